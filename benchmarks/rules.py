"""The rules of the workload as plain values: `workload` writes them into the DBC as alarms, `peer` evaluates them by hand."""
from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal


@dataclass(frozen=True)
class Threshold:
    """Raised above `high`, cleared below `low`, each held for its delay."""

    name: str
    message: str
    signal: str
    high: Decimal
    low: Decimal
    on_ms: int
    off_ms: int


@dataclass(frozen=True)
class Deviation:
    """Raised when two signals of different messages differ by more than `high`, cleared when by less than `low`."""

    name: str
    messages: tuple[str, str]
    signals: tuple[str, str]
    high: Decimal
    low: Decimal
    on_ms: int
    off_ms: int


@dataclass(frozen=True)
class Equality:
    """Raised while a signal has a value; word is its name in the value table."""

    name: str
    message: str
    signal: str
    value: int
    word: str
    on_ms: int
    off_ms: int


@dataclass(frozen=True)
class Silence:
    """Raised when a message has not come for so long, cleared when it comes."""

    name: str
    message: str
    limit_ms: int


Rule = Threshold | Deviation | Equality | Silence
