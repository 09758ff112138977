"""The mission controller with the flaming tool on a bus; alarms come from a hand that plays level 1."""
from __future__ import annotations

from random import Random

import pytest

from firmware_py.fault import Statement
from firmware_py.flaming_tool import IDLE, FlamingTool
from firmware_py.mission_controller import MissionController
from firmware_py.participant import BusFrame
from firmware_py.tests.bench import CODEC, SECOND
from firmware_py.virtual_bus import Simulation

COMMAND = CODEC.identifier("FLAMER_CMD")


class Hand:
    """Sends FLAMER_ALARMS with what it was told, and counts FLAMER_CMD frames."""

    def __init__(self) -> None:
        self.alarms = dict.fromkeys(CODEC.decode("FLAMER_ALARMS", bytes(8)) or {}, "Normal")
        self.commands = 0
        self._next_ns = 0

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        self.commands += (can_id, extended) == COMMAND

    def step(self, now_ns: int) -> list[BusFrame]:
        self._next_ns = now_ns + SECOND // 5
        return [BusFrame(*CODEC.identifier("FLAMER_ALARMS"), CODEC.encode("FLAMER_ALARMS", dict(self.alarms)))]

    def next_deadline(self) -> int | None:
        return self._next_ns


class Mission:
    """Tool, mission controller and hand."""

    def __init__(self, **settings: float):
        self.tool = FlamingTool("flamer", CODEC, settings, Random(1))
        self.controller = MissionController("mission", CODEC, {}, Random(1))
        self.hand = Hand()
        self.simulation = Simulation([self.tool, self.controller, self.hand])

    def run(self, seconds: float) -> Mission:
        self.simulation.run(self.simulation.now_ns + round(seconds * SECOND))
        return self

    def order(self, device: str, action: str, index: int | None = None) -> Mission:
        self.controller.order(self.simulation.now_ns, Statement(device, index, action))
        return self

    def alarm(self, state: str) -> Mission:
        self.hand.alarms["PilotFlameOut"] = state
        return self.run(0.3)

    def working(self) -> Mission:
        return self.run(0.5).order("flaming", "on").run(4)


def test_it_lights_the_pilot_flame_and_works() -> None:
    mission = Mission().working()
    assert mission.controller.state == "Working"
    assert mission.tool.plant.flame


def test_it_purges_a_tool_that_is_not_ready() -> None:
    mission = Mission(purged=0).working()
    assert mission.controller.state == "Purging"
    assert mission.run(31).controller.state == "Working"
    assert mission.tool.hazards == []


def test_it_does_not_light_by_the_last_word_of_a_tool_that_is_silent() -> None:
    mission = Mission().run(0.5)
    mission.tool.inject(mission.simulation.now_ns, Statement("", None, "silent"))
    mission.run(0.4).order("flaming", "on").run(10)
    assert mission.controller.state == "Purging" and not mission.tool.plant.flame
    mission.tool.inject(mission.simulation.now_ns, Statement("", None, "works"))
    assert mission.run(4).controller.state == "Working"
    assert mission.tool.hazards == []


def test_it_does_not_light_while_an_alarm_of_the_gas_valve_waits_for_someone_to_look() -> None:
    mission = Mission()
    mission.hand.alarms["GasValveLeaks"] = "Active"
    assert mission.run(0.5).order("flaming", "on").run(5).controller.state == "Purging"
    mission.hand.alarms["GasValveLeaks"] = "Normal"
    assert mission.run(5).controller.state == "Working"


def test_it_stops_when_ordered() -> None:
    mission = Mission().working().order("burner", "high").run(2).order("flaming", "off").run(2)
    assert mission.controller.state == "Idle"
    assert mission.controller.values("FLAMER_CMD") == IDLE
    assert not mission.tool.plant.flame


@pytest.mark.parametrize("state", ["Repairing", "LockedOut"])
def test_it_sends_nothing_while_level_1_holds_the_command(state: str) -> None:
    mission = Mission().working().alarm(state)
    before = mission.hand.commands
    assert mission.run(3).hand.commands == before


def test_it_sends_on_while_an_alarm_is_only_active() -> None:
    mission = Mission().working().alarm("Active")
    before = mission.hand.commands
    assert mission.run(3).hand.commands >= before + 29


def test_it_works_on_after_a_repair_that_lit_the_flame() -> None:
    mission = Mission().working().alarm("Repairing")
    burning = CODEC.encode("FLAMER_CMD", IDLE | {"Flaming": "On", "GasValve": "Open"})
    mission.tool.receive(mission.simulation.now_ns, *COMMAND, burning)
    mission.alarm("Active")
    assert mission.controller.state == "Working"


def test_it_starts_with_a_purge_when_the_flame_is_out_at_the_hand_back() -> None:
    mission = Mission().working().alarm("Repairing").run(5).alarm("Normal")
    assert not mission.tool.plant.flame, "commands had stopped"
    assert mission.controller.state == "Purging"
    assert mission.run(40).tool.plant.flame
    assert mission.tool.hazards == []


def test_a_lock_out_withdraws_the_order() -> None:
    mission = Mission().working().alarm("LockedOut").run(5).alarm("Normal").run(60)
    assert mission.controller.state == "Idle"
    assert not mission.tool.plant.flame


def test_it_does_not_light_a_flame_again_that_went_out_in_work() -> None:
    mission = Mission().working()
    mission.tool.inject(mission.simulation.now_ns, Statement("pilot", None, "blown out"))
    assert not mission.run(60).tool.plant.flame
    assert mission.controller.state == "Working"


def test_a_failed_ignition_that_nobody_repairs_ends_the_order() -> None:
    mission = Mission()
    mission.tool.inject(0, Statement("igniter", None, "dead"))
    mission.working()
    assert mission.controller.state == "Failed"
    assert mission.run(6).controller.state == "Idle"


def test_it_starts_again_when_the_tool_has_left_its_work_mode() -> None:
    mission = Mission().working()
    mission.tool.inject(mission.simulation.now_ns, Statement("", None, "reset"))
    mission.run(3)
    assert mission.controller.state == "Purging"
    assert mission.run(40).controller.state == "Working"


def test_one_that_ignores_repairs_sends_on() -> None:
    mission = Mission().working()
    mission.controller.inject(mission.simulation.now_ns, Statement("", None, "ignores repairs"))
    before = mission.alarm("Repairing").hand.commands
    assert mission.run(1).hand.commands > before
    mission.controller.inject(mission.simulation.now_ns, Statement("", None, "works"))
    before = mission.run(0.2).hand.commands
    assert mission.run(1).hand.commands == before


def test_orders_set_one_burner_or_all() -> None:
    mission = Mission().working().order("burner", "low").order("burner", "high", 3).run(2)
    assert mission.tool.values("FLAMER_BURNERS") == {"Burner1": "Low", "Burner2": "Low", "Burner3": "High", "Burner4": "Low"}


def test_an_unknown_order_is_refused() -> None:
    with pytest.raises(ValueError, match="knows no order"):
        Mission().order("sprayer", "on")


def test_after_a_reset_nothing_is_ordered() -> None:
    mission = Mission().working()
    mission.controller.inject(mission.simulation.now_ns, Statement("", None, "reset"))
    assert mission.run(5).controller.state == "Idle"
    assert not mission.tool.plant.flame
