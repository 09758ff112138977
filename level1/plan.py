"""What `sieve` reads in one go: pages as trees of columns, and what is answered from them."""
from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from level1.board import Page, Watch
from level1.column_condition import ColumnCondition
from level1.columns import Bits, Column, SignalColumn, Unsupported
from level1.decode import last_byte, raw_range


class Node:
    """A page that can be tracked. columns: of its signals; windows: payload bytes they lie in; need: bytes for all of them.

    children: its multiplexer branches; bits, ids: of a branch, its selector and the values of it that it answers to.
    """

    __slots__ = ("bits", "children", "columns", "ids", "need", "page", "presence", "windows")

    def __init__(self, page: Page):
        self.page = page
        self.columns = [SignalColumn(cell) for cell in page.cells]
        self.presence = Column(page.presence, False)
        self.windows = tuple(sorted({column.bits.window for column in self.columns}))
        self.need = max((last_byte(cell.signal) + 1 for cell in page.cells), default=0)
        self.children = [Node(child) for branches in page.branches.values() for child in branches]
        self.bits: Bits | None = None
        self.ids = np.zeros(0, np.uint64)
        if page.selector is not None:
            signal, ids = page.selector
            if signal.is_float:
                raise Unsupported("a multiplexer is an integer")
            bottom, top = raw_range(signal)
            self.bits = Bits(signal)
            self.ids = np.array(sorted(number - bottom for number in ids if bottom <= number <= top), np.uint64)

    def all(self) -> Iterator[Node]:
        """Itself and the branches below."""
        yield self
        for child in self.children:
            yield from child.all()


class Plan(NamedTuple):
    """Trees that are tracked, which conditions are answered, which columns they need, and which someone else reads (`live`)."""

    roots: dict[int, Node]
    answered: tuple[tuple[Watch, ColumnCondition], ...]
    wanted: frozenset[Column]
    live: frozenset[Column]
