"""The alarm language as written: text of an attribute -> syntax tree with columns (DESIGN §3). Grammar: `language.lark`.

This step knows no signals; `level1.resolver` gives names and types to the tree. Every node knows where it stands:
`start` and `end` are offsets into the text, so that every later error can show its column.
"""
from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from importlib import resources
from typing import Any

from lark import Lark, Token, UnexpectedInput, v_args
from lark.exceptions import UnexpectedToken, VisitError
from lark.tree import Meta
from lark.visitors import Transformer_NonRecursive

MAX_TEXT = 10_000
"""Characters of one condition or repair; the longest shipped one has a few hundred."""
MAX_DEPTH = 60
"""Nested parts of a condition: every later step walks the tree by recursion."""
MAX_DIGITS = 40
"""Characters of a number; exact arithmetic on it must stay cheap."""
MAX_EXPONENT = 40
"""Largest power of ten a number may carry, for the same reason."""

UNITS_NS = {"us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000, "h": 3_600_000_000_000}
"""Units a duration may have, in nanoseconds."""


class LanguageError(Exception):
    """A text that is not in the language. column: 1-based, in the text. hint: what to write instead."""

    def __init__(self, column: int, message: str, hint: str = ""):
        super().__init__(message)
        self.column = column
        self.message = message
        self.hint = hint


@dataclass(frozen=True, slots=True)
class Syntax:
    """A part of a text: offsets of its first character and behind its last."""

    start: int
    end: int

    @property
    def column(self) -> int:
        """1-based column of the first character."""
        return self.start + 1


@dataclass(frozen=True, slots=True)
class Name(Syntax):
    """`Signal`, `Message`, `Message.Signal`, or a value-table name. owner: what stands before the dot, or ""."""

    text: str
    owner: str = ""

    def __str__(self) -> str:
        return f"{self.owner}.{self.text}" if self.owner else self.text


@dataclass(frozen=True, slots=True)
class Quoted(Syntax):
    """A value-table name in single quotes."""

    text: str


@dataclass(frozen=True, slots=True)
class NumberText(Syntax):
    """A number, exactly as written."""

    value: Decimal


@dataclass(frozen=True, slots=True)
class Duration(Syntax):
    """A duration with its unit, in nanoseconds."""

    ns: int


@dataclass(frozen=True, slots=True)
class BooleanText(Syntax):
    """`true` or `false`."""

    value: bool


@dataclass(frozen=True, slots=True)
class Argument(Syntax):
    """`$value`: what a command carries."""


@dataclass(frozen=True, slots=True)
class Call(Syntax):
    """`function(argument, …)`."""

    function: str
    arguments: tuple[Syntax, ...]


@dataclass(frozen=True, slots=True)
class Minus(Syntax):
    """Unary minus."""

    item: Syntax


@dataclass(frozen=True, slots=True)
class Binary(Syntax):
    """`left op right` with op one of `+ - * / & |`; op_start: offset of the operator."""

    op: str
    op_start: int
    left: Syntax
    right: Syntax


@dataclass(frozen=True, slots=True)
class Comparison(Syntax):
    """`left op right` with op one of `== != < <= > >=`."""

    op: str
    left: Syntax
    right: Syntax


@dataclass(frozen=True, slots=True)
class Negation(Syntax):
    """`not item`."""

    item: Syntax


@dataclass(frozen=True, slots=True)
class Junction(Syntax):
    """`item and item …` or `item or item …`; op is `and` or `or`."""

    op: str
    items: tuple[Syntax, ...]


@dataclass(frozen=True, slots=True)
class Assignment(Syntax):
    """`Signal=value` of a command message."""

    signal: Name
    value: Syntax


@dataclass(frozen=True, slots=True)
class Send(Syntax):
    """`send MESSAGE(Signal=value, …)`."""

    message: Name
    assignments: tuple[Assignment, ...]


@dataclass(frozen=True, slots=True)
class Resend(Syntax):
    """`resend MESSAGE`."""

    message: Name


@dataclass(frozen=True, slots=True)
class Wait(Syntax):
    """`wait 30 s`."""

    duration: Duration


@dataclass(frozen=True, slots=True)
class Expect(Syntax):
    """`expect CONDITION within 3 s`."""

    condition: Syntax
    within: Duration


@dataclass(frozen=True, slots=True)
class CommandText(Syntax):
    """`name: Signal=value, …`."""

    name: Name
    assignments: tuple[Assignment, ...]


def parse_condition(text: str) -> Syntax:
    """The tree of a condition. Raises LanguageError."""
    tree: Syntax = _parse("condition", text)
    return tree


def parse_steps(text: str) -> tuple[Syntax, ...]:
    """The steps of a repair. Raises LanguageError."""
    steps: tuple[Syntax, ...] = _parse("steps", text)
    return steps


def parse_commands(text: str) -> tuple[CommandText, ...]:
    """The commands of a message. Raises LanguageError."""
    commands: tuple[CommandText, ...] = _parse("commands", text)
    return commands


def children(node: Syntax) -> tuple[Syntax, ...]:
    """The parts directly inside a node."""
    match node:
        case Call(arguments=parts) | Junction(items=parts):
            return parts
        case Minus(item=part) | Negation(item=part):
            return (part,)
        case Binary(left=left, right=right) | Comparison(left=left, right=right):
            return left, right
        case Expect(condition=part):
            return (part,)
    return ()


def names(node: Syntax) -> Iterator[Name]:
    """Every name in a node, in the order of the text."""
    if isinstance(node, Name):
        yield node
    for part in children(node):
        yield from names(part)


class _ChainedError(Exception):
    """A comparison of comparisons: `parts` are its operands and operators in turn."""

    def __init__(self, parts: Sequence[Any]):
        super().__init__()
        self.parts = parts


class _Builder(Transformer_NonRecursive[Token, Any]):
    """Makes the nodes, without recursion, so that no text can exhaust the stack."""

    @v_args(meta=True)
    def name(self, meta: Meta, words: list[Token]) -> Name:
        owner = str(words[0]) if len(words) == 2 else ""
        return Name(meta.start_pos, meta.end_pos, str(words[-1]), owner)

    @v_args(meta=True)
    def quoted(self, meta: Meta, words: list[Token]) -> Quoted:
        return Quoted(meta.start_pos, meta.end_pos, str(words[0])[1:-1])

    @v_args(meta=True)
    def number(self, meta: Meta, words: list[Token]) -> NumberText:
        return NumberText(meta.start_pos, meta.end_pos, _number(words[0]))

    @v_args(meta=True)
    def signed_number(self, meta: Meta, words: list[Token]) -> NumberText:
        value = _number(words[-1])
        return NumberText(meta.start_pos, meta.end_pos, value.copy_negate() if len(words) == 2 else value)

    @v_args(meta=True)
    def duration(self, meta: Meta, words: list[Token]) -> Duration:
        nanoseconds = _number(words[0]) * UNITS_NS[words[1]]
        if nanoseconds != int(nanoseconds) or nanoseconds > 10**18:
            raise LanguageError(meta.start_pos + 1, f"`{words[0]} {words[1]}` is no usable duration",
                                "whole nanoseconds, at most 30 years")
        return Duration(meta.start_pos, meta.end_pos, int(nanoseconds))

    @v_args(meta=True)
    def true(self, meta: Meta, _: list[Token]) -> BooleanText:
        return BooleanText(meta.start_pos, meta.end_pos, True)

    @v_args(meta=True)
    def false(self, meta: Meta, _: list[Token]) -> BooleanText:
        return BooleanText(meta.start_pos, meta.end_pos, False)

    @v_args(meta=True)
    def call(self, meta: Meta, parts: list[Any]) -> Call:
        return Call(meta.start_pos, meta.end_pos, str(parts[0]), tuple(parts[1:]))

    @v_args(meta=True)
    def minus(self, meta: Meta, parts: list[Any]) -> Syntax:
        if isinstance(parts[1], NumberText):
            return NumberText(meta.start_pos, meta.end_pos, parts[1].value.copy_negate())
        return Minus(meta.start_pos, meta.end_pos, parts[1])

    def _arithmetic(self, parts: list[Any]) -> Syntax:
        left: Syntax = parts[0]
        for operator, right in zip(parts[1::2], parts[2::2], strict=True):
            left = Binary(left.start, right.end, str(operator), operator.start_pos, left, right)
        return left

    bit_or = bit_and = sum = product = _arithmetic

    def comparison(self, parts: list[Any]) -> Syntax:
        if len(parts) > 3:
            raise _ChainedError(parts)
        left, operator, right = parts
        return Comparison(left.start, right.end, str(operator), left, right)

    @v_args(meta=True)
    def negation(self, meta: Meta, parts: list[Any]) -> Syntax:
        return Negation(meta.start_pos, parts[0].end, parts[0])

    def conjunction(self, parts: list[Any]) -> Syntax:
        return Junction(parts[0].start, parts[-1].end, "and", tuple(parts))

    def disjunction(self, parts: list[Any]) -> Syntax:
        return Junction(parts[0].start, parts[-1].end, "or", tuple(parts))

    def condition(self, parts: list[Any]) -> Syntax:
        node: Syntax = parts[0]
        return node

    @v_args(meta=True)
    def assignment(self, meta: Meta, parts: list[Any]) -> Assignment:
        signal, value = parts
        name = Name(signal.start_pos, signal.end_pos, str(signal))
        return Assignment(meta.start_pos, meta.end_pos, name, _value(value))

    @v_args(meta=True)
    def send(self, meta: Meta, parts: list[Any]) -> Send:
        return Send(meta.start_pos, meta.end_pos, parts[0], tuple(parts[1:]))

    @v_args(meta=True)
    def resend(self, meta: Meta, parts: list[Any]) -> Resend:
        return Resend(meta.start_pos, meta.end_pos, parts[0])

    @v_args(meta=True)
    def wait(self, meta: Meta, parts: list[Any]) -> Wait:
        return Wait(meta.start_pos, meta.end_pos, parts[0])

    @v_args(meta=True)
    def expect(self, meta: Meta, parts: list[Any]) -> Expect:
        return Expect(meta.start_pos, meta.end_pos, parts[0], parts[1])

    def steps(self, parts: list[Any]) -> tuple[Syntax, ...]:
        return tuple(parts)

    @v_args(meta=True)
    def command(self, meta: Meta, parts: list[Any]) -> CommandText:
        name = Name(parts[0].start_pos, parts[0].end_pos, str(parts[0]))
        return CommandText(meta.start_pos, meta.end_pos, name, tuple(parts[1:]))

    def commands(self, parts: list[Any]) -> tuple[Syntax, ...]:
        return tuple(parts)


def _value(value: Syntax | Token) -> Syntax:
    if isinstance(value, Syntax):
        return value
    start, end = int(value.start_pos or 0), int(value.end_pos or 0)
    if value.type == "QUOTED":
        return Quoted(start, end, str(value)[1:-1])
    if value.type == "ARGUMENT":
        return Argument(start, end)
    return BooleanText(start, end, value.type == "TRUE")


def _number(token: Token) -> Decimal:
    column = int(token.start_pos or 0) + 1
    if len(token) > MAX_DIGITS:
        raise LanguageError(column, f"number with more than {MAX_DIGITS} characters")
    value = Decimal(int(token, 16)) if token[:2].lower() == "0x" else Decimal(str(token))
    if value and abs(value.adjusted()) > MAX_EXPONENT:
        raise LanguageError(column, f"`{token}` is out of any sensible range", f"at most 1e{MAX_EXPONENT}")
    return value


@cache
def _parser() -> Lark:
    grammar = resources.files("level1").joinpath("language.lark").read_text(encoding="utf-8")
    return Lark(grammar, parser="lalr", start=["condition", "steps", "commands"], propagate_positions=True,
                maybe_placeholders=False)


def _parse(start: str, text: str) -> Any:
    if len(text) > MAX_TEXT:
        raise LanguageError(MAX_TEXT, f"longer than {MAX_TEXT} characters", "split it over several alarms")
    try:
        result = _Builder().transform(_parser().parse(text, start=start))
    except UnexpectedInput as error:
        raise _syntax_error(text, error) from None
    except VisitError as error:
        if isinstance(error.orig_exc, _ChainedError):
            raise _unchained(text, error.orig_exc.parts) from None
        raise error.orig_exc from None
    for node in result if isinstance(result, tuple) else (result,):
        _check_depth(node)
    return result


def _check_depth(node: Syntax) -> None:
    level = [node]
    for _ in range(MAX_DEPTH):
        level = [part for parent in level for part in children(parent)]
        if not level:
            return
    raise LanguageError(node.column, f"nested more than {MAX_DEPTH} deep", "use fewer terms")


def _unchained(text: str, parts: Sequence[Any]) -> LanguageError:
    first, second, third = (text[part.start:part.end] for part in parts[:5:2])
    whole = f"{first} {parts[1]} {second} and {second} {parts[3]} {third}"
    hint = f"write `{whole}`" if whole.count("(") == whole.count(")") else "join two comparisons with `and`"
    return LanguageError(parts[3].start_pos + 1, "comparisons can't be chained", hint)


_HINTS: tuple[tuple[str, str], ...] = (
    (r".*&\0&", "write `and`"),
    (r".*\|\0\|", "write `or`"),
    (r".*\0!", "write `not`"),
    (r".*<\0>", "write `!=`"),
    (r".*(?:=\0=|!=\0=)", "write `==` or `!=`"),
    (r".*\0=", "compare with `==`"),
    (r".*\0AND\b", "write `and` in small letters"),
    (r".*\0OR\b", "write `or` in small letters"),
    (r".*\0NOT\b", "write `not` in small letters"),
    (r".*\0(?:TRUE|True)\b", "write `true` in small letters"),
    (r".*\0\"", "put value names with blanks into single quotes: 'Not available'"),
    (r".*\0'", "the closing single quote is missing"),
    (r".*\d\0,\d", "decimals have a point: 0.5"),
    (r".*\d\s*\0[A-Za-z%°µ]", "units are us, ms, s, min and h; other numbers stand without unit, in the signal's own"),
    (r".*\0;", "conditions end without `;`"),
    (r".*\bwait\s*[\d.]+\s*\0", "durations carry a unit: 500 ms, 30 s, 10 min"),
    (r".*\0\)", "there are more `)` than `(`, or something is missing before this one"),
)
"""What a frequent slip looks like around the place of the error (\\0), and what to write instead."""

_STEP_HINT = "steps are `send MESSAGE(Signal=Value, …)`, `resend MESSAGE`, `wait 30 s`, `expect CONDITION within 3 s`"


def _syntax_error(text: str, error: UnexpectedInput) -> LanguageError:
    expected = _expected(error)
    at_end = isinstance(error, UnexpectedToken) and error.token.type == "$END"
    position = len(text.rstrip()) if at_end else int(error.pos_in_stream or 0)
    if not text.strip():
        return LanguageError(1, "is empty", "say when it holds")
    if at_end:
        missing = "`)`" if "RPAR" in expected and "NAME" not in expected else _in_words(expected)
        return LanguageError(position + 1, f"ends too early: {missing} is missing")
    found = _word_at(text, position)
    return LanguageError(position + 1, f"`{found}` can't stand here, {_in_words(expected)} is expected",
                         _hint(text, position, expected))


def _hint(text: str, position: int, expected: frozenset[str]) -> str:
    marked = f"{text[max(0, position - 40):position]}\0{text[position:position + 40]}"
    for pattern, hint in _HINTS:
        if re.match(pattern, marked, re.DOTALL):
            return hint
    return _STEP_HINT if "_SEND" in expected else ""


def _word_at(text: str, position: int) -> str:
    match = re.match(r"\w+|[=!<>]+|.", text[position:position + 40], re.DOTALL)
    return match.group() if match else ""


def _expected(error: UnexpectedInput) -> frozenset[str]:
    names = getattr(error, "accepts", None) or getattr(error, "expected", None) or getattr(error, "allowed", None)
    return frozenset(names or ())


_WORDS: tuple[tuple[str, str], ...] = (
    ("_SEND", "a step"), ("NUMBER", "a value"), ("NAME", "a name"), ("UNIT", "a unit (ms, s, min, h)"),
    ("ARGUMENT", "a value"), ("_WITHIN", "`within` and a duration"), ("COMPARISON", "an operator"), ("RPAR", "`)`"),
    ("EQUAL", "`=`"), ("COLON", "`:`"), ("LPAR", "`(`"), ("SEMICOLON", "`;` or the end"),
)
"""The most telling of the words the grammar would take, in order."""


def _in_words(expected: frozenset[str]) -> str:
    for word, meaning in _WORDS:
        if word in expected:
            return meaning
    return "`and`, `or` or the end" if "_AND" in expected else "the end"
