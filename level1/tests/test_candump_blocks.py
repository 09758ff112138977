"""candump text in blocks: the frames, counts and complaints of the scalar reader, whatever the text."""
from __future__ import annotations

import gzip
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.frame import Frame
from level1.io import candump_blocks, line_blocks, rows
from level1.io.replay import Log, LogError

DATA = Path(__file__).parents[2].parent / "shared" / "data"
STAMPS = (
    "(1700000000.004100)", "(1700000099.999999)", "(0000000000.352000)", "(12.5)", "(7.123456789)", "(2023-11-14 22:13:20.004100)",
    "(1700000000.12345678)", "(99999999999999.000001)", "(1.1234567890)", "(-1.0)", "(x.y)", "")
BODIES = (
    "0CF00400#F0FFA1161CFFFFFF", "123#", "123#11", "7FF#112233", "0CF00400#f0ffa1161cffffff", "123#R", "123#R8", "123##3112233",
    "18FEF1FE#11 R", "123#11 T", "123##1" + "5A" * 64, "1ABCDEF0##0" + "0f" * 12, "20000080#0000000000000000",
    "123#1122334455667788_F", "123#112", "123#GG", "F0040#00", "FFF#00", "FFFFFFFF#00", "123#112233445566778899", "123##",
    "123##1" + "00" * 65, "not a frame")
SCREENS = (
    "0CF00400   [8]  F0 FF A1 16 1C FF FF FF", "123   [3]  11 22 33", "123   [2]  11 22   '.\"'", "RX - -  123   [2]  11 22",
    "TX B E  123  [12]  11 22 33 44 55 66 77 88 99 AA BB CC", "123  [08]  11 22 33 44 55 66 77 88", "123   [0]  remote request",
    "123   [0]", "20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME", "123   [3]  11 22", "123   [2]  1122",
    "123   [2]  11  22", "123  [64]  " + "5A " * 63 + "A5", "7E8   [8]  01 02 03 04 05 06 07 08   'a b 'c'")
GOOD = b"(1.000000) can0 123#11\n"


def both(tmp_path: Path, text: bytes, name: str = "a.log", rows: int = 1 << 17) -> tuple[Log, list[Frame]]:
    """The text read in blocks and frame by frame; gives what came out, which is the same."""
    file = tmp_path / name
    file.write_bytes(text)
    single, blocks = Log(file), Log(file)
    try:
        wanted = list(single.frames())
    except LogError as error:
        with pytest.raises(LogError) as other:
            list(blocks.blocks(rows))
        assert str(other.value) == str(error)
        wanted = []
    else:
        assert [frame for block in blocks.blocks(rows) for frame in block.frames()] == wanted
    for what in ("frames_read", "error_frames", "remote_frames", "skipped", "complaints", "first_ns", "last_ns", "channels",
                 "channels_seen"):
        assert getattr(blocks, what) == getattr(single, what), what
    return blocks, wanted


def lines_of(random: Random, count: int) -> list[str]:
    """Lines as a recording has them: runs of a few kinds, digits that move on, damage here and there."""
    kinds = [(random.choice(STAMPS), random.choice(["can0", "can1", "vcan12", "x", "slcan0"]),
              *random.choice([(BODIES, " "), (SCREENS, "  ")])) for _ in range(random.randint(1, 3))]
    lines = []
    for _ in range(count):
        stamp, channel, bodies, gap = random.choice(kinds)
        line = f"{stamp}{gap}{channel}{gap}{random.choice(bodies[:random.choice([2, 5, len(bodies)])])}"
        changed = "".join(random.choice("0123456789" if random.random() < 0.8 else "ABCDEFabcdef") if character.isdigit() and
                          random.random() < 0.3 else character for character in line)
        if random.random() < 0.05:
            place = random.randrange(len(changed) + 1)
            changed = changed[:place] + random.choice(["", " ", "g", "#", "(", ".", "é", "\\0"]) + changed[place + 1:]
        lines.append(changed + random.choice(["\n"] * 20 + ["\r\n", " \n", "\n\n", "\n# told\n"]))
    return lines


@given(st.integers(0, 2**64), st.integers(1, 300), st.sampled_from([1, 50, 1 << 17]))
@settings(max_examples=150, deadline=None)
def test_blocks_hold_what_the_scalar_reader_reads(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int,
                                                  rows: int) -> None:
    text = GOOD + "".join(lines_of(Random(seed), count)).encode()
    both(tmp_path_factory.mktemp("log"), text[:len(text) - seed % 7], rows=rows)


@given(st.lists(st.binary(max_size=80), max_size=30))
@settings(max_examples=100, deadline=None)
def test_no_bytes_crash_the_reader(tmp_path_factory: pytest.TempPathFactory, lines: list[bytes]) -> None:
    both(tmp_path_factory.mktemp("log"), GOOD + b"\n".join(lines))


@pytest.mark.parametrize("stamp", STAMPS)
@pytest.mark.parametrize("body", [f" can0 {body}" for body in BODIES] + [f"  can0  {body}" for body in SCREENS])
def test_every_kind_of_line(tmp_path: Path, stamp: str, body: str) -> None:
    both(tmp_path, GOOD + f"{stamp}{body}\n".encode() * 20)


def test_lines_of_one_kind_are_read_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scalar reader is asked to learn the kinds, and never for a line."""
    asked: list[bytes] = []
    learn = candump_blocks.learn

    def noted(line: bytes) -> line_blocks.Shape | None:
        asked.append(line)
        return learn(line)

    monkeypatch.setattr(candump_blocks, "learn", noted)
    lines = [f"({1_700_000_000 + n // 100}.{n % 100:02d}4100) can{n % 2} {0x18F00400 + n % 7:08X}#{n:016X}\n" for n in range(5000)]
    monkeypatch.setattr(candump_blocks.CandumpBlocks, "_read_singly", lambda *_: pytest.fail("read singly"))
    file = tmp_path / "a.log"
    file.write_text("".join(lines))
    assert sum(map(len, Log(file).blocks())) == 5000 and len(asked) == 2


def test_blocks_are_of_the_size_asked_for_or_a_chunk_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_blocks, "CHUNK_BYTES", 1000)
    file = tmp_path / "a.log"
    file.write_text("".join(f"({n}.000000) can0 123#{n:04X}\n" for n in range(1000, 3000)))
    sizes = [len(block) for block in Log(file).blocks(100)]
    assert sum(sizes) == 2000 and all(100 <= size < 140 for size in sizes[:-1])


def test_random_identifiers_end_a_block_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_blocks, "CHUNK_BYTES", 4000)
    monkeypatch.setattr(rows, "MOST_TALKERS", 100)
    text = "".join(f"(1.{n:06d}) can0 {n * 7919:08X}#11\n" for n in range(3000))
    log, frames = both(tmp_path, text.encode())
    assert len(frames) == 3000
    assert all(len(block.keys) < 300 for block in Log(log.path).blocks())


@pytest.mark.parametrize("cut", [0, 100, 5000])
def test_a_packed_recording_that_ends_early(tmp_path: Path, cut: int) -> None:
    random = Random(cut)
    packed = gzip.compress("".join(f"(1.{n:06d}) can0 123#{random.randrange(1 << 64):016X}\n" for n in range(3000)).encode())
    log, frames = both(tmp_path, packed[:len(packed) - cut], "a.log.gz")
    assert (len(frames) == 3000) == (cut == 0) and log.skipped == (cut > 0)


def test_a_line_longer_than_the_buffer_is_one_unreadable_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_blocks, "CHUNK_BYTES", 1000)
    log, frames = both(tmp_path, GOOD + b"x" * 5000 + b"\n" + GOOD + b"#" * 3000 + b"\n" + GOOD + b"y" * 1500)
    assert len(frames) == 3 and log.skipped == 2


@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not on this machine")
@pytest.mark.parametrize("path", sorted([*DATA.glob("jd5055e-tractor/*.log"), *DATA.glob("canboat-nmea2000/candump*[t3].txt")]),
                         ids=lambda path: path.name)
def test_recordings(tmp_path: Path, path: Path) -> None:
    both(tmp_path, path.read_bytes())
