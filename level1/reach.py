"""What a condition can become, given what its inputs can be: bits, J1939 reserved values, limits of the DBC.

Theory of operation. A condition is taken apart into comparisons; each is a *question* about one *quantity* (a signal, a sum,
an age, …), which lies in a known interval. Only the values around the limits it is compared with matter, so a few *probes*
stand for all the rest. Parts that ask about different quantities answer independently of each other; where they ask about the
same, its probes are tried one by one, so that `x > 5 and x < 3` is seen through. What is not understood counts as possible: a
condition said to be impossible is impossible, one said to be possible may not be.
Values that J1939 reserves or the limits exclude never decide a comparison (DESIGN §4: STALE, ERROR), so they don't count here.
"""
from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction

from level1.catalog import Message, Signal
from level1.decode import raw_range, reserved
from level1.expression import (
    AlarmState,
    And,
    Arithmetic,
    Boolean,
    Compare,
    Count,
    Elapsed,
    Expression,
    Function,
    Not,
    Number,
    Or,
    Quality,
    Rate,
    SignalValue,
    Silent,
)
from level1.scaling import physical, plain

MAX_TRIES = 20_000
"""Comparisons worked out for one condition; beyond it parts count as independent."""

Messages = Mapping[str, Message]


@dataclass(frozen=True, slots=True)
class Interval:
    """Physical values from low to high, inclusive; None: without end."""

    low: Fraction | None = None
    high: Fraction | None = None

    def __contains__(self, value: Fraction) -> bool:
        return (self.low is None or self.low <= value) and (self.high is None or value <= self.high)


ANYTHING = Interval()


def valid_raws(message: Message, signal: Signal) -> tuple[int, int] | None:
    """Lowest and highest raw value of an integer signal that counts as good, None when there is none."""
    low, high = raw_range(signal)
    if message.j1939:
        high = min([high, *(first - 1 for first, _, _ in reserved(signal))])
    bounds = [(Fraction(limit) - Fraction(signal.offset)) / Fraction(signal.factor)
              for limit in (signal.minimum, signal.maximum) if limit is not None]
    if len(bounds) == 2:
        low, high = max(low, math.ceil(min(bounds))), min(high, math.floor(max(bounds)))
    return (low, high) if low <= high else None


def describe(message: Message, signal: Signal) -> str:
    """The good values of a signal in words."""
    values = signal_interval(message, signal)
    unit = f" {signal.unit}" if signal.unit else ""
    low, high = ("…" if end is None else plain(end) for end in (values.low, values.high))
    return f"{signal.name} is {low} to {high}{unit}"


def signal_interval(message: Message, signal: Signal) -> Interval:
    """Good physical values of a signal."""
    if signal.is_float:
        return Interval(None if signal.minimum is None else Fraction(signal.minimum),
                        None if signal.maximum is None else Fraction(signal.maximum))
    raws = valid_raws(message, signal)
    if raws is None:
        return ANYTHING
    ends = sorted(physical(signal, raw) for raw in raws)
    return Interval(ends[0], ends[1])


def interval(node: Expression, messages: Messages) -> Interval:
    """Values a number can have."""
    match node:
        case Number(value=value):
            return Interval(Fraction(value), Fraction(value))
        case SignalValue(message=message, signal=name):
            return signal_interval(messages[message], messages[message].signal(name))
        case AlarmState():
            return Interval(Fraction(0), Fraction(3))
        case Count():
            return Interval(Fraction(0), None)
        case Arithmetic(op=op, left=left, right=right):
            return _arithmetic(op, interval(left, messages), interval(right, messages))
        case Function(name=name, arguments=arguments):
            return _function(name, [interval(argument, messages) for argument in arguments])
    return ANYTHING


def verdicts(node: Expression, messages: Messages) -> frozenset[bool]:
    """The verdicts a condition can come to while its inputs are good: TRUE, FALSE or both."""
    return _Search(node, messages).verdicts(node, {})


def overlap(first: Expression, second: Expression, messages: Messages) -> bool:
    """Whether two conditions can surely hold at once. False also where two different quantities of them hang together."""
    quantities = {question.quantity: _inputs(question) for node in (first, second) for question in _questions(node)}
    used = Counter(name for inputs in quantities.values() for name in inputs)
    if any(times > 1 for times in used.values()):
        return False
    return True in verdicts(And((first, second)), messages)


# -- questions and probes -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Question:
    """A comparison: what is asked about, how to answer, and the limit it is compared with (None: yes or no)."""

    quantity: Hashable
    limit: Fraction | None
    answer: Callable[[Fraction], bool]
    node: Expression


def _questions(node: Expression) -> Iterator[_Question]:
    """Every comparison in a condition, each as often as it occurs."""
    match node:
        case And(items=items) | Or(items=items):
            for item in items:
                yield from _questions(item)
        case Not(item=item):
            yield from _questions(item)
        case Boolean():
            return
        case _:
            yield _question(node)


def _question(node: Expression) -> _Question:
    match node:
        case Compare(op=op, left=left, right=right):
            return _comparison(node, op, left, right)
        case Elapsed(kind=kind, message=message, signal=signal, op=op, limit_ns=limit_ns):
            limit = Fraction(limit_ns)
            return _Question((kind, message, signal), limit, lambda value: _HOLDS[op](value, limit), node)
        case Silent(message=message, limit_ns=limit_ns):
            least = Fraction(limit_ns)
            return _Question(("silent", message), least, lambda value: value >= least, node)
    return _Question(node, None, bool, node)


def _comparison(node: Expression, op: str, left: Expression, right: Expression) -> _Question:
    if isinstance(right, Number):
        limit = Fraction(right.value)
        return _Question(left, limit, lambda value: _HOLDS[op](value, limit), node)
    if isinstance(left, Number):
        limit = Fraction(left.value)
        return _Question(right, limit, lambda value: _HOLDS[op](limit, value), node)
    if repr(right) < repr(left):
        return _Question(Arithmetic("-", right, left), Fraction(0), lambda value: _HOLDS[op](Fraction(0), value), node)
    return _Question(Arithmetic("-", left, right), Fraction(0), lambda value: _HOLDS[op](value, Fraction(0)), node)


_HOLDS: Mapping[str, Callable[[Fraction, Fraction], bool]] = {
    "==": lambda a, b: a == b, "!=": lambda a, b: a != b, "<": lambda a, b: a < b, "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b, ">=": lambda a, b: a >= b}

_Probes = Mapping[Hashable, tuple[Fraction, ...]]


def _probes(questions: list[_Question], messages: Messages) -> dict[Hashable, tuple[Fraction, ...]]:
    limits: dict[Hashable, set[Fraction]] = {}
    for question in questions:
        limits.setdefault(question.quantity, set()).update(() if question.limit is None else (question.limit,))
    return {quantity: _probes_of(quantity, found, messages) for quantity, found in limits.items()}


def _probes_of(quantity: Hashable, limits: set[Fraction], messages: Messages) -> tuple[Fraction, ...]:
    if isinstance(quantity, tuple):  # an age, how long a value has been held, a silence: nanoseconds from 0 up
        return _around(limits, Interval(Fraction(0), None))
    if not limits:  # yes or no
        return Fraction(0), Fraction(1)
    if isinstance(quantity, SignalValue):
        message = messages[quantity.message]
        signal = message.signal(quantity.signal)
        if not signal.is_float:
            return _signal_probes(message, signal, limits)
    if isinstance(quantity, AlarmState):
        return tuple(map(Fraction, range(4)))
    return _around(limits, interval(quantity, messages))  # type: ignore[arg-type]  # all other quantities are numbers


def _signal_probes(message: Message, signal: Signal, limits: set[Fraction]) -> tuple[Fraction, ...]:
    raws = valid_raws(message, signal)
    if raws is None:
        return ()
    near = {raw + step for limit in limits for step in (-1, 0, 1)
            for raw in [math.floor((limit - Fraction(signal.offset)) / Fraction(signal.factor))]}
    near |= {raw + 2 for raw in near}
    return tuple(physical(signal, raw) for raw in sorted({*raws, *(raw for raw in near if raws[0] <= raw <= raws[1])}))


def _around(limits: set[Fraction], bounds: Interval) -> tuple[Fraction, ...]:
    """The limits, a value between each two of them, and one beyond either end, as far as they lie within the bounds."""
    ordered = sorted({*limits, *(end for end in (bounds.low, bounds.high) if end is not None)})
    between = [(first + second) / 2 for first, second in itertools.pairwise(ordered)]
    beyond = [ordered[0] - 1, ordered[-1] + 1]
    return tuple(value for value in sorted({*ordered, *between, *beyond}) if value in bounds)


class _Search:
    """Looks for the verdicts of one condition. Parts that ask about nothing in common are worked out one by one; where parts
    ask about the same, each probe of what they ask about most is tried in turn, which parts them further."""

    def __init__(self, node: Expression, messages: Messages):
        questions = list(_questions(node))
        self._probes = _probes(questions, messages)
        self._question = {id(question.node): question for question in questions}
        self._asked: dict[int, Counter[Hashable]] = {}
        self._tries = 0

    def verdicts(self, node: Expression, known: _Probes) -> frozenset[bool]:
        """Verdicts of a part, some quantities being known."""
        match node:
            case Boolean(value=value):
                return frozenset((value,))
            case Not(item=item):
                return frozenset(not value for value in self.verdicts(item, known))
            case And(items=items):
                return _junction([self._connected(part, True, known) for part in self._parts(items, known)], True)
            case Or(items=items):
                return _junction([self._connected(part, False, known) for part in self._parts(items, known)], False)
        question = self._question[id(node)]
        self._tries += 1
        return frozenset(map(question.answer, known.get(question.quantity) or self._probes[question.quantity]))

    def _connected(self, items: list[Expression], neutral: bool, known: _Probes) -> frozenset[bool]:
        """Verdicts of parts that hang together by what they ask about."""
        if len(items) == 1 or self._tries > MAX_TRIES:
            return _junction([self.verdicts(item, known) for item in items], neutral)
        quantity = self._most_asked(items, known)
        found: set[bool] = set()
        for value in self._probes[quantity]:
            tried = {**known, quantity: (value,)}
            found |= _junction([self._connected(part, neutral, tried) for part in self._parts(items, tried)], neutral)
            if len(found) == 2:
                break
        return frozenset(found)

    def _parts(self, items: Iterable[Expression], known: _Probes) -> list[list[Expression]]:
        """The items in groups that ask about nothing unknown in common."""
        groups: list[tuple[set[Hashable], list[Expression]]] = []
        for item in items:
            asked = {quantity for quantity in self._quantities(item) if quantity not in known}
            together = [group for group in groups if group[0] & asked]
            groups = [group for group in groups if not group[0] & asked]
            joined = [one for group in together for one in group[1]]
            groups.append((asked.union(*(group[0] for group in together)), [*joined, item]))
        return [group[1] for group in groups]

    def _most_asked(self, items: list[Expression], known: _Probes) -> Hashable:
        asked: Counter[Hashable] = Counter()
        for item in items:
            asked.update(quantity for quantity in self._quantities(item) if quantity not in known)
        return asked.most_common(1)[0][0]

    def _quantities(self, node: Expression) -> Counter[Hashable]:
        """What a part asks about, and how often."""
        if id(node) not in self._asked:
            self._asked[id(node)] = Counter(question.quantity for question in _questions(node))
        return self._asked[id(node)]


def _junction(parts: list[frozenset[bool]], neutral: bool) -> frozenset[bool]:
    """A conjunction (neutral: True) or disjunction of independent parts."""
    if any(not part for part in parts):
        return frozenset()
    decisive = not neutral
    found = {neutral} if all(neutral in part for part in parts) else set()
    if any(decisive in part for part in parts):
        found.add(decisive)
    return frozenset(found)


def _inputs(question: _Question) -> set[tuple[str, str]]:
    """What a question's quantity hangs on: signals, messages, alarms."""
    quantity = question.quantity
    if isinstance(quantity, tuple):
        return {(str(quantity[1]), "")}
    return set(inputs(question.node))


def inputs(node: Expression) -> Iterator[tuple[str, str]]:
    """Message and signal of everything a condition asks about; ("", alarm) for an alarm, signal "" for a whole message."""
    match node:
        case And(items=parts) | Or(items=parts) | Function(arguments=parts):
            for part in parts:
                yield from inputs(part)
        case Not(item=item):
            yield from inputs(item)
        case Compare(left=left, right=right) | Arithmetic(left=left, right=right):
            yield from inputs(left)
            yield from inputs(right)
        case AlarmState(alarm=alarm) | Count(alarm=alarm):
            yield "", alarm
        case Silent(message=message):
            yield message, ""
        case SignalValue() | Rate() | Elapsed() | Quality():
            yield node.message, node.signal


def states(node: Expression) -> Iterator[str]:
    """Alarms whose state a condition asks for."""
    match node:
        case And(items=parts) | Or(items=parts) | Function(arguments=parts):
            for part in parts:
                yield from states(part)
        case Not(item=item):
            yield from states(item)
        case Compare(left=left, right=right) | Arithmetic(left=left, right=right):
            yield from states(left)
            yield from states(right)
        case AlarmState(alarm=alarm):
            yield alarm


# -- arithmetic of intervals --------------------------------------------------------------------------------------------


def _arithmetic(op: str, left: Interval, right: Interval) -> Interval:
    match op:
        case "+":
            return Interval(_sum(left.low, right.low), _sum(left.high, right.high))
        case "-":
            return Interval(_difference(left.low, right.high), _difference(left.high, right.low))
        case "*":
            return _product(left, right)
        case "/":
            return _quotient(left, right)
        case "&" | "|":
            return _bitwise(op, left, right)
    return ANYTHING


def _sum(first: Fraction | None, second: Fraction | None) -> Fraction | None:
    return None if first is None or second is None else first + second


def _difference(first: Fraction | None, second: Fraction | None) -> Fraction | None:
    return None if first is None or second is None else first - second


def _product(left: Interval, right: Interval) -> Interval:
    if left.low is None or left.high is None or right.low is None or right.high is None:
        return ANYTHING
    corners = [first * second for first in (left.low, left.high) for second in (right.low, right.high)]
    return Interval(min(corners), max(corners))


def _quotient(left: Interval, right: Interval) -> Interval:
    if right.low is None or right.high is None or Fraction(0) in right:
        return ANYTHING
    return _product(left, Interval(1 / right.high, 1 / right.low))


def _bitwise(op: str, left: Interval, right: Interval) -> Interval:
    """Of whole numbers from 0 up: `&` can't exceed the smaller, `|` not the bits of the larger."""
    if left.low is None or right.low is None or left.low < 0 or right.low < 0:
        return ANYTHING
    highs = [high for high in (left.high, right.high) if high is not None]
    if op == "&":
        return Interval(Fraction(0), min(highs) if highs else None)
    return Interval(max(left.low, right.low), Fraction((1 << int(max(highs)).bit_length()) - 1) if len(highs) == 2 else None)


def _function(name: str, arguments: list[Interval]) -> Interval:
    lows = [argument.low for argument in arguments]
    highs = [argument.high for argument in arguments]
    first = arguments[0]
    match name:
        case "neg":
            return _arithmetic("-", Interval(Fraction(0), Fraction(0)), first)
        case "abs":
            return _amount(first)
        case "bits":
            known = first.low is not None and first.high is not None and first.low >= 0
            return Interval(Fraction(0), Fraction(int(first.high or 0).bit_length()) if known else None)
        case "min":
            return Interval(_all(lows, min), _known(highs, min))
        case "max":
            return Interval(_known(lows, max), _all(highs, max))
    return ANYTHING


def _amount(of: Interval) -> Interval:
    high = None if of.low is None or of.high is None else max(abs(of.low), abs(of.high))
    if Fraction(0) in of:
        return Interval(Fraction(0), high)
    nearest = [abs(end) for end in (of.low, of.high) if end is not None]
    return Interval(min(nearest), high)


def _all(ends: list[Fraction | None], choose: Callable[[list[Fraction]], Fraction]) -> Fraction | None:
    known = [end for end in ends if end is not None]
    return choose(known) if len(known) == len(ends) else None


def _known(ends: list[Fraction | None], choose: Callable[[list[Fraction]], Fraction]) -> Fraction | None:
    known = [end for end in ends if end is not None]
    return choose(known) if known else None
