"""A SocketCAN interface read directly: frames in batches, each with the kernel's time; errors beside them; frames out.

Theory of operation. One system call (`recvmmsg`) fetches up to `BATCH` frames with their kernel stamps into memory that was
laid out once; Python only cuts it up. The kernel drops what nobody asked for (`listen`), keeps up to `BUFFER_BYTES` while the
caller is busy, and counts what it then had to drop (SO_RXQ_OVFL). Error message frames come on a socket of their own, so that
the path of the frames need not look for them.

Kernel stamps are of the wall clock, which jumps on a tractor: `Stamps` compares the clocks once a batch.
"""
from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import socket
import struct
import sys
from collections.abc import Callable, Iterable, Sequence

from level1.frame import BUS_SHIFT, EXTENDED, REMOTE, Frame, Row
from level1.io.config import Bus
from level1.io.error import OutsideError
from level1.io.stamps import PLAUSIBLE_AGE_NS, Stamps

BATCH = 64
LOOKS = 3
"""At the clocks before the first frame: it is unlikely to be interrupted in all of them."""
MOST_BATCHES = 64
"""Batches of one `receive` at most, so that a flood can't hold the caller."""
BUFFER_BYTES = 8 << 20
"""What the kernel may keep: 20,000 frames, two seconds of a full 1 Mbit/s bus."""
CLASSIC, FLEXIBLE = 16, 72
"""Sizes of `struct can_frame` and `struct canfd_frame`."""
CLASSIC_BYTES = 8
MOST_FILTERS = 512
"""The kernel takes no more (CAN_RAW_FILTER_MAX); above that everything is received."""
ERROR_MASK = 0x1 | 0x4 | 0x8 | 0x10 | 0x20 | 0x40 | 0x80 | 0x100
"""Classes of error frames asked for (linux/can/error.h): all but lost arbitration, which is normal on a bus, and counters."""
Filter = tuple[int, int]
"""Identifier with flags, and mask: passes what is equal under the mask."""

_SIOCGIFFLAGS, _IFF_UP = 0x8913, 1
_CAN_RAW_ERR_FILTER = 2
_RCVBUFFORCE, _RXQ_OVFL = 33, 40
_MEMINFO, _MEMINFO_FIELDS = 55, 9  # the last field counts drops
_TIMESTAMPNS = 35 if struct.calcsize("l") == 8 else 64  # two 64-bit integers in either case
_STAMP_AT, _STAMP_SPACE = socket.CMSG_LEN(0), socket.CMSG_SPACE(16)
_DROPS_AT = _STAMP_SPACE + socket.CMSG_LEN(0)
_CONTROL = _STAMP_SPACE + socket.CMSG_SPACE(4)
_NOW_OR_NEVER = {errno.ENOBUFS, errno.EAGAIN}


class BusError(OutsideError):
    """A bus that can't be opened; the text says what to do."""


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):
    _fields_ = (("name", ctypes.c_void_p), ("name_length", ctypes.c_uint32), ("vectors", ctypes.c_void_p),
                ("vector_count", ctypes.c_size_t), ("control", ctypes.c_void_p), ("control_length", ctypes.c_size_t),
                ("flags", ctypes.c_int))


class _Header(ctypes.Structure):
    _fields_ = (("message", _Message), ("length", ctypes.c_uint32))


_HEADER = ctypes.sizeof(_Header)
_LENGTH, _LENGTH_AT = struct.Struct("N").unpack_from, _Message.control_length.offset


class Batches:
    """Reads a datagram socket on which each datagram is a CAN frame as Linux lays it out.

    sock: not blocking. frame_bytes: `CLASSIC` or `FLEXIBLE`. clock, wall: monotonic and wall clock, ns. lost: frames that the
    kernel had to drop so far, because its buffer was full. last_ns: when the last frame came.
    """

    def __init__(self, sock: socket.socket, frame_bytes: int, clock: Callable[[], int], wall: Callable[[], int]):
        self.lost = 0
        self.last_ns: int | None = None
        self._sock = sock
        self._clock, self._wall, self._stamps = clock, wall, Stamps()
        for _ in range(LOOKS):
            self._offset_ns()
        for option in (_TIMESTAMPNS, _RXQ_OVFL):
            sock.setsockopt(socket.SOL_SOCKET, option, 1)
        # Frame and control data of each message lie side by side: one cut gives all that belongs together.
        self._stride, self._room = frame_bytes + _CONTROL, frame_bytes - 8
        self._memory = ctypes.create_string_buffer(BATCH * self._stride)
        self._vectors = (_Vector * BATCH)()
        self._headers = (_Header * BATCH)()
        for i in range(BATCH):
            place = ctypes.addressof(self._memory) + i * self._stride
            self._vectors[i] = _Vector(place, frame_bytes)
            self._headers[i].message = _Message(None, 0, ctypes.addressof(self._vectors[i]), 1, place + frame_bytes, _CONTROL, 0)
        self._view, self._header_view = memoryview(self._memory).cast("B"), memoryview(self._headers).cast("B")
        fresh, self._used = memoryview(bytes(self._headers)), 0
        self._resets = [(self._header_view[:count * _HEADER], fresh[:count * _HEADER]) for count in range(BATCH + 1)]
        self._parts = [self._view[:count * self._stride] for count in range(BATCH + 1)]
        self._cut = struct.Struct(f"=IB3x{frame_bytes - 8}s{_STAMP_AT}xqq{_CONTROL - _STAMP_AT - 16}x").iter_unpack
        self._drops_at = frame_bytes + _DROPS_AT
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg

    def receive(self, bus: int) -> list[Row]:
        """All that is there, without waiting. Raises OSError."""
        found: list[Row] = []
        shift = bus << BUS_SHIFT
        for _ in range(MOST_BATCHES):
            kept, fresh = self._resets[self._used]
            kept[:] = fresh  # the kernel overwrote the lengths
            count = self._used = self._recvmmsg(self._sock.fileno(), self._headers, BATCH, socket.MSG_DONTWAIT, None)
            if count <= 0:
                self._used = 0
                self._check(count)
                break
            self._append(count, shift, found)
            if count < BATCH:
                break
        if found:
            self.last_ns = found[-1][0]
        return found

    def _check(self, count: int) -> None:
        """Raises OSError where `recvmmsg` gave no frame for another reason than that there is none."""
        number = ctypes.get_errno() if count < 0 else 0
        if number not in (0, errno.EAGAIN, errno.EINTR):
            raise OSError(number, os.strerror(number))

    def _offset_ns(self) -> tuple[int | None, int]:
        """See `Stamps.offset_ns`; and what time it is."""
        before_ns, wall_ns, now_ns = self._clock(), self._wall(), self._clock()
        return self._stamps.offset_ns(before_ns, wall_ns, now_ns), now_ns

    def _append(self, count: int, shift: int, found: list[Row]) -> None:
        """Cut up what was fetched."""
        offset, now_ns = self._offset_ns()
        last, = _LENGTH(self._header_view, (count - 1) * _HEADER + _LENGTH_AT)
        if last > _STAMP_SPACE:
            self.lost = int.from_bytes(self._view[(count - 1) * self._stride + self._drops_at:][:4], sys.byteorder)
        if offset is None or not last:
            offset, oldest_ns = 0, now_ns
        else:
            oldest_ns = now_ns - PLAUSIBLE_AGE_NS
        append, room = found.append, self._room
        for can_id, size, data, s, ns in self._cut(self._parts[count]):
            t_ns = s * 1_000_000_000 + ns - offset
            append((t_ns if oldest_ns < t_ns <= now_ns else now_ns, can_id | shift, data if size == room else data[:size]))


class SocketCan:
    """An open interface. Raises BusError with what to do when it can't be opened."""

    def __init__(self, settings: Bus, clock: Callable[[], int], wall: Callable[[], int]):
        check(settings)
        self.impossible = 0
        self._sock = _raw_socket()
        self._error_sock = _raw_socket()
        try:
            enlarge(self._sock)
            if settings.fd:
                self._sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            self._error_sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            self._error_sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, ERROR_MASK.to_bytes(4, sys.byteorder))
            self._batches = Batches(self._sock, FLEXIBLE if settings.fd else CLASSIC, clock, wall)
            self._errors = Batches(self._error_sock, CLASSIC, clock, wall)
            self._error_sock.bind((settings.channel,))
            self._sock.bind((settings.channel,))
        except OSError as error:
            self.close()
            raise BusError(f"bus {settings.name}: socketcan {settings.channel} can't be opened: {error.strerror}; "
                           f"{_bring_up(settings)}") from None
        self._channel = settings.channel

    def fileno(self) -> int:
        """The descriptor that becomes readable when frames come."""
        return self._sock.fileno()

    @property
    def lost(self) -> int:
        """Frames that the kernel had to drop since it was opened: also those after which none has come."""
        counters = self._sock.getsockopt(socket.SOL_SOCKET, _MEMINFO, 4 * _MEMINFO_FIELDS)
        drops = struct.unpack(f"={len(counters) // 4}I", counters)
        return max(self._batches.lost, drops[-1]) if len(drops) == _MEMINFO_FIELDS else self._batches.lost

    @property
    def last_ns(self) -> int | None:
        """When the last frame came."""
        return self._batches.last_ns

    def receive(self, bus: int) -> list[Row]:
        """All frames that are there, without waiting. bus: index for their keys. Raises OSError when the interface is lost."""
        return self._batches.receive(bus)

    def errors(self, bus: int) -> list[Frame]:
        """All error message frames that are there."""
        return [Frame(*row) for row in self._errors.receive(bus)]

    def listen(self, filters: Sequence[Filter] | None) -> None:
        """Receive only what passes one of the filters; None: everything. Raises OSError."""
        if filters is None or len(filters) > MOST_FILTERS:
            filters = ((0, 0),)
        packed = b"".join(struct.pack("=II", *one) for one in filters)
        self._sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)

    def send(self, key: int, data: bytes) -> bool:
        """Send a frame; False: not now. Raises OSError."""
        size = len(data)
        frame = struct.pack("=IB3x8s" if size <= CLASSIC_BYTES else "=IB3x64s", key & 0xFFFF_FFFF, size, data)
        try:
            self._sock.send(frame)
        except OSError as error:
            if error.errno in _NOW_OR_NEVER:
                return False
            raise
        return True

    def traffic(self) -> tuple[int, int]:
        """Frames and bytes that the interface has received, whoever asked for them. Raises OSError."""
        with open("/proc/net/dev", encoding="ascii") as table:
            for line in table:
                name, _, counts = line.partition(":")
                if name.strip() == self._channel:
                    octets, packets = counts.split()[:2]
                    return int(packets), int(octets)
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    def close(self) -> None:
        """Close it."""
        self._sock.close()
        self._error_sock.close()


def merged(can_ids: Iterable[int]) -> list[Filter]:
    """Filters that pass exactly these 11-bit identifiers: neighbours that differ in one bit share one."""
    flags = EXTENDED | REMOTE
    level = {(can_id, 0x7FF) for can_id in can_ids}
    done: list[Filter] = []
    while level:
        joined: set[Filter] = set()
        used: set[Filter] = set()
        for one in level:
            for bit in (1 << place for place in range(11)):
                other = (one[0] ^ bit, one[1])
                if one[1] & bit and other in level:
                    joined.add((one[0] & ~bit, one[1] & ~bit))
                    used |= {one, other}
        done += level - used
        level = joined
    return [(can_id, mask | flags) for can_id, mask in _needed(done)]


def _needed(filters: list[Filter]) -> list[Filter]:
    """Without those that others cover, the widest first."""
    kept: list[Filter] = []
    missing = {can_id for can_id in range(0x800) if any(can_id & mask == value for value, mask in filters)}
    for value, mask in sorted(filters, key=lambda one: (one[1].bit_count(), one)):
        passes = {can_id for can_id in missing if can_id & mask == value}
        if passes:
            kept.append((value, mask))
            missing -= passes
    return kept


def check(settings: Bus) -> None:
    """Raises BusError with what to do where the interface is missing or down."""
    name, channel = settings.name, settings.channel
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            request = fcntl.ioctl(probe, _SIOCGIFFLAGS, struct.pack("16sh14x", channel.encode(), 0))
    except OSError as error:
        if error.errno != errno.ENODEV:
            raise BusError(f"bus {name}: this kernel has no SocketCAN ({error.strerror}); load it: modprobe can-raw") from None
        raise BusError(f"bus {name}: there is no interface {channel}; {_create(settings)}") from None
    if not struct.unpack("16sh14x", request)[1] & _IFF_UP:
        raise BusError(f"bus {name}: the interface {channel} is down; {_bring_up(settings)}")


def _raw_socket() -> socket.socket:
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.setblocking(False)
    return sock


def enlarge(sock: socket.socket) -> None:
    """As large a buffer as the kernel allows: without the right to (CAP_NET_ADMIN) it is net.core.rmem_max."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _RCVBUFFORCE, BUFFER_BYTES)
    except OSError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)


def _create(settings: Bus) -> str:
    if settings.channel.startswith("vcan"):
        return f"create it: ip link add {settings.channel} type vcan && {_bring_up(settings).partition(': ')[2]}"
    return f"plug the adapter in (`ip link` lists what is there), then {_bring_up(settings)}"


def _bring_up(settings: Bus) -> str:
    rate = "" if settings.channel.startswith("vcan") else f" type can bitrate {settings.bitrate or 250000}"
    return f"bring it up: ip link set {settings.channel} up{rate}"
