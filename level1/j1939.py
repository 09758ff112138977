"""SAE J1939 beyond single frames: transport protocol (J1939-21 §5.10, ISO 11783-3) and active trouble codes (J1939-73, DM1).

Pure and passive: it listens to sessions between others as well, answers none, and reads no clock. Address claim and own
sessions are the business of the node that sends.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from level1.frame import BUS_SHIFT, EXTENDED

DM1 = 65226
TP_CM, TP_DT = 0xEC00, 0xEB00
"""Parameter groups of connection management and data transfer."""
_RTS, _END, _BAM, _ABORT = 16, 19, 32, 255
MAX_SIZE = 1785
"""Bytes of the longest message: 255 packets of 7."""
T1_NS = 750_000_000
"""Longest gap between two packets of a broadcast (J1939-21 T1)."""
T2_NS = 1_250_000_000
"""Longest gap in a session with flow control (J1939-21 T2, T3)."""
MAX_SESSIONS = 512
"""Sessions at one time over all buses; real buses have a handful, a babbling node must not fill the memory."""
MAX_CODES = 256
"""Trouble codes in one message: (1785 - 2) / 4 is 445; J1939-73 users send up to 50."""

Deliver = Callable[[int, int, bytes], None]


class Session:
    """A message that is coming in packets."""

    __slots__ = ("broadcast", "key", "last_ns", "packets", "size")

    def __init__(self, t_ns: int, key: int, size: int, count: int, broadcast: bool):
        self.key = key
        self.size = size
        self.packets: list[bytes | None] = [None] * count
        self.broadcast = broadcast
        self.last_ns = t_ns


class Transport:
    """Puts messages of 9–1785 bytes together, from many senders at once, and hands them on with the key of their own parameter
    group. What goes wrong is counted: lost packets, time-outs, sessions broken off, sizes that contradict each other."""

    def __init__(self, deliver: Deliver, counters: Counter[str]):
        self.deliver = deliver
        self.counters = counters
        self.sessions: dict[tuple[int, int, int], Session] = {}

    def connection(self, t_ns: int, key: int, data: bytes) -> None:
        """A TP.CM frame: announcement of a broadcast, request or end of a session."""
        if len(data) < 8:
            self.counters["transport: malformed frames"] += 1
            return
        place = (key >> BUS_SHIFT, key & 0xFF, key >> 8 & 0xFF)
        control = data[0]
        if control in (_BAM, _RTS):
            self._begin(t_ns, key, place, data)
        elif control == _ABORT:
            for ends in (place, (place[0], place[2], place[1])):
                if self.sessions.pop(ends, None) is not None:
                    self.counters["transport: sessions broken off"] += 1
        elif control == _END:
            self.sessions.pop((place[0], place[2], place[1]), None)

    def _begin(self, t_ns: int, key: int, place: tuple[int, int, int], data: bytes) -> None:
        size, count = data[1] | data[2] << 8, data[3]
        if not 9 <= size <= MAX_SIZE or count != (size + 6) // 7:
            self.counters["transport: malformed frames"] += 1
            return
        if place in self.sessions:
            self.counters["transport: sessions broken off"] += 1
        elif len(self.sessions) >= MAX_SESSIONS:
            self._drop_dead(t_ns)
            if len(self.sessions) >= MAX_SESSIONS:
                self.counters["transport: too many sessions"] += 1
                return
        group = data[5] | data[6] << 8 | (data[7] & 3) << 16
        destination = place[2] if group >> 8 & 0xFF < 240 else 0
        message_key = key >> BUS_SHIFT << BUS_SHIFT | EXTENDED | key & 0x1C00_0000 | (group | destination) << 8 | place[1]
        self.sessions[place] = Session(t_ns, message_key, size, count, data[0] == _BAM)

    def _drop_dead(self, t_ns: int) -> None:
        for place, session in list(self.sessions.items()):
            if t_ns - session.last_ns > T2_NS:
                self.counters["transport: time-outs"] += 1
                del self.sessions[place]

    def packet(self, t_ns: int, key: int, data: bytes) -> None:
        """A TP.DT frame."""
        place = (key >> BUS_SHIFT, key & 0xFF, key >> 8 & 0xFF)
        session = self.sessions.get(place)
        if session is None or not data:
            self.counters["transport: packets without a session"] += 1
            return
        if t_ns - session.last_ns > (T1_NS if session.broadcast else T2_NS):
            self.counters["transport: time-outs"] += 1
            del self.sessions[place]
            return
        number = data[0] - 1
        if not 0 <= number < len(session.packets) or len(data) < 1 + self._bytes_of(session, number):
            self.counters["transport: malformed frames"] += 1
            del self.sessions[place]
            return
        if session.broadcast and number and session.packets[number - 1] is None:
            self.counters["transport: lost packets"] += 1
            del self.sessions[place]
            return
        session.packets[number] = data[1:8]
        session.last_ns = t_ns
        if number == len(session.packets) - 1 and None not in session.packets:
            del self.sessions[place]
            self.deliver(t_ns, session.key, b"".join(packet for packet in session.packets if packet is not None)[:session.size])

    @staticmethod
    def _bytes_of(session: Session, number: int) -> int:
        return min(7, session.size - 7 * number)


class TroubleCodeReport(NamedTuple):
    """One active trouble code of a DM1. occurrences: None when not available. old_form: conversion method bit set, the SPN may be
    in one of the orders used before 1996 (J1939-73 §5.7.1.11)."""

    spn: int
    fmi: int
    occurrences: int | None
    old_form: bool


LAMPS = ("protect", "amber", "red", "malfunction")
"""Lamps of a DM1, at bits 0, 2, 4, 6 of its first byte."""


FMI_WORDS = (
    "above the normal range, most severe", "below the normal range, most severe", "erratic or incorrect",
    "voltage high or shorted high", "voltage low or shorted low", "current low or circuit open",
    "current high or circuit grounded", "mechanical system not responding", "abnormal frequency or pulse width",
    "abnormal update rate", "abnormal rate of change", "root cause not known", "bad device", "out of calibration",
    "special instructions", "above the normal range, least severe", "above the normal range, moderate",
    "below the normal range, least severe", "below the normal range, moderate", "received data in error",
    "drifted high", "drifted low", "reserved", "reserved", "reserved", "reserved", "reserved", "reserved", "reserved",
    "reserved", "reserved", "condition exists",
)
"""What a failure mode identifier means (J1939-73 appendix A), by number."""


class Diagnosis(NamedTuple):
    """A DM1: lamps that are on, trouble codes that are active. Lamps of ISO 11783 senders (0xFF) count as off."""

    lamps: tuple[str, ...]
    codes: tuple[TroubleCodeReport, ...]


def parse_dm1(data: bytes) -> Diagnosis | None:
    """Read a DM1 (J1939-73 §5.7.1); None when it is too short. SPN 0 with FMI 0, and all ones, mean no code."""
    if len(data) < 6:
        return None
    lamps = tuple(lamp for place, lamp in enumerate(LAMPS) if data[0] >> 2 * place & 3 == 1)
    codes: dict[tuple[int, int], TroubleCodeReport] = {}
    for place in range(2, min(len(data) - 3, 2 + 4 * MAX_CODES), 4):
        low, middle, high, last = data[place:place + 4]
        spn, fmi = low | middle << 8 | high >> 5 << 16, high & 0x1F
        if (spn, fmi) in ((0, 0), (0x7FFFF, 0x1F)):
            continue
        count = last & 0x7F
        codes[spn, fmi] = TroubleCodeReport(spn, fmi, None if count == 0x7F else count, bool(last & 0x80))
    return Diagnosis(lamps, tuple(codes.values()))
