"""The whole chain on real SocketCAN, every part a process of its own: the flaming tool's node, level 1, the bridge, level 2.

Two tractors work at the same time, because the purge of 30 s is not shortened: on vcan0 the wind blows the pilot flame out, on
vcan1 the igniter is dead as well. One level 2 receives both. What was on the buses is recorded.
"""
from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.conftest import RUNNING, SOON_S, START_S, UCS, Process
from hil_tests.recorder import Recorder
from level1.catalog import LOCKED_OUT, NORMAL, REPAIRING
from level1.io.definitions import load
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

BROKER = "127.0.0.1:18830"
PURGE_S, ATTEMPT_S = 30.0, 40.0
MARGIN = 1.2
"""A guest without CPU of its own may be late by so much of a time."""
SCENARIO = """
seed = 1
duration = "5 min"
orders = ["at 1 s: flaming on", "at 3 s: burner low"]
faults = [{faults}]
[nodes.flamer]
program = "flaming_tool"
[nodes.mission]
program = "mission_controller"
"""
BLOWN_OUT = '"at 6 s: flamer.pilot blown out"'
DEAD_TOO = f'"at 5 s: flamer.igniter dead", {BLOWN_OUT}'


class Tractor:
    """A tractor's processes, and what its bus carried."""

    def __init__(self, field: Field, name: str, channel: str, faults: str):
        self.field, self.name = field, name
        self.recorder = Recorder(channel, field.messages)
        (field.folder / f"{name}.toml").write_text(unit_toml(
            "flaming_tool.dbc", name=name, journal=f"{name}.db", armed=["PilotFlameOut"], channel=channel,
            more=f'[bridge]\nbroker = "mqtt://{BROKER}"'))
        (field.folder / f"{name}.scenario.toml").write_text(SCENARIO.format(faults=faults))
        self.run = field.start("run", f"{name}.toml")
        self.bridge = field.start("bridge", f"{name}.toml")
        self.channel = channel

    def drive(self) -> None:
        """Once level 1 is there and level 2 can hear it: begin to work."""
        self.run.expect("; supervising$", START_S)
        self.bridge.expect("connected to mqtt://", START_S)
        self.node = self.field.start("simulate", f"{self.name}.scenario.toml", "--bus", self.channel)


class Field:
    """Level 2 and the tractors."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.processes: list[Process] = []
        self.messages = load(["flaming_tool.dbc"]).messages
        self.level2 = self.start("level2", "--listen", BROKER, "--store", "level2.db")
        self.level2.expect("receiving all fleets", START_S)
        self.windy = Tractor(self, "windy", "vcan0", BLOWN_OUT)
        self.broken = Tractor(self, "broken", "vcan1", DEAD_TOO)
        for tractor in (self.windy, self.broken):
            tractor.drive()

    def start(self, *arguments: str) -> Process:
        """Start `ucs` with these arguments."""
        self.processes.append(Process([*UCS, *arguments], " ".join(arguments[:2]), self.folder))
        return self.processes[-1]

    def close(self) -> list[str]:
        """End everything; gives the names of what did not end with 0 on SIGTERM."""
        bad = []
        for process in reversed(self.processes):
            try:
                if process.stop() != 0:
                    bad.append(process.name)
            except pytest.fail.Exception:
                bad.append(process.name)
                process.kill()
            process.sweep()
        for tractor in (self.windy, self.broken):
            tractor.recorder.stop()
        return bad


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    """Everything, for all tests of this module."""
    field = Field(tmp_path_factory.mktemp("field"))
    yield field
    assert field.close() == [], "every program ends with 0 on SIGTERM"


@pytest.fixture
def field(running: Field, request: pytest.FixtureRequest) -> Field:
    """The same, with what its processes wrote shown where a test fails."""
    request.node.stash[RUNNING] = running.processes
    return running


@pytest.mark.covers("PilotFlameOut", "raised", "repair_started", "repaired", "cleared")
def test_a_flame_blown_out_is_lit_again_and_level_2_hears_it_all(field: Field) -> None:
    level2, run = field.level2, field.windy.run
    run.expect("PilotFlameOut +raised", START_S)
    run.expect("PilotFlameOut +repair started", SOON_S)
    run.expect("PilotFlameOut +repaired", ATTEMPT_S * MARGIN)
    run.expect("PilotFlameOut +cleared", SOON_S)
    for word in ("raised", "repair_started 1", "repaired 1", "cleared"):
        level2.expect(f"windy PilotFlameOut {word}", SOON_S)
    field.windy.node.expect("pilot flame out: blown out", SOON_S)
    field.windy.node.expect("purged", SOON_S)
    field.windy.node.expect("pilot flame burns", SOON_S)


def test_the_valve_closes_within_a_second_and_no_gas_flows_before_the_purge(field: Field) -> None:
    recorder = field.windy.recorder
    flame = recorder.values("FLAMER_STATUS", "PilotFlame")
    burnt = next(t for t, value in flame if value)
    lost = next(t for t, value in flame if t > burnt and not value)
    closed = next(t for t, value in recorder.values("FLAMER_STATUS", "GasValve") if t > lost and not value)
    opened = next(t for t, value in recorder.values("FLAMER_CMD", "GasValve") if t > closed + 0.5 and value)
    assert closed - lost <= 1.0 * MARGIN
    assert opened - closed >= PURGE_S - 0.5
    valve = [value for t, value in recorder.values("FLAMER_STATUS", "GasValve") if closed < t < opened]
    assert valve and not any(valve)


def test_the_bus_shows_the_alarms_life_and_who_commands(field: Field) -> None:
    assert field.windy.recorder.changes("FLAMER_ALARMS", "PilotFlameOut") == [NORMAL, 1, REPAIRING, 1, NORMAL]
    field.windy.node.expect("commands again: working", SOON_S)


@pytest.mark.covers("PilotFlameOut", "raised", "repair_started", "repair_failed", "locked_out")
def test_with_a_dead_igniter_three_attempts_end_in_a_lock_out_at_level_2(field: Field) -> None:
    level2, run = field.level2, field.broken.run
    for attempt in (1, 2, 3):
        run.expect(f"PilotFlameOut +repair started +attempt {attempt}", ATTEMPT_S * MARGIN)
        run.expect(f"PilotFlameOut +repair failed +attempt {attempt}", ATTEMPT_S * MARGIN)
    run.expect("PilotFlameOut +locked out", SOON_S)
    level2.expect("broken PilotFlameOut locked_out", SOON_S)
    assert sum("broken PilotFlameOut repair_failed" in line for line in level2.out) == 3


def test_locked_out_the_gas_valve_is_closed_on_the_bus_and_stays_so_over_a_restart(field: Field) -> None:
    tractor = field.broken
    assert tractor.run.stop() == 0
    again = field.start("run", "broken.toml")
    again.expect("boot .*; supervising$", START_S)
    boots = [int(found[1]) for run in (tractor.run, again) for line in run.out if (found := re.match(r"boot (\d+), journal", line))]
    assert boots[0] < boots[1]
    since = time.monotonic()
    time.sleep(3)
    recorder = tractor.recorder
    for message in ("FLAMER_CMD", "FLAMER_STATUS"):
        values = [value for t, value in recorder.values(message, "GasValve") if t > since]
        assert values and not any(values), message
    assert recorder.changes("FLAMER_ALARMS", "PilotFlameOut")[-1] == LOCKED_OUT
