"""candump text in blocks: lines that look alike are read together, all others by `candump.candump_line`, with the same result.

Theory of operation. The lines of a recording differ in few digits: `(1700000000.000123) can0 18F00400#…` is the same as the
next line but for two digits of the seconds, the fraction, the identifier and the data. A *shape* is such a line with those
places left open. It is learned from one line that the scalar reader understands; every line of the same length that agrees in
all other characters, and has digits where digits belong, is then read by a few operations on columns. A line that fits no
shape teaches a new one (the seconds have moved on, another channel, another length), or is left to the scalar reader, which
also says what is wrong with it.

By far most lines are of the log form, `(stamp) channel ID#DATA` with up to eight data bytes. They need no shape of each
length: where the shape of their *head* fits, up to the identifier, the rest is read in one go.
"""
from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Block, Ints, Words
from level1.frame import BUS_SHIFT, REMOTE
from level1.io.candump import BYTES, DATE, LATEST_NS, LOG, SCREEN, STAMP, candump_line, spelled_id
from level1.io.rows import MOST_TALKERS, Numbers, Rows

LONGEST = 256
"""Longer lines are left to the scalar reader; a CAN FD frame of 64 bytes takes 250 characters on the screen at most."""
FEW_LINES = 6
"""So few lines of a shape are read faster one by one."""
MAX_SHAPES = 24
"""Shapes remembered for each length of a line."""
SHORT_LINE = 24
"""Characters of a short line; where lines are shorter still, a block gets more room when it needs it."""
CHUNK_BYTES = 1 << 18
"""Text taken apart at a time; small enough for the second-level cache of a processor."""

HEXADECIMAL = re.compile(rb"[0-9A-Fa-f]+")
_NEWLINE, _MARK = b"\n#"
NAME_SIZE = 9
"""Characters of the longest identifier and the mark behind it."""
_NO_ROWS: Ints = np.zeros(0, np.int64)


def _hex_pairs() -> npt.NDArray[np.uint16]:
    """Value of two hexadecimal characters, the first in the low byte; 0x100 for anything else."""
    table = np.full(1 << 16, 0x100, np.uint16)
    characters = "0123456789ABCDEFabcdef"
    for high in characters:
        for low in characters:
            table[ord(high) | ord(low) << 8] = int(high + low, 16)
    return table


HEX_PAIRS = _hex_pairs()


_DataPlaces = tuple[tuple[int, int, int], tuple[tuple[int, int], ...]]
"""Of the data of a line: offset, step and bytes as in `Shape.data`; and begin and end of what else is open."""


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
        if len(self.digits) == 2 and sum(field.size for field in self.digits) == 8:
            ahead, fraction = self.digits
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


def learn(line: bytes) -> Shape | None:
    """The shape of a line; None when the scalar reader can't read it, or nothing like it would be read in columns."""
    text = line.strip()
    start = len(line) - len(line.lstrip())
    try:
        t_ns, channel, key, data = candump_line(text)
    except ValueError:
        return None
    match = LOG.fullmatch(text)
    if match:
        stamp = _stamp_places(text, match.start(1), match.end(2))
        name = match.span(4)
        places: _DataPlaces | None = _log_data(text, match, key, len(data))
    else:
        match = SCREEN.fullmatch(text)
        assert match is not None
        stamp = _stamp_places(text, *match.span(1))
        name = match.span(3)
        places = _screen_data(match, len(data))
    if stamp is None or places is None or t_ns > LATEST_NS - 100 * 10**9:
        return None
    data_place, others = places
    digits = tuple(field._replace(offset=field.offset + start) for field in stamp)
    open_ns = sum(int(line[field.offset:field.offset + field.size]) * field.scale_ns for field in digits)
    first, step, count = data_place
    return Shape(line, t_ns - open_ns, digits, channel, (name[0] + start, name[1] - name[0]), key & REMOTE,
                 (first + start, step, count), tuple((begin + start, end + start) for begin, end in others))


def learn_head(line: bytes) -> Shape | None:
    """The shape of what stands before the identifier of a line of the log form; None where there is none."""
    text = line.lstrip()
    match = LOG.fullmatch(text.rstrip())
    shape = learn(line) if match else None
    if match is None or shape is None:
        return None
    head = line[:len(line) - len(text) + match.start(4)]
    if len(head) + NAME_SIZE + 2 * HEAD_BYTES > LONGEST:
        return None
    return Shape(head, shape.base_ns, shape.digits, shape.channel, (0, 0), 0, (0, 2, 0), ())


def _stamp_places(text: bytes, begin: int, end: int) -> tuple[Digits, ...] | None:
    """Where the digits of a time stamp stand that change from line to line: two of the seconds, and the fraction."""
    if not (STAMP.fullmatch(text, begin, end) or DATE.fullmatch(text, begin, end)):
        return None
    point = text.rindex(b".", begin, end)
    seconds, fraction = min(2, point - begin), end - point - 1
    fields = [Digits(point - seconds, seconds, 10**9)]
    if fraction <= 8:
        fields.append(Digits(point + 1, fraction, 10 ** (9 - fraction)))
    else:
        fields += [Digits(point + 1, 8, 10), Digits(point + 9, 1, 1)]
    return tuple(fields)


def _log_data(text: bytes, match: Any, key: int, count: int) -> _DataPlaces:
    """Where the data of `ID#DATA` and `ID##FDATA` stand, and what else may differ: the flags F."""
    begin = match.start(5)
    if key & REMOTE:
        return (begin, 2, 0), ()
    if text[begin:begin + 1] == b"#":
        return (begin + 2, 2, count), ((begin + 1, begin + 2),)
    return (begin, 2, count), ()


def _screen_data(match: Any, count: int) -> _DataPlaces | None:
    """Where the data of `ID [8] 11 22` stand, and what else may differ: the characters they are shown as."""
    begin, rest = match.start(5), match[5]
    if rest.startswith(b"remote request") or not count:
        return (begin, 2, 0), ()
    spaced = BYTES.fullmatch(rest)
    assert spaced is not None
    step = 3
    if spaced[1].split() != spaced[1][:step * count].split(b" ")[:count] or len(spaced[1].rstrip()) != step * count - 1:
        return None
    shown = rest.find(b"'", spaced.end(1)), rest.rfind(b"'")
    return (begin, step, count), ((begin + shown[0] + 1, begin + shown[1]),) if 0 <= shown[0] < shown[1] else ()


class CandumpBlocks:
    """Reads candump text in blocks.

    file: where to read, at its beginning. bus(channel): index of a channel's bus, asked in the order of appearance.
    skip(reason): told of every line that can't be read, in order.
    """

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Callable[[str], None]):
        self._file = file
        self._bus = bus
        self._skip = skip
        self._heads: list[Shape] = []
        self._shapes: dict[int, list[Shape]] = {}
        self._buses: dict[bytes, int] = {}
        self._lines = 0
        self._rows = Rows(0)
        self._forget()

    def _forget(self) -> None:
        """Begin a block: no talker is known."""
        self._talkers: dict[tuple[bytes, int], int] = {}
        self._names: dict[tuple[bytes, int], Numbers] = {}

    def blocks(self, rows: int) -> Iterator[Block]:
        """The frames, so many or somewhat more a block; each block is good until the next is asked for.

        Raises what reading the file raises, after the frames before it.
        """
        self._rows = Rows(rows + CHUNK_BYTES // SHORT_LINE)
        try:
            for _ in self._chunks():
                if self._rows.count >= rows or len(self._talkers) >= MOST_TALKERS:
                    yield self._block()
        except (EOFError, OSError, zlib.error):
            if self._rows.count:
                yield self._block()
            raise
        if self._rows.count:
            yield self._block()

    def _block(self) -> Block:
        keys = [key | self._buses[channel] << BUS_SHIFT for channel, key in self._talkers]
        if len(keys) >= MOST_TALKERS:
            self._forget()
        return self._rows.block(keys)

    def _chunks(self) -> Iterator[None]:
        """Take the frames of the text in pieces of whole lines, and stop after each."""
        text = bytearray(CHUNK_BYTES + width_of(LONGEST))
        view, buffer = memoryview(text), np.frombuffer(text, np.uint8)
        filled, error, got = 0, None, 1
        while got:
            try:
                while filled < CHUNK_BYTES and got:
                    got = self._file.readinto1(view[filled:CHUNK_BYTES])  # type: ignore[attr-defined]
                    filled += got
            except (EOFError, OSError, zlib.error) as reason:
                error, got = reason, 0
            if not got and error is None and filled and text[filled - 1] != _NEWLINE:
                text[filled] = _NEWLINE
                filled += 1
            end = text.rfind(b"\n", 0, filled) + 1
            if end:
                self._take(buffer, end)
                yield
                text[:filled - end] = text[end:filled]
                filled -= end
            elif got:
                self._pass_over(bytes(text[:LONGEST]))
                filled = 0
        if error is not None:
            raise error

    def _pass_over(self, begin: bytes) -> None:
        """Leave out a line that is too long for the buffer, to its end."""
        self._lines += 1
        if not begin.lstrip().startswith(b"#"):
            self._skip(f"unreadable line {self._lines}: not candump text")
        while (rest := self._file.readline(CHUNK_BYTES)) and not rest.endswith(b"\n"):
            pass

    # --- a chunk of whole lines -------------------------------------------------------------------------------------------

    def _take(self, text: npt.NDArray[np.uint8], size: int) -> None:
        """Add the frames of the first so many characters of a text, whole lines. Behind them is room for one more."""
        ends = np.flatnonzero(text[:size] == _NEWLINE)
        starts = np.empty_like(ends)
        starts[0], starts[1:] = 0, ends[:-1] + 1
        sheet = Sheet(text, starts, ends, self._rows)
        self._read_log(sheet)
        if not sheet.found.all():
            self._read_others(sheet, np.flatnonzero(~sheet.found))
        self._lines += len(ends)
        for _, channel in sorted((row, channel) for channel, row in sheet.channels.items()):
            self._buses[channel] = self._bus(channel.decode("utf-8", "replace"))
        self._rows.keep(sheet.found, sheet.wide)

    def _read_log(self, sheet: Sheet) -> None:
        """Lines of the log form with up to eight data bytes, as far as they have heads that are known or can be learned."""
        rows: Ints | None = None
        for number, head in enumerate(self._heads):
            lines = sheet.words(rows, head.size + NAME_SIZE)
            fits = head.fits(lines)
            if fits.any():
                self._heads.insert(0, self._heads.pop(number))
                rows = self._read_head(sheet, head, rows, lines, fits)
                if not len(rows):
                    return
        while rows is None or len(rows) >= FEW_LINES:
            learned = learn_head(sheet.line(0 if rows is None else int(rows[0])))
            if learned is None:
                return
            self._heads.insert(0, learned)
            del self._heads[MAX_SHAPES:]
            lines = sheet.words(rows, learned.size + NAME_SIZE)
            rows = self._read_head(sheet, learned, rows, lines, learned.fits(lines))

    def _read_head(self, sheet: Sheet, head: Shape, rows: Ints | None, lines: npt.NDArray[np.uint64],
                   fits: npt.NDArray[np.bool_]) -> Ints:
        """Read those lines that a head fits; gives the others. rows: lines in question, None for all; lines: their beginnings."""
        others = _NO_ROWS
        if not fits.all():
            others = np.flatnonzero(~fits) if rows is None else rows[~fits]
            rows = np.flatnonzero(fits) if rows is None else rows[fits]
            lines = lines[fits]
        t_ns, wrong = head.times(lines)
        names = characters(lines, head.size)
        is_short = names & np.uint64(0xFF00_0000) == np.uint64(_MARK << 24)
        wrong |= ~is_short & (np.ndarray((len(lines),), np.uint8, lines, head.size + NAME_SIZE - 1, (lines.strides[0],)) != _MARK)
        talkers = self._names_of(head.channel, 0).of(np.where(is_short, names & np.uint64(0xFF_FFFF), names))
        wrong |= talkers < 0
        sizes, heads, wrong_data = sheet.short_data(rows, np.where(is_short, head.size + 4, head.size + NAME_SIZE))
        wrong |= wrong_data
        if wrong.any():
            right = np.flatnonzero(~wrong)
            rows = right if rows is None else rows[right]
            t_ns, talkers, sizes, heads = t_ns[right], talkers[right], sizes[right], heads[right]
        if len(t_ns):
            sheet.put(rows, head.channel, t_ns, talkers, sizes, heads)
        return others

    def _read_others(self, sheet: Sheet, rows: Ints) -> None:
        """All lines but those of the log form."""
        left = []
        lengths = sheet.ends[rows] - sheet.starts[rows]
        for length in np.flatnonzero(np.bincount(np.minimum(lengths, LONGEST + 1))).tolist():
            if length > LONGEST:
                left.append(rows[lengths > LONGEST])
            elif length:
                left += self._read_alike(sheet, rows[lengths == length], length)
        self._read_singly(sheet, np.sort(np.concatenate([_NO_ROWS, *left])).tolist())

    def _read_alike(self, sheet: Sheet, rows: Ints, length: int) -> Iterator[Ints]:
        """Lines of one length, shape by shape; gives those that are to be read one by one."""
        shapes = self._shapes.setdefault(length, [])
        for number, shape in enumerate(shapes):
            lines = sheet.words(rows, length)
            fits = shape.fits(lines)
            if fits.any():
                shapes.insert(0, shapes.pop(number))
                yield self._read_shape(sheet, shape, rows[fits], lines[fits])
                rows = rows[~fits]
        while len(rows) >= FEW_LINES and (learned := learn(sheet.line(int(rows[0])))) is not None:
            shapes.insert(0, learned)
            del shapes[MAX_SHAPES:]
            lines = sheet.words(rows, length)
            fits = learned.fits(lines)
            yield self._read_shape(sheet, learned, rows[fits], lines[fits])
            rows = rows[~fits]
        yield rows

    def _read_shape(self, sheet: Sheet, shape: Shape, rows: Ints, lines: npt.NDArray[np.uint64]) -> Ints:
        """Lines of one shape; gives those that turn out not to be."""
        t_ns, wrong = shape.times(lines)
        talkers = self._names_of(shape.channel, shape.flags).of(shape.names(lines))
        payloads, wrong_data = shape.payloads(lines)
        wrong |= wrong_data
        wrong |= talkers < 0
        right = ~wrong
        if right.any():
            sheet.put_payloads(rows[right], shape.channel, t_ns[right], talkers[right], payloads[right])
        return rows[wrong]

    def _names_of(self, channel: bytes, flags: int) -> Numbers:
        if (channel, flags) not in self._names:
            self._names[channel, flags] = Numbers(lambda word: self._resolve(channel, flags, word))
        return self._names[channel, flags]

    def _resolve(self, channel: bytes, flags: int, word: int) -> int:
        """The talker of an identifier as it is spelled, negative where it is none."""
        name = word.to_bytes(8, "little").rstrip(b"\0")
        try:
            return self._talker(channel, spelled_id(name) | flags) if HEXADECIMAL.fullmatch(name) else -1
        except ValueError:
            return -1

    def _talker(self, channel: bytes, key: int) -> int:
        return self._talkers.setdefault((channel, key), len(self._talkers))

    def _read_singly(self, sheet: Sheet, rows: list[int]) -> None:
        """Lines that are like no others, by the scalar reader."""
        for row in rows:
            text = sheet.line(row).strip()
            if not text or text.startswith(b"#"):
                continue
            try:
                t_ns, channel, key, data = candump_line(text)
            except ValueError as error:
                self._skip(f"unreadable line {self._lines + row + 1}: {error}")
                continue
            sheet.put_payloads(np.array([row]), channel, np.array([t_ns]), np.array([self._talker(channel, key)], np.int32),
                               np.frombuffer(data, np.uint8)[None, :])


class Sheet:
    """The lines of a chunk, from `starts` to `ends` in a text, whose frames go into the next of some rows.

    found: which lines are frames; wide: lines of those longer than a head, and their payloads; channels: first line of each.
    """

    def __init__(self, text: npt.NDArray[np.uint8], starts: Ints, ends: Ints, rows: Rows):
        self.text, self.starts, self.ends = text, starts, ends
        self.channels: dict[bytes, int] = {}
        self.wide: list[tuple[Ints, npt.NDArray[np.uint8]]] = []
        self.found = np.zeros(len(starts), bool)
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

    def short_data(self, rows: Ints | None, offsets: Ints) -> tuple[npt.NDArray[np.uint16], Words, npt.NDArray[np.bool_]]:
        """Sizes and heads of payloads of up to eight bytes that begin at these places of their lines and end with them; and
        which are none."""
        begins = (self.starts if rows is None else self.starts[rows]) + offsets
        digits = (self.ends if rows is None else self.ends[rows]) - begins
        values = HEX_PAIRS.take(self._at(begins, 16).view("<u2"), mode="clip")
        wrong = np.zeros(len(begins), bool)
        if digits.min() != 16 or digits.max() != 16:
            wrong = (digits < 0) | (digits > 16) | (digits & 1 != 0)
            some = np.flatnonzero(digits != 16)
            part = values[some]
            part[np.arange(HEAD_BYTES) >= digits[some, None] >> 1] = 0
            values[some] = part
        if int(values.max(initial=0)) > 0xFF:
            wrong |= np.any(values > 0xFF, axis=1)
        return (digits >> 1).astype(np.uint16), values.astype(np.uint8).view("<u8")[:, 0], wrong

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
