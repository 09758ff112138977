"""Names and types: a syntax tree of `level1.language` becomes the typed nodes of `level1.expression`.

Every mistake of a text is found, not only the first: a part that can't be resolved becomes UNKNOWN, which fits everywhere.
`FUNCTIONS` is the table of what can be called. Constants are folded exactly.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from typing import Literal

from level1 import language, reach, similar
from level1.catalog import ACTIVE, LOCKED_OUT, NORMAL, REPAIRING, STALE_CYCLES, Command, Message, Signal
from level1.decode import UNAVAILABLE, raw_range, reserved
from level1.expression import (
    AlarmState,
    And,
    Arithmetic,
    Boolean,
    Compare,
    Count,
    Elapsed,
    ExpectStep,
    Expression,
    Function,
    Not,
    Number,
    Or,
    Quality,
    Rate,
    ResendStep,
    SendStep,
    SignalValue,
    Silent,
    Step,
    TroubleCode,
    WaitStep,
)
from level1.health import READINGS
from level1.language import LanguageError, Name, Syntax
from level1.scaling import exact_decimal, float_bits, physical, plain

STATES: Mapping[str, int] = {"Normal": NORMAL, "Active": ACTIVE, "Repairing": REPAIRING, "LockedOut": LOCKED_OUT}
"""Names of an alarm's states (DESIGN §3)."""
MOST_SUGGESTIONS = 10
"""Mistakes of one text for which a similar name is looked up: it costs a look at every signal."""
MAX_SPN = 524_287
"""Largest suspect parameter number: 19 bits (SAE J1939-73)."""
MAX_FMI = 31
"""Largest failure mode identifier: 5 bits (SAE J1939-73)."""

_MIRRORED: Mapping[str, Literal["<", "<=", ">", ">="]] = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}


@dataclass(frozen=True, slots=True)
class Finding:
    """What is wrong in a text, and where: column 1-based, 0 for all of it."""

    column: int
    severity: Literal["error", "warning"]
    message: str
    hint: str = ""


@dataclass(frozen=True, slots=True)
class Typed:
    """A resolved part: its kind, its node, and what later checks want to know of it.

    number: `value` when constant, `whole` when surely an integer, `flag` when its valid values are 0 and 1 only.
    elapsed: `age(x)` or `held(x)`, which only a comparison turns into a condition. duration: `ns`. signal, alarm: what it names.
    """

    kind: Literal["number", "boolean", "duration", "elapsed", "unknown"]
    node: Expression | None = None
    value: Fraction | None = None
    whole: bool = False
    flag: bool = False
    ns: int = 0
    elapsed: tuple[Literal["age", "held"], str, str] | None = None
    signal: tuple[Message, Signal] | None = None
    alarm: str = ""
    unit: str = ""


UNKNOWN = Typed("unknown")


class Scope:
    """The names a text can use: all messages of all files, and which signals are alarms (name -> message)."""

    def __init__(self, messages: Iterable[Message], alarms: Mapping[str, str]):
        self.messages: dict[str, Message] = {message.name: message for message in messages}
        self.alarms = alarms
        self._signals: dict[str, list[tuple[Message, Signal]]] = {}
        for message in self.messages.values():
            for signal in message.signals:
                self._signals.setdefault(signal.name, []).append((message, signal))

    def find(self, name: Name) -> list[tuple[Message, Signal]]:
        """Every signal a name can mean."""
        found = self._signals.get(name.text, [])
        return [pair for pair in found if not name.owner or pair[0].name == name.owner]

    def only(self, name: Name) -> tuple[Message, Signal] | None:
        """The signal a name means, None when there is none or more than one."""
        found = self.find(name)
        return found[0] if len(found) == 1 else None

    def is_alarm(self, message: Message, signal: Signal) -> bool:
        """Whether a signal is an alarm's."""
        return self.alarms.get(signal.name) == message.name

    @property
    def signal_names(self) -> Iterable[str]:
        """Names of all signals."""
        return self._signals


def resolve_condition(text: str, scope: Scope) -> tuple[Expression | None, list[Finding]]:
    """The typed condition of a text, None when it has an error; and everything found wrong or doubtful."""
    resolution = _Resolution(scope)
    try:
        node = resolution.condition(language.parse_condition(text))
    except LanguageError as error:
        return None, [_finding(error)]
    return (None if resolution.has_errors else node), resolution.findings


def resolve_steps(text: str, scope: Scope) -> tuple[tuple[Step, ...], list[Finding]]:
    """The steps of a repair; those with an error are left out."""
    resolution = _Resolution(scope)
    try:
        steps = tuple(step for syntax in language.parse_steps(text) if (step := resolution.step(syntax, text)))
    except LanguageError as error:
        return (), [_finding(error)]
    return steps, resolution.findings


def resolve_commands(text: str, message: Message, scope: Scope) -> tuple[tuple[Command, ...], list[Finding]]:
    """The commands of a message."""
    resolution = _Resolution(scope)
    try:
        syntaxes = language.parse_commands(text)
    except LanguageError as error:
        return (), [_finding(error)]
    commands = tuple(Command(syntax.name.text, message.name, resolution.assignments(message, syntax.assignments, True))
                     for syntax in syntaxes)
    return commands, resolution.findings


def _finding(error: LanguageError) -> Finding:
    return Finding(error.column, "error", error.message, error.hint)


@dataclass
class _Resolution:
    """Resolves one text and gathers what it finds."""

    scope: Scope
    findings: list[Finding] = field(default_factory=list)

    @property
    def has_errors(self) -> bool:
        """Whether anything found is an error."""
        return any(finding.severity == "error" for finding in self.findings)

    def error(self, part: Syntax, message: str, hint: str = "") -> Typed:
        """Notes an error at a part of the text."""
        self.findings.append(Finding(part.column, "error", message, hint))
        return UNKNOWN

    def warning(self, part: Syntax, message: str, hint: str = "") -> None:
        """Notes something doubtful."""
        self.findings.append(Finding(part.column, "warning", message, hint))

    # -- conditions ---------------------------------------------------------------------------------------------------

    def condition(self, syntax: Syntax) -> Expression | None:
        """A part that must be a condition."""
        typed = self.typed(syntax)
        if typed.kind == "number" and typed.value is None and typed.flag and typed.node:
            return Compare("!=", typed.node, Number(Decimal(0)))
        if typed.kind in ("boolean", "unknown"):
            return typed.node
        self.error(syntax, f"{_describe(typed)} is no condition", _condition_hint(syntax, typed))
        return None

    def typed(self, syntax: Syntax) -> Typed:
        """Any part, with its type."""
        match syntax:
            case Name():
                return self._name(syntax)
            case language.NumberText(value=value):
                return _constant(Fraction(value))
            case language.Duration(ns=ns):
                return Typed("duration", ns=ns)
            case language.BooleanText(value=flag):
                return Typed("boolean", Boolean(flag))
            case language.Quoted(text=text):
                return self.error(syntax, f"nothing here says whose value '{text}' is", "compare a signal with it")
            case language.Call():
                return self._call(syntax)
            case language.Minus(item=item):
                return self._minus(item)
            case language.Binary():
                return self._binary(syntax)
            case language.Comparison():
                return self._comparison(syntax)
            case language.Negation(item=item):
                node = self.condition(item)
                return Typed("boolean", Not(node)) if node else UNKNOWN
            case language.Junction(op=op, items=items):
                return self._junction(op, items)
        raise TypeError(type(syntax).__name__)

    def _junction(self, op: str, items: tuple[Syntax, ...]) -> Typed:
        nodes = [self.condition(item) for item in items]
        known = tuple(node for node in nodes if node)
        if len(known) < len(nodes):
            return UNKNOWN
        return Typed("boolean", And(known) if op == "and" else Or(known))

    def _name(self, name: Name) -> Typed:
        found = self.scope.find(name)
        if len(found) == 1:
            return self._signal(*found[0])
        if found:
            choices = " or ".join(f"{message.name}.{name.text}" for message, _ in found[:4])
            return self.error(name, f"`{name.text}` is a signal of {len(found)} messages", f"write {choices}")
        if not name.owner and name.text in self.scope.messages:
            return self.error(name, f"`{name.text}` is a message, not a signal", f"write {name.text}.SignalName")
        return self._unknown(name)

    def _unknown(self, name: Name) -> Typed:
        if not name.owner:
            hint = similar.hint(name.text, self.scope.signal_names) if len(self.findings) < MOST_SUGGESTIONS else ""
            return self.error(name, f"there is no signal `{name.text}`", hint or "value names need the signal on the other side")
        message = self.scope.messages.get(name.owner)
        if message is None:
            return self.error(name, f"there is no message `{name.owner}`", similar.hint(name.owner, self.scope.messages))
        signals = [signal.name for signal in message.signals]
        return self.error(name, f"message {name.owner} has no signal `{name.text}`", similar.hint(name.text, signals))

    def _signal(self, message: Message, signal: Signal) -> Typed:
        if self.scope.is_alarm(message, signal):
            return Typed("number", AlarmState(signal.name), whole=True, alarm=signal.name)
        whole = not signal.is_float and _is_whole(signal.factor) and _is_whole(signal.offset)
        return Typed("number", SignalValue(message.name, signal.name), whole=whole, flag=_is_flag(message, signal),
                     signal=(message, signal), unit=signal.unit)

    def _minus(self, item: Syntax) -> Typed:
        typed = self._number(item)
        if typed.node is None:
            return UNKNOWN
        if typed.value is not None:
            return _constant(-typed.value)
        return Typed("number", Function("neg", (typed.node,)), whole=typed.whole, unit=typed.unit)

    def _number(self, syntax: Syntax) -> Typed:
        typed = self.typed(syntax)
        if typed.kind in ("number", "unknown"):
            return typed
        return self.error(syntax, f"{_describe(typed)} stands where a number belongs", _number_hint(typed))

    def _binary(self, syntax: language.Binary) -> Typed:
        left, right = self._number(syntax.left), self._number(syntax.right)
        if left.node is None or right.node is None:
            return UNKNOWN
        if syntax.op in "&|":
            return self._bitwise(syntax, left, right)
        if syntax.op == "/" and right.value == 0:
            return self.error(syntax.right, "division by zero")
        if left.value is not None and right.value is not None:
            return _constant(_FOLD[syntax.op](left.value, right.value))
        if syntax.op == "/" and right.value is None and Fraction(0) in reach.interval(right.node, self.scope.messages):
            self.warning(syntax.right, "the divisor can become 0; the condition is an error then", "exclude 0 by its limits")
        if syntax.op in "+-":
            self._compare_units(syntax, left, right)
        unit = left.unit or right.unit if syntax.op in "+-" else ""
        whole = left.whole and right.whole and syntax.op != "/"
        return Typed("number", _arithmetic(syntax.op, left.node, right.node), whole=whole, unit=unit)

    def _bitwise(self, syntax: language.Binary, left: Typed, right: Typed) -> Typed:
        for part, typed in ((syntax.left, left), (syntax.right, right)):
            if not typed.whole:
                return self.error(part, f"`{syntax.op}` needs whole numbers", "use a signal whose factor and offset are whole")
        if left.value is not None and right.value is not None:
            first, second = int(left.value), int(right.value)
            return _constant(Fraction(first & second if syntax.op == "&" else first | second))
        assert left.node and right.node
        return Typed("number", _arithmetic(syntax.op, left.node, right.node), whole=True)

    def _compare_units(self, syntax: Syntax, left: Typed, right: Typed) -> None:
        if left.unit and right.unit and left.unit != right.unit:
            self.warning(syntax, f"units differ: {left.unit} and {right.unit}", "convert one side by a factor")

    # -- comparisons --------------------------------------------------------------------------------------------------

    def _comparison(self, syntax: language.Comparison) -> Typed:
        if self._is_lost(syntax.left) and self._is_lost(syntax.right):
            return self.typed(self._guilty(syntax.left, syntax.right))
        left = self._operand(syntax.left, syntax.right)
        right = self._operand(syntax.right, syntax.left)
        if "unknown" in (left.kind, right.kind):
            return UNKNOWN
        if "elapsed" in (left.kind, right.kind):
            return self._elapsed(syntax, left, right)
        for part, typed in ((syntax.left, left), (syntax.right, right)):
            if typed.kind != "number":
                return self.error(part, f"{_describe(typed)} can't be compared", _comparison_hint(typed))
        assert left.node and right.node
        if left.value is not None and right.value is not None:
            verdict = _holds(syntax.op, left.value, right.value)
            self.warning(syntax, f"compares two constants: always {'true' if verdict else 'false'}")
            return Typed("boolean", Boolean(verdict))
        self._compare_units(syntax, left, right)
        node = _compare(syntax.op, left.node, right.node)
        self._check_reach(syntax, node, left, right)
        return Typed("boolean", node)

    def _check_reach(self, syntax: language.Comparison, node: Compare, left: Typed, right: Typed) -> None:
        """Notes a comparison that always comes out the same."""
        verdicts = reach.verdicts(node, self.scope.messages)
        if len(verdicts) == 2:
            return
        pair, limit = (left.signal, right.value) if left.signal else (right.signal, left.value)
        why = f": {reach.describe(*pair)}" if pair else ""
        hint = _reach_hint(*pair, limit) if pair and limit is not None else ""
        if True in verdicts:
            self.warning(syntax, f"always holds{why}", hint)
        else:
            self.error(syntax, f"can never hold{why}", hint)

    def _is_lost(self, syntax: Syntax) -> bool:
        """Whether a name means no signal by itself: misspelt, ambiguous, or a value name."""
        return isinstance(syntax, language.Quoted) or (isinstance(syntax, Name) and self.scope.only(syntax) is None)

    def _guilty(self, left: Syntax, right: Syntax) -> Syntax:
        """Which of two names that mean nothing was meant as the signal: the other one is a value name and right as it is."""
        for side in (left, right):
            if isinstance(side, Name) and (side.owner or self.scope.find(side) or side.text in self.scope.messages):
                return side
        if len(self.findings) >= MOST_SUGGESTIONS:
            return left
        near = [side for side in (left, right)
                if isinstance(side, Name) and similar.closest(side.text, self.scope.signal_names)]
        return near[0] if near else left

    def _operand(self, syntax: Syntax, other: Syntax) -> Typed:
        """One side of a comparison: value-table names and true/false mean what they mean to the other side."""
        if isinstance(syntax, language.BooleanText) and self._is_flag(other):
            return _constant(Fraction(int(syntax.value)))
        if not isinstance(syntax, language.Quoted) and not (isinstance(syntax, Name) and not syntax.owner):
            return self.typed(syntax)
        table = self._table(other)
        text = syntax.text
        matching = [value for name, value in table if name == text]
        if isinstance(syntax, Name) and self.scope.find(syntax) and not matching:
            return self.typed(syntax)
        if len(set(matching)) > 1:
            return self.error(syntax, f"`{text}` names {len(matching)} different values", "compare with the number instead")
        if matching:
            return _constant(matching[0])
        return self._no_value(syntax, text, other, [name for name, _ in table])

    def _no_value(self, syntax: Syntax, text: str, other: Syntax, known: Sequence[str]) -> Typed:
        if not known:
            return self.typed(syntax)
        near = similar.hint(text, known)
        listed = ", ".join(_as_written(name) for name in known[:8]) + (", …" if len(known) > 8 else "")
        return self.error(syntax, f"`{text}` is no value of {other}" if isinstance(other, Name) else f"`{text}` is no state",
                          f"{near} its values are {listed}".strip())

    def _table(self, syntax: Syntax) -> list[tuple[str, Fraction]]:
        """The value names a part's signal has, with their physical values."""
        if isinstance(syntax, language.Call) and syntax.function == "state":
            return [(name, Fraction(raw)) for name, raw in STATES.items()]
        pair = self.scope.only(syntax) if isinstance(syntax, Name) else None
        if pair is None:
            return []
        if self.scope.is_alarm(*pair):
            return [(name, Fraction(raw)) for name, raw in STATES.items()]
        signal = pair[1]
        return [(name, physical(signal, raw)) for raw, name in signal.choices.items()]

    def _is_flag(self, syntax: Syntax) -> bool:
        pair = self.scope.only(syntax) if isinstance(syntax, Name) else None
        return pair is not None and _is_flag(*pair)

    def _elapsed(self, syntax: language.Comparison, left: Typed, right: Typed) -> Typed:
        flipped = right.kind == "elapsed"
        elapsed, limit = (right, left) if flipped else (left, right)
        limit_syntax = syntax.left if flipped else syntax.right
        if limit.kind != "duration" or elapsed.elapsed is None:
            return self.error(limit_syntax, f"{_describe(elapsed)} is compared with {_describe(limit)}",
                              "compare it with a duration: 500 ms, 2 s, 10 min")
        if syntax.op in ("==", "!="):
            return self.error(syntax, f"`{syntax.op}` never holds long enough to be seen", "use < <= > or >=")
        op = _MIRRORED[syntax.op] if flipped else _MIRRORED[_MIRRORED[syntax.op]]
        kind, message, signal = elapsed.elapsed
        return Typed("boolean", Elapsed(kind, message, signal, op, limit.ns))

    # -- functions ----------------------------------------------------------------------------------------------------

    def _call(self, call: language.Call) -> Typed:
        spec = FUNCTIONS.get(call.function)
        if spec is None:
            return self.error(call, f"there is no function `{call.function}`",
                              similar.hint(call.function, FUNCTIONS) or f"there are {', '.join(FUNCTIONS)}")
        if not spec.fewest <= len(call.arguments) <= spec.most:
            return self.error(call, f"{call.function} is given {len(call.arguments)} arguments", f"write {spec.usage}")
        return spec.resolve(self, call)

    def signal_argument(self, call: language.Call, allow_alarm: bool = False) -> tuple[Message, Signal] | None:
        """The signal a function is about."""
        argument = call.arguments[0]
        if not isinstance(argument, Name):
            self.error(argument, f"{call.function} takes a signal", f"write {FUNCTIONS[call.function].usage}")
            return None
        typed = self._name(argument)
        if typed.alarm and not allow_alarm:
            self.error(argument, f"{call.function} can't be asked of an alarm", "use state(Alarm) or count(Alarm, 10 min)")
        return typed.signal

    def message_argument(self, call: language.Call) -> Message | None:
        """The message a function is about, when its argument names one."""
        argument = call.arguments[0]
        if not isinstance(argument, Name) or argument.owner or self.scope.find(argument):
            return None
        return self.scope.messages.get(argument.text)

    def alarm_argument(self, call: language.Call) -> str | None:
        """The alarm a function is about."""
        argument = call.arguments[0]
        pair = self.scope.only(argument) if isinstance(argument, Name) else None
        if pair and self.scope.is_alarm(*pair):
            return pair[1].name
        name = str(argument) if isinstance(argument, Name) else "this"
        self.error(argument, f"there is no alarm `{name}`", similar.hint(name, self.scope.alarms)
                   or "an alarm is a signal with AlarmCode and AlarmWhen")
        return None

    def duration_argument(self, call: language.Call, index: int) -> int | None:
        """The duration a function takes, in nanoseconds, above zero."""
        argument = call.arguments[index]
        if isinstance(argument, language.Duration) and argument.ns > 0:
            return argument.ns
        self.error(argument, f"{call.function} takes a duration here", "write 500 ms, 2 s, 10 min")
        return None

    def whole_argument(self, call: language.Call, index: int, most: int) -> int | None:
        """The whole constant a function takes, 0 to `most`."""
        typed = self.typed(call.arguments[index])
        if typed.value is not None and typed.value.denominator == 1 and 0 <= typed.value <= most:
            return int(typed.value)
        if typed.kind != "unknown":
            self.error(call.arguments[index], f"{call.function} takes a whole number here", f"0 to {most}")
        return None

    def number_argument(self, syntax: Syntax) -> Typed:
        """A numeric argument."""
        return self._number(syntax)

    # -- repairs and commands -----------------------------------------------------------------------------------------

    def step(self, syntax: Syntax, text: str) -> Step | None:
        """One step of a repair."""
        match syntax:
            case language.Send(message=name, assignments=assignments):
                message = self._own_message(name)
                return SendStep(message.name, _given(self.assignments(message, assignments))) if message else None
            case language.Resend(message=name):
                message = self._own_message(name)
                return ResendStep(message.name) if message else None
            case language.Wait(duration=duration):
                return WaitStep(duration.ns)
            case language.Expect(condition=condition, within=within):
                node = self.condition(condition)
                self._check_senders(condition)
                said = text[syntax.start:within.start].strip().removeprefix("expect").removesuffix("within").strip()
                return ExpectStep(node, within.ns, said) if node else None
        raise TypeError(type(syntax).__name__)

    def _check_senders(self, condition: Syntax) -> None:
        """What a repair expects has to be told by somebody else or measured, or it proves nothing."""
        pairs = [(name, pair) for name in language.names(condition) if (pair := self.scope.only(name))]
        if any(set(message.senders) - {"UCS"} or message.name in READINGS or self.scope.is_alarm(message, signal)
               for _, (message, signal) in pairs):
            return
        for name, (message, _) in pairs:
            if not message.senders:
                self.warning(name, f"nobody sends {message.name}, so the repair expects in vain", "name its sender in its BO_ line")
            else:
                self.warning(name, f"only UCS sends {message.name}: that proves nothing", "expect what another node reports")

    def _own_message(self, name: Name) -> Message | None:
        message = self.scope.messages.get(name.text) if not name.owner else None
        own = [known.name for known in self.scope.messages.values() if known.sent_by_ucs]
        if message is None:
            self.error(name, f"there is no message `{name}`", similar.hint(str(name), own))
            return None
        if not message.sent_by_ucs:
            senders = " and ".join(message.senders) or "nobody"
            self.error(name, f"UCS may not send {name}: its sender is {senders}", "make UCS its sender, or send another one")
            return None
        return message

    def assignments(self, message: Message, assignments: Sequence[language.Assignment],
                    allow_argument: bool = False) -> dict[str, int | None]:
        """Raw values by signal; None for `$value`."""
        values: dict[str, int | None] = {}
        for assignment in assignments:
            name = assignment.signal.text
            signal = next((known for known in message.signals if known.name == name), None)
            if signal is None:
                self.error(assignment.signal, f"message {message.name} has no signal `{name}`",
                           similar.hint(name, [known.name for known in message.signals]))
            elif name in values:
                self.error(assignment.signal, f"`{name}` is set twice")
            elif self.scope.is_alarm(message, signal):
                self.error(assignment.signal, f"`{name}` is an alarm: only its own condition sets it")
            elif isinstance(assignment.value, language.Argument):
                self._check_argument(assignment.value, allow_argument)
                values[name] = None
            else:
                values[name] = self._raw(signal, assignment.value)
        return values

    def _check_argument(self, syntax: Syntax, allowed: bool) -> None:
        if not allowed:
            self.error(syntax, "`$value` belongs to the attribute Commands only", "write a number or a value name")

    def _raw(self, signal: Signal, syntax: Syntax) -> int:
        if isinstance(syntax, Name | language.Quoted):
            return self._named_raw(signal, syntax)
        if isinstance(syntax, language.BooleanText):
            value = Fraction(int(syntax.value))
        else:
            assert isinstance(syntax, language.NumberText)
            value = Fraction(syntax.value)
        return self._physical_raw(signal, value, syntax)

    def _named_raw(self, signal: Signal, syntax: Name | language.Quoted) -> int:
        text = str(syntax) if isinstance(syntax, Name) else syntax.text
        raws = [raw for raw, name in signal.choices.items() if name == text]
        if len(raws) == 1:
            return self._fitting(signal, raws[0], syntax)
        if raws:
            self.error(syntax, f"`{text}` names {len(raws)} values of {signal.name}", "write the number instead")
        elif signal.choices:
            listed = ", ".join(map(_as_written, signal.choices.values()))
            self.error(syntax, f"`{text}` is no value of {signal.name}",
                       f"{similar.hint(text, signal.choices.values())} its values are {listed}".strip())
        else:
            self.error(syntax, f"{signal.name} has no value names", "write a number")
        return 0

    def _physical_raw(self, signal: Signal, value: Fraction, syntax: Syntax) -> int:
        for limit, beyond in ((signal.minimum, -1), (signal.maximum, 1)):
            if limit is not None and (value - Fraction(limit)) * beyond > 0:
                word = "below the minimum" if beyond < 0 else "above the maximum"
                self.error(syntax, f"{plain(value)} is {word} of {signal.name}, {limit} {signal.unit}".rstrip())
                return 0
        if not signal.factor:
            return 0
        raw = (value - Fraction(signal.offset)) / Fraction(signal.factor)
        if signal.is_float:
            return self._float_raw(signal, raw, syntax)
        if raw.denominator != 1:
            near = physical(signal, round(raw))
            self.error(syntax, f"{plain(value)} is no step of {signal.name}", f"the nearest is {plain(near)}")
            return 0
        return self._fitting(signal, int(raw), syntax)

    def _float_raw(self, signal: Signal, raw: Fraction, syntax: Syntax) -> int:
        try:
            return float_bits(float(raw), signal.length)
        except (OverflowError, KeyError):
            self.error(syntax, f"doesn't fit the {signal.length} bits of {signal.name}")
            return 0

    def _fitting(self, signal: Signal, raw: int, syntax: Syntax) -> int:
        low, high = raw_range(signal)
        if not low <= raw <= high and not signal.is_float:
            self.error(syntax, f"raw value {raw} doesn't fit the {signal.length} bits of {signal.name}", f"{low} to {high}")
        return raw


# -- the functions ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FunctionSpec:
    """A function of the language: how it is written, how many arguments it takes, what it means, how it is resolved."""

    usage: str
    fewest: int
    most: int
    meaning: str
    resolve: Callable[[_Resolution, language.Call], Typed]


def _age(resolution: _Resolution, call: language.Call) -> Typed:
    message = resolution.message_argument(call)
    if message:
        return Typed("elapsed", elapsed=("age", message.name, ""))
    pair = resolution.signal_argument(call)
    return Typed("elapsed", elapsed=("age", pair[0].name, pair[1].name)) if pair else UNKNOWN


def _held(resolution: _Resolution, call: language.Call) -> Typed:
    pair = resolution.signal_argument(call)
    return Typed("elapsed", elapsed=("held", pair[0].name, pair[1].name)) if pair else UNKNOWN


def _rate(resolution: _Resolution, call: language.Call) -> Typed:
    pair = resolution.signal_argument(call)
    if pair is None:
        return UNKNOWN
    unit = f"{pair[1].unit}/s" if pair[1].unit else ""
    return Typed("number", Rate(pair[0].name, pair[1].name), unit=unit)


def _silent(resolution: _Resolution, call: language.Call) -> Typed:
    message = resolution.message_argument(call)
    if message is None:
        name = call.arguments[0]
        return resolution.error(name, "silent takes a message" + (f", `{name}` is none" if isinstance(name, Name) else ""),
                                _message_hint(resolution.scope, name))
    if len(call.arguments) == 2:
        limit = resolution.duration_argument(call, 1)
        if limit is None:
            return UNKNOWN
        _check_silence(resolution, call, message, limit)
        return Typed("boolean", Silent(message.name, limit))
    if message.cycle_ns is None:
        return resolution.error(call, f"{message.name} has no cycle time, so silence needs a limit",
                                f"write silent({message.name}, 1 s) or set GenMsgCycleTime")
    return Typed("boolean", Silent(message.name, STALE_CYCLES * message.cycle_ns))


def _check_silence(resolution: _Resolution, call: language.Call, message: Message, limit_ns: int) -> None:
    if message.cycle_ns is None:
        resolution.warning(call, f"{message.name} has no cycle time: silence may be normal", "set GenMsgCycleTime")
    elif limit_ns <= message.cycle_ns:
        resolution.error(call.arguments[1], f"{message.name} comes every {message.cycle_ns / 1_000_000:g} ms, so it would count "
                         "as silent between two frames", f"at least {STALE_CYCLES * message.cycle_ns / 1_000_000:g} ms")


def _message_hint(scope: Scope, syntax: Syntax) -> str:
    if not isinstance(syntax, Name):
        return f"write {FUNCTIONS['silent'].usage}"
    pair = scope.only(syntax)
    return f"write silent({pair[0].name})" if pair else similar.hint(str(syntax), scope.messages)


def _integrity(kind: Literal["corrupt", "frozen"]) -> Callable[[_Resolution, language.Call], Typed]:
    def resolve(resolution: _Resolution, call: language.Call) -> Typed:
        message = resolution.message_argument(call)
        if message is None:
            return resolution.error(call.arguments[0], f"{kind} takes a message", f"write {FUNCTIONS[kind].usage}")
        wanted = ("Counter",) if kind == "frozen" else ("Counter", "Checksum")
        if not any(signal.role in wanted for signal in message.signals):
            return resolution.error(call.arguments[0], f"{message.name} has no {' or '.join(wanted).lower()} to tell it by",
                                    "set the attribute Role on the signal that is one")
        return Typed("boolean", Quality(kind, message.name, ""))
    return resolve


def _quality(kind: Literal["error", "unavailable", "never"]) -> Callable[[_Resolution, language.Call], Typed]:
    def resolve(resolution: _Resolution, call: language.Call) -> Typed:
        message = resolution.message_argument(call)
        if message and kind == "never":
            return Typed("boolean", Quality(kind, message.name, ""))
        if message:
            return resolution.error(call.arguments[0], f"{kind} takes a signal, {message.name} is a message",
                                    f"write {kind}({message.name}.SignalName)")
        pair = resolution.signal_argument(call)
        return Typed("boolean", Quality(kind, pair[0].name, pair[1].name)) if pair else UNKNOWN
    return resolve


def _state(resolution: _Resolution, call: language.Call) -> Typed:
    alarm = resolution.alarm_argument(call)
    return Typed("number", AlarmState(alarm), whole=True, alarm=alarm) if alarm else UNKNOWN


def _count(resolution: _Resolution, call: language.Call) -> Typed:
    alarm, window = resolution.alarm_argument(call), resolution.duration_argument(call, 1)
    return Typed("number", Count(alarm, window), whole=True) if alarm and window else UNKNOWN


def _dtc(resolution: _Resolution, call: language.Call) -> Typed:
    spn = resolution.whole_argument(call, 0, MAX_SPN)
    fmi = resolution.whole_argument(call, 1, MAX_FMI) if len(call.arguments) == 2 else None
    return UNKNOWN if spn is None else Typed("boolean", TroubleCode(spn, fmi))


def _bits(resolution: _Resolution, call: language.Call) -> Typed:
    typed = resolution.number_argument(call.arguments[0])
    if typed.node is None:
        return UNKNOWN
    if not typed.whole:
        return resolution.error(call.arguments[0], "bits needs a whole number", "use a signal whose factor and offset are whole")
    if typed.value is not None:
        return _constant(Fraction(int(typed.value).bit_count()))
    return Typed("number", Function("bits", (typed.node,)), whole=True)


def _plain_function(name: Literal["abs", "min", "max"]) -> Callable[[_Resolution, language.Call], Typed]:
    folds: Mapping[str, Callable[[list[Fraction]], Fraction]] = {"abs": lambda v: abs(v[0]), "min": min, "max": max}

    def resolve(resolution: _Resolution, call: language.Call) -> Typed:
        typed = [resolution.number_argument(argument) for argument in call.arguments]
        nodes = tuple(part.node for part in typed if part.node)
        if len(nodes) < len(typed):
            return UNKNOWN
        constants = [part.value for part in typed if part.value is not None]
        if len(constants) == len(typed):
            return _constant(folds[name](constants))
        unit = next((part.unit for part in typed if part.unit), "")
        return Typed("number", Function(name, nodes), whole=all(part.whole for part in typed), unit=unit)
    return resolve


FUNCTIONS: Mapping[str, FunctionSpec] = {
    "abs": FunctionSpec("abs(number)", 1, 1, "amount without sign", _plain_function("abs")),
    "min": FunctionSpec("min(number, number, …)", 2, 16, "the smallest", _plain_function("min")),
    "max": FunctionSpec("max(number, number, …)", 2, 16, "the largest", _plain_function("max")),
    "bits": FunctionSpec("bits(number)", 1, 1, "how many bits are set", _bits),
    "age": FunctionSpec("age(Signal or Message) > 500 ms", 1, 1, "time since it was last received", _age),
    "held": FunctionSpec("held(Signal) > 2 s", 1, 1, "time since its value last changed", _held),
    "rate": FunctionSpec("rate(Signal)", 1, 1, "change per second", _rate),
    "silent": FunctionSpec("silent(Message) or silent(Message, 1 s)", 1, 2, "the message does not come any more", _silent),
    "count": FunctionSpec("count(Alarm, 10 min)", 2, 2, "how often it was raised in that time", _count),
    "state": FunctionSpec("state(Alarm) == Active", 1, 1, "Normal, Active, Repairing or LockedOut", _state),
    "error": FunctionSpec("error(Signal)", 1, 1, "its last sample is invalid", _quality("error")),
    "unavailable": FunctionSpec("unavailable(Signal)", 1, 1, "its sender says that it has no value", _quality("unavailable")),
    "never": FunctionSpec("never(Signal or Message)", 1, 1, "it was never received", _quality("never")),
    "corrupt": FunctionSpec("corrupt(Message)", 1, 1, "its checksum is wrong or its counter stepped back", _integrity("corrupt")),
    "frozen": FunctionSpec("frozen(Message)", 1, 1, "its counter stands still", _integrity("frozen")),
    "dtc": FunctionSpec("dtc(SPN) or dtc(SPN, FMI)", 1, 2, "that J1939 trouble code is active", _dtc),
}
"""Every function of the language."""


# -- values -------------------------------------------------------------------------------------------------------------

_FOLD: Mapping[str, Callable[[Fraction, Fraction], Fraction]] = {
    "+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b, "/": lambda a, b: a / b}


def _constant(value: Fraction) -> Typed:
    number = exact_decimal(value)
    node: Expression = Number(number) if number is not None else Arithmetic(
        "/", Number(Decimal(value.numerator)), Number(Decimal(value.denominator)))
    return Typed("number", node, value=value, whole=value.denominator == 1)


def _arithmetic(op: str, left: Expression, right: Expression) -> Arithmetic:
    return Arithmetic(op, left, right)  # type: ignore[arg-type]  # the grammar knows no other operators


def _compare(op: str, left: Expression, right: Expression) -> Compare:
    return Compare(op, left, right)  # type: ignore[arg-type]  # the grammar knows no other operators


def _holds(op: str, left: Fraction, right: Fraction) -> bool:
    return {"==": left == right, "!=": left != right, "<": left < right, "<=": left <= right, ">": left > right,
            ">=": left >= right}[op]


def _is_whole(number: Decimal) -> bool:
    return Fraction(number).denominator == 1


def _is_flag(message: Message, signal: Signal) -> bool:
    """Whether it can stand as a condition: one bit, or only 0 and 1 valid and no value table that says otherwise."""
    if signal.is_float or signal.factor != 1 or signal.offset != 0 or signal.signed:
        return False
    if signal.length == 1:
        return True
    limited = signal.minimum == 0 and signal.maximum == 1
    return not signal.choices and (limited or (message.j1939 and signal.length == 2))


def _reach_hint(message: Message, signal: Signal, limit: Fraction) -> str:
    """What to write instead of a comparison with a value that never counts as good."""
    raw = (limit - Fraction(signal.offset)) / Fraction(signal.factor)
    low, high = raw_range(signal)
    if signal.is_float or not low <= raw <= high:
        return ""
    if raw.denominator != 1:
        return f"it comes in steps of {signal.factor}"
    for first, last, quality in reserved(signal) if message.j1939 else ():
        if first <= raw <= last:
            word = "unavailable" if quality == UNAVAILABLE else "error"
            return f"J1939 reserves that value: write {word}({message.name}.{signal.name})"
    if limit not in reach.signal_interval(message, signal):
        return f"values beyond the signal's limits count as error: widen them or write error({message.name}.{signal.name})"
    return ""


def _given(values: Mapping[str, int | None]) -> dict[str, int]:
    return {name: value for name, value in values.items() if value is not None}


def _as_written(name: str) -> str:
    return name if name.replace("_", "a").isalnum() and not name[:1].isdigit() else f"'{name}'"


def _describe(typed: Typed) -> str:
    if typed.elapsed:
        return f"{typed.elapsed[0]}(…)"
    return {"number": "a number", "boolean": "a condition", "duration": "a duration"}.get(typed.kind, "this")


def _condition_hint(syntax: Syntax, typed: Typed) -> str:
    if typed.elapsed:
        return "compare it with a duration: > 500 ms"
    if typed.alarm:
        return f"write {typed.alarm} == Active"
    if typed.signal and typed.signal[1].choices:
        return f"compare it: {syntax} == {_as_written(next(iter(typed.signal[1].choices.values())))}"
    return f"compare it: {syntax} != 0" if isinstance(syntax, Name) else "compare it with something"


def _number_hint(typed: Typed) -> str:
    if typed.kind == "duration":
        return "durations belong to age, held, silent, count, wait and within"
    return "compare first, then join with and/or" if typed.kind == "boolean" else "it can only be compared with a duration"


def _comparison_hint(typed: Typed) -> str:
    if typed.kind == "duration":
        return "only age(x) and held(x) are compared with durations"
    return "join conditions with and/or/not"
