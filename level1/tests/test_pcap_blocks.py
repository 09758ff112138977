"""pcap and pcapng of SocketCAN interfaces: exact stamps, every kind of frame, damage told."""
from __future__ import annotations

import struct
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Frame
from level1.io import pcap_blocks
from level1.io.replay import Log, LogError

START_NS = 1_700_000_000 * 10**9


def packet(frame: Frame, fd: bool = False) -> bytes:
    """A frame as SocketCAN gives it to libpcap."""
    body = struct.pack(">LBBxx", frame.key & 0xFFFF_FFFF, len(frame.data), 4 * fd) + frame.data
    return body.ljust(72 if fd else 16, b"\0")


def pcap(frames: list[Frame], order: str = "<", unit_ns: int = 1000, link: int = 227) -> bytes:
    magic = 0xA1B2C3D4 if unit_ns == 1000 else 0xA1B23C4D
    out = struct.pack(order + "LHHlLLL", magic, 2, 4, 0, 0, 65535, link)
    for frame in frames:
        body = packet(frame, len(frame.data) > 8)
        out += struct.pack(order + "LLLL", frame.t_ns // 10**9, frame.t_ns % 10**9 // unit_ns, len(body), len(body)) + body
    return out


def block(order: str, kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    return struct.pack(order + "LL", kind, len(body) + 12) + body + struct.pack(order + "L", len(body) + 12)


def pcapng(frames: list[Frame], order: str = "<", resolution: int | None = None) -> bytes:
    """A section with the interfaces can0 and can1, and one that is no CAN bus."""
    out = block(order, 0x0A0D0D0A, struct.pack(order + "LHHq", 0x1A2B3C4D, 1, 0, -1))
    for link, name in ((1, "eth0"), (227, "can0"), (227, "can1")):
        options = struct.pack(order + "HH", 2, len(name)) + name.encode() + bytes(-len(name) % 4)
        if resolution is not None:
            options += struct.pack(order + "HHB3x", 9, 1, resolution)
        out += block(order, 1, struct.pack(order + "HHL", link, 0, 65535) + options + struct.pack(order + "HH", 0, 0))
    units = 10**6 if resolution is None else 2 ** (resolution & 0x7F) if resolution & 0x80 else 10**resolution
    for frame in frames:
        stamp, body = frame.t_ns * units // 10**9, packet(frame, len(frame.data) > 8)
        head = struct.pack(order + "LLLLL", 1 + frame.bus, stamp >> 32, stamp & 0xFFFF_FFFF, len(body), len(body))
        out += block(order, 6, head + body) + block(order, 5, bytes(12))
    return out


def frames_of(random: Random, count: int, buses: int) -> list[Frame]:
    made, t_ns = [], START_NS
    for _ in range(count):
        t_ns += random.choice([0, 1000, 250_000, -3000])
        key = random.choice([random.getrandbits(11), random.getrandbits(29) | EXTENDED, random.getrandbits(11) | REMOTE,
                             random.getrandbits(9) | ERROR])
        data = b"" if key & REMOTE else random.randbytes(8 if key & ERROR else random.choice([8, 8, 0, 5, 12, 64]))
        made.append(Frame(t_ns, key | (random.randrange(buses) << BUS_SHIFT), data))
    return made


def read(path: Path, content: bytes, rows: int = 1 << 18) -> tuple[Log, list[Frame]]:
    """In blocks; frame by frame it is the same. Buses by name, so that their order in the file does not matter."""
    path.write_bytes(content)
    buses = {"can0": 0, "can1": 1, "": 0}
    log, single = Log(path, buses), Log(path, buses)
    frames = [frame for one in log.blocks(rows) for frame in one.frames()]
    assert frames == list(single.frames())
    for what in ("frames_read", "error_frames", "remote_frames", "skipped", "complaints", "first_ns", "last_ns", "channels"):
        assert getattr(log, what) == getattr(single, what), what
    return log, frames


@given(st.integers(0, 2**64), st.integers(1, 100), st.sampled_from("<>"), st.sampled_from([1000, 1]),
       st.sampled_from([100, 1 << 20]), st.sampled_from([1, 40, 1 << 18]))
@settings(max_examples=60, deadline=None)
def test_pcap(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, order: str, unit_ns: int, batch: int,
              rows: int) -> None:
    made = frames_of(Random(seed), count, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pcap_blocks, "BATCH_BYTES", batch)
        log, frames = read(tmp_path_factory.mktemp("pcap") / "a.pcap", pcap(made, order, unit_ns), rows)
    assert frames == made and not log.skipped


@given(st.integers(0, 2**64), st.integers(1, 100), st.sampled_from("<>"), st.sampled_from([None, 6, 9, 0x80 | 30]),
       st.sampled_from([100, 1 << 20]))
@settings(max_examples=60, deadline=None)
def test_pcapng(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, order: str, resolution: int | None,
                batch: int) -> None:
    made = frames_of(Random(seed), count, 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pcap_blocks, "BATCH_BYTES", batch)
        log, frames = read(tmp_path_factory.mktemp("pcap") / "a.pcapng", pcapng(made, order, resolution))
    assert len(frames) == len(made) and not log.skipped
    for frame, wanted in zip(frames, made, strict=True):
        assert frame[1:] == wanted[1:] and 0 <= wanted.t_ns - frame.t_ns <= (1 if resolution == 0x80 | 30 else 0)


def test_nanoseconds_are_exact(tmp_path: Path) -> None:
    made = [Frame(START_NS + 123_456_789, 0x123, b"\1")]
    assert read(tmp_path / "a.pcap", pcap(made, unit_ns=1))[1][0].t_ns == made[0].t_ns
    assert read(tmp_path / "a.pcapng", pcapng(made, resolution=9))[1][0].t_ns == made[0].t_ns


def test_the_content_tells_not_the_name(tmp_path: Path) -> None:
    assert len(read(tmp_path / "capture", pcap([Frame(START_NS, 0x123, b"")]))[1]) == 1


def test_packets_that_are_no_can_frames_are_told(tmp_path: Path) -> None:
    made = [Frame(START_NS, 0x123, b"\1"), Frame(START_NS, 0x124, b"\2")]
    ethernet = block("<", 6, struct.pack("<LLLLL", 0, 0, 0, 4, 4) + b"ping")
    log, frames = read(tmp_path / "a.pcapng", pcapng(made[:1]) + ethernet + pcapng(made[1:]))
    assert frames == made and log.complaints == ["unreadable packet 2: no CAN frame"]
    cut = bytearray(pcap(made))
    cut[24 + 16 + 4] = 12
    log, frames = read(tmp_path / "a.pcap", bytes(cut))
    assert [frame.data for frame in frames] == [b"\2"]
    assert log.complaints == ["unreadable packet 1: 12 data bytes in a packet of 16"]


def test_a_capture_of_all_interfaces_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "any.pcap"
    path.write_bytes(pcap([Frame(START_NS, 0x123, b"")], link=113))
    with pytest.raises(LogError, match="captured from all interfaces at once; capture a CAN interface itself"):
        list(Log(path).blocks())


def test_a_capture_of_something_else_holds_no_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap([Frame(START_NS, 0x123, b"")], link=1))
    with pytest.raises(LogError, match="no CAN frame"):
        list(Log(path).frames())


@pytest.mark.parametrize("cut", [1, 20, 33])
def test_a_capture_that_ends_early_keeps_what_it_has(tmp_path: Path, cut: int) -> None:
    made = [Frame(START_NS + n, 0x123, bytes([n])) for n in range(10)]
    log, frames = read(tmp_path / "a.pcap", pcap(made, unit_ns=1)[:-cut])
    assert frames == made[:9 if cut < 32 else 8]
    assert log.complaints == ["the file ends in the middle or is damaged: a packet is cut"]


@given(st.integers(0, 2**64))
@settings(max_examples=100, deadline=None)
def test_no_damage_crashes_the_reader(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    random = Random(seed)
    made = frames_of(random, 30, 2)
    data = bytearray(pcap(made) if random.random() < 0.5 else pcapng(made))
    for _ in range(random.randint(1, 10)):
        place = random.randrange(4, len(data))
        data[place:place + 1] = random.randbytes(random.choice([0, 1, 1, 2]))
    path = tmp_path_factory.mktemp("pcap") / "a.pcap"
    path.write_bytes(data)
    try:
        list(Log(path).frames())
    except LogError as error:
        assert "\n" not in str(error)
