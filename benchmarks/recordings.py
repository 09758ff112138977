"""The workload as files, in each format that `ucs replay` reads; and candump text of any length, as fast as a disk takes it.

ASC and BLF are written by python-can, MF4 by asammdf as python-can drives it (`mf4`), the rest here: python-can writes no CAN FD
into TRC, and no pcap.
"""
from __future__ import annotations

import gzip
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np

from benchmarks.workload import EPOCH_NS, Workload
from level1.frame import Frame

STAMP_DIGITS = 10
"""Of the seconds in a line of candump text, from 2001 to 2286."""
DAY_NS = 86_400 * 10**9
TRC_EPOCH_DAYS = 25_569
"""From 30 December 1899 to 1970."""
FD_SIZES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def message_of(frame: Frame) -> can.Message:
    """A frame as python-can holds it."""
    return can.Message(timestamp=frame.t_ns / 1e9, arbitration_id=frame.can_id, is_extended_id=frame.extended, data=frame.data,
                       is_fd=len(frame.data) > 8, channel=0)


def write_candump(load: Workload, path: Path) -> None:
    """As `candump -L` writes it."""
    path.write_text("".join(load.candump()))


def write_gzip(load: Workload, path: Path) -> None:
    """The same, packed."""
    with gzip.open(path, "wt", compresslevel=6) as file:
        file.writelines(load.candump())


def write_by_python_can(load: Workload, path: Path) -> None:
    """ASC and BLF."""
    with can.Logger(path) as writer:
        for frame in load.frames():
            writer(message_of(frame))


def write_trc(load: Workload, path: Path) -> None:
    """TRC 2.1 of PEAK's tools, with microseconds."""
    def name(frame: Frame) -> str:
        return f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:04X}"

    with path.open("w", newline="\r\n") as file:
        file.write(f";$FILEVERSION=2.1\n;$STARTTIME={EPOCH_NS / DAY_NS + TRC_EPOCH_DAYS}\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n;\n")
        for number, frame in enumerate(load.frames(), 1):
            size = len(frame.data)
            ms, us = divmod((frame.t_ns - EPOCH_NS) // 1000, 1000)
            file.write(f"{number:>7} {ms:>9}.{us:03} {'FD' if size > 8 else 'DT'}  1 {name(frame):>8}"
                       f" Rx -  {FD_SIZES.index(size):<4} {frame.data.hex(' ').upper()}\n")


def write_pcap(load: Workload, path: Path) -> None:
    """As `tcpdump -i can0 --time-stamp-precision=nano -w` writes it."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 72, 227))
        for frame in load.frames():
            size, room = len(frame.data), 64 if len(frame.data) > 8 else 8
            seconds, ns = divmod(frame.t_ns, 10**9)
            file.write(struct.pack("<4I", seconds, ns, 8 + room, 8 + room)
                       + struct.pack(">IBB2x", frame.key, size, 4 if room == 64 else 0) + frame.data.ljust(room, b"\0"))


WRITERS: dict[str, tuple[str, Callable[[Workload, Path], None]]] = {
    "candump": (".log", write_candump), "candump, gzip": (".log.gz", write_gzip), "ASC": (".asc", write_by_python_can),
    "BLF": (".blf", write_by_python_can), "TRC": (".trc", write_trc), "pcap": (".pcap", write_pcap)}
"""Of each format the end of its file's name, and what writes it."""


def read_pcap(path: str) -> Iterator[can.Message]:
    """Frames of a capture, for the peer: python-can has no reader for it."""
    with open(path, "rb") as file:
        file.read(24)
        while head := file.read(16):
            seconds, ns, size, _ = struct.unpack("<4I", head)
            packet = file.read(size)
            key, length, flags = struct.unpack_from(">IBB", packet)
            yield can.Message(timestamp=seconds + ns / 1e9, arbitration_id=key & 0x1FFF_FFFF, is_extended_id=bool(key >> 31),
                              data=packet[8:8 + length], is_fd=bool(flags & 4))


class Endless:
    """A recording played again and again, each time later by whole seconds."""

    def __init__(self, load: Workload):
        """load: what is played."""
        text = "".join(load.candump()).encode()
        self._text = np.frombuffer(text, np.uint8).copy()
        newlines = np.flatnonzero(self._text == ord("\n"))
        self._begins = np.concatenate(([0], newlines[:-1] + 1)) + 1  # behind the bracket
        self._seconds = (EPOCH_NS // 1000 + load.t_us) // 10**6
        self.frames = len(load)
        self.period_s = int(load.seconds) + 2

    def write(self, path: Path, frames: int) -> int:
        """candump text of so many frames or a few more; gives how often the recording was played."""
        rounds = -(-frames // self.frames)
        with path.open("wb") as file:
            for number in range(rounds):
                self._move_to(number)
                file.write(self._text.data)
        return rounds

    def _move_to(self, number: int) -> None:
        """Write the seconds of a round into the text."""
        rest: Any = self._seconds + number * self.period_s
        for place in reversed(range(STAMP_DIGITS)):
            rest, digit = np.divmod(rest, 10)
            self._text[self._begins + place] = digit + ord("0")
