"""Faults of all four machines and of the GNSS receiver on real SocketCAN, each machine and level 1 a process of its own.

Two units work at the same time: on vcan0 the tractor with the air-blast sprayer (and the tractor's receiver on a serial line), on
vcan1 the boom and the flaming tool. Each run has its faults one after the other, so that a repair never waits for another. What
level 1 did is read from its journal, and what it sent from the bus. The flame that is lit again, the lost node, the traffic log and
the plug of the receiver have files of their own: their times are long, or somebody has to pull a plug.
"""
from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from hil_tests.conftest import RUNNING, START_S, UCS, Process
from hil_tests.recorder import Recorder
from level1.catalog import ACTIVE, NORMAL, REPAIRING, Catalog
from level1.event import Event
from level1.io.definitions import load
from level1.io.journal import read_events
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

LENGTH_S = 25.0
RUNS, STOOD_STILL_S = 3, 0.25
LATE_S = 25.0
"""Programs start slowly in a guest without CPU of its own."""
URGENT = -15
"""Nice value of programs that have begun."""
REPAIRED = ("raised", "repair_started", "repaired", "cleared")
PASSED = ("raised", "cleared")


class Fault(NamedTuple):
    """What is injected, the alarm that tells it, its life, and the message by which it is repaired."""

    fault: str
    alarm: str
    life: Sequence[str]
    message: str = ""


class Plan(NamedTuple):
    """A unit: its bus, definitions, machines, orders and faults."""

    name: str
    channel: str
    files: Sequence[str]
    nodes: str
    orders: Sequence[str]
    faults: Sequence[Fault]


ORCHARD = Plan("orchard", "vcan0", ("vehicle.dbc", "airblast_sprayer.dbc", "ucs.dbc"), """
[nodes.tractor]
program = "vehicle"
[nodes.tractor_mission]
program = "vehicle_mission"
[nodes.airblast]
program = "airblast_sprayer"
[nodes.sensors]
program = "ultrasonic_sensors"
[nodes.airblast_mission]
program = "airblast_mission"
""", ("at 3 s: mission start", "at 3 s: pto on", "at 3 s: hitch by path", "at 3 s: implement set", "at 3 s: spraying on"), (
    Fault("at 0 s: tractor.hitch stuck for 1 command", "HitchNotMoving", REPAIRED, "VEHICLE_HITCH_CMD"),
    Fault("at 0 s: tractor.pto refuses for 1 command", "PtoNotSet", REPAIRED, "VEHICLE_PTO_CMD"),
    Fault("at 0 s: tractor.implement refuses for 1 command", "ImplementSetUnsetFailure", REPAIRED, "VEHICLE_IMPLEMENT_CMD"),
    Fault("at 2 s: airblast refuses start for 1 command", "AirblastStartStopFailure", REPAIRED, "AIRBLAST_CMD"),
    Fault("at 9 s: sensors.sensor[3] dead", "Ultrasonic3NotWorking", REPAIRED, "NMT"),
    Fault("at 10 s: airblast.line blocked for 1 command", "NoMainFlow", REPAIRED, "AIRBLAST_CMD"),
    Fault("at 11 s: tractor.gnss lost for 11 s", "PositionLost", PASSED),
    Fault("", "GnssNoFix", PASSED),
))
FIELD = Plan("field", "vcan1", ("sprayer_boom.dbc", "flaming_tool.dbc"), """
[nodes.boom]
program = "sprayer_boom"
boom_open = true
[nodes.boom_mission]
program = "sprayer_mission"
[nodes.flamer]
program = "flaming_tool"
[nodes.flamer_mission]
program = "mission_controller"
""", ("at 2 s: boom open", "at 3 s: spraying on", "at 4 s: section on", "at 3 s: flaming on", "at 12 s: burner high"), (
    Fault("at 2 s: boom refuses start for 1 command", "SprayingStartStopFailure", REPAIRED, "SPRAYER_CMD"),
    Fault("at 2 s: boom.main_flow refuses for 1 command", "SetMainFlowFailure", REPAIRED, "SPRAYER_MAIN_CMD"),
    Fault("at 2 s: boom.valve[7] stuck closed for 1 command", "Section7NotSet", REPAIRED, "SPRAYER_SECTION_7"),
    Fault("", "ChangeNozzlesFailure", PASSED),
    Fault("at 13 s: boom.line blocked for 1 command", "HerbicideLineBlocked", REPAIRED, "SPRAYER_DIS_CMD"),
    Fault("at 2 s: flamer refuses start for 4 commands", "FlamingStartStopFailure", REPAIRED, "FLAMER_CMD"),
    Fault("at 11 s: flamer.burner[2] stuck for 3 commands", "ChangeBurnersFailure", REPAIRED, "FLAMER_CMD"),
    Fault("at 20 s: boom silent for 2 s", "SprayerSilent", PASSED),
))


class Unit:
    """A unit's processes, and after `end` what they left: events of its journal, frames of its bus."""

    def __init__(self, plan: Plan, folder: Path, started: list[Process]):
        self.plan, self.folder = plan, folder
        self.catalog: Catalog = load(plan.files)
        self._started = started
        self.events: list[Event] = []
        armed = [fault.alarm for fault in plan.faults if fault.message]
        (folder / f"{plan.name}.toml").write_text(
            unit_toml(*plan.files, name=plan.name, journal=f"{plan.name}.db", armed=armed, channel=plan.channel,
                      more='[gnss]\nport = "gnss"' if plan is ORCHARD else ""))
        faults = [fault.fault for fault in plan.faults if fault.fault]
        (folder / f"{plan.name}.scenario.toml").write_text(
            f'duration = "{LENGTH_S} s"\norders = {list(plan.orders)}\nfaults = {faults}\n{plan.nodes}'.replace("'", '"'))
        self.run = self._start("run", f"{plan.name}.toml")

    def work(self) -> None:
        """Let the machines begin; back when they have begun."""
        prefer(self.run)
        self.recorder = Recorder(self.plan.channel, self.catalog.messages)
        nmea = ("--nmea", "gnss") if self.plan is ORCHARD else ()
        self.machines = self._start("simulate", f"{self.plan.name}.scenario.toml", "--bus", self.plan.channel, *nmea)
        self.machines.expect(" order: ", START_S)
        prefer(self.machines)

    def end(self) -> None:
        """Wait until the machines have ended, end level 1, read its journal."""
        try:
            assert self.machines.wait(LENGTH_S + LATE_S) == 0
            assert self.run.stop() == 0
        finally:
            self.recorder.stop()
        self.events = list(read_events(self.folder / f"{self.plan.name}.db"))

    def episode(self, alarm: str) -> list[Event]:
        """The first activation of an alarm, event by event."""
        of_alarm = [event for event in self.events if event.alarm == alarm]
        return [event for event in of_alarm if event.instance == of_alarm[0].instance]

    def _start(self, *arguments: str) -> Process:
        self._started.append(Process([*UCS, *arguments], " ".join(arguments[:2]), self.folder))
        return self._started[-1]


def prefer(process: Process) -> None:
    """Let it go before programs that are still being loaded: what has begun lives by time limits of some 100 ms."""
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, process.pid, URGENT)


class Work:
    """Both units, which have worked."""

    def __init__(self, folder: Path):
        self.processes: list[Process] = []
        try:
            self.units = {plan.name: Unit(plan, folder, self.processes) for plan in (ORCHARD, FIELD)}
            for unit in self.units.values():
                unit.run.expect("; supervising$", START_S)
            for unit in self.units.values():
                unit.work()
            for unit in self.units.values():
                unit.end()
        finally:
            for process in self.processes:
                process.sweep()


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Work:
    """The work of both units, for all tests of this module. A run in which the whole guest stood still (its buses were quiet longer
    than any message's time limit) proves nothing about level 1, and is done again."""
    for _ in range(RUNS):
        work = Work(tmp_path_factory.mktemp("machines"))
        if all(unit.recorder.longest_pause_s < STOOD_STILL_S for unit in work.units.values()):
            break
    return work


def proved(plan: Plan, fault: Fault) -> Any:
    """The row of a fault, with what it proves."""
    return pytest.param(plan.name, fault, marks=pytest.mark.covers(fault.alarm, *fault.life), id=fault.alarm)


@pytest.mark.parametrize(("name", "fault"), [proved(plan, fault) for plan in (ORCHARD, FIELD) for fault in plan.faults])
def test_each_fault_is_told_repaired_on_the_wire_verified_and_cleared(
        done: Work, name: str, fault: Fault, request: pytest.FixtureRequest) -> None:
    request.node.stash[RUNNING] = done.processes
    unit = done.units[name]
    assert [event.event for event in unit.episode(fault.alarm)] == list(fault.life)
    alarm = unit.catalog.alarms[fault.alarm]
    shown = [{"raised": ACTIVE, "repair_started": REPAIRING, "repaired": ACTIVE, "cleared": NORMAL}[word] for word in fault.life]
    assert unit.recorder.changes(alarm.message, alarm.signal)[:len(shown) + 1] == [NORMAL, *shown]
    if fault.message:
        started = unit.episode(fault.alarm)[1]
        sent = [bytes.fromhex(frame.data) for frame in started.frames if frame.message == fault.message]
        assert not started.passive and sent
        assert set(sent) <= unit.recorder.payloads(fault.message), "on the wire"
