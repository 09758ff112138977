"""A block of frames in columns: what the readers of recordings hand on, thousands of frames at a time."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from level1.frame import Frame

HEAD_BYTES = 8
"""Payload bytes that every frame has in the column `head`."""
MAX_TALKERS = 65_536
"""Different keys that 16 bits can number: readers cut a recording of random identifiers into more blocks."""

Ints = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]


class Block:
    """Frames in the order of the recording, one row each.

    t_ns: time stamps as recorded; they may run backwards. talker: index into `keys` (`Frame.key`). length: payload bytes.
    head: the first eight payload bytes as a little-endian integer, zero beyond the end. wide_rows: rows of the frames longer
    than that, rising; wide: their whole payloads, zero beyond the end, `HEAD_BYTES` columns more than the longest.
    """

    __slots__ = ("head", "keys", "length", "t_ns", "talker", "wide", "wide_rows")

    def __init__(self, t_ns: Ints, talker: npt.NDArray[np.uint16], keys: Sequence[int], length: npt.NDArray[np.uint16], head: Words,
                 wide_rows: Ints | None = None, wide: npt.NDArray[np.uint8] | None = None):
        self.t_ns = t_ns
        self.talker = talker
        self.keys = keys
        self.length = length
        self.head = head
        self.wide_rows = wide_rows if wide_rows is not None else np.zeros(0, np.int64)
        self.wide = wide if wide is not None else np.zeros((0, HEAD_BYTES), np.uint8)

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def of(cls, frames: Iterable[tuple[int, int, bytes]]) -> Block:
        """The block of some frames; for formats read frame by frame, and for tests."""
        rows = list(frames)
        numbers: dict[int, int] = {}
        talker = np.array([numbers.setdefault(key, len(numbers)) for _, key, _ in rows], np.uint16)
        length = np.array([len(data) for _, _, data in rows], np.uint16)
        head = np.frombuffer(b"".join(data[:HEAD_BYTES].ljust(HEAD_BYTES, b"\0") for _, _, data in rows), "<u8")
        wide_rows = np.flatnonzero(length > HEAD_BYTES)
        longest = int(length.max(initial=0)) + HEAD_BYTES
        wide = np.frombuffer(b"".join(rows[row][2].ljust(longest, b"\0") for row in wide_rows), np.uint8)
        return cls(np.array([t_ns for t_ns, _, _ in rows], np.int64), talker, list(numbers), length, head.astype(np.uint64),
                   wide_rows, wide.reshape(len(wide_rows), longest))

    def first_rows(self) -> Ints:
        """The first row of each talker; 0 for one that has none."""
        rows = np.zeros(len(self.keys), np.int64)
        rows[self.talker[::-1]] = np.arange(len(self) - 1, -1, -1)
        return rows

    def counts(self) -> list[int]:
        """How many frames each talker has in the block."""
        counts: list[int] = np.bincount(self.talker, minlength=len(self.keys)).tolist()
        return counts

    def payload(self, row: int) -> bytes:
        """The payload of one frame."""
        size = int(self.length[row])
        if size <= HEAD_BYTES:
            return int(self.head[row]).to_bytes(HEAD_BYTES, "little")[:size]
        return self.wide[self.wide_rows.searchsorted(row), :size].tobytes()

    def payloads(self, rows: Ints) -> list[bytes]:
        """The payloads of some frames."""
        heads = self.head[rows].astype("<u8").tobytes()
        lengths = self.length[rows].tolist()
        found = [heads[at:at + size] if size < HEAD_BYTES else heads[at:at + HEAD_BYTES]
                 for at, size in zip(range(0, len(heads), HEAD_BYTES), lengths, strict=True)]
        for place in np.flatnonzero(self.length[rows] > HEAD_BYTES).tolist():
            at = int(np.searchsorted(self.wide_rows, rows[place]))
            found[place] = self.wide[at, :lengths[place]].tobytes()
        return found

    def frames(self) -> Iterator[Frame]:
        """The frames, one by one."""
        payloads = self.payloads(np.arange(len(self)))
        for t_ns, talker, data in zip(self.t_ns.tolist(), self.talker.tolist(), payloads, strict=True):
            yield Frame(t_ns, self.keys[talker], data)

    def window(self, rows: Ints, first: int) -> Words:
        """Payload bytes first … first + 7 of some frames as little-endian integers, zero beyond the end."""
        return self.windows(rows, (first,))[first]

    def windows(self, rows: Ints, firsts: Iterable[int]) -> dict[int, Words]:
        """Several windows of the same frames."""
        heads = self.head[rows]
        words = {first: heads >> np.uint64(8 * first) if 0 < first < HEAD_BYTES else heads if not first else np.zeros_like(heads)
                 for first in firsts}
        if len(self.wide_rows) and any(words):
            at = self.wide_rows.searchsorted(rows)
            at[at == len(self.wide_rows)] = 0
            places = np.flatnonzero(self.wide_rows[at] == rows)
            wide = self.wide[at[places]]
            for first in words if len(places) else ():
                if first and first + HEAD_BYTES <= wide.shape[1]:
                    part: Any = np.ndarray((len(places),), "<u8", wide, first, wide.strides[:1])
                    if len(places) == len(rows):
                        words[first] = part.astype(np.uint64)
                    else:
                        words[first][places] = part
        return words
