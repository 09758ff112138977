"""The supervisor of one unit: frames and time in, events and frames out. A function of what it is given; it performs no I/O.

Live, replay, simulation and tests drive this one object. Deadlines fall exactly where they belong: everything due up to the
time of an input happens first, in order, each at its own time. The same input gives the same events, byte for byte, whether
it comes frame by frame or in batches. A time stamp that runs backwards is clamped to the last one and counted.
"""
from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from itertools import chain
from typing import Any

from level1.alarm import AlarmMachine
from level1.board import ALWAYS, Board, Cell, Page, Watch
from level1.can_gnss import CanReceiver
from level1.canopen import DEVICE_EMERGENCY, DEVICE_SILENT, NMT, REQUEST_NS, SDO, Device, Devices
from level1.catalog import ACTIVE, LOCKED_OUT, NORMAL, REPAIRING, Catalog, Command, Message, Repair
from level1.command import Order
from level1.condition import Compiler, Things, Thresholds, Verdict, Zone, walk
from level1.decode import GOOD, NEVER, QUALITY_WORDS, encode, raw_range, reader
from level1.event import PRIORITIES, Event, Monitor, Output, Result, Send, SentFrame, seconds
from level1.expression import (
    ExpectStep,
    Expression,
    Quality,
    ResendStep,
    SendStep,
    SignalValue,
)
from level1.frame import Frame, frame_key
from level1.freeze_frame import freeze_frame, physical
from level1.gate import Gate, Refused
from level1.health import Reading, raws
from level1.holds import Holds
from level1.memory import AlarmMemory, State
from level1.repair import RepairMachine
from level1.subsystems import TROUBLE_CODE, Subsystems
from level1.timer import FAR, Timed, Timers

REQUEST_STORED = "request_dm2"
"""Order that asks a J1939 sender (target: its address) for the trouble codes it has stored."""
COMMAND = "command"
"""First word of the reason of frames sent for an order; its name follows."""
UNTOLD = -1
"""Outcome of a condition before its first evaluation: whatever it is then, its alarm is told."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


MAX_INSTANCES = 256
"""Causes at one time of an alarm that subsystems report; more are counted, not kept: a babbling node must not fill the memory."""


class Supervisor:
    """Supervises one unit.

    unit: its name. boot, with the seq given to each event, is the event's identity: never give the same boot twice. seq:
    last one used. j1939: bus index -> source address to claim there. armed: alarms whose repairs may act; None arms all.
    broadcast: send the alarm messages on the bus, and guard devices. start_ns: when the time line begins, None: at the first input.
    devices: CANopen devices known beforehand; others are learned when they are heard.
    monitor_ns: period of the monitoring messages, None for none. utc_offset_ns: UTC minus time line, None where no wall
    clock is known; it may be set at any time, as may utc_trusted. restored: the state stored at the end of an earlier boot.
    readings: UCS messages whose values are given to `publish`. gnss_bus: index of the bus on which the unit's GNSS receiver
    speaks, None: on none.
    """

    def __init__(self, catalog: Catalog, *, unit: str, boot: int = 1, seq: int = 0, armed: Collection[str] | None = None,
                 broadcast: bool = True, start_ns: int | None = None, monitor_ns: int | None = None,
                 utc_offset_ns: int | None = None, utc_trusted: bool = False, restored: State | None = None,
                 j1939: Mapping[int, int] | None = None, devices: Iterable[Device] = (),
                 readings: Collection[str] = (), gnss_bus: int | None = None):
        self.catalog = catalog
        self.unit = unit
        self.boot = boot
        self.seq = seq
        self.armed = None if armed is None else frozenset(armed)
        self.utc_offset_ns = utc_offset_ns
        self.utc_trusted = utc_trusted
        self.mode = restored.mode if restored is not None else "running"
        self.timers = Timers()
        self.board = Board(catalog, self.timers)
        self.counters = self.board.counters
        self.now_ns = start_ns if start_ns is not None else -FAR
        self._begun = False
        self._restored = restored
        self._out: list[Output] = []
        self._things = Things()
        self._alarms = {name: AlarmMachine(alarm, self, self.timers) for name, alarm in catalog.alarms.items()}
        self._reported: dict[str, dict[str, AlarmMachine]] = {name: {} for name in catalog.alarms}
        self._raised: dict[str, deque[int]] = {}
        self._activations: Counter[str] = Counter()
        self._counts: list[_Window] = []
        self.holds = Holds(catalog, self.board, self.timers, self.send, self._fits, self._circumstances_changed, self.counters)
        self._inputs: dict[str, list[tuple[str, Callable[[int], Any]]]] = {}
        self._watches: list[Watch] = []
        self._repairs: dict[str, RepairMachine] = {}
        self._devices = Devices(catalog, devices, self, self.timers, self.counters, asks=broadcast) \
            if DEVICE_EMERGENCY in self._alarms or DEVICE_SILENT in self._alarms else None
        self._receiver = None if gnss_bus is None else CanReceiver(gnss_bus, self.timers, self._hear, lambda: self.utc_offset_ns)
        self._compile(j1939 or {})
        self._broadcasts = self._make_broadcasts() if broadcast else {}
        self._samplers = self._make_samplers(monitor_ns) if monitor_ns else []
        self.gate = Gate(catalog, self.sendable(), frozenset(readings), j1939 or (),
                         *(self._devices.questions, self._devices.readable) if self._devices is not None else ())
        self.subsystems.own_keys = frozenset(
            frame_key(message.can_id, message.extended, bus) for name in self._broadcasts
            for message in (catalog.messages[name],) if message.senders == ("UCS",) for bus in catalog.buses.get(name, (0,)))

    # --- inputs -----------------------------------------------------------------------------------------------------------

    def receive(self, frame: Frame) -> Sequence[Output]:
        """One frame, with everything that was due before it."""
        t, key, data = frame
        page = self.board.table.get(key)
        if page is None or not self._begun or not self.now_ns <= t < self.timers.next_ns:
            return self.receive_many((frame,))
        self.now_ns = t
        page.receive(t, data)
        if self.board.queued:
            self.board.settle(t)
        return self._take() if self._out else ()

    def receive_many(self, frames: Iterable[tuple[int, int, bytes]]) -> list[Output]:
        """Frames in order; the same as `receive` for each, without its cost a call."""
        board, timers = self.board, self.timers
        table, queued, settle = board.table, board.queued, board.settle
        last = self.now_ns
        if not self._begun:
            frames, last = self._begin_with(frames)
        for t, key, data in frames:
            if t >= timers.next_ns or t < last:
                if t < last:
                    self.counters["time stamps that ran backwards"] += 1
                    t = last
                self._pass_time(t)
            last = t
            try:
                page = table[key]
            except KeyError:
                page = board.bind(key)
            if page is None:
                continue
            page.t_ns = t
            if page.seen != data:
                if page.seen is None:
                    page.heard()
                page.data = data
                page.seen = ALWAYS if page.always else data
                handle = page.handle  # by a local name: CPython finds what a slot holds slowly in a method call
                handle(t, data)
                if queued:
                    settle(t)
        self.now_ns = last
        return self._take()

    def tick(self, now_ns: int) -> Sequence[Output]:
        """Time has passed without a frame."""
        self._advance(now_ns)
        return self._take()

    def command(self, order: Order, now_ns: int) -> Sequence[Output]:
        """An order from level 2 or from the machine. Always answered by a `Result`."""
        self._advance(now_ns)
        late = order.expires_ns is not None and now_ns > order.expires_ns
        reason = "expired before supervision could obey it" if late else self._obey(order)
        self.board.settle(self.now_ns)
        self._out.append(Result(order.id, "refused" if reason else "done", reason))
        return self._take()

    def publish(self, t_ns: int, name: str, raws: Mapping[str, int], broadcast: bool = True) -> Sequence[Output]:
        """What the UCS says of itself (its computer, its GNSS receiver): on the board as if received, and on the message's buses.

        name: one of `readings`. Raises KeyError, ValueError as `decode.encode`.
        """
        self._advance(max(t_ns, self.now_ns))
        payload = encode(self.catalog.messages[name], raws)
        try:
            if not broadcast:
                raise Refused(f"{name} is not to be sent")
            self.send(self.now_ns, name, payload, "reading")
        except Refused:
            self.counters["readings not sent"] += broadcast
            if name in self.board.pages:
                self.board.pages[name].receive(self.now_ns, payload)
        self.board.settle(self.now_ns)
        return self._take()

    def ask(self, bus: int, can_id: int, data: bytes, now_ns: int) -> Sequence[Output]:
        """Send a request by which a device's error history is read (`io.canopen`), if the gate lets it pass; 11-bit identifier."""
        self._advance(now_ns)
        self.hand_out(Send(self.now_ns, frame_key(can_id, False, bus), data, SDO, "error history", self.now_ns + REQUEST_NS))
        return self._take()

    def next_deadline(self) -> int | None:
        """When the next `tick` is wanted at the latest, ns; None: never, before a frame comes."""
        if not self._begun:
            return self.now_ns if self.now_ns > -FAR else None
        return self.timers.next_ns if self.timers.next_ns < FAR else None

    def state(self) -> State:
        """What to store for the next start."""
        return State(self.mode, tuple(self._memory(alarm) for alarm in self._machines()
                                      if alarm.state != NORMAL or self._raised.get(alarm.definition.name) or self._begun_of(alarm)))

    def alarm_states(self) -> dict[str, int]:
        """Present state of every alarm: 0 Normal, 1 Active, 2 Repairing, 3 LockedOut."""
        return {name: self.bus_state(name) for name in self._alarms}

    def bus_state(self, name: str) -> int:
        """State of an alarm as the bus shows it: the worst of its reported causes."""
        reported = self._reported[name]
        return max(machine.state for machine in reported.values()) if reported else self._alarms[name].state

    def report(self, t_ns: int, alarm: str, key: str, present: bool, detail: dict[str, Any], text: str) -> None:
        """A subsystem reports that one cause of an alarm is there, or no more (trouble codes, emergencies, lost heartbeats).

        key: names the cause among all of this alarm; detail: what events carry as values. Delays and latches are those of
        the alarm's definition. Nothing happens when no definition of that name is loaded.
        """
        if alarm not in self._alarms:
            return
        machines = self._reported[alarm]
        machine = machines.get(key)
        if machine is None:
            if not present:
                return
            if len(machines) >= MAX_INSTANCES:
                self.counters[f"causes of {alarm} beyond the limit"] += 1
                return
            machine = machines[key] = self._instance(alarm, key, detail, text)
        if present:
            machine.detail = detail
        zone = Zone.RAISE if present else Zone.CLEAR
        if machine.zone != zone:
            machine.zone_changed(t_ns, zone)
        if machine.state == NORMAL and not present:
            machines.pop(key, None)

    def active(self) -> Iterator[tuple[AlarmMachine, RepairMachine | None]]:
        """Every alarm, and every reported cause of one, that is not normal, with its repair where it has one; to be looked at."""
        for machine in self._machines():
            if machine.state != NORMAL:
                yield machine, None if machine.key else self._repairs.get(machine.definition.name)

    def causes(self, alarm: str) -> dict[str, dict[str, Any]]:
        """The causes of an alarm that are reported as being there, by key, with their details."""
        return {key: machine.detail for key, machine in self._reported.get(alarm, {}).items()}

    def _instance(self, alarm: str, key: str, detail: dict[str, Any], text: str) -> AlarmMachine:
        machine = AlarmMachine(self.catalog.alarms[alarm], self, self.timers)
        machine.key, machine.detail, machine.text = key, detail, text
        return machine

    def _machines(self) -> Iterator[AlarmMachine]:
        for name, machine in self._alarms.items():
            yield machine
            yield from list(self._reported[name].values())

    # --- for `sieve`, which feeds blocks of frames ------------------------------------------------------------------------

    @property
    def watches(self) -> Sequence[Watch]:
        """All conditions in use, in the order of their evaluation."""
        return self._watches

    def sendable(self) -> set[str]:
        """Messages that this supervisor may send itself."""
        return self._commanded() | {alarm.message for alarm in self.catalog.alarms.values()}

    def begin(self, t_ns: int) -> None:
        """Let the time line begin, unless it has."""
        if not self._begun:
            self._begin(t_ns)

    def take(self, now_ns: int) -> list[Output]:
        """The outputs so far; frames up to now have been received."""
        self.now_ns = now_ns
        return self._take()

    # --- time -------------------------------------------------------------------------------------------------------------

    def _begin_with(self, frames: Iterable[tuple[int, int, bytes]]) -> tuple[Iterable[tuple[int, int, bytes]], int]:
        rest = iter(frames)
        first = next(rest, None)
        if first is None:
            return (), self.now_ns
        self._begin(first[0])
        return chain((first,), rest), self.now_ns

    def _advance(self, now_ns: int) -> None:
        if not self._begun:
            self._begin(now_ns)
        if now_ns < self.now_ns:
            self.counters["time stamps that ran backwards"] += 1
            return
        self._pass_time(now_ns)
        self.now_ns = now_ns

    def _pass_time(self, now_ns: int) -> None:
        """Everything due up to now, each at its own time."""
        queued = self.board.queued
        while (item := self.timers.pop(now_ns)) is not None:
            due = self.timers.popped_ns
            item.expire(due)
            if queued:
                self.board.settle(due)

    def _begin(self, t_ns: int) -> None:
        """The first input: the time line begins, and conditions that hold without any frame are told."""
        self._begun = True
        if self.now_ns == -FAR:
            self.now_ns = t_ns
        start = self.now_ns
        if self._restored is not None:
            self._restore(self._restored, start)
        everything = Cell("everything", 0)
        everything.watches = self._watches
        self.board.queue(everything)
        self.board.settle(start)
        self.subsystems.start(start)
        if self._devices is not None:
            self._devices.start(start)
        if self._receiver is not None:
            self._receiver.start(start)
        cyclic: list[Timed] = [*self._broadcasts.values(), *self._samplers]
        for timed in cyclic:
            self.timers.set(timed, start)
        if cyclic:
            self._pass_time(start)

    def _take(self) -> list[Output]:
        if not self._out:
            return []
        out, self._out = self._out, []
        return out

    # --- building ---------------------------------------------------------------------------------------------------------

    def _compile(self, addresses: Mapping[int, int]) -> None:
        board, things = self.board, self._things
        thresholds = Thresholds(board, things)
        for expression in self._expressions():
            thresholds.add(expression)
        self._use_for_repairs_and_monitoring()
        board.set_classes(thresholds.constants)
        board.set_limits()
        compiler = Compiler(board, things)
        for name, machine in self._alarms.items():
            alarm = machine.definition
            evaluate, cells = compiler.zone(alarm.when, alarm.until, alarm.enabled)
            self._watch(evaluate, cells, machine.zone_changed, UNTOLD)
            self._inputs[name] = freeze_frame(alarm, board, things, self._alarms)
            if alarm.repair is not None:
                self._compile_repair(machine, alarm.repair, compiler)
        for (name, window_ns), cell in things.counts.items():
            self._raised.setdefault(name, deque())
            self._counts.append(_Window(self, name, window_ns, cell))
        self.subsystems = Subsystems(self, board, things, self.timers, self.counters, unit=self.unit, addresses=addresses,
                                     wanted=TROUBLE_CODE in self._alarms or bool(things.codes))
        if self._devices is not None:
            for can_id, listener in self._devices.listeners().items():
                board.listen_to(can_id, listener)
        if self._receiver is not None:
            for pgn, listener in self._receiver.listeners().items():
                board.listen(pgn, listener)
        board.compile()

    def _expressions(self) -> Iterable[Expression]:
        for alarm in self.catalog.alarms.values():
            yield from (part for part in (alarm.when, alarm.until, alarm.enabled) if part is not None)
            if alarm.repair is not None:
                yield from (step.condition for step in alarm.repair.steps if isinstance(step, ExpectStep))

    def _use_for_repairs_and_monitoring(self) -> None:
        for alarm in self.catalog.alarms.values():
            for expression in chain(walk(alarm.when), walk(alarm.enabled)):
                if isinstance(expression, (SignalValue, Quality)) and expression.signal:
                    self.board.cell(expression.message, expression.signal)
        for message in self.catalog.messages.values():
            if message.monitor_as:
                for signal in message.signals:
                    self.board.cell(message.name, signal.name)
        for name in self._commanded():
            self.board.page(name)

    def _commanded(self) -> set[str]:
        """Messages that repairs and commands send."""
        names = {command.message for command in self.catalog.commands.values()}
        for alarm in self.catalog.alarms.values():
            if alarm.repair is not None:
                names.update(step.message for step in (*alarm.repair.steps, *alarm.repair.give_up)
                             if isinstance(step, (SendStep, ResendStep)))
        return names

    def _watch(self, evaluate: Callable[[], int], cells: Iterable[Cell], sink: Callable[[int, int], None], outcome: int) -> None:
        watch = Watch(len(self._watches), evaluate, sink, outcome)
        self._watches.append(watch)
        for cell in cells:
            cell.watches.append(watch)

    def _compile_repair(self, machine: AlarmMachine, repair: Repair, compiler: Compiler) -> None:
        compiled = {position: compiler.verdict(step.condition) for position, step in enumerate(repair.steps)
                    if isinstance(step, ExpectStep)}
        expects = {position: evaluate for position, (evaluate, _) in compiled.items()}
        verdicts = tuple(expects.values())

        def feedback() -> int:
            """The worst unknown among the expectations, 0 when all are known."""
            return max((verdict for verdict in (ask() for ask in verdicts) if verdict > Verdict.TRUE), default=0)

        episode = RepairMachine(machine, repair, self, self.holds, self.timers, expects, feedback)
        self._repairs[machine.definition.name] = machine.episode = episode
        self._watch(feedback, dict.fromkeys(cell for _, cells in compiled.values() for cell in cells), episode.feedback_changed, 0)
        for position, (evaluate, cells) in compiled.items():
            self._watch(evaluate, cells, _expectation(episode, position), Verdict.FALSE)

    def _make_broadcasts(self) -> dict[str, _Broadcast]:
        names = dict.fromkeys(alarm.message for alarm in self.catalog.alarms.values())
        return {name: _Broadcast(self, self.catalog.messages[name]) for name in names
                if self.catalog.messages[name].sent_by_ucs}

    def _make_samplers(self, period_ns: int) -> list[_Sampler]:
        parts: dict[str, list[Message]] = {}
        for message in self.catalog.messages.values():
            if message.monitor_as:
                parts.setdefault(message.monitor_as, []).append(message)
        return [_Sampler(self, name, messages, period_ns) for name, messages in parts.items()]

    # --- what alarms and repairs ask for (alarm.Host, repair.Host) ----------------------------------------------------------

    def emit(self, alarm: AlarmMachine, t_ns: int, event: str, text: str = "", attempt: int = 0,
             frames: tuple[SentFrame, ...] = (), passive: bool = False) -> int:
        """Report a step upward, always."""
        self.seq += 1
        definition = alarm.definition
        values = alarm.detail if alarm.key else {name: read(t_ns) for name, read in self._inputs[definition.name]}
        self._out.append(Event(
            self.unit, self.boot, self.seq, seconds(t_ns), self.utc(t_ns), self.utc_trusted, definition.name, definition.code,
            definition.priority, event, self.seq if event == "raised" else alarm.instance, attempt, values, text, frames, passive))
        return self.seq

    def hand_out(self, send: Send) -> None:
        """Hand a frame of a protocol, which no definition names, out through the gate."""
        try:
            self.gate.check_protocol(send)
        except Refused:
            self.counters["frames refused by the gate"] += 1
        else:
            self._out.append(send)

    def _hear(self, reading: Reading) -> None:
        """What a receiver on a bus says, as if the UCS had said it: on the board, and on no bus again."""
        page = self.board.pages.get(reading.message)
        if page is not None:
            page.receive(reading.t_ns, encode(page.message, raws(page.message, reading.values)))

    def tell(self, t_ns: int, message: str, values: dict[str, Any]) -> None:
        """A monitoring message of what a subsystem has been asked for."""
        self._out.append(Monitor(self.unit, self.boot, seconds(t_ns), self.utc(t_ns), self.utc_trusted, message, values,
                                 dict.fromkeys(values, 0.0), dict.fromkeys(values, QUALITY_WORDS[GOOD])))

    def utc(self, t_ns: int) -> str | None:
        """RFC 3339 label of a time, None where no wall clock is known."""
        if self.utc_offset_ns is None:
            return None
        moment = _EPOCH + timedelta(microseconds=(t_ns + self.utc_offset_ns) // 1000)
        return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")

    def moved(self, alarm: AlarmMachine, t_ns: int) -> None:
        """The state of an alarm has changed: conditions that ask for it, and everyone on the bus, must know."""
        if alarm.key and alarm.state == NORMAL:
            self._reported[alarm.definition.name].pop(alarm.key, None)
        cell = self._things.alarms.get(alarm.definition.name)
        if cell is not None:
            cell.k = self.bus_state(alarm.definition.name)
            self.board.queue(cell)
        if self.subsystems.speaks:
            self.subsystems.report(t_ns, *self._own_codes())
        broadcast = self._broadcasts.get(alarm.definition.message)
        if broadcast is not None:
            broadcast.expire(t_ns)

    def _own_codes(self) -> tuple[list[tuple[int, int, int]], int]:
        """The active alarms that have a trouble code, and the lamps: red for Critical, amber for other faults (J1939-73)."""
        active = [alarm for alarm in self.catalog.alarms.values() if alarm.spn is not None and self.bus_state(alarm.name) != NORMAL]
        codes = [(alarm.spn or 0, 31 if alarm.fmi is None else alarm.fmi, self._activations[alarm.name]) for alarm in active]
        red = any(alarm.priority == PRIORITIES[-1] for alarm in active)
        return codes, (0x10 if red else 0) | (0x04 if any(alarm.is_fault for alarm in active) else 0)

    def counted(self, alarm: AlarmMachine, t_ns: int) -> None:
        """An activation more."""
        name = alarm.definition.name
        self._activations[name] += 1
        if name in self._raised:
            self._raised[name].append(t_ns)
        for window in self._counts:
            if window.alarm == alarm.definition.name:
                window.expire(t_ns)

    def is_armed(self, alarm: AlarmMachine) -> bool:
        """Whether the configuration lets its repair act."""
        return self.armed is None or alarm.definition.name in self.armed or alarm.definition.signal in self.armed

    def forbidden(self, repair: Repair) -> str:
        """Nothing moves while the unit is stopped or paused from above."""
        return f"the unit is {self.mode}" if repair.moves and self.mode != "running" else ""

    # --- sending ----------------------------------------------------------------------------------------------------------

    def send(self, t_ns: int, name: str, payload: bytes, reason: str, safe: bool = False) -> None:
        """Hand a frame out through the gate; the board then knows it as the last one commanded. safe: it leads into a safe state.
        Raises Refused."""
        expires_ns = self.gate.check(t_ns, name, payload, safe=safe)
        message = self.catalog.messages[name]
        for bus in self.catalog.buses.get(name, (0,)):
            key = frame_key(message.can_id, message.extended, bus)
            self._out.append(Send(t_ns, key, payload, name, reason, expires_ns))
            if self._devices is not None and message.can_id == NMT and not message.extended:
                self._devices.command(t_ns, key, payload)
        page = self.board.pages.get(name)
        if page is not None:
            page.receive(t_ns, payload)

    def _fits(self, name: str, payload: bytes) -> bool:
        return not self.gate.outside(name, payload)

    # --- commands ---------------------------------------------------------------------------------------------------------

    def _obey(self, order: Order) -> str:
        """Carry an order out; gives the reason of a refusal."""
        if order.name in ("acknowledge", "reset"):
            return self._people(order)
        if order.name == REQUEST_STORED:
            return self.subsystems.request_stored(self.now_ns, order.target)
        commands = [command for name, command in self.catalog.commands.items() if order.name in (name, name.partition("@")[0])]
        if order.name not in ("pause", "resume", "stop") and not commands:
            return f"unknown command {order.name}"
        if order.name == "resume" and self.mode == "stopped" and order.origin == "above":
            return "the unit was stopped: it is started again at the machine"
        if order.name == "stop":
            self._change_mode("stopped")  # whatever becomes of its frames: nothing moves any more by our doing
        refusals = [refusal for command in commands if (refusal := self._carry_out(command, order))]
        if refusals:
            return "; ".join(dict.fromkeys(refusals))
        if order.name == "resume":
            self._change_mode("running")
        elif order.name == "pause" and self.mode == "running":
            self._change_mode("paused")
        return ""

    def _carry_out(self, command: Command, order: Order) -> str:
        """Send a command's message; gives the reason of a refusal."""
        try:
            self.send(self.now_ns, command.message, self._command_payload(command, order), f"{COMMAND} {order.name}")
        except (Refused, ValueError, OverflowError) as refusal:  # an infinite value
            return str(refusal)
        return ""

    def _change_mode(self, mode: str) -> None:
        if mode != self.mode:
            self.mode = mode
            self._circumstances_changed(self.now_ns)

    def _people(self, order: Order) -> str:
        who = order.origin
        if order.name == "acknowledge" and not order.target:
            for alarm in self._machines():
                if alarm.state != NORMAL and not (who == "above" and alarm.definition.local_latch):
                    alarm.acknowledge(self.now_ns, who)
            return ""
        machine = self._alarms.get(order.target)
        if machine is None:
            return f"unknown alarm {order.target}"
        if order.name == "acknowledge":
            if who == "above" and machine.definition.local_latch:
                return f"{order.target} can only be acknowledged at the machine"
            causes = list(self._reported[order.target].values())
            return " ".join(dict.fromkeys(cause.acknowledge(self.now_ns, who) for cause in causes or [machine])).strip()
        repair = machine.definition.repair
        if order.origin == "above" and (repair is None or repair.local_reset):
            return f"{order.target} can only be reset at the machine"
        if order.target == DEVICE_SILENT and self._devices is not None:
            return self._devices.taken_off(self.now_ns)
        return machine.reset(self.now_ns, who)

    def _command_payload(self, command: Command, order: Order) -> bytes:
        message = self.catalog.messages[command.message]
        owner = self.holds.owner(command.message)
        if owner is not None:
            raise Refused(f"{command.message} belongs to the repair of {owner.name} now")
        raws: dict[str, int] = {}
        for name, raw in command.values.items():
            if raw is not None:
                raws[name] = raw
                continue
            if order.value is None:
                raise Refused(f"{order.name} needs a value")
            signal = message.signal(name)
            exact = (Fraction(order.value) - Fraction(signal.offset)) / Fraction(signal.factor)
            raws[name] = round(exact)
            low, high = raw_range(signal)
            if not low <= raws[name] <= high:
                least, most = sorted(float(Fraction(signal.factor) * raw + Fraction(signal.offset)) for raw in (low, high))
                raise Refused(f"{order.value} is outside {least:g} … {most:g}, what {name} can say")
        return encode(message, raws, self.holds.last_command(command.message))

    def _circumstances_changed(self, t_ns: int) -> None:
        ranked = sorted(self._repairs.values(), key=lambda repair: -repair.rank)
        for repair in ranked:
            repair.circumstances_changed(t_ns)

    # --- restart ----------------------------------------------------------------------------------------------------------

    def _begun_of(self, alarm: AlarmMachine) -> list[int]:
        repair = self._repairs.get(alarm.definition.name)
        return repair.begun_ns if repair is not None else []

    def _memory(self, alarm: AlarmMachine) -> AlarmMemory:
        name = alarm.definition.name
        repair = self._repairs.get(name)
        now = self.now_ns
        return AlarmMemory(name, alarm.state, alarm.instance, alarm.acknowledged, repair.attempt if repair is not None else 0,
                           tuple(now - begun for begun in self._begun_of(alarm)),
                           tuple(now - raised for raised in self._raised.get(name, ())) if not alarm.key else (),
                           alarm.key, alarm.detail, alarm.text if alarm.key else "")

    def _restore(self, state: State, now_ns: int) -> None:
        for memory in state.alarms:
            machine = self._alarms.get(memory.name)
            if machine is None:
                self.counters["remembered alarms that are defined no more"] += 1
                continue
            if memory.key:
                machine = self._instance(memory.name, memory.key, memory.detail, memory.text)
                self._reported[memory.name][memory.key] = machine
            if memory.name in self._raised:
                self._raised[memory.name].extend(now_ns - ago for ago in memory.raised_ago_ns)
            machine.state = memory.state
            machine.zone = Zone.STALE
            machine.instance = memory.instance
            machine.acknowledged = memory.acknowledged
            repair = self._repairs.get(memory.name)
            if repair is not None:
                repair.restore(now_ns, memory.attempt, [now_ns - ago for ago in memory.begun_ago_ns])
            elif machine.state in (REPAIRING, LOCKED_OUT):
                machine.state = ACTIVE
            self.moved(machine, now_ns)
        for window in self._counts:
            window.expire(now_ns)


class _Window:
    """`count(Alarm, window)`: falls by one exactly when an activation leaves the window."""

    def __init__(self, supervisor: Supervisor, alarm: str, window_ns: int, cell: Cell):
        self.supervisor = supervisor
        self.alarm = alarm
        self.window_ns = window_ns
        self.cell = cell
        self.order = supervisor.timers.order()
        self.due = FAR

    def expire(self, now_ns: int) -> None:
        """An activation has come, or one may have left."""
        supervisor = self.supervisor
        inside = [raised for raised in supervisor._raised[self.alarm] if raised + self.window_ns > now_ns]
        if len(inside) != self.cell.value:
            self.cell.value = len(inside)
            supervisor.board.queue(self.cell)
        longest = max(window.window_ns for window in supervisor._counts if window.alarm == self.alarm)
        raised = supervisor._raised[self.alarm]
        while raised and raised[0] + longest <= now_ns:
            raised.popleft()
        if inside:
            supervisor.timers.set(self, inside[0] + self.window_ns)


class _Broadcast:
    """An alarm message on the bus: at every change and at its cycle time."""

    def __init__(self, supervisor: Supervisor, message: Message):
        self.supervisor = supervisor
        self.message = message
        self.order = supervisor.timers.order()
        self.due = FAR
        self.alarms = [(alarm.name, alarm.signal) for alarm in supervisor.catalog.alarms.values() if alarm.message == message.name]
        self.states: list[int] = []
        self.payload = b""

    def expire(self, now_ns: int) -> None:
        """Send it as it is now."""
        supervisor = self.supervisor
        states = [supervisor.bus_state(name) for name, _ in self.alarms]
        if states != self.states:
            self.states = states
            self.payload = encode(self.message, {signal: state for (_, signal), state in zip(self.alarms, states, strict=True)})
        try:
            supervisor.send(now_ns, self.message.name, self.payload, "alarm states")
        except Refused:
            supervisor.counters["frames refused by the gate"] += 1
        if self.message.cycle_ns:
            supervisor.timers.set(self, now_ns + self.message.cycle_ns)


class _Sampled:
    """A signal in a monitoring message. data, value: the payload that was looked at last, and what it said."""

    __slots__ = ("cell", "data", "name", "page", "read", "value")

    def __init__(self, name: str, cell: Cell):
        self.name = name
        self.cell = cell
        self.page = cell.page
        self.read = reader(cell.signal)
        self.data: bytes | None = None
        self.value: Any = None

    def look(self, data: bytes) -> Any:
        """The value in a payload."""
        raw = self.read(data)
        self.data = data
        self.value = physical(self.cell, raw) if raw is not None else None
        return self.value


class _Sampler:
    """A monitoring message, sampled at a fixed rate without drift. Several messages may form one (`MonitorAs`); a signal name
    that two of them have carries its message there."""

    def __init__(self, supervisor: Supervisor, name: str, messages: Sequence[Message], period_ns: int):
        self.supervisor = supervisor
        self.name = name
        self.period_ns = period_ns
        self.order = supervisor.timers.order()
        self.due = FAR
        counts = Counter(signal.name for message in messages for signal in message.signals)
        self.parts = [_Sampled(signal.name if counts[signal.name] == 1 else f"{message.name}.{signal.name}",
                               supervisor.board.cell(message.name, signal.name))
                      for message in messages for signal in message.signals]

    def expire(self, now_ns: int) -> None:
        """Take a sample of all values, each with its age and quality."""
        supervisor = self.supervisor
        refresh = supervisor.board.refresh
        page: Page | None = None
        age_s: float | None = None
        values: dict[str, Any] = {}
        ages: dict[str, float | None] = {}
        quality: dict[str, str] = {}
        for part in self.parts:
            name, cell = part.name, part.cell
            if page is not part.page:
                page = part.page
                refresh(page)
                age_s = None if page.level < 0 else (now_ns - page.t_ns) / 1e9
            grade = NEVER if page.level < 0 else cell.k - cell.base if cell.k >= cell.base else cell.classes.quality[cell.k]
            values[name] = None if grade != GOOD else part.value if page.data is part.data else part.look(page.data)
            ages[name] = age_s
            quality[name] = QUALITY_WORDS[grade]
        supervisor._out.append(Monitor(supervisor.unit, supervisor.boot, seconds(now_ns), supervisor.utc(now_ns),
                                       supervisor.utc_trusted, self.name, values, ages, quality))
        supervisor.timers.set(self, now_ns + self.period_ns)


def _expectation(episode: RepairMachine, position: int) -> Callable[[int, int], None]:
    def sink(t_ns: int, verdict: int) -> None:
        episode.expectation_changed(t_ns, position, verdict)
    return sink


