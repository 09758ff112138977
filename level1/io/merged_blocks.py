"""Blocks of several recordings merged in the order of time, as `heapq.merge` merges single frames."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from level1.block import MAX_TALKERS, Block, Ints


class Stream:
    """A recording that is being merged: its present block, and how many of its rows are taken.

    order_ns: by which rows are ordered: the highest time stamp so far, because a recording keeps its own order.
    """

    def __init__(self, blocks: Iterator[Block]):
        self._blocks = blocks
        self._last_ns = -1 << 63
        self.block: Block | None = None
        self.taken = 0
        self.order_ns: Ints = np.zeros(0, np.int64)

    def has_more(self) -> bool:
        """Whether there are rows to take; reads on when the present block is used up."""
        if self.taken < len(self.order_ns):
            return True
        self.block = next(self._blocks, None)
        self.taken = 0
        self.order_ns = np.zeros(0, np.int64)
        if self.block is not None:
            self.order_ns = np.maximum(np.maximum.accumulate(self.block.t_ns), self._last_ns)
            self._last_ns = int(self.order_ns[-1])
        return self.block is not None


def merged(recordings: Sequence[Iterator[Block]], begun: Callable[[], None]) -> Iterator[tuple[Block, list[int]]]:
    """Blocks in the order of time, each with the number of the recording that each of its talkers is of.

    begun(): called when the first block of each has been read. Rows of the same time come in the order of the recordings.
    """
    streams = [Stream(blocks) for blocks in recordings]
    for stream in streams:
        stream.has_more()
    begun()
    while active := [number for number, stream in enumerate(streams) if stream.has_more()]:
        # Up to the last row of whichever block ends first, nothing can come in between any more.
        end_ns, first_to_end = min((int(streams[number].order_ns[-1]), number) for number in active)
        parts = []
        for number in active:
            stream = streams[number]
            end = int(stream.order_ns.searchsorted(end_ns, "right" if number <= first_to_end else "left"))
            if end > stream.taken:
                parts.append((number, stream, slice(stream.taken, end)))
                stream.taken = end
        yield _joined(parts)


def _joined(parts: list[tuple[int, Stream, slice]]) -> tuple[Block, list[int]]:
    """The rows of these parts in the order of time."""
    order = np.argsort(np.concatenate([stream.order_ns[part] for _, stream, part in parts]), kind="stable")
    blocks = [(stream.block, part) for _, stream, part in parts if stream.block is not None]
    offsets = np.cumsum([0, *(len(block.keys) for block, _ in blocks)])
    talkers = np.concatenate([block.talker[part].astype(np.int64) + offset
                              for (block, part), offset in zip(blocks, offsets.tolist(), strict=False)])
    used = np.flatnonzero(np.bincount(talkers))
    numbers = np.zeros(int(offsets[-1]), np.int64)
    numbers[used] = np.arange(len(used))
    columns: list[Any] = [np.concatenate([getattr(block, name)[part] for block, part in blocks])[order]
                          for name in ("t_ns", "length", "head")]
    places = np.empty(len(order), np.int64)
    places[order] = np.arange(len(order))
    wide_rows, wide = _wide(blocks, places)
    keys = [key for block, _ in blocks for key in block.keys]
    origins = [number for number, stream, _ in parts if stream.block is not None for _ in stream.block.keys]
    t_ns, length, head = columns
    talkers = numbers[talkers[order]].astype(np.uint16 if len(used) <= MAX_TALKERS else np.uint32)
    block = Block(t_ns, talkers, [keys[place] for place in used.tolist()], length, head, wide_rows, wide)
    return block, [origins[place] for place in used.tolist()]


def _wide(blocks: list[tuple[Block, slice]], places: Ints) -> tuple[Ints, Any]:
    """The long payloads of some parts. places: where each of their rows goes."""
    longest = max(block.wide.shape[1] for block, _ in blocks)
    found, payloads, begin = [np.zeros(0, np.int64)], [np.zeros((0, longest), np.uint8)], 0
    for block, part in blocks:
        first, last = block.wide_rows.searchsorted([part.start, part.stop]).tolist()
        found.append(places[block.wide_rows[first:last] - part.start + begin])
        payloads.append(np.pad(block.wide[first:last], ((0, 0), (0, longest - block.wide.shape[1]))))
        begin += part.stop - part.start
    rows = np.concatenate(found)
    order = np.argsort(rows)
    return rows[order], np.concatenate(payloads)[order]
