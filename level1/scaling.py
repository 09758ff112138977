"""Raw and physical values of a signal, exactly: physical = raw * factor + offset over fractions, never over binary floats."""
from __future__ import annotations

import struct
from decimal import Decimal
from fractions import Fraction

from level1.catalog import Signal

FLOAT_LENGTHS = (16, 32, 64)
"""Bits a floating point signal can have (IEEE 754 binary16, 32, 64)."""

_FORMATS = {16: ">e", 32: ">f", 64: ">d"}


def float_bits(value: float, length: int) -> int:
    """Raw value of a floating point signal: its IEEE 754 bits. Raises OverflowError when the value is too large for them."""
    return int.from_bytes(struct.pack(_FORMATS[length], value), "big")


def physical(signal: Signal, raw: int) -> Fraction:
    """Physical value of a raw integer."""
    return Fraction(raw) * Fraction(signal.factor) + Fraction(signal.offset)


def exact_decimal(value: Fraction) -> Decimal | None:
    """A fraction as a decimal, None when it has no finite one."""
    remainder, twos, fives = value.denominator, 0, 0
    while remainder % 2 == 0:
        remainder, twos = remainder // 2, twos + 1
    while remainder % 5 == 0:
        remainder, fives = remainder // 5, fives + 1
    if remainder != 1:
        return None
    places = max(twos, fives)
    digits = value.numerator * 10**places // value.denominator
    return Decimal(f"{digits}e-{places}") if places else Decimal(digits)


def plain(value: Fraction) -> str:
    """A value for people: decimal where there is one, without exponent."""
    number = exact_decimal(value)
    return str(value) if number is None else format(number, "f")
