"""What the benchmark rests on: all contenders give the same alarms at the same times."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cantools
import pytest

from benchmarks import core, runs, workload

FRAMES = 15_000


@pytest.mark.parametrize("seed", [workload.SEED, 1, 2, 3])
def test_core_and_peer_give_the_same_alarms(seed: int) -> None:
    load = workload.make(FRAMES, seed)
    catalog, frames = core.catalog_of(load), list(load.frames())
    _, alarms = runs.receive_many(catalog, frames)
    database = cantools.database.load_string(workload.dbc(load), "dbc")
    assert len(alarms) > 50
    assert sorted(runs.peer(database, load.rules, core.messages_of(frames))[1]) == sorted(alarms)
    assert runs.receive(catalog, frames)[1] == alarms


def test_both_chains_give_the_alarms_of_the_frames_in_memory(tmp_path: Path) -> None:
    load = workload.make(FRAMES)
    log = tmp_path / "drive.log"
    log.write_text("".join(load.candump()))
    catalog = core.catalog_of(load)
    _, alarms = runs.receive_many(catalog, list(load.frames()))
    database = cantools.database.load_string(workload.dbc(load), "dbc")
    assert runs.chain_core(catalog, str(log))[1] == alarms
    assert sorted(runs.chain_peer(database, load.rules, str(log))[1]) == sorted(alarms)


def test_the_definitions_load_without_a_remark() -> None:
    load = workload.make(FRAMES)
    assert len(core.catalog_of(load).alarms) == len(load.rules) == 160


def test_the_command_prints_the_ratio() -> None:
    done = subprocess.run([sys.executable, "-m", "benchmarks.core", "--frames", "3000", "--rounds", "1"], capture_output=True,
                          text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    ratio = next(line for line in done.stdout.splitlines() if line.startswith("ratio: "))
    assert float(ratio.removeprefix("ratio: ")) > 0
