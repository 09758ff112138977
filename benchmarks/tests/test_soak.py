"""The trials of the soak, short: each finds nothing lost and nobody obeyed, and would say so if it did."""
from __future__ import annotations

import random
from pathlib import Path

import pytest

from benchmarks import faults, killed_unit, soak
from level1.io.journal import read_events


def test_killed_writers_lose_nothing() -> None:
    row = soak.kill_writer(30, random.Random(2))
    assert row.good and row.outcome == "0 lost, 0 boot ids reused"


def test_a_killed_unit_has_told_and_sent_nothing_that_is_not_in_its_journal() -> None:
    row = soak.kill_unit(5, random.Random(2))
    assert row.good, row
    assert row.outcome.startswith("0 told or sent and not in the journal; ")


def test_what_a_killed_unit_sent_and_did_not_keep_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(killed_unit, "read_events", lambda path, limit: [
        event for event in read_events(path, limit=limit) if event.event != "repair_started"])
    outcome = killed_unit.kill(2, random.Random(2))
    assert any("commands of FanStopped for 0 attempts in the journal" in problem for problem in outcome.problems)
    assert any(problem.startswith("told and not in the journal: ") and "repair started" in problem for problem in outcome.problems)
    assert any("holds the seqs [1, " in problem for problem in outcome.problems)


def test_bad_commands_of_every_kind_are_refused_for_the_right_reason() -> None:
    row = soak.forge_commands(1500, random.Random(2))
    assert row.good, row


def test_a_gate_that_lets_something_through_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bridge.gate.VALID_NS", 60 * soak.S)
    assert not soak.forge_commands(300, random.Random(2)).good


def test_the_counts_go_into_the_page_and_nothing_else_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "reliability.md"
    page.write_text(soak.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(soak, "PAGE", page)
    before = page.read_text(encoding="utf-8")
    soak.put_into_page([soak.Row("fault", "2 times", "0 lost", True)])
    after = page.read_text(encoding="utf-8")
    assert "| fault | 2 times | 0 lost |" in after
    begin, end = "<!-- counts -->", "<!-- end of counts -->"
    assert before.partition(begin)[0] == after.partition(begin)[0]
    assert before.partition(end)[2] == after.partition(end)[2]


def test_the_page_says_of_each_fault_what_the_tests_say() -> None:
    found, told = faults.gather(run=False)
    assert found and all(fault.outcome for fault in found), told
    page = faults.PAGE.read_text(encoding="utf-8")
    assert "\n".join(faults.table(found)) in page, "run `python -m benchmarks.faults --write` and commit"
