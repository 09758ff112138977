"""What the benchmark rests on: all contenders give the same alarms at the same times."""
from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import cantools
import pytest

from benchmarks import chain, core, page, runs, workload
from benchmarks.recordings import WRITERS, Endless
from level1.io.replay import Log

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


@pytest.mark.parametrize("seed", [workload.SEED, 1])
def test_they_do_so_with_multiplexed_fd_and_odd_frames(seed: int) -> None:
    load = workload.make(FRAMES, seed, mixed=True)
    catalog, frames = core.catalog_of(load), list(load.frames())
    assert {len(frame.data) for frame in frames} == {1, 3, 5, 6, 7, 8, 12, 24, 64}
    _, alarms = runs.receive_many(catalog, frames)
    assert any("B" in name for _, name, _ in alarms)
    database = cantools.database.load_string(workload.dbc(load), "dbc")
    assert sorted(runs.peer(database, load.rules, core.messages_of(frames))[1]) == sorted(alarms)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, workload.Workload, list[runs.AlarmLine]]:
    load, folder = workload.make(5000, mixed=True), tmp_path_factory.mktemp("drive")
    (folder / "drive.dbc").write_text(workload.dbc(load))
    (folder / "rules.pickle").write_bytes(pickle.dumps(load.rules))
    return folder, load, sorted(runs.receive_many(core.catalog_of(load), list(load.frames()))[1])


@pytest.mark.parametrize("name", WRITERS)
def test_both_give_the_alarms_of_the_frames_in_memory_from_every_format(
        drive: tuple[Path, workload.Workload, list[runs.AlarmLine]], name: str) -> None:
    folder, load, alarms = drive
    suffix, write = WRITERS[name]
    log, dbc = folder / f"drive{suffix}", str(folder / "drive.dbc")
    write(load, log)
    first_ns = next(load.frames()).t_ns if suffix == ".asc" else 0  # python-can's ASC counts from its first frame
    expected = [(t_ns - first_ns, alarm, event) for t_ns, alarm, event in alarms]
    ours = chain.ours(str(log), dbc)
    assert sorted(ours.alarms) == expected and ours.frames == len(load)
    assert sorted(chain.peer(str(log), dbc, str(folder / "rules.pickle")).alarms) == expected


def test_a_long_recording_is_the_drive_again_and_again(tmp_path: Path) -> None:
    load = workload.make(3000, mixed=True)
    endless = Endless(load)
    assert endless.write(tmp_path / "long.log", 2 * len(load) + 1) == 3
    frames = list(Log(tmp_path / "long.log", one_bus=True).frames())
    later = [frame._replace(t_ns=frame.t_ns + 2 * endless.period_s * 10**9) for frame in load.frames()]
    assert frames[:len(load)] == list(load.frames()) and frames[2 * len(load):] == later


def test_the_definitions_load_without_a_remark() -> None:
    load = workload.make(FRAMES)
    assert len(core.catalog_of(load).alarms) == len(load.rules) == 160


def test_the_command_prints_the_ratio() -> None:
    done = subprocess.run([sys.executable, "-m", "benchmarks.core", "--frames", "3000", "--rounds", "1"], capture_output=True,
                          text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    ratio = next(line for line in done.stdout.splitlines() if line.startswith("ratio: "))
    assert float(ratio.removeprefix("ratio: ")) > 0


def test_the_benchmark_of_recordings_prints_a_ratio_a_format_and_says_what_mf4_needs() -> None:
    done = subprocess.run([sys.executable, "-m", "benchmarks.replay", "--compared", "3000", "--rounds", "1", "--only", "formats",
                           "--formats", "candump", "MF4", "--mf4-python", "/bin/false"], capture_output=True, text=True,
                          cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    assert len([line for line in done.stdout.splitlines() if line.startswith("ratio: ")]) == 1
    assert "MF4: left out. asammdf is not installed here" in done.stdout


def test_a_benchmark_writes_only_its_own_part_of_the_page(tmp_path: Path) -> None:
    there = tmp_path / "page.md"
    there.write_text("before\n<!-- a -->\nold\n<!-- end of a -->\n<!-- b -->\n<!-- end of b -->\n")
    page.put("a", page.table(("x", "y"), [("1", "2")]), there)
    assert there.read_text() == ("before\n<!-- a -->\n| x | y |\n| --- | --- |\n| 1 | 2 |\n<!-- end of a -->\n<!-- b -->\n"
                                 "<!-- end of b -->\n")
    with pytest.raises(ValueError, match="no part c"):
        page.put("c", [], there)
