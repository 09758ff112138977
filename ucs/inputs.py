"""Which signals of which messages the alarms of a catalog look at."""
from __future__ import annotations

from collections.abc import Iterator

from level1.catalog import Alarm, Catalog
from level1.condition import children
from level1.expression import Elapsed, ExpectStep, Expression, Quality, Rate, SignalValue, Silent

Input = tuple[str, str]
"""Message and signal; the signal is "" where the message as a whole is asked for."""


def of_alarm(alarm: Alarm, *, ages_expected: bool = True) -> list[Input]:
    """Inputs of an alarm's conditions and of what its repair expects, in the order of the text, each once.

    ages_expected: also signals of which a repair only wants to know how long ago they changed (counters).
    """
    expected = [step.condition for step in alarm.repair.steps if isinstance(step, ExpectStep)] if alarm.repair else []
    parts = [part for part in (alarm.when, alarm.until, alarm.enabled) if part is not None]
    found = [place for part in parts for place in _of(part)] + [place for part in expected for place in _of(part, ages_expected)]
    return list(dict.fromkeys(found))


def messages(catalog: Catalog) -> set[str]:
    """Messages that some alarm looks at."""
    return {message for alarm in catalog.alarms.values() for message, _ in of_alarm(alarm)}


def _of(node: Expression, ages: bool = True) -> Iterator[Input]:
    match node:
        case Elapsed() if not ages:
            return
        case SignalValue() | Rate() | Elapsed() | Quality():
            yield node.message, node.signal
        case Silent():
            yield node.message, ""
        case _:
            for child in children(node):
                yield from _of(child, ages)
