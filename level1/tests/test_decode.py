"""Bits to raw values, against cantools; classes against exact fractions."""
from __future__ import annotations

from decimal import Decimal
from fractions import Fraction
from typing import Any

import cantools
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.catalog import Message, Signal
from level1.decode import GOOD, Classes, Scale, compile_handler, encode, raw_of, raw_range, reserved


@st.composite
def layouts(draw: st.DrawFn) -> Signal:
    """A signal anywhere in 8 bytes, either byte order."""
    length = draw(st.integers(1, 64))
    big = draw(st.booleans())
    first = draw(st.integers(0, 64 - length))
    start = first // 8 * 8 + 7 - first % 8 if big else first
    return Signal("S", start, length, big, draw(st.booleans()), False, Decimal(1), Decimal(0))


def dbc_of(signal: Signal) -> str:
    order, sign = "0" if signal.big_endian else "1", "-" if signal.signed else "+"
    return f'BO_ 1 M: 8 N\n SG_ S : {signal.start}|{signal.length}@{order}{sign} (1,0) [0|0] "" N\n'


def handled(signal: Signal, data: bytes) -> Any:
    """The raw value that the generated decoder hands over."""
    seen: list[Any] = []
    cell: Any = type("Cell", (), {"lo": 1, "hi": 0})()
    message = Message("M", 1, False, 8, (signal,))
    handle = compile_handler(message, [(signal, cell, lambda cell, raw, t: seen.append(raw))], lambda t, d: seen.append(None),
                             set(), None)
    handle(0, data)
    return seen[0]


@given(layouts(), st.binary(min_size=8, max_size=8))
@settings(max_examples=300, deadline=None)
def test_both_decoders_agree_with_cantools(signal: Signal, data: bytes) -> None:
    expected = cantools.database.load_string(dbc_of(signal), "dbc").decode_message(1, data)["S"]  # type: ignore[union-attr, call-overload]
    assert raw_of(signal, data) == expected
    assert handled(signal, data) == expected
    assert handled(signal, data + b"\xaa\xbb") == expected


@given(layouts(), st.binary(min_size=0, max_size=8))
@settings(max_examples=200, deadline=None)
def test_both_decoders_agree_on_short_payloads(signal: Signal, data: bytes) -> None:
    assert handled(signal, data) == raw_of(signal, data)


@given(layouts(), st.binary(min_size=8, max_size=8), st.data())
@settings(max_examples=200, deadline=None)
def test_encoding_sets_the_signal_and_nothing_else(signal: Signal, base: bytes, data: st.DataObject) -> None:
    raw = data.draw(st.integers(*raw_range(signal)))
    payload = encode(Message("M", 1, False, 8, (signal,)), {"S": raw}, base)
    assert raw_of(signal, payload) == raw
    before = raw_of(signal, base)
    assert isinstance(before, int) and encode(Message("M", 1, False, 8, (signal,)), {"S": before}, payload) == base


@given(st.integers(1, 64), st.booleans(), st.booleans(), st.data())
@settings(max_examples=300, deadline=None)
def test_a_class_has_one_answer_to_every_comparison(length: int, signed: bool, j1939: bool, data: st.DataObject) -> None:
    decimals = st.integers(-10**6, 10**6).map(lambda n: Decimal(n) / 1000)
    factor = data.draw(decimals.filter(bool))
    signal = Signal("S", 0, length, False, signed, False, factor, data.draw(decimals),
                    minimum=data.draw(st.none() | decimals), maximum=data.draw(st.none() | decimals))
    constants = data.draw(st.lists(decimals, max_size=4))
    classes = Classes(signal, j1939, constants)
    raw = data.draw(st.integers(*raw_range(signal)))
    k = classes.of(raw)
    assert classes.low[k] <= raw <= classes.high[k]
    physical, sample = (Fraction(factor) * n + Fraction(signal.offset) for n in (raw, classes.sample[k]))
    for constant in constants:
        limit = Fraction(constant)
        assert (physical < limit, physical == limit) == (sample < limit, sample == limit)
    inside = (signal.minimum is None or physical >= Fraction(signal.minimum)) and \
        (signal.maximum is None or physical <= Fraction(signal.maximum))
    free = not (j1939 and any(low <= raw <= high for low, high, _ in reserved(signal)))
    assert (classes.quality[k] == GOOD) == (inside and free)


def test_the_physical_value_is_the_nearest_float_of_the_exact_decimal() -> None:
    scale = Scale(Signal("S", 0, 16, False, False, False, Decimal("0.1"), Decimal("0.2")))
    assert [scale.physical(n) for n in (1, 3, 7)] == [0.3, 0.5, 0.9]
    assert isinstance(Scale(Signal("S", 0, 16, False, False, False, Decimal(2), Decimal(-1))).physical(3), int)


def test_reserved_values_of_j1939_by_width() -> None:
    def of(length: int) -> list[tuple[int, int]]:
        return [(low, high) for low, high, _ in reserved(Signal("S", 0, length, False, False, False, Decimal(1), Decimal(0)))]
    assert of(1) == [] and of(2) == [(2, 2), (3, 3)] and of(8) == [(0xFE, 0xFE), (0xFF, 0xFF)]
    assert of(16) == [(0xFE00, 0xFEFF), (0xFF00, 0xFFFF)] and of(32) == [(0xFE000000, 0xFEFFFFFF), (0xFF000000, 0xFFFFFFFF)]
