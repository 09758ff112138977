"""python-can's messages and the core's frames, into one another."""
from __future__ import annotations

from typing import TYPE_CHECKING

from level1.frame import ERROR, EXTENDED, REMOTE

if TYPE_CHECKING:
    import can

CLASSIC_BYTES, FD_BYTES = 8, 64


def flagged_id(can_id: int, extended: bool) -> int:
    """`Frame.key` of an identifier, without a bus. Raises ValueError when it has too many bits."""
    if can_id > (0x1FFFFFFF if extended else 0x7FF):
        raise ValueError(f"the identifier {can_id:X} has more than {29 if extended else 11} bits")
    return can_id | (EXTENDED if extended else 0)


def bounded(data: bytes, limit: int) -> bytes:
    """The data. Raises ValueError when it is longer than a frame of this kind can be."""
    if len(data) > limit:
        raise ValueError(f"{len(data)} data bytes; a frame of this kind has at most {limit}")
    return data


def from_message(message: can.Message) -> tuple[int, bytes]:
    """Flagged identifier (`Frame.key` without a bus) and data. Raises ValueError with what is wrong."""
    data = bytes(message.data)
    if message.is_error_frame:
        return ERROR | message.arbitration_id & 0x1FFFFFFF, data
    # Some BLF writers leave the flag out; an identifier of more than 11 bits can only be an extended one.
    can_id = flagged_id(message.arbitration_id, message.is_extended_id or message.arbitration_id > 0x7FF)
    if message.is_remote_frame:
        return can_id | REMOTE, b""
    return can_id, bounded(data, FD_BYTES if message.is_fd else CLASSIC_BYTES)
