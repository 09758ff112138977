"""What waits for the live loop: frames from the buses' threads, orders from above, notices about the world."""
from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from level1.command import Order
from level1.frame import Frame

FRAMES = 20_000
"""Frames that wait at most: two seconds of a full 1 Mbit/s bus."""


class Load(NamedTuple):
    """What had come since the last `take`. dropped: frames lost because too many waited, the oldest first."""

    frames: list[Frame]
    orders: list[Order]
    notices: list[str]
    dropped: int


class Inbox:
    """Filled by any thread, emptied by one. Frames are bounded; orders and notices, which are few, are never dropped."""

    def __init__(self, frames: int = FRAMES):
        self._frames: deque[Frame] = deque()
        self._limit = frames
        self._orders: list[Order] = []
        self._notices: list[str] = []
        self._dropped = 0
        self._lock = threading.Lock()
        self._filled = threading.Event()

    def put(self, frame: Frame) -> None:
        """A frame has come."""
        with self._lock:
            if len(self._frames) >= self._limit:
                self._frames.popleft()
                self._dropped += 1
            self._frames.append(frame)
        self.wake()

    def order(self, order: Order) -> None:
        """An authenticated order has come."""
        with self._lock:
            self._orders.append(order)
        self.wake()

    def notice(self, text: str) -> None:
        """Something worth a line has happened outside."""
        with self._lock:
            self._notices.append(text)
        self.wake()

    def wake(self) -> None:
        """End a `wait`, also from a signal handler."""
        if not self._filled.is_set():
            self._filled.set()

    def wait(self, timeout_s: float) -> None:
        """Until something is there, at most so long."""
        self._filled.wait(timeout_s)

    def take(self) -> Load:
        """All that is there."""
        self._filled.clear()
        with self._lock:
            load = Load(list(self._frames), self._orders, self._notices, self._dropped)
            self._frames.clear()
            self._orders, self._notices, self._dropped = [], [], 0
        return load
