"""The state of the unit control system, put together once a period: the computer, the loop, the buses, journal and recorder."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from level1 import health
from level1.health import BUS_STATES, HEALTH, LOAD, Host, Loop, Reading

JOURNAL_WORDS = (("full", "JournalFull"), ("readonly", "JournalReadOnly"), ("read-only", "JournalReadOnly"),
                 ("malformed", "JournalCorrupt"), ("not a database", "JournalCorrupt"))
"""What the text of a journal's fault says (SQLite's own words among them), and the word of the signal JournalState for it."""


class Watch(Protocol):
    """What is needed of `level1.io.host.HostWatch`."""

    def take(self) -> tuple[int, Host] | None:
        """The measurement since the last call and its time."""


class Bus(Protocol):
    """What is needed of `level1.io.can.Port`."""

    @property
    def state(self) -> str:
        """A word of `health.BUS_STATES`."""

    @property
    def load_percent(self) -> float | None:
        """Share of the bit rate in use; None: not known."""


class Store(Protocol):
    """What is needed of `level1.io.journal.Journal`."""

    @property
    def fault(self) -> str | None:
        """Why events are not on the disk."""


class Recording(Protocol):
    """What is needed of `level1.io.recorder.Recorder`."""

    @property
    def dropped(self) -> int:
        """Frames not recorded so far."""

    @property
    def fault(self) -> str | None:
        """Why traffic is not recorded."""


class Satellites(Protocol):
    """What is needed of `level1.io.gnss.GnssReceiver`."""

    @property
    def fix(self) -> int | None:
        """Quality of the fix."""

    def utc_offset_ns(self) -> int | None:
        """UTC minus the monotonic clock."""


class Housekeeping:
    """Puts the readings together. watch: the computer, measured once a period; buses: their ports."""

    def __init__(self, watch: Watch, buses: Sequence[Bus], journal: Store, recorder: Recording | None = None,
                 gnss: Satellites | None = None):
        self._watch, self._buses, self._journal, self._recorder, self._gnss = watch, buses, journal, recorder, gnss
        self._lateness_ns = 0
        self._dropped = 0

    def take(self, lateness_ns: int, dropped: int) -> list[Reading]:
        """The readings since the last call, none within a period. lateness_ns: of this turn of the loop; dropped: frames lost
        so far."""
        self._lateness_ns = max(self._lateness_ns, lateness_ns)
        measured = self._watch.take()
        if measured is None:
            return []
        t_ns, host = measured
        loop = self._loop(dropped)
        self._lateness_ns, self._dropped = 0, dropped
        fix = None if self._gnss is None else self._gnss.fix
        gnss_time = self._gnss is not None and self._gnss.utc_offset_ns() is not None
        return [Reading(t_ns, HEALTH, health.health(host, loop, fix, gnss_time)), Reading(t_ns, LOAD, health.load(host, loop))]

    def _loop(self, dropped: int) -> Loop:
        fault = self._journal.fault
        recorder = self._recorder
        return Loop(
            lateness_ns=self._lateness_ns, frames_dropped=dropped - self._dropped, bus_state=bus_state(self._buses),
            bus_load_percent=max((bus.load_percent for bus in self._buses if bus.load_percent is not None), default=None),
            journal=journal_word(fault), storage_writes=fault is None,
            recorder_works=None if recorder is None else recorder.fault is None,
            recorder_dropped=None if recorder is None else recorder.dropped)


def bus_state(buses: Sequence[Bus]) -> str | None:
    """State of the worst of the buses, a word of `BUS_STATES`; None without a bus."""
    return max((bus.state for bus in buses), key=BUS_STATES.index, default=None)


def journal_word(fault: str | None) -> str:
    """The word of the signal JournalState for a fault of the journal."""
    if fault is None:
        return "JournalOk"
    return next((word for text, word in JOURNAL_WORDS if text in fault.lower()), "JournalFailed")
