"""Compiled conditions against the slow interpreter, over random conditions and random traffic."""
from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from level1.board import Board
from level1.condition import AND, NOT, OR, Compiler, Things, Thresholds, Verdict
from level1.expression import (
    And,
    Arithmetic,
    Boolean,
    Compare,
    Elapsed,
    Expression,
    Function,
    Not,
    Number,
    Or,
    Quality,
    SignalValue,
    Silent,
)
from level1.frame import EXTENDED
from level1.supervisor import Supervisor
from level1.tests.build import MS, alarm, catalog, message, signal
from level1.tests.reference import Reference

ENGINE = message("ENGINE", 0x0CF004FE, [
    signal("Speed", 24, 16, factor=Decimal("0.125"), maximum=Decimal("8031.875"), minimum=Decimal(0)),
    signal("Torque", 16, 8, offset=Decimal(-125)), signal("Mode", 0, 4), signal("Switch", 6, 2)],
    extended=True, j1939=True, pgn=0xF004, source=None, cycle_ns=20 * MS)
BOX = message("BOX", 0x123, [
    signal("Level", 7, 12, big_endian=True, factor=Decimal("0.1"), offset=Decimal(-40)),
    signal("Swing", 19, 9, big_endian=True, signed=True), signal("Flag", 63, 1)], cycle_ns=None)
MESSAGES = (ENGINE, BOX)
SIGNALS = [(m.name, s.name) for m in MESSAGES for s in m.signals]
KEYS = {"ENGINE": 0x0CF00403 | EXTENDED, "BOX": 0x123}

numbers = st.one_of(st.integers(-200, 5000).map(Decimal), st.integers(-500, 5000).map(lambda n: Decimal(n) / 10))
values = st.sampled_from(SIGNALS).map(lambda pair: SignalValue(*pair))
operators: st.SearchStrategy[Any] = st.sampled_from(["==", "!=", "<", "<=", ">", ">="])
limits = st.sampled_from([1, 5 * MS, 20 * MS, 60 * MS, 60 * MS + 1, 61 * MS, 200 * MS])
whole = st.sampled_from([("ENGINE", "Mode"), ("BOX", "Swing"), ("BOX", "Flag")]).map(lambda pair: SignalValue(*pair))
bitwise: st.SearchStrategy[Any] = st.builds(Arithmetic, st.sampled_from(["&", "|"]), whole, whole)


def arithmetic(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """One level more of arithmetic."""
    return st.one_of(
        st.builds(Arithmetic, st.sampled_from(["+", "-", "*"]), inner, inner),
        st.builds(lambda name, items: Function(name, tuple(items)), st.sampled_from(["min", "max"]),
                  st.lists(inner, min_size=2, max_size=3)),
        st.builds(lambda item: Function("abs", (item,)), inner), st.builds(lambda item: Function("neg", (item,)), values),
        st.builds(lambda item: Function("bits", (item,)), whole), bitwise)


quantities: st.SearchStrategy[Any] = st.recursive(st.one_of(values, numbers.map(Number)), arithmetic, max_leaves=4)
atoms: st.SearchStrategy[Any] = st.one_of(
    st.builds(Compare, operators, values, numbers.map(Number)), st.builds(Compare, operators, numbers.map(Number), values),
    st.builds(Compare, operators, quantities, quantities),
    st.builds(lambda kind, pair: Quality(kind, pair[0], pair[1]), st.sampled_from(["error", "unavailable", "never"]),
              st.sampled_from(SIGNALS)),
    st.builds(Silent, st.sampled_from(["ENGINE", "BOX"]), st.sampled_from([30 * MS, 60 * MS, 60 * MS + 1, 150 * MS])),
    st.builds(lambda kind, pair, op, limit: Elapsed(kind, pair[0], pair[1], op, limit), st.sampled_from(["age", "held"]),
              st.sampled_from(SIGNALS), st.sampled_from(["<", "<=", ">", ">="]), limits),
    st.booleans().map(Boolean), st.builds(Quality, st.just("never"), st.sampled_from(["ENGINE", "BOX"]), st.just("")))
conditions: st.SearchStrategy[Any] = st.recursive(atoms, lambda inner: st.one_of(
    inner.map(Not), st.lists(inner, min_size=2, max_size=3).map(lambda items: And(tuple(items))),
    st.lists(inner, min_size=2, max_size=3).map(lambda items: Or(tuple(items)))), max_leaves=6)

payload = st.one_of(st.binary(min_size=8, max_size=8), st.binary(min_size=0, max_size=8),
                    st.sampled_from([b"\xff" * 8, b"\xfe" * 8, b"\0" * 8]))
traffic = st.lists(st.tuples(st.sampled_from([0, 1, 5 * MS, 20 * MS, 20 * MS, 59 * MS, 60 * MS, 60 * MS + 1, 300 * MS]),
                             st.sampled_from(["ENGINE", "BOX", ""]), payload), max_size=25)


def compiled(condition: Expression) -> tuple[Supervisor, Callable[[], int]]:
    """A supervisor with one alarm of this condition, and the closure of it."""
    supervisor = Supervisor(catalog(MESSAGES, [alarm("A", condition)]), unit="test", broadcast=False, start_ns=0)
    return supervisor, supervisor._watches[0].evaluate


@given(conditions, traffic)
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_compiled_condition_equals_the_slow_interpreter(condition: Expression, steps: list[tuple[int, str, bytes]]) -> None:
    supervisor, _ = compiled(condition)
    reference = Reference(supervisor.catalog)
    ask = _verdict_of(supervisor, condition)
    now = 0
    supervisor.tick(0)
    for gap, name, data in steps:
        now += gap
        supervisor.tick(now)
        if name:
            supervisor.receive_many([(now, KEYS[name], data)])
            reference.receive(now, name, data)
        assert ask() == reference.verdict(condition, now), (now, condition)


def _verdict_of(supervisor: Supervisor, condition: Expression) -> Callable[[], int]:
    """The same condition compiled once more on the same board, as a verdict instead of a zone."""
    return Compiler(supervisor.board, supervisor._things).verdict(condition)[0]


@given(conditions, traffic)
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_every_change_of_verdict_queues_the_condition(condition: Expression, steps: list[tuple[int, str, bytes]]) -> None:
    """The outcome remembered by the watch (told to the alarm) is never behind the one that evaluation gives."""
    supervisor, evaluate = compiled(condition)
    now = 0
    supervisor.tick(0)
    for gap, name, data in steps:
        now += gap
        supervisor.tick(now)
        assert supervisor._watches[0].outcome == evaluate()
        if name:
            supervisor.receive_many([(now, KEYS[name], data)])
            assert supervisor._watches[0].outcome == evaluate()


def test_kleene_tables() -> None:
    f, t, s, e = Verdict
    assert [AND[a << 2 | b] for a, b in ((f, s), (f, e), (t, s), (s, e), (t, t))] == [f, f, s, e, t]
    assert [OR[a << 2 | b] for a, b in ((t, s), (t, e), (f, s), (s, e), (f, f))] == [t, t, s, e, f]
    assert [NOT[a] for a in (f, t, s, e)] == [t, f, s, e]


def test_a_decimal_constant_is_exact() -> None:
    """0.3 bar is raw 3 at factor 0.1, although 3 * 0.1 is not 0.3 in binary."""
    box = message("M", 1, [signal("P", 0, 8, factor=Decimal("0.1"))])
    supervisor = Supervisor(catalog([box], [alarm("A", Compare("==", SignalValue("M", "P"), Number(Decimal("0.3"))))]), unit="u",
                            broadcast=False)
    assert [getattr(out, "event", "") for out in supervisor.receive_many([(0, 1, b"\3" + bytes(7))])] == ["raised"]


def test_division_by_zero_is_an_error_not_an_exception() -> None:
    box = message("M", 1, [signal("P", 0, 8), signal("Q", 8, 8)])
    condition = Compare(">", Arithmetic("/", SignalValue("M", "P"), SignalValue("M", "Q")), Number(Decimal(2)))
    definitions = catalog([box], [alarm("A", condition)])
    board_user = Supervisor(definitions, unit="u", broadcast=False)
    board_user.receive_many([(0, 1, bytes([9, 0, 0, 0, 0, 0, 0, 0]))])
    assert board_user._watches[0].evaluate() == Verdict.ERROR
    board_user.receive_many([(1, 1, bytes([9, 3, 0, 0, 0, 0, 0, 0]))])
    assert board_user._watches[0].evaluate() == Verdict.TRUE


def test_the_compiler_needs_no_supervisor() -> None:
    from level1.timer import Timers

    board, things = Board(catalog(MESSAGES, []), Timers()), Things()
    condition = Compare(">", SignalValue("BOX", "Level"), Number(Decimal(10)))
    thresholds = Thresholds(board, things)
    thresholds.add(condition)
    board.set_classes(thresholds.constants)
    board.set_limits()
    evaluate, cells = Compiler(board, things).verdict(condition)
    assert evaluate() == Verdict.STALE and [cell.name for cell in cells] == ["BOX.Level"]
