"""The flaming tool on its bus: physics, safeguard, work mode, and each fault."""
from __future__ import annotations

import pytest

from firmware_py.fault import Statement
from firmware_py.flaming_plant import Bottle, propane_bar
from firmware_py.flaming_tool import FlamingTool
from firmware_py.participant import BusFrame
from firmware_py.tests.bench import CODEC, LIT, SECOND, WORK, Bench


def test_a_healthy_start_lights_the_pilot_flame_within_the_trial_whatever_the_chance() -> None:
    for seed in range(30):
        bench = Bench(seed).light()
        assert bench.status("PilotFlame") == "On", seed
        assert bench.status("Flaming") == "On", seed
        assert bench.tool.hazards == [], seed


def test_no_flame_without_a_spark() -> None:
    bench = Bench().break_("igniter", "dead").run(0.3).order(**LIT).run(2.5)
    assert bench.status("GasValve") == "Open"
    assert not bench.tool.plant.flame
    assert bench.status("Igniter") == "Off"


def test_no_flame_without_gas() -> None:
    bench = Bench().break_("gas_valve", "stuck closed").run(0.3).order(**LIT).run(0.7)
    assert bench.status("Igniter") == "On"
    assert bench.run(0.5).status("GasValveDemand") == "Closed" and bench.status("Igniter") == "Off", "the trial has ended"
    assert not bench.tool.plant.flame


def test_a_valve_that_falls_closed_in_a_trial_ends_it_and_gets_no_second_chance_over_the_gas_that_has_flowed() -> None:
    bench = Bench().break_("igniter", "dead").run(0.3).order(**LIT).run(0.5)
    bench.break_("gas_valve", "stuck closed", commands=2).break_("igniter", "works").run(4)
    assert bench.status("Safeguard") == "IgnitionFailed" and bench.tool.hazards == []


def test_the_ignition_trial_ends_after_three_seconds() -> None:
    bench = Bench().break_("igniter", "dead").run(0.3).order(**LIT).run(3.4)
    assert bench.status("Safeguard") == "IgnitionFailed"
    assert bench.status("GasValve") == "Closed"
    assert bench.run(5).status("GasValve") == "Closed", "a demand that just goes on opens nothing"


def test_the_valve_opens_only_after_closed_was_commanded() -> None:
    bench = Bench().order(**LIT).run(2)
    assert bench.status("GasValve") == "Closed"
    assert bench.order(GasValve="Closed").run(0.4).order(GasValve="Open").run(0.4).status("GasValve") == "Open"


def test_the_valve_does_not_open_without_the_igniter() -> None:
    assert Bench().run(0.3).order(**WORK).run(3).status("GasValve") == "Closed"


def test_the_safeguard_closes_the_valve_within_a_second_of_flame_loss() -> None:
    bench = Bench().light().break_("pilot", "blown out")
    lost_ns = bench.now_ns
    bench.run(2)
    closed_ns = next(t_ns for t_ns, name, values in bench.commander.history
                     if t_ns > lost_ns and name == "FLAMER_STATUS" and values["GasValve"] == "Closed")
    assert closed_ns - lost_ns <= SECOND
    assert bench.status("Safeguard") == "FlameLost"
    assert bench.status("Flaming") == "On", "the work mode stays, so that level 1 sees what was wanted"


def test_a_lost_flame_is_lit_again_after_a_purge() -> None:
    bench = Bench().light().break_("pilot", "blown out").run(1).order(GasValve="Closed").run(31)
    assert bench.status("Safeguard") == "Ready"
    bench.order(**LIT).run(2.5).order(**WORK).run(0.5)
    assert bench.status("PilotFlame") == "On"
    assert bench.tool.hazards == []


@pytest.mark.parametrize("purge_s", [1, 5, 15])
def test_lighting_without_a_purge_is_a_hazard(purge_s: float) -> None:
    bench = Bench().order(Burner1="High", Burner2="High", Burner3="High", Burner4="High").light()
    bench.break_("pilot", "blown out").run(1).order(GasValve="Closed").run(purge_s).order(**LIT).run(3)
    assert bench.tool.hazards
    assert any(text.startswith("HAZARD") for text in bench.told)


def test_trying_again_and_again_without_a_purge_is_a_hazard() -> None:
    bench = Bench().break_("igniter", "dead").run(0.3).order(**LIT).run(3.5).order(GasValve="Closed").run(0.5)
    assert bench.tool.hazards == []
    bench.break_("igniter", "works").order(**LIT).run(3)
    assert bench.tool.hazards


def test_the_valve_is_closed_within_500_ms_when_commands_stop() -> None:
    bench = Bench().light()
    bench.commander.sends = False
    stopped_ns = bench.now_ns
    bench.simulation.run(stopped_ns + SECOND // 2)
    assert bench.tool.safeguard.valve == "Closed"
    assert "gas valve closed" in bench.told
    bench.run(1)
    assert bench.status("Safeguard") == "CommandsLost"
    assert bench.status("Flaming") == "Off"
    assert not bench.tool.plant.flame


def test_commands_that_return_open_nothing_by_themselves() -> None:
    bench = Bench().light()
    bench.commander.sends = False
    bench.run(1)
    bench.commander.sends = True
    assert bench.run(5).status("GasValve") == "Closed"


def test_a_healthy_stop_never_shows_work_mode_without_a_flame() -> None:
    bench = Bench().order(Burner1="High").light().run(5).order(Flaming="Off", GasValve="Closed", Burner1="Off").run(2)
    assert bench.status("PilotFlame") == "Off"
    states = [values for _, name, values in bench.commander.history if name == "FLAMER_STATUS"]
    assert not [state for state in states if state["Flaming"] == "On" and state["PilotFlame"] == "Off"]


def test_the_work_mode_ends_when_gas_is_commanded_closed_for_two_minutes() -> None:
    bench = Bench().light().break_("pilot", "blown out").order(GasValve="Closed").run(119)
    assert bench.status("Flaming") == "On"
    assert bench.run(2).status("Flaming") == "Off"


# --- bottle, burners, wind ------------------------------------------------------------------------------------------------


def test_the_vapour_pressure_is_that_of_propane() -> None:
    assert propane_bar(20) == pytest.approx(7.35, abs=0.3), "8.36 bar absolute at 20 °C (NIST)"
    assert propane_bar(-42.1) == pytest.approx(0.0, abs=0.05), "its boiling point"


def test_pressure_and_level_fall_with_use_and_the_bottle_cools() -> None:
    bench = Bench().order(Burner1="High", Burner2="High", Burner3="High", Burner4="High").light()
    before = dict(bench.commander.heard["FLAMER_BOTTLE"])
    after = bench.run(1200).commander.heard["FLAMER_BOTTLE"]
    for signal in ("BottlePressure", "BottleLevel", "BottleTemperature"):
        assert float(after[signal]) < float(before[signal]), signal
    assert float(after["GasUsed"]) == pytest.approx(1200 * 2.05e-3, rel=0.05)


def test_an_idle_bottle_keeps_its_pressure() -> None:
    bottle = Bottle(50, 15)
    before = bottle.bar
    for _ in range(1000):
        bottle.advance(1.0, 0.0)
    assert bottle.bar == before


def test_a_cold_bottle_has_less_pressure() -> None:
    assert Bottle(50, -20).bar < Bottle(50, 15).bar / 3


def test_burners_take_their_set_points_within_their_response_time() -> None:
    bench = Bench().light().order(Burner1="Low", Burner2="High").run(0.9)
    assert bench.burners() == ("Low", "High", "Off", "Off")
    assert bench.order(Burner1="High", Burner2="Low").run(0.9).burners() == ("High", "Low", "Off", "Off")


def test_burners_are_off_outside_work_whatever_their_set_points() -> None:
    bench = Bench().order(Burner1="High").run(2)
    assert bench.burners() == ("Off",) * 4
    bench.light().break_("pilot", "blown out").run(2)
    assert bench.burners() == ("Off",) * 4


def test_a_storm_blows_the_flame_out_and_a_breeze_does_not() -> None:
    calm = Bench(wind=5).light().run(600)
    assert "On" == calm.status("PilotFlame")
    storm = Bench(wind=5, gust=15, gust_every=20, gust_length=3).light().run(600)
    assert any("a gust of 15 m/s" in text for text in storm.told)


def test_more_wind_blows_it_out_sooner() -> None:
    def survived_s(gust: float) -> float:
        bench = Bench(3, wind=0, gust=gust, gust_every=5, gust_length=3).light()
        while bench.tool.plant.flame and bench.now_ns < 3600 * SECOND:
            bench.run(1)
        return bench.now_ns / SECOND
    assert survived_s(25) < survived_s(9)


# --- faults ---------------------------------------------------------------------------------------------------------------


def test_an_empty_bottle_puts_the_flame_out() -> None:
    bench = Bench().light().break_("bottle", "empty").run(3)
    assert bench.commander.heard["FLAMER_BOTTLE"]["BottlePressure"] == 0
    assert bench.status("PilotFlame") == "Off"
    assert bench.status("GasValve") == "Closed"


def test_a_valve_stuck_closed_falls_closed_and_opens_again_after_so_many_commands() -> None:
    bench = Bench().light().break_("gas_valve", "stuck closed").run(1)
    assert bench.status("GasValve") == "Closed"
    assert bench.status("PilotFlame") == "Off"
    later = Bench().break_("gas_valve", "stuck closed", commands=2).run(0.3)
    for outcome in ("Closed", "Closed", "Open"):
        assert later.order(**LIT).run(0.5).status("GasValve") == outcome
        later.order(GasValve="Closed", Igniter="Off").run(1)


def test_a_valve_stuck_open_lets_gas_flow_and_never_reads_ready() -> None:
    bench = Bench().light().break_("gas_valve", "stuck open").break_("pilot", "blown out").order(GasValve="Closed").run(40)
    assert bench.status("GasValve") == "Open"
    assert bench.status("GasValveDemand") == "Closed"
    assert bench.status("Safeguard") != "Ready"
    assert any("gas flows without a flame" in hazard.what for hazard in bench.tool.hazards)


def test_a_leaking_valve_shows_pressure_behind_it_and_never_reads_ready() -> None:
    bench = Bench().light().break_("gas_valve", "leaks").break_("pilot", "blown out").order(GasValve="Closed").run(40)
    assert bench.status("GasValve") == "Closed"
    assert float(bench.status("LinePressure")) > 0.2
    assert bench.status("Safeguard") != "Ready"
    bench.break_("gas_valve", "works").run(31)
    assert bench.status("Safeguard") == "Ready"


def test_a_flame_goes_on_behind_a_leaking_valve() -> None:
    bench = Bench().light().break_("gas_valve", "leaks").order(Flaming="Off", GasValve="Closed").run(5)
    assert (bench.status("GasValve"), bench.status("PilotFlame")) == ("Closed", "On")


@pytest.mark.parametrize(("action", "set_point", "expected"), [
    ("stuck", "High", "Low"), ("stuck low", "High", "Low"), ("stuck low", "Off", "Low"), ("stuck high", "Off", "High"),
    ("stuck off", "Off", "Off")])
def test_a_stuck_burner_stays(action: str, set_point: str, expected: str) -> None:
    first = "High" if action == "stuck high" else "Low"
    bench = Bench().order(Burner2=first).light().break_("burner", action, 2).order(Burner1="High", Burner2=set_point).run(5)
    assert bench.burners()[:2] == ("High", expected)
    assert bench.break_("burner", "works", 2).run(2).burners()[1] == set_point


def test_a_burner_that_ignores_two_commands_obeys_the_third() -> None:
    bench = Bench().light().break_("burner", "stuck", 1, commands=2).order(Burner1="High").run(1.5)
    assert bench.burners()[0] == "Off"
    assert bench.run(2).burners()[0] == "High"


def test_refusing_to_start_and_to_stop() -> None:
    bench = Bench().break_("", "refuses start").light().run(5)
    assert (bench.status("PilotFlame"), bench.status("Flaming")) == ("On", "Off")
    assert bench.break_("", "works").run(2).status("Flaming") == "On"
    bench.break_("", "refuses stop", commands=3).order(Flaming="Off", GasValve="Closed").run(2)
    assert bench.status("Flaming") == "On"
    assert bench.run(3).status("Flaming") == "Off"


def test_a_flame_sensor_that_lies() -> None:
    bench = Bench().light().break_("flame_sensor", "stuck off").run(2)
    assert (bench.status("PilotFlame"), bench.status("GasValve")) == ("Off", "Closed")
    bench.break_("flame_sensor", "stuck on").run(2)
    assert (bench.status("PilotFlame"), bench.tool.plant.flame) == ("On", False)


def test_a_silent_node_works_on() -> None:
    bench = Bench().light().break_("", "silent").run(0.1)
    count = len(bench.commander.history)
    bench.run(3)
    assert len(bench.commander.history) == count
    assert bench.tool.plant.flame
    bench.break_("", "works").run(0.2)
    assert len(bench.commander.history) > count


def test_a_frozen_node_repeats_itself_and_its_safeguard_closes() -> None:
    bench = Bench().light().break_("", "frozen").run(3)
    last = [values for _, name, values in bench.commander.history if name == "FLAMER_STATUS"][-10:]
    assert all(values == last[0] for values in last)
    assert last[0]["PilotFlame"] == "On", "what it says is old"
    assert not bench.tool.plant.flame


def test_a_reset_node_is_silent_for_a_moment_and_starts_purging() -> None:
    bench = Bench().light().break_("", "reset").run(1)
    count = len(bench.commander.history)
    assert not bench.tool.plant.flame
    bench.run(0.4)
    assert len(bench.commander.history) == count
    bench.run(1)
    assert (bench.status("Safeguard"), bench.status("Flaming"), bench.status("GasValve")) == ("Purging", "Off", "Closed")


def test_every_fault_of_the_vocabulary_can_be_injected() -> None:
    for phrase in FlamingTool.FAULTS:
        bench = Bench().light()
        bench.tool.inject(bench.now_ns, Statement(phrase.device, 1 if phrase.count else None, phrase.action))
        bench.run(1)


def test_an_unknown_fault_is_refused() -> None:
    with pytest.raises(ValueError, match="knows no fault"):
        Bench().break_("pilot", "sings")


# --- protocol -------------------------------------------------------------------------------------------------------------


def test_short_frames_are_ignored_and_counted() -> None:
    bench = Bench().run(0.3)
    bench.tool.receive(bench.now_ns, *CODEC.identifier("FLAMER_CMD"), b"\x05")
    assert bench.tool.short_frames == 1


def test_a_reserved_value_opens_nothing() -> None:
    bench = Bench().run(0.3)
    bench.commander.sends = False
    for step in range(20):
        bench.tool.receive(bench.now_ns, *CODEC.identifier("FLAMER_CMD"), bytes([0b111101 if step else 0b111110, 0xFF, 0, 0]))
        bench.run(0.1)
    assert bench.status("GasValve") == "Closed"


def test_a_second_node_of_the_same_kind_is_told() -> None:
    bench = Bench().run(0.3)
    bench.tool.receive(bench.now_ns, *CODEC.identifier("FLAMER_STATUS"), bytes(8))
    bench.run(0.1)
    assert any("started twice" in text for text in bench.told)


def test_status_comes_ten_times_a_second() -> None:
    history = Bench().run(10).commander.history
    assert len([1 for _, name, _ in history if name == "FLAMER_STATUS"]) == pytest.approx(100, abs=1)
    assert len([1 for _, name, _ in history if name == "FLAMER_BOTTLE"]) == pytest.approx(20, abs=1)


def test_a_late_step_makes_up_for_the_plant_but_sends_each_message_once() -> None:
    bench = Bench()
    frames = bench.tool.step(60 * SECOND)
    assert len(frames) == 3
    assert bench.tool.next_deadline() == 60 * SECOND + FlamingTool.TICK_NS
    assert bench.tool.step(60 * SECOND + FlamingTool.TICK_NS) == []


def test_the_same_seed_gives_the_same_frames() -> None:
    def traffic(seed: int) -> list[tuple[int, BusFrame]]:
        frames: list[tuple[int, BusFrame]] = []
        bench = Bench(seed, wind=5, gust=15, gust_every=30)
        bench.simulation.on_frame = lambda t_ns, frame: frames.append((t_ns, frame))
        bench.light().run(120)
        return frames
    assert traffic(4) == traffic(4)
    assert traffic(4) != traffic(5)
