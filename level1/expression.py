"""A condition after names and types are resolved: what `language` makes of an attribute's text and `condition` compiles.

Every node is a frozen value; a tree can be encoded (msgspec) and sent to another process. Numbers are exact decimals,
as written in the DBC: `x == 0.3` means 0.3, whatever binary floating point makes of factor 0.1.
"""
from __future__ import annotations

from decimal import Decimal
from typing import Literal

import msgspec


class Node(msgspec.Struct, frozen=True, tag=True):
    """A part of a condition."""


class Number(Node, frozen=True):
    """A constant. Value-table names become the physical value of their raw value here."""

    value: Decimal


class Boolean(Node, frozen=True):
    """`true` or `false`."""

    value: bool


class SignalValue(Node, frozen=True):
    """Physical value of a signal: raw * factor + offset."""

    message: str
    signal: str


class AlarmState(Node, frozen=True):
    """`state(Alarm)`: 0 Normal, 1 Active, 2 Repairing, 3 LockedOut; always known."""

    alarm: str


class Count(Node, frozen=True):
    """`count(Alarm, window)`: how often the alarm was raised within the window that ends now; always known."""

    alarm: str
    window_ns: int


class Rate(Node, frozen=True):
    """`rate(x)`: change per second between the last two received samples of x."""

    message: str
    signal: str


class Elapsed(Node, frozen=True):
    """`age(x)` (kind "age": time since x was last received) or `held(x)` (kind "held": time since its value last changed)
    compared with a constant duration; op is one of `< <= > >=`."""

    kind: Literal["age", "held"]
    message: str
    signal: str
    op: Literal["<", "<=", ">", ">="]
    limit_ns: int


class Silent(Node, frozen=True):
    """`silent(Message, limit)`: not received for at least the limit. STALE until the message was first received."""

    message: str
    limit_ns: int


class Quality(Node, frozen=True):
    """`error(x)`, `unavailable(x)`: what the last received sample says (STALE when there is none or it is too old);
    `never(x)`: never received (always known). `corrupt(Message)`, `frozen(Message)`: what its counter and checksum say.
    Where it is asked of a message, the signal is ""."""

    kind: Literal["error", "unavailable", "never", "corrupt", "frozen"]
    message: str
    signal: str


class TroubleCode(Node, frozen=True):
    """`dtc(SPN)` or `dtc(SPN, FMI)`: an active J1939 trouble code of that kind is reported."""

    spn: int
    fmi: int | None


class Arithmetic(Node, frozen=True):
    """`left op right` over numbers; `&` and `|` take integers."""

    op: Literal["+", "-", "*", "/", "&", "|"]
    left: Expression
    right: Expression


class Function(Node, frozen=True):
    """`abs(x)`, `min(x, …)`, `max(x, …)`, `bits(x)` (number of set bits of an integer), `neg(x)` (unary minus)."""

    name: Literal["abs", "min", "max", "bits", "neg"]
    arguments: tuple[Expression, ...]


class Compare(Node, frozen=True):
    """`left op right` over numbers."""

    op: Literal["==", "!=", "<", "<=", ">", ">="]
    left: Expression
    right: Expression


class Not(Node, frozen=True):
    """Kleene's negation."""

    item: Expression


class And(Node, frozen=True):
    """Kleene's conjunction."""

    items: tuple[Expression, ...]


class Or(Node, frozen=True):
    """Kleene's disjunction."""

    items: tuple[Expression, ...]


Expression = (
    Number | Boolean | SignalValue | AlarmState | Count | Rate | Elapsed | Silent | Quality | TroubleCode
    | Arithmetic | Function | Compare | Not | And | Or
)


class SendStep(msgspec.Struct, frozen=True, tag=True):
    """`send MESSAGE(Signal=Value, …)`: raw values to set; signals not named keep what was last commanded."""

    message: str
    values: dict[str, int]


class ResendStep(msgspec.Struct, frozen=True, tag=True):
    """`resend MESSAGE`: the last one commanded, by whomever."""

    message: str


class WaitStep(msgspec.Struct, frozen=True, tag=True):
    """`wait 30 s`."""

    duration_ns: int


class ExpectStep(msgspec.Struct, frozen=True, tag=True):
    """`expect CONDITION within 3 s`: goes on as soon as it is TRUE, fails when it is not by the end."""

    condition: Expression
    within_ns: int
    text: str


Step = SendStep | ResendStep | WaitStep | ExpectStep
