"""candump text in blocks (see `line_blocks`); lines that are like no others by `candump.candump_line`.

By far most lines are of the log form, `(stamp) channel ID#DATA` or `ID##FDATA`. They need no shape of each length: where the
shape of their *head* fits, up to the identifier, the rest is read in one go.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Ints
from level1.frame import REMOTE
from level1.io.candump import BYTES, DATE, LATEST_NS, LOG, SCREEN, STAMP, candump_line, spelled_id
from level1.io.line_blocks import FEW_LINES, LONGEST, MARK, MAX_SHAPES, NO_ROWS, Digits, LineBlocks, Shape, Sheet, characters

NAME_SIZE = 9
"""Characters of the longest identifier and the mark behind it."""
_DataPlaces = tuple[tuple[int, int, int], tuple[tuple[int, int], ...]]
"""Of the data of a line: offset, step and bytes as in `Shape.data`; and begin and end of what else is open."""


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


class CandumpBlocks(LineBlocks):
    """Reads candump text in blocks."""

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Callable[[str], None]):
        super().__init__(file, bus, skip)
        self._heads: list[Shape] = []

    def _learn(self, line: bytes) -> Shape | None:
        return learn(line)

    def _key(self, name: bytes, flags: int) -> int:
        return spelled_id(name) | flags

    def _pass_over(self, begin: bytes) -> None:
        if not begin.lstrip().startswith(b"#"):
            self._skip(f"unreadable line {self._lines}: not candump text")

    def _read_first(self, sheet: Sheet) -> None:
        """Lines of the log form, as far as they have heads that are known or can be learned."""
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
        others = NO_ROWS
        if not fits.all():
            others = np.flatnonzero(~fits) if rows is None else rows[~fits]
            rows = np.flatnonzero(fits) if rows is None else rows[fits]
            lines = lines[fits]
        t_ns, wrong = head.times(lines)
        names = characters(lines, head.size)
        is_short = names & np.uint64(0xFF00_0000) == np.uint64(MARK << 24)
        wrong |= ~is_short & (np.ndarray((len(lines),), np.uint8, lines, head.size + NAME_SIZE - 1, (lines.strides[0],)) != MARK)
        talkers = self._names_of(head.channel, 0).of(np.where(is_short, names & np.uint64(0xFF_FFFF), names))
        wrong |= talkers < 0
        begins = (sheet.starts if rows is None else sheet.starts[rows]) + np.where(is_short, head.size + 4, head.size + NAME_SIZE)
        longer = sheet.fd_data(begins, wrong)
        sizes, heads, wrong_data = sheet.data(rows, begins, longer)
        wrong |= wrong_data
        if len(longer):
            sheet.keep_wide(rows, begins, longer, wrong)
        if wrong.any():
            right = np.flatnonzero(~wrong)
            rows = right if rows is None else rows[right]
            t_ns, talkers, sizes, heads = t_ns[right], talkers[right], sizes[right], heads[right]
        if len(t_ns):
            sheet.put(rows, head.channel, t_ns, talkers, sizes, heads)
        return others

    def _read_singly(self, sheet: Sheet, rows: list[int]) -> None:
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


