"""ASC and TRC text in blocks (see `line_blocks`). A shape is only learned from a line that python-can's reader understands as the
places say; lines that are like no others, and all before the first frame, are read by python-can's reader (`text_format`).
"""
from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import BinaryIO, NamedTuple

import numpy as np

from level1.frame import EXTENDED
from level1.io.line_blocks import Digits, LineBlocks, Shape, Sheet
from level1.io.message import flagged_id
from level1.io.text_format import LATEST_S, TextFormat

_ASC = re.compile(rb"\s*(\d+)\.(\d{1,6})\s+\d+\s+([0-9A-Fa-f]{1,8})(x?)\s+[RT]x\s+d\s+([0-8])(?:\s|$)")
"""`stamp channel ID[x] Rx d length data`."""
_ASC_FD = re.compile(rb"\s*(\d+)\.(\d{1,6})\s+CANFD\s+\d+\s+[RT]x\s+([0-9A-Fa-f]{1,8})(x?)\s+(?:\S*[^\s\d]\S*\s+)?[01]\s+[01]\s+"
                     rb"[0-9A-Fa-f]\s+(\d{1,2})(?:\s|$)")
"""`stamp CANFD channel Rx ID[x] [name] BRS ESI DLC length data`."""
_PAIRS = re.compile(rb"[0-9A-Fa-f]{2}(?: [0-9A-Fa-f]{2})*")
_TOKEN = re.compile(rb"\S+")
_TRC_VERSIONS = {"1.1": (1, 3, 5), "1.3": (1, 4, 7)}
"""Columns of stamp, identifier and data; 1.0 has (1, 2, 4)."""
_MOST_DIGITS = 8


class Places(NamedTuple):
    """Where in a line what stands: digits that count, identifier (and whether it is spelled as an extended one), data as in
    `Shape.data`, and what else may differ."""

    digits: tuple[Digits, ...]
    name: tuple[int, int]
    extended: bool
    data: tuple[int, int, int]
    others: tuple[tuple[int, int], ...] = ()


Finder = Callable[[bytes], Places | None]


def places_of(text: TextFormat) -> Finder | None:
    """What finds the places in lines of a file; None where its lines are to be read one by one."""
    head = "".join(text.head).lower()
    if text.suffix == ".asc":
        return None if text.is_relative or re.search(r"^\s*base\s+dec", head, re.MULTILINE) else asc_places
    version = re.search(r"^;\$fileversion=(\S+)", head, re.MULTILINE)
    if version is None:
        return partial(trc_places, (1, 2, 4))
    if version[1] in _TRC_VERSIONS:
        return partial(trc_places, _TRC_VERSIONS[version[1]])
    names = re.search(r"^;\$COLUMNS=(\S+)", "".join(text.head), re.MULTILINE)
    columns = names[1].split(",") if names else []
    if version[1] not in ("2.0", "2.1") or columns[:2] != ["N", "O"] or columns[-1] != "D" or "I" not in columns:
        return None
    return partial(trc_places, (1, columns.index("I"), len(columns) - 1))


def asc_places(line: bytes) -> Places | None:
    """The places in a line of ASC."""
    match = _ASC.match(line) or _ASC_FD.match(line)
    if match is None:
        return None
    begin, size = match.end(), int(match[5])
    begin += len(line) - begin - len(line[begin:].lstrip())
    if size:
        end = begin + 3 * size - 1
        if not _PAIRS.fullmatch(line, begin, end) or not (line[end:end + 1].isspace() or end == len(line)):
            return None
    else:
        begin = end = match.end(5)
    stamp = (*_whole(match.start(1), match.end(1), 10**9, 2), Digits(match.start(2), len(match[2]), 10 ** (9 - len(match[2]))))
    tail = ((end + 1, len(line)),) if end + 1 < len(line) else ()
    return Places(stamp, (match.start(3), len(match[3])), bool(match[4]), (begin, 3, size), tail)


def trc_places(columns: tuple[int, int, int], line: bytes) -> Places | None:
    """The places in a line of TRC, whose stamp, identifier and data stand in these columns."""
    cells = [match.span() for match in _TOKEN.finditer(line)]
    stamp, name, data = columns
    if len(cells) < data or not cells:
        return None
    number = re.fullmatch(rb"(\d{1,8})\)?", line[slice(*cells[0])])
    offset = re.fullmatch(rb"(\d+)(?:\.(\d{1,3}))?", line[slice(*cells[stamp])])
    if number is None or offset is None or not re.fullmatch(rb"[0-9A-Fa-f]{1,8}", line[slice(*cells[name])]):
        return None
    begin = cells[data][0] if len(cells) > data else len(line)
    rest = line[begin:].rstrip()
    if rest and not _PAIRS.fullmatch(rest):
        return None
    first = cells[stamp][0]
    digits = [Digits(cells[0][0], len(number[1]), 0), *_whole(first, first + len(offset[1]), 10**6, 5)]
    if offset[2]:
        digits.append(Digits(first + len(offset[1]) + 1, len(offset[2]), 10 ** (6 - len(offset[2]))))
    size = cells[name][1] - cells[name][0]
    return Places(tuple(digits), (cells[name][0], size), size > 4, (begin, 3, (len(rest) + 1) // 3))


def _whole(begin: int, end: int, scale_ns: int, most: int) -> tuple[Digits]:
    """The last so many digits of a whole number."""
    size = min(most, end - begin)
    return (Digits(end - size, size, scale_ns),)


class TextBlocks(LineBlocks):
    """Reads ASC or TRC in blocks. text: the file, its header read; places: finds them in its lines."""

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Callable[[str], None], text: TextFormat, places: Finder):
        super().__init__(file, bus, skip, len(text.head))
        self._text = text
        self._quiet = text.quiet()
        self._places = places
        self._has_begun = False

    def _learn(self, line: bytes) -> Shape | None:
        places = self._places(line)
        reads = list(self._quiet.frames([(0, line.decode("utf-8", "replace"))])) if places is not None else []
        if places is None or len(reads) != 1:
            return None
        _, t_ns, channel, key, data = reads[0]
        if t_ns > (LATEST_S - 100) * 10**9:  # two digits of the seconds are open
            return None
        first, step, count = places.data
        digits = b"".join(line[first + step * place:first + step * place + 2] for place in range(count))
        name = line[places.name[0]:sum(places.name)]
        flags = EXTENDED if places.extended else 0
        if bytes.fromhex(digits.decode()) != data or self._key(name, flags) != key:
            return None
        open_ns = sum(int(line[field.offset:field.offset + field.size]) * field.scale_ns for field in places.digits)
        return Shape(line, t_ns - open_ns, places.digits, channel.encode(), places.name, flags, places.data, places.others)

    def _key(self, name: bytes, flags: int) -> int:
        value = int(name, 16)
        return flagged_id(value, bool(flags) or value > 0x7FF)

    def _read_first(self, sheet: Sheet) -> None:
        if not self._has_begun:
            self._read_by_python_can(sheet, range(len(sheet.starts)), only_first=True)

    def _read_singly(self, sheet: Sheet, rows: list[int]) -> None:
        if rows and self._has_begun:
            self._read_by_python_can(sheet, rows)

    def _read_by_python_can(self, sheet: Sheet, rows: Sequence[int], only_first: bool = False) -> None:
        """Read some lines; or, of all lines, those up to the first frame: whether a file is given up is decided before it."""
        lines = ((row, sheet.line(row).decode("utf-8", "replace")) for row in rows)
        for row, t_ns, channel, key, data in self._text.frames((self._lines + row + 1, line) for row, line in lines):
            place = row - self._lines - 1
            sheet.put_payloads(np.array([place]), channel.encode(), np.array([t_ns]),
                               np.array([self._talker(channel.encode(), key)], np.int32), np.frombuffer(data, np.uint8)[None, :])
            if only_first:
                self._has_begun = True
                sheet.done = place + 1
                return
        if only_first:
            sheet.done = len(sheet.starts)

    def _pass_over(self, begin: bytes) -> None:
        self._skip(f"unreadable line {self._lines}: too long")
