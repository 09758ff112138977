"""What the readers of blocks have in common: rows that become a block, and numbers for identifiers."""
from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Block, Ints, Words
from level1.frame import BUS_SHIFT

MOST_TALKERS = 32_768
"""A block ends before it has many more talkers than that: a babbling node brings a new one with each frame."""

_HASH = np.uint64(0x9E37_79B9_7F4A_7C15)
_SLOTS = 1 << 16
_NO_ROWS: Ints = np.zeros(0, np.int64)


class Numbers:
    """Talkers of whatever names them in a recording (an identifier as it is spelled, a channel and an identifier), eight bytes.

    resolve(word): the talker, negative where the word names none. No word is zero.
    """

    def __init__(self, resolve: Callable[[int], int]):
        self._resolve = resolve
        self._texts = np.zeros(_SLOTS, np.uint64)
        self._talkers = np.zeros(_SLOTS, np.int32)
        self._others: dict[int, int] = {}

    def of(self, names: Words) -> npt.NDArray[np.int32]:
        """The talkers of some words."""
        slots = (names * _HASH >> np.uint64(48)).view(np.int64)
        talkers = self._talkers.take(slots)
        unknown = np.flatnonzero(self._texts.take(slots) != names)
        if len(unknown):
            words, which = np.unique(names[unknown], return_inverse=True)
            talkers[unknown] = np.array([self._meet(word) for word in words.tolist()], np.int32)[which]
        return talkers

    def _meet(self, word: int) -> int:
        """The talker of an identifier that is not in its slot of the table."""
        if word not in self._others:
            self._others[word] = self._resolve(word)
            slot = word * int(_HASH) % (1 << 64) >> 48
            if not self._texts[slot]:
                self._texts[slot], self._talkers[slot] = word, self._others[word]
        return self._others[word]


class Rows:
    """The rows of a block that is being filled; the same memory for every block, because fresh memory is slow. count: so far."""

    def __init__(self, rows: int):
        self.count = 0
        self._t_ns = np.empty(rows, np.int64)
        self._talker = np.empty(rows, np.uint16)
        self._length = np.empty(rows, np.uint16)
        self._head = np.empty(rows, np.uint64)
        self._wide: list[tuple[Ints, npt.NDArray[np.uint8]]] = []

    def sheet(self, lines: int) -> tuple[Ints, npt.NDArray[np.uint16], npt.NDArray[np.uint16], Words]:
        """Room for the frames of so many lines: times, talkers, lengths, heads."""
        part = slice(self.count, self.count + lines)
        if part.stop > len(self._t_ns):
            for name in ("_t_ns", "_talker", "_length", "_head"):
                column = getattr(self, name)
                setattr(self, name, np.concatenate((column[:self.count], np.empty(lines, column.dtype))))
        return self._t_ns[part], self._talker[part], self._length[part], self._head[part]

    def keep(self, found: npt.NDArray[np.bool_], wide: list[tuple[Ints, npt.NDArray[np.uint8]]]) -> None:
        """Those lines of the last sheet are frames. wide: lines of frames that are longer than a head, and their payloads."""
        lines, begin, places = len(found), self.count, np.arange(len(found))
        self.count += lines
        if not found.all():
            kept = int(np.count_nonzero(found))
            for column in (self._t_ns, self._talker, self._length, self._head):
                column[begin:begin + kept] = column[begin:begin + lines][found]
            self.count = begin + kept
            places = np.cumsum(found) - 1
        self._wide += [(places[rows] + begin, payloads) for rows, payloads in wide]

    def block(self, keys: list[int]) -> Block:
        """All rows; they are good until the next sheet is taken."""
        count, self.count = self.count, 0
        wide_rows = np.concatenate([_NO_ROWS, *(rows for rows, _ in self._wide)])
        longest = max((payloads.shape[1] for _, payloads in self._wide), default=0)
        wide = np.zeros((len(wide_rows), longest + HEAD_BYTES), np.uint8)
        place = 0
        for rows, payloads in self._wide:
            wide[place:place + len(rows), :payloads.shape[1]] = payloads
            place += len(rows)
        order = np.argsort(wide_rows)
        self._wide = []
        block = Block(self._t_ns[:count], self._talker[:count], keys, self._length[:count], self._head[:count], wide_rows[order],
                      wide[order])
        return block


class BlockReader:
    """Gathers the frames of a recording into blocks; how they are found is a subclass's to say.

    PIECE_ROWS: rows that a piece brings at most, or nearly. _rows: where the frames go. _talkers: the talkers of this block by
    whatever names them, in the order of their numbers.
    """

    PIECE_ROWS: ClassVar[int]

    def __init__(self) -> None:
        self._talkers: dict[Any, int] = {}
        self._rows = Rows(0)
        self._forget()

    def _forget(self) -> None:
        """Begin a block: no talker is known."""
        self._talkers = {}

    def _pieces(self) -> Iterator[None]:
        """Add the frames piece by piece, and stop after each."""
        raise NotImplementedError

    def _keys(self) -> list[int]:
        """`Frame.key` of each talker."""
        raise NotImplementedError

    def blocks(self, rows: int) -> Iterator[Block]:
        """The frames, so many or somewhat more a block; each block is good until the next is asked for.

        Raises what reading the file raises, after the frames before it.
        """
        self._rows = Rows(rows + self.PIECE_ROWS)
        try:
            for _ in self._pieces():
                if self._rows.count >= rows or len(self._talkers) >= MOST_TALKERS:
                    yield self._block()
        except (EOFError, OSError, zlib.error):
            if self._rows.count:
                yield self._block()
            raise
        if self._rows.count:
            yield self._block()

    def _block(self) -> Block:
        keys = self._keys()
        if len(keys) >= MOST_TALKERS:
            self._forget()
        return self._rows.block(keys)


HEAD_MASKS = np.array([(1 << 8 * size) - 1 for size in range(HEAD_BYTES + 1)], np.uint64)
"""What of a head counts, by the size of the payload up to eight."""


def block_of_words(t_ns: Ints, words: Words, lengths: Any, heads: Words, wide_rows: Ints, wide: npt.NDArray[np.uint8]) -> Block:
    """A block of frames whose talkers are named by words: `Frame.key` with the number of a channel in place of the bus."""
    keys, talkers = np.unique(words, return_inverse=True)
    return Block(t_ns, talkers.astype(np.uint32), keys.tolist(), lengths, heads, wide_rows, wide)


def on_buses(blocks: Iterator[Block], bus_of: Callable[[int], int]) -> Iterator[Block]:
    """Blocks with buses for channels. bus_of(channel): asked once for each, in the order in which they appear."""
    buses: dict[int, int] = {}
    for block in blocks:
        first = block.first_rows().tolist()
        for place in sorted(range(len(block.keys)), key=first.__getitem__):
            channel = block.keys[place] >> BUS_SHIFT
            if channel not in buses:
                buses[channel] = bus_of(channel)
        block.keys = [key & (1 << BUS_SHIFT) - 1 | buses[key >> BUS_SHIFT] << BUS_SHIFT for key in block.keys]
        yield block
