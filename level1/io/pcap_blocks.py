"""pcap and pcapng captures of SocketCAN interfaces (tcpdump, Wireshark; link type 227) in blocks.

A frame stands in a packet as `struct can_frame` or `canfd_frame`, but its identifier in network byte order (LINKTYPE_CAN_SOCKETCAN
of the Tcpdump group). Time stamps are exact. Packets of other links, and CAN XL, are counted as unreadable.
"""
from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Block, Ints
from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE
from level1.io.candump import LATEST_NS
from level1.io.message import CLASSIC_BYTES, FD_BYTES
from level1.io.rows import HEAD_MASKS, block_of_words, on_buses

SOCKETCAN = 227
"""Link type of CAN frames."""
_COOKED = (113, 276)
"""Link types of `tcpdump -i any`."""
BATCH_BYTES = 1 << 21
"""Bytes taken apart at a time: some 60,000 frames, so that what a block costs does not matter."""
MOST_BYTES = 1 << 20
"""A packet or block longer than this is damage."""

_MAGICS = {b"\xa1\xb2\xc3\xd4": (">", 1000), b"\xd4\xc3\xb2\xa1": ("<", 1000), b"\xa1\xb2\x3c\x4d": (">", 1),
           b"\x4d\x3c\xb2\xa1": ("<", 1)}
"""How a pcap file begins: byte order, and ns in a unit of its fractions."""
_SECTION, _INTERFACE, _PACKET, _SIMPLE = 0x0A0D0D0A, 1, 6, 3
"""Types of pcapng blocks."""
_NAME, _RESOLUTION = 2, 9
"""Options of an interface."""
_HEAD, _ROOM, _PACKET_HEAD = 8, 72, 16
_XL = 0x80
"""Flag, where other frames have their length, of a CAN XL frame."""


class Packets(NamedTuple):
    """Of each packet where its bytes begin in a batch, how many there are, when it came (-1: out of range), on which channel
    (negative: no CAN bus)."""

    places: Ints
    sizes: Ints
    t_ns: Ints
    channels: Ints


class Interface(NamedTuple):
    """Of a pcapng section: its link, and how many of its units of time are a second."""

    channel: int
    units: int


class PcapBlocks:
    """Reads a capture in blocks.

    file: where to read, at its beginning. bus(channel): index of a channel's bus, asked in the order of appearance. skip(reason):
    told of every packet that can't be read, in order.
    """

    def __init__(self, file: BinaryIO, bus: Callable[[str], int], skip: Callable[[str], None]):
        self._file = file
        self._bus = bus
        self._skip = skip
        self._names = [""]
        self._interfaces: list[Interface] = []
        self._order, self._unit_ns = "<", 1000
        self._count = 0

    def blocks(self, rows: int) -> Iterator[Block]:
        """The frames, so many a block or fewer."""
        magic = self._file.read(4)
        if magic in _MAGICS:
            self._order, self._unit_ns = _MAGICS[magic]
            head = self._file.read(20)
            link = struct.unpack_from(self._order + "L", head, 16)[0] & 0x0FFF_FFFF if len(head) == 20 else -1
            walk = self._walk
            self._interfaces = [Interface(0 if link == SOCKETCAN else -1, 0)]
            if link in _COOKED:
                self._skip("captured from all interfaces at once; capture a CAN interface itself: tcpdump -i can0 -w FILE")
                return
            tail = b""
        else:
            walk, tail = self._walk_blocks, magic
        yield from on_buses(self._batches(walk, tail, rows), lambda channel: self._bus(self._names[channel]))

    def _batches(self, walk: Callable[[bytes], tuple[Packets, int]], tail: bytes, rows: int) -> Iterator[Block]:
        while piece := self._file.read(min(BATCH_BYTES, rows * 32)):
            data = tail + piece
            packets, end = walk(data)
            tail = data[end:]
            block = self._frames(data, packets)
            if block is not None:
                yield block
        if tail:
            raise EOFError("a packet is cut")

    # --- where packets are ------------------------------------------------------------------------------------------------

    def _walk(self, data: bytes) -> tuple[Packets, int]:
        """The whole packets of a piece of a pcap file, and where they end."""
        size_at, last, place, found = struct.Struct(self._order + "L").unpack_from, len(data) - _PACKET_HEAD, 0, []
        while place <= last:
            found.append(place)
            place += _PACKET_HEAD + size_at(data, place + 8)[0]
        places = np.array(found, np.int64)
        heads = _rows(np.frombuffer(data, np.uint8), places, 12).view(self._order + "u4").astype(np.int64)
        sizes = heads[:, 2]
        if len(sizes) and sizes.max() > MOST_BYTES:
            raise EOFError(f"a packet of {sizes.max()} bytes")
        if place > len(data):
            place, places, heads, sizes = found[-1], places[:-1], heads[:-1], sizes[:-1]
        t_ns = heads[:, 0] * 10**9 + heads[:, 1] * self._unit_ns
        return Packets(places + _PACKET_HEAD, sizes, t_ns, np.full(len(places), self._interfaces[0].channel)), place

    def _walk_blocks(self, data: bytes) -> tuple[Packets, int]:
        """The whole packets of a piece of a pcapng file, and where its whole blocks end."""
        packets: list[tuple[int, int, int, int]] = []
        place = 0
        while place + 12 <= len(data):
            kind, size = struct.unpack_from(self._order + "LL", data, place)
            if kind == _SECTION:
                self._order = "<" if data[place + 8:place + 12] == b"\x4d\x3c\x2b\x1a" else ">"
                size = struct.unpack_from(self._order + "L", data, place + 4)[0]
            if not 12 <= size <= MOST_BYTES or size % 4:
                raise EOFError(f"a block of {size} bytes")
            if place + size > len(data):
                break
            body = data[place + 8:place + size - 4]
            if kind == _SECTION:
                self._interfaces = []
            elif kind == _INTERFACE and len(body) >= 8:
                self._interfaces.append(self._interface(body))
            elif kind == _PACKET and len(body) >= 20:
                packets.append(self._packet(body, place + 28))
            elif kind == _SIMPLE:
                packets.append((place, 0, 0, -1))
            place += size
        columns = np.array(packets, np.int64).reshape(-1, 4)
        return Packets(*columns.T), place

    def _packet(self, body: bytes, place: int) -> tuple[int, int, int, int]:
        number, high, low, size = struct.unpack_from(self._order + "LLLL", body)
        if number >= len(self._interfaces):
            return place, 0, 0, -1
        interface = self._interfaces[number]
        t_ns = (high << 32 | low) * 10**9 // interface.units
        return place, min(size, len(body) - 20), t_ns if t_ns <= LATEST_NS else -1, interface.channel

    def _interface(self, body: bytes) -> Interface:
        """An interface: its link, its name and its resolution of time."""
        name, units, place = "", 10**6, 8
        while place + 4 <= len(body):
            option, size = struct.unpack_from(self._order + "HH", body, place)
            value = body[place + 4:place + 4 + size]
            if option == _NAME:
                name = value.decode("utf-8", "replace")
            elif option == _RESOLUTION and value:
                units = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
            place += 4 + (size + 3) // 4 * 4
        if struct.unpack_from(self._order + "H", body)[0] != SOCKETCAN:
            return Interface(-1, units)
        name = name or str(len(self._interfaces))
        if name not in self._names:
            self._names.append(name)
        return Interface(self._names.index(name), units)

    # --- what is in them --------------------------------------------------------------------------------------------------

    def _frames(self, data: bytes, packets: Packets) -> Block | None:
        """The frames of some packets."""
        places, sizes, t_ns, channels = packets
        if not len(places):
            return None
        room = np.frombuffer(data + bytes(_HEAD + _ROOM), np.uint8)
        heads = _rows(room, places, _HEAD)
        ids = heads[:, :4].copy().view(">u4")[:, 0].astype(np.uint64)
        lengths = heads[:, 4].astype(np.int64)
        is_error, is_remote = ids & np.uint64(ERROR) != 0, ids & np.uint64(REMOTE) != 0
        is_fd = (sizes >= _HEAD + FD_BYTES) | (heads[:, 5] & 4 != 0)
        right = (channels >= 0) & (t_ns >= 0) & (lengths <= np.where(is_fd, FD_BYTES, CLASSIC_BYTES))
        lengths[is_remote & ~is_error] = 0
        right &= sizes >= _HEAD + lengths
        for place in np.flatnonzero(~right).tolist():
            reason = "no CAN frame" if channels[place] < 0 else "time stamp out of range" if t_ns[place] < 0 else (
                f"{lengths[place]} data bytes in a packet of {sizes[place]}")
            self._skip(f"unreadable packet {self._count + place + 1}: {reason}")
        self._count += len(places)
        keep = np.flatnonzero(right)
        if not len(keep):
            return None
        ids = np.where(is_error, ids & np.uint64(0x1FFF_FFFF | ERROR), ids & np.uint64(0x1FFF_FFFF | EXTENDED | REMOTE))[keep]
        words = channels[keep].astype(np.uint64) << np.uint64(BUS_SHIFT) | ids
        lengths, places = lengths[keep], places[keep] + _HEAD
        eight = _rows(room, places, HEAD_BYTES).view("<u8")[:, 0] & HEAD_MASKS[np.minimum(lengths, HEAD_BYTES)]
        wide_rows = np.flatnonzero(lengths > HEAD_BYTES)
        wide = _rows(room, places[wide_rows], _ROOM)
        wide[np.arange(_ROOM) >= lengths[wide_rows, None]] = 0
        return block_of_words(t_ns[keep], words, lengths.astype(np.uint16), eight, wide_rows, wide)


def _rows(room: npt.NDArray[np.uint8], places: Ints, width: int) -> npt.NDArray[np.uint8]:
    """So many bytes from each place on, a row each."""
    everywhere = np.ndarray((len(room) - width + 1,), f"V{width}", room, 0, (1,))
    return everywhere[places].view(np.uint8).reshape(len(places), width)
