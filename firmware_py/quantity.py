"""Numbers with their units, as people write them in a scenario: `12 s`, `2.5 min`, `12 m/s`, `80 %`."""
from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

DURATIONS_NS = {"ms": 10**6, "s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9}
_QUANTITY = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*(\S.*)?")
LONGEST_NS = 100 * 365 * 24 * DURATIONS_NS["h"]


class QuantityError(ValueError):
    """A quantity that can't be read; the text says what is wrong and what is wanted."""


def duration_ns(text: Any) -> int:
    """Nanoseconds of a duration such as `500 ms`, `12 s`, `2 min`, `1 h`. Raises QuantityError."""
    number, unit = _split(text, "a duration such as \"12 s\" (ms, s, min, h)")
    if unit not in DURATIONS_NS:
        raise QuantityError(f'{text!r} is no duration: write "500 ms", "12 s", "2 min" or "1 h"')
    result = round(number * DURATIONS_NS[unit])
    if not 0 <= result <= LONGEST_NS:
        raise QuantityError(f"{text!r} is not between 0 s and 100 years")
    return result


def _split(text: Any, wanted: str) -> tuple[Decimal, str]:
    match = _QUANTITY.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None:
        raise QuantityError(f"{text!r} should be {wanted}")
    return Decimal(match[1]), (match[2] or "").strip()


@dataclass(frozen=True)
class Setting:
    """A setting of a node. unit: `s` takes any duration and gives seconds; "" stands for true or false.

    minimum, maximum, default: in that unit. meaning: for those who write scenarios.
    """

    name: str
    unit: str
    default: float
    minimum: float
    maximum: float
    meaning: str

    def parse(self, value: Any) -> float:
        """The value in the setting's unit; true is 1, false 0. Raises QuantityError."""
        if not self.unit:
            if not isinstance(value, bool):
                raise QuantityError(f"{value!r} should be true or false")
            return float(value)
        if self.unit == "s":
            number = duration_ns(value) / 10**9
        else:
            parsed, unit = _split(value, f'a text such as "{self.default:g} {self.unit}"')
            if unit != self.unit:
                raise QuantityError(f'{value!r} should be in {self.unit}, such as "{self.default:g} {self.unit}"')
            number = float(parsed)
        if not self.minimum <= number <= self.maximum:
            raise QuantityError(f"{value!r} is not between {self.minimum:g} and {self.maximum:g} {self.unit}")
        return number
