"""BLF in blocks: what python-can's reader reads, and more of what is damaged."""
from __future__ import annotations

import struct
import zlib
from pathlib import Path
from random import Random
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Frame
from level1.io import blf_blocks
from level1.io.message import from_message
from level1.io.replay import Log
from level1.io.text_format import stamp_ns

DATA = Path(__file__).parents[2].parent / "shared" / "data"
START_S = 1_700_000_000


def reference(path: Path) -> list[Frame]:
    """What python-can's reader reads, stamps rounded to the microsecond, channels in the order of appearance."""
    frames, buses = [], dict[Any, int]()
    for message in can.BLFReader(path):
        key, data = from_message(message)
        bus = buses.setdefault(message.channel, len(buses))
        frames.append(Frame(stamp_ns(message.timestamp), key | bus << BUS_SHIFT, data))
    return frames


def messages(random: Random, count: int) -> list[can.Message]:
    """Messages of all kinds, stamps on whole microseconds."""
    made, t_us = [], START_S * 10**6
    for _ in range(count):
        t_us += random.choice([0, 1, 250, 10_000, -3])
        extended = random.random() < 0.5
        can_id = random.getrandbits(29 if extended else 11)
        kind = random.choice(["classic", "classic", "classic", "fd", "remote", "error"])
        size = random.choice([8, 8, 8, random.randrange(9)])
        if kind == "fd":
            size = random.choice([0, 5, 8, 12, 16, 20, 24, 32, 48, 64])
        made.append(can.Message(
            timestamp=t_us / 1e6, arbitration_id=can_id, is_extended_id=extended, is_fd=kind == "fd", channel=random.randrange(3),
            is_remote_frame=kind == "remote", is_error_frame=kind == "error", bitrate_switch=kind == "fd",
            data=None if kind == "remote" else random.choice([random.randbytes(size), b"LOBJLOBJ"[:size].ljust(size, b"\0")])))
    return made


def written(path: Path, made: list[can.Message], **options: Any) -> Path:
    """A file of python-can's writer."""
    writer = can.BLFWriter(path, **options)
    for message in made:
        writer.on_message_received(message)
    writer.stop()
    return path


def read(path: Path, rows: int = 1 << 18) -> tuple[Log, list[Frame]]:
    """In blocks; frame by frame it is the same."""
    log, single = Log(path), Log(path)
    frames = [frame for block in log.blocks(rows) for frame in block.frames()]
    assert frames == list(single.frames())
    for what in ("frames_read", "error_frames", "remote_frames", "skipped", "complaints", "first_ns", "last_ns", "channels"):
        assert getattr(log, what) == getattr(single, what), what
    return log, frames


@given(st.integers(0, 2**64), st.integers(1, 300), st.sampled_from([60, 1000, 1 << 17]), st.sampled_from([0, 1, 6]),
       st.sampled_from([100, 1 << 19]), st.sampled_from([1, 70, 1 << 18]))
@settings(max_examples=100, deadline=None)
def test_blocks_hold_what_python_can_reads(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, container: int,
                                           level: int, batch: int, rows: int) -> None:
    path = written(tmp_path_factory.mktemp("blf") / "a.blf", messages(Random(seed), count), max_container_size=container,
                   compression_level=level)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blf_blocks, "BATCH_BYTES", batch)
        log, frames = read(path, rows)
    assert frames == reference(path)
    assert not log.skipped
    assert log.error_frames == sum(bool(frame.key & ERROR) for frame in frames)
    assert log.remote_frames == sum(bool(frame.key & REMOTE) for frame in frames)


@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not on this machine")
@pytest.mark.parametrize("path", sorted(DATA.glob("python-can-formats/*.blf")), ids=lambda path: path.name)
def test_recordings(path: Path) -> None:
    assert read(path)[1] == reference(path)


# --- by hand: what python-can does not write --------------------------------------------------------------------------------


def blf(*objects: bytes, start: tuple[int, ...] = (2023, 11, 2, 14, 22, 13, 20, 0)) -> bytes:
    """A file of one container."""
    return header(start) + container(b"".join(objects))


def header(start: tuple[int, ...]) -> bytes:
    head = struct.pack("<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1, 0, 0, 0, 0, *start, *start)
    return head.ljust(144, b"\0")


def container(data: bytes, method: int = 2) -> bytes:
    body = struct.pack("<H6xL4x", method, len(data)) + (zlib.compress(data) if method == 2 else data)
    return struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(body), 10) + body + bytes(len(body) % 4)


def thing(kind: int, body: bytes, t_ns: int = 0, flags: int = 2, version: int = 1) -> bytes:
    """An object."""
    head = struct.pack("<LHHQ", flags, 0, 0, t_ns) if version == 1 else struct.pack("<LBxHQ8x", flags, 0, 0, t_ns)
    size = 16 + len(head) + len(body)
    return struct.pack("<4sHHLL", b"LOBJ", 16 + len(head), version, size, kind) + head + body


def classic(can_id: int, data: bytes, channel: int = 1, flags: int = 0) -> bytes:
    return struct.pack("<HBBL8s", channel, flags, len(data), can_id, data)


def fd_64(can_id: int, data: bytes, valid: int | None = None, flags: int = 0x1000, further: int = 0) -> bytes:
    return struct.pack("<BBBBLLLLLLLHBBL", 2, 15, len(data) if valid is None else valid, 0, can_id, 0, flags, 0, 0, 0, 0, 0, 0,
                       further, 0) + data


def test_other_objects_and_unknown_headers_are_passed_over(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    file.write_bytes(blf(thing(65, b"text"), thing(86, classic(0x123, b"\1\2") + bytes(8), 1000),
                         thing(1, classic(0x124, b""), 2000, 2, 3), thing(1, classic(0x125, b"\3"), 3000, 2, 2)))
    assert read(file)[1] == reference(file) == [
        Frame(START_S * 10**9 + 1000, 0x123, b"\1\2"), Frame(START_S * 10**9 + 3000, 0x125, b"\3")]


def test_coarse_stamps_count_ten_microseconds(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    file.write_bytes(blf(*(thing(1, classic(0x123, b""), stamp, flags)
                           for stamp, flags in ((7, 1), (7, 0), (1501, 2), (2500, 2), (3500, 2)))))
    assert [frame.t_ns - START_S * 10**9 for frame in read(file)[1]] == [70_000, 0, 2000, 2000, 4000]


def test_a_file_without_a_date_counts_from_its_start(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    file.write_bytes(blf(thing(1, classic(0x123, b""), 5000), start=(0,) * 8))
    log, frames = read(file)
    assert frames[0].t_ns == 5000 and not log.is_utc


def test_fd_frames_of_the_newer_kind(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    file.write_bytes(blf(
        thing(101, fd_64(0x18FEF100 | EXTENDED, bytes(range(24)))), thing(101, fd_64(0x123, bytes(range(12)), 32)),
        thing(101, fd_64(0x124, b"\1\2", flags=0)), thing(101, fd_64(0x125, b"", flags=0x1010)),
        thing(101, fd_64(0x126, bytes(range(20)), 20, further=32 + 40 + 16))))
    frames = read(file)[1]
    assert frames == reference(file)
    assert [len(frame.data) for frame in frames] == [24, 32, 2, 0, 20]
    assert frames[4].data == bytes(range(16)) + bytes(4)


def test_frames_that_can_be_none_are_told(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    file.write_bytes(blf(thing(1, classic(0x123, b"\1")), thing(101, fd_64(0x124, bytes(12), flags=0)),
                         thing(1, classic(0x123, b""), 1 << 63), thing(1, classic(0x123, b"\2"))))
    log, frames = read(file)
    assert [frame.data for frame in frames] == [b"\1", b"\2"]
    assert log.complaints == ["unreadable frame 2: 12 data bytes; a frame of this kind has at most 8",
                              "unreadable frame 3: time stamp 10923372036.854776 out of range"]


def test_a_damaged_container_costs_only_itself(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    whole = [thing(1, classic(0x100 + n, bytes([n])), n * 1000) for n in range(9)]
    good, cut = container(b"".join(whole[:3])), container(b"".join(whole[3:6]))
    broken = bytearray(cut)
    broken[40:44] = b"\xff" * 4
    unknown = bytearray(container(whole[6], 0))
    unknown[16] = 9
    file.write_bytes(header((2023, 11, 2, 14, 22, 13, 20, 0)) + good + broken + unknown + container(whole[7]) + b"garbage!" * 9
                     + container(whole[8]))
    log, frames = read(file)
    assert [frame.can_id - 0x100 for frame in frames] == [0, 1, 2, 7, 8]
    assert log.skipped == 3 and "damaged container" in log.complaints[0] and "unknown way (9)" in log.complaints[1]


@pytest.mark.parametrize("cut", [60, 100, 500])
def test_a_file_that_ends_early_keeps_what_it_has(tmp_path: Path, cut: int) -> None:
    random = Random(5)
    path = written(tmp_path / "a.blf", messages(random, 400), max_container_size=2000)
    everything = reference(path)
    path.write_bytes(path.read_bytes()[:-cut])
    log, frames = read(path)
    assert frames == everything[:len(frames)] and 300 < len(frames) < 400
    assert log.complaints == ["the file ends in the middle or is damaged: an object is cut"]


@given(st.integers(0, 2**64))
@settings(max_examples=100, deadline=None)
def test_no_damage_crashes_the_reader(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    random = Random(seed)
    path = written(tmp_path_factory.mktemp("blf") / "a.blf", messages(random, 60), max_container_size=random.choice([100, 2000]),
                   compression_level=random.choice([0, 6]))
    data = bytearray(path.read_bytes())
    for _ in range(random.randint(1, 20)):
        place = random.randrange(144, len(data))
        data[place:place + random.choice([1, 1, 4])] = random.randbytes(random.choice([0, 1, 1, 4]))
    path.write_bytes(data)
    try:
        read(path)
    except Exception as error:
        assert type(error).__name__ == "LogError", error
