"""Conditions compiled to functions over columns: the same tree, tables and order of operations as `condition`, on arrays.

Only what a condition asks of signals and silences has columns; `compile_zone` refuses everything else, and everything that
binary64 would not compute exactly as Python's integers and floats do. What it refuses stays with the closures.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from level1.board import Board, Cell
from level1.columns import EXACT_BITS, Column, Unsupported
from level1.condition import AND, NOT, OR, Compiler, E, T, Things, Zone
from level1.decode import raw_range
from level1.expression import Arithmetic, Compare, Expression, Function, Number, SignalValue

_LARGEST = 1 << EXACT_BITS


def _table(entries: bytes | list[int]) -> Any:
    return np.frombuffer(bytes(entries), np.uint8)


ZONE = _table([w or (Zone.CLEAR if u == T else Zone.NEITHER) for w in range(4) for u in range(4)])
"""Zone of an enabled alarm: row the verdict of its when-condition, column that of its until-condition."""


class ColumnCondition(NamedTuple):
    """zone(): the zones of an alarm at the slots its columns were last set to; an array, or one number for all. columns: what
    it reads. table: the zone for each class, where it reads the classes of one thing."""

    zone: Callable[[], Any]
    columns: tuple[Column, ...]
    table: Any = None


def compile_zone(board: Board, columns: Mapping[Cell, Column], when: Expression, until: Expression | None,
                 enabled: Expression | None) -> ColumnCondition:
    """The zone of an alarm as a function over columns. Raises Unsupported."""
    compiler = _ColumnCompiler(board, columns)
    zone, cells = compiler.zone(when, until, enabled)
    read = tuple(compiler.column(cell) for cell in cells)
    table = None
    if len(read) == 1 and not read[0].numeric:
        read[0].k = np.arange(compiler.classes)
        table = np.array(np.broadcast_to(zone(), read[0].k.shape))
    return ColumnCondition(zone, read, table)


class _ColumnCompiler(Compiler):
    """`Compiler` with arrays for bytes, columns for cells, and no short cuts: every part is evaluated everywhere."""

    def __init__(self, board: Board, columns: Mapping[Cell, Column]):
        super().__init__(board, Things())
        self.columns = columns
        self.classes = 0
        self.names = {"AND": _table(AND), "OR": _table(OR), "NOT": _table(NOT), "ZONE": ZONE, "where": np.where, "judge": judge,
                      "divide": divide, "whole": whole, "ones": ones, "least": least, "largest": largest, "absolute": np.abs}

    def column(self, cell: Cell) -> Column:
        """The column of a cell. Raises Unsupported for what has none."""
        if cell not in self.columns:
            raise Unsupported(f"{cell.name} has no column")
        return self.columns[cell]

    def zone(self, when: Expression, until: Expression | None,
             enabled: Expression | None) -> tuple[Callable[[], Any], tuple[Cell, ...]]:
        self.cells = []
        second = self.boolean(until) if until is not None else str(T)
        source = f"ZONE[{self.boolean(when)} << 2 | {second}]"
        if enabled is not None:
            self_enabled = self.boolean(enabled)
            source = f"where((e := {self_enabled}) == {T}, {source}, e)"
        return self._function([f" return {source}"]), tuple(dict.fromkeys(self.cells))

    def _name(self, value: Any) -> str:
        return super()._name(self.column(value) if isinstance(value, Cell) else value)

    def _table(self, cell: Cell, verdicts: list[int]) -> str:
        self.cells.append(cell)
        self.classes = len(verdicts)
        return f"{self._name(_table(verdicts))}[{self._name(cell)}.k]"

    def _comparison(self, node: Compare) -> str:
        for side in (node.left, node.right):
            _range(self, side)
        first = len(self.cells)
        test = f"{self.number(node.left)} {node.op} {self.number(node.right)}"
        bad = " | ".join(f"{self._name(cell)}.bad" for cell in dict.fromkeys(self.cells[first:])) or "0"
        return f"judge({bad}, lambda zeros: {test})"

    def number(self, node: Expression) -> str:
        match node:
            case Arithmetic(op="/", left=left, right=right):
                return f"divide({self.number(left)}, {self.number(right)}, zeros)"
            case Arithmetic(op=op, left=left, right=right) if op in "&|":
                return f"(whole({self.number(left)}) {op} whole({self.number(right)}))"
            case Function(name="abs", arguments=(argument,)):
                return f"absolute({self.number(argument)})"
            case Function(name="bits", arguments=(argument,)):
                return f"ones(whole({self.number(argument)}))"
            case Function(name=name, arguments=arguments) if name in ("min", "max"):
                return f"{'least' if name == 'min' else 'largest'}({', '.join(self.number(argument) for argument in arguments)})"
            case _:
                return super().number(node)

    def _value(self, cell: Cell) -> str:
        if not self.column(cell).numeric:
            raise Unsupported(f"the values of {cell.name} are too large")
        return super()._value(cell)


def judge(bad: Any, test: Callable[[list[Any]], Any]) -> Any:
    """Verdict of a comparison: the badness of its inputs, else ERROR where it divides by zero, else whether it holds."""
    zeros: list[Any] = []
    with np.errstate(all="ignore"):
        holds = test(zeros)
    verdict = np.asarray(holds).astype(np.uint8)
    for zero in zeros:
        verdict = np.where(zero, np.uint8(E), verdict)
    return np.where(bad, bad, verdict).astype(np.uint8)


def divide(left: Any, right: Any, zeros: list[Any]) -> Any:
    """The quotient; where the divisor is zero is noted in `zeros`."""
    zero = np.asarray(right) == 0
    zeros.append(zero)
    return np.true_divide(left, np.where(zero, 1, right))


def whole(values: Any) -> Any:
    """Integers, by leaving the fraction out."""
    return np.asarray(values).astype(np.int64)


def ones(values: Any) -> Any:
    """Number of set bits of the absolute value."""
    return np.bitwise_count(values).astype(np.int64)


def least(*values: Any) -> Any:
    """The smallest, each row."""
    return reduce(np.minimum, values)


def largest(*values: Any) -> Any:
    """The largest, each row."""
    return reduce(np.maximum, values)


class _Range(NamedTuple):
    """Bounds of a number. whole: whether Python may hold it as an integer (then it must stay within `_LARGEST`); mad: whether it
    may be no number at all, of which Python's `min` and numpy's make different things."""

    low: float
    high: float
    whole: bool
    mad: bool = False


def _range(compiler: _ColumnCompiler, node: Expression) -> _Range:
    """Bounds of a numeric expression. Raises Unsupported where arrays would compute it less exactly than Python."""
    match node:
        case Number(value=value):
            found = _Range(float(value), float(value), value == value.to_integral_value())
        case SignalValue(message=message, signal=signal):
            found = _signal_range(compiler.board.cell(message, signal))
        case Arithmetic(op=op, left=left, right=right):
            found = _arithmetic_range(op, _range(compiler, left), _range(compiler, right))
        case Function(name=name, arguments=arguments):
            found = _function_range(name, [_range(compiler, argument) for argument in arguments])
        case _:
            raise Unsupported("only signals have columns")
    if found.whole and max(-found.low, found.high) > _LARGEST:
        raise Unsupported("a number may become too large")
    return found


def _signal_range(cell: Cell) -> _Range:
    if cell.signal.is_float:
        return _Range(-math.inf, math.inf, False)
    ends = [float(cell.scale.physical(raw)) for raw in raw_range(cell.signal)]
    return _Range(min(ends), max(ends), cell.scale.denominator == 1)


def _arithmetic_range(op: str, left: _Range, right: _Range) -> _Range:
    both_whole = left.whole and right.whole
    if op in "&|":
        return _bits_range(left, right)
    endless = math.inf in (left.high, right.high, -left.low, -right.low)
    if endless or op == "/":
        return _Range(-math.inf, math.inf, False, endless)
    if op == "+":
        return _Range(left.low + right.low, left.high + right.high, both_whole)
    if op == "-":
        return _Range(left.low - right.high, left.high - right.low, both_whole)
    ends = [a * b for a in (left.low, left.high) for b in (right.low, right.high)]
    return _Range(min(ends), max(ends), both_whole)


def _bits_range(*operands: _Range) -> _Range:
    """Bounds of `&` and `|`: no more bits than the longest operand."""
    largest_end = max(max(abs(operand.low), abs(operand.high)) for operand in operands)
    if not largest_end < _LARGEST:
        raise Unsupported("bits of a number without bounds")
    end = float(1 << int(largest_end).bit_length())
    return _Range(-end, end, True)


def _function_range(name: str, operands: list[_Range]) -> _Range:
    first = operands[0]
    if name == "neg":
        return first._replace(low=-first.high, high=-first.low)
    if name == "abs":
        return first._replace(low=0, high=max(abs(first.low), abs(first.high)))
    if name == "bits":
        _bits_range(first)
        return _Range(0, EXACT_BITS, True)
    if any(operand.mad for operand in operands):
        raise Unsupported("the smallest of what may be no number")
    return _Range(min(operand.low for operand in operands), max(operand.high for operand in operands),
                  any(operand.whole for operand in operands))
