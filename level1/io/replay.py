"""Recordings: their frames with exact integer time stamps, whatever the format.

candump text (the log form of `candump -l`/`-L` and the screen form with time stamps) and SavvyCAN's GVRET text are read
here, because their decimal stamps must become exactly as many nanoseconds; BLF, MF4 and pcap by readers of their own
(`blf_blocks`, `mf4_blocks`, `pcap_blocks`), which read many frames at a time. What ASC and TRC say, python-can's readers decide
(`text_format`), whose floating-point stamps are rounded to the microsecond (all they hold at today's epoch); lines that look like
others are read in blocks (`text_blocks`). NMEA 0183 text of a GNSS receiver becomes the frames that the UCS makes of it
(`nmea_log`).

Nothing in a file stops the reading for good: a line that can't be read is skipped, counted and told. Stamps that run
backwards are handed on as they stand; the supervisor clamps and counts them.
"""
from __future__ import annotations

import gzip
import itertools
import re
import zlib
from binascii import unhexlify
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Frame
from level1.io.candump import LATEST_NS, candump_line, is_candump
from level1.io.error import OutsideError
from level1.io.message import CLASSIC_BYTES, FD_BYTES, flagged_id, from_message

if TYPE_CHECKING:
    import can

    from level1.block import Block
    from level1.catalog import Catalog

TOLD_LINES = 3
"""How many unreadable lines are told in words; all are counted."""
BLOCK_ROWS = 1 << 18
"""Frames in a block: enough that what each block costs does not matter, some tens of megabytes of memory."""
SINGLE_ROWS = 1 << 14
"""Frames in a block of a format that is read frame by frame: each is an object first."""
LONG_BYTES = 1 << 20
"""Recordings from this size on, some 20,000 frames, are read in blocks."""
EPOCH_NS = 1_000_000_000 * 10**9
"""Stamps above (9 September 2001) are UTC; below they count from the recording's start."""

_GVRET_HEAD = re.compile(rb"Time Stamp,ID,Extended,(Dir,)?Bus,LEN\b")
_SUFFIXES = (".asc", ".blf", ".csv", ".mf4", ".trc")
_PCAP = (b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a")
_HINT = "known: candump text, .asc, .blf, .csv, .mf4, .pcap, .trc, NMEA 0183 text of a GNSS receiver, also with .gz"


@cache
def _own_messages() -> Catalog:
    """What the UCS says of itself."""
    from level1.io.definitions import load
    return load(["ucs.dbc"])


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
        self._columns: Callable[[int], Iterator[Block]] | None = None
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
    def is_long(self) -> bool:
        """Whether reading it in blocks saves more time than it takes to begin with (numpy and tables must be made ready)."""
        return self._size >= LONG_BYTES

    @property
    def is_utc(self) -> bool:
        """Whether the stamps are UTC rather than counted from the recording's start."""
        return self.first_ns >= EPOCH_NS

    def frames(self) -> Iterator[Frame]:
        """The frames in the order of the file. Raises LogError at the end when there was none."""
        with self._reading():
            for frame in self._read():
                if not self.frames_read:
                    self.first_ns = self.last_ns = frame.t_ns
                elif frame.t_ns > self.last_ns:
                    self.last_ns = frame.t_ns
                self.frames_read += 1
                yield frame

    def blocks(self, rows: int = BLOCK_ROWS) -> Iterator[Block]:
        """The frames in columns, so many rows a block or somewhat more; otherwise as `frames`.

        A block is good until the next is asked for.
        """
        with self._reading():
            for block in self._read_blocks(rows):
                if not self.frames_read:
                    self.first_ns = self.last_ns = int(block.t_ns[0])
                self.last_ns = max(self.last_ns, int(block.t_ns.max()))
                self.frames_read += len(block)
                yield block

    def _pcap_blocks(self, rows: int) -> Iterator[Block]:
        from level1.io.pcap_blocks import PcapBlocks
        return self._counted_blocks(PcapBlocks(self._file, self.bus, self._skip).blocks(rows))

    def _mf4_blocks(self, rows: int) -> Iterator[Block]:
        from level1.block import Block
        from level1.io.mf4 import Unsupported
        from level1.io.mf4_blocks import Mf4Blocks
        try:
            yield from self._counted_blocks(Mf4Blocks(self._file, self.bus, self._skip).blocks(rows))
        except Unsupported as reason:
            if self.frames_read:
                self._skip(f"can't be read any further: {reason}")
                return
            frames = self._by_asammdf(str(reason))
            while batch := list(itertools.islice(frames, SINGLE_ROWS)):
                yield Block.of(batch)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        with self._raw:
            try:
                yield
            except (EOFError, OSError, zlib.error) as error:
                self._skip(f"the file ends in the middle or is damaged: {error}")
        if not self.frames_read:
            reason = f"no readable frame; {self.complaints[0]}" if self.complaints else "holds no frame"
            raise LogError(f"{self.path}: {reason}")

    def _read_blocks(self, rows: int) -> Iterator[Block]:
        from level1.block import Block
        if self._columns is not None:
            yield from self._columns(rows)
            return
        frames = self._read()
        while batch := list(itertools.islice(frames, min(rows, SINGLE_ROWS))):
            yield Block.of(batch)

    def _counted_blocks(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """The blocks, their error and remote frames counted."""
        for block in blocks:
            if any(key & (ERROR | REMOTE) for key in block.keys):
                counts = block.counts()
                self.error_frames += sum(count for key, count in zip(block.keys, counts, strict=True) if key & ERROR)
                self.remote_frames += sum(count for key, count in zip(block.keys, counts, strict=True) if key & REMOTE)
            yield block

    def _from_blocks(self) -> Iterator[Frame]:
        """Frame by frame what only a reader of blocks can read."""
        assert self._columns is not None
        for block in self._columns(SINGLE_ROWS):
            yield from block.frames()

    def _candump_blocks(self, rows: int) -> Iterator[Block]:
        from level1.io.candump_blocks import CandumpBlocks
        return self._counted_blocks(CandumpBlocks(self._file, self.bus, self._skip).blocks(rows))

    def _blf_blocks(self, rows: int) -> Iterator[Block]:
        from level1.io.blf_blocks import BlfBlocks
        return self._counted_blocks(BlfBlocks(self._file, self.bus, self._skip).blocks(rows))

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
        if suffix == ".blf" or head.startswith(b"LOGG"):
            self._columns = self._blf_blocks
            return self._from_blocks
        if head.startswith(_PCAP):
            self._columns = self._pcap_blocks
            return self._from_blocks
        if suffix == ".mf4" or head.startswith((b"MDF     4", b"UnFinMF 4")):
            self._columns = self._mf4_blocks
            return self._from_blocks
        if suffix:
            if suffix != ".csv":
                self._columns = lambda rows: self._text_blocks(suffix, rows)
            return lambda: self._text(suffix)
        if any(map(is_candump, head.splitlines())):
            self._columns = self._candump_blocks
            return self._candump
        from level1.io.nmea_log import is_nmea  # a parser of its own, only for what is nothing else
        if is_nmea(head):
            return self._nmea
        raise LogError(f"{self.path}: no recording of a known format; {_HINT}")

    def _nmea(self) -> Iterator[Frame]:
        """What a GNSS receiver said, as the frames of the shipped `ucs.dbc`."""
        from level1.io.nmea_log import frames
        return frames(self._file.read(), _own_messages(), self.bus("gnss"))

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
                name, mark, payload = body.partition(b"#")
                key = keys[channel][name]
                data = unhexlify(payload)
                is_common = mark and len(data) <= CLASSIC_BYTES and len(stamp) < 20 and b"(0" <= stamp < b"(92"
                if is_common and stamp[-8::7] == b".)" and stamp[1:-8].isdigit() and stamp[-7:-1].isdigit():
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
                if not cells[0].isdigit() or int(cells[0]) * 1000 > LATEST_NS:
                    raise ValueError("no time stamp in microseconds")
                yield self._counted(int(cells[0]) * 1000, can_id | self.bus(cells[bus].decode()) << BUS_SHIFT, data)
            except (ValueError, IndexError) as error:
                self._skip(f"unreadable line {number}: {error}")

    def _text(self, suffix: str) -> Iterator[Frame]:
        """ASC, TRC and python-can's csv."""
        from level1.io.text_format import TextFormat
        for _, t_ns, channel, key, data in TextFormat(self._file, suffix, self._skip).all_frames():
            yield self._counted(t_ns, key | self.bus(channel) << BUS_SHIFT, data)

    def _text_blocks(self, suffix: str, rows: int) -> Iterator[Block]:
        from level1.io.text_blocks import TextBlocks, places_of
        from level1.io.text_format import TextFormat
        text = TextFormat(self._file, suffix, self._skip)
        places = places_of(text)
        if places is not None:
            yield from self._counted_blocks(TextBlocks(self._file, self.bus, self._skip, text, places).blocks(rows))
            return
        from level1.block import Block
        reads = ((t_ns, key | self.bus(channel) << BUS_SHIFT, data) for _, t_ns, channel, key, data in text.all_frames())
        while batch := list(itertools.islice(reads, min(rows, SINGLE_ROWS))):
            yield from self._counted_blocks(iter([Block.of(batch)]))

    def _by_asammdf(self, what: str) -> Iterator[Frame]:
        """An MF4 that has something we don't read, by asammdf through python-can. what: that."""
        from can.io.player import MESSAGE_READERS

        from level1.io.text_format import stamp_ns
        for message in self._binary(MESSAGE_READERS[".mf4"], f"an MF4 with {what}"):
            channel = message.channel
            name = str(channel if isinstance(channel, int) else channel or "")
            try:
                t_ns, (key, data) = stamp_ns(message.timestamp), from_message(message)
            except ValueError as error:
                self._skip(f"unreadable frame {self.frames_read + self.skipped + 1}: {error}")
                continue
            yield self._counted(t_ns, key | self.bus(name) << BUS_SHIFT, data)

    def _binary(self, reader: Callable[..., Iterable[can.Message]], what: str) -> Iterator[can.Message]:
        """Frames of a binary file, up to where it is damaged."""
        try:
            yield from reader(self.path)
        except NotImplementedError:
            raise LogError(f"{self.path}: {what} needs a package more: pip install 'tractor-ucs[mf4]'") from None
        except (EOFError, OSError, zlib.error):
            raise
        except Exception as error:  # whatever bytes make python-can's and asammdf's parsers raise
            self._skip(f"the file ends in the middle or is damaged: {error or type(error).__name__}")

    def _counted(self, t_ns: int, key: int, data: bytes) -> Frame:
        """The frame, counted when it is an error or a remote frame."""
        self.error_frames += bool(key & ERROR)
        self.remote_frames += bool(key & REMOTE)
        return Frame(t_ns, key, data)


def _open(path: Path) -> tuple[BinaryIO, int]:
    """The file and its size in bytes."""
    try:
        return path.open("rb"), path.stat().st_size or 1
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except OSError as error:
        raise LogError(f"{path}: can't be read: {error.strerror}") from None
