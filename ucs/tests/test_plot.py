"""Pictures: what is traced from the frames, what is chosen for a picture, and the commands that draw it."""
from __future__ import annotations

import math
import sys
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from level1.decode import encode
from level1.event import Event
from level1.frame import Frame, frame_key
from level1.io.definitions import load
from ucs import main, pairs
from ucs.plot import MOST_ALARMS, draw, lanes, stories
from ucs.trace import Trace

SECOND = 1_000_000_000
PNG = b"\x89PNG"
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ucs(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs `ucs`: exit code, standard output, standard error."""

    def run(*words: Any) -> tuple[int, str, str]:
        code = main.main([*map(str, words)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def boom(pattern: int, valves: int, t_s: float) -> list[Frame]:
    """What is commanded of valve 1, and what it is, once a time stamp."""
    messages = load(["sprayer_boom.dbc"]).messages
    return [Frame(round(t_s * SECOND), frame_key(messages[name].can_id, False), encode(messages[name], {signal: value}, None))
            for name, signal, value in (("SPRAYER_NOZZLES_CMD", "Valve1Wanted", pattern), ("SPRAYER_NOZZLES", "Valve1", valves))]


def event(alarm: str, t_s: float, word: str, instance: int = 1, priority: str = "High") -> Event:
    return Event("u", 1, 1, Decimal(str(t_s)), None, False, alarm, 1, priority, word, instance, 0, {}, "")


def test_a_line_holds_changes_only_and_breaks_where_its_message_falls_silent() -> None:
    trace = Trace(load(["sprayer_boom.dbc"]))
    for n in range(20):
        for frame in boom(1, int(n > 4), n / 10):
            trace.take(*frame)
    cycle_s = (trace.catalog.messages["SPRAYER_NOZZLES"].cycle_ns or 0) / SECOND
    trace.take(10 * SECOND, 0x7FF, b"")
    line = trace.lines()["SPRAYER_NOZZLES", "Valve1"]
    assert [t_ns / SECOND for t_ns in line.times_ns] == [0, 0.5, pytest.approx(1.9 + 3 * cycle_s)]
    assert list(line.values[:2]) == [0, 1] and math.isnan(line.values[2]) and line.words == ["", "", "silent"]


def test_reserved_values_are_told_apart_from_numbers() -> None:
    trace = Trace(load(["isobus_tractor.dbc"]))
    message = trace.catalog.messages["EFL_P1"]
    oil = message.signal("EngineOilPressure")
    for n, raw in enumerate((50, 0xFE, 0xFF)):
        trace.take(n * SECOND // 10, frame_key(message.can_id & ~0xFF, True), encode(message, {oil.name: raw}, None))
    line = trace.lines()["EFL_P1", "EngineOilPressure"]
    assert line.words == ["", "error", "unavailable"] and line.values[0] == 200


def test_commanded_and_actual_stand_in_one_lane() -> None:
    trace = Trace(load(["sprayer_boom.dbc"]))
    for frame in boom(1, 0, 0):
        trace.take(*frame)
    lane = next(lane for lane in lanes(trace, ["Section1NotSet"]) if lane.expected)
    assert lane.expected is not None
    assert (lane.actual.signal.name, lane.expected.signal.name) == ("Valve1", "Valve1Wanted")
    assert lane.alarms == {"Section1NotSet"}


def test_stories_run_from_raised_to_cleared_or_to_the_end() -> None:
    told = stories([event("A", 11, "raised", 1), event("A", 12, "repair_started", 1), event("B", 13, "raised", 2),
                    event("A", 14, "cleared", 1), event("B", 15, "locked_out", 2)], 10 * SECOND, 20.0)
    assert [(story.alarm, story.start, story.end, story.locked) for story in told] == [("A", 1, 4, None), ("B", 3, 20, 5)]
    assert told[0].marks == ((2, "repair_started"),)


def test_more_alarms_than_fit_are_said_and_the_suffix_is_the_format(tmp_path: Path) -> None:
    trace = Trace(load(["sprayer_boom.dbc"]))
    for frame in boom(1, 0, 0) + boom(1, 0, 60):
        trace.take(*frame)
    told = [event(f"Alarm{n}", n, word, n, "Low") for n in range(MOST_ALARMS + 2) for word in ("raised", "repaired", "cleared")]
    draw(trace, told, tmp_path / "many.svg", "Many")
    assert (tmp_path / "many.svg").read_text().startswith("<?xml")
    draw(trace, [], tmp_path / "none.png", "None")
    assert (tmp_path / "none.png").read_bytes().startswith(PNG)


def test_a_simulation_is_supervised_and_drawn_with_its_path(ucs: Run, tmp_path: Path) -> None:
    picture = tmp_path / "boom.png"
    code, out, _ = ucs("simulate", "sprayer_stuck_valve", "--supervise", "sprayer_boom.dbc", "--duration", "4 min",
                       "--plot", picture)
    assert code == 0 and picture.read_bytes().startswith(PNG)
    words = [line for line in out.splitlines() if "Section7NotSet" in line]
    assert sum("repair started" in line for line in words) == 3 and "locked out" in words[-1]


def test_without_plot_a_simulation_can_be_supervised_by_all_its_definitions(ucs: Run) -> None:
    code, out, _ = ucs("simulate", "igniter_dead", "--supervise", "--duration", "20 s")
    assert code == 0 and "PilotFlameOut                raised" in out


def test_a_replay_is_drawn_and_several_get_a_picture_each(ucs: Run, tmp_path: Path) -> None:
    ucs("simulate", "igniter_dead", "--supervise", "--duration", "20 s", "--log", tmp_path / "a.log")
    (tmp_path / "b.log").write_bytes((tmp_path / "a.log").read_bytes())
    logs = (tmp_path / "a.log", tmp_path / "b.log")
    code, _, err = ucs("replay", *logs, "--dbc", "flaming_tool.dbc", "--plot", tmp_path / "out.png")
    assert code == 0 and err == ""
    assert sorted(file.name for file in tmp_path.glob("*.png")) == ["out-a.png", "out-b.png"]


def test_what_stands_in_the_way_is_one_line_and_said_before_the_work(ucs: Run, tmp_path: Path,
                                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "a.log"
    log.write_text("(1.000000) can0 210#00\n")
    words = ("replay", log, "--dbc", "flaming_tool.dbc", "--plot")
    assert ucs(*words, tmp_path / "no" / "x.png") == (
        2, "", f"ucs: {tmp_path / 'no' / 'x.png'}: the picture can't be written: there is no folder {tmp_path / 'no'}\n")
    assert ucs(*words, tmp_path / "x.doc") == (2, "", f"ucs: {tmp_path / 'x.doc'}: the picture can't be written: its name says no "
                                                      "known format; end it in .png, .svg or .pdf\n")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert ucs(*words, tmp_path / "x.png") == (2, "", "ucs: --plot needs a package more: pip install 'tractor-ucs[plot]'\n")


@pytest.mark.parametrize(("file", "alarm", "pairs_of_it"), [
    ("sprayer_boom.dbc", "Section7NotSet", {("Valve7", "Valve7Wanted")}),
    ("sprayer_boom.dbc", "MainFlowNotAdjusted", {("MainFlow", "MainFlowTarget")}),
    ("sprayer_boom.dbc", "MainTankMismatch", set()),
    ("sprayer_boom.dbc", "BoomOpeningNotAdjusted", set()),
    ("vehicle.dbc", "HitchNotMoving", {("HitchPosition", "HitchWanted")}),
    ("vehicle.dbc", "PtoNotSet", {("PtoState", "PtoWanted")}),
    ("vehicle.dbc", "ImplementSetUnsetFailure", {("ImplementState", "ImplementWanted")}),
    ("flaming_tool.dbc", "FlamingStartStopFailure", {("Flaming", "Flaming")}),
    ("flaming_tool.dbc", "PilotFlameOut", set())])
def test_what_is_and_what_was_expected_of_it_stand_together(file: str, alarm: str, pairs_of_it: set[tuple[str, str]]) -> None:
    catalog = load([file])
    found = pairs.of_alarm(catalog.alarms[alarm], catalog)
    assert {(actual[1], expected[1]) for actual, expected in found} == pairs_of_it
    assert all(catalog.messages[actual[0]].senders != ("UCS",) for actual, _ in found)


def test_an_expected_word_stands_where_the_actual_one_does() -> None:
    messages = load(["vehicle.dbc"]).messages
    actual = messages["VEHICLE_IMPLEMENT"].signal("ImplementState")
    expected = messages["VEHICLE_IMPLEMENT_CMD"].signal("ImplementWanted")
    assert {expected.choices[int(raw)]: actual.choices[int(same)] for raw, same in pairs.translation(actual, expected).items()} == {
        "Set": "Set", "Unset": "Unset"}
