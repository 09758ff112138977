"""`ucs journal`: what happened, for people and for programs."""
from __future__ import annotations

import csv
import io
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from level1.event import Commanded, Event, Monitor, SentFrame, decode, decode_commanded, decode_monitor, seconds
from level1.io.journal import Journal
from ucs.main import main
from ucs.tests.units import unit_toml

ROOT = Path(__file__).parents[2]


def an_event(seq: int, alarm: str, event: str, utc: str | None = None, boot: int = 1, **more: object) -> Event:
    values = {"FLAMER_STATUS.PilotFlame": "Off"} if event == "raised" else {}
    return Event("tractor-7", boot, seq, seconds(seq * 10**9), utc, utc is not None, alarm, 3101, "High", event, 1, 0, values,
                 "Pilot flame out", **more)  # type: ignore[arg-type]


EVENTS = [
    an_event(1, "PilotFlameOut", "raised", "2025-05-01T10:00:00.500Z"),
    an_event(2, "PilotFlameOut", "repair_started", "2025-05-01T10:00:01Z", frames=(SentFrame("FLAMER_CMD", "651", "00"),),
             passive=True),
    an_event(3, "BottleEmpty", "raised", "2025-05-01T11:00:00Z"),
    an_event(4, "BottleEmpty", "cleared"),
]


@pytest.fixture
def unit(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "unit.toml").write_text(unit_toml("flaming_tool.dbc"))
    with Journal(tmp_path / "journal.db", "tractor-7") as journal:
        journal.append(EVENTS, b"")
        yield tmp_path / "unit.toml"


def shown(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    capsys.readouterr()
    assert main(["journal", *map(str, args)]) == 0
    return capsys.readouterr().out


def test_events_are_listed_one_a_line(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(capsys, unit).splitlines() == [
        "2025-05-01T10:00:00.500Z  1.1  PilotFlameOut  raised  Pilot flame out",
        "2025-05-01T10:00:01Z  1.2  PilotFlameOut  repair_started  Pilot flame out (passive)",
        "2025-05-01T11:00:00Z  1.3  BottleEmpty  raised  Pilot flame out",
        "4.000 s  1.4  BottleEmpty  cleared  Pilot flame out",
    ]


def test_a_journal_file_will_do_as_well(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(capsys, unit.with_name("journal.db")) == shown(capsys, unit)


@pytest.mark.parametrize(("options", "seqs"), [
    (["--alarm", "BottleEmpty"], [3, 4]),
    (["--event", "raised"], [1, 3]),
    (["--alarm", "BottleEmpty", "--event", "raised"], [3]),
    (["--since", "2025-05-01T10:30"], [3]),
    (["--until", "2025-05-01T10:30:00Z"], [1, 2]),
    (["--since", "2025-05-01T12:00:00+02:00", "--until", "2025-05-01T10:00:01Z"], [1]),
    (["--since", "1 h"], []),
    (["--last", "2"], [3, 4]),
    (["--last", "1", "--event", "raised"], [3]),
    (["--boot", "1"], [1, 2, 3, 4]),
    (["--boot", "2"], []),
])
def test_events_are_chosen(unit: Path, capsys: pytest.CaptureFixture[str], options: list[str], seqs: list[int]) -> None:
    lines = shown(capsys, unit, "--format", "jsonl", *options).splitlines()
    assert [decode(line).seq for line in lines] == seqs


def test_freeze_frames_and_sent_frames_are_shown(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(capsys, unit, "--values").splitlines()
    assert "    FLAMER_STATUS.PilotFlame = Off" in lines
    assert "    sent FLAMER_CMD 651#00" in lines


def test_json_lines_are_the_events(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [decode(line) for line in shown(capsys, unit, "--format", "jsonl").splitlines()] == EVENTS


def test_csv_has_a_row_for_each_event(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(csv.DictReader(io.StringIO(shown(capsys, unit, "--format", "csv"))))
    assert [row["seq"] for row in rows] == ["1", "2", "3", "4"]
    assert json.loads(rows[0]["values"]) == {"FLAMER_STATUS.PilotFlame": "Off"}
    assert json.loads(rows[1]["frames"]) == [{"message": "FLAMER_CMD", "id": "651", "data": "00"}]


def test_nothing_to_show_is_told_apart_from_nothing_yet(unit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["journal", str(unit), "--alarm", "PilotFlameOut", "--event", "locked_out"]) == 0
    assert "nothing of the kind" in capsys.readouterr().err
    assert main(["journal", str(unit), "--alarm", "PilotFlameOot"]) == 0
    assert 'no event of an alarm called "PilotFlameOot"; did you mean "PilotFlameOut"?' in capsys.readouterr().err
    Journal(tmp_path / "empty.db", "tractor-8").close()
    assert main(["journal", str(tmp_path / "empty.db")]) == 0
    assert "nothing yet" in capsys.readouterr().err


def test_commands_stand_among_the_events_with_what_was_sent(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def command(after: int, name: str, **more: Any) -> Commanded:
        return Commanded("tractor-7", 2, after, seconds(after * 10**9), None, False, name, **{
            "target": "", "value": None, "origin": "above", "by": "chief", "id": "c-17", "outcome": "done"} | more)

    slower = command(0, "reduce_speed", value=Decimal("2.50"), frames=(SentFrame("VEHICLE_CMD", "100", "0019"),))
    reset = command(1, "reset", target="PilotFlameOut", outcome="refused", reason="can only be reset at the machine", id="c-18")
    with Journal(unit.with_name("second.db"), "tractor-7") as journal:
        journal.append(EVENTS[:1], b"")
    with Journal(unit.with_name("second.db"), "tractor-7") as journal:
        journal.append([an_event(1, "BottleEmpty", "raised", boot=2)], b"", [slower, reset])
    second = unit.with_name("second.db")
    assert shown(capsys, second, "--values").splitlines()[2:] == [
        "0.000 s  2  command  reduce_speed 2.50 by chief (c-17): done",
        "    sent VEHICLE_CMD 100#0019",
        "1.000 s  2.1  BottleEmpty  raised  Pilot flame out",
        "    FLAMER_STATUS.PilotFlame = Off",
        "1.000 s  2  command  reset PilotFlameOut by chief (c-18): refused: can only be reset at the machine"]
    lines = shown(capsys, second, "--event", "command", "--format", "jsonl").splitlines()
    assert [decode_commanded(line) for line in lines] == [slower, reset]
    assert len(shown(capsys, second, "--alarm", "PilotFlameOut").splitlines()) == 2
    row = list(csv.DictReader(io.StringIO(shown(capsys, second, "--format", "csv", "--event", "command"))))[0]
    assert (row["event"], row["seq"], json.loads(row["frames"])[0]["id"]) == ("command", "0", "100")


def test_following_waits_for_a_journal_that_is_not_there_yet(tmp_path: Path) -> None:
    follower = subprocess.Popen([sys.executable, "-m", "ucs", "journal", str(tmp_path / "journal.db"), "--follow"], cwd=ROOT,
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert follower.stdout and follower.stderr
    assert "waiting for `ucs run`" in follower.stderr.readline()
    follower.send_signal(signal.SIGINT)
    assert follower.wait(timeout=60) == 0
    follower.stdout.close()
    follower.stderr.close()


def test_following_shows_events_as_they_come(tmp_path: Path) -> None:
    with Journal(tmp_path / "journal.db", "tractor-7") as journal:
        journal.append(EVENTS[:1], b"")
        command = [sys.executable, "-m", "ucs", "journal", str(tmp_path / "journal.db"), "--follow"]
        follower = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert follower.stdout
        assert "1.1" in follower.stdout.readline()
        journal.append(EVENTS[1:2], b"")
        assert "1.2" in follower.stdout.readline()
        follower.send_signal(signal.SIGINT)
        assert follower.wait(timeout=60) == 0
        follower.stdout.close()


@pytest.mark.parametrize(("args", "told"), [
    (["missing.db"], "no such file"),
    (["missing.toml"], "no such file"),
    (["unit.toml"], "journal: missing; write [journal] path"),
    (["unit.toml", "--since", "yesterday"], '--since "yesterday": no time; write'),
    (["unit.toml", "--last", "0"], "--last 0: write a number from 1"),
])
def test_mistakes_are_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], args: list[str], told: str) -> None:
    (tmp_path / "unit.toml").write_text(unit_toml("flaming_tool.dbc", journal=""))
    assert main(["journal", str(tmp_path / args[0]), *args[1:]]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


# --- the monitoring history -------------------------------------------------------------------------------------------------


def a_sample(second: int, message: str = "motion", speed: float | None = 1.5, trusted: bool = True) -> Monitor:
    return Monitor("tractor-7", 1, seconds(second * 10**9), f"2025-05-01T10:{second // 60:02}:{second % 60:02}.000000Z", trusted,
                   message, {"Speed": speed}, {"Speed": 0.02}, {"Speed": "good" if speed else "stale"})


SAMPLES = [a_sample(0), a_sample(1, "nozzles"), a_sample(2, speed=None), a_sample(70, trusted=False)]


@pytest.fixture
def history(tmp_path: Path) -> Path:
    """A journal with a history of two batches."""
    with Journal(tmp_path / "monitored.db", "tractor-7", monitor_bytes=10**6) as journal:
        journal.record(SAMPLES[:3])
        journal.record(SAMPLES[3:])
        journal.record([a_sample(71, "nozzles")])
    return tmp_path / "monitored.db"


def test_the_monitoring_history_is_listed_one_sample_a_line(history: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(capsys, history, "--monitor", "motion").splitlines() == [
        "2025-05-01T10:00:00.000000Z  1  motion  Speed=1.5",
        "2025-05-01T10:00:02.000000Z  1  motion  Speed=(stale)",
        "2025-05-01T10:01:10.000000Z  1  motion  Speed=1.5 (clock not synchronised)"]
    assert "    Speed = - (stale, 0.020 s old)" in shown(capsys, history, "--monitor", "motion", "--values").splitlines()


@pytest.mark.parametrize(("options", "times"), [
    ([], [0, 1, 2, 70, 71]),
    (["--since", "2025-05-01T10:00:02"], [2, 70, 71]),
    (["--until", "2025-05-01T10:00:02"], [0, 1]),
    (["--last", "2"], [70, 71]),
    (["--last", "3", "--until", "2025-05-01T10:01:11"], [1, 2, 70]),
    (["--boot", "2"], []),
])
def test_samples_are_chosen(history: Path, capsys: pytest.CaptureFixture[str], options: list[str], times: list[int]) -> None:
    lines = shown(capsys, history, "--format", "jsonl", *options, "--monitor").splitlines()
    assert [decode_monitor(line).t for line in lines] == times


def test_csv_has_a_row_for_each_sample(history: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(csv.DictReader(io.StringIO(shown(capsys, history, "--monitor", "motion", "--format", "csv"))))
    assert [(row["message"], json.loads(row["values"])) for row in rows] == [
        ("motion", {"Speed": 1.5}), ("motion", {"Speed": None}), ("motion", {"Speed": 1.5})]


@pytest.mark.parametrize(("args", "told"), [
    (["monitored.db", "--monitor", "motoin"], 'no such monitoring message; did you mean "motion"?'),
    (["monitored.db", "--monitor", "--follow"], "`ucs monitor unit.toml` shows it live"),
    (["monitored.db", "--monitor", "--alarm", "X"], "--monitor --alarm: leave one of the two out"),
    (["other.db", "--monitor"], "other.db.monitor: no such file; `ucs run` writes it a minute after it was started"),
])
def test_mistakes_about_the_history_are_told_in_one_line(
        history: Path, capsys: pytest.CaptureFixture[str], args: list[str], told: str) -> None:
    assert main(["journal", str(history.with_name(args[0])), *args[1:]]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1
