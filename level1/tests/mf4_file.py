"""A small writer of MF4 files, for tests: the layouts that loggers and tools use, one after the other."""
from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

START_NS = 1_700_000_000 * 10**9
DATA, ERRORS, REMOTE = "CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame"


class Record(NamedTuple):
    """A frame: kind, microseconds since the start, channel, identifier, extended, fd, data."""

    kind: str
    t_us: int
    channel: int
    can_id: int
    extended: bool
    fd: bool
    data: bytes


class Mf4Writer:
    """Puts blocks one behind the other."""

    def __init__(self, finished: bool = True):
        self.out = bytearray((b"MDF     " if finished else b"UnFinMF ") + b"4.10    test    ".ljust(56, b"\0"))
        self.finished = finished

    def block(self, kind: bytes, links: Sequence[int], body: bytes) -> int:
        """A block; gives where it begins."""
        self.out += bytes(-len(self.out) % 8)
        place = len(self.out)
        self.out += struct.pack(f"<4s4xQQ{len(links)}Q", b"##" + kind, 24 + 8 * len(links) + len(body), len(links), *links) + body
        return place

    def patch(self, place: int, link: int, to: int) -> None:
        """Let a link of a block point somewhere else."""
        struct.pack_into("<Q", self.out, place + 24 + 8 * link, to)

    def text(self, words: str) -> int:
        return self.block(b"TX", (), words.encode() + b"\0")

    def linear(self, offset: float, factor: float) -> int:
        return self.block(b"CC", (0, 0, 0, 0), struct.pack("<BBHHHdddd", 1, 0, 0, 0, 2, 0, 0, offset, factor))

    def table(self, pairs: Sequence[tuple[float, float]]) -> int:
        flat = [number for pair in pairs for number in pair]
        return self.block(b"CC", (0, 0, 0, 0), struct.pack(f"<BBHHHdd{len(flat)}d", 5, 0, 0, 0, len(flat), 0, 0, *flat))

    def channel(self, name: str, byte: int, bit: int, bits: int, *, kind: int = 0, data_kind: int = 0, conversion: int = 0,
                data: int = 0, parts: int = 0, following: int = 0) -> int:
        links = (following, parts, self.text(name), 0, conversion, data, 0, 0)
        return self.block(b"CN", links, struct.pack("<BBBBLLLBxHdddddd", kind, int(kind == 2), data_kind, bit, byte, bits, 0, 0, 0,
                                                    *[0.0] * 6))

    def data(self, data: bytes, layout: str, kind: bytes = b"DT") -> int:
        """Data in one block, packed or in a list of them."""
        if layout == "plain" or not data:
            return self.block(kind, (), data)
        if layout in ("packed", "transposed"):
            return self._packed(data, kind, 8 if layout == "transposed" else 0)
        size = max(1, len(data) // 3)
        parts = [data[place:place + size] for place in range(0, len(data), size)]
        places = [self._packed(part, kind, 0) if number % 2 else self.block(kind, (), part) for number, part in enumerate(parts)]
        later = self.block(b"DL", (0, *places[1:]), struct.pack("<BxxxLQ", 0, len(places) - 1, 0))
        first = self.block(b"DL", (later, *places[:1]), struct.pack("<BxxxLQ", 0, 1, 0))
        return self.block(b"HL", (first,), struct.pack("<HB5x", 0, 0))

    def _packed(self, data: bytes, kind: bytes, columns: int) -> int:
        packed = data
        if columns:
            rows = len(data) // columns
            packed = b"".join(data[column:rows * columns:columns] for column in range(columns)) + data[rows * columns:]
        packed = zlib.compress(packed)
        return self.block(b"DZ", (), struct.pack("<2sBxLQQ", kind, int(columns > 0), columns, len(data), len(packed)) + packed)

    def finish(self, groups: Sequence[int]) -> bytes:
        """The file with these groups of data, linked one to the next."""
        for one, other in zip(groups, groups[1:], strict=False):
            self.patch(one, 0, other)
        header = struct.pack("<4s4xQQ6Q", b"##HD", 104, 6, groups[0] if groups else 0, 0, 0, 0, 0, 0) + struct.pack(
            "<QhhBBBx8x8x", START_NS, 0, 0, 0, 0, 0)
        return bytes(self.out[:64]) + header + bytes(self.out[64 + 104:])

    def begin(self) -> None:
        """Leave room for the header."""
        self.out += bytes(104)


SIZE_OF_RECORD = 8 + 4 + 1 + 1 + 1 + 1 + 64
"""Time, identifier, IDE and EDL, DLC, length, channel, data or the place of it."""


def packed_record(record: Record, place: int | None) -> bytes:
    """A record. place: of data bytes that stand elsewhere."""
    data = record.data.ljust(64, b"\0") if place is None else struct.pack("<Q56x", place)
    dlc = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64).index(len(record.data))
    return struct.pack("<QLBBBB", record.t_us * 10, record.can_id, record.extended | record.fd << 1, dlc, len(record.data),
                       record.channel) + data


def group(writer: Mf4Writer, kind: str, number: int, variable: int | None, by_table: bool) -> int:
    """A channel group of such records. variable: place of the block or group with the data bytes."""
    table = writer.table(list(enumerate((0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)))) if by_table else 0
    following = 0
    if variable is None:
        following = writer.channel(f"{kind}.DataBytes", 16, 0, 512, data_kind=10, following=following)
    else:
        following = writer.channel(f"{kind}.DataBytes", 16, 0, 64, kind=1, data_kind=10, data=variable, following=following)
    for name, byte, bit, bits, conversion in (("DataLength", 13, 0, 8, table) if by_table else ("DataLength", 14, 0, 8, 0),
                                              ("DLC", 13, 0, 8, 0), ("EDL", 12, 1, 1, 0), ("IDE", 12, 0, 1, 0), ("ID", 8, 0, 29, 0),
                                              ("BusChannel", 15, 0, 8, 0)):
        following = writer.channel(f"{kind}.{name}", byte, bit, bits, conversion=conversion, following=following)
    frame = writer.channel(kind, 8, 0, 576, data_kind=10, parts=following)
    time = writer.channel("Timestamp", 0, 0, 64, kind=2, conversion=writer.linear(0.0, 1e-7), following=frame)
    source = writer.block(b"SI", (0, 0, 0), struct.pack("<BBB5x", 2, 2, 0))
    return writer.block(b"CG", (0, time, 0, source, 0, 0), struct.pack("<QQHH4xLL", number, 0, 6, 0, SIZE_OF_RECORD, 0))


def mf4(records: Sequence[Record], *, mixed: bool, variable: bool, layout: str, by_table: bool = False,
        finished: bool = True) -> bytes:
    """A file of these records. mixed: all kinds in one list, with other records between them; else each kind for itself, in the
    order of the records. variable: data bytes stand elsewhere."""
    writer = Mf4Writer(finished)
    writer.begin()
    if mixed:
        groups = [_mixed(writer, records, variable, layout, by_table)]
    else:
        groups = [_alone(writer, [one for one in records if one.kind == kind], kind, variable, layout, by_table)
                  for kind in (DATA, ERRORS, REMOTE)]
    return writer.finish(groups)


def _alone(writer: Mf4Writer, records: Sequence[Record], kind: str, variable: bool, layout: str, by_table: bool) -> int:
    lengthy, places = bytearray(), list[Any]()
    for record in records:
        places.append(len(lengthy) if variable else None)
        lengthy += struct.pack("<L", len(record.data)) + record.data
    data = b"".join(packed_record(record, place) for record, place in zip(records, places, strict=True))
    one = group(writer, kind, 0, writer.data(bytes(lengthy), layout, b"SD") if variable else None, by_table)
    return writer.block(b"DG", (0, one, writer.data(data, layout) if data else 0, 0), struct.pack("<B7x", 0))


def _mixed(writer: Mf4Writer, records: Sequence[Record], variable: bool, layout: str, by_table: bool) -> int:
    numbers = {DATA: 1, ERRORS: 2, REMOTE: 3}
    lists = {kind: writer.block(b"CG", (0,) * 6, struct.pack("<QQHH4xLL", number + 10, 0, 1, 0, 0, 0))
             for kind, number in numbers.items()} if variable else {}
    groups = [group(writer, kind, number, lists.get(kind), by_table) for kind, number in numbers.items()]
    groups += [*lists.values(), writer.block(b"CG", (0,) * 6, struct.pack("<QQHH4xLL", 9, 0, 0, 0, 3, 0))]
    for one, other in zip(groups, groups[1:], strict=False):
        writer.patch(one, 0, other)
    written, data = dict.fromkeys(numbers, 0), bytearray()
    for count, record in enumerate(records):
        data += bytes([numbers[record.kind]]) + packed_record(record, written[record.kind] if variable else None)
        if variable:
            data += struct.pack("<BL", numbers[record.kind] + 10, len(record.data)) + record.data
            written[record.kind] += 4 + len(record.data)
        if count % 5 == 0:
            data += b"\x09odd"
    found = writer.block(b"DG", (0, groups[0], 0, 0), struct.pack("<B7x", 1))
    writer.patch(found, 2, writer.data(bytes(data), layout))
    return found
