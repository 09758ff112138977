"""One CAN frame as the core sees it: when, which, what."""
from __future__ import annotations

from typing import NamedTuple

EXTENDED = 0x8000_0000
"""Bit of a 29-bit identifier (SocketCAN `CAN_EFF_FLAG`)."""
REMOTE = 0x4000_0000
"""Bit of a remote frame (SocketCAN `CAN_RTR_FLAG`)."""
ERROR = 0x2000_0000
"""Bit of an error message frame (SocketCAN `CAN_ERR_FLAG`)."""
BUS_SHIFT = 32


Row = tuple[int, int, bytes]
"""A frame on the hot path, where making a `Frame` of each costs more than judging it: time, key, data."""


class Frame(NamedTuple):
    """A received or sent CAN frame.

    t_ns: nanoseconds on the caller's monotonic (or the recording's) time line.
    key:  SocketCAN `canid_t` (29-bit identifiers carry `EXTENDED`), plus the bus index shifted by `BUS_SHIFT`:
          one integer that names the talker, so that a dictionary finds its decoder in one step.
    data: 0–8 payload bytes (CAN), up to 64 (CAN FD), up to 1785 (reassembled J1939 transport protocol). A remote frame has none;
          in one that is to be sent stand as many zeros as it asks for.
    """

    t_ns: int
    key: int
    data: bytes

    @property
    def can_id(self) -> int:
        """The 11- or 29-bit identifier without flags."""
        return self.key & 0x1FFF_FFFF

    @property
    def extended(self) -> bool:
        """Whether the identifier has 29 bits."""
        return bool(self.key & EXTENDED)

    @property
    def bus(self) -> int:
        """Index of the bus, in the order of the configuration."""
        return self.key >> BUS_SHIFT


def frame_key(can_id: int, extended: bool, bus: int = 0) -> int:
    """The `Frame.key` of an identifier on a bus."""
    return can_id | (EXTENDED if extended else 0) | bus << BUS_SHIFT


def j1939_pgn(can_id: int) -> int:
    """Parameter group number of a 29-bit identifier (SAE J1939-21 §5.2): the destination of PDU1 is not part of it."""
    pgn = can_id >> 8 & 0x3FFFF
    return pgn if (pgn >> 8 & 0xFF) >= 240 else pgn & 0x3FF00
