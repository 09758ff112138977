"""Who takes part on a bus: three calls, no I/O, no clock. Nodes do, and so can anything that is attached to a simulation."""
from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable


class BusFrame(NamedTuple):
    """A data frame on a bus: identifier of 11 bits, or of 29 when `extended`; 0–8 payload bytes."""

    can_id: int
    extended: bool
    data: bytes


class Happening(NamedTuple):
    """Something worth telling: when (ns), who, what, in one line."""

    t_ns: int
    who: str
    text: str


class Participant(Protocol):
    """Anything that hears and sends frames. Times are ns on the caller's monotonic line and never run backwards.

    The caller steps it whenever `next_deadline` is reached, and again after each frame that makes its deadline due.
    """

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """Hear a frame of another participant."""

    def step(self, now_ns: int) -> list[BusFrame]:
        """Do all that is due up to now and give the frames to send, in order."""

    def next_deadline(self) -> int | None:
        """When `step` is wanted next at the latest; a time that has passed means at once, None never."""


@runtime_checkable
class Storyteller(Protocol):
    """A participant that tells what happens to it."""

    def take_happenings(self) -> list[Happening]:
        """What happened since the last call, in order."""


@runtime_checkable
class Selective(Protocol):
    """A participant that does nothing about most frames: it need not be told of those that it doesn't hear."""

    def hears(self, can_id: int, extended: bool) -> bool:
        """Whether `receive` does anything about frames of this identifier; always the same answer."""


@runtime_checkable
class Meddler(Protocol):
    """A participant whose `step` does something to others, so that their deadlines may move."""

    meddles: bool
