"""The reference receiver: takes in what the units of a fleet send, stores it, and only then acknowledges (DESIGN §6).

One thread does everything, as in the bridge. Events are committed in batches, as many as have come; then each sender gets
one acknowledgement. A gap that stays is asked for; a unit whose monitoring messages stop is told at once, without waiting
for the broker's last will.
"""
from __future__ import annotations

import secrets
import select
import threading
from collections import Counter
from collections.abc import Callable, Iterable

import msgspec

from bridge import wire
from bridge.clock import Clock
from bridge.error import OutsideError
from bridge.mqtt import Address, MqttConnection, MqttError, Received, Tls, Waker
from bridge.ranges import Range
from level2.store import Arrival, Outcome, Sender, Store, StoreError

SILENT_NS = 1_500_000_000
"""A unit not heard from for so long is told silent: six monitoring messages at 4 Hz (SPEC §3), within 2 s with the check."""
PERIODS = 2
"""Periods more that a unit may take which was asked to send less often than at 4 Hz."""
CHECK_NS = 250_000_000
ASK_NS = 5_000_000_000
"""How long a gap may stay before it is asked for, and between askings."""
ASK_LONGEST_NS = 600_000_000_000
RECONNECT_S = 1.0
MONITORS = 100
"""Monitoring messages of a unit that are remembered."""
SAID = 1000
"""Kinds of trouble told; a hostile sender must not fill the memory."""
EVERY_FLEET = "+"


class Settings(msgspec.Struct, frozen=True):
    """Which broker, which fleet (`EVERY_FLEET`: all of them)."""

    broker: Address
    fleet: str = EVERY_FLEET
    tls: Tls = Tls()
    silent_ns: int = SILENT_NS
    ask_ns: int = ASK_NS


class Receiver:
    """Receives until stopped. counters: arrivals by outcome, refused messages, monitoring messages.

    store: used by the thread of `run` alone. told: called with every arrival once it is on the disk and acknowledged.
    say: called with a line about what happens to units and connection.
    """

    def __init__(self, settings: Settings, store: Store, *, told: Callable[[Arrival], None], say: Callable[[str], None],
                 clock: Clock | None = None):
        if settings.fleet != EVERY_FLEET:
            try:
                wire.check_name(settings.fleet, "fleet")
            except wire.WireError as error:
                raise OutsideError(str(error)) from None
        self.settings, self.store = settings, store
        self.counters: Counter[str] = Counter()
        self.latest: dict[tuple[str, str], dict[str, wire.MonitorMessage]] = {}
        self._told, self._say = told, say
        self._clock = clock or Clock()
        self._waker = Waker()
        self._stopping = False
        self._connection: MqttConnection | None = None
        self._said: set[str] = set()
        self._heard_ns: dict[tuple[str, str], int] = {}
        self._patience_ns: dict[tuple[str, str], int] = {}
        self._silent: set[tuple[str, str]] = set()
        self._gaps = {sender: _Gap(self._clock.now_ns() + settings.ask_ns) for sender in store.gaps()}
        self._check_ns = 0
        self._turned_ns = self._clock.now_ns()

    def run(self) -> None:
        """Receive until `stop`."""
        try:
            while not self._stopping:
                if self._connection is None:
                    self._connect()
                else:
                    self._turn(self._connection)
        finally:
            if self._connection:
                self._connection.close()
            self._waker.close()

    def stop(self) -> None:
        """End `run` soon. Safe from any thread and from signal handlers."""
        self._stopping = True
        self._waker.wake()

    @property
    def online(self) -> bool:
        """Whether the broker has accepted us and our subscriptions."""
        connection = self._connection
        return connection is not None and connection.ready and not connection.lost

    def _connect(self) -> None:
        subscribe = [(_filter(self.settings.fleet, kind), 0 if kind == "monitor" else 1) for kind in wire.UP]
        try:
            self._connection = MqttConnection(self.settings.broker, f"ucs-level2-{secrets.token_hex(4)}", subscribe=subscribe,
                                              tls=self.settings.tls)
        except MqttError as error:
            self._say_once("broker", f"{error} (trying on)")
            self._pause()

    def _pause(self) -> None:
        if not self._stopping:
            select.select([self._waker.fileno()], [], [], RECONNECT_S)

    def _turn(self, connection: MqttConnection) -> None:
        ready = connection.wait(max(0, self._check_ns - self._clock.now_ns()) / 1e9, [self._waker.fileno()])
        if ready:
            self._waker.clear()
        if connection.ready and "broker" in self._said:
            self._said.discard("broker")
            self._say(f"connected to {connection.address}")
        self._take_in(connection, connection.take())
        now_ns = self._clock.now_ns()
        self._excuse(now_ns - self._turned_ns)
        self._turned_ns = now_ns
        if now_ns >= self._check_ns:
            self._check_ns = now_ns + CHECK_NS
            self._tell_silent(now_ns)
            self._ask(connection, now_ns)
        if connection.lost:
            self._say_once("broker", f"broker {connection.address}: {connection.lost} (trying on)")
            connection.abandon()
            self._connection = None
            self._heard_ns.clear()
            self._pause()

    # What units send

    def _take_in(self, connection: MqttConnection, messages: Iterable[Received]) -> None:
        now_ns = self._clock.now_ns()
        alarms: list[tuple[str, wire.Alarm]] = []
        for message in messages:
            try:
                topic = wire.parse_topic(message.topic)
                content = wire.decode(message.payload, wire.KINDS[topic.kind])
                if getattr(content, "unit", topic.unit) != topic.unit:
                    raise wire.WireError(f'says it is from "{getattr(content, "unit", "")}"')
            except wire.WireError as error:
                self.counters["refused"] += 1
                self._say_once(f"refused {message.topic[:200]}", f"{message.topic[:200]}: refused: {error} (told once)")
                continue
            if isinstance(content, wire.Alarm):
                alarms.append((topic.fleet, content))
            elif isinstance(content, wire.MonitorMessage):
                self._hear(topic, content, now_ns)
            elif isinstance(content, wire.Connection):
                self._tell_connection(connection, topic, content, message.retained)
        if alarms:
            self._commit(connection, alarms)

    def _commit(self, connection: MqttConnection, alarms: list[tuple[str, wire.Alarm]]) -> None:
        try:
            arrivals = self.store.add(alarms, self._clock.utc())
        except StoreError as error:
            self._say_once("store", str(error))
            return
        self._said.discard("store")
        fresh: dict[Sender, list[int]] = {}
        for arrival in arrivals:
            fresh.setdefault(Sender(arrival.fleet, arrival.alarm.unit, arrival.alarm.boot), []).append(arrival.alarm.seq)
        for sender, seqs in fresh.items():
            self._acknowledge(connection, sender, seqs)
            self._watch_gap(sender, self._clock.now_ns())
        for arrival in arrivals:
            self._account(arrival)

    def _account(self, arrival: Arrival) -> None:
        alarm = arrival.alarm
        self.counters[arrival.outcome.value] += 1
        for first, last in arrival.lost:
            self._say(f"{alarm.unit} has lost its events {first} to {last} of boot {alarm.boot}")
        if arrival.outcome is Outcome.CONFLICT:
            self._say(f"{alarm.unit} gave the identity boot {alarm.boot} seq {alarm.seq} to two events: both are kept")
        if arrival.outcome is not Outcome.DUPLICATE:
            self._told(arrival)

    def _acknowledge(self, connection: MqttConnection, sender: Sender, seqs: Iterable[int], missing: Iterable[Range] = ()) -> None:
        """Everything up to the first gap; above it what has just come, then the rest as far as it fits."""
        known = self.store.known(sender)
        upto = known.upto
        new = [known.around(seq) for seq in seqs if seq > upto]
        also = list(dict.fromkeys([*new, *known.common(upto + 1, known.last)]))[:wire.RANGES]
        ack = wire.Ack(unit=sender.unit, boot=sender.boot, seq=upto, also=tuple(also), missing=tuple(missing)[:wire.RANGES],
                       t=self._clock.t(), utc=self._clock.utc(), utc_trusted=self._clock.trusted())
        connection.publish(wire.topic(sender.fleet, sender.unit, "ack"), wire.encode(ack), qos=1)

    # Gaps

    def _watch_gap(self, sender: Sender, now_ns: int) -> None:
        known = self.store.known(sender)
        if known.upto < known.last:
            self._gaps.setdefault(sender, _Gap(now_ns + self.settings.ask_ns))
        elif (gap := self._gaps.pop(sender, None)) and gap.asked:
            self._say(f"{sender.unit}: the gap in its events of boot {sender.boot} is closed")

    def _ask(self, connection: MqttConnection, now_ns: int) -> None:
        for sender, gap in self._gaps.items():
            if now_ns < gap.due_ns or not connection.ready:
                continue
            known = self.store.known(sender)
            missing = list(known.missing(1, known.last))
            if not gap.asked:
                text = ", ".join(f"{first} to {last}" if first < last else str(first) for first, last in missing[:5])
                more = " …" * (len(missing) > 5)
                self._say(f"{sender.unit}: of boot {sender.boot} the events {text}{more} are missing, asked for")
            gap.due_ns = now_ns + min(self.settings.ask_ns << gap.asked, ASK_LONGEST_NS)
            gap.asked += 1
            self._acknowledge(connection, sender, (), missing)

    # Silence

    def _hear(self, topic: wire.Topic, sample: wire.MonitorMessage, now_ns: int) -> None:
        unit = (topic.fleet, topic.unit)
        self.counters["monitor"] += 1
        latest = self.latest.setdefault(unit, {})
        if sample.message in latest or len(latest) < MONITORS:
            latest[sample.message] = sample
        self._heard_ns[unit] = now_ns
        self._patience_ns[unit] = self.settings.silent_ns + (int((sample.period_s - wire.PERIOD_S) * PERIODS * 1e9)
                                                             if sample.period_s > wire.PERIOD_S else 0)
        if unit in self._silent:
            self._silent.discard(unit)
            self._say(f"{topic.unit} is heard again")

    def _excuse(self, turn_ns: int) -> None:
        """What a slow disk or a busy computer cost us, nobody was silent: their messages wait."""
        if turn_ns > 2 * CHECK_NS:
            self._heard_ns = {unit: heard_ns + turn_ns for unit, heard_ns in self._heard_ns.items()}

    def _tell_silent(self, now_ns: int) -> None:
        for unit in [unit for unit, heard_ns in self._heard_ns.items() if now_ns - heard_ns > self._patience_ns[unit]]:
            del self._heard_ns[unit]
            self._silent.add(unit)
            self._say(f"{unit[1]} is silent: no monitoring message for {self._patience_ns[unit] / 1e9:g} s")

    def _tell_connection(self, connection: MqttConnection, topic: wire.Topic, state: wire.Connection, retained: bool) -> None:
        waiting = f", {state.waiting} events to come" if state.waiting else ""
        alone = "" if state.supervising or state.state != "ONLINE" else ", its supervision is not running"
        self._say(f"{topic.unit} is {state.state}{' (as last known)' * retained}{alone}{waiting}")
        if state.state != "ONLINE":
            self._heard_ns.pop((topic.fleet, topic.unit), None)
        else:
            # we are here: a unit whose events went unanswered sends them less and less often
            self._acknowledge(connection, Sender(topic.fleet, topic.unit, state.boot), ())

    def _say_once(self, what: str, text: str) -> None:
        if what not in self._said and len(self._said) < SAID:
            self._said.add(what)
            self._say(text)


class _Gap:
    """Something missing below something that is here. asked: how often it was asked for; due_ns: when next."""

    __slots__ = ("asked", "due_ns")

    def __init__(self, due_ns: int):
        self.asked = 0
        self.due_ns = due_ns


class ReceiverThread:
    """A receiver in a thread of its own, for `ucs demo`; a context manager that stops it on leaving.

    What ends the thread early is not lost: leaving raises it.
    """

    def __init__(self, receiver: Receiver):
        self.receiver = receiver
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="receiver", daemon=True)
        self._thread.start()

    def __enter__(self) -> Receiver:
        return self.receiver

    def __exit__(self, *_: object) -> None:
        self.receiver.stop()
        self._thread.join()
        if self._failure:
            raise self._failure

    def _run(self) -> None:
        try:
            self.receiver.run()
        except BaseException as error:
            self._failure = error


def event_line(arrival: Arrival) -> str:
    """One readable line: time, unit, alarm, event, text; how it came where that matters."""
    alarm = arrival.alarm
    time = alarm.utc or f"{alarm.t:.3f} s"
    attempt = f" {alarm.attempt}" if alarm.attempt else ""
    notes = [note for note, true in (("passive", alarm.passive), ("late", alarm.historical),
                                     ("conflict", arrival.outcome is Outcome.CONFLICT)) if true]
    note_text = ", ".join(notes)
    text = f"  {alarm.text}" if alarm.text else ""
    return wire.shown(f"{time} {alarm.unit} {alarm.alarm} {alarm.event}{attempt}{text}{f' ({note_text})' if notes else ''}")


def _filter(fleet: str, kind: str) -> str:
    levels = [*wire.PREFIX, fleet, "+", kind]
    return "/".join([*levels, "+"] if kind == "monitor" else levels)
