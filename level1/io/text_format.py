"""ASC and TRC text (and python-can's own csv), line by line, by python-can's readers: they know all variants.

A line of these formats means the same wherever it stands; only the header before the first of them says how all are to be read. So
lines can be read on their own (`text_blocks`), each time with the header before them; and a broken line costs only itself, where
python-can's readers end.
"""
from __future__ import annotations

import io
import logging
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import TYPE_CHECKING, Any, BinaryIO

from level1.io.message import from_message

if TYPE_CHECKING:
    import can

LATEST_S = 1 << 33
"""Time stamps from here on, in the year 2242, are none."""
HOPELESS_LINES = 1000
"""A file whose first so many lines are all unreadable is given up."""

_ASC_STAMP = re.compile(r"\s*(\d+\.\d+)\s")
_RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative\b", re.IGNORECASE)
_MOST_HEADER_LINES = 10_000

Line = tuple[int, str]
"""A line and its number, from 1."""
Read = tuple[int, int, str, int, bytes]
"""Number of the line, time stamp in ns, channel, identifier with its flags (`Frame.key` without a bus), data."""


class TextFormat:
    """A file of one of these formats, whose header is read. head: its lines.

    skip(reason): told of each line that can't be read.
    """

    def __init__(self, file: BinaryIO, suffix: str, skip: Callable[[str], None]):
        from can.io.player import MESSAGE_READERS
        self._reader: Callable[..., Iterable[can.Message]] = MESSAGE_READERS[suffix]
        self._file = file
        self.suffix = suffix
        self._skip = skip
        self._hopes = HOPELESS_LINES
        # python-can counts channels of ASC from 0, the files from 1.
        self._first_channel = 1 if suffix == ".asc" else 0
        self.head = self._header()

    @property
    def is_relative(self) -> bool:
        """Whether each stamp counts from the line before (ASC with `timestamps relative`): python-can knows nothing of it."""
        return self.suffix == ".asc" and any(map(_RELATIVE.match, self.head))

    def quiet(self) -> TextFormat:
        """The same, which tells of nothing."""
        twin = copy(self)
        twin._skip, twin._hopes = lambda reason: None, -1
        return twin

    def _header(self) -> list[str]:
        """Read the header, up to the first line that is none."""
        head: list[str] = []
        while len(head) < _MOST_HEADER_LINES:
            place = self._file.tell()
            line = self._file.readline().decode("utf-8", "replace")
            is_body = {".asc": bool(_ASC_STAMP.match(line)), ".trc": not line.startswith(";"), ".csv": bool(head)}[self.suffix]
            if not line or is_body:
                self._file.seek(place)
                break
            head.append(line)
        return head

    def all_frames(self) -> Iterator[Read]:
        """The frames of the rest of the file."""
        text = io.TextIOWrapper(self._file, encoding="utf-8", errors="replace", newline="\n")
        lines: Iterator[Line] = enumerate(text, len(self.head) + 1)
        return self.frames(_absolute(lines) if self.is_relative else lines)

    def frames(self, lines: Iterable[Line]) -> Iterator[Read]:
        """The frames that some lines hold."""
        source = _Lines(self.head, lines, self.suffix)
        with _warnings_as(lambda text: self._skip(f"unreadable line {source.number}: {text}")):
            while self._hopes and source.begin():
                try:
                    for message in self._reader(source):
                        read = self._read(source.number, message)
                        if read is not None:
                            self._hopes = -1
                            yield read
                except (ValueError, LookupError, TypeError, ArithmeticError, NotImplementedError) as error:
                    self._complain(source.number, error)

    def _complain(self, number: int, error: object) -> None:
        self._skip(f"unreadable line {number}: {error}")
        self._hopes -= self._hopes > 0

    def _read(self, number: int, message: can.Message) -> Read | None:
        channel = message.channel
        name = str(channel + self._first_channel if isinstance(channel, int) else channel or "")
        try:
            return number, stamp_ns(message.timestamp), name, *from_message(message)
        except ValueError as error:
            self._complain(number, error)
            return None


class _Lines:
    """Lines of a text file as python-can's readers take them, each time behind the header. number: of the line read last.

    Empty lines and comments are left out: at the begin python-can's readers take them for something else than further on.
    """

    def __init__(self, head: list[str], lines: Iterable[Line], suffix: str):
        # The ASC reader swallows one line behind the header, whatever it is; it gets an empty one.
        self._head = [*head, "\n"] if suffix == ".asc" else head
        self._lines = (each for each in lines if each[1].strip() and not (suffix == ".trc" and each[1].lstrip().startswith(";")))
        self._pending: Iterator[str] = iter(())
        self._next: Line | None = None
        self.number = len(head)

    def begin(self) -> bool:
        """Begin with the header once more, if there is a line behind it."""
        self._pending = iter(self._head)
        self._next = self._next or next(self._lines, None)
        return self._next is not None

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        for head_line in self._pending:
            return head_line
        self.number, line = self._next or next(self._lines)
        self._next = None
        return line

    def read(self, size: int = -1) -> str:
        """python-can takes what has `read` and `write` for a file; it reads by lines only."""
        raise io.UnsupportedOperation("read")

    write = read

    def close(self) -> None:
        """The owner of the file closes it."""


def _absolute(lines: Iterable[Line]) -> Iterator[Line]:
    """Lines with stamps from the beginning in place of those from the line before."""
    total_us = 0
    for number, line in lines:
        match = _ASC_STAMP.match(line)
        if match is not None:
            total_us += round(float(match[1]) * 1e6)
            line = f"{total_us // 10**6}.{total_us % 10**6:06}{line[match.end(1):]}"
        yield number, line


def stamp_ns(stamp_s: float) -> int:
    """A floating-point stamp of seconds in ns, rounded to the microsecond. Raises ValueError when it can't be one."""
    if not 0 <= stamp_s < LATEST_S:
        raise ValueError(f"time stamp {stamp_s} out of range")
    return round(stamp_s * 1_000_000) * 1000


@contextmanager
def _warnings_as(tell: Callable[[str], Any]) -> Iterator[None]:
    """Within it, lines that python-can's readers drop with a warning are told to `tell` rather than to the terminal."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if "Failed to parse" in record.msg:
                tell(record.getMessage())

    logger, handler = logging.getLogger("can.io"), Handler(logging.WARNING)
    propagate, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate
