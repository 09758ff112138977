"""The file beside the journal that remembers the boot id: it outlives a lost or corrupt journal.

Two slots of one line each, both in the first 512 bytes of the file and written in turn and in place: a power cut
while writing spoils one slot at most, and a full disk can't stop it, since nothing is allocated.
"""
from __future__ import annotations

import os
import zlib
from pathlib import Path

SLOT = 30
"""Bytes of a slot: 20 digits, a space, 8 hexadecimal digits of the CRC-32 of the digits, a line end."""


class BootFile:
    """The boot id last begun, on disk."""

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> int:
        """The highest boot id written, 0 where there is none. Raises OSError when the file can't be read."""
        return max(self._slots())

    def write(self, boot: int) -> None:
        """Remember a boot id; it is on the disk when this returns. Raises OSError."""
        slots = self._slots()
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            os.pwrite(file, _line(boot), slots.index(min(slots)) * SLOT)
            os.fsync(file)
        finally:
            os.close(file)
        sync_folder(self.path.parent)

    def _slots(self) -> tuple[int, int]:
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            content = b""
        return _value(content[:SLOT]), _value(content[SLOT:2 * SLOT])


def sync_folder(folder: Path) -> None:
    """Make new and renamed files of a folder durable. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _line(boot: int) -> bytes:
    digits = b"%020d" % boot
    return b"%s %08x\n" % (digits, zlib.crc32(digits))


def _value(line: bytes) -> int:
    digits = line[:20]
    return int(digits) if digits.isdigit() and line == b"%s %08x\n" % (digits, zlib.crc32(digits)) else 0
