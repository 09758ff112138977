"""Doubts about an alarm as a whole: conditions that can't come true or can't clear, delays and repairs that can't work.

What stands wrong at one place of a text, `level1.resolver` tells with its column; here is what only the whole shows.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from level1 import reach
from level1.catalog import Alarm, Repair
from level1.expression import And, Boolean, ExpectStep, Step, WaitStep
from level1.reach import Messages


@dataclass(frozen=True, slots=True)
class Doubt:
    """Something wrong or doubtful in an attribute of an alarm, and what to do."""

    attribute: str
    severity: Literal["error", "warning"]
    message: str
    hint: str = ""


def doubts(alarm: Alarm, messages: Messages) -> Iterator[Doubt]:
    """Everything doubtful about an alarm whose conditions are resolved."""
    yield from _when(alarm, messages)
    yield from _until(alarm, messages)
    yield from _enabled(alarm, messages)
    yield from _delay(alarm, messages)
    if alarm.repair:
        yield from _expectations(alarm.repair, messages)
        yield from _budget(alarm.repair)


def _when(alarm: Alarm, messages: Messages) -> Iterator[Doubt]:
    if alarm.when == Boolean(False):
        return  # written on purpose, for an alarm that the UCS raises itself
    found = reach.verdicts(alarm.when, messages)
    if True not in found:
        yield Doubt("AlarmWhen", "error", "the condition can never be true", "look at the ranges of its signals")
    elif False not in found and alarm.until is None:
        yield Doubt("AlarmWhen", "error", "the condition is always true: the alarm would never clear",
                    "look at the ranges of its signals")


def _until(alarm: Alarm, messages: Messages) -> Iterator[Doubt]:
    if alarm.until is None:
        return
    if True not in reach.verdicts(alarm.until, messages):
        yield Doubt("AlarmUntil", "error", "the condition can never be true: the alarm would never clear",
                    "look at the ranges of its signals")
    elif reach.overlap(alarm.when, alarm.until, messages):
        yield Doubt("AlarmUntil", "warning", "can be true while AlarmWhen is true as well",
                    "leave a gap between the two, so that the alarm can't toggle")


def _enabled(alarm: Alarm, messages: Messages) -> Iterator[Doubt]:
    if alarm.enabled is None:
        return
    if True not in reach.verdicts(alarm.enabled, messages):
        yield Doubt("AlarmEnabledWhen", "error", "the condition can never be true: the alarm is always suppressed",
                    "look at the ranges of its signals")
    elif alarm.when != Boolean(False) and True not in reach.verdicts(And((alarm.when, alarm.enabled)), messages):
        yield Doubt("AlarmEnabledWhen", "error", "is never true together with AlarmWhen: the alarm can't be raised",
                    "one of the two contradicts the other")


def _delay(alarm: Alarm, messages: Messages) -> Iterator[Doubt]:
    cycles = [messages[name].cycle_ns for name, _ in reach.inputs(alarm.when) if name]
    known = [cycle for cycle in cycles if cycle is not None]
    if known and len(known) == len(cycles) and 0 < alarm.on_delay_ns < min(known):
        yield Doubt("AlarmOnDelay", "warning", f"{_ms(alarm.on_delay_ns)} is shorter than the cycle of its inputs, "
                    f"{_ms(min(known))}: one frame decides all the same", "make it at least two cycles, or leave it out")


def _expectations(repair: Repair, messages: Messages) -> Iterator[Doubt]:
    for attribute, steps in (("Repair", repair.steps), ("RepairGiveUp", repair.give_up)):
        for step in steps:
            if isinstance(step, ExpectStep) and True not in reach.verdicts(step.condition, messages):
                yield Doubt(attribute, "error", f"`expect {step.text}` can never succeed", "look at the ranges of its signals")


def _budget(repair: Repair) -> Iterator[Doubt]:
    """A window shorter than its attempts forgets the first before the last has failed: the repair would never give up."""
    shortest, longest = least_ns(repair.steps), most_ns(repair.steps)
    together = repair.attempts * longest + (repair.attempts - 1) * repair.pause_ns
    if shortest > repair.window_ns:
        yield Doubt("RepairWindow", "error", f"one attempt takes at least {_s(shortest)}, the window is {_s(repair.window_ns)}: "
                    "the repair can't finish inside it", "make the window longer")
    elif together > repair.window_ns:
        yield Doubt("RepairWindow", "warning", f"{repair.attempts} attempts can take {_s(together)}, the window is "
                    f"{_s(repair.window_ns)}: it may never give up", "make the window longer")


def ageless(alarms: Iterable[Alarm], messages: Messages) -> Iterator[tuple[Alarm, Doubt]]:
    """Messages of others without a cycle time, each once: what they said last stays true when their sender has fallen silent."""
    told: set[str] = set()
    for alarm in alarms:
        for name in dict.fromkeys(message for message, signal in reach.inputs(alarm.when) if message and signal):
            if name not in told and messages[name].cycle_ns is None and not messages[name].sent_by_ucs:
                told.add(name)
                yield alarm, Doubt("AlarmWhen", "warning", f"{name} has no cycle time: its values never grow old, so its sender "
                                   "looks healthy when it has fallen silent", "set GenMsgCycleTime")


def circles(alarms: Iterable[Alarm]) -> Iterator[tuple[Alarm, tuple[str, ...]]]:
    """Alarms whose conditions ask, in the end, for their own state, each circle once: they would never come to rest."""
    by_name = {alarm.name: alarm for alarm in alarms}
    asks = {name: sorted({asked for condition in (alarm.when, alarm.until, alarm.enabled) if condition
                          for asked in reach.states(condition) if asked in by_name}) for name, alarm in by_name.items()}
    told: set[str] = set()
    for name in by_name:
        path = _way_back(name, asks)
        if path and not told & set(path):
            told |= set(path)
            yield by_name[name], (*path, name)


def _way_back(name: str, asks: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """The shortest chain of questions that begins at an alarm and would lead back to it, () when there is none."""
    ways: deque[tuple[str, ...]] = deque([(name,)])
    seen: set[str] = set()
    while ways:
        way = ways.popleft()
        for asked in asks[way[-1]]:
            if asked == name:
                return way
            if asked not in seen:
                seen.add(asked)
                ways.append((*way, asked))
    return ()


def least_ns(steps: Iterable[Step]) -> int:
    """Time the steps take when every expectation is met at once."""
    return sum(step.duration_ns for step in steps if isinstance(step, WaitStep))


def most_ns(steps: Iterable[Step]) -> int:
    """Time the steps take when every expectation is met at the last moment."""
    expected = sum(step.within_ns for step in steps if isinstance(step, ExpectStep))
    return least_ns(steps) + expected


def _ms(ns: int) -> str:
    return f"{ns / 1_000_000:g} ms"


def _s(ns: int) -> str:
    return f"{ns / 1_000_000_000:g} s"

