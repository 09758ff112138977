"""What was on a bus: for tests of what programs send."""
from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Mapping
from typing import NamedTuple

import can

from level1.catalog import Message
from level1.decode import raw_of


class Heard(NamedTuple):
    """A frame on a bus. t_s: monotonic."""

    t_s: float
    can_id: int
    data: bytes


class Recorder:
    """Records a SocketCAN interface from now on, until `stop`. messages: by which it is read."""

    def __init__(self, channel: str, messages: Mapping[str, Message]):
        self.frames: list[Heard] = []
        self._messages = messages
        self._bus = can.Bus(channel=channel, interface="socketcan")
        self._stopping = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def stop(self) -> None:
        """Record no more."""
        self._stopping = True
        self._thread.join()
        self._bus.shutdown()

    @property
    def longest_pause_s(self) -> float:
        """The longest time without any frame."""
        return max((after.t_s - before.t_s for before, after in itertools.pairwise(self.frames)), default=0.0)

    def values(self, message: str, signal: str) -> list[tuple[float, int | float | None]]:
        """Time and raw value of a signal in each frame of a message."""
        wanted = self._messages[message].signal(signal)
        return [(frame.t_s, raw_of(wanted, frame.data)) for frame in self._of(message)]

    def changes(self, message: str, signal: str) -> list[int | float | None]:
        """The values of a signal, one after the other."""
        values = [value for _, value in self.values(message, signal)]
        return [value for place, value in enumerate(values) if not place or value != values[place - 1]]

    def payloads(self, message: str) -> set[bytes]:
        """Every payload that a message had."""
        return {frame.data for frame in self._of(message)}

    def _of(self, message: str) -> list[Heard]:
        return [frame for frame in list(self.frames) if frame.can_id == self._messages[message].can_id]

    def _read(self) -> None:
        while not self._stopping:
            message = self._bus.recv(0.2)
            if message is not None:
                self.frames.append(Heard(time.monotonic(), message.arbitration_id, bytes(message.data)))
