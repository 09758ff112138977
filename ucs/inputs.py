"""Which signals of which messages the alarms of a catalog look at."""
from __future__ import annotations

from collections.abc import Iterator

from level1.catalog import Alarm, Catalog
from level1.condition import children
from level1.expression import Elapsed, ExpectStep, Expression, Quality, Rate, SignalValue, Silent

Input = tuple[str, str]
"""Message and signal; the signal is "" where the message as a whole is asked for."""


def of_alarm(alarm: Alarm) -> list[Input]:
    """Inputs of an alarm's conditions and of what its repair expects, in the order of the text, each once."""
    expected = [step.condition for step in alarm.repair.steps if isinstance(step, ExpectStep)] if alarm.repair else []
    parts = [part for part in (alarm.when, alarm.until, alarm.enabled, *expected) if part is not None]
    return list(dict.fromkeys(found for part in parts for found in _of(part)))


def messages(catalog: Catalog) -> set[str]:
    """Messages that some alarm looks at."""
    return {message for alarm in catalog.alarms.values() for message, _ in of_alarm(alarm)}


def _of(node: Expression) -> Iterator[Input]:
    match node:
        case SignalValue() | Rate() | Elapsed() | Quality():
            yield node.message, node.signal
        case Silent():
            yield node.message, ""
        case _:
            for child in children(node):
                yield from _of(child)
