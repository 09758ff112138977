"""How a running process stands, as it tells those who ask (`level1.io.inquiry`): the answer of `ucs run`, and of `ucs bridge`.

Fields may be added; a reader takes what it knows. Durations in seconds, times none: the asker's clock need not be ours.
"""
from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from level1.io.inquiry import Silence, ask


class RepairStanding(msgspec.Struct, frozen=True):
    """A repair under way or given up.

    phase: idle, running, pausing, waiting (something is in the way: `obstacle`), settling, or passive (not armed). attempt: of this
    activation; used, attempts: of the budget, which earlier activations use up too. step, steps: which of how many, from 1.
    left_s: of the present wait, expectation or pause; None: nothing runs out.
    """

    phase: str
    attempt: int
    used: int
    attempts: int
    step: int = 0
    steps: int = 0
    doing: str = ""
    left_s: float | None = None
    obstacle: str = ""


    @property
    def attempt_text(self) -> str:
        """Which attempt of how many."""
        if self.used == self.attempt:
            return f"attempt {self.attempt} of {self.attempts}"
        return f"attempt {self.attempt} ({self.used} of {self.attempts} of the budget used)"


class AlarmStanding(msgspec.Struct, frozen=True):
    """An alarm, or one cause of one that a subsystem reports, that is not normal. state: a word of `freeze_frame.STATE_WORDS`.

    key: of the cause. age_s: since it was raised; None: in an earlier boot. latch: it waits for an acknowledgement to clear.
    """

    name: str
    code: int
    priority: str
    state: str
    text: str = ""
    key: str = ""
    instance: int = 0
    age_s: float | None = None
    latch: bool = False
    acknowledged: bool = False
    repair: RepairStanding | None = None


class BusStanding(msgspec.Struct, frozen=True):
    """A bus. state: a word of `health.BUS_STATES`. quiet_s: since the last frame, None: none yet. counters: as `Port` counts."""

    name: str
    interface: str
    channel: str
    state: str
    received: int
    sent: int
    quiet_s: float | None = None
    load_percent: float | None = None
    counters: dict[str, int] = {}


class GnssStanding(msgspec.Struct, frozen=True):
    """The GNSS receiver. fix: a word of `navigation.FIXES`, None: nothing heard lately. time: whether it gives UTC."""

    port: str
    fix: str | None
    time: bool


class RunStanding(msgspec.Struct, frozen=True):
    """`ucs run`. turn_age_s: since the loop last did a turn: large means that it hangs, and the rest is as old.

    lateness_s: of the loop, the largest within the last minute or so. mode: running, paused or stopped. hidden:
    active causes that are not listed. journal_fault, recorder_fault: why nothing is written, empty when it is.
    """

    unit: str
    fleet: str
    version: str
    pid: int
    boot: int
    seq: int
    uptime_s: float
    turn_age_s: float
    lateness_s: float
    mode: str
    utc_trusted: bool
    buses: tuple[BusStanding, ...]
    alarms: tuple[AlarmStanding, ...]
    defined: int
    armed: tuple[str, ...] = ()
    passive: tuple[str, ...] = ()
    hidden: int = 0
    dropped: int = 0
    journal_fault: str = ""
    journal_waiting: int = 0
    journal_lost: int = 0
    gnss: GnssStanding | None = None
    recorder: str | None = None
    recorder_fault: str = ""
    recorder_dropped: int = 0
    counters: dict[str, int] = {}


class BridgeStanding(msgspec.Struct, frozen=True):
    """`ucs bridge`. online_s: how long it has been connected or not. ack_age_s: since the last acknowledgement, None: none yet.
    said: the last line it told."""

    broker: str
    version: str
    pid: int
    uptime_s: float
    turn_age_s: float
    online: bool
    online_s: float
    ack_age_s: float | None = None
    said: str = ""
    counters: dict[str, int] = {}


RUN, BRIDGE = "run", "bridge"
T = TypeVar("T")


def encode(standing: RunStanding | BridgeStanding) -> bytes:
    """What goes over the socket."""
    return msgspec.json.encode(standing)


def ask_run(journal: Path) -> RunStanding | Silence:
    """How the `ucs run` of a journal stands, or why that is not known."""
    return _decoded(ask(journal, RUN), RunStanding)


def ask_bridge(journal: Path) -> BridgeStanding | Silence:
    """How the `ucs bridge` of a journal stands, or why that is not known."""
    return _decoded(ask(journal, BRIDGE), BridgeStanding)


def _decoded(answer: bytes | Silence, kind: type[T]) -> T | Silence:
    if isinstance(answer, Silence):
        return answer
    try:
        return msgspec.json.decode(answer, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return Silence.MUTE  # another version's, or cut off
