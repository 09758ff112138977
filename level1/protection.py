"""End-to-end protection of a message: rolling counter and checksum, checked at every frame (attribute `Role`).

A wrong checksum makes the frame CORRUPT. A counter that steps back (by more than half its range) is CORRUPT too; one that
skips means lost frames, which is the business of silence, not of this. A counter that stands still for `FROZEN_REPEATS`
frames is FROZEN: something repeats old data. After a silence the counter may begin anywhere.
"""
from __future__ import annotations

from level1.catalog import Message, Signal
from level1.decode import CORRUPT, FROZEN, GOOD, raw_of

FROZEN_REPEATS = 3
"""Frames with the counter of the one before: one may be a retransmission; opendbc drops control after 5 bad counters."""


def crc8(data: bytes, polynomial: int) -> int:
    """CRC-8 with initial value and final XOR 0xFF, not reflected (SAE J1850: 0x1D; AUTOSAR CRC8H2F: 0x2F)."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ polynomial) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ 0xFF


def xor8(data: bytes) -> int:
    """All bytes XORed."""
    total = 0
    for byte in data:
        total ^= byte
    return total


CHECKSUMS = {
    "CRC8_SAE_J1850": lambda data: crc8(data, 0x1D),
    "CRC8_2F": lambda data: crc8(data, 0x2F),
    "XOR": xor8,
}
"""Algorithms of the attribute `ChecksumType`, over all bytes of the payload but the checksum's own, in order."""


class Protection:
    """The counter and checksum of one message. Made only for a message that has one (`of`)."""

    __slots__ = ("checksum", "counter", "last", "repeats", "sum")

    def __init__(self, counter: Signal | None, checksum: Signal | None):
        self.counter = counter
        self.checksum = checksum
        self.sum = CHECKSUMS[checksum.checksum] if checksum is not None else xor8
        self.last: int | None = None
        self.repeats = 0

    @classmethod
    def of(cls, message: Message) -> Protection | None:
        """The protection a message carries, None if it carries none."""
        roles = {signal.role: signal for signal in message.signals if signal.role != "None"}
        return cls(roles.get("Counter"), roles.get("Checksum")) if roles else None

    def restart(self) -> None:
        """After a silence the counter may begin anywhere."""
        self.last = None
        self.repeats = 0

    def check(self, data: bytes) -> int:
        """GOOD, CORRUPT or FROZEN for the next frame."""
        if self.checksum is not None:
            place = self.checksum.start // 8
            if place >= len(data) or self.sum(data[:place] + data[place + 1:]) != data[place]:
                return CORRUPT
        if self.counter is None:
            return GOOD
        count = raw_of(self.counter, data)
        if count is None:
            return CORRUPT
        return self._step(int(count), 1 << self.counter.length)

    def _step(self, count: int, period: int) -> int:
        step = None if self.last is None else (count - self.last) % period
        if step is not None and step > period // 2:
            return CORRUPT
        self.last = count
        self.repeats = self.repeats + 1 if step == 0 else 0
        return FROZEN if self.repeats >= FROZEN_REPEATS else GOOD
