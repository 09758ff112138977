"""The shipped sprayer boom under level 1: the mission over the field, each fault with its alarm, repair and end, interlocks."""
from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import pytest

from firmware_py.codec import Codec
from firmware_py.fault import WORKS
from firmware_py.field import CELL_M, LENGTH_M, paper_map
from firmware_py.participant import Happening
from firmware_py.path_driver import PathDriver
from firmware_py.scenario import build, parse
from firmware_py.sprayer_boom import SprayerBoom
from firmware_py.sprayer_plant import HIGHEST_BAR, SECTIONS, WaterLine
from firmware_py.virtual_bus import Simulation
from level1.catalog import LOCKED_OUT, NORMAL, Catalog
from level1.command import Order
from level1.event import Event, Monitor, Output, Result
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.main import main
from ucs.simulate import SHIPPED
from ucs.simulated_unit import SimulatedUnit
from ucs.tests.proof import proves

SECOND = 1_000_000_000
CODEC = Codec.shipped("sprayer_boom.dbc", "isobus_tractor.dbc")
SCENARIOS = sorted(file.name for file in SHIPPED.glob("sprayer_*.toml"))
NODES = '[nodes.sprayer]\nprogram = "sprayer_boom"\n{settings}\n[nodes.mission]\nprogram = "sprayer_mission"\n'
WORK = ("at 1 s: boom open", "at 2 s: spraying on", "at 3 s: section on")
"""With the boom unfolded at the start: all sections spray from about 5 s on."""
FOLDED, UNFOLDED = "", "boom_open = true"
SECTION_ALARMS = tuple(f"Section{n}NotSet" for n in range(1, SECTIONS + 1))
REPAIRED = ["raised", "repair_started", "repaired", "cleared"]


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["sprayer_boom.dbc"])


class Work:
    """A scenario with level 1 attached, in virtual time. events: of faults, that is without those of priority Event."""

    def __init__(self, catalog: Catalog, text: str, *, seed: int | None = None, armed: Sequence[str] | None = None,
                 monitor_ns: int | None = None):
        self.catalog = catalog
        self.scenario = parse(text, "test.toml")
        self.cast = build(self.scenario, seed=seed, codec=CODEC)
        self.outputs: list[Output] = []
        self.told: list[Happening] = []
        self.supervisor = Supervisor(catalog, unit="tractor-7", start_ns=0, armed=armed, monitor_ns=monitor_ns)
        self.unit = SimulatedUnit(self.supervisor, self.outputs.extend)
        self.simulation = Simulation([*self.cast.participants, self.unit], on_happening=self.told.append)
        sprayer = self.cast.nodes["sprayer"]
        assert isinstance(sprayer, SprayerBoom)
        self.sprayer = sprayer

    def run(self, until_s: float | None = None) -> Work:
        """Up to a time, or to the scenario's end."""
        self.simulation.run(self.scenario.duration_ns if until_s is None else round(until_s * SECOND))
        return self

    def order(self, name: str, alarm: str = "", origin: Literal["local", "above"] = "above") -> str:
        """An order to level 1; gives why it was refused, or an empty string."""
        before = len(self.outputs)
        self.unit.command(self.simulation.now_ns, Order("1", name, alarm, origin=origin))
        return next(output.reason for output in self.outputs[before:] if isinstance(output, Result))

    @property
    def happened(self) -> list[Event]:
        """All events."""
        return [output for output in self.outputs if isinstance(output, Event)]

    @property
    def events(self) -> list[Event]:
        """Events of faults."""
        return [event for event in self.happened if event.priority != "Event"]

    def life(self, alarm: str) -> list[str]:
        """What was reported of an alarm."""
        return [event.event for event in self.happened if event.alarm == alarm]

    @property
    def raised(self) -> set[str]:
        """Faults that were raised at all."""
        return {event.alarm for event in self.events}


def work(catalog: Catalog, *faults: str, orders: Sequence[str] = WORK, duration: str = "40 s", settings: str = UNFOLDED,
         seed: int = 1, armed: Sequence[str] | None = None) -> Work:
    """A boom with faults, without a field. settings: further lines of its table."""
    head = f'seed = {seed}\nduration = "{duration}"\norders = {list(orders)}\nfaults = {list(faults)}\n'
    return Work(catalog, head + NODES.format(settings=settings), armed=armed)


# --- the mission over the field -----------------------------------------------------------------------------------------------


class Sprayed:
    """What the boom does where: fed with the moments of a run."""

    def __init__(self) -> None:
        self.map = paper_map()
        self.treated: set[tuple[int, int]] = set()
        self.wasted: set[tuple[int, int]] = set()

    def look(self, driver: PathDriver, boom: SprayerBoom) -> None:
        """Note the cells under open sections."""
        heading = math.radians(driver.pose.heading_deg)
        x_m, y_m = driver.pose.x_m - 2 * math.sin(heading), driver.pose.y_m - 2 * math.cos(heading)
        for section, is_open in enumerate(boom.sections_open, 1):
            right_m = (section - 6.5) * CELL_M
            place = x_m + math.cos(heading) * right_m, y_m - math.sin(heading) * right_m
            if is_open and 0 <= place[1] < LENGTH_M:
                cells = self.treated if self.map.weed(*place) else self.wasted
                cells.add((int(place[0] / CELL_M), int(place[1] / CELL_M)))


@pytest.fixture(scope="module")
def mission(catalog: Catalog) -> tuple[Work, Sprayed]:
    """The shipped mission over the whole field."""
    whole = Work(catalog, (SHIPPED / "sprayer_mission.toml").read_text("utf-8"), monitor_ns=SECOND // 4)
    driver = whole.cast.nodes["tractor"]
    assert isinstance(driver, PathDriver)
    sprayed = Sprayed()
    while whole.simulation.now_ns < whole.scenario.duration_ns:
        whole.simulation.run(whole.simulation.now_ns + SECOND // 10)
        sprayed.look(driver, whole.sprayer)
    assert driver.arrived
    return whole, sprayed


def test_the_mission_over_the_field_raises_nothing_although_valves_lag(mission: tuple[Work, Sprayed]) -> None:
    whole, _ = mission
    assert max(valve.response_ns for valve in whole.sprayer.valves) > 1.7 * SECOND, "or the test proves nothing"
    assert whole.events == []
    assert whole.life("BoomMoving") == ["raised", "cleared"] * 2, "unfolding and folding are events, no faults"


def test_the_mission_treats_the_patches_and_little_else(mission: tuple[Work, Sprayed]) -> None:
    _, sprayed = mission
    weeds = sum(sum(row) for row in sprayed.map.cells)
    assert len(sprayed.treated) > 0.85 * weeds
    assert len(sprayed.wasted) < 0.3 * weeds


def test_the_mission_uses_what_the_patches_need(mission: tuple[Work, Sprayed]) -> None:
    whole, sprayed = mission
    weeds_ha = sum(sum(row) for row in sprayed.map.cells) * CELL_M**2 / 10_000
    tank = whole.sprayer.plant.tank
    assert tank.used_l == pytest.approx(200 * weeds_ha, rel=0.25)
    assert 8 - whole.sprayer.plant.dis_l == pytest.approx(0.02 * tank.used_l, rel=0.1)


@pytest.mark.covers("monitoring: sprayer boom implement")
@pytest.mark.covers("monitoring: sprayer boom nozzles")
def test_monitoring_says_on_or_off_of_the_implement_and_of_each_valve(mission: tuple[Work, Sprayed]) -> None:
    samples = [output for output in mission[0].outputs if isinstance(output, Monitor)]
    nozzles = [sample.values for sample in samples if sample.message == "nozzles"]
    implement = [sample.values["Spraying"] for sample in samples if sample.message == "implement"]
    assert len(nozzles) == len(implement) > 2300
    assert all(list(values) == [f"Valve{n}" for n in range(1, SECTIONS + 1)] for values in nozzles)
    assert {values["Valve6"] for values in nozzles} == {None, "Off", "On"}
    assert set(implement) == {None, "Off", "On"}


def test_a_stuck_valve_is_told_in_the_mission_and_the_others_go_on(catalog: Catalog) -> None:
    text = (SHIPPED / "sprayer_stuck_valve.toml").read_text("utf-8")
    stuck = Work(catalog, text).run(240)
    assert stuck.raised == {"ChangeNozzlesFailure", "Section7NotSet"}
    assert stuck.life("Section7NotSet")[:2] == ["raised", "repair_started"]
    assert stuck.life("Section7NotSet")[-1] == "locked_out"
    assert stuck.life("Section7NotSet").count("repair_started") == 3
    assert stuck.supervisor.alarm_states()["Section6NotSet"] == NORMAL
    assert sum(stuck.sprayer.sections_open) == 0
    used_l = stuck.sprayer.plant.tank.used_l
    stuck.run(300)
    assert stuck.sprayer.plant.tank.used_l > used_l + 0.3, "the next patches are sprayed all the same"


def test_a_line_that_runs_down_with_all_sections_open_is_given_the_time(catalog: Catalog) -> None:
    line, tick_s, t_s = WaterLine(0.02), 0.02, 0.0
    line.regulator.position = HIGHEST_BAR
    for _ in range(500):
        line.advance(0, True, 20.0, SECTIONS, supply=True)
    assert line.flow_l_min == pytest.approx(13.4, abs=0.1)
    while line.flow_l_min > 0.3:
        t_s += tick_s
        line.advance(round(t_s * SECOND), True, 0.0, SECTIONS, supply=True)
    assert 5 < t_s < catalog.alarms["MainFlowNotAdjusted"].on_delay_ns / SECOND - 0.5


@pytest.mark.parametrize("seed", range(3))
def test_valves_that_lag_raise_nothing_whatever_the_pattern(catalog: Catalog, seed: int) -> None:
    dice = random.Random(seed)
    flicker = [f"at {t / 10:g} s: section[{dice.randint(1, SECTIONS)}] {dice.choice(['on', 'off'])}"
               for t in range(30, 390) for _ in range(dice.choice([0, 0, 1, 3]))]
    assert work(catalog, orders=[*WORK[:2], *flicker], seed=seed).run().events == []


# --- every fault × its alarm, repair and clearing -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Faults, and the whole life of the alarm that tells them. also: alarms that belong to it."""

    alarm: str
    faults: tuple[str, ...]
    life: list[str]
    orders: tuple[str, ...] = WORK
    settings: str = UNFOLDED
    duration: str = "40 s"
    also: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return f"{self.alarm}: {', '.join(self.faults)}"


def failed(attempts: int, *then: str) -> list[str]:
    """Raised, so many failed attempts, and what comes then."""
    return ["raised", *["repair_started", "repair_failed"] * attempts, *then]


OPEN = ("at 1 s: boom open",)
CLOSE = ("at 1 s: boom close",)
STOP = (*WORK, "at 12 s: spraying off")
SECTION_OFF = (*WORK, "at 10 s: section[7] off")
FIXED = ["repair_started", "repaired", "cleared"]
NOZZLES = frozenset({"ChangeNozzlesFailure"})

TABLE = [
    Case("MainTankCritical", ("at 8 s: sprayer.main_tank empty", "at 15 s: sprayer.main_tank filled"), ["raised", "cleared"]),
    Case("MainTankCritical", (), ["raised"], settings='boom_open = true\nmain_tank = "11 L"'),
    Case("MainTankMismatch", ("at 5 s: sprayer.main_tank leaks",), ["raised"], duration="60 s"),
    Case("MainTankMismatch", ("at 5 s: sprayer.main_tank leaks for 40 s", "at 60 s: sprayer.main_tank filled"),
         ["raised", "cleared"], duration="75 s"),
    Case("MainTankMismatch", ("at 5 s: sprayer.level_sensor drifts up",), ["raised"], duration="60 s"),
    Case("MainTankMismatch", ("at 5 s: sprayer.level_sensor drifts down for 45 s",), ["raised"], duration="60 s"),
    Case("DisTankCritical", ("at 8 s: sprayer.dis_tank empty", "at 15 s: sprayer.dis_tank filled"), ["raised", "cleared"]),
    Case("MainFlowNotAdjusted", ("at 1 s: sprayer.regulator stuck for 2 commands",), failed(1, *FIXED)),
    Case("MainFlowNotAdjusted", ("at 1 s: sprayer.regulator stuck for 10 s",), failed(1, *FIXED)),
    Case("MainFlowNotAdjusted", ("at 8 s: sprayer.pump weak",), failed(2, "locked_out")),
    Case("MainFlowNotAdjusted", ("at 8 s: sprayer.pump weak for 8 s",), REPAIRED),
    Case("HerbicideLineBlocked", ("at 8 s: sprayer.line blocked for 1 command",), REPAIRED),
    Case("HerbicideLineBlocked", ("at 8 s: sprayer.line blocked for 2 commands",), failed(1, *FIXED)),
    Case("HerbicideLineBlocked", ("at 8 s: sprayer.line blocked",), failed(2, "locked_out")),
    Case("HerbicideLineBlocked", ("at 8 s: sprayer.line blocked for 5 s",), REPAIRED),
    Case("BoomMoving", (), ["raised", "cleared"], orders=OPEN, settings=FOLDED),
    Case("BoomMoving", (), ["raised", "cleared"], orders=CLOSE),
    Case("BoomOpeningNotAdjusted", ("at 5 s: sprayer.boom blocked for 1 command",), REPAIRED, OPEN, FOLDED),
    Case("BoomOpeningNotAdjusted", ("at 5 s: sprayer.boom blocked",), failed(2, "locked_out"), OPEN, FOLDED, "60 s"),
    Case("BoomOpeningNotAdjusted", ("at 0 s: sprayer.boom slow",), REPAIRED, CLOSE, UNFOLDED),
    Case("BoomOpeningNotAdjusted", ("at 0 s: sprayer.boom slow for 35 s",), REPAIRED, OPEN, FOLDED),
    Case("OpenCloseBoomFailure", ("at 0 s: sprayer.boom refuses for 2 commands",), failed(1, *FIXED), OPEN, FOLDED),
    Case("OpenCloseBoomFailure", ("at 0 s: sprayer.boom refuses for 3 commands",), failed(2, *FIXED), CLOSE),
    Case("OpenCloseBoomFailure", ("at 0 s: sprayer.boom refuses",), failed(3, "locked_out"), OPEN, FOLDED),
    Case("OpenCloseBoomFailure", ("at 0 s: sprayer.boom refuses for 8 s",), failed(1, *FIXED), CLOSE),
    Case("SprayingStartStopFailure", ("at 1 s: sprayer refuses start for 1 command",), REPAIRED),
    Case("SprayingStartStopFailure", ("at 1 s: sprayer refuses start for 3 commands",), failed(2, *FIXED)),
    Case("SprayingStartStopFailure", ("at 1 s: sprayer refuses start",), failed(3, "locked_out")),
    Case("SprayingStartStopFailure", ("at 1 s: sprayer refuses start for 6 s",), failed(1, *FIXED)),
    Case("SprayingStartStopFailure", ("at 8 s: sprayer refuses stop for 2 commands",), failed(1, *FIXED), STOP),
    Case("SprayingStartStopFailure", ("at 8 s: sprayer refuses stop",), failed(3, "locked_out"), STOP),
    Case("SetMainFlowFailure", ("at 1 s: sprayer.main_flow refuses for 2 commands",), failed(1, *FIXED)),
    Case("SetMainFlowFailure", ("at 1 s: sprayer.main_flow refuses",), failed(3, "locked_out")),
    Case("SetMainFlowFailure", ("at 9 s: sprayer.main_flow refuses for 6 s",), failed(1, *FIXED), (*WORK, "at 10 s: dose half")),
    Case("SetDisFlowFailure", ("at 1 s: sprayer.dis_flow refuses for 2 commands",), failed(1, *FIXED)),
    Case("SetDisFlowFailure", ("at 1 s: sprayer.dis_flow refuses",), failed(3, "locked_out")),
    Case("SetDisFlowFailure", ("at 1 s: sprayer.dis_flow refuses for 9 s",), failed(1, *FIXED)),
    Case("SetDisFlowFailure", ("at 8 s: sprayer.dis_pump weak",), failed(3, "locked_out")),
    Case("SetDisFlowFailure", ("at 8 s: sprayer.dis_pump weak for 8 s",), REPAIRED),
    Case("SprayerSilent", ("at 10 s: sprayer silent for 5 s",), ["raised", "cleared"]),
    Case("SprayerSilent", ("at 10 s: sprayer reset",), ["raised", "cleared"]),
    Case("SprayerFrozen", ("at 10 s: sprayer frozen for 5 s",), ["raised", "cleared"]),
    Case("SprayerFrozen", ("at 10 s: sprayer babbling for 5 s",), ["raised", "cleared"]),
    Case("SprayerDataCorrupt", ("at 10 s: sprayer wrong counter for 5 s",), ["raised", "cleared"]),
    Case("SprayerDataCorrupt", ("at 10 s: sprayer wrong checksum for 5 s",), ["raised", "cleared"]),
    Case("SprayerCommandsLost", ("at 10 s: mission silent for 5 s",), ["raised", "cleared"]),
    Case("SprayerCommandsLost", ("at 10 s: mission frozen for 5 s", "at 10 s: mission silent for 5 s"), ["raised", "cleared"]),
    Case("SprayerCommandsLost", ("at 10 s: mission reset",), ["raised", "cleared"]),
    Case("Section7NotSet", ("at 1 s: sprayer.valve[7] stuck closed for 1 command",), REPAIRED, also=NOZZLES),
    Case("Section7NotSet", ("at 8 s: sprayer.valve[7] stuck closed for 1 command",), failed(1, *FIXED), also=NOZZLES),
    Case("Section7NotSet", ("at 8 s: sprayer.valve[7] stuck closed for 2 commands",), failed(2, *FIXED), also=NOZZLES),
    Case("Section7NotSet", ("at 8 s: sprayer.valve[7] stuck closed",), failed(3, "locked_out"), also=NOZZLES),
    Case("Section7NotSet", ("at 8 s: sprayer.valve[7] stuck closed for 5 s",), failed(1, *FIXED), also=NOZZLES),
    Case("Section7NotSet", ("at 8 s: sprayer.valve[7] stuck open for 1 command",), REPAIRED, SECTION_OFF, also=NOZZLES),
    Case("Section7NotSet", ("at 8 s: sprayer.valve[7] stuck open",), failed(3, "locked_out"), SECTION_OFF,
         also=NOZZLES | {"SectionStaysOpen"}),
    Case("Section1NotSet", ("at 8 s: sprayer.valve[1] slow",), REPAIRED, (*WORK, "at 10 s: section[1] off"), also=NOZZLES),
    Case("ChangeNozzlesFailure", ("at 8 s: sprayer.valve[12] stuck closed for 1 command",), ["raised", "cleared"],
         also=frozenset({"Section12NotSet"})),
    Case("SectionStaysOpen", ("at 8 s: sprayer.valve[7] stuck open for 7 commands",), REPAIRED, SECTION_OFF,
         also=NOZZLES | {"Section7NotSet"}),
    Case("SectionStaysOpen", ("at 8 s: sprayer.valve[7] stuck open",), failed(1, "locked_out"), SECTION_OFF,
         also=NOZZLES | {"Section7NotSet"}),
]


@pytest.mark.parametrize("case", [proves({case.alarm: case.life}, case) for case in TABLE], ids=map(str, TABLE))
def test_each_fault_has_its_alarm_repair_and_clearing(catalog: Catalog, case: Case) -> None:
    done = work(catalog, *case.faults, orders=case.orders, settings=case.settings, duration=case.duration, seed=4).run()
    assert done.life(case.alarm) == case.life
    assert done.raised - {case.alarm} == case.also


def test_every_alarm_and_every_fault_stand_in_the_table(catalog: Catalog) -> None:
    alarms = {case.alarm for case in TABLE} | set(SECTION_ALARMS)
    assert set(catalog.alarms) == alarms
    said = " ".join(fault for case in TABLE for fault in case.faults)
    for phrase in SprayerBoom.FAULTS:
        if phrase.action not in (WORKS, "manual"):
            subject = f"{phrase.device}[7]" if phrase.device == "valve" and phrase.action != "slow" else phrase.device
            assert f"sprayer.{subject}".rstrip(".[1]") in said and phrase.action in said, phrase


@pytest.mark.parametrize("seed", range(6))
def test_a_healthy_start_work_and_stop_raise_nothing(catalog: Catalog, seed: int) -> None:
    orders = ("at 1 s: boom open", "at 2 s: spraying on", "at 3 s: section on", "at 20 s: dose half", "at 22 s: section[5] off",
              "at 26 s: section[5] on", "at 28 s: dose normal", "at 34 s: boom close")
    healthy = work(catalog, orders=orders, settings=FOLDED, duration="55 s", seed=seed).run()
    assert healthy.events == []
    assert healthy.sprayer.boom.state == "Closed"


@pytest.mark.parametrize("fault", [
    "at 10 s: sprayer silent for 800 ms", "at 10 s: sprayer frozen for 1 s", "at 10 s: mission silent for 350 ms",
    "at 10 s: sprayer.valve[7] stuck closed for 2 s", "at 1 s: sprayer refuses start for 1 s",
    "at 10 s: sprayer.dis_pump weak for 2 s", "at 10 s: sprayer.pump weak for 3 s", "at 10 s: sprayer wrong counter for 200 ms"])
def test_what_is_within_the_response_times_raises_nothing(catalog: Catalog, fault: str) -> None:
    orders = (*WORK, "at 12500 ms: section off", "at 13 s: spraying off", "at 14 s: spraying on", "at 16 s: section on")
    assert work(catalog, fault, orders=orders).run().events == []


# --- repairs ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("life", [proves(dict.fromkeys(SECTION_ALARMS, REPAIRED), REPAIRED)], ids=["each"])
def test_sections_are_repaired_side_by_side_each_by_its_own_message(catalog: Catalog, life: list[str]) -> None:
    all_stuck = work(catalog, "at 1 s: sprayer.valve stuck closed for 1 command").run()
    assert {alarm: all_stuck.life(alarm) for alarm in SECTION_ALARMS} == dict.fromkeys(SECTION_ALARMS, life)
    started = [event for event in all_stuck.events if event.event == "repair_started"]
    assert [[frame.message for frame in event.frames] for event in started] == [
        [f"SPRAYER_SECTION_{event.alarm.removeprefix('Section').removesuffix('NotSet')}"] for event in started]
    assert all(all_stuck.sprayer.sections_open)


@pytest.mark.parametrize("life", [proves(dict.fromkeys(SECTION_ALARMS, failed(3, "locked_out")), failed(3, "locked_out"))],
                         ids=["each"])
def test_each_section_that_stays_stuck_is_locked_out(catalog: Catalog, life: list[str]) -> None:
    all_stuck = work(catalog, "at 1 s: sprayer.valve stuck closed").run()
    assert {alarm: all_stuck.life(alarm) for alarm in SECTION_ALARMS} == dict.fromkeys(SECTION_ALARMS, life)
    assert all_stuck.sprayer.locked == set(range(1, SECTIONS + 1))


@pytest.mark.covers("ChangeNozzlesFailure", "raised", "cleared")
@pytest.mark.covers("Section7NotSet", "locked_out", "cleared")
def test_a_locked_out_section_is_closed_and_left_out_until_someone_resets_it(catalog: Catalog) -> None:
    stuck = work(catalog, "at 8 s: sprayer.valve[7] stuck closed for 20 s", duration="60 s").run(35)
    assert stuck.life("Section7NotSet")[-1] == "locked_out"
    assert stuck.sprayer.locked == {7}
    assert stuck.sprayer.sections_open == tuple(n != 7 for n in range(1, SECTIONS + 1))
    assert stuck.order("reset", "Section7NotSet") == ""
    stuck.run()
    assert stuck.life("Section7NotSet")[-2:] == ["acknowledged", "cleared"]
    assert stuck.life("ChangeNozzlesFailure") == ["raised", "cleared"]
    assert stuck.sprayer.locked == set()
    assert all(stuck.sprayer.sections_open)


@pytest.mark.covers("SectionStaysOpen", "raised", "locked_out", "cleared")
def test_a_section_that_can_not_be_closed_ends_spraying(catalog: Catalog) -> None:
    stuck = work(catalog, "at 8 s: sprayer.valve[7] stuck open for 40 s", orders=(*SECTION_OFF, "at 65 s: spraying on"),
                 duration="75 s").run(45)
    assert not stuck.sprayer.spraying
    assert stuck.order("reset", "SectionStaysOpen", origin="local").startswith("the cause of SectionStaysOpen is still there")
    stuck.run(55)
    assert stuck.order("reset", "SectionStaysOpen").endswith("only be reset at the machine")
    assert stuck.order("reset", "Section7NotSet") == ""
    stuck.run(60)
    assert stuck.sprayer.locked == set()
    assert stuck.order("reset", "SectionStaysOpen", origin="local") == ""
    stuck.run()
    assert stuck.sprayer.spraying, "ordered anew"
    assert stuck.supervisor.alarm_states()["SectionStaysOpen"] == NORMAL


LOCKED = [case for case in TABLE if case.life[-1] == "locked_out" and "Section" not in case.alarm]


@pytest.mark.parametrize("case", [proves({case.alarm: [*case.life, "cleared"]}, case) for case in LOCKED], ids=map(str, LOCKED))
def test_a_lock_out_is_safe_and_can_be_reset_at_the_machine(catalog: Catalog, case: Case) -> None:
    end_s = 60 if "boom blocked" in case.faults[0] else 38
    lasting = [f"{fault} for {end_s - 9} s" for fault in case.faults]
    again = (f"at {end_s + 8} s: boom open", f"at {end_s + 9} s: spraying on", f"at {end_s + 10} s: section on")
    locked = work(catalog, *lasting, f"at {end_s + 1} s: sprayer reset", orders=(*case.orders, *again), settings=case.settings,
                  duration=f"{end_s + 30} s").run(end_s)
    assert locked.life(case.alarm)[-1] == "locked_out"
    assert sum(locked.sprayer.sections_open) == 0, "nothing is sprayed"
    assert locked.sprayer.boom.state not in ("Opening", "Closing"), "nothing moves"
    locked.run(end_s + 5)
    assert locked.order("reset", case.alarm, origin="local") == ""
    locked.run()
    assert locked.life(case.alarm)[-1] == "cleared"
    assert locked.sprayer.spraying
    assert all(locked.sprayer.sections_open)
    assert set(locked.supervisor.alarm_states().values()) == {NORMAL}


def test_an_unarmed_repair_sends_nothing(catalog: Catalog) -> None:
    passive = work(catalog, "at 1 s: sprayer refuses start for 1 command", "at 8 s: sprayer.valve[3] stuck closed", armed=[]).run()
    assert passive.life("SprayingStartStopFailure") == ["raised", "repair_started"]
    assert passive.happened[1].passive
    assert not passive.sprayer.spraying
    assert passive.sprayer.locked == set()


def test_a_valve_that_fails_again_and_again_is_locked_out_by_its_budget(catalog: Catalog) -> None:
    toggles = [f"at {10 * n} s: section[7] {'off' if n % 2 else 'on'}" for n in range(1, 12)]
    faults = [f"at {10 * n - 1} s: sprayer.valve[7] stuck closed for 1 command" for n in range(2, 12, 2)]
    tired = work(catalog, *faults, orders=(*WORK, *toggles), duration="2 min").run()
    assert tired.life("Section7NotSet") == [*REPAIRED * 3, "raised", "locked_out"]


# --- interlocks: nothing moves while a person may be near ---------------------------------------------------------------------


@pytest.mark.parametrize("order", ["pause", "stop"])
def test_no_repair_moves_the_boom_while_the_unit_is_paused_or_stopped(catalog: Catalog, order: str) -> None:
    halted = work(catalog, "at 5 s: sprayer.boom blocked for 1 command", orders=OPEN, settings=FOLDED, duration="2 min").run(10)
    assert halted.order(order) == ""
    opening = halted.run(60).sprayer.boom.opening
    assert halted.life("BoomOpeningNotAdjusted") == ["raised"]
    assert 0.2 < opening < 0.5, "stopped half-way"
    halted.order("resume", origin="local")
    halted.run()
    assert halted.life("BoomOpeningNotAdjusted") == REPAIRED


def test_a_pause_in_the_middle_of_a_repair_stops_the_boom_at_once(catalog: Catalog) -> None:
    halted = work(catalog, "at 5 s: sprayer.boom blocked for 1 command", orders=OPEN, settings=FOLDED, duration="2 min").run(21)
    assert halted.sprayer.boom.state == "Opening"
    halted.order("pause")
    halted.run(21.5)
    opening = halted.sprayer.boom.opening
    halted.run(60)
    assert (halted.sprayer.boom.state, halted.sprayer.boom.opening) == ("Stopped", opening)
    assert halted.life("BoomOpeningNotAdjusted") == failed(1)
    halted.order("resume")
    assert halted.run().life("BoomOpeningNotAdjusted") == failed(1, *FIXED)


def test_no_section_is_driven_while_the_unit_is_paused(catalog: Catalog) -> None:
    paused = work(catalog, "at 8 s: sprayer.valve[7] stuck closed for 1 command").run(8)
    paused.order("pause")
    assert paused.run(30).life("Section7NotSet") == ["raised"]


@pytest.mark.parametrize("at_s", [3, 12, 22])
def test_nothing_moves_while_someone_has_the_hand_panel_nor_when_it_is_left(catalog: Catalog, at_s: int) -> None:
    manual = work(catalog, "at 5 s: sprayer.boom blocked for 1 command", f"at {at_s} s: sprayer manual for 10 s",
                  orders=OPEN, settings=FOLDED, duration="2 min").run(at_s + 0.5)
    opening = manual.sprayer.boom.opening
    manual.run()
    assert manual.sprayer.boom.opening == opening
    assert "repaired" not in manual.life("BoomOpeningNotAdjusted")


def test_spraying_ends_at_the_hand_panel_and_has_to_be_ordered_anew(catalog: Catalog) -> None:
    manual = work(catalog, "at 10 s: sprayer manual for 5 s", orders=(*WORK, "at 25 s: boom open", "at 26 s: spraying on")).run(24)
    assert not manual.sprayer.spraying
    manual.run()
    assert manual.sprayer.spraying
    assert manual.events == []


def test_an_order_to_stop_closes_all_sections_even_while_level_1_holds_the_start(catalog: Catalog) -> None:
    held = work(catalog, "at 10 s: sprayer.regulator stuck", "at 12 s: sprayer.valve[2] stuck closed",
                orders=(*WORK, "at 11 s: dose half", "at 20 s: spraying off")).run(19)
    assert "MainFlowNotAdjusted" in held.raised
    assert sum(held.sprayer.sections_open) == SECTIONS - 1
    assert sum(held.run(23).sprayer.sections_open) == 0


def test_level_1_that_dies_in_the_middle_of_a_repair_leaves_the_boom_standing(catalog: Catalog) -> None:
    lost = work(catalog, "at 5 s: sprayer.boom blocked for 1 command", orders=OPEN, settings=FOLDED, duration="60 s").run(21)
    lost.simulation.detach(lost.unit)
    lost.run(22)
    opening = lost.sprayer.boom.opening
    assert lost.run().sprayer.boom.opening == opening < 1


def test_a_locked_section_stays_closed_when_level_1_dies_and_locked_out_when_it_returns(catalog: Catalog) -> None:
    lost = work(catalog, "at 8 s: sprayer.valve[7] stuck closed for 20 s", duration="70 s").run(35)
    state = lost.supervisor.state()
    lost.simulation.detach(lost.unit)
    lost.run(45)
    assert lost.sprayer.locked == {7}
    lost.supervisor = Supervisor(catalog, unit="tractor-7", boot=2, start_ns=lost.simulation.now_ns, restored=state)
    lost.simulation.attach(SimulatedUnit(lost.supervisor, lost.outputs.extend))
    lost.run()
    assert lost.supervisor.alarm_states()["Section7NotSet"] == LOCKED_OUT
    assert not lost.sprayer.sections_open[6]


@pytest.mark.parametrize(("alarm", "fault", "orders", "settings"), [
    ("SprayingStartStopFailure", "at 1 s: sprayer refuses start for 1 command", WORK, UNFOLDED),
    ("BoomOpeningNotAdjusted", "at 5 s: sprayer.boom blocked for 1 command", OPEN, FOLDED)])
def test_a_mission_controller_that_sends_on_during_a_repair_ends_it_in_the_safe_state(
        catalog: Catalog, alarm: str, fault: str, orders: tuple[str, ...], settings: str) -> None:
    rude = work(catalog, "at 0 s: mission ignores repairs", fault, orders=orders, settings=settings, duration="2 min").run()
    assert rude.life(alarm)[-1] in ("cleared", "locked_out")
    assert rude.sprayer.boom.state not in ("Opening", "Closing")


# --- the command --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENARIOS)
def test_each_shipped_scenario_runs_and_tells(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", name, "--duration", "60 s"]) == 0
    out, err = capsys.readouterr()
    assert "spraying on" in out
    assert "no hazards" in out.splitlines()[-1]
    assert "× real time" in err


def test_two_runs_report_the_same(catalog: Catalog) -> None:
    text = (SHIPPED / "sprayer_faults.toml").read_text("utf-8")
    assert Work(catalog, text).run(60).outputs == Work(catalog, text).run(60).outputs
    assert Work(catalog, text, seed=2).run(60).outputs != Work(catalog, text).run(60).outputs


def test_sections_that_close_while_the_pumps_do_not_stop_are_no_alarm(catalog: Catalog) -> None:
    """Level 1 holds spraying off; somebody orders it anew, and the mission controller its pattern."""
    orders = (*WORK, "at 12 s: spraying off", "at 35 s: spraying on")
    done = work(catalog, "at 10 s: sprayer refuses stop", orders=orders, duration="45 s").run()
    assert done.life("SprayingStartStopFailure")[-1] == "locked_out"
    assert done.sprayer.spraying
    assert done.raised == {"SprayingStartStopFailure"}
