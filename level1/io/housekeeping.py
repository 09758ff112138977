"""The state of the unit control system, put together once a period: the computer, the loop, the buses, journal and recorder."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from level1 import health
from level1.health import BUS_STATES, HEALTH, LOAD, Host, Loop, Reading

JOURNAL_WORDS = (("full", "JournalFull"), ("readonly", "JournalReadOnly"), ("read-only", "JournalReadOnly"),
                 ("malformed", "JournalCorrupt"), ("not a database", "JournalCorrupt"))
"""What the text of a journal's fault says (SQLite's own words among them), and the word of the signal JournalState for it."""
INCIDENT_WORDS = ((" was corrupt: ", "JournalCorrupt"), (" is too big: ", "JournalFull"),
                  (" dropped: the disk is full", "JournalFull"))
"""The same for its incidents."""


INCIDENT_NS = 10_000_000_000
"""So long an incident of the journal shows, though it is over: longer than the on-delay of the alarm that tells it."""


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

    @property
    def incidents(self) -> tuple[str, ...]:
        """What befell the file so far: damaged, gone, events dropped."""


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
        self._incidents = 0
        self._incident_ns: int | None = None

    def take(self, lateness_ns: int, dropped: int) -> list[Reading]:
        """The readings since the last call, none within a period. lateness_ns: the loop's worst since then; dropped: frames lost
        so far."""
        self._lateness_ns = max(self._lateness_ns, lateness_ns)
        measured = self._watch.take()
        if measured is None:
            return []
        t_ns, host = measured
        loop = self._loop(t_ns, dropped)
        self._lateness_ns, self._dropped = 0, dropped
        fix = None if self._gnss is None else self._gnss.fix
        gnss_time = self._gnss is not None and self._gnss.utc_offset_ns() is not None
        return [Reading(t_ns, HEALTH, health.health(host, loop, fix, gnss_time)), Reading(t_ns, LOAD, health.load(host, loop))]

    def _loop(self, t_ns: int, dropped: int) -> Loop:
        fault = self._journal.fault
        recorder = self._recorder
        return Loop(
            lateness_ns=self._lateness_ns, frames_dropped=dropped - self._dropped, bus_state=bus_state(self._buses),
            bus_load_percent=max((bus.load_percent for bus in self._buses if bus.load_percent is not None), default=None),
            journal=journal_word(fault) if fault else self._incident_word(t_ns), storage_writes=fault is None,
            recorder_works=None if recorder is None else recorder.fault is None,
            recorder_dropped=None if recorder is None else recorder.dropped)

    def _incident_word(self, t_ns: int) -> str:
        """The word for what has lately befallen a journal that works again."""
        incidents = self._journal.incidents
        if len(incidents) > self._incidents:
            self._incidents, self._incident_ns = len(incidents), t_ns
        if self._incident_ns is None or t_ns - self._incident_ns >= INCIDENT_NS:
            return "JournalOk"
        return next((word for text, word in INCIDENT_WORDS if text in incidents[-1]), "JournalFailed")


def bus_state(buses: Sequence[Bus]) -> str | None:
    """State of the worst of the buses, a word of `BUS_STATES`; None without a bus."""
    return max((bus.state for bus in buses), key=BUS_STATES.index, default=None)


def journal_word(fault: str | None) -> str:
    """The word of the signal JournalState for a fault of the journal."""
    if fault is None:
        return "JournalOk"
    trouble = fault.partition(": ")[2].lower()  # the path before it may have any words
    return next((word for text, word in JOURNAL_WORDS if text in trouble), "JournalFailed")
