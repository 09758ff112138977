"""MF4 recordings in blocks; see `mf4` for what is read of a file."""
from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Block, Ints, Words
from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE
from level1.io.merged_blocks import merged
from level1.io.message import CLASSIC_BYTES, FD_BYTES
from level1.io.mf4 import Field, Group, Mf4File, Records, Unsupported
from level1.io.rows import HEAD_MASKS, block_of_words, on_buses

LAG_NS = 1_000_000_000
"""Groups of one list of records may be out of order among each other by so much: their frames are put in order of time."""
BATCH_BYTES = 1 << 20
"""Bytes of records that are taken apart at a time."""
_ROOM = 80
"""Bytes that may be looked at behind the last of a piece."""
_SIZES_OF_DLC = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64])
_LATEST_US = (1 << 33) * 10**6
NO_CHANNEL = (1 << 16) - 1
"""Stands for the channel of frames that name none."""
_ID = np.uint64(0x1FFF_FFFF)
_NO_ROWS: Ints = np.zeros(0, np.int64)


READING = (EOFError, OSError, zlib.error)
"""What reading a damaged file raises."""
Skip = Callable[[str], None]


class Mf4Blocks:
    """Reads an MF4 file in blocks.

    file: where to read. bus(channel): index of a channel's bus, asked in the order of appearance. skip(reason): told of what can't
    be read.
    """

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Skip):
        self._file = file
        self._bus = bus
        self._skip = skip

    def blocks(self, rows: int) -> Iterator[Block]:
        """The frames in the order of time, some ten thousand a block or `rows`, whichever is less, or somewhat more.

        Raises what reading the file raises, and Unsupported.
        """
        try:
            yield from self._blocks(rows)
        except (struct.error, ArithmeticError, LookupError, ValueError) as error:  # what numbers make of damaged ones
            raise OSError(f"damaged: {error}") from None

    def _blocks(self, rows: int) -> Iterator[Block]:
        recording = Mf4File(self._file)
        streams = [(_Mixed if records.number_size else _Alone)(recording, records, self._skip).blocks(rows)
                   for records in recording.records()]
        blocks = streams[0] if len(streams) == 1 else (block for block, _ in merged(streams, _nothing))
        yield from on_buses(blocks, lambda channel: self._bus(str(channel) if channel != NO_CHANNEL else ""))


def _nothing() -> None:
    """There is nothing to check before recordings of one file are merged."""


class Frames(NamedTuple):
    """Frames of one kind, in the order of the file. words: key, and the channel above it. wide: payloads of those longer than a
    head; wide_of: which of them each has, negative for none. order_us: the highest time stamp so far."""

    t_us: Ints
    words: Words
    lengths: npt.NDArray[np.uint16]
    heads: Words
    wide_of: Ints
    wide: npt.NDArray[np.uint8]
    order_us: Ints
    rank: Ints

    def block(self) -> Block:
        """These frames as a block whose buses are channels."""
        wide_rows = np.flatnonzero(self.wide_of >= 0)
        return block_of_words(self.t_us * 1000, self.words, self.lengths, self.heads, wide_rows, self.wide[self.wide_of[wide_rows]])

    def chosen(self, places: Any) -> Frames:
        """Some of them, in this order."""
        return self._replace(t_us=self.t_us[places], words=self.words[places], lengths=self.lengths[places],
                             heads=self.heads[places], wide_of=self.wide_of[places], order_us=self.order_us[places],
                             rank=self.rank[places])


def joined(parts: list[Frames]) -> Frames:
    """Frames one part after the other."""
    shifts = np.cumsum([0, *(len(part.wide) for part in parts)])
    wide_of = [np.where(part.wide_of >= 0, part.wide_of + shift, -1) for part, shift in zip(parts, shifts, strict=False)]
    t_us, words, lengths, heads, wide, order_us, rank = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("t_us", "words", "lengths", "heads", "wide", "order_us", "rank"))
    return Frames(t_us, words, lengths, heads, np.concatenate(wide_of), wide, order_us, rank)


class Payloads(NamedTuple):
    """Data bytes of some frames. lengths: how many there are of each; room: where they stand, with room behind; places: from where
    on."""

    lengths: Ints
    room: npt.NDArray[np.uint8]
    places: Ints

    def bytes_of(self, rows: Ints, width: int) -> npt.NDArray[np.uint8]:
        """The first so many bytes of some of them; what lies behind their end is something else."""
        everywhere = np.ndarray((len(self.room) - width + 1,), f"V{width}", self.room, 0, (1,))
        return everywhere[self.places[rows]].view(np.uint8).reshape(len(rows), width)


class Table:
    """Records of a group, one after the other. first: number of the first of them."""

    def __init__(self, group: Group, data: bytes, first: int):
        self.group = group
        self.count = len(data) // group.size
        self.room = np.frombuffer(data + bytes(_ROOM), np.uint8)
        self._first = first

    def raw(self, field: Field) -> Any:
        """Raw values of a field. Raises Unsupported."""
        if field.is_virtual:
            return np.arange(self._first, self._first + self.count)
        size = self.group.size
        if field.kind in (4, 5) and field.bits in (32, 64) and not field.bit:
            kind = f"{'<' if field.kind == 4 else '>'}f{field.bits // 8}"
            return np.ndarray((self.count,), kind, self.room, field.byte, (size,)).astype(np.float64)
        if field.kind not in (0, 1) or field.bit + field.bits > 64:
            raise Unsupported(f"{field.name} of data type {field.kind} with {field.bits} bits")
        words: Words = np.ndarray((self.count,), "<u8", self.room, field.byte, (size,))
        if field.kind == 1:
            words = words.byteswap() >> np.uint64(64 - (field.bit + field.bits + 7) // 8 * 8)
        return words >> np.uint64(field.bit) & np.uint64((1 << field.bits) - 1)

    def value(self, name: str) -> Any:
        """Physical values of a field, None where the group has none of that name."""
        field = self.group.fields.get(name)
        if field is None:
            return None
        raw, conversion = self.raw(field), field.conversion
        if conversion.kind == 0:
            return raw
        if conversion.kind == 1:
            return raw * conversion.factor + conversion.offset
        if conversion.kind == 5:
            keys, values = np.array(conversion.table).T
            return values[np.minimum(np.searchsorted(keys, raw), len(keys) - 1)]
        raise Unsupported(f"{name} by a conversion of type {conversion.kind}")

    def number(self, name: str, default: int) -> Ints:
        """Physical values of a field as integers."""
        values = self.value(name)
        found: Ints = np.full(self.count, default) if values is None else np.asarray(values).astype(np.int64)
        return found

    def inside(self, field: Field) -> Payloads:
        """Data bytes that stand in the records themselves."""
        return Payloads(np.full(self.count, field.bits // 8), self.room, np.arange(self.count) * self.group.size + field.byte)


class Reader:
    """What takes records of one group apart. rank: place of the group among others."""

    def __init__(self, recording: Mf4File, group: Group, skip: Skip, rank: int = 0):
        self.group = group
        self._rank = rank
        self.data = group.fields.get("DataBytes")
        self._start_us = recording.start_us
        self._skip = skip
        self._count = 0
        self._last_us = -1 << 62

    def frames(self, table: Table, payloads: Payloads | None) -> Frames:
        """The frames of some records."""
        seconds = np.asarray(table.value("time"), np.float64)
        with np.errstate(invalid="ignore"):
            t_us = np.rint(seconds * 1e6).astype(np.int64) + self._start_us
        is_fd = table.number("EDL", 0) != 0
        lengths = self._lengths(table, payloads, is_fd)
        right = np.isfinite(seconds) & (t_us >= 0) & (t_us < _LATEST_US) & (lengths <= np.where(is_fd, FD_BYTES, CLASSIC_BYTES))
        for place in np.flatnonzero(~right).tolist():
            self._skip(f"unreadable frame {self._count + place + 1}: {lengths[place]} data bytes at {seconds[place]} s")
        self._count += table.count
        lengths[~right] = 0
        heads, wide_of, wide = self._payloads(payloads, lengths)
        order_us = np.maximum(np.maximum.accumulate(np.where(right, t_us, 0)), self._last_us) if table.count else t_us
        self._last_us = int(order_us[-1]) if table.count else self._last_us
        frames = Frames(t_us, self._words(table), lengths.astype(np.uint16), heads, wide_of, wide, order_us,
                        np.full(table.count, self._rank))
        return frames if right.all() else frames.chosen(np.flatnonzero(right))

    def _words(self, table: Table) -> Words:
        ids = table.number("ID", 0).astype(np.uint64) & _ID
        extended = (table.number("IDE", 1) != 0) | (ids > np.uint64(0x7FF))
        flags = {"CAN_ErrorFrame": ERROR, "CAN_RemoteFrame": REMOTE}.get(self.group.kind, 0)
        if flags == ERROR:
            extended[:] = False
        channels = table.number("BusChannel", NO_CHANNEL).astype(np.uint64)
        words: Words = channels << np.uint64(BUS_SHIFT) | ids | extended * np.uint64(EXTENDED) | np.uint64(flags)
        return words

    def _lengths(self, table: Table, payloads: Payloads | None, is_fd: Any) -> Ints:
        """Data bytes of each frame; a remote frame has none."""
        if payloads is None or self.group.kind == "CAN_RemoteFrame":
            return np.zeros(table.count, np.int64)
        dlc = table.number("DLC", 8)
        sizes = _SIZES_OF_DLC[np.minimum(dlc, np.where(is_fd, 15, 8))]
        wanted = table.number("DataLength", 0) if "DataLength" in table.group.fields else sizes
        return np.minimum(wanted, payloads.lengths)

    @staticmethod
    def _payloads(payloads: Payloads | None, lengths: Ints) -> tuple[Words, Ints, npt.NDArray[np.uint8]]:
        """Heads, and the whole payloads of those that are longer."""
        if payloads is None:
            return np.zeros(len(lengths), np.uint64), np.full(len(lengths), -1), np.zeros((0, FD_BYTES + HEAD_BYTES), np.uint8)
        heads = payloads.bytes_of(np.arange(len(lengths)), HEAD_BYTES).view("<u8")[:, 0]
        heads = heads & HEAD_MASKS[np.minimum(lengths, HEAD_BYTES)]
        rows = np.flatnonzero(lengths > HEAD_BYTES)
        wide = np.zeros((len(rows), FD_BYTES + HEAD_BYTES), np.uint8)
        wide[:, :FD_BYTES] = payloads.bytes_of(rows, FD_BYTES)
        wide[np.arange(FD_BYTES + HEAD_BYTES) >= lengths[rows, None]] = 0
        wide_of = np.full(len(lengths), -1)
        wide_of[rows] = np.arange(len(rows))
        return heads, wide_of, wide


class _Alone:
    """One group with records of one size; data bytes of different lengths stand in a block of their own."""

    def __init__(self, recording: Mf4File, records: Records, skip: Skip):
        self._recording = recording
        self._records = records
        self._reader = Reader(recording, next(group for group in records.groups if group.kind), skip)

    def blocks(self, rows: int) -> Iterator[Block]:
        """Its frames."""
        reader, group = self._reader, self._reader.group
        field = reader.data
        lengthy = Lengthy(self._recording.data(field.data)) if field is not None and field.is_variable else None
        tail, first = b"", 0
        for data in batches(self._recording.data(self._records.data), min(BATCH_BYTES, rows * group.size)):
            data = tail + data
            whole = len(data) // group.size * group.size
            table, tail = Table(group, data[:whole], first), data[whole:]
            first += table.count
            payloads = None
            if lengthy is not None and field is not None:
                payloads = lengthy.at(table.raw(field._replace(kind=0, is_virtual=False)).astype(np.int64))
            elif field is not None:
                payloads = table.inside(field)
            frames = reader.frames(table, payloads)
            if len(frames.t_us):
                yield frames.block()


class Lengthy:
    """Data bytes of different lengths, each behind its length, one after the other; read along with the records that name them."""

    def __init__(self, pieces: Iterator[bytes]):
        self._pieces = pieces
        self._begin = 0
        self._data = b""

    def at(self, places: Ints) -> Payloads:
        """Those that begin at these places, which only rise. Raises EOFError when one is not there."""
        if not len(places):
            return Payloads(_NO_ROWS, np.zeros(_ROOM, np.uint8), _NO_ROWS)
        if int(places.min()) < self._begin:
            raise Unsupported("data bytes in another order than frames")
        self._read_to(int(places.max()) + 4)
        room = np.frombuffer(self._data + bytes(_ROOM), np.uint8)
        lengths = np.ndarray((len(room) - 3,), "<u4", room, 0, (1,))[places - self._begin].astype(np.int64)
        self._read_to(int((places + lengths).max()) + 4)
        room = np.frombuffer(self._data + bytes(_ROOM), np.uint8)
        found = Payloads(lengths, room, places - self._begin + 4)
        used = int(places[-1]) - self._begin
        self._data, self._begin = self._data[used:], self._begin + used
        return found

    def _read_to(self, end: int) -> None:
        parts, reached = [self._data], self._begin + len(self._data)
        while reached < end:
            piece = next(self._pieces, None)
            if piece is None:
                raise EOFError("data bytes of frames are missing")
            parts.append(piece)
            reached += len(piece)
        if len(parts) > 1:
            self._data = b"".join(parts)


class _Mixed:
    """Groups whose records follow one another as they came, each with its group's number before it."""

    def __init__(self, recording: Mf4File, records: Records, skip: Skip):
        self._recording = recording
        self._records = records
        self._skip = skip
        self._readers = [Reader(recording, group, skip, rank) for rank, group in enumerate(records.groups) if group.kind]
        self._lists: dict[int, Listed] = {}
        self._waiting: dict[int, bytes] = {}
        self._counts: dict[int, int] = {}
        by_place = {group.place: group.number for group in records.groups if group.is_variable}
        self._list_of = {reader.group.number: by_place[reader.data.data] for reader in self._readers
                         if reader.data is not None and reader.data.data in by_place}
        for number in self._list_of.values():
            self._lists[number] = Listed()

    def blocks(self, rows: int) -> Iterator[Block]:
        """Their frames, in the order of time as far as it is out by no more than `LAG_NS`."""
        tail, held = b"", list[Frames]()
        try:
            for data in batches(self._recording.data(self._records.data), BATCH_BYTES):
                data = tail + data
                end, places = self._walk(data)
                tail = data[end:]
                held = [joined([*held, *self._frames(data, places)])] if held else [joined(self._frames(data, places))]
                ready, kept = self._ordered(held[0], int(held[0].order_us.max(initial=0)) - LAG_NS // 1000)
                held = [kept]
                if len(ready.t_us):
                    yield ready.block()
        except READING:
            if held and len(held[0].t_us):
                yield self._ordered(held[0], 1 << 62)[0].block()
            raise
        if held and len(held[0].t_us):
            yield self._ordered(held[0], 1 << 62)[0].block()
        if tail or any(self._waiting.values()):
            self._skip("the file ends in the middle or is damaged: a record is cut")

    @staticmethod
    def _ordered(frames: Frames, until_us: int) -> tuple[Frames, Frames]:
        """Frames in the order of time, and those after a time as they are."""
        is_ready = frames.order_us <= until_us
        ready = frames.chosen(np.flatnonzero(is_ready))
        return ready.chosen(np.lexsort((ready.rank, ready.order_us))), frames.chosen(np.flatnonzero(~is_ready))

    def _walk(self, data: bytes) -> tuple[int, dict[int, list[int]]]:
        """Where the whole records end, and where those of each group begin, behind their numbers."""
        width = self._records.number_size
        sizes = {group.number: -1 if group.is_variable else group.size for group in self._records.groups}
        found: dict[int, list[int]] = {number: [] for number in sizes}
        place, end = 0, len(data)
        while place + width <= end:
            number = data[place] if width == 1 else int.from_bytes(data[place:place + width], "little")
            size = sizes.get(number)
            if size is None:
                raise EOFError(f"a record of an unknown group {number}")
            body = place + width
            if size < 0:
                size = 4 + int.from_bytes(data[body:body + 4], "little")
                if body + 4 > end:
                    break
            if body + size > end:
                break
            found[number].append(body)
            place = body + size
        return place, found

    def _frames(self, data: bytes, found: dict[int, list[int]]) -> list[Frames]:
        """The frames whose data bytes are there."""
        room = np.frombuffer(data + bytes(_ROOM), np.uint8)
        for number, listed in self._lists.items():
            listed.add(room, np.array(found[number], np.int64))
        parts = []
        for reader in self._readers:
            group = reader.group
            places = np.array(found[group.number], np.int64)
            records = self._waiting.get(group.number, b"")
            records += np.ndarray((len(room) - group.size + 1,), f"V{group.size}", room, 0, (1,))[places].tobytes()
            first = self._counts.get(group.number, 0)
            table, payloads = Table(group, records, first), None
            if group.number in self._list_of and reader.data is not None:
                offsets = table.raw(reader.data._replace(kind=0, is_virtual=False)).astype(np.int64)
                count = self._lists[self._list_of[group.number]].reached(offsets)
                self._waiting[group.number] = records[count * group.size:]
                table = Table(group, records[:count * group.size], first)
                payloads = self._lists[self._list_of[group.number]].at(offsets[:count])
            elif reader.data is not None and not reader.data.is_variable:
                payloads = table.inside(reader.data)
            elif reader.data is not None:
                raise Unsupported("data bytes in a block of their own beside mixed records")
            self._counts[group.number] = first + table.count
            parts.append(reader.frames(table, payloads))
        for listed in self._lists.values():
            listed.forget()
        return parts


class Listed:
    """Data bytes that came as records of their own; frames name them by how many bytes of such records were before them."""

    def __init__(self) -> None:
        self._end = 0
        self._offsets = _NO_ROWS
        self._lengths = _NO_ROWS
        self._data = np.zeros((0, FD_BYTES), np.uint8)

    def add(self, room: npt.NDArray[np.uint8], places: Ints) -> None:
        """More of them, at these places."""
        lengths = np.ndarray((len(room) - 3,), "<u4", room, 0, (1,))[places].astype(np.int64)
        ends = np.cumsum(lengths + 4) + self._end
        everywhere = np.ndarray((len(room) - FD_BYTES + 1,), f"V{FD_BYTES}", room, 0, (1,))
        data = everywhere[places + 4].view(np.uint8).reshape(len(places), FD_BYTES)
        self._offsets = np.concatenate((self._offsets, ends - lengths - 4))
        self._lengths = np.concatenate((self._lengths, lengths))
        self._data = np.concatenate((self._data, data))
        self._end = int(ends[-1]) if len(ends) else self._end

    def reached(self, offsets: Ints) -> int:
        """How many frames at the front have their data bytes."""
        missing = np.flatnonzero(offsets >= self._end)
        return int(missing[0]) if len(missing) else len(offsets)

    def at(self, offsets: Ints) -> Payloads:
        """The data bytes at these offsets. Raises EOFError where there are none."""
        rows = np.searchsorted(self._offsets, offsets)
        if len(offsets) and (self._offsets[np.minimum(rows, len(self._offsets) - 1)] != offsets).any():
            raise EOFError("data bytes of frames are missing")
        return Payloads(self._lengths[rows], np.concatenate((self._data.reshape(-1), np.zeros(_ROOM, np.uint8))), rows * FD_BYTES)

    def forget(self) -> None:
        """Leave only the last few: frames come before their data bytes or right behind them."""
        kept = slice(max(0, len(self._offsets) - 16), None)
        self._offsets, self._lengths, self._data = self._offsets[kept], self._lengths[kept], self._data[kept]


def batches(pieces: Iterator[bytes], size: int) -> Iterator[bytes]:
    """Pieces put together to this size or more. What they raise comes behind what they gave before."""
    parts: list[bytes] = []
    total, failure = 0, None
    try:
        for piece in pieces:
            parts.append(piece)
            total += len(piece)
            if total >= size:
                yield b"".join(parts)
                parts, total = [], 0
    except READING as error:
        failure = error
    if parts:
        yield b"".join(parts)
    if failure is not None:
        raise failure
