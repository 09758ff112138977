"""Stands beside the live loop of `ucs run`: hears each turn, tells systemd that it lives, and answers who asks how it stands.

Theory of operation. The supervisor belongs to the loop's thread, so the answer is put together there, between two turns: the
desk's thread leaves a wish, wakes the loop and waits. A loop that does not come by within `PATIENCE_S` hangs; then the last
answer is given, with how old it is. An answer costs the loop less than 0.1 ms, and is given at most fifty times a second.
"""
from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from level1.alarm import AlarmMachine
from level1.catalog import LOCKED_OUT, NORMAL
from level1.event import PRIORITIES, Event, Monitor, Result
from level1.freeze_frame import STATE_WORDS
from level1.health import Reading
from level1.io.can import Port
from level1.io.inquiry import Desk
from level1.io.journal import Journal
from level1.io.live import House, Link, Live
from level1.io.systemd import Supervised
from level1.navigation import FIXES
from level1.repair import IDLE, PAUSING, RUNNING, SETTLING, WAITING, RepairMachine
from level1.timer import FAR
from ucs.readings import Sources
from ucs.standing import RUN, AlarmStanding, BusStanding, GnssStanding, RepairStanding, RunStanding, encode
from ucs.version import version

if TYPE_CHECKING:
    from level1.io.gnss import GnssReceiver

PATIENCE_S = 1.0
KNOCK_S = 0.06
"""The loop looks by once it has work, or when it is woken and has not lately: it is woken so often."""
LATENESS_NS = 30_000_000_000
"""The largest lateness is told of the present and the last such stretch of time."""
LISTED = 100
"""Causes listed; the others are counted."""
PHASES = {IDLE: "idle", RUNNING: "running", PAUSING: "pausing", WAITING: "waiting", SETTLING: "settling"}


class Attendant:
    """The link and the house of a `Live`, with the real ones behind it; a context manager once `attend` was called."""

    def __init__(self, link: Link, house: House | None, clock: Callable[[], int], service: Supervised | None = None):
        self._link, self._house, self._clock = link, house, clock
        self._service = service or Supervised({})
        self._turned_ns = self._begun_ns = clock()
        self._lateness: deque[int] = deque([0, 0], maxlen=2)
        self._lateness_ns = self._begun_ns
        self._begun = False
        self._version = version()
        self._raised_ns: dict[int, int] = {}
        self._story: dict[int, str] = {}
        self._wanted, self._given = threading.Event(), threading.Event()
        self._answer: RunStanding | None = None
        self._standing: Callable[[], RunStanding] | None = None
        self._wake: Callable[[], None] = lambda: None

    def attend(self, live: Live, journal: Journal, sources: Sources, fleet: str) -> Desk:
        """From now on answer for this loop; gives the desk, a context manager."""
        self._standing = lambda: self._look(live, journal, sources, fleet)
        self._answer = self._standing()
        self._wake = live.inbox.wake
        return Desk(Path(journal.path), RUN, self.answer)

    # --- the loop's thread --------------------------------------------------------------------------------------------

    def publish(self, events: Sequence[Event], outputs: Sequence[Monitor | Result]) -> None:
        """See `live.Link`."""
        self._link.publish(events, outputs)
        now_ns = self._turned_ns = self._clock()
        for event in events:
            self._remember(event, now_ns)
        self._service.alive(now_ns)
        if self._wanted.is_set() and self._standing is not None:
            self._wanted.clear()
            self._answer = self._standing()
            self._given.set()

    def take(self, lateness_ns: int, dropped: int) -> Sequence[Reading]:
        """See `live.House`."""
        if self._turned_ns - self._lateness_ns >= LATENESS_NS:
            self._lateness_ns = self._turned_ns
            self._lateness.append(0)
        if self._begun:  # the first turn is late by what the start took
            self._lateness[-1] = max(self._lateness[-1], lateness_ns)
        self._begun = True
        return () if self._house is None else self._house.take(lateness_ns, dropped)

    def _remember(self, event: Event, now_ns: int) -> None:
        if event.event == "raised":
            self._raised_ns[event.instance] = int(event.t.scaleb(9))
        elif event.event == "cleared":
            self._raised_ns.pop(event.instance, None)
            self._story.pop(event.instance, None)
        if event.event in ("repair_failed", "locked_out") and event.text:
            self._story[event.instance] = event.text

    def _look(self, live: Live, journal: Journal, sources: Sources, fleet: str) -> RunStanding:
        supervisor, now_ns = live.supervisor, self._clock()
        active = sorted(supervisor.active(), key=gravest)
        repairable = [name for name, alarm in supervisor.catalog.alarms.items() if alarm.repair]
        armed = supervisor.armed if supervisor.armed is not None else repairable
        is_armed = {name: name in armed or name.partition("@")[0] in armed for name in repairable}
        gnss, recorder = sources.gnss, sources.recorder
        return RunStanding(
            unit=supervisor.unit, fleet=fleet, version=self._version, pid=os.getpid(), boot=supervisor.boot, seq=supervisor.seq,
            uptime_s=(now_ns - self._begun_ns) / 1e9, turn_age_s=0.0, lateness_s=max(self._lateness) / 1e9, mode=supervisor.mode,
            utc_trusted=supervisor.utc_trusted, buses=tuple(bus_standing(port, now_ns, port.state) for port in live.ports),
            alarms=tuple(self._alarm(machine, repair, now_ns, is_armed.get(machine.definition.name, True))
                         for machine, repair in active[:LISTED]),
            hidden=max(0, len(active) - LISTED), defined=len(supervisor.catalog.alarms),
            armed=tuple(name for name in repairable if is_armed[name]),
            passive=tuple(name for name in repairable if not is_armed[name]), dropped=live.dropped,
            journal_fault=journal.fault or "", journal_waiting=len(journal.pending), journal_lost=journal.lost,
            gnss=None if gnss is None else _gnss(gnss), recorder=None if recorder is None else str(recorder.folder),
            recorder_fault=recorder and recorder.fault or "", recorder_dropped=recorder.dropped if recorder else 0,
            counters=dict(supervisor.counters))

    def _alarm(self, machine: AlarmMachine, repair: RepairMachine | None, now_ns: int, armed: bool) -> AlarmStanding:
        raised_ns = self._raised_ns.get(machine.instance)
        story = self._story.get(machine.instance, "")
        age_s = None if raised_ns is None else max(0.0, (now_ns - raised_ns) / 1e9)
        return alarm_standing(machine, repair, now_ns, armed, age_s, story if machine.state == LOCKED_OUT else "")

    # --- the desk's thread --------------------------------------------------------------------------------------------

    def answer(self) -> bytes:
        """How the loop stands now; of one that hangs, how it stood."""
        self._given.clear()
        self._wanted.set()
        for _ in range(round(PATIENCE_S / KNOCK_S)):
            self._wake()
            if self._given.wait(KNOCK_S):
                break
        answer = self._answer
        assert answer is not None
        return encode(msgspec.structs.replace(answer, turn_age_s=max(0.0, (self._clock() - self._turned_ns) / 1e9)))


def bus_standing(port: Port, now_ns: int, state: str) -> BusStanding:
    """A bus as a standing. state: a word of `health.BUS_STATES`."""
    settings, last_ns = port.settings, port.last_ns
    return BusStanding(
        name=settings.name, interface=settings.interface, channel=settings.channel, state=state, received=port.received,
        sent=port.counters["sent"], quiet_s=None if last_ns is None else max(0.0, (now_ns - last_ns) / 1e9),
        load_percent=port.load_percent, counters=dict(port.counters))


def gravest(found: tuple[AlarmMachine, RepairMachine | None]) -> tuple[int, int]:
    """Sorts the gravest first, then the newest."""
    return -PRIORITIES.index(found[0].definition.priority), -found[0].instance


def _gnss(receiver: GnssReceiver) -> GnssStanding:
    fix = receiver.fix
    return GnssStanding(receiver.settings.port, None if fix is None else FIXES[fix], receiver.utc_offset_ns() is not None)


def alarm_standing(machine: AlarmMachine, repair: RepairMachine | None, now_ns: int, armed: bool, age_s: float | None,
                   story: str = "") -> AlarmStanding:
    """An alarm as a standing. armed: its repair may act. story: what to tell in place of its text."""
    definition = machine.definition
    shown = repair is not None and machine.state != NORMAL and (repair.attempt or repair.reported or repair.phase != IDLE)
    return AlarmStanding(
        name=definition.name, code=definition.code, priority=definition.priority, state=STATE_WORDS[machine.state],
        text=story or machine.text, key=machine.key, instance=machine.instance, age_s=age_s, latch=definition.latch,
        acknowledged=machine.acknowledged, repair=_repair(repair, now_ns, armed) if repair is not None and shown else None)


def _repair(repair: RepairMachine, now_ns: int, armed: bool) -> RepairStanding:
    definition, running = repair.definition, repair.phase == RUNNING
    texts = [text.strip() for text in definition.text.split(";") if text.strip()]
    position = min(repair.position, len(definition.steps) - 1)
    return RepairStanding(
        phase=PHASES[repair.phase] if armed else "passive", attempt=repair.attempt, attempts=definition.attempts,
        used=sum(begun_ns > now_ns - definition.window_ns for begun_ns in repair.begun_ns),
        step=position + 1 if running else 0, steps=len(definition.steps),
        doing=texts[position] if running and len(texts) == len(definition.steps) else "",
        left_s=None if repair.due >= FAR else max(0.0, (repair.due - now_ns) / 1e9), obstacle=repair.obstacle())
