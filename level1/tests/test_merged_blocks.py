"""Recordings merged in blocks: the frames of `heapq.merge`, in its order."""
from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.io import line_blocks, merged
from level1.io.merged import MergedLog


def write(folder: Path, random: Random, number: int) -> Path:
    """A recording with channels of its own, ties, stamps that run backwards, long and short frames."""
    t_us, lines = random.choice([0, 0, 500, 3000]), []
    channels = random.sample(["can0", "can1", "can2", "vcan0"], random.randint(1, 3))
    for _ in range(random.randint(1, 300)):
        t_us = max(0, t_us + random.choice([0, 0, 1, 1, 20, 200, -5]))
        data = random.choice([f"#{random.randrange(1 << 64):016X}", "#11", f"##1{random.randrange(1 << 96):024X}", "#R"])
        lines.append(f"(0.{t_us:06d}) {random.choice(channels)} {random.choice([0x123, 0x18F00400, 0x7FF]):X}{data}\n")
    file = folder / f"{number}.log"
    file.write_text("".join(lines))
    return file


@given(st.integers(0, 2**64), st.integers(1, 4), st.booleans(), st.sampled_from([1, 30, 1 << 18]))
@settings(max_examples=150, deadline=None)
def test_blocks_hold_the_frames_that_single_reading_gives(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int,
                                                          one_bus: bool, rows: int) -> None:
    random, folder = Random(seed), tmp_path_factory.mktemp("drive")
    files = [write(folder, random, number) for number in range(count)]
    buses = {name: random.randrange(3) for name in random.sample(["can0", "can1", "1.log"], random.randint(0, 2))}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(line_blocks, "CHUNK_BYTES", 1500)
        patch.setattr(merged, "LEAST_ROWS", 1)
        single, blocks = MergedLog(files, buses, one_bus=one_bus), MergedLog(files, buses, one_bus=one_bus)
        assert [frame for block in blocks.blocks(rows) for frame in block.frames()] == list(single.frames())
    for what in ("frames_read", "error_frames", "remote_frames", "first_ns", "last_ns", "channels_seen"):
        assert getattr(blocks, what) == getattr(single, what), what
