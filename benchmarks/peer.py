"""What a user would write today: python-can's messages, decoded by cantools, and rule objects evaluated for every frame.

Written as one would with care: each rule is asked only about frames of the messages it reads, deadlines wait in a heap, values
that have not come for three cycles are taken away and hold the delays. It gives the same alarms at the same times as the core.
Every message has a rule on one of its signals, so no frame could be left undecoded.
"""
from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import can

from benchmarks.rules import Deviation, Equality, Rule, Silence, Threshold

STALE_CYCLES = 3


class Deadline(Protocol):
    """Something that waits for a time."""

    due_ns: int | None

    def expire(self, now_ns: int) -> None:
        """It has come."""


class Condition:
    """A rule with an on-delay and an off-delay. signals: what it reads."""

    def __init__(self, monitor: Monitor, name: str, signals: tuple[str, ...], on_ms: int, off_ms: int):
        self.monitor = monitor
        self.name = name
        self.signals = signals
        self.on_ns = on_ms * 1_000_000
        self.off_ns = off_ms * 1_000_000
        self.active = False
        self.due_ns: int | None = None
        self.left_ns: int | None = None

    def wants_change(self, values: Mapping[str, float]) -> bool:
        """Whether it should be raised (while not active) or cleared (while active). Raises KeyError when a value is missing."""
        raise NotImplementedError

    def evaluate(self, t_ns: int) -> None:
        """A message it reads has come."""
        try:
            wanted = self.wants_change(self.monitor.values)
        except KeyError:
            return
        if not wanted:
            self.due_ns = self.left_ns = None
        elif self.due_ns is None:
            delay_ns = self.off_ns if self.active else self.on_ns
            if self.left_ns is not None:
                delay_ns, self.left_ns = self.left_ns, None
            if delay_ns:
                self.due_ns = t_ns + delay_ns
                self.monitor.wake(self.due_ns, self)
            else:
                self.expire(t_ns)

    def hold(self, t_ns: int) -> None:
        """A value it reads is missing: keep what is left of the delay."""
        if self.due_ns is not None:
            self.left_ns, self.due_ns = self.due_ns - t_ns, None

    def expire(self, now_ns: int) -> None:
        """The delay has been held to its end."""
        self.active = not self.active
        self.due_ns = None
        self.monitor.alarms.append((now_ns, self.name, "raised" if self.active else "cleared"))


class HighValue(Condition):
    """A value above one limit, until it is below another."""

    def __init__(self, monitor: Monitor, rule: Threshold):
        super().__init__(monitor, rule.name, (rule.signal,), rule.on_ms, rule.off_ms)
        self.signal, self.high, self.low = rule.signal, float(rule.high), float(rule.low)

    def wants_change(self, values: Mapping[str, float]) -> bool:
        value = values[self.signal]
        return value < self.low if self.active else value > self.high


class LargeDeviation(Condition):
    """Two values that differ by more than one limit, until they do by less than another."""

    def __init__(self, monitor: Monitor, rule: Deviation):
        super().__init__(monitor, rule.name, rule.signals, rule.on_ms, rule.off_ms)
        self.one, self.other = rule.signals
        self.high, self.low = float(rule.high), float(rule.low)

    def wants_change(self, values: Mapping[str, float]) -> bool:
        deviation = abs(values[self.one] - values[self.other])
        return deviation < self.low if self.active else deviation > self.high


class EqualValue(Condition):
    """A value that is a certain one."""

    def __init__(self, monitor: Monitor, rule: Equality):
        super().__init__(monitor, rule.name, (rule.signal,), rule.on_ms, rule.off_ms)
        self.signal, self.value = rule.signal, rule.value

    def wants_change(self, values: Mapping[str, float]) -> bool:
        return (values[self.signal] == self.value) != self.active


class Watchdog:
    """Waits for the frames of a message. Frames only move `last_ns`; the deadline is looked at when it comes."""

    def __init__(self, monitor: Monitor, limit_ns: int):
        self.monitor = monitor
        self.limit_ns = limit_ns
        self.last_ns = 0
        self.due_ns: int | None = None

    def feed(self, t_ns: int) -> None:
        """A frame has come."""
        self.last_ns = t_ns
        if self.due_ns is None:
            self.due_ns = t_ns + self.limit_ns
            self.monitor.wake(self.due_ns, self)

    def expire(self, now_ns: int) -> None:
        """The frame may be missing."""
        due_ns = self.last_ns + self.limit_ns
        if due_ns > now_ns:
            self.due_ns = due_ns
            self.monitor.wake(due_ns, self)
        else:
            self.due_ns = None
            self.missed(now_ns)

    def missed(self, now_ns: int) -> None:
        """It is missing."""
        raise NotImplementedError


class SilentMessage(Watchdog):
    """A message that has not come for too long, until it comes."""

    def __init__(self, monitor: Monitor, rule: Silence):
        super().__init__(monitor, rule.limit_ms * 1_000_000)
        self.name = rule.name
        self.active = False

    def feed(self, t_ns: int) -> None:
        if self.active:
            self.active = False
            self.monitor.alarms.append((t_ns, self.name, "cleared"))
        super().feed(t_ns)

    def missed(self, now_ns: int) -> None:
        self.active = True
        self.monitor.alarms.append((now_ns, self.name, "raised"))


class StaleValues(Watchdog):
    """Takes the values of a message away when they are older than three cycles; delays that depend on them are held."""

    def __init__(self, monitor: Monitor, cycle_ms: int, signals: Sequence[str], conditions: Sequence[Condition]):
        super().__init__(monitor, STALE_CYCLES * cycle_ms * 1_000_000 + 1)
        self.signals = signals
        self.conditions = conditions

    def missed(self, now_ns: int) -> None:
        for signal in self.signals:
            self.monitor.values.pop(signal, None)
        for condition in self.conditions:
            condition.hold(now_ns)


class Monitor:
    """Raises and clears alarms from CAN messages. alarms: (ns, name, "raised" or "cleared"), as they happened.

    database: of cantools; every message of its files has a cycle time.
    """

    def __init__(self, database: Any, rules: Sequence[Rule]):
        self.database = database
        self.values: dict[str, float] = {}
        self.alarms: list[tuple[int, str, str]] = []
        self._deadlines: list[tuple[int, int, Deadline]] = []
        self._wakes = 0
        conditions: dict[str, list[Condition]] = {message.name: [] for message in database.messages}
        watchdogs: dict[str, list[Watchdog]] = {message.name: [] for message in database.messages}
        for rule in rules:
            match rule:
                case Threshold():
                    conditions[rule.message].append(HighValue(self, rule))
                case Equality():
                    conditions[rule.message].append(EqualValue(self, rule))
                case Deviation():
                    deviation = LargeDeviation(self, rule)
                    for name in rule.messages:
                        conditions[name].append(deviation)
                case Silence():
                    watchdogs[rule.message].append(SilentMessage(self, rule))
        self._branches: dict[int, tuple[str, dict[int, StaleValues]]] = {}
        for message in database.messages:
            always = [signal.name for signal in message.signals if not signal.multiplexer_ids]
            watchdogs[message.name].append(self._stale_values(message.cycle_time, always, conditions[message.name]))
            branches: dict[int, list[str]] = {}
            for signal in message.signals:
                for branch in signal.multiplexer_ids or ():
                    branches.setdefault(branch, []).append(signal.name)
            if branches:
                selector = next(signal.name for signal in message.signals if signal.is_multiplexer)
                self._branches[message.frame_id] = selector, {
                    branch: self._stale_values(message.cycle_time * len(branches), names, conditions[message.name])
                    for branch, names in branches.items()}
        self._conditions = {message.frame_id: conditions[message.name] for message in database.messages}
        self._watchdogs = {message.frame_id: watchdogs[message.name] for message in database.messages}

    def _stale_values(self, cycle_ms: int, names: Sequence[str], conditions: Sequence[Condition]) -> StaleValues:
        """The watchdog of some signals that come together, each cycle."""
        return StaleValues(self, cycle_ms, names, [each for each in conditions if not set(each.signals).isdisjoint(names)])

    def receive(self, message: can.Message) -> None:
        """One message from the bus."""
        t_ns = round(message.timestamp * 1e6) * 1000
        while self._deadlines and self._deadlines[0][0] <= t_ns:
            due_ns, _, item = heapq.heappop(self._deadlines)
            if item.due_ns == due_ns:
                item.expire(due_ns)
        frame_id = message.arbitration_id
        decoded = self.database.decode_message(frame_id, message.data, decode_choices=False)
        self.values.update(decoded)
        if frame_id in self._branches:
            selector, branches = self._branches[frame_id]
            branches[decoded[selector]].feed(t_ns)
        for watchdog in self._watchdogs[frame_id]:
            watchdog.feed(t_ns)
        for condition in self._conditions[frame_id]:
            condition.evaluate(t_ns)

    def wake(self, due_ns: int, item: Deadline) -> None:
        """Let `item` expire at this time, unless it has another deadline by then."""
        self._wakes += 1
        heapq.heappush(self._deadlines, (due_ns, self._wakes, item))
