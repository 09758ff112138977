"""BLF recordings (Vector's binary logging format) in blocks, exact to what the file holds.

A file is a header and log containers, most of them packed with zlib; what they hold, put one after the other, is a chain of
objects. Frames and error frames are read, classic and CAN FD; everything else (statistics, markers, other buses) is passed
over. No official description exists; this one follows python-can and T. Lorenz' vector_blf, and agrees with python-can's
reader. Time stamps are rounded to the microsecond, which is what CAN hardware measures and what other formats hold.
"""
from __future__ import annotations

import struct
import zlib
from calendar import timegm
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Ints
from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE
from level1.io.message import CLASSIC_BYTES, FD_BYTES
from level1.io.rows import HEAD_MASKS, BlockReader, Numbers, Rows

SIGNATURE = b"LOGG"
MESSAGE, CONTAINER, ERROR_FRAME, MESSAGE_2, FD_MESSAGE, FD_MESSAGE_64 = 1, 10, 73, 86, 100, 101
"""Types of objects."""
BATCH_BYTES = 1 << 20
"""Unpacked bytes that are taken apart at a time."""
MOST_BYTES = 1 << 24
"""A container or object larger than this is damage: writers use containers of 128 KB."""

_HEADER = struct.Struct("<4sL")
_OBJECT = struct.Struct("<4sHHLL")
_CONTAINER = struct.Struct("<H6xL4x")
_MARK = int.from_bytes(b"LOBJ", "little")
_START, _HEADER_SIZE = 40, 144
_BODY = {1: 32, 2: 40}
"""Where the body of an object begins, by the version of its header."""
_TEN_MICROSECONDS = 1
_LATEST_S = 1 << 33
_ID = np.uint64(0x1FFF_FFFF)
_WORD = np.uint64(1 << 63)
"""Makes words of channel and identifier something else than zero."""
_OBJECT_BYTES = 160
"""Bytes looked at of an object: the longest that is read, a CAN FD frame, has less."""


class BlfBlocks(BlockReader):
    """Reads a BLF file in blocks.

    file: where to read, at its beginning. bus(channel): index of a channel's bus, asked in the order of appearance.
    skip(reason): told of every frame or container that can't be read, in order.
    """

    PIECE_ROWS = BATCH_BYTES // 32

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Callable[[str], None]):
        self._file = file
        self._bus = bus
        self._skip = skip
        self._buses: dict[int, int] = {}
        self._start_ns = 0
        self._read = self._left_out = 0
        self._tail = b""
        super().__init__()

    def _forget(self) -> None:
        super()._forget()
        self._numbers = Numbers(self._talker)

    def _pieces(self) -> Iterator[None]:
        for data in self._batches():
            self._take(data)
            yield

    def _keys(self) -> list[int]:
        return [word & 0xFFFF_FFFF | self._buses[word >> 32 & 0xFFFF] << BUS_SHIFT for word in self._talkers]

    def _talker(self, word: int) -> int:
        return self._talkers.setdefault(word, len(self._talkers))

    # --- containers -------------------------------------------------------------------------------------------------------

    def _batches(self) -> Iterator[bytes]:
        """What the containers hold, in pieces that begin with an object. What follows the last whole one of a piece is kept in
        `_tail` by whoever takes it."""
        self._begin()
        parts: list[bytes] = []
        for data in self._containers():
            if data is None:  # one is lost: the object that was cut by it is lost too
                if parts:
                    yield b"".join((self._tail, *parts))
                    parts = []
                self._tail = b""
            else:
                parts.append(data)
            if sum(map(len, parts)) >= BATCH_BYTES:
                yield b"".join((self._tail, *parts))
                parts = []
        if parts:
            yield b"".join((self._tail, *parts))

    def _begin(self) -> None:
        """Read the header of the file: when its time begins."""
        header = self._file.read(_HEADER_SIZE)
        if len(header) < _START + 16 or not header.startswith(SIGNATURE):
            raise OSError("no BLF file")
        self._file.read(max(0, _HEADER.unpack_from(header)[1] - len(header)))
        year, month, _, day, hour, minute, second, millisecond = struct.unpack_from("<8H", header, _START)
        try:
            begin = datetime(year, month, day, hour, minute, second)
        except ValueError:
            return  # without a date, time counts from the start of the recording
        self._start_ns = timegm(begin.timetuple()) * 10**9 + millisecond * 10**6

    def _containers(self) -> Iterator[bytes | None]:
        """The contents of the containers; None in place of what can't be read."""
        while head := self._file.read(_OBJECT.size):
            if len(head) < _OBJECT.size:
                self._damage("the file ends in the middle or is damaged: an object is cut")
                return
            mark, _, _, size, kind = _OBJECT.unpack(head)
            if mark != b"LOBJ" or not _OBJECT.size <= size <= MOST_BYTES:
                self._damage("damaged between two containers")
                yield None
                if not self._search():
                    return
                continue
            body = self._file.read(size - _OBJECT.size)
            self._file.read(size % 4)
            if len(body) < size - _OBJECT.size:
                self._damage("the file ends in the middle or is damaged: an object is cut")
            if kind == CONTAINER:
                yield self._unpacked(body)

    def _search(self) -> bool:
        """Go on behind damage at the next container."""
        window = b""
        while piece := self._file.read(1 << 16):
            window = window[-_OBJECT.size:] + piece
            place = window.find(b"LOBJ\x10\0\1\0")
            if place >= 0:
                self._file.seek(place - len(window), 1)
                return True
        return False

    def _unpacked(self, body: bytes) -> bytes | None:
        if len(body) < _CONTAINER.size:
            return None
        method, _ = _CONTAINER.unpack_from(body)
        packed = body[_CONTAINER.size:]
        if method == 0:
            return packed
        if method != 2:
            self._damage(f"a container packed in an unknown way ({method})")
            return None
        try:
            return zlib.decompressobj().decompress(packed, MOST_BYTES)
        except zlib.error as error:
            self._damage(f"a damaged container: {error}")
            return None

    def _damage(self, reason: str) -> None:
        self._left_out += 1
        self._skip(reason)

    # --- objects ----------------------------------------------------------------------------------------------------------

    def _take(self, data: bytes) -> None:
        """Add the frames of a chain of objects, and keep what is left of it."""
        room = np.frombuffer(data + bytes(_OBJECT_BYTES), np.uint8)
        begins, end = self._chain(data, room)
        self._tail = data[end:]
        if len(begins):
            self._read_objects(room, begins)

    def _chain(self, data: bytes, room: npt.NDArray[np.uint8]) -> tuple[Ints, int]:
        """Where the whole objects begin, and where the last of them ends."""
        marks = np.flatnonzero(room[:len(data) // 4 * 4].view("<u4") == _MARK) * 4
        marks = marks[marks + _OBJECT.size <= len(data)]
        sizes = np.ndarray((len(room) - 4,), "<u4", room, 0, (1,))[marks + 8].astype(np.int64)
        ends = marks + sizes
        follows = ends + sizes % 4
        if len(marks) and marks[0] == 0 and (follows[:-1] == marks[1:]).all():
            count = len(marks) if ends[-1] <= len(data) else len(marks) - 1
            end = int(ends[count - 1]) if count else 0
            following = data.find(b"LOBJ", end, end + 8)
            if len(data) < end + 8 or 0 <= following and not _is_whole(data, following):
                return marks[:count], end
        return self._walk(data)

    def _walk(self, data: bytes) -> tuple[Ints, int]:
        """The same, object by object; over what is no object, to the next mark."""
        begins: list[int] = []
        place = 0
        while True:
            mark = data.find(b"LOBJ", place, place + 8)
            if mark < 0 and place + 8 <= len(data):
                self._damage("damaged between two objects")
                mark = data.find(b"LOBJ", place)
                if mark < 0:
                    return np.array(begins, np.int64), max(place, len(data) - 3)
            if mark < 0 or mark + _OBJECT.size > len(data):
                return np.array(begins, np.int64), place if mark < 0 else mark
            size = _OBJECT.unpack_from(data, mark)[3]
            if not _OBJECT.size <= size <= MOST_BYTES:
                self._damage("damaged between two objects")
                place = mark + 4
                continue
            if mark + size > len(data):
                return np.array(begins, np.int64), mark
            begins.append(mark)
            place = mark + size

    def _read_objects(self, room: npt.NDArray[np.uint8], begins: Ints) -> None:
        """The frames among some objects."""
        objects = Objects(room, begins, self._rows)
        objects.read()
        t_ns, wrong = objects.times(self._start_ns)
        objects.is_right &= ~wrong
        found = objects.is_right
        for place in np.flatnonzero(objects.is_frame & ~found).tolist():
            number = self._read + int(np.count_nonzero(found[:place])) + self._left_out + 1
            self._damage(f"unreadable frame {number}: {objects.reason(place, self._start_ns)}")
        words = objects.words[found]
        channels, firsts = np.unique(words >> np.uint64(32) & np.uint64(0xFFFF), return_index=True)
        for _, channel in sorted(zip(firsts.tolist(), channels.tolist(), strict=True)):
            if channel not in self._buses:
                self._buses[channel] = self._bus(str(channel))
        talkers = np.zeros(len(found), np.int32)
        talkers[found] = self._numbers.of(words)
        objects.keep(talkers, t_ns)
        self._read += len(words)


_CLASSIC = np.dtype([("channel", "<u2"), ("flags", "u1"), ("dlc", "u1"), ("id", "<u4"), ("data", "<u8")])
_FD = np.dtype([("channel", "<u2"), ("flags", "u1"), ("dlc", "u1"), ("id", "<u4"), ("", "V5"), ("fd", "u1"), ("valid", "u1"),
                ("", "V5"), ("data", "u1", FD_BYTES)])
_FD_64 = np.dtype([("channel", "u1"), ("dlc", "u1"), ("valid", "u1"), ("", "V1"), ("id", "<u4"), ("", "V4"), ("flags", "<u4"),
                   ("", "V19"), ("further", "u1"), ("", "V4")])
_ERROR = np.dtype([("channel", "<u2"), ("", "V8"), ("dlc", "u1"), ("", "V5"), ("id", "<u4"), ("", "V4"), ("data", "<u8")])
_OBJECT_HEAD = np.dtype([("mark", "<u4"), ("header", "<u2"), ("version", "<u2"), ("size", "<u4"), ("kind", "<u4"), ("flags", "<u4"),
                         ("", "V4"), ("stamp", "<u8"), ("body", _CLASSIC)])
_READ = np.isin(np.arange(128), (MESSAGE, MESSAGE_2, FD_MESSAGE, FD_MESSAGE_64, ERROR_FRAME))
"""Which types of objects are read."""


def _is_whole(data: bytes, place: int) -> bool:
    """Whether the object that begins here ends within the data."""
    return place + _OBJECT.size <= len(data) and place + int(_OBJECT.unpack_from(data, place)[3]) <= len(data)


class Objects:
    """The objects of a piece of a file. is_frame: those that are frames or error frames; is_right: those of them that can be read;
    words: channel and flagged identifier of each (with `_WORD`)."""

    def __init__(self, room: npt.NDArray[np.uint8], begins: Ints, rows: Rows):
        count = len(begins)
        self._room, self._begins, self._rows = room, begins, rows
        self._heads_of = self._fields(begins, _OBJECT_HEAD)
        self._kinds = np.minimum(self._heads_of["kind"], len(_READ) - 1)
        versions = self._heads_of["version"]
        self._is_newer = versions == 2
        self.is_frame = _READ[self._kinds] & ((versions == 1) | self._is_newer)
        self.is_right = self.is_frame.copy()
        self.words = np.zeros(count, np.uint64)
        self._sizes = np.zeros(count, np.uint16)
        self._limits = np.full(count, CLASSIC_BYTES, np.uint16)
        self._heads = np.zeros(count, np.uint64)
        self._wide: list[tuple[Ints, npt.NDArray[np.uint8]]] = []

    def _bodies(self, places: Ints) -> Ints:
        """Where what comes behind the headers of some objects begins."""
        return self._begins[places] + np.where(self._is_newer[places], _BODY[2], _BODY[1])

    def _fields(self, places: Ints, kind: Any) -> Any:
        """What stands at these places."""
        size = np.dtype(kind).itemsize
        return np.ndarray((len(self._room) - size + 1,), f"V{size}", self._room, 0, (1,))[places].view(kind)

    def read(self) -> None:
        """Take the frames apart."""
        for number, read in ((MESSAGE, self._read_classic), (MESSAGE_2, self._read_classic), (FD_MESSAGE, self._read_fd),
                             (FD_MESSAGE_64, self._read_fd_64), (ERROR_FRAME, self._read_errors)):
            places = np.flatnonzero((self._kinds == number) & self.is_frame)
            if len(places):
                read(places)
        self.is_right &= self._sizes <= self._limits

    def _put(self, places: Ints, channels: Any, ids: Any, flags: Any, sizes: Any, heads: Any) -> None:
        """Frames at these places. flags: what besides the length of the identifier."""
        plain = ids.astype(np.uint64) & _ID
        extended = (ids & np.uint32(EXTENDED) != 0) | (plain > np.uint64(0x7FF))  # some writers leave the flag out
        keys = plain | extended * np.uint64(EXTENDED) | flags
        self.words[places] = keys | channels.astype(np.uint64) << np.uint64(32) | _WORD
        self._sizes[places] = sizes
        self._heads[places] = heads & HEAD_MASKS[np.minimum(sizes, HEAD_BYTES)]

    def _read_classic(self, places: Ints) -> None:
        if self._is_newer.any():
            found = self._fields(self._bodies(places), _CLASSIC)
            channels, flags, dlcs, ids, heads = (found[name] for name in ("channel", "flags", "dlc", "id", "data"))
        else:
            bodies, chosen = self._heads_of["body"], slice(None) if len(places) == len(self.words) else places
            channels, flags, dlcs, ids, heads = (bodies[name][chosen] for name in ("channel", "flags", "dlc", "id", "data"))
        is_remote = flags & np.uint8(0x80) != 0
        sizes = np.where(is_remote, 0, np.minimum(dlcs, CLASSIC_BYTES))
        self._put(places, channels, ids, is_remote * np.uint64(REMOTE), sizes, heads)

    def _read_errors(self, places: Ints) -> None:
        found = self._fields(self._bodies(places), _ERROR)
        self._put(places, found["channel"], found["id"], np.uint64(ERROR), np.minimum(found["dlc"], CLASSIC_BYTES), found["data"])
        self.words[places] &= ~np.uint64(EXTENDED)

    def _read_fd(self, places: Ints) -> None:
        found = self._fields(self._bodies(places), _FD)
        self._put_fd(places, found, found["flags"] & np.uint8(0x80) != 0, found["fd"] & np.uint8(1) != 0,
                     np.minimum(found["valid"], FD_BYTES), np.ascontiguousarray(found["data"]))

    def _read_fd_64(self, places: Ints) -> None:
        bodies = self._bodies(places)
        found = self._fields(bodies, _FD_64)
        ends = np.where(found["further"] != 0, found["further"], self._heads_of["size"][places]).astype(np.int64)
        present = ends - self._heads_of["header"][places] - _FD_64.itemsize
        data = self._fields(np.minimum(bodies + _FD_64.itemsize, len(self._room) - FD_BYTES), f"V{FD_BYTES}")
        data = data.view(np.uint8).reshape(len(places), FD_BYTES)
        sizes = found["valid"].astype(np.int64)
        data[np.arange(FD_BYTES) >= np.minimum(sizes, present)[:, None]] = 0  # as CANoe fills up what a file lacks
        self._put_fd(places, found, found["flags"] & np.uint32(0x10) != 0, found["flags"] & np.uint32(0x1000) != 0, sizes, data)

    def _put_fd(self, places: Ints, found: Any, is_remote: Any, is_fd: Any, sizes: Any, data: npt.NDArray[np.uint8]) -> None:
        sizes = np.where(is_remote, 0, sizes)
        self._limits[places[is_fd]] = FD_BYTES
        self._put(places, found["channel"], found["id"], is_remote * np.uint64(REMOTE), sizes, data.view("<u8")[:, 0])
        is_wide = sizes > HEAD_BYTES
        if is_wide.any():
            data = data[is_wide]
            data[np.arange(FD_BYTES) >= sizes[is_wide, None]] = 0
            self._wide.append((places[is_wide], data))

    def times(self, start_ns: int) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """Time stamps in ns, to the nearest microsecond; and which are none."""
        stamps = np.ascontiguousarray(self._heads_of["stamp"])
        latest = np.uint64(_LATEST_S * 10**9 - start_ns)
        coarse = self._heads_of["flags"] == _TEN_MICROSECONDS
        wrong = stamps > latest
        if coarse.any():
            wrong = stamps > np.where(coarse, latest // np.uint64(10_000), latest)
            stamps[coarse] *= np.uint64(10_000)
        stamps[wrong] = 0
        stamps = stamps.view(np.int64) + start_ns
        microseconds = stamps // 1000
        rests = stamps - microseconds * 1000
        return (microseconds + (rests + (microseconds & 1) > 500)) * 1000, wrong

    def reason(self, place: int, start_ns: int) -> str:
        """What is wrong with a frame."""
        if self._sizes[place] > self._limits[place]:
            return f"{self._sizes[place]} data bytes; a frame of this kind has at most {self._limits[place]}"
        stamp, flags = int(self._heads_of["stamp"][place]), int(self._heads_of["flags"][place])
        coarse = flags == _TEN_MICROSECONDS
        return f"time stamp {stamp * (1e-5 if coarse else 1e-9) + start_ns / 1e9} out of range"

    def keep(self, talkers: npt.NDArray[np.int32], t_ns: Ints) -> None:
        """Hand the right frames on."""
        found = self.is_right
        to_t_ns, to_talker, to_length, to_head = self._rows.sheet(len(found))
        to_t_ns[:], to_talker[:], to_length[:], to_head[:] = t_ns, talkers, self._sizes, self._heads
        wide = [(places[found[places]], data[found[places]]) for places, data in self._wide]
        self._rows.keep(found, wide)
