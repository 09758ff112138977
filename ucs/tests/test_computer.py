"""The alarms of the UCS itself, in virtual time: heat, memory, storage, traffic log, clock; the two that it repairs."""
from __future__ import annotations

from collections.abc import Sequence

import pytest

from firmware_py.computer import Computer
from firmware_py.fault import WORKS
from firmware_py.node import COMMON_FAULTS
from firmware_py.scenario import build, parse
from firmware_py.virtual_bus import Simulation
from level1.catalog import Catalog
from level1.command import Order
from level1.event import Event, Output, Result, Send
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.simulate import SHIPPED
from ucs.simulated_unit import SimulatedUnit
from ucs.tests.proof import proves

SECOND = 1_000_000_000
NODES = '[nodes.computer]\nprogram = "computer"\n'


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["ucs.dbc"])


class Unit:
    """A computer with faults, and the level 1 that runs on it. lives: what was reported of each alarm; sent: its orders."""

    def __init__(self, catalog: Catalog, text: str, armed: Sequence[str] | None = None):
        self.scenario = parse(text, "test.toml")
        self.lives: dict[str, list[str]] = {}
        self.sent: list[str] = []
        self.supervisor = Supervisor(catalog, unit="tractor-7", start_ns=0, armed=armed)
        self.simulation = Simulation([*build(self.scenario).participants, SimulatedUnit(self.supervisor, self._deliver)])

    def _deliver(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, Event):
                self.lives.setdefault(output.alarm, []).append(output.event)
            elif isinstance(output, Send) and output.message.endswith("_CMD"):
                self.sent.append(output.message)

    def run(self, until_s: float | None = None) -> Unit:
        """Up to a time, or to the scenario's end."""
        self.simulation.run(self.scenario.duration_ns if until_s is None else round(until_s * SECOND))
        return self

    def reset(self, alarm: str) -> str:
        """Level 2 resets a lock-out; gives the reason of a refusal."""
        outputs = self.supervisor.command(Order("1", "reset", alarm), self.simulation.now_ns)
        self._deliver(outputs)
        return next(output.reason for output in outputs if isinstance(output, Result))


def unit(catalog: Catalog, *faults: str, minutes: float = 5, armed: Sequence[str] | None = None) -> Unit:
    return Unit(catalog, f'duration = "{minutes} min"\nfaults = {list(faults)}\n{NODES}', armed)


REPAIRED = ["raised", "repair_started", "repaired", "cleared"]
SECOND_TRY = ["raised", "repair_started", "repair_failed", "repair_started", "repaired", "cleared"]
LOCKED_OUT = ["raised", *["repair_started", "repair_failed"] * 3, "locked_out"]
PASSED = ["raised", "cleared"]
TABLE: list[tuple[str, dict[str, list[str]]]] = [
    ("at 10 s: computer.board overheats for 1 min", {"MainboardTemperatureCritical": PASSED}),
    ("at 10 s: computer.cpu overheats for 1 min", {"CpuTemperatureCritical": PASSED}),
    ("at 10 s: computer.memory leaks for 90 s", {"RamCritical": PASSED}),
    ("at 10 s: computer.storage fills for 90 s", {"StorageCritical": PASSED}),
    ("at 10 s: computer.storage fails for 20 s", {"StorageWriteFailed": PASSED, "JournalFault": PASSED}),
    ("at 10 s: computer.recorder fails for 1 command", {"TrafficLogFailed": REPAIRED}),
    ("at 10 s: computer.recorder fails for 2 commands", {"TrafficLogFailed": SECOND_TRY}),
    ("at 10 s: computer.recorder fails for 5 s", {"TrafficLogFailed": REPAIRED}),
    ("at 10 s: computer.recorder fails", {"TrafficLogFailed": LOCKED_OUT}),
    ("at 10 s: computer.clock lost for 1 command", {"TimeSyncLost": REPAIRED}),
    ("at 10 s: computer.clock lost for 2 commands", {"TimeSyncLost": SECOND_TRY}),
    ("at 10 s: computer.clock lost", {"TimeSyncLost": LOCKED_OUT}),
    ("at 10 s: computer.loop late for 20 s", {"LoopLate": PASSED}),
    ("at 10 s: computer.bus overloaded for 20 s", {"BusOverloaded": PASSED}),
    ("at 10 s: computer silent for 10 s", {"HealthNotMeasured": PASSED}),
    ("at 10 s: computer.clock lost for 1 min", {}),
    ("at 10 s: computer.cpu overheats for 10 s", {}),
    ("at 10 s: computer reset", {}),
]


@pytest.mark.parametrize(("fault", "lives"), [proves(lives, fault, lives) for fault, lives in TABLE],
                         ids=[fault for fault, _ in TABLE])
def test_each_fault_raises_its_alarms_and_no_others(catalog: Catalog, fault: str, lives: dict[str, list[str]]) -> None:
    assert unit(catalog, fault, minutes=16 if "clock" in fault else 4).run().lives == lives


def test_every_fault_stands_in_the_table() -> None:
    said = " ".join(fault for fault, _ in TABLE)
    for phrase in Computer.FAULTS:
        if phrase not in COMMON_FAULTS and phrase.action != WORKS:
            assert f"computer.{phrase.device} {phrase.action}" in said


def test_a_healthy_computer_raises_nothing(catalog: Catalog) -> None:
    assert unit(catalog, minutes=20).run().lives == {}


@pytest.mark.parametrize(("alarm", "fault", "locked_s"), [
    proves({"TrafficLogFailed": [*LOCKED_OUT, "cleared"]}, "TrafficLogFailed", "at 10 s: computer.recorder fails for 2 min", 90),
    proves({"TimeSyncLost": [*LOCKED_OUT, "cleared"]}, "TimeSyncLost", "at 10 s: computer.clock lost for 15 min", 900)])
def test_a_lock_out_can_be_reset_from_above_once_the_cause_is_gone(
        catalog: Catalog, alarm: str, fault: str, locked_s: float) -> None:
    locked = unit(catalog, fault, minutes=20).run(locked_s)
    assert locked.lives[alarm] == LOCKED_OUT
    assert "still there" in locked.reset(alarm)
    locked.run(locked_s + 100)
    assert locked.reset(alarm) == ""
    assert locked.run().lives[alarm] == [*LOCKED_OUT, "acknowledged", "cleared"]


def test_an_unarmed_repair_orders_nothing(catalog: Catalog) -> None:
    passive = unit(catalog, "at 10 s: computer.recorder fails for 5 s", armed=[]).run()
    assert passive.lives == {"TrafficLogFailed": ["raised", "repair_started", "cleared"]}
    assert passive.sent == []


def test_the_log_is_begun_anew_while_the_unit_is_stopped_because_nothing_moves(catalog: Catalog) -> None:
    stopped = unit(catalog, "at 10 s: computer.recorder fails for 1 command").run(5)
    stopped.supervisor.command(Order("1", "stop"), stopped.simulation.now_ns)
    assert stopped.run().lives["TrafficLogFailed"] == REPAIRED
    assert stopped.sent == ["UCS_LOG_CMD"]


def test_the_shipped_scenario_raises_what_its_faults_say(catalog: Catalog) -> None:
    shown = Unit(catalog, (SHIPPED / "computer.toml").read_text("utf-8")).run()
    assert set(shown.lives) == {alarm for _, lives in TABLE for alarm in lives} - {"LoopLate", "BusOverloaded"}
