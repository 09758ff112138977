"""The monitoring messages of SPEC §3: every 250 ms without drift, complete, each value with its age and quality."""
from __future__ import annotations

import itertools
from decimal import Decimal
from typing import NamedTuple

import pytest

from firmware_py.fault import Statement
from firmware_py.scenario import build
from firmware_py.virtual_bus import Simulation
from level1.event import Monitor
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.simulate import load
from ucs.simulated_unit import SimulatedUnit

SECOND = 1_000_000_000
PERIOD_NS = SECOND // 4
SILENT_FROM_S, UNTIL_S = 20, 30


class Row(NamedTuple):
    """A message of SPEC §3: who sends it, what it says, and the scenario and node that show it."""

    producer: str
    message: str
    scenario: str
    node: str
    file: str
    signals: tuple[str, ...]


ROWS = [
    Row("vehicle", "controller", "vehicle_healthy.toml", "tractor", "vehicle.dbc", ("Controller",)),
    Row("vehicle", "motion", "vehicle_healthy.toml", "tractor", "vehicle.dbc",
        ("PositionLatitude", "PositionLongitude", "DriveSpeed", "DriveHeading", "PtoState", "HitchPosition")),
    Row("flaming tool", "implement", "healthy.toml", "flamer", "flaming_tool.dbc", ("Flaming",)),
    Row("flaming tool", "burners", "healthy.toml", "flamer", "flaming_tool.dbc", tuple(f"Burner{n}" for n in range(1, 5))),
    Row("sprayer boom", "implement", "sprayer_faults.toml", "sprayer", "sprayer_boom.dbc", ("Spraying",)),
    Row("sprayer boom", "nozzles", "sprayer_faults.toml", "sprayer", "sprayer_boom.dbc", tuple(f"Valve{n}" for n in range(1, 13))),
    Row("air-blast sprayer", "implement", "airblast_healthy.toml", "sprayer", "airblast_sprayer.dbc", ("Airblast",)),
]


def covers(row: Row) -> pytest.MarkDecorator:
    return pytest.mark.covers(f"monitoring: {row.producer} {row.message}")


@pytest.mark.parametrize("row", [pytest.param(row, marks=covers(row)) for row in ROWS],
                         ids=[f"{row.producer} {row.message}" for row in ROWS])
def test_each_value_is_told_four_times_a_second_with_its_age_and_an_old_one_says_so(row: Row) -> None:
    catalog = definitions.load([row.file])
    samples: list[Monitor] = []
    unit = SimulatedUnit(Supervisor(catalog, unit="tractor-7", start_ns=0, monitor_ns=PERIOD_NS), lambda outputs: samples.extend(
        output for output in outputs if isinstance(output, Monitor) and output.message == row.message))
    cast = build(load(row.scenario))
    simulation = Simulation([*cast.participants, unit])
    simulation.run(SILENT_FROM_S * SECOND)
    cast.nodes[row.node].inject(simulation.now_ns, Statement("", None, "silent"))
    simulation.run(UNTIL_S * SECOND)
    assert samples[0].t == 0
    assert {after.t - before.t for before, after in itertools.pairwise(samples)} == {Decimal("0.25")}
    cycles_s = {signal.name: (message.cycle_ns or 0) / SECOND for message in catalog.messages.values()
                for signal in message.signals}
    first, fresh, old = samples[0], samples[4 * (SILENT_FROM_S - 1)], samples[-1]
    for name in row.signals:
        assert (first.values[name], first.quality[name], first.age_s[name]) == (None, "never", None)
        assert fresh.values[name] is not None and fresh.quality[name] == "good"
        assert 0 <= (fresh.age_s[name] or 0) <= cycles_s[name]
        assert (old.values[name], old.quality[name]) == (None, "stale")
        assert (old.age_s[name] or 0) > UNTIL_S - SILENT_FROM_S - 1
