"""Deadlines in order. Everything that happens because time passes (delays, silence, steps of a repair) waits here."""
from __future__ import annotations

import heapq
from typing import Protocol

FAR = 1 << 80
"""A deadline that never comes."""


class Timed(Protocol):
    """Something that waits. due: its present deadline, `FAR` for none. order: unique; the smaller goes first at equal deadlines."""

    due: int
    order: int

    def expire(self, now_ns: int) -> None:
        """The deadline has come; `now_ns` is exactly it. `due` is `FAR` again already."""


class Timers:
    """A heap of deadlines. An entry whose owner has moved on is dropped when it comes up. until_ns: time up to which deadlines are
    being served; one far before it is served late."""

    __slots__ = ("heap", "next_ns", "orders", "popped_ns", "until_ns")

    def __init__(self) -> None:
        self.heap: list[tuple[int, int, Timed]] = []
        self.next_ns = FAR
        self.orders = 0
        self.popped_ns = self.until_ns = 0

    def order(self) -> int:
        """A new place in the order of equal deadlines."""
        self.orders += 1
        return self.orders

    def set(self, item: Timed, due_ns: int) -> None:
        """Let `item` expire at `due_ns`, and no longer at an earlier set deadline."""
        if item.due == due_ns:
            return
        item.due = due_ns
        heapq.heappush(self.heap, (due_ns, item.order, item))
        if due_ns < self.next_ns:
            self.next_ns = due_ns

    def pop(self, now_ns: int) -> Timed | None:
        """The next item whose deadline (then `popped_ns`) is not after `now_ns`, with its `due` reset; None when there is none."""
        heap = self.heap
        self.until_ns = now_ns
        while self.next_ns <= now_ns:
            due, _, item = heapq.heappop(heap)
            self.next_ns = heap[0][0] if heap else FAR
            if item.due == due:
                item.due = FAR
                self.popped_ns = due
                return item
        return None
