"""Several recordings of one drive as one: their frames in the order of time."""
from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path

from level1.frame import BUS_SHIFT, Frame
from level1.io.replay import Log, LogError


class MergedLog:
    """Recordings read side by side; what `Log` offers of one, of all of them together.

    A bus of `buses` may also be called by the name of a file, which then is that bus with all its channels: two loggers
    that both call their channel can0 are told apart so. Frames of the same time stamp come in the order of the files.
    """

    def __init__(self, paths: Sequence[str | Path], buses: Mapping[str, int] | None = None, *, one_bus: bool = False):
        """Open them. Raises LogError when one can't be used."""
        buses = dict(buses or {})
        self.path = Path(f"{paths[0]} and {len(paths) - 1} more" if len(paths) > 1 else paths[0])
        self._logs: list[Log] = []
        self._given: dict[str, int] = {}
        self._shifts: list[int] = []
        for path in paths:
            name = next((name for name in (str(path), Path(path).name) if name in buses), None)
            log = Log(path, {} if name else buses, one_bus=one_bus or name is not None)
            if name is None:
                log.channels = buses  # one numbering for all files
            else:
                self._given[name] = buses[name]
            self._logs.append(log)
            self._shifts.append(buses[name] << BUS_SHIFT if name else 0)
        self.first_ns = self.last_ns = 0

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
        return set().union(self._given, *(log.channels_seen for log in self._logs))

    @property
    def fraction(self) -> float:
        """How much of the files has been read, 0 to 1."""
        return sum(log.fraction for log in self._logs) / len(self._logs)

    @property
    def is_utc(self) -> bool:
        """Whether the stamps are UTC rather than counted from the recording's start."""
        return self._logs[0].is_utc

    def frames(self) -> Iterator[Frame]:
        """The frames in time order. Raises LogError where one file holds none, or their times have no common beginning."""
        frames = heapq.merge(*map(self._of, self._logs, self._shifts), key=itemgetter(0))
        for number, frame in enumerate(frames):
            if not number:
                self._check()
                self.first_ns = self.last_ns = frame.t_ns
            elif frame.t_ns > self.last_ns:
                self.last_ns = frame.t_ns
            yield frame

    def batches(self, size: int = 4096) -> Iterator[list[Frame]]:
        """The frames in lists of at most `size`."""
        frames = self.frames()
        while batch := list(itertools.islice(frames, size)):
            yield batch

    def _of(self, log: Log, shift: int) -> Iterator[Frame]:
        if not shift:
            return log.frames()
        return (Frame(t_ns, key | shift, data) for t_ns, key, data in log.frames())

    def _check(self) -> None:
        """The first frame of each has been read by now."""
        for log in self._logs[1:]:
            if log.is_utc != self.is_utc:
                wall, own = (log, self._logs[0]) if log.is_utc else (self._logs[0], log)
                raise LogError(f"{own.path} counts time from its own start and {wall.path} in UTC: they can't be merged")
