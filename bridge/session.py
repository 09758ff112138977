"""The bridge: carries the events and monitoring messages of one unit to level 2, and acknowledgements and commands back.

One thread does everything, so nothing dies unseen: it waits for the network, for `ucs run` (`BridgeLink`) and for the next
due time, then sends what the `Outbox` says. It may be killed at any moment: what is not acknowledged is in the journal.
"""
from __future__ import annotations

import hashlib
import random
import re
import select
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Literal

import msgspec

from bridge import wire
from bridge.clock import Clock
from bridge.delivered import Delivered, delivered_path
from bridge.gate import Decision, Gate, Passed, Refused, commands_path
from bridge.keys import KeyRing
from bridge.link import Answer, Beside, BridgeLink, Samples
from bridge.mqtt import Address, MqttConnection, MqttError, Received, Tls, Waker
from bridge.outbox import BACKLOG_PER_S, RETRY_NS, WINDOW, Outbox, Verdict
from level1.event import Monitor
from level1.io.error import OutsideError
from level1.io.journal import JournalError, Reader

POLL_NS = 50_000_000
"""How often the journal is looked at: an event waits no longer, though nobody poked."""
ALIVE_NS = 2_000_000_000
"""Supervision not heard from for so long is not there."""
CONNECT_NS = 500_000_000
"""Pause before the next attempt to connect; doubled up to `CONNECT_LONGEST_NS`, give or take half."""
CONNECT_LONGEST_NS = 30_000_000_000
MONITOR_PERIOD = "monitor_period"
"""The one command that is the bridge's own: seconds between monitoring messages."""
PERIOD_LONGEST_NS = 3_600_000_000_000
ANSWER_NS = 5_000_000_000
"""Patience with supervision's answer to an order."""
STRANGERS_NS = 200_000_000
"""Pause between answers to senders without a key."""
UNKNOWN = "whether it was obeyed is not known"
REFUSAL_NS = 500_000_000
"""Pause between tellings of refusals to supervision, doubled while they go on up to `REFUSAL_LONGEST_NS`."""
REFUSAL_LONGEST_NS = 60_000_000_000
REFUSALS = 20
"""Kinds of refusals told at a time."""
SAID = 1000
"""Kinds of trouble told; a hostile sender must not fill the memory."""
JOURNAL_NS = 500_000_000
"""How often a missing journal is looked for."""


class Settings(msgspec.Struct, frozen=True):
    """What a bridge serves and where it leads. Names are checked by `wire.check_name`.

    period_ns: of each monitoring message. keys: file of those who may command; without one nobody may. The rest
    is for tests: see `Outbox`.
    """

    journal: Path
    unit: str
    fleet: str
    broker: Address
    tls: Tls = Tls()
    period_ns: int = 250_000_000
    keys: Path | None = None
    window: int = WINDOW
    retry_ns: int = RETRY_NS
    backlog_per_s: float = BACKLOG_PER_S


def client_id(settings: Settings) -> str:
    """The same at every start, so that a new connection ends an old one that nobody closed, whose last will would else come later.
    Another unit can't guess it, where there is a private key, and so can't push this one out. NATS takes no points in it.
    """
    secret = b""
    with suppress(OSError):
        secret = Path(settings.tls.key).read_bytes() if settings.tls.key else b""
    mark = hashlib.sha256(b"\n".join([settings.fleet.encode(), settings.unit.encode(), secret])).hexdigest()[:16]
    return f"ucs-{re.sub('[^A-Za-z0-9-]', '_', settings.unit)}-{mark}"


class Bridge:
    """The bridge of one journal. Raises OutsideError where another bridge serves it.

    say: called with a line about what happens, each kind of trouble once. counters: of what came and what was wrong with it.
    turned: called after every turn of the loop, at least once a minute.
    """

    def __init__(self, settings: Settings, say: Callable[[str], None], clock: Clock | None = None, *,
                 turned: Callable[[], None] = lambda: None):
        try:
            wire.check_name(settings.unit, "unit")
            wire.check_name(settings.fleet, "fleet")
        except wire.WireError as error:
            raise OutsideError(str(error)) from None
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self._say, self._turned = say, turned
        self._clock = clock or Clock()
        self._jitter = random.Random()
        self._said: set[str] = set()
        self._delivered = Delivered(delivered_path(settings.journal))
        self._keys = KeyRing(settings.keys)
        self._gate = Gate(commands_path(settings.journal), settings.fleet, settings.unit, self._keys.current(),
                          self._clock.now_ns())
        self._commands: dict[str, tuple[Passed, int]] = {}
        self._answer_strangers_ns = self._refusal_ns = 0
        self._refusal_pause_ns = REFUSAL_NS
        self._refusals: Counter[tuple[str, str]] = Counter()
        self._link = BridgeLink(settings.journal)
        self._waker = Waker()
        self._stopping = False
        self._journal: Reader | None = None
        self._outbox: Outbox | None = None
        self._journal_ns = 0
        self._connection: MqttConnection | None = None
        self._connect_ns = 0
        self._failures = 0
        self._online = False
        self._alive_ns: int | None = None
        self._supervising = False
        self._period_ns = settings.period_ns
        self._samples: dict[str, Monitor] = {}
        self._sample_due_ns: dict[str, int] = {}
        self._sample_seq: Counter[str] = Counter()
        self._connection_seq = 0

    def run(self) -> None:
        """Serve until `stop`, then say goodbye."""
        try:
            while not self._stopping:
                self._turn()
                self._turned()
        finally:
            self._close()

    def stop(self) -> None:
        """End `run` soon. Safe from any thread and from signal handlers."""
        self._stopping = True
        self._waker.wake()

    @property
    def online(self) -> bool:
        """Whether the broker has us now."""
        return self._online

    def _turn(self) -> None:
        now_ns = self._clock.now_ns()
        try:
            self._open_journal(now_ns)
            if self._outbox and self._connection is None and now_ns >= self._connect_ns:
                self._connect()
            self._wait(now_ns)
            now_ns = self._clock.now_ns()
            self._hear_run(now_ns)
            if self._connection and self._outbox:
                self._serve(self._connection, self._outbox, now_ns)
        except JournalError as error:
            self._lose_journal(error, now_ns)

    def _serve(self, connection: MqttConnection, outbox: Outbox, now_ns: int) -> None:
        if connection.ready and not self._online:
            self._greet(outbox, now_ns)
        for message in connection.take():
            self._receive(message, outbox, now_ns)
        if self._online:
            for delivery in outbox.due(now_ns):
                self._publish("alarm", wire.alarm_message(*delivery), qos=1)
            self._tell_supervising(now_ns)
            self._publish_samples(connection, now_ns)
        if connection.lost:
            self._lose(connection, now_ns)

    def _wait(self, now_ns: int) -> None:
        readers = [self._waker.fileno(), self._link.fileno()]
        timeout_s = self._patience_ns(now_ns) / 1e9
        if self._connection:
            ready = self._connection.wait(timeout_s, readers)
        else:
            ready = select.select(readers, [], [], timeout_s)[0]
        if self._waker.fileno() in ready:
            self._waker.clear()

    def _patience_ns(self, now_ns: int) -> int:
        times = [now_ns + POLL_NS]
        if self._online:
            times += [self._sample_due_ns.get(name, 0) for name in self._samples]
            due_ns = self._outbox.next_due_ns() if self._outbox else None
            times += [due_ns] if due_ns is not None else []
        elif self._connection is None:
            times = [max(self._connect_ns, self._journal_ns if self._outbox is None else 0)]
        return max(0, min(times) - now_ns)

    # The journal

    def _open_journal(self, now_ns: int) -> None:
        """Raises JournalError."""
        if self._outbox or now_ns < self._journal_ns:
            return
        self._journal = Reader(self.settings.journal)
        if self._journal.unit != self.settings.unit:
            raise JournalError(f'journal {self.settings.journal}: belongs to the unit "{self._journal.unit}", '
                               f'not "{self.settings.unit}"; set [journal] path to the journal of this unit')
        self._said.discard("journal")
        self._outbox = Outbox(self._journal, self._delivered, window=self.settings.window, retry_ns=self.settings.retry_ns,
                              backlog_per_s=self.settings.backlog_per_s, jitter=self._jitter)
        self._outbox.connected(now_ns)

    def _lose_journal(self, error: JournalError, now_ns: int) -> None:
        self._say_once("journal", f"{error} (the bridge waits for it)")
        if self._journal:
            self._journal.close()
        self._journal = self._outbox = None
        self._journal_ns = now_ns + JOURNAL_NS

    # The connection

    def _connect(self) -> None:
        settings = self.settings
        subscribe = [(self._topic("ack"), 1), (self._topic("command"), 1)]
        will = (self._topic("connection"), wire.encode(self._connection_message("CONNECTION_BROKEN")))
        try:
            self._connection = MqttConnection(settings.broker, client_id(settings), subscribe=subscribe, will=will,
                                              tls=settings.tls)
        except MqttError as error:
            self._say_once("broker", f"{error} (the bridge keeps trying, the journal keeps the events)")
            self._connect_later()

    def _connect_later(self) -> None:
        pause_ns = min(CONNECT_NS << min(self._failures, 16), CONNECT_LONGEST_NS)
        self._connect_ns = self._clock.now_ns() + int(pause_ns * self._jitter.uniform(0.5, 1.5))
        self._failures += 1

    def _greet(self, outbox: Outbox, now_ns: int) -> None:
        self._online = True
        self._failures = 0
        self._said.discard("broker")
        outbox.connected(now_ns)
        self._samples.clear()
        self._supervising = self._is_supervising(now_ns)
        self._publish("connection", self._connection_message("ONLINE"), qos=1, retain=True)
        waiting = outbox.waiting()
        self._say(f"connected to {self.settings.broker}" + (f", {waiting} events to deliver" if waiting else ""))

    def _lose(self, connection: MqttConnection, now_ns: int) -> None:
        self._say_once("broker", f"broker {connection.address}: {connection.lost} (the bridge keeps trying, the journal "
                                 "keeps the events)")
        connection.abandon()
        self._connection = None
        self._online = False
        self._connect_later()

    def _close(self) -> None:
        if self._connection and self._online and not self._connection.lost:
            with suppress(JournalError):
                self._publish("connection", self._connection_message("OFFLINE"), qos=1, retain=True)
        if self._connection:
            self._connection.close()
        self._connection, self._online = None, False
        if self._journal:
            self._journal.close()
        self._delivered.close()
        self._gate.close()
        self._link.close()
        self._waker.close()

    def _connection_message(self, state: Literal["ONLINE", "OFFLINE", "CONNECTION_BROKEN"]) -> wire.Connection:
        self._connection_seq += 1
        waiting = self._outbox.waiting() if self._outbox else 0
        return wire.Connection(unit=self.settings.unit, boot=self._boot(), seq=self._connection_seq, t=self._clock.t(),
                               utc=self._clock.utc(), utc_trusted=self._clock.trusted(), state=state,
                               supervising=self._supervising and state == "ONLINE", waiting=waiting)

    def _boot(self) -> int:
        boots = self._journal.boots() if self._journal else ()
        return boots[-1] if boots else 0

    def _publish(self, kind: str, message: msgspec.Struct, *, name: str = "", qos: int = 0, retain: bool = False) -> None:
        if self._connection:
            self._connection.publish(self._topic(kind, name), wire.encode(message), qos, retain)
            self.counters[f"{kind} sent"] += 1

    def _topic(self, kind: str, name: str = "") -> str:
        return wire.topic(self.settings.fleet, self.settings.unit, kind, name)

    # What comes from level 2

    def _receive(self, message: Received, outbox: Outbox, now_ns: int) -> None:
        kind = message.topic.rpartition("/")[2]
        try:
            if kind == "ack" and message.retained:
                self._refuse("ack", "retained: it may be of any age")
            elif kind == "ack":
                self._acknowledge(wire.decode(message.payload, wire.Ack), outbox)
            elif kind == "command":
                self._command(message, now_ns)
        except wire.WireError as error:
            self._refuse(kind, f"malformed: {error}")

    def _acknowledge(self, ack: wire.Ack, outbox: Outbox) -> None:
        if ack.unit != self.settings.unit:
            self._refuse("ack", f"for another unit ({ack.unit})")
            return
        outbox.heard(self._clock.now_ns())
        verdict = outbox.acknowledge(ack.boot, ack.seq, ack.also)
        self.counters["ack"] += 1
        if verdict in (Verdict.NEVER_SENT, Verdict.BACKWARDS):
            self._refuse("ack", verdict.value)
        if verdict is not Verdict.NEVER_SENT:
            outbox.ask(ack.boot, ack.missing)
        if self._delivered.fault:
            self._say_once("delivered", self._delivered.fault)

    def _refuse(self, kind: str, reason: str) -> None:
        self.counters[f"{kind} refused"] += 1
        self._say_once(f"{kind} {reason[:20]}", f"{kind} from level 2 refused: {reason} (told once, then counted)")

    def _say_once(self, what: str, text: str) -> None:
        if what not in self._said and len(self._said) < SAID:
            self._said.add(what)
            self._say(text)

    # Commands

    def _command(self, message: Received, now_ns: int) -> None:
        self._gate.keys = self._keys.current()
        if self._keys.fault:
            self._say_once(self._keys.fault, self._keys.fault)
        if message.retained:
            decision: Decision = Refused("retained: it may be of any age")
        else:
            decision = self._gate.decide(message.payload, self._boot(), now_ns)
        if isinstance(decision, Passed):
            self._instruct(decision, now_ns)
        elif isinstance(decision, Refused):
            self._refuse_command(decision, message.payload, now_ns)
        elif decision.outcome:
            self._publish_result(decision.id, decision.seq, decision.outcome, decision.reason)
        elif not any(passed.id == decision.id for passed, _ in self._commands.values()):
            self._publish_result(decision.id, decision.seq, "refused", f"handed to supervision before; {UNKNOWN}")

    def _instruct(self, passed: Passed, now_ns: int) -> None:
        self.counters["command passed"] += 1
        if passed.order.name == MONITOR_PERIOD:
            outcome, reason = self._set_period(passed.order.value)
            self._gate.remember(passed, outcome, reason)
            self._publish_result(passed.id, passed.seq, outcome, reason)
            return
        self._commands[passed.order.id] = (passed, now_ns + ANSWER_NS)
        if not self._link.instruct(passed.order):
            self._answer(passed.order.id, "refused", "supervision is not running")

    def _set_period(self, period_s: Decimal | None) -> tuple[str, str]:
        """A longer period of monitoring messages, for a poor link; that of the configuration when no value is given."""
        period_ns = self.settings.period_ns if period_s is None else int(period_s * 10**9)
        if not self.settings.period_ns <= period_ns <= PERIOD_LONGEST_NS:
            return "refused", f"give seconds from {self.settings.period_ns / 1e9:g} to {PERIOD_LONGEST_NS // 10**9}"
        self._period_ns = period_ns
        return "done", ""

    def _answer(self, id: str, outcome: str, reason: str) -> None:
        """Supervision's answer, or the lack of one, to an order that passed."""
        if found := self._commands.pop(id, None):
            passed = found[0]
            self._gate.remember(passed, outcome, reason)
            self._publish_result(passed.id, passed.seq, outcome, reason)

    def _refuse_command(self, refused: Refused, payload: bytes, now_ns: int) -> None:
        """Those with a key of ours get an answer each; strangers a few, lest they make us flood the network."""
        self.counters["command refused"] += 1
        self._say_once(f"command {refused.reason[:20]}",
                       f"command from level 2 refused: {refused.reason} (told once, then counted)")
        kind = (refused.reason if refused.known else refused.reason.partition(":")[0],
                refused.key if refused.key in self._gate.keys else "")  # what a stranger writes makes no kind of its own
        if kind in self._refusals or len(self._refusals) < REFUSALS:
            self._refusals[kind] += 1
        if refused.known or now_ns >= self._answer_strangers_ns:
            self._answer_strangers_ns = max(self._answer_strangers_ns, now_ns if refused.known else now_ns + STRANGERS_NS)
            self._publish_result(refused.id, refused.seq, "refused", refused.reason, "" if refused.id else wire.digest(payload))

    def _publish_result(self, id: str, seq: int, outcome: str, reason: str, digest: str = "") -> None:
        self._publish("result", wire.Result(unit=self.settings.unit, boot=self._boot(), seq=seq, t=self._clock.t(),
                                            utc=self._clock.utc(), utc_trusted=self._clock.trusted(), id=id,
                                            outcome="done" if outcome == "done" else "refused", reason=reason[:1024],
                                            digest=digest), qos=1)

    def _tell_refusals(self, now_ns: int) -> None:
        """Supervision makes events of refusals: ever less often while they go on, or a stranger would fill journal and radio."""
        if self._refusals and now_ns >= self._refusal_ns:
            quiet = now_ns - self._refusal_ns > REFUSAL_LONGEST_NS
            self._refusal_pause_ns = REFUSAL_NS if quiet else min(2 * self._refusal_pause_ns, REFUSAL_LONGEST_NS)
            self._refusal_ns = now_ns + self._refusal_pause_ns
            for (reason, key), count in self._refusals.items():
                self._link.refuse(reason, key, count)
            self._refusals.clear()

    # What comes from `ucs run`

    def _hear_run(self, now_ns: int) -> None:
        for message in self._link.receive():
            self._alive_ns = now_ns
            if isinstance(message, Samples):
                self._samples |= {sample.message: sample for sample in message.monitors}
            elif isinstance(message, Beside) and self._outbox:
                self._outbox.unjournaled(event for event in message.events if event.unit == self.settings.unit)
            elif isinstance(message, Answer):
                self._answer(message.result.id, message.result.outcome, message.result.reason)
        for id in [id for id, (_, due_ns) in self._commands.items() if due_ns <= now_ns]:
            self._answer(id, "refused", f"no answer from supervision within {ANSWER_NS // 10**9} s; {UNKNOWN}")
        self._tell_refusals(now_ns)

    def _is_supervising(self, now_ns: int) -> bool:
        return self._alive_ns is not None and now_ns - self._alive_ns < ALIVE_NS

    def _tell_supervising(self, now_ns: int) -> None:
        supervising = self._is_supervising(now_ns)
        if supervising != self._supervising:
            self._supervising = supervising
            self._publish("connection", self._connection_message("ONLINE"), qos=1, retain=True)

    def _publish_samples(self, connection: MqttConnection, now_ns: int) -> None:
        """The latest of each, at its period; on a congested link the next one will be newer."""
        for name in [name for name in self._samples if self._sample_due_ns.get(name, 0) <= now_ns]:
            self._sample_due_ns[name] = max(self._sample_due_ns.get(name, 0), now_ns - self._period_ns) + self._period_ns
            if connection.congested:
                continue
            sample = self._samples.pop(name)
            self._sample_seq[name] += 1
            try:
                self._publish("monitor", wire.monitor_message(sample, self._sample_seq[name], self._period_ns / 1e9),
                              name=name)
            except wire.WireError as error:
                self._say_once(f"monitor {name}", str(error))


class BridgeThread:
    """A bridge in a thread of its own, for `ucs demo`; a context manager that stops it on leaving.

    What ends the thread early is not lost: leaving raises it.
    """

    def __init__(self, settings: Settings, say: Callable[[str], None]):
        self.bridge = Bridge(settings, say)
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="bridge", daemon=True)
        self._thread.start()

    def __enter__(self) -> Bridge:
        return self.bridge

    def __exit__(self, *_: object) -> None:
        self.bridge.stop()
        self._thread.join()
        if self._failure:
            raise self._failure

    def _run(self) -> None:
        try:
            self.bridge.run()
        except BaseException as error:
            self._failure = error
