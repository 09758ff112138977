"""`ucs diff`: what changed between two sets of definitions, what a threshold changes, and runs that go on after Ctrl-C."""
from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from level1.io.definitions import load
from level1.io.error import OutsideError
from ucs import main, season
from ucs.recording import Outcome
from ucs.spans import Span, behaviour, bursts, busiest, changes, floods

TEXT = """VERSION ""
NS_ :
BS_:
BU_: UCS NODE
BO_ 512 TANK: 8 NODE
 SG_ Level : 0|8@1+ (1,0) [0|200] "L" UCS
BO_ 1537 ALARMS: 8 UCS
 SG_ TankLow : 0|2@1+ (1,0) [0|3] "" NODE
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmOnDelay" INT 0 100000;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmOnDelay" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_ "AlarmCode" SG_ 1537 TankLow 40001;
BA_ "AlarmOnDelay" SG_ 1537 TankLow 500;
BA_ "AlarmWhen" SG_ 1537 TankLow "Level < 20";
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings: the level dips for 1 s, and for 3 s; and two definitions."""
    (tmp_path / "old.dbc").write_text(TEXT)
    (tmp_path / "new.dbc").write_text(TEXT.replace("TankLow 500;", "TankLow 2000;"))
    logs = tmp_path / "season"
    logs.mkdir()
    for name, dip in (("short", 10), ("long", 30)):
        levels = [10 if 20 <= n < 20 + dip else 50 for n in range(80)]
        lines = [f"({1_700_000_000 + n / 10:.6f}) can0 200#{level:02X}00000000000000\n" for n, level in enumerate(levels)]
        (logs / f"{name}.log").write_text("".join(lines))
    return tmp_path


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    code = main.main(["diff", *map(str, words), "--jobs", "1"])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_alarms_that_vanish_and_move_are_told_and_make_the_exit_code(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, folder / "season", "--dbc", folder / "old.dbc", "--against", folder / "new.dbc")
    assert code == 1
    assert "- short.log  TankLow                      vanished         2.500 s to 3.000 s → not raised" in out
    assert "~ long.log  TankLow                      moved            2.500 s to 5.000 s → 4.000 s to 5.000 s" in out
    assert "alarms in the busiest 10 min    1    1    at most 10" in out
    assert out.endswith("2 differences: 1 moved, 1 vanished\n")


def test_the_same_definitions_differ_in_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, folder / "season", "--dbc", folder / "old.dbc", "--against", folder / "old.dbc")
    assert code == 0 and out.endswith("no difference\n")


def test_json_and_html(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = folder / "report.html"
    code, out, _ = run(capsys, folder / "season", "--dbc", folder / "old.dbc", "--against", folder / "new.dbc", "--format", "json",
                       "--html", report)
    told = json.loads(out)
    assert code == 1 and told["alarms"]["TankLow"]["old"]["raised"] == 2 and told["alarms"]["TankLow"]["new"]["raised"] == 1
    assert sorted(change["what"] for change in told["changes"]) == ["moved", "vanished"]
    page = report.read_text()
    assert told["rates"]["old"] == {"average": None, "busiest": 1, "floods": 0, "chattered": 0, "stale": 0}, "7 s tell no average"
    assert "http" not in page and "vanished" in page and page.count("<rect") == 3
    assert str(folder / "new.dbc") in page and "IEC 62682 asks for" in page and "long.log 4.0 s" in page


@pytest.mark.parametrize(("sweep", "raised"), [
    ("TankLow.AlarmOnDelay=0s,500ms,1500ms,5s", [2, 2, 1, 0]), ("TankLow.AlarmWhen=5,20,60", [0, 2, 2])])
def test_a_sweep_counts_for_each_value(folder: Path, capsys: pytest.CaptureFixture[str], sweep: str, raised: list[int]) -> None:
    code, out, _ = run(capsys, folder / "season", "--dbc", folder / "old.dbc", "--sweep", sweep, "--format", "json",
                       "--html", folder / "sweep.html")
    assert code == 0 and [value["raised"] for value in json.loads(out)["values"]] == raised
    assert (folder / "sweep.html").read_text().count("<rect") == len(raised)


@pytest.mark.parametrize(("sweep", "told"), [
    ("TankLwo.AlarmOnDelay=1s", 'no alarm is called "TankLwo"; did you mean "TankLow"?'),
    ("TankLow.AlarmOnDelay=1", "is no duration"), ("TankLow.AlarmPriority=1", "no values can be tried"),
    ("TankLow.AlarmWhen=low", "is no number"), ("TankLow.AlarmUntil=1", "has 0 numbers")])
def test_a_sweep_that_makes_no_sense_is_told(folder: Path, capsys: pytest.CaptureFixture[str], sweep: str, told: str) -> None:
    code, _, err = run(capsys, folder / "season", "--dbc", folder / "old.dbc", "--sweep", sweep)
    assert code == 2 and told in err


def test_what_cannot_be_used_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "empty").mkdir()
    both = ("--dbc", folder / "old.dbc", "--against", folder / "new.dbc")
    assert "no recording in this folder" in run(capsys, folder / "empty", *both)[2]
    assert "no file fits" in run(capsys, folder / "*.blf", *both)[2]
    assert "give either --against" in run(capsys, folder / "season", "--dbc", folder / "old.dbc")[2]
    code, _, err = run(capsys, folder / "nothing.log", *both)
    assert code == 2 and "nothing.log" in err


def test_several_processes_give_the_same_as_one(folder: Path) -> None:
    catalog = season.encoded(load([folder / "old.dbc"]))
    jobs = [season.Job(path, catalog) for path in season.recordings([str(folder / "season")])]
    assert season.run(jobs, workers=2) == season.run(jobs, workers=1)


def test_an_interrupted_run_goes_on_where_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = season.encoded(load([folder / "old.dbc"]))
    jobs = [season.Job(path, catalog) for path in season.recordings([str(folder / "season")])]
    cache = folder / "cache"

    def stop(outcome: Outcome) -> None:
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        season.run(jobs, workers=1, cache=cache, told=stop)
    assert len(list(cache.iterdir())) == 1
    worked: list[str] = []
    real = season.work

    def watched(job: season.Job) -> Outcome:
        worked.append(job.path)
        return real(job)
    monkeypatch.setattr(season, "work", watched)
    assert season.run(jobs, workers=1, cache=cache) == [real(job) for job in jobs]
    assert worked == [jobs[1].path] and list(cache.iterdir()) == []


def test_a_changed_recording_or_definition_is_another_job(folder: Path) -> None:
    old, new = (season.encoded(load([folder / name])) for name in ("old.dbc", "new.dbc"))
    path = folder / "season" / "long.log"
    before = season.Job(str(path), old).key()
    assert season.Job(str(path), new).key() != before
    path.write_text(path.read_text() + "(1700000009.000000) can0 200#00\n")
    assert season.Job(str(path), old).key() != before


def test_a_cluster_gives_the_same_as_this_machine(folder: Path) -> None:
    """A scheduler and a worker as separate processes."""
    catalog = season.encoded(load([folder / "old.dbc"]))
    jobs = [season.Job(path, catalog) for path in season.recordings([str(folder / "season")])]
    address_file = folder / "scheduler.json"
    common = ["--scheduler-file", str(address_file)]
    scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
                                  "--dashboard-address", "127.0.0.1:0", "--no-dashboard", *common], stderr=subprocess.DEVNULL)
    worker = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-nanny",
                               "--no-dashboard", "--host", "127.0.0.1", *common], stderr=subprocess.DEVNULL)
    try:
        for _ in range(300):
            if address_file.exists() and address_file.read_text():
                break
            scheduler.poll()
            subprocess.run(["sleep", "0.1"], check=True)
        address = json.loads(address_file.read_text())["address"]
        assert season.run(jobs, scheduler=address) == season.run(jobs, workers=1)
    finally:
        for process in (worker, scheduler):
            process.terminate()
            process.wait()


def test_a_scheduler_that_is_not_there_is_told(folder: Path) -> None:
    with pytest.raises(OutsideError, match="no Dask scheduler answers"):
        season.run([season.Job(str(folder / "season" / "long.log"), b"")], scheduler="tcp://127.0.0.1:9")


def test_spans_that_overlap_are_one_occasion() -> None:
    old = [Span("A", 0, 10, 0, ""), Span("A", 100, None, 0, "")]
    new = [Span("A", 4, 12, 0, ""), Span("A", 50, 51, 0, ""), Span("A", 100, 140, 0, "")]
    found = [(change.what, change.seconds()) for change in changes(old, new, 0)]
    assert found == [("moved", 4), ("appeared", 50), ("shorter", 100)]
    assert changes([Span("A", 0, 1, 0, "")], [Span("A", 0.005, 1.004, 0, "")], 0.01) == []
    assert [c.what for c in changes([Span("A", 0, 1, 1, "repaired")], [Span("A", 0, 1, 3, "locked_out")], 0)] == ["ended otherwise"]


def test_chatter_and_floods_by_the_standards_figures() -> None:
    assert bursts([0, 10, 20, 100, 110, 120, 500], 3, 60) == 2
    assert floods([Span("A", n * 50.0, None, 0, "") for n in range(11)]) == 1
    assert floods([Span("A", n * 70.0, None, 0, "") for n in range(11)]) == 0
    assert busiest([Span("A", n * 70.0, None, 0, "") for n in range(11)]) == 9 and busiest([]) == 0
    found = behaviour([("one", 200.0, [Span("A", 0, 10, 0, "locked_out"), Span("A", 100, None, 0, "")])], 2.0)
    assert (found.raised, found.per_hour, found.standing_s, found.locked_out) == (2, 1.0, 110.0, 1)
    assert (found.first, found.last) == (("one", 0), ("one", 100))


def test_outcomes_travel_as_bytes() -> None:
    outcome = Outcome("x", (b"{}",), 3, 1, 2)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(outcome), type=Outcome) == outcome
