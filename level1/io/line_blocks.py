"""Text in blocks: lines that look alike are read together, all others one by one, with the same result.

Theory of operation. The lines of a recording differ in few digits: `(1700000000.000123) can0 18F00400#…` is the same as the
next line but for two digits of the seconds, the fraction, the identifier and the data. A *shape* is such a line with those
places left open. It is learned from one line that the scalar reader understands; every line of the same length that agrees in
all other characters, and has digits where digits belong, is then read by a few operations on columns. A line that fits no
shape teaches a new one (the seconds have moved on, another channel, another length), or is left to the scalar reader, which
also says what is wrong with it.
"""
from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Ints, Words
from level1.frame import BUS_SHIFT
from level1.io.message import FD_BYTES
from level1.io.rows import BlockReader, Numbers, Rows

LONGEST = 512
"""Longer lines are left to the scalar reader; a CAN FD frame of 64 bytes takes some 350 characters in ASC at most."""
FEW_LINES = 6
"""So few lines of a shape are read faster one by one."""
MAX_SHAPES = 24
"""Shapes remembered for each length of a line, and lines of a length that are tried to learn one from, in each chunk."""
SHORT_LINE = 24
"""Characters of a short line; where lines are shorter still, a block gets more room when it needs it."""
CHUNK_BYTES = 1 << 20
"""Text taken apart at a time: enough that what each piece costs does not matter, little enough for a processor's cache."""

HEXADECIMAL = re.compile(rb"[0-9A-Fa-f]+")
NEWLINE, MARK, SPACE = b"\n# "
NO_ROWS: Ints = np.zeros(0, np.int64)


def _hex_pairs() -> npt.NDArray[np.uint16]:
    """Value of two hexadecimal characters, the first in the low byte; 0x100 for anything else."""
    table = np.full(1 << 16, 0x100, np.uint16)
    characters = "0123456789ABCDEFabcdef"
    for high in characters:
        for low in characters:
            table[ord(high) | ord(low) << 8] = int(high + low, 16)
    return table


HEX_PAIRS = _hex_pairs()


class Digits(NamedTuple):
    """A field of decimal digits in a line, and what its value counts in ns."""

    offset: int
    size: int
    scale_ns: int


class Shape:
    """Lines of one length that differ only in open places.

    base_ns: time of the digits that are not open. digits: the open ones. name: offset and length of the identifier; flags: bits
    besides its spelling. data: offset of the payload's first digit, distance of one byte's digits to the next, and bytes.
    """

    __slots__ = ("_columns", "base_ns", "channel", "data", "digits", "flags", "name", "size")

    def __init__(self, line: bytes, base_ns: int, digits: tuple[Digits, ...], channel: bytes, name: tuple[int, int], flags: int,
                 data: tuple[int, int, int], others: tuple[tuple[int, int], ...]):
        self.base_ns, self.digits, self.channel, self.name, self.flags, self.data = base_ns, digits, channel, name, flags, data
        self.size = len(line)
        width = width_of(self.size)
        fixed = bytearray(b"\xff" * len(line)).ljust(width, b"\0")
        first, step, count = data
        opened = [*((field.offset, field.offset + field.size) for field in digits), (name[0], sum(name)), *others]
        opened += [(first + step * n, first + step * n + 2) for n in range(count)]
        for begin, end in opened:
            fixed[begin:end] = bytes(end - begin)
        masks = np.frombuffer(bytes(fixed), "<u8")
        wanted = np.frombuffer(line.ljust(width, b"\0"), "<u8") & masks
        self._columns = [(column, masks[column], wanted[column]) for column in range(width // 8) if masks[column]]

    def fits(self, lines: npt.NDArray[np.uint64]) -> npt.NDArray[np.bool_]:
        """Which lines agree in all places that are not open. lines: eight characters a column."""
        wrong = np.zeros(len(lines), np.uint64)
        for column, mask, wanted in self._columns:
            words = lines[:, column] & mask
            words ^= wanted
            wrong |= words
        agrees: npt.NDArray[np.bool_] = wrong == 0
        return agrees

    def times(self, lines: npt.NDArray[np.uint64]) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """Time stamps in ns, and where they are none because there is something else than a digit."""
        total, wrong = None, None
        for words, scale_ns in self._digit_words(lines):
            numbers, strange = decimal(words)
            wrong = strange if wrong is None else wrong | strange
            times = numbers.view(np.int64)
            times *= scale_ns
            total = times if total is None else total + times
        assert total is not None and wrong is not None
        total += self.base_ns
        return total, wrong != 0

    def _digit_words(self, lines: npt.NDArray[np.uint64]) -> list[tuple[Words, int]]:
        """Eight digits at a time, the first in the lowest byte, zeros in front; and what they count in."""
        ahead, fraction = self.digits[0], self.digits[-1]
        if len(self.digits) == 2 and ahead.size + fraction.size == 8 and ahead.scale_ns == fraction.scale_ns * 10**fraction.size:
            words = characters(lines, fraction.offset) << np.uint64(8 * ahead.size)
            words |= characters(lines, ahead.offset) & np.uint64((1 << 8 * ahead.size) - 1)
            return [(words, fraction.scale_ns)]
        return [(last_characters(lines, field.offset, field.size), field.scale_ns) for field in self.digits]

    def names(self, lines: npt.NDArray[np.uint64]) -> Words:
        """The identifiers as they are spelled, eight characters a word."""
        offset, count = self.name
        words = characters(lines, offset)
        return words if count == 8 else words & np.uint64((1 << 8 * count) - 1)

    def payloads(self, lines: npt.NDArray[np.uint64]) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """The data bytes, a row a line, and where they are none because there is something else than a hexadecimal digit."""
        first, step, count = self.data
        pairs = np.ndarray((len(lines), count), "<u2", lines, first, (lines.strides[0], step))
        values = HEX_PAIRS.take(pairs)
        if int(values.max(initial=0)) < 0x100:
            return values.astype(np.uint8), np.zeros(len(lines), bool)
        wrong: npt.NDArray[np.bool_] = np.any(values > 0xFF, axis=1)
        return values.astype(np.uint8), wrong


def width_of(length: int) -> int:
    """Characters taken of lines of a length: eight more at least, so that eight can be read from any place on."""
    return length // 8 * 8 + 16


def characters(lines: npt.NDArray[np.uint64], offset: int) -> Words:
    """Eight characters of each line from an offset on."""
    return np.ndarray((len(lines),), "<u8", lines, offset, (lines.strides[0],))


def last_characters(lines: npt.NDArray[np.uint64], offset: int, count: int) -> Words:
    """Up to eight characters of each line as the last of eight digits, zeros in front."""
    words = characters(lines, offset)
    if count == 8:
        return words.copy()
    shift = 8 * (8 - count)
    return words << np.uint64(shift) | np.uint64(0x3030_3030_3030_3030 & (1 << shift) - 1)


def decimal(words: Words) -> tuple[Words, Words]:
    """The numbers that eight digits spell, the first in the lowest byte (D. Lemire's parallel sums of neighbours); and something
    else than zero for those that are no digits. Takes the words for itself."""
    words ^= np.uint64(0x3030_3030_3030_3030)
    strange = words + np.uint64(0x7676_7676_7676_7676)
    strange |= words
    strange &= np.uint64(0x8080_8080_8080_8080)
    words *= np.uint64(10 << 8 | 1)
    words >>= np.uint64(8)
    words &= np.uint64(0x00FF_00FF_00FF_00FF)
    words *= np.uint64(100 << 16 | 1)
    words >>= np.uint64(16)
    words &= np.uint64(0x0000_FFFF_0000_FFFF)
    words *= np.uint64(10_000 << 32 | 1)
    words >>= np.uint64(32)
    return words, strange


class LineBlocks(BlockReader):
    """Reads text in blocks; what a line means is a subclass's to say.

    file: where to read. bus(channel): index of a channel's bus, asked in the order of appearance. skip(reason): told of every line
    that can't be read, in order. lines: how many stand before.
    """

    PIECE_ROWS = CHUNK_BYTES // SHORT_LINE

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Callable[[str], None], lines: int = 0):
        self._file = file
        self._bus = bus
        self._skip = skip
        self._shapes: dict[int, list[Shape]] = {}
        self._buses: dict[bytes, int] = {}
        self._lines = lines
        super().__init__()

    # --- what a subclass says ---------------------------------------------------------------------------------------------

    def _learn(self, line: bytes) -> Shape | None:
        """The shape of a line; None when the scalar reader can't read it, or nothing like it would be read in columns."""
        raise NotImplementedError

    def _key(self, name: bytes, flags: int) -> int:
        """`Frame.key` without a bus of an identifier as it is spelled, in hexadecimal digits. Raises ValueError."""
        raise NotImplementedError

    def _read_first(self, sheet: Sheet) -> None:
        """Lines that are read before all others; those found are marked in the sheet."""

    def _read_singly(self, sheet: Sheet, rows: list[int]) -> None:
        """Lines that are like no others, by the scalar reader."""
        raise NotImplementedError

    def _pass_over(self, begin: bytes) -> None:
        """A line is too long for the buffer, and left out; how it begins."""
        raise NotImplementedError

    # --- blocks -----------------------------------------------------------------------------------------------------------

    def _forget(self) -> None:
        super()._forget()
        self._names: dict[tuple[bytes, int], Numbers] = {}

    def _keys(self) -> list[int]:
        return [key | self._buses[channel] << BUS_SHIFT for channel, key in self._talkers]

    def _pieces(self) -> Iterator[None]:
        """Chunks of whole lines."""
        text = bytearray(CHUNK_BYTES + 2 * width_of(LONGEST))
        view, buffer = memoryview(text), np.frombuffer(text, np.uint8)
        filled, error, got = 0, None, 1
        while got:
            try:
                while filled < CHUNK_BYTES and got:
                    got = self._file.readinto1(view[filled:CHUNK_BYTES])  # type: ignore[attr-defined]
                    filled += got
            except (EOFError, OSError, zlib.error) as reason:
                error, got = reason, 0
            if not got and error is None and filled and text[filled - 1] != NEWLINE:
                text[filled] = NEWLINE
                filled += 1
            end = text.rfind(b"\n", 0, filled) + 1
            if end:
                self._take(buffer, end)
                yield
                text[:filled - end] = text[end:filled]
                filled -= end
            elif got:
                self._lines += 1
                self._pass_over(bytes(text[:LONGEST]))
                filled = 0
                while (rest := self._file.readline(CHUNK_BYTES)) and not rest.endswith(b"\n"):
                    pass
        if error is not None:
            raise error

    # --- a chunk of whole lines -------------------------------------------------------------------------------------------

    def _take(self, text: npt.NDArray[np.uint8], size: int) -> None:
        """Add the frames of the first so many characters of a text, whole lines. Behind them is room for one more."""
        ends = np.flatnonzero(text[:size] == NEWLINE)
        starts = np.empty_like(ends)
        starts[0], starts[1:] = 0, ends[:-1] + 1
        sheet = Sheet(text, starts, ends, self._rows)
        self._read_first(sheet)
        if not sheet.found[sheet.done:].all():
            self._read_others(sheet, np.flatnonzero(~sheet.found[sheet.done:]) + sheet.done)
        self._lines += len(ends)
        for _, channel in sorted((row, channel) for channel, row in sheet.channels.items()):
            self._buses[channel] = self._bus(channel.decode("utf-8", "replace"))
        self._rows.keep(sheet.found, sheet.wide)

    def _read_others(self, sheet: Sheet, rows: Ints) -> None:
        """Lines by their shapes, and what is left by the scalar reader."""
        left = []
        lengths = sheet.ends[rows] - sheet.starts[rows]
        for length in np.flatnonzero(np.bincount(np.minimum(lengths, LONGEST + 1))).tolist():
            if length > LONGEST:
                left.append(rows[lengths > LONGEST])
            elif length:
                left += self._read_alike(sheet, rows[lengths == length], length)
        self._read_singly(sheet, np.sort(np.concatenate([NO_ROWS, *left])).tolist())

    def _read_alike(self, sheet: Sheet, rows: Ints, length: int) -> Iterator[Ints]:
        """Lines of one length, shape by shape; gives those that are to be read one by one."""
        shapes = self._shapes.setdefault(length, [])
        for number, shape in enumerate(shapes):
            left = self._read_shape(sheet, shape, rows)
            if len(left) < len(rows):
                shapes.insert(0, shapes.pop(number))
                rows = left
                if not len(rows):
                    return
        for _ in range(MAX_SHAPES):
            if len(rows) < FEW_LINES:
                break
            learned = self._learn(sheet.line(int(rows[0])))
            if learned is None:
                yield rows[:1]
                rows = rows[1:]
            else:
                shapes.insert(0, learned)
                del shapes[MAX_SHAPES:]
                rows = self._read_shape(sheet, learned, rows)
        yield rows

    def _read_shape(self, sheet: Sheet, shape: Shape, rows: Ints) -> Ints:
        """Read the lines that are of a shape; gives the others."""
        lines = sheet.words(rows, shape.size)
        fits = shape.fits(lines)
        if not fits.any():
            return rows
        lines = lines[fits]
        t_ns, wrong = shape.times(lines)
        talkers = self._names_of(shape.channel, shape.flags).of(shape.names(lines))
        payloads, wrong_data = shape.payloads(lines)
        wrong |= wrong_data
        wrong |= talkers < 0
        right = ~wrong
        found = np.flatnonzero(fits)[right]
        if len(found):
            sheet.put_payloads(rows[found], shape.channel, t_ns[right], talkers[right], payloads[right])
        left = np.ones(len(rows), bool)
        left[found] = False
        return rows[left]

    def _names_of(self, channel: bytes, flags: int) -> Numbers:
        if (channel, flags) not in self._names:
            self._names[channel, flags] = Numbers(lambda word: self._resolve(channel, flags, word))
        return self._names[channel, flags]

    def _resolve(self, channel: bytes, flags: int, word: int) -> int:
        """The talker of an identifier as it is spelled, negative where it is none."""
        name = word.to_bytes(8, "little").rstrip(b"\0")
        try:
            return self._talker(channel, self._key(name, flags)) if HEXADECIMAL.fullmatch(name) else -1
        except ValueError:
            return -1

    def _talker(self, channel: bytes, key: int) -> int:
        return self._talkers.setdefault((channel, key), len(self._talkers))


class Sheet:
    """The lines of a chunk, from `starts` to `ends` in a text, whose frames go into the next of some rows.

    found: which lines are frames; wide: lines of those longer than a head, and their payloads; channels: first line of each.
    done: so many lines from the first need no further look.
    """

    def __init__(self, text: npt.NDArray[np.uint8], starts: Ints, ends: Ints, rows: Rows):
        self.text, self.starts, self.ends = text, starts, ends
        self.channels: dict[bytes, int] = {}
        self.wide: list[tuple[Ints, npt.NDArray[np.uint8]]] = []
        self.found = np.zeros(len(starts), bool)
        self.done = 0
        self._t_ns, self._talker, self._length, self._head = rows.sheet(len(starts))

    def line(self, row: int) -> bytes:
        """A line without its end."""
        return self.text[self.starts[row]:self.ends[row]].tobytes()

    def words(self, rows: Ints | None, length: int) -> npt.NDArray[np.uint64]:
        """The first so many characters of some lines (None: all) or a few more, eight a column."""
        return self._at(self.starts if rows is None else self.starts[rows], width_of(length))

    def _at(self, places: Ints, width: int) -> npt.NDArray[np.uint64]:
        """So many characters from these places on; what lies behind the end of a line is another one, or nothing."""
        everywhere = np.ndarray((len(self.text) - width,), f"V{width}", self.text, 0, (1,))
        return everywhere[places].view("<u8").reshape(len(places), width // 8)

    def fd_data(self, begins: Ints, wrong: npt.NDArray[np.bool_]) -> Ints:
        """Finds the data of CAN FD frames behind `#` and the flags, and moves their begins there; gives which are CAN FD. Those
        without flags are `wrong`."""
        found = np.flatnonzero(self.text[begins] == MARK)
        if len(found):
            wrong[found] |= self.text[begins[found] + 1] <= SPACE
            begins[found] += 2
        return found

    def data(self, rows: Ints | None, begins: Ints, longer: Ints) -> tuple[npt.NDArray[np.uint16], Words, npt.NDArray[np.bool_]]:
        """Sizes and heads of payloads that begin at these places of the text and end with their lines; and which are none,
        because they are longer than eight bytes (`longer`: may have up to 64), or something else."""
        digits = (self.ends if rows is None else self.ends[rows]) - begins
        values = HEX_PAIRS.take(self._at(begins, 16).view("<u2"), mode="clip")
        wrong = np.zeros(len(begins), bool)
        if digits.min() != 16 or digits.max() != 16:
            most = np.full(len(begins), 2 * HEAD_BYTES)
            most[longer] = 2 * FD_BYTES
            wrong = (digits < 0) | (digits > most) | (digits & 1 != 0)
            some = np.flatnonzero(digits < 16)
            part = values[some]
            part[np.arange(HEAD_BYTES) >= digits[some, None] >> 1] = 0
            values[some] = part
        if int(values.max(initial=0)) > 0xFF:
            wrong |= np.any(values > 0xFF, axis=1)
        return (digits >> 1).astype(np.uint16), values.astype(np.uint8).view("<u8")[:, 0], wrong

    def keep_wide(self, rows: Ints | None, begins: Ints, longer: Ints, wrong: npt.NDArray[np.bool_]) -> None:
        """Keep the payloads of more than eight bytes; those that are none become `wrong`."""
        longer = longer[~wrong[longer]]
        sizes = ((self.ends if rows is None else self.ends[rows])[longer] - begins[longer]) >> 1
        for size in np.flatnonzero(np.bincount(sizes)).tolist():
            if size <= HEAD_BYTES:
                continue
            some = longer[sizes == size]
            values = HEX_PAIRS.take(self._at(begins[some], width_of(2 * size)).view("<u2")[:, :size])
            wrong[some] = np.any(values > 0xFF, axis=1)
            right = ~wrong[some]
            kept = some if rows is None else rows[some]
            self.wide.append((kept[right], values[right].astype(np.uint8)))

    def put(self, rows: Ints | None, channel: bytes, t_ns: Ints, talkers: npt.NDArray[np.int32], sizes: Any, heads: Words) -> None:
        """Frames of some lines (None: all), all of one channel."""
        chosen: Any = slice(None) if rows is None else rows
        self.channels[channel] = min(0 if rows is None else int(rows[0]), self.channels.get(channel, len(self.starts)))
        self._t_ns[chosen] = t_ns
        self._talker[chosen] = talkers
        self._length[chosen] = sizes
        self._head[chosen] = heads
        self.found[chosen] = True

    def put_payloads(self, rows: Ints, channel: bytes, t_ns: Ints, talkers: npt.NDArray[np.int32],
                     payloads: npt.NDArray[np.uint8]) -> None:
        """Frames of some lines, all of one channel and size, with their data bytes, a row a frame."""
        size = payloads.shape[1]
        heads = np.zeros((len(rows), HEAD_BYTES), np.uint8)
        heads[:, :size] = payloads[:, :HEAD_BYTES]
        if size > HEAD_BYTES:
            self.wide.append((rows, payloads))
        self.put(rows, channel, t_ns, talkers, size, heads.view("<u8")[:, 0])
