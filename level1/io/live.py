"""The live loop: the one thread that owns the supervisor of a unit.

It waits for frames, orders or the next deadline; hands frames over in batches, and what the buses' threads report among them, in
the order of the stamps; and brings what comes out to where it belongs: **events into the journal first, on the disk**, then
frames to the buses, then results and monitoring messages to the link upward. On a busy bus waking up costs more than all the
rest: while turns of the loop follow each other within `BUSY_NS` there is at least `NAP_NS` between two, in which frames gather; a
frame on a quiet bus is looked at at once. What a turn does without a reason to is paid a thousand times a second: it looks at the
inbox, and asks for readings, only when the bell has rung.

Time is the monotonic clock; UTC is a label, measured anew all the time, because the wall clock of a tractor jumps.
"""
from __future__ import annotations

import gc
import time
from bisect import bisect_right
from collections.abc import Callable, Collection, Sequence
from operator import itemgetter
from typing import Protocol

import msgspec

from level1 import bus_health, health
from level1.bus_health import Report, Tolls
from level1.command import Order
from level1.event import Commanded, Event, Monitor, Output, Result, Send, SentFrame, seconds
from level1.frame import BUS_SHIFT, EXTENDED, Row
from level1.health import Reading
from level1.io.can import Port
from level1.io.host import clock_is_synchronised
from level1.io.inbox import NOTHING, Inbox, Load
from level1.io.listening import listening
from level1.j1939_node import ADDRESS_CLAIMED
from level1.memory import State
from level1.supervisor import COMMAND, Supervisor

LAG_NS = 2_000_000
"""Deadlines are served so late, that a frame stamped before one, which its reader hands over a moment later, still counts."""
LONGEST_WAIT_S = 1.0
NAP_NS = 1_050_000
"""From one turn to the next on a busy bus: what is left of it is slept, less than a millisecond."""
NAP_S = NAP_NS / 1e9
BUSY_NS = 2 * NAP_NS
"""Turns that follow each other so fast, frames in all of them, make a bus a busy one."""
LABEL_PERIOD_NS = 10_000_000
"""So often UTC is measured."""
QUIET_NS = 50_000_000
"""Where nothing comes out, journal and link are looked after so often."""
LOSS_NS = 500_000_000
"""So long after the last lost frame the loss is over."""
DROPPED = "UCS"
"""Key of the cause of `FramesLost` for frames of any bus that came faster than they were supervised."""
TRUST_PERIOD_NS = 10_000_000_000
YOUNG_OBJECTS = 20_000
"""New objects that wait for the garbage collector: the frames of two windows of `bus_health` at the most, which need none."""
_stamp = itemgetter(0)
"""Time of a frame or a reading."""


class EventStore(Protocol):
    """What the loop needs of `level1.io.journal.Journal`."""

    def append(self, events: Sequence[Event], state: bytes, commands: Sequence[Commanded] = ()) -> bool:
        """Write events, commands and the state after them; True when they are on the disk."""

    def record(self, monitors: Sequence[Monitor]) -> None:
        """Keep monitoring messages; waits for nothing."""

    @property
    def fault(self) -> str | None:
        """Why events are not on the disk."""

    @property
    def incidents(self) -> tuple[str, ...]:
        """What befell the journal's file so far."""


class Link(Protocol):
    """The way to the bridge process; never blocks. What it can't take is in the journal, or soon out of date."""

    def publish(self, events: Sequence[Event], outputs: Sequence[Monitor | Result]) -> None:
        """Called with what there is, and now and then with nothing: events that were just journaled, monitoring messages and
        answers to orders."""


class Tap(Protocol):
    """What the loop needs of `level1.io.recorder.Recorder`; never blocks."""

    def reopen(self) -> None:
        """Begin a new file."""

    def record(self, frames: Sequence[Row] | Sequence[Send]) -> None:
        """Record what was received or sent."""


class Receiver(Protocol):
    """What the loop needs of `level1.io.gnss.GnssReceiver`, which wakes the inbox when it has readings."""

    def take(self) -> Sequence[Reading]:
        """The readings since the last call."""

    def reopen(self) -> None:
        """Have the line opened anew."""

    def utc_offset_ns(self) -> int | None:
        """UTC minus the monotonic clock by the satellites, None: not known."""


class House(Protocol):
    """What the loop needs of `level1.io.housekeeping.Housekeeping`, whose watch wakes the inbox when it has measured."""

    def take(self, lateness_ns: int, dropped: int) -> Sequence[Reading]:
        """The readings since the last call. lateness_ns: the worst since then; dropped: frames lost so far."""


class Live:
    """Drives a supervisor from an inbox and ports until `stop`.

    supervisor: of this boot, not yet given anything. ports: in the order of the bus indexes, started and stopped by the
    caller. told: called with every event once it is in the journal. notice: called with a line about the world (a bus lost,
    the journal's disk full). clock, wall: monotonic and wall clock in ns. dropped: frames that came faster than they were
    supervised. recorder, gnss, house: the traffic recorder, the GNSS receiver, the state of the computer, where there are any.
    quiet: readings that are not sent on the buses. nap: sleeps for so many seconds.
    """

    def __init__(self, supervisor: Supervisor, journal: EventStore, ports: Sequence[Port], inbox: Inbox, *,
                 clock: Callable[[], int], wall: Callable[[], int], told: Callable[[Event], None],
                 notice: Callable[[str], None], link: Link | None = None, recorder: Tap | None = None,
                 gnss: Receiver | None = None, house: House | None = None, quiet: Collection[str] = (),
                 nap: Callable[[float], None] = time.sleep):
        self.supervisor, self.journal, self.ports, self.inbox = supervisor, journal, ports, inbox
        self.dropped = 0
        self._clock, self._wall, self._told, self._notice, self._link = clock, wall, told, notice, link
        self._recorder, self._gnss, self._house, self._quiet = recorder, gnss, house, frozenset(quiet)
        self._synchronised = False
        self._stopping = False
        self._served_ns = clock()
        self._retry_ns: int | None = None
        self._trust_due_ns = self._label_due_ns = self._lateness_ns = 0
        self._fault: str | None = None
        self._incidents = 0
        self._nap = nap
        self._busy = False
        self._turned_ns = clock()
        self._delivered_ns = self._turned_ns - QUIET_NS
        self._missing = 0
        self._missing_ns: int | None = None
        self._addresses: dict[int, int] = {}
        self._begun = False
        self._tolls = Tolls()
        for port in ports:
            self._listen(port)

    def stop(self) -> None:
        """End `run` soon; may be called from a signal handler."""
        self._stopping = True
        self.inbox.wake()

    def run(self) -> None:
        """Supervise until `stop`; then store the state."""
        settle_memory()
        now_ns = self._clock()
        self._label(now_ns)
        self.supervisor.begin(now_ns)  # not while things were made ready: what it then sends would be late at once
        try:
            while not self._stopping:
                self.turn(NAP_S if self._busy else self.patience_s())
        finally:
            self.journal.append((), encode_state(self.supervisor.state()))

    def turn(self, patience_s: float) -> None:
        """Wait at most so long for something to do, and do all there is."""
        self._wait(patience_s)
        load = self.inbox.take() if self.inbox.rung else NOTHING
        frames = self._fetch(load.frames) if load.frames or len(self.ports) != 1 else self.ports[0].fetch()
        now_ns = self._clock()
        self._busy = bool(frames) and now_ns - self._turned_ns < BUSY_NS
        self._turned_ns = now_ns
        if now_ns >= self._label_due_ns:
            self._label(now_ns)
        supervisor = self.supervisor
        deadline = supervisor.next_deadline()
        oldest_ns = now_ns if deadline is None else deadline
        if frames and frames[0][0] < oldest_ns:
            oldest_ns = frames[0][0]
        if now_ns - oldest_ns > self._lateness_ns:
            self._lateness_ns = now_ns - oldest_ns
        beside = self._hear(load, now_ns) if load is not NOTHING or self._missing else ()
        outputs: list[Output] = [] if self._begun else self._begin()
        if frames or beside:
            outputs += self._feed(frames, beside)
        served_ns = now_ns - LAG_NS
        if served_ns < supervisor.now_ns:
            served_ns = supervisor.now_ns
        if served_ns > self._served_ns:
            self._served_ns = served_ns
        commands = [self._command(order, outputs) for order in load.orders] if load.orders else ()
        for request in load.requests:
            outputs.extend(supervisor.ask(*request, self._served_ns))
        deadline = supervisor.next_deadline()
        if deadline is not None and deadline <= self._served_ns:
            outputs.extend(supervisor.tick(self._served_ns))
        if outputs or self._retry_ns is not None or now_ns - self._delivered_ns >= QUIET_NS:
            self._delivered_ns = now_ns
            self._deliver(outputs, commands)

    def _command(self, order: Order, outputs: list[Output]) -> Commanded:
        """Have an order obeyed; gives what the journal is to know of it."""
        supervisor, now_ns = self.supervisor, self._served_ns
        outputs += supervisor.tick(now_ns)
        after = supervisor.seq
        found = supervisor.command(order, now_ns)
        outputs += found
        frames = tuple(sent_frame(send) for send in found if isinstance(send, Send) and send.reason == f"{COMMAND} {order.name}")
        result = next(output for output in found if isinstance(output, Result))
        return Commanded(supervisor.unit, supervisor.boot, after, seconds(now_ns), supervisor.utc(now_ns), supervisor.utc_trusted,
                         order.name, order.target, order.value, order.origin, order.by, order.called or order.id, result.outcome,
                         result.reason, frames)

    def _wait(self, patience_s: float) -> None:
        """Until something comes; on a busy bus until enough has come."""
        rest_ns = self._turned_ns + NAP_NS - self._clock() if self._busy else 0
        if 0 < rest_ns <= NAP_NS and patience_s > 0:
            self._nap(rest_ns / 1e9)
        else:
            self.inbox.wait(patience_s)

    def _fetch(self, waiting: Sequence[Row]) -> list[Row]:
        """The frames of all buses, in the order of their stamps. waiting: those that were in the inbox."""
        frames = list(waiting)
        for port in self.ports:
            frames += port.fetch()
        frames.sort(key=_stamp)
        return frames

    def _hear(self, load: Load, now_ns: int) -> list[Reading | Report]:
        """The bell has rung: tell what is to be told at once, and take what the UCS says of itself and what befell its buses, in
        the order of the stamps."""
        for text in load.notices:
            self._notice(text)
        if load.dropped:
            self.dropped += load.dropped
            self._notice(f"{load.dropped} frames dropped, the oldest first: supervision can't keep up")
        beside: list[Reading | Report] = [*self._readings(), *load.reports, *self._drops(load.dropped, now_ns)]
        beside.sort(key=_stamp)
        return beside

    # --- the health of the buses --------------------------------------------------------------------------------------

    def _begin(self) -> list[Output]:
        """The first turn: what the last boot left of the buses is over, unless it is reported again."""
        self._begun = True
        supervisor = self.supervisor
        outputs = list(supervisor.tick(max(self._served_ns, supervisor.now_ns)))
        for alarm in bus_health.ALARMS:
            for key, detail in supervisor.causes(alarm).items():
                outputs += self._tell(Report(supervisor.now_ns, alarm, key, False, detail, ""))
        return outputs

    def _tell(self, report: Report) -> Sequence[Output]:
        """A cause of an alarm that no condition raises, at its time, or, heard late, at the time that supervision has come to."""
        supervisor = self.supervisor
        report = report._replace(t_ns=max(report.t_ns, supervisor.now_ns))
        outputs = list(supervisor.tick(report.t_ns))
        stands = report.key in supervisor.causes(report.alarm)
        t_ns, alarm, key, present, detail, text = self._tolls.summed(report, stands=stands)
        if present or stands:
            supervisor.report(t_ns, alarm, key, True, detail, text)
        supervisor.report(t_ns, alarm, key, present, detail, text)
        supervisor.board.settle(t_ns)
        return [*outputs, *supervisor.tick(t_ns)]

    def _drops(self, dropped: int, now_ns: int) -> list[Report]:
        """Frames that came faster than they were supervised."""
        if dropped:
            self._missing += dropped
            self._missing_ns = now_ns
        elif self._missing_ns is None or now_ns - self._missing_ns < LOSS_NS:
            return []
        else:
            self._missing_ns = None
        text = f"{self._missing} frames were lost because supervision could not keep up"
        report = Report(now_ns, bus_health.LOST, DROPPED, bool(dropped), {"Frames": self._missing}, text)
        if not dropped:
            self._missing = 0
        return [report]

    def _listen(self, port: Port) -> None:
        """Let the kernel hold back what nobody asks for."""
        address = self._addresses.get(port.index)
        port.listen(listening(self.supervisor, port.index, address, everything=self._recorder is not None))

    def _follow(self, sends: Sequence[Send]) -> None:
        """Listen to the address that the UCS claims."""
        for send in sends:
            bus, source = send.key >> BUS_SHIFT, send.key & 0xFF
            if send.key & EXTENDED and send.key >> 8 & 0x3FF00 == ADDRESS_CLAIMED and self._addresses.get(bus) != source:
                self._addresses[bus] = source
                self._listen(self.ports[bus])

    def _readings(self) -> list[Reading]:
        """What the UCS says of itself since the last call."""
        readings = list(self._gnss.take()) if self._gnss is not None else []
        if self._house is not None:
            readings += self._house.take(self._lateness_ns, self.dropped)
            self._lateness_ns = 0
        return readings

    def _feed(self, frames: Sequence[Row], beside: Sequence[Reading | Report]) -> list[Output]:
        """Frames of several buses, and the readings and reports among them, in the order of their stamps."""
        if self._recorder is not None:
            self._recorder.record(frames)
        if not beside:
            return self.supervisor.receive_many(frames)
        outputs: list[Output] = []
        begin = 0
        for one in beside:
            end = bisect_right(frames, one.t_ns, begin, key=_stamp)
            outputs += self.supervisor.receive_many(frames[begin:end])
            outputs += self._tell(one) if isinstance(one, Report) else self._publish(one)
            begin = end
        return outputs + self.supervisor.receive_many(frames[begin:] if begin else frames)

    def _publish(self, reading: Reading) -> Sequence[Output]:
        if reading.message not in self.supervisor.gate.readings:
            return ()
        raws = health.raws(self.supervisor.catalog.messages[reading.message], reading.values)
        return self.supervisor.publish(reading.t_ns, reading.message, raws, reading.message not in self._quiet)

    def _deliver(self, outputs: Sequence[Output], commands: Sequence[Commanded] = ()) -> None:
        """Durable first; then to the buses; then upward."""
        events = [output for output in outputs if isinstance(output, Event)]
        upward = [output for output in outputs if isinstance(output, Monitor | Result)]
        if events or any(isinstance(output, Result) for output in upward):
            self.journal.append(events, encode_state(self.supervisor.state()), commands)
        now_ns = self._clock()
        sends = [output for output in outputs if isinstance(output, Send)]
        self._follow(sends)
        for send in sends:
            self.ports[send.key >> BUS_SHIFT].send(send, now_ns)
            self._obey(send)
        if sends and self._recorder is not None:
            self._recorder.record(sends)
        retries = [retry for port in self.ports if (retry := port.flush(now_ns)) is not None]
        self._retry_ns = min(retries, default=None)
        if self._link is not None:
            self._link.publish(events, upward)
        monitors = [output for output in upward if isinstance(output, Monitor)]
        if monitors:
            self.journal.record(monitors)
        for event in events:
            self._told(event)
        self._tell_journal()

    def _obey(self, send: Send) -> None:
        """Orders of repairs to this program itself."""
        if send.message.partition("@")[0] == health.LOG_ORDER and self._recorder is not None:
            self._recorder.reopen()
        elif send.message.partition("@")[0] == health.TIME_ORDER:
            self._trust_due_ns = 0
            if self._gnss is not None:
                self._gnss.reopen()

    def _tell_journal(self) -> None:
        for incident in self.journal.incidents[self._incidents:]:
            self._notice(incident)
            self._incidents += 1
        fault = self.journal.fault
        if fault != self._fault:
            self._notice(fault or "the journal works again; nothing waits in memory")
            self._fault = fault

    def patience_s(self) -> float:
        """How long nothing has to be done, unless something comes."""
        deadline = self.supervisor.next_deadline()
        dues = [due for due in (deadline + LAG_NS if deadline is not None else None, self._retry_ns) if due is not None]
        wait_s = (min(dues) - self._clock()) / 1e9 if dues else LONGEST_WAIT_S
        return min(max(wait_s, 0.0), LONGEST_WAIT_S)

    def _label(self, now_ns: int) -> None:
        """UTC beside the time line, and whether it is to be trusted: the wall clock if something keeps it right, else the
        satellites, else the wall clock all the same."""
        self._label_due_ns = now_ns + LABEL_PERIOD_NS
        if now_ns >= self._trust_due_ns:
            self._trust_due_ns = now_ns + TRUST_PERIOD_NS
            self._synchronised = clock_is_synchronised()
        offset_ns = None if self._synchronised or self._gnss is None else self._gnss.utc_offset_ns()
        self.supervisor.utc_offset_ns = self._wall() - now_ns if offset_ns is None else offset_ns
        self.supervisor.utc_trusted = self._synchronised or offset_ns is not None


def settle_memory() -> None:
    """What is loaded stays: to look through all of it in the middle of the work takes 20 ms. What comes later is let go without
    the garbage collector, but for a few cycles; it need not look every hundred frames."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS)


def sent_frame(send: Send) -> SentFrame:
    """A frame as events and commands name it."""
    return SentFrame(send.message, f"{send.key & 0x1FFF_FFFF:0{8 if send.key & EXTENDED else 3}X}", send.data.hex().upper())


def encode_state(state: State) -> bytes:
    """The supervisor's state as the journal keeps it."""
    return msgspec.json.encode(state)


def decode_state(stored: bytes) -> State:
    """The state the journal kept. Raises msgspec.DecodeError when another version of this program wrote it."""
    return msgspec.json.decode(stored, type=State)
