"""Frames read from a socket in batches, filters of the kernel, and what the live path must not load."""
from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1.catalog import Catalog
from level1.frame import ERROR, EXTENDED, REMOTE, Frame, frame_key
from level1.io.definitions import load
from level1.io.listening import group, listening
from level1.io.socketcan import BATCH, CLASSIC, FLEXIBLE, Batches, Filter, merged
from level1.io.stamps import PLAUSIBLE_AGE_NS
from level1.supervisor import Supervisor

MS = 1_000_000
STAMPING_TRIES = 50
"""The kernel begins to stamp in the background, some time after the first socket has asked for it (`net_enable_timestamp`); until
then a frame gets the time at which it is read."""


class Line:
    """A datagram socket that stands for a CAN socket, and the one who sends to it."""

    def __init__(self, frame_bytes: int = CLASSIC, buffer_bytes: int = 1 << 20):
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        self.sock.setblocking(False)
        self.sock.bind(("127.0.0.1", 0))
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sender.connect(self.sock.getsockname())
        self.wall_jump_ns = 0
        self.batches = Batches(self.sock, frame_bytes, time.monotonic_ns, lambda: time.time_ns() + self.wall_jump_ns)

    def receive(self, bus: int) -> list[Frame]:
        return [Frame(*row) for row in self.batches.receive(bus)]

    def send(self, can_id: int, data: bytes) -> None:
        self.sender.send(struct.pack("=IB3x8s" if len(data) <= 8 else "=IB3x64s", can_id, len(data), data))


@pytest.fixture
def lines() -> Iterator[list[Line]]:
    """Lines to be closed after the test."""
    made: list[Line] = []
    yield made
    for line in made:
        line.sock.close()
        line.sender.close()


def passes(filters: tuple[Filter, ...] | list[Filter], can_id: int) -> bool:
    """Whether the kernel lets an identifier with flags through."""
    return any(can_id & mask == value & mask for value, mask in filters)


class TestBatches:
    def test_frames_come_with_identifier_bus_data_and_the_time_of_their_coming(self, lines: list[Line]) -> None:
        lines.append(line := Line())
        for _ in range(STAMPING_TRIES):
            before_ns = time.monotonic_ns()
            line.send(0x123, b"\1\2")
            line.send(EXTENDED | 0x18FEF100, bytes(range(8)))
            after_ns = time.monotonic_ns()
            time.sleep(0.03)
            frames = line.receive(2)
            assert [(frame.key, frame.data) for frame in frames] == [
                (frame_key(0x123, False, 2), b"\1\2"), (frame_key(0x18FEF100, True, 2), bytes(range(8)))]
            assert line.batches.last_ns == frames[-1].t_ns
            if all(before_ns - MS <= frame.t_ns <= after_ns + 5 * MS for frame in frames):
                return
        pytest.fail("the time of reading, not the kernel's")

    def test_more_than_a_batch_comes_in_one_call_and_in_order(self, lines: list[Line]) -> None:
        lines.append(line := Line())
        for number in range(2 * BATCH + 7):
            line.send(0x100, struct.pack("<Q", number))
        frames = line.receive(0)
        assert [struct.unpack("<Q", frame.data)[0] for frame in frames] == list(range(2 * BATCH + 7))
        assert sorted(frame.t_ns for frame in frames) == [frame.t_ns for frame in frames]
        assert line.receive(0) == []

    def test_frames_of_can_fd_and_of_classic_can_share_a_socket(self, lines: list[Line]) -> None:
        lines.append(line := Line(FLEXIBLE))
        line.send(0x100, bytes(range(64)))
        line.send(0x101, b"\7")
        assert [frame.data for frame in line.receive(0)] == [bytes(range(64)), b"\7"]

    def test_frames_dropped_by_the_kernel_are_counted(self, lines: list[Line]) -> None:
        lines.append(line := Line(buffer_bytes=4096))
        for _ in range(200):
            line.send(0x100, b"\1")
        kept = len(line.receive(0))
        line.send(0x100, b"\2")
        assert len(line.receive(0)) == 1
        assert kept < 200 and line.batches.lost == 200 - kept

    def test_after_a_jump_of_the_wall_clock_frames_count_from_when_they_are_read(self, lines: list[Line]) -> None:
        lines.append(line := Line())
        line.send(0x100, b"")
        line.receive(0)
        line.wall_jump_ns = 700 * MS
        line.send(0x100, b"")
        time.sleep(0.02)
        now_ns = time.monotonic_ns()
        assert now_ns <= line.receive(0)[0].t_ns

    def test_a_socket_that_fails_says_so(self, lines: list[Line]) -> None:
        lines.append(line := Line())
        line.sock.close()
        with pytest.raises(OSError, match="descriptor"):
            line.receive(0)


class TestFilters:
    @given(st.sets(st.integers(0, 0x7FF), max_size=300))
    def test_merged_filters_pass_exactly_what_is_asked_for(self, wanted: set[int]) -> None:
        filters = merged(wanted)
        assert {can_id for can_id in range(0x800) if passes(filters, can_id)} == wanted
        assert not any(passes(filters, can_id | flag) for can_id in list(wanted)[:5] for flag in (EXTENDED, REMOTE))

    def test_a_group_passes_any_destination_or_source(self) -> None:
        request = [group(0xEA00)]
        assert passes(request, EXTENDED | 0x18EA80F9) and passes(request, EXTENDED | 0x0CEAFF00)
        assert not passes(request, EXTENDED | 0x18EB80F9) and not passes(request, 0x6A0)
        engine = [group(0xF004, 0x00)]
        assert passes(engine, EXTENDED | 0x0CF00400)
        assert not passes(engine, EXTENDED | 0x0CF00401) and not passes(engine, EXTENDED | 0x0CF00500)


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    """Two buses: the tractor's and the flaming tool's."""
    return load((), {0: ["ucs.dbc", "isobus_tractor.dbc"], 1: ["flaming_tool.dbc"]}, ("tractor", "implement"))


class TestListening:
    def test_what_conditions_and_protocols_ask_for_passes_and_nothing_else(self, catalog: Catalog) -> None:
        supervisor = Supervisor(catalog, unit="a", j1939={0: 0x80})
        tractor = listening(supervisor, 0, 0x80, everything=False).filters
        assert tractor is not None and len(tractor) < 512
        asked = (EXTENDED | 0x0CF00400, EXTENDED | 0x18FECA00, EXTENDED | 0x18EBFF03, EXTENDED | 0x1CECFF03, EXTENDED | 0x18EEFF26)
        assert all(passes(tractor, can_id) for can_id in asked), "engine, trouble codes, transport, address claims"
        assert passes(tractor, EXTENDED | 0x18ABCD80), "whatever comes from the address of the UCS"
        assert passes(tractor, 0x701) and passes(tractor, 0x081), "heartbeats and emergencies of CANopen"
        assert not passes(tractor, EXTENDED | 0x18FF1234) and not passes(tractor, 0x210)
        assert not any(passes(tractor, ERROR | classes) for classes in (0x40, 0x4))

    def test_each_bus_passes_its_own_messages_and_those_only_the_ucs_may_send(self, catalog: Catalog) -> None:
        tool = listening(Supervisor(catalog, unit="a"), 1, None, everything=False).filters
        assert tool is not None
        assert passes(tool, 0x210) and passes(tool, 0x650) and not passes(tool, EXTENDED | 0x0CF00400)

    def test_a_recorder_hears_everything(self, catalog: Catalog) -> None:
        assert listening(Supervisor(catalog, unit="a"), 0, None, everything=True).filters is None

    def test_the_nominal_cycle_is_that_of_the_definition(self, catalog: Catalog) -> None:
        heard = listening(Supervisor(catalog, unit="a"), 0, None, everything=False)
        engine = catalog.messages["EEC1"]
        assert engine.cycle_ns and heard.cycle_of(EXTENDED | 0x0CF00400) == engine.cycle_ns
        assert heard.cycle_of(0x123) is None


def test_the_live_path_loads_nothing_that_it_does_not_use() -> None:
    program = ("import sys, ucs.run\n"
               "print(*{name.partition('.')[0] for name in sys.modules} & "
               "{'can', 'cantools', 'canopen', 'lark', 'numpy', 'paho', 'serial', 'pynmeagps', 'cryptography', 'asyncio'})")
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert loaded == []


def test_a_frame_may_wait_as_long_as_the_kernels_buffer_lasts() -> None:
    assert PLAUSIBLE_AGE_NS >= 2_000_000_000, "two seconds of a full bus fit into it"
