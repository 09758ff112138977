"""`ucs simulate`, and the shipped flaming tool under level 1: a healthy one raises nothing, each fault raises its alarm."""
from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import can
import pytest

from firmware_py.flaming_tool import FlamingTool
from firmware_py.scenario import build, parse
from firmware_py.virtual_bus import Simulation
from level1.catalog import NORMAL, Catalog
from level1.command import Order
from level1.event import Event, Output
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.main import main
from ucs.simulate import EXAMPLE, SHIPPED, load
from ucs.simulated_unit import SimulatedUnit
from ucs.tests.proof import proves

ROOT = Path(__file__).parents[2]
SECOND = 1_000_000_000
SCENARIOS = sorted(file.name for file in SHIPPED.glob("*.toml") if '"flaming_tool"' in file.read_text("utf-8"))
NODES = '[nodes.flamer]\nprogram = "flaming_tool"\n[nodes.mission]\nprogram = "mission_controller"\n'


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["flaming_tool.dbc"])


class Field:
    """A scenario with level 1 attached, in virtual time. events: what level 1 reported."""

    def __init__(self, catalog: Catalog, text: str, *, seed: int | None = None, armed: Sequence[str] | None = None):
        self.scenario = parse(text, "test.toml")
        cast = build(self.scenario, seed=seed)
        self.events: list[Event] = []
        self.supervisor = Supervisor(catalog, unit="tractor-7", start_ns=0, armed=armed)
        self.unit = SimulatedUnit(self.supervisor, self._deliver)
        self.simulation = Simulation([*cast.participants, self.unit])
        tool = cast.nodes["flamer"]
        assert isinstance(tool, FlamingTool)
        self.tool = tool

    def _deliver(self, outputs: Sequence[Output]) -> None:
        self.events += [output for output in outputs if isinstance(output, Event)]

    def run(self, until_s: float | None = None) -> Field:
        """Up to a time, or to the scenario's end."""
        self.simulation.run(self.scenario.duration_ns if until_s is None else round(until_s * SECOND))
        return self

    def reset(self, alarm: str) -> None:
        """Somebody resets a lock-out at the machine."""
        self._deliver(self.supervisor.command(Order("1", "reset", alarm, origin="local"), self.simulation.now_ns))

    def life(self, alarm: str) -> list[str]:
        """What was reported of an alarm."""
        return [event.event for event in self.events if event.alarm == alarm]

    @property
    def raised(self) -> set[str]:
        """Alarms that were raised at all."""
        return {event.alarm for event in self.events}


def field(catalog: Catalog, *faults: str, orders: Sequence[str] = ("at 2 s: flaming on",), duration: str = "3 min",
          settings: str = "", armed: Sequence[str] | None = None) -> Field:
    """A mission with faults. settings: further lines of the tool's table."""
    head = f'duration = "{duration}"\norders = {list(orders)}\nfaults = {list(faults)}\n'
    return Field(catalog, head + NODES.replace('flaming_tool"\n', f'flaming_tool"\n{settings}\n'), armed=armed)


# --- the shipped definition against the node ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_a_healthy_start_work_and_stop_raise_nothing(catalog: Catalog, seed: int) -> None:
    healthy = Field(catalog, (SHIPPED / "healthy.toml").read_text("utf-8"), seed=seed).run()
    assert healthy.events == []
    assert healthy.tool.hazards == []


def test_an_unpurged_tool_starts_without_an_alarm(catalog: Catalog) -> None:
    assert field(catalog, settings="purged = false").run().events == []


@pytest.mark.covers("PilotFlameOut", "raised", "repair_started", "repaired", "cleared")
def test_a_flame_blown_out_is_lit_again_without_a_hazard(catalog: Catalog) -> None:
    windy = field(catalog, "at 12 s: flamer.pilot blown out").run()
    assert windy.life("PilotFlameOut") == ["raised", "repair_started", "repaired", "cleared"]
    assert windy.raised == {"PilotFlameOut"}
    assert windy.tool.plant.flame
    assert windy.tool.hazards == []
    assert windy.events[0].t - 12 < 1, "raised within a second"
    assert windy.events[2].t - windy.events[1].t > 30, "the purge is not shortened"


@pytest.mark.covers("PilotFlameOut", "raised", "repair_started", "repair_failed", "locked_out", "cleared")
def test_a_dead_igniter_ends_locked_out_and_closed(catalog: Catalog) -> None:
    dead = field(catalog, "at 10 s: flamer.igniter dead", "at 12 s: flamer.pilot blown out", duration="10 min").run(235)
    assert dead.life("PilotFlameOut") == ["raised", *["repair_started", "repair_failed"] * 3, "locked_out"]
    assert dead.raised == {"PilotFlameOut"}
    assert dead.tool.safeguard.valve == "Closed"
    assert dead.tool.hazards == []
    dead.reset("PilotFlameOut")
    dead.run()
    assert dead.life("PilotFlameOut")[-2:] == ["acknowledged", "cleared"]
    assert not dead.tool.plant.flame, "a reset lights nothing by itself"


@pytest.mark.covers("PilotIgnitionFailure", "raised", "repair_started", "repair_failed", "repaired", "cleared")
def test_an_igniter_that_is_dead_at_the_start_is_tried_again_by_level_1(catalog: Catalog) -> None:
    late = field(catalog, "at 1 s: flamer.igniter dead for 50 s").run()
    assert late.life("PilotIgnitionFailure") == [
        "raised", "repair_started", "repair_failed", "repair_started", "repaired", "cleared"]
    assert late.tool.plant.flame
    assert late.tool.hazards == []


@pytest.mark.covers("PilotIgnitionFailure", "locked_out", "cleared")
def test_a_lock_out_at_the_start_can_be_reset_at_the_machine(catalog: Catalog) -> None:
    dead = field(catalog, "at 1 s: flamer.igniter dead", duration="10 min").run(400)
    assert dead.life("PilotIgnitionFailure")[-1] == "locked_out"
    dead.reset("PilotIgnitionFailure")
    assert dead.life("PilotIgnitionFailure")[-1] == "cleared"
    assert dead.run().tool.hazards == []


REPAIRED = ["raised", "repair_started", "repaired", "cleared"]
LOCKED_OUT = ["raised", "repair_started", "repair_failed", "locked_out"]
PASSED = ["raised", "cleared"]
TABLE = [
    ("FlamingStartStopFailure", ["at 1 s: flamer refuses start for 4 commands"], REPAIRED),
    ("FlamingStartStopFailure", ["at 1 s: flamer refuses start"], LOCKED_OUT),
    ("FlamingStartStopFailure", ["at 59 s: flamer refuses stop for 4 commands"], REPAIRED),
    ("ChangeBurnersFailure", ["at 19 s: flamer.burner[2] stuck for 3 commands"], REPAIRED),
    ("ChangeBurnersFailure", ["at 19 s: flamer.burner[2] stuck"], LOCKED_OUT),
    ("FlamerSilent", ["at 20 s: flamer silent for 5 s"], PASSED),
    ("ChangeBurnersFailure", ["at 19 s: flamer.burner slow for 35 s"], REPAIRED),
    ("FlamerFrozen", ["at 20 s: flamer frozen for 5 s"], PASSED),
    ("FlamerFrozen", ["at 20 s: flamer wrong counter for 5 s"], PASSED),
    ("FlamerCommandsLost", ["at 20 s: mission silent for 3 s"], PASSED),
    ("FlameWithValveClosed", ["at 65 s: flamer.flame_sensor stuck on"], ["raised"]),
    ("FlameWithValveClosed", ["at 50 s: flamer.gas_valve leaks"], ["raised"]),
    ("GasValveLeaks", ["at 50 s: flamer.gas_valve leaks"], ["raised"]),
    ("GasValveNotClosed", ["at 50 s: flamer.gas_valve stuck open"], ["raised"]),
    ("GasValveNotOpened", ["at 1 s: flamer.gas_valve stuck closed for 3 s"], PASSED),
    ("BottleEmpty", ["at 20 s: flamer.bottle empty"], ["raised"]),
    ("BottleEmpty", ["at 20 s: flamer.bottle empty", "at 40 s: flamer.bottle changed"], PASSED),
    ("BottleEmpty", ["at 20 s: flamer.bottle_sensor drifts down for 40 s"], PASSED),
    ("BottleLow", ["at 20 s: flamer.bottle empty", "at 40 s: flamer.bottle changed"], PASSED),
    ("PilotFlameTooOften", [f"at {10 + 40 * n} s: flamer.pilot blown out" for n in range(3)], PASSED),
]


@pytest.mark.parametrize(("alarm", "faults", "life"), [proves({row[0]: row[2]}, *row) for row in TABLE],
                         ids=[f"{alarm}: {', '.join(faults)}" for alarm, faults, _ in TABLE])
def test_each_fault_raises_its_alarm(catalog: Catalog, alarm: str, faults: list[str], life: list[str]) -> None:
    often = alarm == "PilotFlameTooOften"
    orders = ["at 2 s: flaming on", "at 20 s: burner high", *([] if often else ["at 60 s: flaming off"])]
    assert field(catalog, *faults, orders=orders, duration="12 min" if often else "3 min").run().life(alarm) == life


LATCHED = [("FlameWithValveClosed", "at 65 s: flamer.flame_sensor stuck on for 20 s"),
           ("GasValveNotClosed", "at 50 s: flamer.gas_valve stuck open for 30 s"),
           ("GasValveLeaks", "at 50 s: flamer.gas_valve leaks for 30 s")]


@pytest.mark.parametrize(("alarm", "fault"), [proves({alarm: PASSED}, alarm, fault) for alarm, fault in LATCHED],
                         ids=[alarm for alarm, _ in LATCHED])
def test_what_may_have_let_gas_out_stays_until_someone_has_looked_and_acknowledged(
        catalog: Catalog, alarm: str, fault: str) -> None:
    mission = field(catalog, fault, orders=["at 2 s: flaming on", "at 20 s: burner high", "at 60 s: flaming off"]).run(150)
    assert mission.life(alarm) == ["raised"]
    mission._deliver(mission.supervisor.command(Order("1", "acknowledge", alarm, origin="local"), mission.simulation.now_ns))
    assert mission.run().life(alarm) == ["raised", "acknowledged", "cleared"]


def test_every_alarm_of_the_definition_is_raised_by_some_fault(catalog: Catalog) -> None:
    covered = {alarm for alarm, _, _ in TABLE} | {"PilotFlameOut", "PilotIgnitionFailure"}
    assert set(catalog.alarms) == covered


@pytest.mark.parametrize("fault", [
    "at 1 s: flamer refuses start for 2 commands", "at 19 s: flamer.burner[2] stuck for 1 commands",
    "at 59 s: flamer refuses stop for 2 commands", "at 20 s: flamer silent for 600 ms", "at 20 s: flamer babbling for 20 s",
    "at 20 s: mission silent for 250 ms"])
def test_what_is_within_the_response_times_raises_nothing(catalog: Catalog, fault: str) -> None:
    orders = ["at 2 s: flaming on", "at 20 s: burner high", "at 60 s: flaming off"]
    assert field(catalog, fault, orders=orders).run().events == []


@pytest.mark.covers("ChangeBurnersFailure", "locked_out", "cleared")
@pytest.mark.covers("FlamingStartStopFailure", "locked_out", "cleared")
def test_a_locked_out_burner_or_start_can_be_reset_and_works_again(catalog: Catalog) -> None:
    for alarm, fault in (("ChangeBurnersFailure", "at 19 s: flamer.burner[2] stuck for 30 s"),
                         ("FlamingStartStopFailure", "at 1 s: flamer refuses start for 30 s")):
        mission = field(catalog, fault, orders=["at 2 s: flaming on", "at 20 s: burner high", "at 90 s: flaming on"]).run(80)
        assert mission.life(alarm)[-1] == "locked_out"
        assert not mission.tool.plant.flame
        mission.reset(alarm)
        assert mission.run().life(alarm)[-1] == "cleared"
        assert mission.tool.plant.flame
        assert mission.tool.hazards == []


def test_nothing_is_lit_while_a_burner_stays_open_and_its_lock_out_can_not_be_reset(catalog: Catalog) -> None:
    orders = ["at 2 s: flaming on", "at 20 s: burner high", "at 60 s: flaming off", "at 80 s: flaming on", "at 150 s: flaming on"]
    mission = field(catalog, "at 59 s: flamer.burner[2] stuck for 70 s", orders=orders, duration="4 min").run(75)
    assert mission.life("ChangeBurnersFailure") == LOCKED_OUT
    mission.reset("ChangeBurnersFailure")
    assert mission.run(128).life("ChangeBurnersFailure") == LOCKED_OUT, "refused while it is open"
    assert not mission.tool.plant.flame
    mission.run(140)
    mission.reset("ChangeBurnersFailure")
    assert mission.run().life("ChangeBurnersFailure")[-1] == "cleared"
    assert mission.tool.plant.flame
    assert mission.tool.hazards == []


def test_a_flame_that_goes_out_is_not_lit_again_over_a_burner_that_stays_open(catalog: Catalog) -> None:
    out = field(catalog, "at 29 s: flamer.burner[2] stuck", "at 30 s: flamer.pilot blown out",
                orders=["at 2 s: flaming on", "at 20 s: burner high"], duration="4 min").run()
    assert "raised" in out.life("ChangeBurnersFailure")
    assert "repaired" not in out.life("PilotFlameOut")
    assert not out.tool.plant.flame
    assert out.tool.hazards == []


@pytest.mark.parametrize("fault", [
    "at 30 s: flamer.gas_valve stuck open", "at 30 s: flamer.gas_valve leaks", "at 30 s: flamer.flame_sensor stuck on"])
def test_nothing_is_lit_with_a_valve_or_sensor_that_can_not_be_trusted(catalog: Catalog, fault: str) -> None:
    lost = field(catalog, fault, "at 31 s: flamer.pilot blown out", duration="10 min").run()
    assert not any("spark" in hazard.what or "lit" in hazard.what for hazard in lost.tool.hazards)
    assert not lost.tool.plant.flame


@pytest.mark.parametrize("fault", ["mission ignores repairs", "mission frozen"])
def test_a_mission_controller_that_sends_on_during_a_repair_causes_no_hazard(catalog: Catalog, fault: str) -> None:
    rude = field(catalog, f"at 11 s: {fault}", "at 12 s: flamer.pilot blown out",
                 "at 60 s: flamer.igniter dead", "at 61 s: flamer.pilot blown out", duration="6 min").run()
    assert rude.tool.hazards == []


def test_an_unarmed_repair_lights_nothing(catalog: Catalog) -> None:
    passive = field(catalog, "at 12 s: flamer.pilot blown out", armed=[]).run()
    assert passive.life("PilotFlameOut") == ["raised", "repair_started"]
    assert passive.events[1].passive
    assert not passive.tool.plant.flame


def test_level_1_that_dies_in_the_middle_of_a_repair_leaves_the_valve_closed(catalog: Catalog) -> None:
    lost = field(catalog, "at 12 s: flamer.pilot blown out").run(40)
    while lost.tool.safeguard.valve == "Closed":
        lost.run(lost.simulation.now_ns / SECOND + 0.1)
    lost.simulation.detach(lost.unit)
    lost.run(lost.simulation.now_ns / SECOND + 0.5)
    assert lost.tool.safeguard.valve == "Closed"
    assert not lost.run().tool.plant.flame, "the mission controller waits until the alarm is over"


@pytest.mark.parametrize("seed", range(2))
def test_hours_of_gusts_cause_no_hazard_and_only_the_alarms_of_wind(catalog: Catalog, seed: int) -> None:
    orders = ["at 2 s: flaming on", "at 5 s: burner high", "at 30 min: flaming off", "at 32 min: flaming on"]
    text = (f'duration = "50 min"\norders = {orders}\n'
            + NODES.replace('flaming_tool"\n', 'flaming_tool"\nwind = "5 m/s"\ngust = "15 m/s"\ngust_every = "4 min"\n'))
    storm = Field(catalog, text, seed=seed)
    while storm.simulation.now_ns < storm.scenario.duration_ns:
        storm.run(storm.simulation.now_ns / SECOND + 300)
        if storm.supervisor.alarm_states()["PilotFlameOut"] != NORMAL:
            storm.reset("PilotFlameOut")
    assert storm.life("PilotFlameOut").count("raised") > 2
    assert storm.raised <= {"PilotFlameOut", "PilotFlameTooOften", "PilotIgnitionFailure", "BottleLow", "BottleEmpty"}
    assert storm.tool.hazards == []


# --- the command --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENARIOS)
def test_each_shipped_scenario_runs_and_tells(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert load(name).title
    assert main(["simulate", name, "--duration", "65 s"]) == 0
    out, err = capsys.readouterr()
    assert "pilot flame burns" in out
    assert out.splitlines()[-1].startswith("    65.000 s  end: ")
    assert "× real time" in err


def test_the_scenario_that_the_help_teaches_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.toml").write_text(EXAMPLE)
    assert main(["simulate", str(tmp_path / "own.toml"), "--duration", "22 s"]) == 0
    assert "pilot flame out: blown out" in capsys.readouterr().out


def test_a_blown_out_flame_is_told_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    main(["simulate", "windy.toml", "--duration", "15 s"])
    out = capsys.readouterr().out
    words = ["igniter sparks", "gas valve opens", "pilot flame burns", "flamer     flaming on", "fault: pilot blown out",
             "pilot flame out: blown out", "safeguard closes the gas valve: flame lost", "gas valve closed"]
    positions = [out.index(word) for word in words]
    assert positions == sorted(positions)
    assert "    12.000 s  flamer     pilot flame out: blown out" in out


def test_two_runs_give_the_same_bytes_and_another_seed_does_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def run(name: str, *more: str) -> tuple[str, bytes]:
        assert main(["simulate", "windy.toml", "--log", str(tmp_path / name), *more]) == 0
        return capsys.readouterr().out, (tmp_path / name).read_bytes()
    assert run("a.log") == run("b.log")
    assert run("c.log", "--seed", "8")[1] != run("d.log")[1]


def test_the_log_is_a_candump_file(tmp_path: Path) -> None:
    log = tmp_path / "out.log"
    assert main(["simulate", "healthy.toml", "--duration", "10 s", "--log", str(log)]) == 0
    messages = list(can.LogReader(str(log)))
    assert {message.arbitration_id for message in messages} == {0x110, 0x210, 0x211, 0x410}
    assert [message.timestamp for message in messages] == sorted(message.timestamp for message in messages)
    assert messages[0].channel == "vcan0"
    assert not messages[0].is_extended_id


@pytest.mark.parametrize(("words", "error"), [
    (["nosuch.toml"], "nosuch.toml: there is no such scenario; "),
    (["windi.toml"], 'did you mean "windy.toml"?'),
    ([], "simulate needs a scenario"),
    (["windy.toml", "--duration", "soon"], "--duration: 'soon' should be a duration"),
    (["windy.toml", "--node", "flamr"], 'no node "flamr" in windy.toml; did you mean "flamer"?'),
    (["windy.toml", "--log", "/nonexistent/out.log"], "/nonexistent/out.log: there is no folder /nonexistent"),
    (["windy.toml", "--bus", "nosuch0"], "bus nosuch0: th"),
    (["windy.toml", "--interface", "nosuch", "--channel", "1"], 'bus nosuch:1: no interface is called "nosuch"; known: '),
    (["windy.toml", "--bus", "vcan0", "--channel", "1"], "not both"),
])
def test_what_stands_in_the_way_is_one_line_and_code_2(words: list[str], error: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", *words]) == 2
    err = capsys.readouterr().err
    assert error in err
    assert err.startswith("ucs: ")
    assert "Traceback" not in err


def test_all_mistakes_of_a_scenario_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "bad.toml"
    file.write_text('sede = 1\nfaults = ["at 1 s: flmer silent", "at x: flamer silent"]\n' + NODES)
    assert main(["simulate", str(file)]) == 2
    err = capsys.readouterr().err
    assert err.count("ucs: ") == 3
    assert "bad.toml:1: unknown key" in err
    assert 'did you mean "flamer"?' in err


def test_a_file_that_is_no_text_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "junk.toml"
    file.write_bytes(b"\xff\xfe\x00")
    assert main(["simulate", str(file)]) == 2
    assert "not a text in UTF-8" in capsys.readouterr().err


def test_the_list_shows_scenarios_and_what_they_can_say(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--list"]) == 0
    out = capsys.readouterr().out
    for words in (*SCENARIOS, "NODE.pilot blown out", "flaming on", "gust_every", "NODE ignores repairs"):
        assert words in out


def test_nodes_run_in_real_time_on_a_bus_of_python_can(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "healthy.toml", "--interface", "virtual", "--channel", "test", "--duration", "300 ms"]) == 0
    assert "end: " in capsys.readouterr().out


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_it_stops_cleanly_when_told_to(number: signal.Signals, code: int, tmp_path: Path) -> None:
    log = tmp_path / "out.log"
    process = subprocess.Popen(
        [sys.executable, "-m", "ucs", "simulate", "healthy.toml", "--interface", "virtual", "--channel", "test", "--log", str(log)],
        cwd=ROOT, env={**os.environ, "PYTHONUNBUFFERED": "1"}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == code
    assert "end: " in out
    assert "Traceback" not in err
    assert log.read_bytes().endswith(b"\n")
