"""The project's own gate: its examples give the events that are declared, byte for byte; real recordings the alarms declared."""
from __future__ import annotations

import gzip

import pytest

from examples.golden import (
    DECLARE,
    EXAMPLES,
    SHARED,
    Example,
    Recorded,
    Summary,
    changed,
    changed_summary,
    declared_summary,
    real_recordings,
    summary,
)
from level1.event import decode

LARGEST_BYTES = 300_000
"""Of all examples together: every clone carries them."""


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: str(example.name))
def test_an_example_gives_the_declared_events(example: Example) -> None:
    difference = changed(example, example.golden.read_bytes(), example.events())
    assert not difference, difference


def test_real_recordings_give_the_declared_alarms() -> None:
    if not SHARED.is_dir():
        pytest.skip("the shared recordings are not on this machine")
    declared, present = declared_summary(), real_recordings()
    now = summary(SHARED, present)
    difference = changed_summary(declared, now, present)
    assert not difference, difference
    assert not now.keys() - declared.keys(), f"not declared: {now.keys() - declared.keys()}; {DECLARE}"


def test_a_change_is_told_by_its_events_and_how_to_declare_it() -> None:
    example = next(each for each in EXAMPLES if each.name == "igniter_dead")
    golden = example.golden.read_bytes()
    lines = golden.splitlines(keepends=True)
    told = changed(example, golden, b"".join(lines[1:])).splitlines()
    assert told[0] == "igniter_dead.log.gz: the events changed (- as declared, + now):"
    assert len(told) == 3 and "raised" in told[1] and told[1].startswith("-") and told[-1] == DECLARE
    other = golden.replace(b'"unit":"replay"', b'"unit":"other"', 1)
    assert '"unit":"other"' in changed(example, golden, other), "what no line for people shows is told as it is"
    assert changed(example, golden, golden) == ""


def test_changed_counts_are_told_by_recording_and_alarm() -> None:
    once = Recorded(9, "0a", {"X": [1, 0]})
    declared: Summary = {"a.log": once, "b.log": Recorded(9, "", {}), "c.log": once, "d.log": once, "absent.log": once}
    now: Summary = {"a.log": Recorded(9, "0b", {"X": [2, 1]}), "c.log": once._replace(events="0c"),
                    "d.log": once._replace(frames=8)}
    told = changed_summary(declared, now, ["a.log", "b.log", "c.log", "d.log", "new.log"])
    assert told.splitlines()[1:-1] == [
        "a.log: X: 1 raised, 0 standing at the end → 2 raised, 1 standing at the end", "b.log: can no longer be read",
        "c.log: the same alarms, as often, but their events are others: `ucs replay --events` shows them",
        "d.log: 9 frames → 8"]
    assert changed_summary({"a.log": once}, {"a.log": once}, ["a.log"]) == ""


def test_the_examples_show_every_step_in_the_life_of_an_alarm_and_stay_small() -> None:
    words = {decode(line).event for example in EXAMPLES for line in example.golden.read_text().splitlines()}
    assert words >= {"raised", "repair_started", "repair_failed", "repaired", "locked_out", "cleared"}
    assert EXAMPLES[0].golden.read_bytes() == b"", "a healthy machine raises nothing"
    assert sum(file.stat().st_size for each in EXAMPLES for file in (each.log, each.golden)) < LARGEST_BYTES
    assert all(gzip.decompress(each.log.read_bytes()).startswith(b"(") for each in EXAMPLES)
