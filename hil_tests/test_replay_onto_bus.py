"""`ucs replay --onto` on real SocketCAN: each frame at its time, no drift, as canplayer does it; and a bus that is missing."""
from __future__ import annotations

import signal
import socket
import statistics
import struct
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from hil_tests.conftest import START_S, Process

pytestmark = pytest.mark.vcan

MARGIN_S = 0.05
"""How long a program may take to start in a guest without CPU of its own, and how late a frame may be there."""
FRAMES, PERIOD_S = 500, 0.01
SO_TIMESTAMPNS = 35


class Heard(NamedTuple):
    """A frame on the bus. t_s: when the kernel got it."""

    t_s: float
    can_id: int


class Ear:
    """Everything on an interface, with the kernel's time stamps."""

    def __init__(self, interface: str):
        self.frames: list[Heard] = []
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.bind((interface,))
        self._socket.settimeout(0.2)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def _read(self) -> None:
        while not self._stopping.is_set():
            try:
                data, ancillary, _, _ = self._socket.recvmsg(16, 64)
            except TimeoutError:
                continue
            seconds, nanoseconds = struct.unpack("qq", ancillary[0][2])
            self.frames.append(Heard(seconds + nanoseconds / 1e9, struct.unpack("=I", data[:4])[0]))


@pytest.fixture
def ear() -> Iterator[Ear]:
    """Listens on vcan0."""
    one = Ear("vcan0")
    yield one
    one.close()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """5 s with a frame every 10 ms, every tenth one together with its follower, and an error frame in between."""
    file = tmp_path / "drive.log"
    lines = []
    for n in range(FRAMES):
        t_us = round((n - 1 if n % 10 == 9 else n) * PERIOD_S * 1e6)
        lines.append(f"({1_700_000_000 + t_us // 1_000_000}.{t_us % 1_000_000:06d}) vcan0 {0x100 + n:03X}#{n % 256:02X}\n")
    lines.insert(100, lines[99].split(" ")[0] + " vcan0 20000004#0000000000000000\n")
    file.write_text("".join(lines))
    return file


def errors_s(heard: list[Heard]) -> list[float]:
    """How far each frame is off the schedule of the log; the least is taken as on time."""
    expected = [(n - 1 if n % 10 == 9 else n) * PERIOD_S for n in range(FRAMES)]
    off = [frame.t_s - due for frame, due in zip(heard, expected, strict=True)]
    return [each - min(off) for each in off]


def told(name: str, off: list[float]) -> str:
    first, last = statistics.median(off[:50]), statistics.median(off[-50:])
    return (f"{name}: median {statistics.median(off) * 1e3:.2f} ms, 99 % {sorted(off)[-len(off) // 100] * 1e3:.2f} ms, worst "
            f"{max(off) * 1e3:.2f} ms off the schedule; drift {(last - first) * 1e3:+.2f} ms")


def test_each_frame_goes_out_at_its_time_as_canplayer_does_it(
        process: Callable[..., Process], ear: Ear, log: Path, record_property: Callable[[str, object], None]) -> None:
    play = process("replay", log, "--speed", "1", "--bus", "vcan0")
    assert play.wait(START_S) == 0
    ours = list(ear.frames)
    assert [frame.can_id for frame in ours] == [0x100 + n for n in range(FRAMES)], "all, in order, without the error frame"
    assert play.out[-1].startswith(f"played {FRAMES} frames in ")
    clean = log.with_suffix(".clean")
    clean.write_text("".join(line for line in log.read_text().splitlines(True) if "#0000000000000000" not in line))
    reference = process("-I", clean, program=("canplayer",), name="canplayer")
    assert reference.wait(START_S) == 0
    theirs = ear.frames[FRAMES:]
    figures = [told("ucs replay", errors_s(ours)), told("canplayer", errors_s(theirs))]
    record_property("timing", figures)
    print(*figures, sep="\n")
    assert statistics.median(errors_s(ours)) < MARGIN_S
    span = ours[-1].t_s - ours[0].t_s
    assert span == pytest.approx((FRAMES - 2) * PERIOD_S, abs=MARGIN_S)
    assert sum(b.t_s - a.t_s < MARGIN_S for a, b in pairwise(ours)) > 0.98 * FRAMES


def test_ctrl_c_ends_with_what_was_played(process: Callable[..., Process], ear: Ear, log: Path) -> None:
    play = process("replay", log, "--speed", "0.1", "--onto", "vcan0")
    for _ in range(int(START_S / 0.1)):
        if ear.frames:
            break
        threading.Event().wait(0.1)
    assert play.stop(signal.SIGINT) == 130
    assert play.out[-1].startswith("played ") and play.err == ["ucs: stopped by Ctrl-C"]


def test_a_missing_interface_and_one_that_is_down_are_one_line(
        process: Callable[..., Process], log: Path, set_link: Callable[[str, bool], None]) -> None:
    missing = process("replay", log, "--onto", "vcan7")
    assert missing.wait(START_S) == 2
    assert missing.err == ["ucs: bus vcan7: there is no interface vcan7; create it: ip link add vcan7 type vcan && "
                           "ip link set vcan7 up"]
    set_link("vcan0", False)
    down = process("replay", log, "--onto", "vcan0")
    assert down.wait(START_S) == 2
    assert down.err == ["ucs: bus vcan0: the interface vcan0 is down; bring it up: ip link set vcan0 up"]
