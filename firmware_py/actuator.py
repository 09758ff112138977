"""A part that takes a commanded position after its response time: a valve, a relay, a clamp. It can jam.

Theory of operation. A new target is a *try*; so is the old one again when, `RETRY_NS` after the last try, the part still
stands elsewhere (a driver energises a solenoid again, not without end). Where the driver does not do that by itself
(`retry_ns` None), `again` is one more try. A jammed part ignores tries; "for n commands" means that it ignores n of them and
works again.
"""
from __future__ import annotations

from collections.abc import Collection
from typing import Generic, TypeVar

Position = TypeVar("Position")

RETRY_NS = 1_000_000_000


class Actuator(Generic[Position]):
    """One such part. position: where it stands. response_ns: from a try that it obeys to the new position.

    retry_ns: after this its driver tries once more by itself; None: only when it is told to.
    """

    def __init__(self, position: Position, response_ns: int, retry_ns: int | None = RETRY_NS):
        self.position = position
        self.response_ns = response_ns
        self._retry_ns = retry_ns
        self._target = position
        self._arrives_ns: int | None = None
        self._tried_ns = 0
        self._refused: Collection[Position] | None = ()
        self._refusals: int | None = None

    def advance(self, now_ns: int, target: Position) -> None:
        """Drive it towards a target. Call it often: it moves only then."""
        if target != self._target:
            self._target = target
            self._arrives_ns = None
            if target != self.position:
                self._try(now_ns)
        elif (target != self.position and self._arrives_ns is None and self._retry_ns is not None
              and now_ns - self._tried_ns >= self._retry_ns):
            self._try(now_ns)
        if self._arrives_ns is not None and now_ns >= self._arrives_ns:
            self.position = target
            self._arrives_ns = None

    @property
    def target(self) -> Position:
        """Where it was told to go last."""
        return self._target

    def again(self, now_ns: int) -> None:
        """One more try, if it stands elsewhere, does not move, and was not tried at this very moment."""
        if self._target != self.position and self._arrives_ns is None and self._tried_ns != now_ns:
            self._try(now_ns)

    def _try(self, now_ns: int) -> None:
        self._tried_ns = now_ns
        if not self._ignores(self._target):
            self._arrives_ns = now_ns + self.response_ns

    def _ignores(self, target: Position) -> bool:
        if self._refused is not None and target not in self._refused:
            return False
        if self._refusals is None:
            return True
        self._refusals -= 1
        if self._refusals <= 0:
            self.release()
        return True

    def jam(self, refused: Collection[Position] | None = None, commands: int | None = None) -> None:
        """From now on it ignores commands to these positions (None: to any), so many of them (None: until released)."""
        self._refused = refused
        self._refusals = commands
        self._arrives_ns = None

    def release(self) -> None:
        """It works again, from the next try on."""
        self._refused = ()
        self._refusals = None

    def force(self, position: Position) -> None:
        """It stands there at once, whatever was commanded: a spring returned it, someone turned it."""
        self.position = position
        self._arrives_ns = None
        self._tried_ns -= RETRY_NS
