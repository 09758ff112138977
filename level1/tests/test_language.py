"""The alarm language as written: what is a text of it, where the mistakes are, and what to write instead."""
from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1 import language
from level1.language import (
    Argument,
    Binary,
    Comparison,
    Duration,
    Expect,
    Junction,
    LanguageError,
    Minus,
    Name,
    Negation,
    NumberText,
    Quoted,
    Resend,
    Send,
    Wait,
    parse_commands,
    parse_condition,
    parse_steps,
)


def refused(text: str) -> LanguageError:
    with pytest.raises(LanguageError) as caught:
        parse_condition(text)
    return caught.value


def test_and_binds_tighter_than_or_and_not_tighter_than_and() -> None:
    tree = parse_condition("not a or b and c")
    assert isinstance(tree, Junction) and tree.op == "or"
    assert isinstance(tree.items[0], Negation)
    assert isinstance(tree.items[1], Junction) and tree.items[1].op == "and"


def test_bits_bind_tighter_than_comparisons() -> None:
    tree = parse_condition("Status & 4 != 0")
    assert isinstance(tree, Comparison) and isinstance(tree.left, Binary) and tree.left.op == "&"


def test_products_bind_tighter_than_sums_and_fold_from_the_left() -> None:
    tree = parse_condition("a - b - c * d > 0")
    assert isinstance(tree, Comparison) and isinstance(tree.left, Binary)
    outer = tree.left
    assert outer.op == "-" and isinstance(outer.left, Binary) and outer.left.op == "-"
    assert isinstance(outer.right, Binary) and outer.right.op == "*"


def test_numbers_are_exact() -> None:
    tree = parse_condition("x == 0.1")
    assert isinstance(tree, Comparison) and isinstance(tree.right, NumberText) and tree.right.value == Decimal("0.1")


@pytest.mark.parametrize(("text", "value"), [("0x1F", 31), ("1e3", 1000), (".5", Decimal("0.5")), ("-3", -3)])
def test_numbers_in_every_spelling(text: str, value: Decimal) -> None:
    tree = parse_condition(f"x > {text}")
    assert isinstance(tree, Comparison) and isinstance(tree.right, NumberText) and tree.right.value == value


@pytest.mark.parametrize(("text", "ns"), [("5 us", 5_000), ("500 ms", 500_000_000), ("1.5s", 1_500_000_000),
                                          ("10 min", 600_000_000_000), ("2 h", 7_200_000_000_000)])
def test_durations_carry_units(text: str, ns: int) -> None:
    tree = parse_condition(f"age(x) > {text}")
    assert isinstance(tree, Comparison) and isinstance(tree.right, Duration) and tree.right.ns == ns


def test_value_names_with_blanks_stand_in_single_quotes() -> None:
    tree = parse_condition("x == 'Not available'")
    assert isinstance(tree, Comparison) and tree.right == Quoted(5, 20, "Not available")


@pytest.mark.parametrize("name", ["android", "order", "note", "trueish", "sender", "withinRange", "s", "min_"])
def test_names_may_begin_like_words_of_the_language(name: str) -> None:
    tree = parse_condition(f"{name} == 1 and {name} == 2 or not {name}")
    assert [found.text for found in language.names(tree)] == [name] * 3


def test_unary_minus_of_a_signal() -> None:
    tree = parse_condition("-x > 1")
    assert isinstance(tree, Comparison) and isinstance(tree.left, Minus)


def test_every_node_knows_its_column() -> None:
    tree = parse_condition("aa == 1 and  bb.cc == 2")
    assert [(str(name), name.column) for name in language.names(tree)] == [("aa", 1), ("bb.cc", 14)]


def test_chained_comparisons_are_refused_with_the_text_to_write() -> None:
    error = refused("20 < OilPressure < 80")
    assert error.column == 18 and error.hint == "write `20 < OilPressure and OilPressure < 80`"


@pytest.mark.parametrize(("text", "column", "hint"), [
    ("a && b", 4, "`and`"), ("a || b", 4, "`or`"), ("!a", 1, "`not`"), ("a = b", 3, "`==`"), ("a <> b", 4, "`!=`"),
    ("a === b", 5, "`==`"), ("a AND b", 3, "small letters"), ("x > 0,5", 6, "decimals have a point"),
    ('x == "Not available"', 6, "single quotes"), ("x == 'Not", 6, "closing single quote"), ("x > 2 bar", 7, "units are"),
    ("x > 5)", 6, "more `)`"), ("x > 1;", 6, "without `;`"),
])
def test_frequent_slips_are_told_where_they_stand_with_what_to_write(text: str, column: int, hint: str) -> None:
    error = refused(text)
    assert error.column == column and hint in error.hint


@pytest.mark.parametrize(("text", "column", "missing"), [("x ==", 5, "a value"), ("max(a, b", 9, "`)`"), ("", 1, "empty")])
def test_what_is_missing_at_the_end_is_told(text: str, column: int, missing: str) -> None:
    error = refused(text)
    assert error.column == column and missing in error.message


@pytest.mark.parametrize("text", ["(" * 4000 + "x" + ")" * 4000, "-" * 5000 + "x > 1", "not " * 2000 + "x",
                                  "x" + "+x" * 3000 + ">1"])
def test_no_nesting_exhausts_the_stack(text: str) -> None:
    try:
        parse_condition(text)
    except LanguageError as error:
        assert "deep" in error.message


def test_a_text_without_end_is_refused() -> None:
    assert "longer than" in refused("x > 1 or " * 2000 + "x > 2").message


@pytest.mark.parametrize("text", ["x > 1e999999", "x > " + "9" * 100, "age(x) > 0.0001 us", "age(x) > 99999999 h"])
def test_numbers_out_of_any_range_are_refused(text: str) -> None:
    refused(text)


@given(st.text(alphabet="ab.=<>!&|+-*/()' ,;0159esm$\n\t\"é", max_size=40))
def test_any_text_is_a_condition_or_refused_at_a_column_of_it(text: str) -> None:
    for parse in (parse_condition, parse_steps, parse_commands):
        try:
            parse(text)
        except LanguageError as error:
            assert 1 <= error.column <= len(text) + 1 and error.message


def test_repair_steps() -> None:
    send, wait, expect, resend = parse_steps(
        "send CMD(Valve=Closed, Level=-1.5); wait 30 s; expect Flame == Off and age(Flame) < 1 s within 3 s; resend NOZZLES;")
    assert isinstance(send, Send) and send.message.text == "CMD"
    assert [(a.signal.text, a.value) for a in send.assignments] == [
        ("Valve", Name(15, 21, "Closed")), ("Level", NumberText(29, 33, Decimal("-1.5")))]
    assert isinstance(wait, Wait) and wait.duration.ns == 30_000_000_000
    assert isinstance(expect, Expect) and expect.within.ns == 3_000_000_000
    assert isinstance(resend, Resend) and resend.message.text == "NOZZLES"


@pytest.mark.parametrize("text", ["wait 30", "wait", "expect a == b", "send CMD(Valve)", "send CMD(Valve==Open)", "do this",
                                  "wait 1 s wait 1 s"])
def test_wrong_steps_are_refused_where_they_are_wrong(text: str) -> None:
    with pytest.raises(LanguageError) as caught:
        parse_steps(text)
    assert caught.value.message


def test_commands_carry_values_or_what_comes_with_the_command() -> None:
    pause, speed = parse_commands("pause: Mode=Pause, Light='On now'; reduce_speed: SpeedLimit=$value")
    assert pause.name.text == "pause" and [a.signal.text for a in pause.assignments] == ["Mode", "Light"]
    assert isinstance(speed.assignments[0].value, Argument)
