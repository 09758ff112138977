"""Signals that an alarm compares with each other: what is, and what was expected of it."""
from __future__ import annotations

from collections.abc import Iterator

from level1.catalog import Alarm, Catalog, Signal
from level1.condition import children
from level1.expression import And, Arithmetic, Compare, Expression, Number, SignalValue
from ucs.inputs import Input

WANTED = ("Wanted", "Demand", "Commanded", "Setpoint", "Target")
"""In the name of a signal by which a node says itself what is expected of it."""


def of_alarm(alarm: Alarm, catalog: Catalog) -> set[tuple[Input, Input]]:
    """Pairs (actual, expected) that can stand in one lane: `A != B`, `A - B`, or `B == On and A != On`."""
    found = set()
    for node in _nodes(alarm.when):
        for left, right, certain in _compared(node, catalog):
            ranks = [_rank(place, catalog) for place in (left, right)]
            if ranks[0] == ranks[1] and not certain:
                continue
            actual, expected = (right, left) if ranks[0] > ranks[1] else (left, right)
            if _comparable(_signal(actual, catalog), _signal(expected, catalog)):
                found.add((actual, expected))
    return found


def translation(actual: Signal, expected: Signal) -> dict[float, float]:
    """Raw values of the expected signal as those of the actual one with the same word; empty for numbers."""
    raws = {word: raw for raw, word in actual.choices.items()}
    return {float(raw): float(raws[word]) for raw, word in expected.choices.items() if word in raws}


def _compared(node: Expression, catalog: Catalog) -> Iterator[tuple[Input, Input, bool]]:
    """Two signals, and whether they certainly are what is and what should be, whichever is which."""
    match node:
        case Compare(left=SignalValue() as left, right=SignalValue() as right):
            yield (left.message, left.signal), (right.message, right.signal), True
        case Arithmetic(op="-", left=SignalValue() as left, right=SignalValue() as right):
            yield (left.message, left.signal), (right.message, right.signal), False
        case And(items=items):
            said = [(item.op, (item.left.message, item.left.signal), _word(item, catalog)) for item in items
                    if isinstance(item, Compare) and isinstance(item.left, SignalValue) and isinstance(item.right, Number)]
            for wanted, place, word in said:
                for unlike, other, same in said:
                    if (wanted, unlike) == ("==", "!=") and word is not None and word == same:
                        yield other, place, False


def _word(item: Compare, catalog: Catalog) -> str | None:
    """The word of the value table that a signal is compared with."""
    assert isinstance(item.left, SignalValue) and isinstance(item.right, Number)
    return _signal((item.left.message, item.left.signal), catalog).choices.get(int(item.right.value))


def _rank(place: Input, catalog: Catalog) -> tuple[bool, bool]:
    """How much a signal is an expectation: commanded by the UCS, or named so."""
    return catalog.messages[place[0]].sent_by_ucs, any(word in place[1] for word in WANTED)


def _comparable(actual: Signal, expected: Signal) -> bool:
    if actual.choices or expected.choices:
        return set(expected.choices.values()) <= set(actual.choices.values())
    return actual.unit == expected.unit


def _signal(place: Input, catalog: Catalog) -> Signal:
    return catalog.messages[place[0]].signal(place[1])


def _nodes(node: Expression) -> Iterator[Expression]:
    yield node
    for child in children(node):
        yield from _nodes(child)
