"""Several recordings of one drive as one: their frames in the order of time."""
from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from level1.frame import BUS_SHIFT, Frame
from level1.io.replay import BLOCK_ROWS, Log, LogError

if TYPE_CHECKING:
    from level1.block import Block

KEY_MASK = (1 << BUS_SHIFT) - 1
"""The bits of `Frame.key` that are not the bus."""
LEAST_ROWS = 1 << 14
"""Rows of a block of one file, however many files there are."""


class MergedLog:
    """Recordings read side by side; what `Log` offers of one, of all of them together.

    A bus of `buses` may also be called by the name of a file, which then is that bus with all its channels: two loggers
    that both call their channel can0 are told apart so. Frames of the same time stamp come in the order of the files.
    """

    def __init__(self, paths: Sequence[str | Path], buses: Mapping[str, int] | None = None, *, one_bus: bool = False):
        """Open them. Raises LogError when one can't be used."""
        self.path = Path(f"{paths[0]} and {len(paths) - 1} more" if len(paths) > 1 else paths[0])
        self._channels = dict(buses or {})
        self._one_bus = one_bus
        self._logs = [Log(path) for path in paths]
        self._names = [next((name for name in (str(path), Path(path).name) if name in self._channels), None) for path in paths]
        self._buses: dict[tuple[int, int], int] = {}
        self.first_ns = self.last_ns = self._handed_on = 0

    @property
    def frames_read(self) -> int:
        """Frames handed on."""
        return sum(log.frames_read for log in self._logs)

    @property
    def error_frames(self) -> int:
        """Error frames among them."""
        return sum(log.error_frames for log in self._logs)

    @property
    def remote_frames(self) -> int:
        """Remote frames among them."""
        return sum(log.remote_frames for log in self._logs)

    @property
    def skipped(self) -> int:
        """Lines or objects left out."""
        return sum(log.skipped for log in self._logs)

    @property
    def complaints(self) -> list[str]:
        """The first of them in words, with the file."""
        return [f"{log.path.name}: {complaint}" for log in self._logs for complaint in log.complaints]

    @property
    def channels_seen(self) -> set[str]:
        """Channels, and files that stand for one, that frames came from."""
        return {name for name in self._names if name} | set().union(*(log.channels_seen for log in self._logs))

    @property
    def fraction(self) -> float:
        """How much of the files has been read, 0 to 1."""
        return sum(log.fraction for log in self._logs) / len(self._logs)

    @property
    def is_utc(self) -> bool:
        """Whether the stamps are UTC rather than counted from the recording's start."""
        return self._logs[0].is_utc

    @property
    def is_long(self) -> bool:
        """As of `Log`."""
        return any(log.is_long for log in self._logs)

    def frames(self) -> Iterator[Frame]:
        """The frames in time order. Raises LogError where one file holds none, or their times have no common beginning."""
        frames = heapq.merge(*(zip(log.frames(), itertools.repeat(number)) for number, log in enumerate(self._logs)), key=_time_of)
        for count, ((t_ns, key, data), number) in enumerate(frames):
            if not count:
                self._check()
                self.first_ns = self.last_ns = t_ns
            elif t_ns > self.last_ns:
                self.last_ns = t_ns
            yield Frame(t_ns, key & KEY_MASK | self._bus(number, key >> BUS_SHIFT) << BUS_SHIFT, data)

    def batches(self, size: int = 4096) -> Iterator[list[Frame]]:
        """The frames in lists of at most `size`."""
        frames = self.frames()
        while batch := list(itertools.islice(frames, size)):
            yield batch

    def blocks(self, rows: int = BLOCK_ROWS) -> Iterator[Block]:
        """The frames in columns, about so many rows a block; otherwise as `frames`. A block is good until the next is asked for."""
        from level1.io.merged_blocks import merged
        each = max(rows // len(self._logs), LEAST_ROWS)
        for block, origins in merged([log.blocks(each) for log in self._logs], self._check):
            if not self._handed_on:
                self.first_ns = self.last_ns = int(block.t_ns[0])
            self._handed_on += len(block)
            self.last_ns = max(self.last_ns, int(block.t_ns.max()))
            first = block.first_rows().tolist()
            for place in sorted(range(len(block.keys)), key=first.__getitem__):
                self._bus(origins[place], block.keys[place] >> BUS_SHIFT)
            block.keys = [key & KEY_MASK | self._bus(origin, key >> BUS_SHIFT) << BUS_SHIFT
                          for origin, key in zip(origins, block.keys, strict=True)]
            yield block

    def _bus(self, number: int, own: int) -> int:
        """The bus of a channel of a file. own: its index in the file's own numbering."""
        if (number, own) not in self._buses:
            name = self._names[number] or next(name for name, index in self._logs[number].channels.items() if index == own)
            if name not in self._channels:
                taken = () if self._one_bus else set(self._channels.values())
                self._channels[name] = next(index for index in itertools.count() if index not in taken)
            self._buses[number, own] = self._channels[name]
        return self._buses[number, own]

    def _check(self) -> None:
        """The first frame of each has been read by now."""
        for log in self._logs[1:]:
            if log.is_utc != self.is_utc:
                wall, own = (log, self._logs[0]) if log.is_utc else (self._logs[0], log)
                raise LogError(f"{own.path} counts time from its own start and {wall.path} in UTC: they can't be merged")


def _time_of(item: tuple[Frame, int]) -> int:
    return item[0].t_ns
