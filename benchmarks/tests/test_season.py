"""A short season: what `python -m benchmarks.season` does for a thousand hours, for some minutes of each machine."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from benchmarks.season import day as day_module
from benchmarks.season.__main__ import Report, main
from benchmarks.season.day import Day, DayResult
from benchmarks.season.kept import Kept, code_hash
from benchmarks.season.oracle import TABLE
from benchmarks.season.plan import MACHINES, NO_FAULTS, Fault, Plan, S, plan
from firmware_py.codec import Codec
from firmware_py.fault import WORKS, Statement
from firmware_py.scenario import PROGRAMS
from level1.catalog import Alarm, Catalog

SHORT_NS = 700 * S
SEED = 4


def short(machine: str, number: int = 0) -> Plan:
    return plan(SEED, number, SHORT_NS, machine)


@pytest.mark.parametrize("machine", MACHINES)
def test_what_breaks_is_reported_and_nothing_else(machine: str) -> None:
    result = Day(short(machine)).run()
    assert result.wrong == []
    assert sum(tally.injected for tally in result.tallies.values()) > 0
    assert not any(tally.missed for tally in result.tallies.values())


def test_the_same_seed_gives_the_same_day() -> None:
    assert Day(short("flaming tool")).run().digest == Day(short("flaming tool")).run().digest


def test_every_fault_that_a_node_knows_is_judged() -> None:
    for program, kind in PROGRAMS.items():
        if program == "path_driver":  # a stand-in for the vehicle; nothing on it is supervised
            continue
        known = {f"{phrase.device} {phrase.action}".strip() for phrase in kind.FAULTS
                 if phrase.action != WORKS and (phrase.device, phrase.action) not in NO_FAULTS}
        assert known == set(TABLE[program]), program


def judged(monkeypatch: pytest.MonkeyPatch, name: str, change: dict[str, object]) -> DayResult:
    """A day of the flaming tool on which it falls silent once, with one alarm defined otherwise."""
    known = day_module._definitions

    def spoilt(programs: tuple[str, ...]) -> tuple[Catalog, Codec]:
        catalog, codec = known(programs)
        alarms: dict[str, Alarm] = {**catalog.alarms, name: msgspec.structs.replace(catalog.alarms[name], **change)}
        return msgspec.structs.replace(catalog, alarms=alarms), codec
    monkeypatch.setattr(day_module, "_definitions", spoilt)
    silent = Fault(100 * S, "flamer", "flaming_tool", Statement("", None, "silent"), 108 * S, Statement("", None, WORKS))
    return Day(replace(plan(SEED, 0, 300 * S, "flaming tool"), faults=(silent,))).run()


def test_an_alarm_that_comes_too_late_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    result = judged(monkeypatch, "FlamerSilent", {"on_delay_ns": 10 * S})
    assert any("MISSED FlamerSilent" in line for line in result.wrong)


def test_an_alarm_that_comes_without_a_reason_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    result = judged(monkeypatch, "ChangeBurnersFailure", {"on_delay_ns": 0})
    assert any("FALSE ChangeBurnersFailure" in line for line in result.wrong)


def test_finished_days_count_when_it_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--hours", "0.1", "--day", "360", "--machine", "flaming tool", "--cache", str(tmp_path), "--jobs", "1"]
    assert main(arguments) == 0
    first = capsys.readouterr().out.splitlines()[-1]
    assert main([*arguments, "--report"]) == 0
    assert capsys.readouterr().out.splitlines() == ["1 day was finished before", first]
    (kept,) = Kept(tmp_path).load([(1, 0, 360 * S, "flaming tool")])
    table = Report([kept]).tables()
    assert f"| flaming tool | 0.1 | {sum(tally.injected for tally in kept.tallies.values())} |" in table


def test_a_day_counts_until_something_that_it_ran_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    def files_of(change: str) -> dict[str, str]:
        code_hash.cache_clear()
        read = Path.read_bytes
        monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + (b" " if path.as_posix().endswith(change) else b""))
        try:
            return {machine: code_hash(machine) for machine in MACHINES}
        finally:
            monkeypatch.undo()
            code_hash.cache_clear()
    before = files_of("nothing")

    def again(change: str) -> set[str]:
        after = files_of(change)
        return {machine for machine in MACHINES if after[machine] != before[machine]}
    assert again("level1/repair.py") == again("dbc/ucs.dbc") == again("firmware_py/node.py") == set(MACHINES)
    assert again("firmware_py/sprayer_plant.py") == again("oracle/sprayer_boom.py") == {"sprayer boom", "tractor with boom"}
    assert again("dbc/vehicle.dbc") == {"tractor", "tractor with boom"}
    assert again("level1/io/live.py") == set()


def test_memory_that_grows_is_wrong() -> None:
    def result(number: int, rss_kb: int) -> DayResult:
        return DayResult(number, "tractor", 1.0, "", process="one", turn=number, rss_kb=rss_kb)
    assert Report([result(0, 50_000), result(1, 51_000)]).wrong == []
    assert Report([result(0, 50_000), result(1, 90_000)]).wrong == ["memory grew by 40000 kB"]
