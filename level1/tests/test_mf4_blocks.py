"""MF4 in blocks: every layout gives the frames that were written, real loggers' files what asammdf reads of them."""
from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Frame
from level1.io import mf4, mf4_blocks
from level1.io.replay import Log, LogError
from level1.tests import mf4_file
from level1.tests.mf4_file import START_NS, Record

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "css-canedge-mf4"


def records(random: Random, count: int) -> list[Record]:
    """Frames of all kinds; stamps that stand still or run backwards a little."""
    made, t_us = [], 0
    for _ in range(count):
        t_us = max(0, t_us + random.choice([0, 1, 20, 10_000, -2]))
        kind = random.choice([mf4_file.DATA] * 6 + [mf4_file.ERRORS, mf4_file.REMOTE])
        fd, extended = kind == mf4_file.DATA and random.random() < 0.3, random.random() < 0.5
        size = random.choice([12, 16, 24, 64, 5]) if fd else random.choice([8, 8, 0, 3])
        made.append(Record(kind, t_us, random.randrange(3), random.getrandbits(29 if extended else 11), extended, fd,
                           b"" if kind == mf4_file.REMOTE else random.randbytes(size)))
    return made


def frames_of(made: list[Record], mixed: bool) -> list[Frame]:
    """The frames as they come, kind by kind in its own order, merged by the highest time so far."""
    highest: dict[str, int] = {}
    order = []
    for place, record in enumerate(made):
        highest[record.kind] = max(highest.get(record.kind, 0), record.t_us)
        kind = (mf4_file.DATA, mf4_file.ERRORS, mf4_file.REMOTE).index(record.kind)
        order.append((highest[record.kind], kind, place))
    buses: dict[int, int] = {}
    frames = []
    for _, _, place in sorted(order):
        record = made[place]
        flags = {mf4_file.ERRORS: ERROR, mf4_file.REMOTE: REMOTE}.get(record.kind, 0)
        extended = EXTENDED if (record.extended or record.can_id > 0x7FF) and not flags & ERROR else 0
        bus = buses.setdefault(record.channel, len(buses))
        frames.append(Frame(START_NS + record.t_us * 1000, record.can_id | extended | flags | bus << BUS_SHIFT, record.data))
    return frames


def read(path: Path, rows: int = 1 << 18) -> tuple[Log, list[Frame]]:
    """In blocks; frame by frame it is the same."""
    log, single = Log(path), Log(path)
    frames = [frame for block in log.blocks(rows) for frame in block.frames()]
    assert frames == list(single.frames())
    for what in ("frames_read", "error_frames", "remote_frames", "skipped", "complaints", "first_ns", "last_ns", "channels"):
        assert getattr(log, what) == getattr(single, what), what
    return log, frames


@given(st.integers(0, 2**64), st.integers(1, 200), st.booleans(), st.booleans(), st.booleans(), st.booleans(),
       st.sampled_from(["plain", "packed", "transposed", "list"]), st.sampled_from([300, 1 << 20]),
       st.sampled_from([1, 40, 1 << 18]))
@settings(max_examples=200, deadline=None)
def test_every_layout(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, mixed: bool, variable: bool, by_table: bool,
                      finished: bool, layout: str, batch: int, rows: int) -> None:
    made = records(Random(seed), count)
    path = tmp_path_factory.mktemp("mf4") / "a.mf4"
    path.write_bytes(mf4_file.mf4(made, mixed=mixed, variable=variable, layout=layout, by_table=by_table, finished=finished))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mf4_blocks, "BATCH_BYTES", batch)
        patch.setattr(mf4, "PIECE_BYTES", batch)
        log, frames = read(path, rows)
    assert frames == frames_of(made, mixed) and not log.skipped


@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not on this machine")
@pytest.mark.parametrize(("name", "count", "digest"), [
    ("data-processing__LOG__17BD1DB7__00000006__00000170.MF4", 2010, "88647f9f3bde7142"),
    ("data-processing__LOG__94C49784__00000005__00000002.MF4", 9600, "5a1a0fb9db83ff1c"),
    ("data-processing__LOG__FCBF0606__00003482__00000001-60B621D9.MF4", 1815, "bce3ec8deaa300fa"),
    ("other__asammdf-basics__input__00000001.MF4", 150_411, "c36ba956e7311536")])
def test_recordings_hold_what_asammdf_reads(name: str, count: int, digest: str) -> None:
    """The digests are of the frames of python-can 4.6.1 with asammdf 8.8.28, stamps rounded to the microsecond."""
    told = hashlib.sha256()
    log = Log(DATA / name)
    for t_ns, key, data in log.frames():
        told.update(repr((t_ns, key, data.hex())).encode())
    assert (log.frames_read, told.hexdigest()[:16], log.skipped) == (count, digest, 0)


@pytest.mark.parametrize("mixed", [False, True])
def test_a_file_that_ends_early_keeps_what_it_has(tmp_path: Path, mixed: bool) -> None:
    made = records(Random(3), 200)
    data = mf4_file.mf4(made, mixed=True, variable=True, layout="plain", finished=not mixed)
    place = data.rindex(b"##DT")
    path = tmp_path / "a.mf4"
    whole = bytearray(data[:place + 24 + 9000])
    if mixed:
        struct.pack_into("<Q", whole, place + 8, 24)
    path.write_bytes(whole)
    log, frames = read(path)
    assert 60 < len(frames) < 150 and set(frames) <= set(frames_of(made, True))
    assert log.skipped == 1 and "the file ends in the middle or is damaged" in log.complaints[0]


def test_frames_that_can_be_none_are_told(tmp_path: Path) -> None:
    made = [Record(mf4_file.DATA, 0, 0, 0x123, False, False, b"\1"), Record(mf4_file.DATA, 1, 0, 0x123, False, False, bytes(12)),
            Record(mf4_file.DATA, 2, 0, 0x123, False, False, b"\2")]
    path = tmp_path / "a.mf4"
    path.write_bytes(mf4_file.mf4(made, mixed=False, variable=True, layout="plain"))
    log, frames = read(path)
    assert [frame.data for frame in frames] == [b"\1", b"\2"]
    assert log.complaints == ["unreadable frame 2: 12 data bytes at 1e-06 s"]


def test_what_is_no_bus_logging_holds_no_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.mf4"
    path.write_bytes(mf4_file.mf4([], mixed=False, variable=False, layout="plain"))
    with pytest.raises(LogError, match="holds no frame"):
        list(Log(path).frames())


@given(st.integers(0, 2**64))
@settings(max_examples=150, deadline=None)
def test_no_damage_crashes_the_reader(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    random = Random(seed)
    data = bytearray(mf4_file.mf4(records(random, 40), mixed=random.random() < 0.5, variable=random.random() < 0.5,
                                  layout=random.choice(["plain", "packed", "list"]), finished=random.random() < 0.5))
    for _ in range(random.randint(1, 12)):
        place = random.randrange(8, len(data))
        data[place:place + 1] = random.randbytes(random.choice([0, 1, 1, 2]))
    path = tmp_path_factory.mktemp("mf4") / "a.mf4"
    path.write_bytes(data)
    try:
        list(Log(path).frames())
    except LogError as error:
        assert "\n" not in str(error)
