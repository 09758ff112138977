"""The freeze frame: what the inputs of an alarm were when it was raised, in words and units that people use."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import chain
from typing import Any

from level1.alarm import AlarmMachine
from level1.board import Board, Cell, Page
from level1.catalog import Alarm
from level1.condition import Things, walk
from level1.decode import GOOD, QUALITY_WORDS, RawValue
from level1.expression import AlarmState, Count, Elapsed, Quality, Rate, SignalValue, Silent

STATE_WORDS = ("Normal", "Active", "Repairing", "LockedOut")
"""Names of the states of an alarm, by raw value."""

Reader = Callable[[int], Any]
"""Gives the present value of one input at a time (ns)."""


def freeze_frame(alarm: Alarm, board: Board, things: Things, machines: Mapping[str, AlarmMachine]) -> list[tuple[str, Reader]]:
    """What to record with every event of an alarm: the inputs of its condition and of what enables it, by name."""
    inputs: dict[str, Callable[[int], Any]] = {}
    for node in chain(walk(alarm.when), walk(alarm.enabled)):
        match node:
            case SignalValue(message=message, signal=signal) | Rate(message=message, signal=signal):
                cell = board.cell(message, signal)
                inputs[cell.name] = _reader(board, cell)
            case Quality(message=message, signal=signal) | Elapsed(message=message, signal=signal) if signal:
                cell = board.cell(message, signal)
                inputs[cell.name] = _reader(board, cell)
            case Silent(message=message) | Quality(message=message) | Elapsed(message=message):
                inputs[message] = _silence(board, board.page(message))
            case AlarmState(alarm=other):
                inputs[other] = _state_word(machines[other])
            case Count(alarm=other, window_ns=window):
                inputs[f"count({other})"] = _count(things.count(other, window))
            case _:
                pass
    return list(inputs.items())


def physical(cell: Cell, raw: RawValue) -> int | float | str:
    """A raw value for people: its name in the value table, else the physical value."""
    if isinstance(raw, int) and raw in cell.signal.choices:
        return cell.signal.choices[raw]
    return cell.scale.physical(raw)


def _reader(board: Board, cell: Cell) -> Callable[[int], Any]:
    def read(t_ns: int) -> Any:
        raw, quality = board.sample(cell)
        return physical(cell, raw) if quality == GOOD and raw is not None else QUALITY_WORDS[quality]
    return read


def _silence(board: Board, page: Page) -> Callable[[int], Any]:
    def read(t_ns: int) -> Any:
        board.refresh(page)
        return "never" if page.level < 0 else f"last received {(t_ns - page.t_ns) / 1e9:.3f} s ago"
    return read


def _state_word(machine: AlarmMachine) -> Callable[[int], Any]:
    def read(t_ns: int) -> Any:
        return STATE_WORDS[machine.state]
    return read


def _count(cell: Cell) -> Callable[[int], Any]:
    def read(t_ns: int) -> Any:
        return cell.value
    return read
