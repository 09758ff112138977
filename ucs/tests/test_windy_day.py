"""A windy day for the flaming tool: hours of gusts, every relight after a purge and verified, too many told, none locked out."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from firmware_py.fault import Statement
from firmware_py.flaming_tool import FlamingTool
from firmware_py.participant import Happening
from firmware_py.safeguard import PURGE_NS
from firmware_py.scenario import Step, build
from firmware_py.virtual_bus import Simulation
from level1.event import Event, Output
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.simulate import load
from ucs.simulated_unit import SimulatedUnit

S = 1_000_000_000
MORNING_NS = 2 * 3600 * S
BREAK_S = (6000.0, 6720.0)
DEAD_S = 7000.0
"""The igniter dies, so that what is not the wind's is locked out, after all that the wind has used."""

WORK_S, DAY_WORK_S = 6280, 26280
"""Time in which the flame is wanted: until the igniter dies, and in the whole day, which has to relight 200 times."""


class Morning:
    """The first two hours of the shipped day. lit: whether a flame burnt at each `repaired`."""

    def __init__(self) -> None:
        day = load("windy_day.toml")
        dead = Step(round(DEAD_S * S), "flamer", Statement("igniter", None, "dead"))
        cast = build(replace(day, duration_ns=MORNING_NS, steps=tuple(sorted((*day.steps, dead), key=lambda step: step.t_ns))))
        tool = cast.nodes["flamer"]
        assert isinstance(tool, FlamingTool)
        self.tool = tool
        self.events: list[Event] = []
        self.lit: list[bool] = []
        self.told: list[Happening] = []
        unit = SimulatedUnit(Supervisor(definitions.load(["flaming_tool.dbc", "ucs.dbc"]), unit="u", start_ns=0), self._deliver)
        Simulation([*cast.participants, unit], on_happening=self.told.append).run(MORNING_NS)

    def _deliver(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, Event):
                self.events.append(output)
                if output.event == "repaired":
                    self.lit.append(self.tool.plant.flame)

    def of(self, alarm: str) -> list[Event]:
        return [event for event in self.events if event.alarm == alarm]

    def at_s(self, alarm: str, word: str) -> list[float]:
        return [float(event.t) for event in self.of(alarm) if event.event == word]


@pytest.fixture(scope="module")
def morning() -> Morning:
    return Morning()


def test_each_flame_that_the_wind_blows_out_is_lit_again_and_seen_to_burn(morning: Morning) -> None:
    counts = Counter(event.event for event in morning.of("PilotFlameOut") if event.t < DEAD_S)
    assert counts["repaired"] >= 200 * WORK_S // DAY_WORK_S
    assert counts["repair_started"] - counts["repaired"] - counts["repair_failed"] in (0, 1)
    assert counts["locked_out"] == 0
    assert all(morning.lit)


def test_gas_flows_only_after_a_purge_that_was_finished_and_checked(morning: Morning) -> None:
    gas = [happening for happening in morning.told if happening.text in ("gas valve opens", "gas valve closed")]
    purged = [happening.t_ns for happening in morning.told if happening.text.startswith("purged")]
    for before, now in pairwise(gas):
        if now.text == "gas valve opens":
            assert before.text == "gas valve closed"
            assert now.t_ns - before.t_ns >= PURGE_NS
            assert any(before.t_ns < t_ns <= now.t_ns for t_ns in purged)
    assert morning.tool.hazards == []


def test_too_many_in_ten_minutes_are_told_until_the_wind_no_longer_gets_at_a_flame(morning: Morning) -> None:
    outs = morning.at_s("PilotFlameOut", "raised")
    raised, cleared = morning.at_s("PilotFlameTooOften", "raised"), morning.at_s("PilotFlameTooOften", "cleared")
    assert raised[0] == outs[2]
    assert outs[2] - outs[0] < 600
    assert [t for t in cleared if BREAK_S[0] < t < BREAK_S[1]] == [pytest.approx(outs[sum(t < BREAK_S[0] for t in outs) - 2] + 600)]
    assert len(raised) == 2


def test_an_igniter_that_is_dead_is_locked_out_after_three_attempts(morning: Morning) -> None:
    end = [event for event in morning.of("PilotFlameOut") if event.t > DEAD_S]
    (locked,) = (event for event in end if event.event == "locked_out")
    story = [(event.event, event.attempt) for event in end if event.instance == locked.instance]
    assert story == [("raised", 0), ("repair_started", 1), ("repair_failed", 1), ("repair_started", 2), ("repair_failed", 2),
                     ("repair_started", 3), ("repair_failed", 3), ("locked_out", 3)]
