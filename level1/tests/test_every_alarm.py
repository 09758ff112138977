"""What every alarm of every shipped definition must do, whatever its condition: found, driven and judged by one class.

For each alarm the test searches for values of its inputs that raise it and values that clear it, then plays both as traffic at
the messages' own cycle times. Counters count and checksums are right, but for the alarms that ask for them: for those 0 stands for
a counter or checksum that is right, 1 for one that is not.
"""
from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import cache
from itertools import islice, product
from typing import Any

import msgspec
import pytest

import dbc
from level1.catalog import Alarm, Catalog, Message, Signal
from level1.command import Order
from level1.condition import Verdict, Zone, walk
from level1.decode import GOOD, Classes, encode, last_byte, raw_range, reserved
from level1.event import Event
from level1.expression import AlarmState, Boolean, Count, Elapsed, Expression, Number, Quality, Rate, SignalValue, Silent
from level1.frame import EXTENDED, Frame, frame_key
from level1.io.definitions import load
from level1.protection import CHECKSUMS
from level1.supervisor import Supervisor
from level1.tests.build import MS, SECOND
from level1.tests.reference import Reference

SOURCE = 0x80
"""Source address of J1939 messages that any source may send."""
TRIES = 4000
Values = dict[tuple[str, str], int]
Quiet = frozenset[str]


@cache
def shipped() -> Catalog:
    """All shipped definitions together."""
    return load(sorted(dbc.path("ucs.dbc").parent.glob("*.dbc")))


def conditions(alarm: Alarm) -> list[Expression]:
    """Its conditions, without those of its repair."""
    return [part for part in (alarm.when, alarm.until, alarm.enabled) if part is not None]


def nodes(alarm: Alarm) -> Iterator[Expression]:
    for part in conditions(alarm):
        yield from walk(part)


def asks_for(alarm: Alarm, *kinds: type) -> bool:
    """Whether a node of one of these kinds is in its conditions."""
    return any(isinstance(node, kinds) for node in nodes(alarm))


@cache
def messages() -> dict[str, Message]:
    """All shipped messages, unmonitored: the board then holds no more than the alarm asks for."""
    return {name: msgspec.structs.replace(message, monitor_as="") for name, message in shipped().messages.items()}


def alone(alarm: Alarm) -> Catalog:
    """The catalog with this alarm and those it asks for, unarmed and without repairs."""
    wanted, queue = {alarm.name}, [alarm]
    while queue:
        for node in nodes(queue.pop()):
            if isinstance(node, (AlarmState, Count)) and node.alarm not in wanted:
                wanted.add(node.alarm)
                queue.append(shipped().alarms[node.alarm])
    alarms = {name: msgspec.structs.replace(shipped().alarms[name], repair=None) for name in shipped().alarms if name in wanted}
    return msgspec.structs.replace(shipped(), messages=messages(), alarms=alarms, commands={})


def asks_for_integrity(alarm: Alarm) -> bool:
    """Whether it asks for the counter or checksum of a message."""
    return any(isinstance(node, Quality) and node.kind in ("corrupt", "frozen") for node in nodes(alarm))


class Player:
    """Plays values of the inputs as traffic and notes what the alarm does."""

    def __init__(self, alarm: Alarm):
        self.alarm = alarm
        self.target = Supervisor(alone(alarm), unit="test", armed=(), broadcast=False, start_ns=0)
        self.target.tick(0)
        self.watch = self.target._watches[list(self.target.catalog.alarms).index(alarm.name)]
        self.now = 0
        self.made = 0
        self.events: list[Event] = []
        self.zones: list[tuple[int, int]] = []
        sink = self.watch.sink

        def spy(t_ns: int, zone: int) -> None:
            self.zones.append((t_ns, zone))
            sink(t_ns, zone)
        self.watch.sink = spy

    def told(self) -> list[tuple[int, str]]:
        """Events of this alarm as (ns, word)."""
        return [(int(event.t * SECOND), event.event) for event in self.events if event.alarm == self.alarm.name]

    def take(self, outputs: Any) -> None:
        self.events += [output for output in outputs if isinstance(output, Event)]

    def play(self, values: Values, length_ns: int, quiet: Quiet = frozenset(),
             change: Callable[[Frame], Frame] = lambda frame: frame) -> Player:
        """Send every message of the values at its cycle time for so long."""
        messages = sorted({message for message, _ in values if message not in quiet})
        end = self.now + length_ns
        due = dict.fromkeys(messages, self.now)
        while due and min(due.values()) < end:
            name = min(messages, key=lambda each: (due[each], each))
            self.take(self.target.receive(change(self.frame(name, values, due[name]))))
            due[name] += self.target.catalog.messages[name].cycle_ns or 100 * MS
        self.now = end
        self.take(self.target.tick(end))
        return self

    def frame(self, name: str, values: Values, t_ns: int) -> Frame:
        message = self.target.catalog.messages[name]
        can_id = message.can_id & ~0xFF | SOURCE if message.j1939 and message.source is None else message.can_id
        raws = {signal: raw for (owner, signal), raw in values.items() if owner == name}
        is_protected = any(signal.role != "None" for signal in message.signals)
        payload = self.protected(message, raws) if is_protected else encode(message, raws)
        return Frame(t_ns, frame_key(can_id, message.extended), payload)

    def protected(self, message: Message, raws: dict[str, int]) -> bytes:
        """A payload with its counter and checksum."""
        roles = {signal.role: signal for signal in message.signals}
        wrong = {role: bool(raws.pop(signal.name, 0)) for role, signal in roles.items() if role != "None"}
        if (counter := roles.get("Counter")) is not None and not wrong["Counter"]:
            self.made += 1
            raws[counter.name] = self.made % (1 << counter.length)
        payload = encode(message, raws)
        if (checksum := roles.get("Checksum")) is not None:
            place = checksum.start // 8
            value = CHECKSUMS[checksum.checksum](payload[:place] + payload[place + 1:]) ^ (0xFF if wrong["Checksum"] else 0)
            payload = payload[:place] + bytes([value]) + payload[place + 1:]
        return payload


def inputs(alarm: Alarm) -> list[tuple[Message, Signal]]:
    """Every signal it asks for, and of messages it asks for as a whole the first signal."""
    found: dict[tuple[str, str], tuple[Message, Signal]] = {}
    for node in nodes(alarm):
        if isinstance(node, (SignalValue, Rate, Elapsed, Quality, Silent)):
            message = shipped().messages[node.message]
            if isinstance(node, Quality) and node.kind in ("corrupt", "frozen"):
                found |= {(message.name, signal.name): (message, signal) for signal in message.signals if signal.role != "None"}
                continue
            name = getattr(node, "signal", "") or message.signals[0].name
            found[message.name, name] = (message, message.signal(name))
        elif isinstance(node, (AlarmState, Count)):
            found |= {(m.name, s.name): (m, s) for m, s in inputs(shipped().alarms[node.alarm])}
    return list(found.values())


def choices(alarm: Alarm, message: Message, signal: Signal, wrong: bool) -> list[int]:
    """Raw values worth trying: the ends of every class that any constant of the conditions makes."""
    if signal.role != "None":
        return [0, 1]
    classes = Classes(signal, message.j1939, {node.value for node in nodes(alarm) if isinstance(node, Number)})
    found = {raw for low, high, quality in zip(classes.low, classes.high, classes.quality, strict=True)
             if wrong or quality == GOOD for raw in (low, high, (low + high) // 2)}
    return sorted(found | {raw for raw in signal.choices if classes.quality[classes.of(raw)] == GOOD})


def edges(alarm: Alarm, message: Message, signal: Signal) -> list[int]:
    """The last raw value before and the first behind every limit of a signal: constants, DBC limits, reserved values."""
    classes = Classes(signal, message.j1939, {node.value for node in nodes(alarm) if isinstance(node, Number)})
    return sorted({raw for cut in classes.cuts for raw in (cut - 1, cut)} | set(raw_range(signal)))


@cache
def search(name: str, zone: Zone) -> tuple[Values, Quiet]:
    """Values (and messages that fall silent) at which the conditions of an alarm give this zone. Fails if there are none."""
    alarm = shipped().alarms[name]
    places = inputs(alarm)
    wrong = any(isinstance(node, Quality) for node in nodes(alarm))
    options = [choices(alarm, message, signal, wrong) for message, signal in places]
    silences = sorted({node.message for node in nodes(alarm) if isinstance(node, (Silent, Elapsed, Quality))})
    quiets = [frozenset(message for message, stop in zip(silences, stops, strict=True) if stop)
              for stops in product((False, True), repeat=len(silences))]
    dice = random.Random(name)
    combinations = list(islice(product(*options), TRIES))
    combinations += [tuple(dice.choice(option) for option in options) for _ in range(TRIES)]
    timed = asks_for(alarm, Silent, Elapsed, Quality, Rate, Count, AlarmState)
    dice.shuffle(combinations)
    for combination in combinations[:300 if timed else None]:
        values = {(message.name, signal.name): raw for (message, signal), raw in zip(places, combination, strict=True)}
        for quiet in quiets:
            player = Player(alarm).play(values, SECOND)
            if timed:
                player.play(values, 30 * SECOND, quiet)
            if player.watch.evaluate() == zone:
                return values, quiet
    raise AssertionError(f"{name}: nothing found that makes it {zone.name}")


def reported(alarm: Alarm) -> bool:
    """Whether subsystems report it themselves, so that no condition raises it."""
    return alarm.when == Boolean(False)


NAMES = [name for name, alarm in shipped().alarms.items() if not reported(alarm) and not asks_for(alarm, Count)]
FLAPPABLE = [name for name in NAMES if not asks_for(shipped().alarms[name], Silent, Elapsed, Quality)]
LONG = 600 * SECOND


def every(*but: type) -> pytest.MarkDecorator:
    """Every alarm whose conditions ask for none of these."""
    return pytest.mark.parametrize("name", [name for name in NAMES if not asks_for(shipped().alarms[name], *but)])


def slow_enough(name: str) -> bool:
    """Whether its on-delay is longer than three cycles of its inputs, so that they can flap within it."""
    alarm = shipped().alarms[name]
    return alarm.on_delay_ns > 3 * max((message.cycle_ns or 100 * MS for message, _ in inputs(alarm)), default=0)


class TestEveryAlarm:
    """One alarm each."""

    def settled(self, name: str, zone: Zone) -> Player:
        """A player that has played values for this zone until nothing moves any more."""
        alarm = shipped().alarms[name]
        values, quiet = search(name, zone)
        player = Player(alarm).play(values, 3 * SECOND)
        return player.play(values, alarm.on_delay_ns + alarm.off_delay_ns + 40 * SECOND, quiet)

    @every()
    def test_it_is_raised_exactly_at_the_end_of_its_on_delay(self, name: str) -> None:
        player = self.settled(name, Zone.RAISE)
        raised = [t for t, word in player.told() if word == "raised"]
        began = [t for t, zone in player.zones if zone == Zone.RAISE and t <= raised[0]]
        assert raised[0] == began[-1] + shipped().alarms[name].on_delay_ns

    @every()
    def test_it_clears_when_its_condition_is_over(self, name: str) -> None:
        player = self.settled(name, Zone.RAISE)
        values, quiet = search(name, Zone.CLEAR)
        player.play(values, 3 * SECOND).play(values, shipped().alarms[name].off_delay_ns + 40 * SECOND, quiet)
        if shipped().alarms[name].latch:
            assert [word for _, word in player.told()] == ["raised"]
            player.take(player.target.command(Order("1", "acknowledge", name, origin="local"), player.now))
        assert [word for _, word in player.told() if word != "acknowledged"][-1] == "cleared"

    @every(Elapsed)
    def test_it_is_not_raised_by_what_clears_it(self, name: str) -> None:
        assert self.settled(name, Zone.CLEAR).told() == []

    @every(Quality)
    def test_it_is_not_raised_before_anything_was_heard(self, name: str) -> None:
        player = Player(shipped().alarms[name])
        player.take(player.target.tick(LONG))
        assert player.told() == []

    @every(Silent, Elapsed)
    def test_silence_of_everything_neither_raises_nor_clears(self, name: str) -> None:
        for zone in (Zone.CLEAR, Zone.RAISE):
            player = self.settled(name, zone)
            before = player.told()
            player.take(player.target.tick(player.now + LONG))
            assert player.told() == before

    @pytest.mark.parametrize("name", [name for name in FLAPPABLE if slow_enough(name)])
    def test_flapping_faster_than_the_on_delay_never_raises_it(self, name: str) -> None:
        (on, _), (off, _) = search(name, Zone.RAISE), search(name, Zone.CLEAR)
        cycle = max(shipped().messages[message].cycle_ns or 100 * MS for message, _ in on)
        player = Player(shipped().alarms[name])
        for _ in range(20):
            player.play(on, cycle + 1).play(off, cycle + 1)
        assert player.told() == []

    @every(Quality, Elapsed, AlarmState)
    @pytest.mark.parametrize("kind", ["error", "unavailable", "limits"])
    def test_a_bad_value_of_any_input_neither_raises_nor_clears(self, name: str, kind: str) -> None:
        alarm = shipped().alarms[name]
        on, quiet = search(name, Zone.RAISE)
        for message, signal in inputs(alarm):
            bad = bad_value(message, signal, kind)
            if bad is None or message.name in quiet:
                continue
            player = Player(alarm).play(on | {(message.name, signal.name): bad}, alarm.on_delay_ns + 5 * SECOND, quiet)
            spoilt = player.told()
            assert spoilt == [] or player.watch.evaluate() == Zone.RAISE, f"{signal.name} is not needed"
            player = self.settled(name, Zone.RAISE)
            player.play(on | {(message.name, signal.name): bad}, alarm.off_delay_ns + 10 * SECOND, quiet)
            assert [word for _, word in player.told()] == ["raised"] or player.watch.evaluate() == Zone.CLEAR

    @pytest.mark.parametrize("name", [
        name for name in NAMES if not asks_for(shipped().alarms[name], Silent, Elapsed, AlarmState, Rate)
        and not asks_for_integrity(shipped().alarms[name])])
    def test_at_each_limit_and_one_step_past_it_the_verdict_is_that_of_the_slow_interpreter(self, name: str) -> None:
        alarm = shipped().alarms[name]
        on, _ = search(name, Zone.RAISE)
        for message, signal in inputs(alarm):
            for raw in edges(alarm, message, signal):
                player = Player(alarm)
                reference = Reference(player.target.catalog)
                values = on | {(message.name, signal.name): raw}
                for owner in sorted({owner for owner, _ in values}):
                    frame = player.frame(owner, values, 0)
                    player.target.receive(frame)
                    reference.receive(0, owner, frame.data)
                expected = reference.verdict(alarm.when, 0)
                if alarm.enabled is None or reference.verdict(alarm.enabled, 0) == Verdict.TRUE:
                    assert (player.watch.evaluate() == Zone.RAISE) == (expected == Verdict.TRUE)
                    assert (player.watch.evaluate() in (Zone.STALE, Zone.ERROR)) == (expected > Verdict.TRUE)

    @every(Quality, Elapsed)
    def test_short_frames_and_time_going_backwards_do_no_harm(self, name: str) -> None:
        values, _ = search(name, Zone.CLEAR)
        player = Player(shipped().alarms[name]).play(values, 2 * SECOND)
        told = player.told()
        dice = random.Random(name)

        def worse(frame: Frame) -> Frame:
            return Frame(frame.t_ns - dice.randrange(3 * SECOND), frame.key, frame.data[:dice.randrange(len(frame.data) + 1)])
        player.play(values, 2 * SECOND, change=worse)
        assert player.told() == told
        assert player.target.counters["time stamps that ran backwards"] > 0


def bad_value(message: Message, signal: Signal, kind: str) -> int | None:
    """A raw value of this kind of badness, None where the signal has none."""
    ranges = {"error": 0, "unavailable": 1}
    if kind in ranges:
        if not message.j1939 or not reserved(signal):
            return None
        return reserved(signal)[ranges[kind]][0]
    classes = Classes(signal, False, ())
    top = raw_range(signal)[1]
    return top if classes.quality[classes.of(top)] != GOOD and not message.j1939 else None


def test_the_source_address_of_the_test_is_nobodys() -> None:
    assert all(not message.can_id & EXTENDED for message in shipped().messages.values())
    assert all(last_byte(signal) < message.length for message in shipped().messages.values() for signal in message.signals)


def test_every_alarm_is_covered() -> None:
    left = sorted(set(shipped().alarms) - set(NAMES))
    assert [name for name in left if not reported(shipped().alarms[name])] == ["PilotFlameTooOften"]
