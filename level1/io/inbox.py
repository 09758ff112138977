"""What waits for the live loop: frames, orders, questions to devices, reports and notices about the world; and what wakes it."""
from __future__ import annotations

import os
import select
import threading
import weakref
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple

from level1.bus_health import Report
from level1.command import Order
from level1.frame import Frame

FRAMES = 20_000
"""Frames that wait at most: two seconds of a full 1 Mbit/s bus."""


class Request(NamedTuple):
    """What is to be asked of a device on a bus. can_id: of 11 bits."""

    bus: int
    can_id: int
    data: bytes


class Load(NamedTuple):
    """What had come since the last `take`. dropped: frames lost because too many waited, the oldest first."""

    frames: Sequence[Frame]
    orders: Sequence[Order]
    reports: Sequence[Report]
    notices: Sequence[str]
    dropped: int
    requests: Sequence[Request] = ()


NOTHING = Load((), (), (), (), 0)


class Inbox:
    """Filled by any thread, emptied by one. Frames are bounded; the others, which are few, are never dropped.

    It wakes the one that waits, as do the descriptors it is told to `watch`: of sockets that the loop reads itself.
    rung: whether something has come, or `wake` was called, since the last `take`.
    """

    def __init__(self, frames: int = FRAMES):
        self._frames: deque[Frame] = deque()
        self._limit = frames
        self._orders: list[Order] = []
        self._reports: list[Report] = []
        self._notices: list[str] = []
        self._requests: list[Request] = []
        self._dropped = 0
        self._lock = threading.Lock()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self._bell)
        self.rung = False
        self._poll = select.epoll()
        self._poll.register(self._bell, select.EPOLLIN)

    def put(self, frames: Iterable[Frame]) -> None:
        """Frames have come."""
        with self._lock:
            self._frames.extend(frames)
            while len(self._frames) > self._limit:
                self._frames.popleft()
                self._dropped += 1
        self.wake()

    def order(self, order: Order) -> None:
        """An authenticated order has come."""
        with self._lock:
            self._orders.append(order)
        self.wake()

    def ask(self, bus: int, can_id: int, data: bytes) -> None:
        """A device is to be asked, as far as the gate lets it."""
        with self._lock:
            self._requests.append(Request(bus, can_id, data))
        self.wake()

    def report(self, reports: Iterable[Report]) -> None:
        """Causes of alarms are there, or no more."""
        with self._lock:
            self._reports += reports
        self.wake()

    def notice(self, text: str) -> None:
        """Something worth a line has happened outside."""
        with self._lock:
            self._notices.append(text)
        self.wake()

    def watch(self, descriptor: int) -> None:
        """End a `wait` when a descriptor becomes readable, until it is closed."""
        self._poll.register(descriptor, select.EPOLLIN)

    def forget(self, descriptor: int) -> None:
        """Watch a descriptor no more; to be called before it is closed."""
        with suppress(OSError, ValueError):
            self._poll.unregister(descriptor)

    def wake(self) -> None:
        """End a `wait`, also from a signal handler."""
        if not self.rung:
            self.rung = True
            os.eventfd_write(self._bell, 1)

    def wait(self, timeout_s: float) -> None:
        """Until something is there, at most so long."""
        self._poll.poll(timeout_s)

    def take(self) -> Load:
        """All that is there."""
        if not self.rung:
            return NOTHING
        with suppress(BlockingIOError):
            os.eventfd_read(self._bell)
        self.rung = False  # only now: a bell rung before would be silenced, and who comes later would not ring it
        with self._lock:
            load = Load(list(self._frames), self._orders, self._reports, self._notices, self._dropped, self._requests)
            self._frames.clear()
            self._orders, self._reports, self._notices, self._dropped, self._requests = [], [], [], 0, []
        return load
