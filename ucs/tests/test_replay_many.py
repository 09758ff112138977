"""`ucs replay` over many recordings: one after the other, in processes, merged, resumed; as Parquet; and what doesn't fit."""
from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from level1.event import decode
from level1.io.merged import MergedLog
from level1.io.replay import LogError
from ucs import main, season
from ucs.recording import Outcome

START_S = 1_700_000_000
TEXT = """VERSION ""
NS_ :
BS_:
BU_: UCS NODE
BO_ 512 TANK: 8 NODE
 SG_ Level : 0|8@1+ (1,0) [0|200] "L" UCS
BO_ 513 PUMP: 8 NODE
 SG_ Pressure : 0|8@1+ (0.1,0) [0|20] "bar" UCS
BO_ 1537 ALARMS: 8 UCS
 SG_ TankLow : 0|2@1+ (1,0) [0|3] "" NODE
 SG_ PumpRunsDry : 2|2@1+ (1,0) [0|3] "" NODE
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmOnDelay" INT 0 100000;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmOnDelay" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_ "AlarmCode" SG_ 1537 TankLow 40001;
BA_ "AlarmOnDelay" SG_ 1537 TankLow 500;
BA_ "AlarmWhen" SG_ 1537 TankLow "Level < 20";
BA_ "AlarmCode" SG_ 1537 PumpRunsDry 40002;
BA_ "AlarmWhen" SG_ 1537 PumpRunsDry "Level < 20 and Pressure > 5";
"""
J1939 = """VERSION ""
NS_ :
BS_:
BU_: UCS ECU
BO_ 2364539904 ENGINE: 8 ECU
 SG_ Speed : 24|16@1+ (0.125,0) [0|8031] "rpm" UCS
BO_ 1538 ENGINE_ALARMS: 8 UCS
 SG_ TooFast : 0|2@1+ (1,0) [0|3] "" ECU
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2364539904 3;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_ "AlarmCode" SG_ 1538 TooFast 40003;
BA_ "AlarmWhen" SG_ 1538 TooFast "Speed > 2500";
"""
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path) -> Run:
    """Runs `ucs replay`: exit code, standard output, standard error."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))

    def run(*words: Any) -> tuple[int, str, str]:
        code = main.main(["replay", *map(str, words)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A season of three recordings in which the level is low for 1, 2 and 3 s, and a definition."""
    (tmp_path / "tank.dbc").write_text(TEXT)
    (tmp_path / "season").mkdir()
    for number, name in enumerate(("c", "a", "b"), 1):
        lines = [f"({START_S + n / 10:.6f}) can0 200#{10 if 20 <= n < 20 + 10 * number else 50:02X}00\n" for n in range(80)]
        (tmp_path / "season" / f"{name}.log").write_text("".join(lines))
    return tmp_path


def test_several_processes_print_and_write_what_one_does(replay: Run, folder: Path) -> None:
    words = (folder / "season", "--dbc", folder / "tank.dbc", "--events")
    one = replay(*words, folder / "one.jsonl", "--jobs", 1)
    two = replay(*words, folder / "two.jsonl", "--jobs", 2)
    assert one[0] == two[0] == 0
    lines, others = one[1].splitlines(), two[1].splitlines()
    assert lines[:-2] == others[:-2] and lines[-2].startswith("3 recordings, 240 frames in ")
    assert lines[-1] == others[-1] == f"  {'TankLow':<28} 3 × raised, 3 × cleared in 3 of them"
    assert (folder / "one.jsonl").read_bytes() == (folder / "two.jsonl").read_bytes()
    assert [line for line in lines if line.endswith(".log")] == [
        str(folder / "season" / f"{name}.log") for name in "abc"]


def test_the_order_is_that_of_the_arguments_and_one_by_one_gives_the_same_bytes(replay: Run, folder: Path) -> None:
    logs = [folder / "season" / f"{name}.log" for name in ("b", "c", "a")]
    replay(*logs, "--dbc", folder / "tank.dbc", "--events", folder / "all.jsonl", "--jobs", 2)
    single = b""
    for log in logs:
        replay(log, "--dbc", folder / "tank.dbc", "--events", folder / "one.jsonl")
        single += (folder / "one.jsonl").read_bytes()
    assert (folder / "all.jsonl").read_bytes() == single and single.count(b'"raised"') == 3


def test_patterns_and_a_recording_that_fails_among_others(replay: Run, folder: Path) -> None:
    (folder / "season" / "d.log").write_text("no recording\n")
    code, out, err = replay(folder / "season" / "[acd].log", "--dbc", folder / "tank.dbc")
    assert code == 2 and "a.log\n" in out and "c.log\n" in out and "b.log" not in out
    assert f"ucs: {folder / 'season' / 'd.log'}: no recording of a known format; known: candump text" in err


def test_an_empty_folder_and_a_pattern_without_files_are_told(replay: Run, folder: Path) -> None:
    (folder / "empty").mkdir()
    assert "no recording in this folder; they end in .log" in replay(folder / "empty", "--dbc", folder / "tank.dbc")[2]
    assert "no file fits this pattern" in replay(folder / "*.blf", "--dbc", folder / "tank.dbc")[2]


def test_ctrl_c_ends_with_a_word_and_the_next_run_goes_on_from_there(replay: Run, folder: Path,
                                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    words = (folder / "season", "--dbc", folder / "tank.dbc", "--jobs", 1, "--events")
    replay(*words, folder / "whole.jsonl")
    worked: list[str] = []
    real = season.work

    def interrupted(job: season.Job) -> Outcome:
        worked.append(Path(job.path).name)
        if len(worked) == 3:
            raise KeyboardInterrupt
        return real(job)
    monkeypatch.setattr(season, "work", interrupted)
    code, _, err = replay(*words, folder / "again.jsonl")
    assert code == main.INTERRUPTED
    assert err.splitlines()[-2:] == ["ucs: 2 of 3 recordings are done and kept; the same command goes on from there",
                                     "ucs: stopped by Ctrl-C"]
    assert replay(*words, folder / "again.jsonl")[0] == 0
    assert worked == ["a.log", "b.log", "c.log", "c.log"]
    assert (folder / "again.jsonl").read_bytes() == (folder / "whole.jsonl").read_bytes()


def test_ctrl_c_with_processes_leaves_no_traces_of_them(folder: Path) -> None:
    """A real signal to the whole process group, as a terminal sends it, while every process works."""
    long = folder / "long.log"
    long.write_text("".join(f"({START_S + n / 1000:.6f}) can0 200#{10 + n % 9:02X}00\n" for n in range(400_000)))
    second = folder / "second.log"
    os.link(long, second)
    with subprocess.Popen([sys.executable, "-m", "ucs", "replay", long, second, folder / "season", "--jobs", "2", "--dbc",
                           folder / "tank.dbc", "--events", "/dev/null"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          start_new_session=True, env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}) as run:
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children")
        while len(children.read_text().split()) < 3 and run.poll() is None:  # two workers and multiprocessing's tracker
            time.sleep(0.05)
        os.killpg(run.pid, signal.SIGINT)
        _, err = run.communicate()
    assert run.returncode == main.INTERRUPTED and "Traceback" not in err
    assert err.splitlines()[-1] == "ucs: stopped by Ctrl-C"


# --- several files of one drive -----------------------------------------------------------------------------------------------


def pressures(channel: str, bar: int) -> str:
    return "".join(f"({START_S + 0.05 + n / 10:.6f}) {channel} 201#{bar * 10:02X}\n" for n in range(80))


def test_files_of_one_drive_run_as_one_in_time_order(replay: Run, folder: Path) -> None:
    pump = folder / "pump.log"
    pump.write_text(pressures("can1", 9))
    tank = folder / "season" / "c.log"
    code, out, _ = replay(tank, pump, "--merge", "--dbc", folder / "tank.dbc", "--events", folder / "e.jsonl")
    raised = [(event.alarm, event.t - START_S) for event in map(decode, (folder / "e.jsonl").read_text().splitlines())
              if event.event == "raised"]
    assert code == 0 and raised == [("PumpRunsDry", Decimal("2.0")), ("TankLow", Decimal("2.5"))]
    assert f"{tank} and 1 more" in out and "160 frames" in out


def test_two_loggers_that_both_say_can0_are_told_apart_by_their_files(folder: Path) -> None:
    pump = folder / "pump.log"
    pump.write_text(pressures("can0", 9))
    merged = MergedLog([folder / "season" / "c.log", pump], {"pump.log": 1, "can0": 0})
    frames = list(merged.frames())
    assert [frame.t_ns for frame in frames] == sorted(frame.t_ns for frame in frames)
    assert {(frame.can_id, frame.bus) for frame in frames} == {(0x200, 0), (0x201, 1)}
    assert merged.channels_seen == {"can0", "pump.log"} and merged.frames_read == 160


def test_channels_keep_their_bus_from_file_to_file(folder: Path) -> None:
    for name, channels in (("one", ("can0", "can1")), ("two", ("can1", "can2"))):
        (folder / f"{name}.log").write_text("".join(f"({START_S + n}.000000) {channel} {0x300 + int(channel[-1]):03X}#00\n"
                                                    for n, channel in enumerate(channels)))
    frames = list(MergedLog([folder / "one.log", folder / "two.log"]).frames())
    assert {(frame.can_id, frame.bus) for frame in frames} == {(0x300, 0), (0x301, 1), (0x302, 2)}


def test_times_without_a_common_beginning_are_refused(folder: Path) -> None:
    other = folder / "other.log"
    other.write_text("(5.000000) can0 201#00\n")
    with pytest.raises(LogError, match="counts time from its own start"):
        list(MergedLog([folder / "season" / "a.log", other]).frames())


# --- Parquet ------------------------------------------------------------------------------------------------------------------


def test_parquet_holds_every_event_with_typed_columns(replay: Run, folder: Path) -> None:
    assert replay(folder / "season", "--dbc", folder / "tank.dbc", "--jobs", 1, "--events", folder / "e.jsonl",
                  "--parquet", folder / "e.parquet")[0] == 0
    events = [decode(line) for line in (folder / "e.jsonl").read_text().splitlines()]
    table = importlib.import_module("pyarrow.parquet").read_table(folder / "e.parquet")
    rows = table.to_pylist()
    assert [(row["t"], row["alarm"], row["event"], row["seq"]) for row in rows] == [
        (event.t, event.alarm, event.event, event.seq) for event in events] and len(rows) == 6
    assert json.loads(rows[0]["values"]) == {"TANK.Level": 10}
    assert rows[0]["utc"].isoformat() == "2023-11-14T22:13:22.500000+00:00"
    assert str(table.schema.field("t").type) == "decimal128(20, 9)" and rows[0]["recording"].endswith("a.log")


def test_a_comparison_writes_both_sides(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "late.dbc").write_text(TEXT.replace("TankLow 500;", "TankLow 1500;"))
    words = (folder / "season", "--dbc", folder / "tank.dbc", "--against", folder / "late.dbc", "--parquet", folder / "e.parquet")
    assert main.main(["diff", *map(str, words), "--jobs", "1"]) == 1
    rows = importlib.import_module("pyarrow.parquet").read_table(folder / "e.parquet").to_pylist()
    assert [(row["side"], Path(row["recording"]).stem) for row in rows if row["event"] == "raised"] == [
        ("old", "a"), ("old", "b"), ("old", "c"), ("new", "a"), ("new", "b")]


def test_a_table_that_cannot_be_written_is_told(replay: Run, folder: Path) -> None:
    code, _, err = replay(folder / "season", "--dbc", folder / "tank.dbc", "--parquet", folder / "none" / "e.parquet")
    assert code == 2 and err.startswith(f"ucs: {folder / 'none' / 'e.parquet'}: can't be written")


def test_a_missing_package_is_told_with_the_command(replay: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    code, _, err = replay(folder / "season", "--dbc", folder / "tank.dbc", "--parquet", folder / "e.parquet")
    assert (code, err) == (2, "ucs: --parquet needs a package more: pip install 'tractor-ucs[parquet]'\n")


# --- definitions that don't fit -----------------------------------------------------------------------------------------------


def test_the_nearest_identifier_is_named_when_none_fits(replay: Run, folder: Path) -> None:
    log = folder / "other.log"
    log.write_text("(1.000000) can0 1F0#00\n(2.000000) can0 203#00\n")
    assert replay(log, "--dbc", folder / "tank.dbc")[2] == (
        f"ucs: {log}: none of the 2 ids in this recording (1F0, 203) is in these definitions; the nearest: 203, and PUMP in "
        f"{folder / 'tank.dbc'}, 201; give the DBC files of the machine that was recorded\n")


def test_the_nearest_parameter_group_is_named_when_none_fits(replay: Run, folder: Path) -> None:
    (folder / "engine.dbc").write_text(J1939)
    log = folder / "other.log"
    log.write_text("(1.000000) can0 18FEEE00#FFFFFFFFFFFFFFFF\n(2.000000) can0 18F00503#FFFFFFFFFFFFFFFF\n")
    assert (f"; the nearest: 18F00503, PGN 61445, and ENGINE in {folder / 'engine.dbc'}, 0CF00400, PGN 61444; give"
            in replay(log, "--dbc", folder / "engine.dbc")[2])


def test_another_source_address_than_the_definitions_is_named(replay: Run, folder: Path) -> None:
    (folder / "engine.dbc").write_text(J1939)
    log = folder / "other.log"
    log.write_text("(1.000000) can0 0CF00421#FFFFFFFFFFFFFFFF\n(2.000000) can0 201#FF\n")
    assert replay(log, "--dbc", folder / "engine.dbc", folder / "tank.dbc")[2] == (
        f"ucs: {log}: ENGINE (PGN 61444) is defined for source address 0x00, which never sends it here; 0x21 does: write that "
        f"address, or FE for any, into its id in {folder / 'engine.dbc'}\n")
    log.write_text(log.read_text() + "(3.000000) can0 0CF00400#FFFFFFFFFFFFFFFF\n")
    assert replay(log, "--dbc", folder / "engine.dbc", folder / "tank.dbc")[2] == ""
