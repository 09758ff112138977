"""What conditions can become: compared with trying every value of every signal."""
from __future__ import annotations

import itertools
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1 import reach
from level1.catalog import Message, Signal
from level1.condition import Operator
from level1.expression import And, Arithmetic, Boolean, Compare, Elapsed, Expression, Function, Not, Number, Or, SignalValue
from level1.scaling import physical


def signal(name: str, length: int, **more: Any) -> Signal:
    usual: dict[str, Any] = {"big_endian": False, "signed": False, "is_float": False, "factor": Decimal(1), "offset": Decimal(0)}
    return Signal(name, 0, length, **(usual | more))


A = signal("a", 3, factor=Decimal("0.5"), offset=Decimal(-1))
B = signal("b", 2)
C = signal("c", 3, signed=True, factor=Decimal(-2))
MESSAGE = Message("M", 1, False, 8, (A, B, C))
MESSAGES = {"M": MESSAGE}
VALUES = {one.name: [physical(one, raw) for raw in range(-4 if one.signed else 0, (4 if one.signed else 1 << one.length))]
          for one in (A, B, C)}

signals = st.sampled_from([SignalValue("M", name) for name in "abc"])
constants = st.sampled_from([Decimal(n) / 2 for n in range(-9, 10)]).map(Number)
arithmetic = st.builds(Arithmetic, st.sampled_from(["+", "-", "*"]), signals, st.one_of(signals, constants))
functions = st.one_of(st.builds(lambda x: Function("abs", (x,)), signals), st.builds(lambda x: Function("neg", (x,)), signals),
                      st.builds(lambda x, y: Function("min", (x, y)), signals, signals),
                      st.builds(lambda x, y: Function("max", (x, y)), signals, constants))
numbers = st.one_of(signals, signals, arithmetic, functions)
operators: st.SearchStrategy[Operator] = st.sampled_from(["==", "!=", "<", "<=", ">", ">="])
comparisons = st.one_of(st.builds(Compare, operators, numbers, constants), st.builds(Compare, operators, constants, numbers),
                        st.builds(Compare, operators, signals, signals))
conditions: st.SearchStrategy[Expression] = st.recursive(
    st.one_of(comparisons, comparisons, st.booleans().map(Boolean)),
    lambda inner: st.one_of(st.builds(Not, inner), st.builds(lambda x, y: And((x, y)), inner, inner),
                            st.builds(lambda x, y: Or((x, y)), inner, inner)), max_leaves=6)
of_one_signal: st.SearchStrategy[Expression] = st.recursive(
    st.one_of(st.builds(Compare, operators, st.just(SignalValue("M", "a")), constants),
              st.builds(Compare, operators, constants, st.just(SignalValue("M", "b")))),
    lambda inner: st.one_of(st.builds(Not, inner), st.builds(lambda x, y: And((x, y)), inner, inner),
                            st.builds(lambda x, y: Or((x, y)), inner, inner)), max_leaves=6)

HOLDS = {"==": lambda a, b: a == b, "!=": lambda a, b: a != b, "<": lambda a, b: a < b, "<=": lambda a, b: a <= b,
         ">": lambda a, b: a > b, ">=": lambda a, b: a >= b}


def value(node: Expression, board: Mapping[str, Fraction]) -> Any:
    """The value of a node, straight from its definition."""
    match node:
        case Number(value=number):
            return Fraction(number)
        case Boolean(value=flag):
            return flag
        case SignalValue(signal=name):
            return board[name]
        case Arithmetic(op=op, left=left, right=right):
            first, second = value(left, board), value(right, board)
            return {"+": first + second, "-": first - second, "*": first * second}[op]
        case Function(name=name, arguments=arguments):
            found = [value(argument, board) for argument in arguments]
            return {"abs": lambda: abs(found[0]), "neg": lambda: -found[0], "min": lambda: min(found),
                    "max": lambda: max(found)}[name]()
        case Compare(op=op, left=left, right=right):
            return HOLDS[op](value(left, board), value(right, board))
        case Not(item=item):
            return not value(item, board)
        case And(items=items):
            return all(value(item, board) for item in items)
        case Or(items=items):
            return any(value(item, board) for item in items)
    raise TypeError(node)


def tried(node: Expression) -> frozenset[bool]:
    """The verdicts a condition really comes to over all values."""
    boards = (dict(zip(VALUES, values, strict=True)) for values in itertools.product(*VALUES.values()))
    return frozenset(value(node, board) for board in boards)


@given(conditions)
def test_what_is_called_impossible_is_impossible(node: Expression) -> None:
    assert tried(node) <= reach.verdicts(node, MESSAGES)


@given(of_one_signal)
def test_comparisons_of_signals_with_constants_are_seen_through_exactly(node: Expression) -> None:
    assert tried(node) == reach.verdicts(node, MESSAGES)


@given(of_one_signal, of_one_signal)
def test_an_overlap_that_is_told_is_one(first: Expression, second: Expression) -> None:
    assert reach.overlap(first, second, MESSAGES) == (True in tried(And((first, second))))


@given(numbers)
def test_an_interval_holds_every_value(node: Expression) -> None:
    bounds = reach.interval(node, MESSAGES)
    for values in itertools.product(*VALUES.values()):
        assert value(node, dict(zip(VALUES, values, strict=True))) in bounds


def test_twelve_signals_asked_about_twice_are_seen_through() -> None:
    many = {"M": Message("M", 1, False, 8, tuple(signal(f"s{n}", 8) for n in range(12)))}

    def asked(n: int, gap: int) -> tuple[Expression, Expression]:
        one = SignalValue("M", f"s{n}")
        return Compare(">", one, Number(Decimal(100))), Compare("<", one, Number(Decimal(100 + gap)))
    possible = [And(asked(n, 2)) for n in range(12)]
    assert reach.verdicts(And(tuple(possible)), many) == {True, False}
    assert reach.verdicts(And((*possible[1:], *asked(0, 1))), many) == {False}
    assert reach.verdicts(Or(tuple(Or(asked(n, 2)) for n in range(12))), many) == {True}


def test_a_knot_too_large_to_try_counts_as_possible() -> None:
    many = {"M": Message("M", 1, False, 8, tuple(signal(f"s{n}", 8) for n in range(8)))}
    values = [SignalValue("M", f"s{n}") for n in range(8)]
    knot = tuple(Or((Compare("==", values[n], Number(Decimal(n))), Compare(">", values[m], Number(Decimal(n * m)))))
                 for n in range(8) for m in range(8) if n != m)
    assert reach.verdicts(And(knot), many) == {True, False}  # s0 == 0, s1 == 1, … makes it true


@pytest.mark.parametrize(("limits", "j1939", "length", "bounds"), [
    ((None, None), False, 8, (0, 255)), ((None, None), True, 8, (0, 253)), ((None, None), True, 2, (0, 1)),
    ((None, None), True, 1, (0, 1)), ((None, None), True, 16, (0, 0xFDFF)), ((Decimal(3), Decimal(250)), True, 8, (3, 250)),
    ((Decimal(3), Decimal(300)), True, 8, (3, 253)), ((Decimal(300), Decimal(400)), False, 8, None),
])
def test_good_raw_values_are_those_not_reserved_and_within_the_limits(
        limits: tuple[Decimal | None, Decimal | None], j1939: bool, length: int, bounds: tuple[int, int] | None) -> None:
    one = signal("x", length, minimum=limits[0], maximum=limits[1])
    assert reach.valid_raws(Message("M", 1, True, 8, (one,), j1939=j1939), one) == bounds


def test_ages_begin_at_nothing() -> None:
    def age(op: Any, limit_ns: int) -> Expression:
        return Elapsed("age", "M", "a", op, limit_ns)
    assert reach.verdicts(And((age(">", 5), age("<", 3))), MESSAGES) == {False}
    assert reach.verdicts(age("<", 3), MESSAGES) == {True, False}
    assert reach.verdicts(Or((age(">=", 3), age("<", 5))), MESSAGES) == {True}
