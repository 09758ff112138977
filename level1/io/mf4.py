"""What an MF4 recording (ASAM MDF 4) holds of CAN buses, and where: its groups of frames and their fields.

Only bus logging is read: channel groups of bus events whose source is a CAN bus, with a channel `CAN_DataFrame`,
`CAN_ErrorFrame` or `CAN_RemoteFrame` and its parts (ASAM MDF bus logging, associated standard). Files that a logger did not
finish are read to where they end. The frames themselves are read by `mf4_blocks`.
"""
from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

PIECE_BYTES = 1 << 20
"""Bytes of a data block that are read at a time."""
MOST_BYTES = 1 << 26
"""A packed block is not unpacked beyond this; writers use 4 MB."""
KINDS = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")

_IDENTIFICATION = 64
_BUS_EVENT, _VLSD_GROUP = 2, 1
_CAN_SOURCE = (2, 2)
"""Type and bus type of a source that is a CAN bus."""
_VIRTUAL = (3, 6)
"""Types of channels whose value is the number of the record."""
_MASTERS = (2, 3)
_VARIABLE = 1
_UNKNOWN_SIZE = 24
"""Length of a data block whose writer was interrupted: that of its head."""


class Unsupported(Exception):
    """Something that MF4 allows and this reader does not know."""


class Conversion(NamedTuple):
    """How physical values come from raw ones. kind: 0 not at all, 1 linear (`offset + factor * raw`), 5 by a table."""

    kind: int = 0
    offset: float = 0.0
    factor: float = 1.0
    table: tuple[tuple[float, float], ...] = ()


class Field(NamedTuple):
    """A channel in a record. kind: data type of MDF (0, 1 unsigned, 4, 5 float, 10 bytes …; even: little-endian). virtual: no bits
    of its own, the raw value counts records. variable: what the record holds is a place in `data`, a block or a group."""

    name: str
    byte: int
    bit: int
    bits: int
    kind: int
    conversion: Conversion
    is_virtual: bool
    is_variable: bool
    data: int


class Group(NamedTuple):
    """Records of one kind. kind: of `KINDS`, or "" where they are no frames. size: bytes without the record's number; variable:
    each record has its own. place: where the file describes it. fields: by the last part of their names; the time as "time"."""

    number: int
    kind: str
    size: int
    is_variable: bool
    place: int
    fields: dict[str, Field]


class Records(NamedTuple):
    """Groups whose records stand in one another's company. number_size: bytes of the number before each, 0 where there is only one
    group. data: place of the first data block."""

    groups: tuple[Group, ...]
    number_size: int
    data: int


class _Block(NamedTuple):
    kind: bytes
    place: int
    size: int
    links: tuple[int, ...]
    body: int


class Mf4File:
    """An MF4 file. Raises OSError when it is none.

    start_us: UTC of its beginning, microseconds. is_finished: whether its writer came to the end.
    """

    def __init__(self, file: BinaryIO):
        self._file = file
        head = self._at(0, _IDENTIFICATION)
        if not head.startswith((b"MDF     ", b"UnFinMF ")) or head[8:10] < b"4.":
            raise OSError("no MF4 file")
        self.is_finished = head.startswith(b"MDF")
        self._header = self._block(_IDENTIFICATION, b"##HD")
        self.start_us = round(struct.unpack("<Q", self._at(self._header.body, 8))[0] / 1000)

    def records(self) -> list[Records]:
        """What holds frames."""
        found = []
        for block in self._chain(self._header.links[0], b"##DG"):
            groups = tuple(self._group(one) for one in self._chain(block.links[1], b"##CG"))
            if block.links[2] and any(group.kind for group in groups):
                found.append(Records(groups, self._at(block.body, 1)[0], block.links[2]))
        return found

    def data(self, place: int) -> Iterator[bytes]:
        """The bytes of a data block, or of a list of them, in pieces."""
        if not place:
            return
        block = self._block(place)
        if block.kind in (b"##DT", b"##SD", b"##RD"):
            yield from self._plain(block)
        elif block.kind == b"##DZ":
            yield self._unpacked(block)
        elif block.kind == b"##HL":
            yield from self.data(block.links[0])
        elif block.kind == b"##DL":
            for part in self._chain(place, b"##DL"):
                for link in part.links[1:]:
                    yield from self.data(link)
        else:
            raise Unsupported(f"data in a block {block.kind.decode('ascii', 'replace')}")

    # --- blocks -----------------------------------------------------------------------------------------------------------

    def _at(self, place: int, size: int) -> bytes:
        self._file.seek(place)
        return self._file.read(size)

    def _block(self, place: int, kind: bytes = b"") -> _Block:
        head = self._at(place, 24)
        if len(head) < 24 or head[:2] != b"##" or (kind and head[:4] != kind):
            raise OSError(f"no block {kind.decode()} at {place}")
        size, count = struct.unpack_from("<QQ", head, 8)
        if count > 1 << 16:
            raise OSError(f"a block with {count} links at {place}")
        links = struct.unpack(f"<{count}Q", self._at(place + 24, 8 * count))
        return _Block(head[:4], place, size, links, place + 24 + 8 * count)

    def _chain(self, place: int, kind: bytes) -> Iterator[_Block]:
        """A block and those it is linked with, one after the other."""
        seen = set()
        while place and place not in seen:
            seen.add(place)
            block = self._block(place, kind)
            yield block
            place = block.links[0]

    def _text(self, place: int) -> str:
        if not place:
            return ""
        block = self._block(place)
        return self._at(block.body, min(block.size - 24, 4096)).split(b"\0")[0].decode("utf-8", "replace")

    def _plain(self, block: _Block) -> Iterator[bytes]:
        left = block.size - _UNKNOWN_SIZE
        is_open = not left and not self.is_finished
        place = block.body
        while piece := self._at(place, PIECE_BYTES if is_open else min(left, PIECE_BYTES)):
            yield piece
            place += len(piece)
            left -= len(piece)
        if left > 0 and not is_open:
            raise EOFError("a data block is cut")

    def _unpacked(self, block: _Block) -> bytes:
        _, method, columns, size, packed = struct.unpack("<2sBxLQQ", self._at(block.body, 24))
        if size > MOST_BYTES or method > 1:
            raise Unsupported(f"a block packed by method {method} to {size} bytes")
        data = zlib.decompressobj().decompress(self._at(block.body + 24, packed), size)
        if len(data) < size:
            raise EOFError("a packed data block is cut")
        if method == 0 or columns < 2:
            return data
        rows = size // columns  # written column by column, what is left over at the end as it is
        square = bytearray(size)
        for column in range(columns):
            square[column:rows * columns:columns] = data[column * rows:(column + 1) * rows]
        square[rows * columns:] = data[rows * columns:]
        return bytes(square)

    # --- groups and their fields ------------------------------------------------------------------------------------------

    def _group(self, block: _Block) -> Group:
        number, _, flags, _, size, invalidation = struct.unpack("<QQHH4xLL", self._at(block.body, 32))
        if flags & _VLSD_GROUP:
            return Group(number, "", 0, True, block.place, {})
        source = self._at(self._block(block.links[3]).body, 2) if block.links[3] else b""
        fields: dict[str, Field] = {}
        kind = ""
        if flags & _BUS_EVENT and tuple(source) == _CAN_SOURCE:
            for channel in self._chain(block.links[1], b"##CN"):
                name = self._text(channel.links[2])
                if self._at(channel.body, 1)[0] in _MASTERS:
                    fields["time"] = self._field(channel, name)
                elif name in KINDS:
                    kind = name
                    fields.update(self._parts(channel))
        return Group(number, kind if "time" in fields and size else "", size + invalidation, False, block.place, fields)

    def _parts(self, channel: _Block) -> dict[str, Field]:
        """The parts of a frame, by the last part of their names."""
        if not channel.links[1] or self._at(channel.links[1], 4) != b"##CN":
            return {}
        parts = {}
        for part in self._chain(channel.links[1], b"##CN"):
            name = self._text(part.links[2]).rpartition(".")[2]
            parts[name] = self._field(part, name)
        return parts

    def _field(self, channel: _Block, name: str) -> Field:
        kind, _, data_kind, bit, byte, bits = struct.unpack("<BBBBLL", self._at(channel.body, 12))
        return Field(name, byte, bit, bits, data_kind, self._conversion(channel.links[4]), kind in _VIRTUAL, kind == _VARIABLE,
                     channel.links[5])

    def _conversion(self, place: int) -> Conversion:
        if not place:
            return Conversion()
        block = self._block(place, b"##CC")
        kind, _, _, _, count = struct.unpack("<BBHHH", self._at(block.body, 8))
        values = struct.unpack(f"<{count}d", self._at(block.body + 24, 8 * count))
        if kind == 0:
            return Conversion()
        if kind == 1:
            return Conversion(1, values[0], values[1])
        if kind in (4, 5):
            return Conversion(5, table=tuple(zip(values[::2], values[1::2], strict=True)))
        return Conversion(kind)
