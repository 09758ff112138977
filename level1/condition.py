"""Conditions compiled to closures over the cells of the board.

Every part of a condition that concerns one thing only (a signal against constants, a silence, a quality, the state of an
alarm) becomes a table with a verdict for each class of that thing, so that evaluating it is one look-up. Arithmetic over
several signals is evaluated on their values, or is STALE or ERROR as the worst of them. Verdicts combine as in Kleene's
three-valued logic, with ERROR the stronger of the two unknowns.
"""
from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from decimal import Decimal
from enum import IntEnum
from fractions import Fraction
from typing import Any, Literal

from level1.board import BAD, Board, Cell
from level1.decode import CORRUPT, ERROR, FROZEN, GOOD, NEVER, OLD, SHORT, UNAVAILABLE
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
    TroubleCode,
)


class Verdict(IntEnum):
    """What a condition says (DESIGN §4). STALE and ERROR neither raise, clear nor reset anything."""

    FALSE = 0
    TRUE = 1
    STALE = 2
    ERROR = 3


class Zone(IntEnum):
    """What the conditions of an alarm say together; all that its automaton ever sees of them.

    CLEAR: the until-condition holds, or the alarm is suppressed. RAISE: the when-condition holds. NEITHER: between the two.
    """

    CLEAR = 0
    RAISE = 1
    STALE = 2
    ERROR = 3
    NEITHER = 4


F, T, S, E = Verdict.FALSE.value, Verdict.TRUE.value, Verdict.STALE.value, Verdict.ERROR.value


def kleene_and(a: int, b: int) -> int:
    """FALSE if either is; else the worst of the two."""
    return F if F in (a, b) else max(a, b)


def kleene_or(a: int, b: int) -> int:
    """TRUE if either is; else the worst of the two."""
    return T if T in (a, b) else max(a, b)


AND = bytes(kleene_and(a, b) for a in range(4) for b in range(4))
OR = bytes(kleene_or(a, b) for a in range(4) for b in range(4))
NOT = bytes((T, F, S, E))

Operator = Literal["==", "!=", "<", "<=", ">", ">="]
COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq, "!=": operator.ne, "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}
MIRRORED: dict[Operator, Operator] = {"==": "==", "!=": "!=", "<": ">", "<=": ">=", ">": "<", ">=": "<="}


def walk(expression: Expression | None) -> Iterator[Expression]:
    """Every node of a condition, the outer ones first."""
    if expression is None:
        return
    yield expression
    for child in children(expression):
        yield from walk(child)


def children(node: Expression) -> tuple[Expression, ...]:
    """The direct parts of a node."""
    match node:
        case Arithmetic(left=left, right=right) | Compare(left=left, right=right):
            return (left, right)
        case Function(arguments=arguments):
            return arguments
        case Not(item=item):
            return (item,)
        case And(items=items) | Or(items=items):
            return items
        case _:
            return ()


def constant(node: Expression) -> Decimal | None:
    """The value of a numeric constant, else None."""
    if isinstance(node, Number):
        return node.value
    if isinstance(node, Function) and node.name == "neg" and isinstance(node.arguments[0], Number):
        return -node.arguments[0].value
    return None


def single(node: Compare) -> tuple[SignalValue | AlarmState, Operator, Decimal] | None:
    """A comparison of one thing with a constant as (thing, operator, constant); None for any other comparison."""
    right, left = constant(node.right), constant(node.left)
    if isinstance(node.left, (SignalValue, AlarmState)) and right is not None:
        return node.left, node.op, right
    if isinstance(node.right, (SignalValue, AlarmState)) and left is not None:
        return node.right, MIRRORED[node.op], left
    return None


class Thresholds:
    """First pass over all conditions: which signals are in use, against which constants, which silences are watched."""

    def __init__(self, board: Board, things: Things):
        self.board = board
        self.things = things
        self.constants: dict[str, set[Decimal]] = {}

    def add(self, node: Expression) -> None:
        """Note what a condition asks for."""
        match node:
            case Compare() if (atom := single(node)) is not None:
                if isinstance(atom[0], SignalValue):
                    cell = self.board.cell(atom[0].message, atom[0].signal)
                    self.constants.setdefault(cell.name, set()).add(atom[2])
                else:
                    self.things.alarm(atom[0].alarm)
                return
            case SignalValue(message=message, signal=signal):
                self.board.cell(message, signal).exact = True
            case Rate(message=message, signal=signal):
                self.board.rate(message, signal)
            case Quality(message=message, signal=signal):
                if signal:
                    self.board.cell(message, signal)
                else:
                    self.board.page(message)
            case Silent(message=message, limit_ns=limit):
                self.board.page(message).limits.append(limit)
            case Elapsed():
                self._elapsed(node)
            case AlarmState(alarm=alarm):
                self.things.alarm(alarm)
            case Count(alarm=alarm, window_ns=window):
                self.things.count(alarm, window)
            case TroubleCode(spn=spn, fmi=fmi):
                self.things.trouble_code(spn, fmi)
            case _:
                pass
        for child in children(node):
            self.add(child)

    def _elapsed(self, node: Elapsed) -> None:
        limit = elapsed_limit(node)
        if node.kind == "held":
            limits = self.board.held(node.message, node.signal).limits
        elif node.signal:
            limits = self.board.cell(node.message, node.signal).page.limits
        else:
            limits = self.board.page(node.message).limits
        if limit not in limits:
            limits.append(limit)


def elapsed_limit(node: Elapsed) -> int:
    """The moment at which the comparison changes, ns after the sample or change: `>` holds one nanosecond after `>=` does."""
    return node.limit_ns + (1 if node.op in (">", "<=") else 0)


class Things:
    """Cells for what is not a signal: states and counts of alarms, trouble codes. The supervisor moves them."""

    def __init__(self) -> None:
        self.alarms: dict[str, Cell] = {}
        self.counts: dict[tuple[str, int], Cell] = {}
        self.codes: dict[tuple[int, int | None], Cell] = {}

    def alarm(self, name: str) -> Cell:
        """Class = raw value of the alarm signal, 0–3; also a number for arithmetic."""
        if name not in self.alarms:
            cell = self.alarms[name] = Cell(name, 0)
            cell.bad = 0
        return self.alarms[name]

    def count(self, alarm: str, window_ns: int) -> Cell:
        """Value = number of activations within the window."""
        if (alarm, window_ns) not in self.counts:
            cell = self.counts[alarm, window_ns] = Cell(f"count({alarm})", 0)
            cell.bad = 0
        return self.counts[alarm, window_ns]

    def trouble_code(self, spn: int, fmi: int | None) -> Cell:
        """Class 0 not reported, 1 reported, 2 no trouble code message received yet."""
        return self.codes.setdefault((spn, fmi), Cell(f"dtc({spn})", 2))


class Compiler:
    """Second pass, when classes and limits are fixed: conditions to source, source to closures."""

    def __init__(self, board: Board, things: Things):
        self.board = board
        self.things = things
        self.names: dict[str, Any] = {"AND": AND, "OR": OR, "NOT": NOT}
        self.cells: list[Cell] = []

    def verdict(self, expression: Expression) -> tuple[Callable[[], int], tuple[Cell, ...]]:
        """A closure that gives the present verdict, and the cells whose moves may change it."""
        self.cells = []
        return self._function([f" return {self.boolean(expression)}"]), tuple(dict.fromkeys(self.cells))

    def zone(self, when: Expression, until: Expression | None,
             enabled: Expression | None) -> tuple[Callable[[], int], tuple[Cell, ...]]:
        """A closure that gives the present `Zone` of an alarm, and the cells whose moves may change it."""
        self.cells = []
        lines = []
        if enabled is not None:
            lines += [f" e = {self.boolean(enabled)}", f" if e != {T}: return e"]
        lines += [f" w = {self.boolean(when)}", " if w: return w"]
        if until is not None:
            lines += [f" return {Zone.CLEAR.value} if {self.boolean(until)} == {T} else {Zone.NEITHER.value}"]
        else:
            lines += [f" return {Zone.CLEAR.value}"]
        return self._function(lines), tuple(dict.fromkeys(self.cells))

    def _function(self, lines: list[str]) -> Callable[[], int]:
        scope: dict[str, Any] = {}
        exec(compile("def evaluate():\n" + "\n".join(lines), "<condition>", "exec"), self.names, scope)
        function: Callable[[], int] = scope["evaluate"]
        return function

    def _name(self, value: Any) -> str:
        name = f"v{len(self.names)}"
        self.names[name] = value
        return name

    def _table(self, cell: Cell, verdicts: list[int]) -> str:
        self.cells.append(cell)
        return f"{self._name(bytes(verdicts))}[{self._name(cell)}.k]"

    def boolean(self, node: Expression) -> str:
        """Source of an expression that gives a verdict number."""
        match node:
            case Boolean(value=value):
                return str(T if value else F)
            case Not(item=item):
                return f"NOT[{self.boolean(item)}]"
            case And(items=items):
                return self._chain("AND", items)
            case Or(items=items):
                return self._chain("OR", items)
            case Compare() if (atom := single(node)) is not None:
                return self._atom(*atom)
            case Compare():
                return self._comparison(node)
            case Quality():
                return self._quality(node)
            case Silent(message=message, limit_ns=limit):
                page = self.board.page(message)
                passed = page.limits.index(limit)
                return self._table(page.presence, [*(T if k > passed else F for k in range(len(page.limits) + 1)), S])
            case Elapsed():
                return self._elapsed(node)
            case TroubleCode(spn=spn, fmi=fmi):
                return self._table(self.things.trouble_code(spn, fmi), [F, T, S])
            case _:
                raise TypeError(f"not a condition: {node}")

    def _chain(self, table: str, items: tuple[Expression, ...]) -> str:
        source = self.boolean(items[0])
        for item in items[1:]:
            source = f"{table}[{source} << 2 | {self.boolean(item)}]"
        return source

    def _atom(self, thing: SignalValue | AlarmState, op: Operator, limit: Decimal) -> str:
        compare = COMPARE[op]
        if isinstance(thing, AlarmState):
            return self._table(self.things.alarm(thing.alarm), [int(compare(state, limit)) for state in range(4)])
        cell = self.board.cell(thing.message, thing.signal)
        if cell.exact:
            return self._comparison(Compare(op, thing, Number(limit)))
        factor, offset = Fraction(cell.signal.factor), Fraction(cell.signal.offset)
        verdicts = [BAD[quality] or int(compare(raw * factor + offset, Fraction(limit)))
                    for raw, quality in zip(cell.classes.sample, cell.classes.quality, strict=True)]
        return self._table(cell, verdicts + list(BAD))

    def _quality(self, node: Quality) -> str:
        if node.kind in ("corrupt", "frozen"):
            wanted = CORRUPT if node.kind == "corrupt" else FROZEN
            return self._table(self.board.page(node.message).integrity, _quality_table((wanted,), (NEVER, OLD)))
        if not node.signal:
            page = self.board.page(node.message)
            return self._table(page.presence, [F] * (len(page.limits) + 1) + [T])
        cell = self.board.cell(node.message, node.signal)
        table = QUALITY_TABLES[node.kind]
        return self._table(cell, [table[quality] for quality in cell.classes.quality] + list(table))

    def _elapsed(self, node: Elapsed) -> str:
        limit = elapsed_limit(node)
        if node.kind == "held":
            held = self.board.held(node.message, node.signal)
            limits, cell, unknown = held.limits, held.cell, [S, E]
        else:
            page = self.board.cell(node.message, node.signal).page if node.signal else self.board.page(node.message)
            limits, cell, unknown = page.limits, page.presence, [S]
        passed = limits.index(limit)
        after, before = (T, F) if node.op in (">", ">=") else (F, T)
        return self._table(cell, [*(after if k > passed else before for k in range(len(limits) + 1)), *unknown])

    def _comparison(self, node: Compare) -> str:
        first = len(self.cells)
        test = f"1 if {self.number(node.left)} {node.op} {self.number(node.right)} else 0"
        bad = " | ".join(f"{self._name(cell)}.bad" for cell in dict.fromkeys(self.cells[first:])) or "0"
        if any(isinstance(part, Arithmetic) and part.op == "/" for part in walk(node)):
            guarded = self._function([" try:", f"  return {test}", f" except (ZeroDivisionError, OverflowError): return {E}"])
            test = f"{self._name(guarded)}()"
        return f"(({bad}) or ({test}))"

    def number(self, node: Expression) -> str:
        """Source of an expression that gives a number; only to be evaluated when no cell in it is bad."""
        match node:
            case Number(value=value):
                return repr(int(value)) if value == value.to_integral_value() else repr(float(value))
            case SignalValue(message=message, signal=signal):
                return self._value(self.board.cell(message, signal))
            case Rate(message=message, signal=signal):
                return self._value(self.board.rate(message, signal).cell)
            case AlarmState(alarm=alarm):
                cell = self.things.alarm(alarm)
                self.cells.append(cell)
                return f"{self._name(cell)}.k"
            case Count(alarm=alarm, window_ns=window):
                return self._value(self.things.count(alarm, window))
            case Arithmetic(op=op, left=left, right=right):
                if op in "&|":
                    return f"(int({self.number(left)}) {op} int({self.number(right)}))"
                return f"({self.number(left)} {op} {self.number(right)})"
            case Function(name="neg", arguments=(argument,)):
                return f"(-{self.number(argument)})"
            case Function(name="bits", arguments=(argument,)):
                return f"int({self.number(argument)}).bit_count()"
            case Function(name=name, arguments=arguments):
                return f"{name}({', '.join(self.number(argument) for argument in arguments)})"
            case _:
                raise TypeError(f"not a number: {node}")

    def _value(self, cell: Cell) -> str:
        self.cells.append(cell)
        return f"{self._name(cell)}.value"


def _quality_table(true: tuple[int, ...], unknown: tuple[int, ...]) -> list[int]:
    return [T if q in true else S if q in unknown else F for q in (GOOD, UNAVAILABLE, ERROR, NEVER, OLD, SHORT, CORRUPT, FROZEN)]


QUALITY_TABLES = {
    "error": _quality_table((ERROR, SHORT, CORRUPT, FROZEN), (NEVER, OLD)),
    "unavailable": _quality_table((UNAVAILABLE,), (NEVER, OLD)),
    "never": _quality_table((NEVER,), ()),
}
"""Verdict of `error`, `unavailable` and `never` for each quality, by number."""
