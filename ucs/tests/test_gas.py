"""The shipped repairs of the flaming tool against a tool and a mission controller that say anything: gas is lit only after a purge
that the frames on the bus prove, and never over a lock-out or an alarm of the gas valve."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from random import Random

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from firmware_py.codec import Codec, Value
from firmware_py.mission_controller import DANGERS
from level1.catalog import LOCKED_OUT
from level1.command import Order
from level1.event import Output, Send
from level1.frame import Frame, frame_key
from level1.io import definitions
from level1.supervisor import Supervisor

S = 1_000_000_000
STEP_NS = S // 10
CATALOG = definitions.load(["ucs.dbc", "flaming_tool.dbc"])
CODEC = Codec.shipped("flaming_tool.dbc")
HELD = (2, 3)
"""Repairing, LockedOut: nobody but the UCS commands."""
ORDERS = ("PilotFlameOut", "PilotIgnitionFailure", "ChangeBurnersFailure", "FlamingStartStopFailure", "pause", "resume", "stop",
          "restart")


class Bus:
    """A tool and a mission controller without sense, level 1, and the judge of what level 1 sends."""

    def __init__(self, dice: Random):
        self.dice = dice
        self.target = Supervisor(CATALOG, unit="a", start_ns=0)
        self.now_ns = 0
        self.status: dict[str, Value] = {
            "Flaming": "On", "PilotFlame": "On", "GasValve": "Open", "GasValveDemand": "Open", "Igniter": "Off",
            "Safeguard": "Running", "PilotCurrent": 8.0, "LinePressure": 0.0, "AliveCounter": 0}
        self.burners: dict[str, Value] = {f"Burner{number}": "Low" for number in range(1, 5)}
        self.command: dict[str, Value] = {"Flaming": "On", "GasValve": "Open", "Igniter": "Off", **self.burners}
        self.gas: Value = "Open"
        self.closed_ns: int | None = None
        self.spark_ns: int | None = None
        self.lit = 0

    def go_on(self, seconds: float, heard: bool, obeys: bool) -> None:
        """So long; obeys: the valve does what is commanded, and the safeguard what suits it."""
        for _ in range(round(seconds * 10)):
            if obeys:
                self.status["GasValve"] = self.status["GasValveDemand"] = self.gas
                self.status["Safeguard"] = "Running" if self.gas == "Open" else "Ready"
            if not any(state in HELD for state in self.target.alarm_states().values()):
                self._give("FLAMER_CMD", self.command)
                self.gas = self.command["GasValve"]
            if heard:
                self.status["AliveCounter"] = (int(self.status["AliveCounter"]) + 1) % 16
                self._give("FLAMER_STATUS", self.status)
                self._give("FLAMER_BURNERS", self.burners)
            self.judge(self.target.tick(self.now_ns))
            self.now_ns += STEP_NS

    def order(self, name: str) -> None:
        """Reset an alarm, an order, or a restart of the program."""
        if name == "restart":
            self.target = Supervisor(CATALOG, unit="a", boot=self.target.boot + 1, restored=self.target.state(),
                                     start_ns=self.now_ns)
            self.closed_ns = self.spark_ns = None
            self.judge(self.target.tick(self.now_ns))
            return
        order = Order("x", "reset", name, origin="local") if name in CATALOG.alarms else Order("x", name, origin="local")
        self.judge(self.target.command(order, self.now_ns))

    def judge(self, outputs: Iterable[Output]) -> None:
        """Look at every command of level 1."""
        for output in outputs:
            if isinstance(output, Send) and output.message == "FLAMER_CMD":
                said = CODEC.decode("FLAMER_CMD", output.data)
                assert said is not None
                self._judge(output.t_ns, said["GasValve"] == "Open", said["Igniter"] == "On")
                self.gas = said["GasValve"]

    def _judge(self, t_ns: int, gas: bool, spark: bool) -> None:
        if gas and spark and self.spark_ns is None:
            self.spark_ns = t_ns
            self.lit += 1
            assert self.closed_ns is not None and t_ns - self.closed_ns >= 30 * S, "lit before the purge was over"
            states = self.target.alarm_states()
            assert LOCKED_OUT not in states.values() and not any(states[name] for name in DANGERS), states
            assert self.status["PilotFlame"] == "Off" and self.status["GasValve"] == self.status["GasValveDemand"] == "Closed"
        if self.spark_ns is not None:
            assert t_ns - self.spark_ns <= 3 * S, "the igniter is on for longer than a trial"
        if not spark:
            self.spark_ns = None
        self.closed_ns = None if gas else t_ns if self.closed_ns is None else self.closed_ns

    def _give(self, name: str, values: dict[str, Value]) -> None:
        key = frame_key(*CODEC.identifier(name))
        self.judge(self.target.receive(Frame(self.now_ns, key, CODEC.encode(name, values))))

    def meddle(self) -> None:
        """Something changes."""
        dice, status = self.dice, self.status
        status["PilotFlame"] = dice.choice([status["PilotFlame"], "Off", "Off", "On"])
        if dice.random() < 0.3:
            self.burners[f"Burner{dice.randint(1, 4)}"] = dice.choice(["Off", "Low", "High"])
        elif dice.random() < 0.4:
            self.burners = dict.fromkeys(self.burners, "Off")
        choices: Sequence[tuple[dict[str, Value], str, tuple[Value, ...]]] = (
            (status, "Flaming", ("On", "Off")), (status, "LinePressure", (0.0, 1.4)),
            (self.command, "Flaming", ("On", "Off")), (self.command, "GasValve", ("Open", "Closed")))
        for values, name, choice in choices:
            if dice.random() < 0.12:
                values[name] = dice.choice(choice)


def scramble(seed: int) -> Bus:
    """Some minutes of it."""
    dice = Random(seed)
    bus = Bus(dice)
    for _ in range(dice.randint(4, 12)):
        bus.meddle()
        bus.go_on(dice.choice([0.5, 2, 5, 12, 32, 36, 70]), dice.random() < 0.94, dice.random() < 0.85)
        if dice.random() < 0.2:
            bus.order(dice.choice(ORDERS))
    return bus


@given(st.integers(0, 1 << 30))
@example(89)
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
def test_nothing_that_tool_and_mission_say_lights_gas_without_purge_or_over_a_lock_out(seed: int) -> None:
    scramble(seed)


def test_a_tool_that_behaves_is_lit_again() -> None:
    """What forbids everything proves nothing."""
    bus = Bus(Random(0))
    bus.go_on(2, heard=True, obeys=True)
    bus.status["PilotFlame"], bus.burners = "Off", dict.fromkeys(bus.burners, "Off")
    bus.go_on(33, heard=True, obeys=True)
    assert bus.lit == 1
