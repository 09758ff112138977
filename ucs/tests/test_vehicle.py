"""The vehicle under level 1, in virtual time: a healthy mission raises nothing, each fault its alarm; orders reach the brakes."""
from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from random import Random

import pytest
import serial

from firmware_py.drive import KMH
from firmware_py.field import CELL_M, LENGTH_M, Pose, WeedMap, paper_map, to_degrees
from firmware_py.scenario import build, parse
from firmware_py.sprayer_boom import SprayerBoom
from firmware_py.vehicle import UTC_START_NS, Vehicle
from firmware_py.vehicle_mission import VehicleMission
from firmware_py.virtual_bus import Simulation
from level1.catalog import Catalog
from level1.command import Order
from level1.event import Event, Monitor, Output, Result
from level1.io import definitions
from level1.navigation import FIXES
from level1.nmea import Navigator
from level1.supervisor import Supervisor
from ucs.main import main
from ucs.nmea_line import nmea_line
from ucs.simulate import SHIPPED, load
from ucs.simulated_unit import SimulatedUnit
from ucs.tests.proof import proves

SECOND = 1_000_000_000
FILES = ("vehicle.dbc", "isobus_tractor.dbc", "ucs.dbc")
NODES = '[nodes.tractor]\nprogram = "vehicle"\n{}\n[nodes.mission]\nprogram = "vehicle_mission"\n'
WORK = ("at 1 s: mission start", "at 1 s: pto on", "at 1 s: hitch by path", "at 1 s: implement set")


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(FILES)


class Farm:
    """Tractor, mission controller and level 1. events: what level 1 reported; results: of orders."""

    def __init__(self, catalog: Catalog, text: str, armed: Sequence[str] | None = None, monitor_ns: int | None = None):
        self.scenario = parse(text, "test.toml")
        self.cast = cast = build(self.scenario)
        self.events: list[Event] = []
        self.results: list[Result] = []
        self.monitors: list[Monitor] = []
        self.told: list[str] = []
        self.supervisor = Supervisor(catalog, unit="tractor-7", start_ns=0, armed=armed, monitor_ns=monitor_ns)
        self.unit = SimulatedUnit(self.supervisor, self._deliver)
        self.simulation = Simulation([*cast.participants, self.unit], on_happening=lambda said: self.told.append(said.text))
        tractor = cast.nodes["tractor"]
        assert isinstance(tractor, Vehicle)
        self.tractor = tractor

    def _deliver(self, outputs: Sequence[Output]) -> None:
        self.events += [output for output in outputs if isinstance(output, Event)]
        self.monitors += [output for output in outputs if isinstance(output, Monitor)]
        self.results += [output for output in outputs if isinstance(output, Result)]

    def run(self, until_s: float | None = None) -> Farm:
        """Up to a time, or to the scenario's end."""
        self.simulation.run(self.scenario.duration_ns if until_s is None else round(until_s * SECOND))
        return self

    def order(self, name: str, target: str = "", value: str | None = None, origin: str = "above") -> str:
        """An order; gives why it was refused, or nothing."""
        number = Decimal(value) if value is not None else None
        order = Order("1", name, target, number, origin="local" if origin == "local" else "above")
        self.unit._take(self.supervisor.command(order, self.simulation.now_ns))
        return self.results[-1].reason

    def life(self, alarm: str) -> list[str]:
        """What was reported of an alarm."""
        return [event.event for event in self.events if event.alarm == alarm]

    @property
    def raised(self) -> set[str]:
        """Alarms that were raised at all."""
        return {event.alarm for event in self.events if event.event == "raised"}

    @property
    def kmh(self) -> float:
        """How fast it drives."""
        return self.tractor.drive.speed_m_s * KMH


def farm(catalog: Catalog, *faults: str, orders: Sequence[str] = WORK, duration: str = "2 min", settings: str = "",
         armed: Sequence[str] | None = None) -> Farm:
    """A mission with faults. settings: further lines of the tractor's table."""
    head = f'duration = "{duration}"\norders = {list(orders)}\nfaults = {list(faults)}\n'
    return Farm(catalog, head + NODES.format(settings), armed)


# --- missions -----------------------------------------------------------------------------------------------------------------


@pytest.mark.covers("MissionFinished", "raised")
def test_a_healthy_mission_raises_nothing_but_that_it_is_finished(catalog: Catalog) -> None:
    done = farm(catalog, duration="10 min", orders=(*WORK, "at 9 min: pto off", "at 9 min: implement unset")).run()
    assert [(event.alarm, event.event) for event in done.events] == [("MissionFinished", "raised")]
    assert done.tractor.drive.passage == 7
    assert done.tractor.controller == "Ready"


@pytest.mark.covers("MissionFinished", "raised", "cleared")
def test_the_next_mission_ends_that_the_last_one_is_finished(catalog: Catalog) -> None:
    twice = farm(catalog, "at 2 min: tractor.path loaded", settings='passes = "1 passes"', duration="4 min",
                 orders=(*WORK, "at 2 min: mission start")).run()
    assert twice.life("MissionFinished") == ["raised", "cleared", "raised"]
    assert twice.raised == {"MissionFinished"}


@pytest.mark.parametrize("name", sorted(file.name for file in SHIPPED.glob("vehicle_*.toml")))
def test_each_shipped_scenario_of_the_vehicle_runs(catalog: Catalog, name: str) -> None:
    assert load(name).title
    shown = Farm(catalog, (SHIPPED / name).read_text("utf-8")).run(30)
    assert "executing" in shown.told


def test_the_sprayer_boom_behind_it_follows_the_weed_map_without_an_alarm() -> None:
    """The paper's mission: valves lag up to 2 s, and nothing is raised but what is no fault."""
    catalog = definitions.load([*FILES, "sprayer_boom.dbc"])
    mission = Farm(catalog, (SHIPPED / "vehicle_sprayer.toml").read_text("utf-8"))
    boom = mission.cast.nodes["sprayer"]
    assert isinstance(boom, SprayerBoom)
    weeds = paper_map()
    treated: set[tuple[int, int]] = set()
    wasted: set[tuple[int, int]] = set()
    while mission.simulation.now_ns < mission.scenario.duration_ns:
        mission.run(mission.simulation.now_ns / SECOND + 0.1)
        for cell, has_weed in cells_under(boom, mission.tractor.drive.pose, weeds):
            (treated if has_weed else wasted).add(cell)
    assert {event.alarm for event in mission.events} == {"BoomMoving", "MissionFinished"}
    number = sum(sum(row) for row in weeds.cells)
    assert len(treated) > 0.85 * number
    assert len(wasted) < 0.3 * number


def test_a_stuck_valve_of_the_boom_is_told_and_the_mission_goes_on() -> None:
    catalog = definitions.load([*FILES, "sprayer_boom.dbc"])
    text = (SHIPPED / "vehicle_sprayer.toml").read_text("utf-8")
    stuck = Farm(catalog, 'faults = ["at 25 s: sprayer.valve[7] stuck closed"]\n' + text).run(150)
    assert "raised" in stuck.life("ChangeNozzlesFailure") + stuck.life("Section7NotSet")
    assert stuck.raised <= {"BoomMoving", "ChangeNozzlesFailure", "Section7NotSet"}
    assert stuck.tractor.controller == "Executing"


def cells_under(boom: SprayerBoom, pose: Pose, weeds: WeedMap) -> Iterator[tuple[tuple[int, int], bool]]:
    """Cells under open sections, 2 m behind the antenna, and whether there is weed."""
    heading = math.radians(pose.heading_deg)
    for section, is_open in enumerate(boom.sections_open, 1):
        right_m = (section - 6.5) * CELL_M
        x_m = pose.x_m - 2 * math.sin(heading) + math.cos(heading) * right_m
        y_m = pose.y_m - 2 * math.cos(heading) - math.sin(heading) * right_m
        if is_open and 0 <= y_m < LENGTH_M:
            yield (int(x_m / CELL_M), int(y_m / CELL_M)), weeds.weed(x_m, y_m)


@pytest.mark.parametrize("seed", [0, 1, 2, 17, 21, 27, 33, 36])
def test_no_sequence_of_orders_raises_an_alarm_of_a_healthy_vehicle(catalog: Catalog, seed: int) -> None:
    """Whoever orders what and when, down to the tenth of a second: a stop is told, and nothing else."""
    dice = Random(seed)
    orders, faults, t_s = [], [], 0.0
    while t_s < 150:
        device, action = dice.choice([(phrase.device, phrase.action) for phrase in VehicleMission.ORDERS])
        orders.append(f"at {t_s:.1f} s: {device} {action}")
        if dice.random() < 0.1:
            faults.append(f"at {t_s:.1f} s: tractor manual for 5 s")
        if dice.random() < 0.1:
            faults.append(f"at {t_s:.1f} s: tractor.stop_switch pressed for 4 s")
        if dice.random() < 0.1:
            faults.append(f"at {t_s:.1f} s: tractor.start_button pressed")
        t_s += dice.choice([0.1, 0.3, 1.0, 4.0, 12.0])
    busy = farm(catalog, *faults, orders=orders, duration="3 min").run()
    assert busy.raised <= {"UnitStopped"}


# --- monitoring ---------------------------------------------------------------------------------------------------------------


@pytest.mark.covers("monitoring: vehicle controller")
@pytest.mark.covers("monitoring: vehicle motion")
def test_monitoring_tells_controller_and_motion_every_250_ms_and_a_lost_position_has_no_value(catalog: Catalog) -> None:
    text = f'orders = {list(WORK)}\nfaults = ["at 20 s: tractor.gnss lost"]\n' + NODES.format("")
    seen = Farm(catalog, text, monitor_ns=SECOND // 4).run(15)

    def last(message: str) -> dict[str, object]:
        sample = [monitor for monitor in seen.monitors if monitor.message == message][-1]
        return {name.rpartition(".")[2]: value for name, value in sample.values.items()}
    times = [monitor.t for monitor in seen.monitors if monitor.message == "controller"]
    assert {after - before for before, after in itertools.pairwise(times)} == {Decimal("0.25")}
    assert last("controller")["Controller"] == "Executing"
    motion = last("motion")
    pose = seen.tractor.drive.pose
    latitude, longitude = to_degrees(pose.x_m, pose.y_m)
    assert motion["PositionLatitude"] == pytest.approx(latitude, abs=2e-6)
    assert motion["PositionLongitude"] == pytest.approx(longitude, abs=2e-6)
    assert (motion["DriveSpeed"], motion["DriveHeading"], motion["PtoState"], motion["HitchPosition"]) == (3, 0, "On", 0)
    seen.run(25)
    assert last("motion")["PositionLatitude"] is None
    assert last("motion")["PositionFix"] == "NoFix"


# --- each fault, its alarm, its repair, its end -------------------------------------------------------------------------------

REPAIRED = ["raised", "repair_started", "repaired", "cleared"]
LOCKED = ["raised", *["repair_started", "repair_failed"] * 2, "locked_out"]
TABLE: list[tuple[str, list[str], list[str], set[str] | None]] = [
    ("UnitNotMoving", ["at 20 s: tractor.engine dies"], ["raised"], {"UnitNotMoving"}),
    ("UnitNotMoving", ["at 20 s: tractor.wheels blocked for 8 s"], ["raised", "cleared"], {"UnitNotMoving"}),
    ("UnitNotMoving", ["at 20 s: tractor.wheels blocked"], ["raised"], {"UnitNotMoving"}),
    ("UnitStopped", ["at 20 s: tractor.stop_switch pressed for 5 s"], ["raised"], {"UnitStopped"}),
    ("HitchNotMoving", ["at 0 s: tractor.hitch stuck for 1 command"], REPAIRED, {"HitchNotMoving"}),
    ("HitchNotMoving", ["at 0 s: tractor.hitch stuck for 2 commands"],
     ["raised", "repair_started", "repair_failed", "repair_started", "repaired", "cleared"], {"HitchNotMoving"}),
    ("HitchNotMoving", ["at 0 s: tractor.hitch stuck"], LOCKED, {"HitchNotMoving"}),
    ("PtoNotSet", ["at 0 s: tractor.pto refuses for 1 command"], REPAIRED, {"PtoNotSet", "RearPtoNotEngaging"}),
    ("PtoNotSet", ["at 0 s: tractor.pto refuses"], LOCKED, {"PtoNotSet", "RearPtoNotEngaging"}),
    ("PtoNotUnset", ["at 50 s: tractor.pto stays on for 2 commands"],
     ["raised", "repair_started", "repair_failed", "repair_started", "repaired", "cleared"], {"PtoNotUnset"}),
    ("PtoNotUnset", ["at 50 s: tractor.pto stays on"],
     ["raised", *["repair_started", "repair_failed"] * 3, "locked_out"], {"PtoNotUnset"}),
    ("ImplementSetUnsetFailure", ["at 0 s: tractor.implement refuses for 1 command"], REPAIRED, {"ImplementSetUnsetFailure"}),
    ("ImplementSetUnsetFailure", ["at 50 s: tractor.implement refuses for 1 command"], REPAIRED, {"ImplementSetUnsetFailure"}),
    ("ImplementSetUnsetFailure", ["at 0 s: tractor.implement refuses"],
     ["raised", *["repair_started", "repair_failed"] * 3, "locked_out"], {"ImplementSetUnsetFailure"}),
    ("ImplementSetUnsetFailure", ["at 0 s: tractor.implement slow for 40 s"], REPAIRED, {"ImplementSetUnsetFailure"}),
    ("VehicleSilent", ["at 20 s: tractor silent for 5 s"], ["raised", "cleared"], None),
    ("VehicleFrozen", ["at 20 s: tractor frozen for 5 s"], ["raised", "cleared"], {"VehicleFrozen", "VehicleCommandsLost"}),
    ("VehicleFrozen", ["at 20 s: tractor wrong counter for 5 s"], ["raised", "cleared"], {"VehicleFrozen"}),
    ("VehicleCommandsLost", ["at 20 s: mission silent for 3 s"], ["raised"], {"VehicleCommandsLost"}),
    ("VehicleCommandsLost", ["at 20 s: mission frozen for 3 s"], ["raised"], {"VehicleCommandsLost"}),
    ("PositionLost", ["at 20 s: tractor.gnss lost for 10 s"], ["raised", "cleared"], {"PositionLost"}),
    ("PositionInaccurate", ["at 20 s: tractor.gnss float for 20 s"], ["raised", "cleared"], {"PositionInaccurate"}),
    ("OilPressureSensorFault", ["at 20 s: tractor.oil_sensor unplugged for 20 s"], ["raised", "cleared"],
     {"OilPressureSensorFault", "EngineWarningLamp", "TroubleCode"}),
    ("TroubleCode", ["at 20 s: tractor.oil_sensor unplugged for 20 s"], ["raised", "cleared"],
     {"OilPressureSensorFault", "EngineWarningLamp", "TroubleCode"}),
    ("CoolantHot", ["at 5 s: tractor.coolant leaks for 90 s"], ["raised", "cleared"], {"CoolantHot", "CoolantCritical"}),
    ("ChargingVoltageLow", ["at 20 s: tractor.alternator dead for 40 s"], ["raised", "cleared"], {"ChargingVoltageLow"}),
]


@pytest.mark.parametrize(("alarm", "faults", "life", "others"), [proves({row[0]: row[2]}, *row) for row in TABLE],
                         ids=[f"{alarm}: {', '.join(faults)}" for alarm, faults, *_ in TABLE])
def test_each_fault_raises_its_alarm_and_no_other(catalog: Catalog, alarm: str, faults: list[str], life: list[str],
                                                  others: set[str] | None) -> None:
    orders = (*WORK, "at 51 s: pto off", "at 51 s: implement unset")
    seen = farm(catalog, *faults, orders=orders, duration="4 min" if "Coolant" in alarm else "2 min").run()
    assert seen.life(alarm) == life
    if others is not None:
        assert seen.raised - {"MissionFinished"} == others


def test_every_alarm_of_the_definition_is_raised_by_some_fault() -> None:
    assert set(definitions.load(["vehicle.dbc"]).alarms) <= {alarm for alarm, *_ in TABLE} | {"MissionFinished"}


@pytest.mark.parametrize("fault", [
    "at 20 s: tractor silent for 600 ms", "at 20 s: mission silent for 300 ms", "at 20 s: tractor.gnss lost for 300 ms",
    "at 0 s: tractor.hitch slow", "at 20 s: tractor babbling for 5 s", "at 20 s: tractor.gnss drifts for 20 s",
    "at 20 s: tractor.wheels blocked for 2 s", "at 20 s: tractor.gnss float for 3 s"])
def test_what_is_within_the_allowances_raises_nothing(catalog: Catalog, fault: str) -> None:
    assert farm(catalog, fault, duration="1 min").run().events == []


def test_a_receiver_that_comes_back_last_is_not_silent(catalog: Catalog) -> None:
    """The engine's speed is known again a moment before the position is."""
    assert "PositionSilent" not in farm(catalog, "at 20 s: tractor silent for 20 s", duration="1 min").run().raised


@pytest.mark.covers("VehicleCommandsLost", "raised", "cleared")
def test_a_mission_controller_that_is_back_resumes_and_nothing_is_lost_any_more(catalog: Catalog) -> None:
    unit = farm(catalog, "at 20 s: mission silent for 3 s", orders=(*WORK, "at 30 s: mission resume"), duration="40 s").run(28)
    assert unit.life("VehicleCommandsLost") == ["raised"]
    assert unit.tractor.controller == "Paused"
    assert unit.run().life("VehicleCommandsLost") == ["raised", "cleared"]
    assert unit.kmh == pytest.approx(3)


def test_a_reset_of_the_vehicles_computer_brakes_and_switches_off(catalog: Catalog) -> None:
    reset = farm(catalog, "at 20 s: tractor reset").run(26)
    assert reset.kmh == 0
    assert reset.tractor.controller == "Ready"
    assert reset.tractor.pto.state in ("Off", "RunningDown")
    assert reset.raised <= {"VehicleSilent"}


@pytest.mark.covers("UnitStopped", "raised", "cleared")
def test_a_stop_by_switch_is_ended_at_the_machine_and_clears(catalog: Catalog) -> None:
    faults = ("at 20 s: tractor.stop_switch pressed for 5 s", "at 40 s: tractor.start_button pressed")
    unit = farm(catalog, *faults, orders=(*WORK, "at 45 s: mission start")).run(30)
    unit.order("resume")
    assert unit.run(35).tractor.controller == "Stopped", "not from above"
    assert unit.run(60).life("UnitStopped") == ["raised", "cleared"]
    assert unit.kmh == pytest.approx(3)


# --- the interlock: nothing moves while somebody may be near ------------------------------------------------------------------


@pytest.mark.parametrize("who", ["at 9 s: tractor manual", "at 9 s: tractor.stop_switch pressed"])
@pytest.mark.parametrize("fault", ["pto refuses", "implement refuses", "hitch stuck"])
def test_no_repair_moves_anything_while_somebody_may_be_near(catalog: Catalog, who: str, fault: str) -> None:
    near = farm(catalog, f"at 0 s: tractor.{fault} for 9 s", who, duration="1 min").run(9.2)
    position = near.tractor.hitch.position
    near.run()
    assert near.tractor.pto.clutch.position == "Off"
    assert near.tractor.implement.position == "Unset"
    assert near.tractor.hitch.position == position
    assert "repaired" not in {event.event for event in near.events}


@pytest.mark.parametrize("order", ["pause", "stop"])
def test_no_repair_begins_while_the_unit_is_paused_or_stopped_from_above(catalog: Catalog, order: str) -> None:
    held = farm(catalog, "at 0 s: tractor.pto refuses").run(5)
    assert held.order(order) == ""
    held.run()
    assert "repair_started" not in held.life("PtoNotSet")
    assert held.tractor.pto.clutch.position == "Off"


def test_a_pto_that_does_not_let_go_is_switched_off_again_even_when_stopped(catalog: Catalog) -> None:
    runs = farm(catalog, "at 10 s: tractor.pto stays on for 2 commands").run(20)
    assert runs.order("stop") == ""
    assert runs.run().life("PtoNotUnset")[-1] == "cleared"
    assert runs.tractor.pto.state == "Off"


def test_after_a_stop_pto_and_implement_stay_off_until_ordered_anew(catalog: Catalog) -> None:
    stopped = farm(catalog, orders=(*WORK, "at 40 s: mission start", "at 60 s: pto on")).run(20)
    stopped.order("stop")
    stopped.run(30)
    assert stopped.order("resume", origin="local") == ""
    stopped.run(55)
    assert stopped.tractor.controller == "Executing"
    assert stopped.tractor.pto.state == "Off"
    assert stopped.tractor.implement.position == "Unset"
    assert stopped.run(70).tractor.pto.state == "On"


@pytest.mark.covers("PtoNotSet", "locked_out", "cleared")
def test_a_lock_out_pauses_the_mission_and_can_be_reset(catalog: Catalog) -> None:
    orders = (*WORK, "at 90 s: mission resume", "at 95 s: pto on")
    locked = farm(catalog, "at 0 s: tractor.pto refuses for 60 s", orders=orders).run(70)
    assert locked.life("PtoNotSet")[-1] == "locked_out"
    assert locked.tractor.controller == "Paused"
    locked.order("reset", "PtoNotSet", origin="local")
    locked.run()
    assert locked.life("PtoNotSet")[-1] == "cleared"
    assert locked.tractor.pto.state == "On"


@pytest.mark.covers("PtoNotUnset", "locked_out", "cleared")
def test_a_shaft_that_did_not_stop_is_held_off_until_it_does_and_then_can_be_reset(catalog: Catalog) -> None:
    turns = farm(catalog, "at 10 s: tractor.pto stays on for 70 s", orders=(*WORK, "at 20 s: pto off", "at 100 s: mission resume"),
                 duration="2 min").run(70)
    assert turns.life("PtoNotUnset")[-1] == "locked_out"
    assert "PtoNotUnset" in turns.order("reset", "PtoNotUnset", origin="local"), "refused while the shaft turns"
    assert turns.run(90).tractor.pto.state == "Off"
    assert turns.life("PtoNotUnset")[-1] == "locked_out", "held until somebody says so"
    assert turns.order("reset", "PtoNotUnset", origin="local") == ""
    assert turns.run().life("PtoNotUnset")[-1] == "cleared"


# --- orders from above --------------------------------------------------------------------------------------------------------


def test_pause_and_resume_brake_and_go_on(catalog: Catalog) -> None:
    unit = farm(catalog).run(20)
    assert unit.kmh == pytest.approx(3)
    before_m = unit.tractor.drive.driven_m
    assert unit.order("pause") == ""
    unit.run(20.5)
    assert 0 < unit.kmh < 3, "it brakes, it does not jump"
    unit.run(22)
    assert unit.kmh == 0
    assert 0.3 < unit.tractor.drive.driven_m - before_m < 0.7
    assert unit.tractor.pto.state == "On"
    assert unit.order("resume") == ""
    assert unit.run(30).kmh == pytest.approx(3)
    assert unit.raised == set()


@pytest.mark.covers("UnitStopped", "raised", "cleared")
def test_stop_brakes_harder_and_is_released_at_the_machine_only(catalog: Catalog) -> None:
    unit = farm(catalog, orders=(*WORK, "at 40 s: mission start")).run(20)
    before_m = unit.tractor.drive.driven_m
    assert unit.order("stop") == ""
    unit.run(30)
    assert unit.tractor.drive.driven_m - before_m < 0.3
    assert unit.tractor.pto.state == "Off"
    assert unit.life("UnitStopped") == ["raised"]
    assert "at the machine" in unit.order("resume")
    assert unit.order("stop") == "", "a stop may be repeated"
    assert unit.order("resume", origin="local") == ""
    unit.run(50)
    assert unit.kmh == pytest.approx(3)
    assert unit.life("UnitStopped") == ["raised", "cleared"]


def test_reduced_speed_holds_through_a_pause_and_does_not_resume(catalog: Catalog) -> None:
    unit = farm(catalog).run(20)
    assert unit.order("reduce_speed", value="1.5") == ""
    assert unit.run(25).kmh == pytest.approx(1.5)
    unit.order("pause")
    unit.run(30)
    assert unit.order("reduce_speed", value="1") == ""
    assert unit.run(35).kmh == 0
    unit.order("resume")
    assert unit.run(40).kmh == pytest.approx(1)
    assert "outside" in unit.order("reduce_speed", value="7")


@pytest.mark.parametrize("order", ["pause", "stop"])
def test_stop_and_pause_go_through_in_the_middle_of_every_repair(catalog: Catalog, order: str) -> None:
    busy = farm(catalog, "at 0 s: tractor.pto refuses", "at 0 s: tractor.hitch stuck", "at 0 s: tractor.implement refuses").run(8)
    assert "repair_started" in {event.event for event in busy.events}
    assert busy.order(order) == ""
    assert busy.run(12).kmh == 0


# --- its GNSS receiver --------------------------------------------------------------------------------------------------------


def test_what_its_receiver_says_is_where_it_is(catalog: Catalog) -> None:
    navigator = Navigator()
    driving = farm(catalog, "at 40 s: tractor.gnss float for 10 s", "at 70 s: tractor.gnss lost")
    driving.tractor.nmea = lambda data: navigator.feed(driving.simulation.now_ns, data)
    for until_s, fix in ((30, "RtkFixed"), (45, "RtkFloat"), (65, "RtkFixed")):
        driving.run(until_s)
        said = navigator.navigation(driving.simulation.now_ns)
        pose = driving.tractor.drive.pose
        latitude, longitude = to_degrees(pose.x_m, pose.y_m)
        assert said.latitude_deg == pytest.approx(latitude, abs=2e-7)
        assert said.longitude_deg == pytest.approx(longitude, abs=2e-7)
        assert said.heading_deg == pytest.approx(pose.heading_deg, abs=0.01)
        assert said.speed_km_h == pytest.approx(driving.kmh, abs=0.01)
        assert said.fix is not None and FIXES[said.fix] == fix
        assert said.utc_ns is not None
        assert abs(said.utc_ns - UTC_START_NS - until_s * SECOND) <= SECOND // 5
    driving.run(80)
    assert navigator.navigation(driving.simulation.now_ns).latitude_deg is None
    assert set(navigator.counters) == {"sentences"}


def test_in_virtual_time_its_sentences_go_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "gnss.nmea"
    assert main(["simulate", "vehicle_healthy.toml", "--duration", "10 s", "--nmea", str(file)]) == 0
    sentences = file.read_bytes().split(b"\r\n")
    assert len(sentences) == 4 * 101 + 1
    assert all(len(sentence) <= 100 for sentence in sentences)


def test_on_a_bus_its_sentences_go_to_a_serial_line_that_can_be_opened(tmp_path: Path) -> None:
    line = tmp_path / "gnss"
    with nmea_line(line) as write:
        for _ in range(1000):
            write(b"$GNHDT,90.00,T*1A\r\n")
        with serial.serial_for_url(str(line), timeout=1) as port:
            port.reset_input_buffer()
            write(b"$GNHDT,91.00,T*1B\r\n")
            assert port.read_until() == b"$GNHDT,91.00,T*1B\r\n"
    assert not line.is_symlink()


@pytest.mark.parametrize(("name", "scenario", "error"), [
    ("new", "healthy.toml", "no node of this scenario has a GNSS receiver"),
    ("taken", "vehicle_healthy.toml", "there is something of that name already"),
    ("no/such/folder", "vehicle_healthy.toml", "No such file or directory")])
def test_a_line_that_can_not_be_made_is_one_line_and_code_2(tmp_path: Path, name: str, scenario: str, error: str,
                                                            capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").touch()
    bus = ["--interface", "virtual", "--channel", "nmea", "--duration", "1 s"]
    assert main(["simulate", scenario, "--nmea", str(tmp_path / name), *bus]) == 2
    assert error in capsys.readouterr().err
