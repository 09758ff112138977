"""One definition, two machines: a DBC file bound to several buses becomes a copy for each.

Two implements of a kind on two buses must not mix their values. Every message, alarm and command of such a file gets a copy a
bus, named `Name@bus`; conditions and repairs of a copy look at their own bus. A file of which the UCS sends everything
(`ucs.dbc`) is the same everywhere: it stays one, sent on all its buses.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import msgspec

from level1.catalog import Alarm, Catalog, Message, Problem, Repair
from level1.condition import children
from level1.expression import (
    AlarmState,
    And,
    Arithmetic,
    Compare,
    Count,
    ExpectStep,
    Expression,
    Function,
    Not,
    Or,
    ResendStep,
    SendStep,
    Step,
)

Rename = Callable[[str], str]
T = TypeVar("T")


def split(catalog: Catalog, names: Sequence[str]) -> tuple[Catalog, tuple[Problem, ...]]:
    """The catalog with a copy for each bus where a file is bound to several; and what can't be told apart then.

    names: of the buses, by index. An alarm that asks for a message of such a file, but stands in another file, is an error.
    """
    heard = {message.file for message in catalog.messages.values() if message.senders != ("UCS",)}
    several = {name for name, message in catalog.messages.items() if len(catalog.buses.get(name, ())) > 1 and message.file in heard}
    if not several:
        return catalog, ()
    alarms = {name for name, alarm in catalog.alarms.items() if alarm.message in several}
    problems = tuple(_ambiguous(alarm, asked) for name, alarm in catalog.alarms.items() if name not in alarms
                     and (asked := sorted(_asked(alarm) & (several | alarms))))
    return msgspec.structs.replace(
        catalog,
        messages=_copies(catalog, several, names, catalog.messages, lambda message: message.name, _message),
        alarms=_copies(catalog, several | alarms, names, catalog.alarms, lambda alarm: alarm.message, _alarm),
        commands=_copies(catalog, several, names, catalog.commands, lambda command: command.message,
                         lambda command, rename: msgspec.structs.replace(
                             command, name=rename(command.name), message=rename(command.message))),
        buses={copy: (bus,) if name in several else buses for name, buses in catalog.buses.items()
               for bus in buses for copy in [f"{name}@{names[bus]}" if name in several else name]}), problems


def _copies(catalog: Catalog, several: set[str], names: Sequence[str], things: dict[str, T], home: Callable[[T], str],
               copied: Callable[[T, Rename], T]) -> dict[str, T]:
    result: dict[str, T] = {}
    for name, thing in things.items():
        if home(thing) not in several:
            result[name] = thing
            continue
        for bus in catalog.buses[home(thing)]:
            def rename(old: str, suffix: str = names[bus], own: str = name) -> str:
                return f"{old}@{suffix}" if old in several or old == own else old
            result[rename(name)] = copied(thing, rename)
    return result


def _message(message: Message, rename: Rename) -> Message:
    monitor_as = message.monitor_as and message.monitor_as + rename(message.name).removeprefix(message.name)
    return msgspec.structs.replace(message, name=rename(message.name), monitor_as=monitor_as)


def _alarm(alarm: Alarm, rename: Rename) -> Alarm:
    def of(part: Expression | None) -> Expression | None:
        return None if part is None else _expression(part, rename)
    return msgspec.structs.replace(
        alarm, name=rename(alarm.name), message=rename(alarm.message), when=_expression(alarm.when, rename), until=of(alarm.until),
        enabled=of(alarm.enabled), repair=alarm.repair and _repair(alarm.repair, rename))


def _repair(repair: Repair, rename: Rename) -> Repair:
    return msgspec.structs.replace(repair, steps=tuple(_step(step, rename) for step in repair.steps),
                                   give_up=tuple(_step(step, rename) for step in repair.give_up))


def _step(step: Step, rename: Rename) -> Step:
    if isinstance(step, (SendStep, ResendStep)):
        return msgspec.structs.replace(step, message=rename(step.message))
    if isinstance(step, ExpectStep):
        return msgspec.structs.replace(step, condition=_expression(step.condition, rename))
    return step


def _expression(node: Expression, rename: Rename) -> Expression:
    match node:
        case Compare() | Arithmetic():
            return msgspec.structs.replace(node, left=_expression(node.left, rename), right=_expression(node.right, rename))
        case Not(item=item):
            return Not(_expression(item, rename))
        case And(items=items) | Or(items=items):
            return msgspec.structs.replace(node, items=tuple(_expression(item, rename) for item in items))
        case Function(arguments=arguments):
            return msgspec.structs.replace(node, arguments=tuple(_expression(argument, rename) for argument in arguments))
        case AlarmState(alarm=alarm) | Count(alarm=alarm):
            return msgspec.structs.replace(node, alarm=rename(alarm))
        case _:
            message = getattr(node, "message", None)
            return node if message is None else msgspec.structs.replace(node, message=rename(message))


def _asked(alarm: Alarm) -> set[str]:
    """Messages and alarms that its conditions and its repair name."""
    names: set[str] = set()

    def visit(node: Expression) -> None:
        names.update(name for name in (getattr(node, "message", ""), getattr(node, "alarm", "")) if name)
        for child in children(node):
            visit(child)
    repair = alarm.repair
    steps = (*repair.steps, *repair.give_up) if repair is not None else ()
    for part in (alarm.when, alarm.until, alarm.enabled, *(step.condition for step in steps if isinstance(step, ExpectStep))):
        if part is not None:
            visit(part)
    return names | {step.message for step in steps if isinstance(step, (SendStep, ResendStep))}


def _ambiguous(alarm: Alarm, asked: list[str]) -> Problem:
    return Problem(alarm.file, alarm.line, f"{alarm.message}.{alarm.name}", "", 0, "error",
                   f"asks for {asked[0]}, of which there is one on each of several buses",
                   "put the alarm into the file that is bound to them")
