"""Recordings: their frames with exact integer time stamps, whatever the format.

candump text (the log form of `candump -l`/`-L` and the screen form with time stamps) and SavvyCAN's GVRET text are read
here, because their decimal stamps must become exactly as many nanoseconds; every other format goes through python-can's
readers, whose floating-point stamps are rounded to the microsecond (all they hold at today's epoch).

Nothing in a file stops the reading for good: a line that can't be read is skipped, counted and told. Stamps that run
backwards are handed on as they stand; the supervisor clamps and counts them.
"""
from __future__ import annotations

import gzip
import io
import itertools
import logging
import re
import zlib
from binascii import unhexlify
from calendar import timegm
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Frame
from level1.io.error import OutsideError
from level1.io.message import CLASSIC_BYTES, FD_BYTES, bounded, flagged_id, from_message

if TYPE_CHECKING:
    import can

TOLD_LINES = 3
"""How many unreadable lines are told in words; all are counted."""
HOPELESS_LINES = 1000
"""A file whose first so many lines are all unreadable is given up."""
EPOCH_NS = 1_000_000_000 * 10**9
"""Stamps above (9 September 2001) are UTC; below they count from the recording's start."""

_LOG = re.compile(rb"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]+)#(\S*)(?:\s+[RT])?\s*")
_SCREEN = re.compile(rb"(?:\(([^)]*)\))?\s*(\S+)\s+(?:(?:RX|TX)\s+\S+\s+\S+\s+)?"
                     rb"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[(\d+)\]\s*(.*)")
_STAMP = re.compile(rb"(\d+)\.(\d{1,9})")
_DATE = re.compile(rb"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{1,9})")
_BYTES = re.compile(rb"((?:[0-9A-Fa-f]{2}(?:\s+|$))*)(?:'.*'|ERRORFRAME)?\s*")
_ASC_FRAME = re.compile(r"\s*\d+\.\d+\s")
_GVRET_HEAD = re.compile(rb"Time Stamp,ID,Extended,(Dir,)?Bus,LEN\b")
_SUFFIXES = (".asc", ".blf", ".csv", ".mf4", ".trc")
_HINT = "known: candump text, .asc, .blf, .csv, .mf4, .trc, also with .gz"


class LogError(OutsideError):
    """A recording that can't be used."""


class Log:
    """One recording. Iterate `frames` or `batches` once; the counts tell what was met so far.

    channels: channel name -> bus index, `buses` first, every other in the order of appearance; with `one_bus` every
    channel not in `buses` is bus 0. channels_seen: those that frames came from.
    frames_read: frames handed on, error_frames and remote_frames among them. skipped: lines or objects left out, the
    first of them in words in `complaints`. first_ns, last_ns: first and highest time stamp.
    """

    def __init__(self, path: str | Path, buses: Mapping[str, int] | None = None, *, one_bus: bool = False):
        """Open a recording and find out its format. Raises LogError when there is none, or of no known format."""
        self.path = Path(path)
        self.channels: dict[str, int] = dict(buses or {})
        self.channels_seen: set[str] = set()
        self._one_bus = one_bus
        self.frames_read = self.error_frames = self.remote_frames = self.skipped = 0
        self.first_ns = self.last_ns = 0
        self.complaints: list[str] = []
        self._raw, self._size = _open(self.path)
        packed = self.path.suffix.lower() == ".gz"
        self._file = cast(BinaryIO, gzip.GzipFile(fileobj=self._raw)) if packed else self._raw
        try:
            self._read = self._reader()
        except LogError:
            self._raw.close()
            raise

    @property
    def fraction(self) -> float:
        """How much of the file has been read, 0 to 1."""
        return 1.0 if self._raw.closed else self._raw.tell() / self._size

    @property
    def is_utc(self) -> bool:
        """Whether the stamps are UTC rather than counted from the recording's start."""
        return self.first_ns >= EPOCH_NS

    def frames(self) -> Iterator[Frame]:
        """The frames in the order of the file. Raises LogError at the end when there was none."""
        with self._raw:
            try:
                for frame in self._read():
                    if not self.frames_read:
                        self.first_ns = self.last_ns = frame.t_ns
                    elif frame.t_ns > self.last_ns:
                        self.last_ns = frame.t_ns
                    self.frames_read += 1
                    yield frame
            except (EOFError, OSError, zlib.error) as error:
                self._skip(f"the file ends in the middle or is damaged: {error}")
        if not self.frames_read:
            reason = f"no readable frame; {self.complaints[0]}" if self.complaints else "holds no frame"
            raise LogError(f"{self.path}: {reason}")

    def batches(self, size: int = 4096) -> Iterator[list[Frame]]:
        """The frames in lists of at most `size`."""
        frames = self.frames()
        while batch := list(itertools.islice(frames, size)):
            yield batch

    def bus(self, channel: str) -> int:
        """Index of the bus of a channel; a channel not seen before takes the lowest free one."""
        if channel not in self.channels_seen:
            self.channels_seen.add(channel)
            taken = () if self._one_bus else set(self.channels.values())
            self.channels.setdefault(channel, next(index for index in itertools.count() if index not in taken))
        return self.channels[channel]

    def _reader(self) -> Callable[[], Iterator[Frame]]:
        """What reads this file: by its content where that tells, else by its name."""
        try:
            head = self._file.read(1 << 16)
            self._file.seek(0)
        except (EOFError, OSError, zlib.error) as error:
            raise LogError(f"{self.path}: can't be unpacked: {error}") from None
        if not head.strip():
            raise LogError(f"{self.path}: the file is empty")
        name = self.path.name.lower().removesuffix(".gz")
        suffix = next((suffix for suffix in _SUFFIXES if name.endswith(suffix)), "")
        if _GVRET_HEAD.match(head):
            return self._gvret
        if suffix:
            return lambda: self._python_can(suffix)
        if any(_LOG.fullmatch(line) or _SCREEN.fullmatch(line.strip()) for line in head.splitlines()):
            return self._candump
        raise LogError(f"{self.path}: no recording of a known format; {_HINT}")

    def _skip(self, reason: str) -> None:
        self.skipped += 1
        if len(self.complaints) < TOLD_LINES:
            self.complaints.append(reason)

    def _candump(self) -> Iterator[Frame]:
        """candump text. The common form takes the short way; everything else, and every doubt, `candump_line`."""
        keys: dict[bytes, dict[bytes, int]] = {}
        for number, line in enumerate(self._file, 1):
            try:
                stamp, channel, body = line.split()
                name, _, payload = body.partition(b"#")
                key = keys[channel][name]
                data = unhexlify(payload)
                if len(data) <= CLASSIC_BYTES and stamp[-8] == 46 and stamp[1:-8].isdigit() and stamp[-7:-1].isdigit():
                    yield Frame(int(stamp[1:-8]) * 10**9 + int(stamp[-7:-1]) * 1000, key, data)
                    continue
            except (ValueError, KeyError, IndexError):
                pass
            text = line.strip()
            if not text or text.startswith(b"#"):
                continue
            try:
                t_ns, channel, plain_key, data = candump_line(text)
            except ValueError as error:
                self._skip(f"unreadable line {number}: {error}")
                continue
            key = plain_key | self.bus(channel.decode("utf-8", "replace")) << BUS_SHIFT
            if not plain_key & (ERROR | REMOTE):
                keys.setdefault(channel, {})[b"%08X" % (plain_key & 0x1FFFFFFF) if plain_key & EXTENDED
                                             else b"%03X" % plain_key] = key
            yield self._counted(t_ns, key, data)

    def _gvret(self) -> Iterator[Frame]:
        """SavvyCAN's csv: `Time Stamp,ID,Extended,[Dir,]Bus,LEN,D1,…`, microseconds, hexadecimal."""
        columns = [name.strip() for name in self._file.readline().split(b",")]
        bus, length = columns.index(b"Bus"), columns.index(b"LEN")
        for number, line in enumerate(self._file, 2):
            cells = line.strip().split(b",")
            if cells == [b""]:
                continue
            try:
                size = int(cells[length])
                data = bytes(int(cell, 16) for cell in cells[length + 1:length + 1 + size])
                can_id = flagged_id(int(cells[1], 16), cells[2].strip().lower() == b"true")
                if len(data) != size or size > FD_BYTES:
                    raise ValueError(f"{len(data)} of {size} data bytes")
                if not cells[0].isdigit():
                    raise ValueError("no time stamp in microseconds")
                yield self._counted(int(cells[0]) * 1000, can_id | self.bus(cells[bus].decode()) << BUS_SHIFT, data)
            except (ValueError, IndexError) as error:
                self._skip(f"unreadable line {number}: {error}")

    def _python_can(self, suffix: str) -> Iterator[Frame]:
        """Any other format, through python-can's reader of that suffix."""
        from can.io.player import MESSAGE_READERS
        reader = MESSAGE_READERS[suffix]
        first_channel = 1 if suffix in (".asc", ".blf") else 0  # python-can counts these from 0, the files from 1
        with _warnings_as(lambda text: self._skip(f"unreadable: {text}")):
            if suffix in (".blf", ".mf4"):
                messages = self._binary(reader, suffix)
            else:
                messages = self._text(reader, suffix)
            for message in messages:
                channel = message.channel
                name = str(channel + first_channel if isinstance(channel, int) else channel or "")
                try:
                    t_ns, (key, data) = stamp_ns(message.timestamp), from_message(message)
                except ValueError as error:
                    self._skip(f"unreadable frame {self.frames_read + self.skipped + 1}: {error}")
                    continue
                yield self._counted(t_ns, key | self.bus(name) << BUS_SHIFT, data)

    def _binary(self, reader: Callable[..., Iterable[can.Message]], suffix: str) -> Iterator[can.Message]:
        """Frames of a binary file, up to where it is damaged."""
        try:
            yield from reader(self.path if suffix == ".mf4" else self._file)
        except NotImplementedError:
            raise LogError(f"{self.path}: MF4 needs a package more: pip install 'tractor-ucs[mf4]'") from None
        except (EOFError, OSError, zlib.error):
            raise
        except Exception as error:  # whatever bytes make python-can's and asammdf's parsers raise
            self._skip(f"the file ends in the middle or is damaged: {error or type(error).__name__}")

    def _text(self, reader: Callable[..., Iterable[can.Message]], suffix: str) -> Iterator[can.Message]:
        """Frames of a text file. python-can's readers end at a broken line: begin anew behind it, with the header."""
        lines = _Lines(self._file, suffix)
        while True:
            try:
                yield from reader(lines)
                return
            except (ValueError, LookupError, TypeError, ArithmeticError, NotImplementedError) as error:
                self._skip(f"unreadable line {lines.number}: {error}")
                if lines.at_end or (self.skipped >= HOPELESS_LINES and not self.frames_read):
                    return
                lines.again()

    def _counted(self, t_ns: int, key: int, data: bytes) -> Frame:
        """The frame, counted when it is an error or a remote frame."""
        self.error_frames += bool(key & ERROR)
        self.remote_frames += bool(key & REMOTE)
        return Frame(t_ns, key, data)


class _Lines:
    """Lines of a text file as python-can's readers take them, counted; `again` starts with the header once more."""

    def __init__(self, file: BinaryIO, suffix: str):
        self._lines = iter(io.TextIOWrapper(file, encoding="utf-8", errors="replace"))
        self._head, rest = self._split(suffix)
        self._rest: Iterator[str] = itertools.chain(rest, self._lines)
        self._read = 0
        self.at_end = False
        # The ASC reader swallows one line behind the header, whatever it is; it gets an empty one.
        self._filler = ["\n"] if suffix == ".asc" else []
        self._pending: Iterator[str] = itertools.chain(self._head, self._filler)

    @property
    def number(self) -> int:
        """Number of the line read last, from 1."""
        return len(self._head) + self._read

    def again(self) -> None:
        self._pending = itertools.chain(self._head, self._filler)

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        for line in self._pending:
            return line
        try:
            line = next(self._rest)
        except StopIteration:
            self.at_end = True
            raise
        self._read += 1
        return line

    def read(self, size: int = -1) -> str:
        """python-can takes what has `read` and `write` for a file; it reads by lines only."""
        raise io.UnsupportedOperation("read")

    write = read

    def close(self) -> None:
        """The owner of the file closes it."""

    def _split(self, suffix: str) -> tuple[list[str], list[str]]:
        """Header lines, and the first line behind them."""
        head: list[str] = []
        for line in self._lines:
            if (suffix == ".csv" and head) or (suffix == ".trc" and not line.startswith(";")) or (
                    suffix == ".asc" and _ASC_FRAME.match(line)):
                return head, [line]
            head.append(line)
        return head, []


def candump_line(line: bytes) -> tuple[int, bytes, int, bytes]:
    """Time stamp in ns, channel, identifier with its flags (`Frame.key` without a bus) and data of a candump line.

    Raises ValueError with what is wrong.
    """
    if match := _LOG.fullmatch(line):
        seconds, fraction, channel, name, payload = match.groups()
        return _nanoseconds(seconds, fraction), channel, *_log_frame(name, payload)
    if match := _SCREEN.fullmatch(line):
        stamp, channel, name, length, rest = match.groups()
        return _stamp(stamp), channel, *_screen_frame(name, length, rest)
    raise ValueError("not candump text")


def _log_frame(name: bytes, payload: bytes) -> tuple[int, bytes]:
    """Flagged identifier and data of `ID#DATA`, `ID#R`, `ID##FDATA` (can-utils, lib.h)."""
    can_id = _spelled_id(name)
    if payload.startswith(b"#"):
        return can_id, _data(payload[2:], FD_BYTES)
    if payload[:1] in (b"R", b"r"):
        return can_id | REMOTE, b""
    return can_id, _data(payload.split(b"_")[0], CLASSIC_BYTES)


def _screen_frame(name: bytes, length: bytes, rest: bytes) -> tuple[int, bytes]:
    """Flagged identifier and data of `ID [8] 11 22 …`; a length in two digits is CAN FD's."""
    can_id = _spelled_id(name)
    if rest.startswith(b"remote request"):
        return can_id | REMOTE, b""
    match = _BYTES.fullmatch(rest)
    if not match:
        raise ValueError("data bytes are not hexadecimal")
    data = _data(b"".join(match[1].split()), FD_BYTES if len(length) > 1 else CLASSIC_BYTES)
    if len(data) != int(length):
        raise ValueError(f"{len(data)} of {int(length)} data bytes")
    return can_id, data


def _spelled_id(name: bytes) -> int:
    """Identifier with the flags that its spelling means: 3 digits standard, 8 extended or an error frame."""
    value = int(name, 16)
    if len(name) == 8 and value >> 29 == 1:
        return value
    if len(name) not in (3, 8):
        raise ValueError(f"the identifier {name.decode()} has {len(name)} digits; candump writes 3 or 8")
    return flagged_id(value, len(name) == 8)


def _data(digits: bytes, limit: int) -> bytes:
    try:
        data = unhexlify(digits)
    except ValueError:
        raise ValueError("data bytes are not pairs of hexadecimal digits") from None
    return bounded(data, limit)


def _nanoseconds(seconds: bytes, fraction: bytes) -> int:
    return int(seconds) * 10**9 + int(fraction.ljust(9, b"0"))


def _stamp(text: bytes | None) -> int:
    """Nanoseconds of a screen stamp: seconds, or a date and time, which is taken as UTC."""
    if text is None:
        raise ValueError("no time stamp; record with `candump -L` or `candump -ta`")
    if match := _STAMP.fullmatch(text):
        return _nanoseconds(*match.groups())
    if match := _DATE.fullmatch(text):
        return _nanoseconds(b"%d" % timegm((*map(int, match.groups()[:6]), 0, 0, 0)), match[7])
    raise ValueError(f'unreadable time stamp "{text.decode("ascii", "replace")}"')


def stamp_ns(stamp_s: float) -> int:
    """A floating-point stamp of seconds in ns, rounded to the microsecond. Raises ValueError when it can't be one."""
    if not 0 <= stamp_s < 2**33:
        raise ValueError(f"time stamp {stamp_s} out of range")
    return round(stamp_s * 1_000_000) * 1000


def _open(path: Path) -> tuple[BinaryIO, int]:
    """The file and its size in bytes."""
    try:
        return path.open("rb"), path.stat().st_size or 1
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except OSError as error:
        raise LogError(f"{path}: can't be read: {error.strerror}") from None


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
