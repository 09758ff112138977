"""What happens on a day of the season: which machine works, and what breaks when. Drawn from the seed, from nothing else."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from random import Random

from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.scenario import PROGRAMS, NodePlan

S = 1_000_000_000


@dataclass(frozen=True)
class Machine:
    """A kind of day. programs: node name -> program. share: how many days of a hundred."""

    programs: Mapping[str, str]
    share: int


MACHINES: Mapping[str, Machine] = {
    "flaming tool": Machine({"flamer": "flaming_tool", "mission": "mission_controller"}, 25),
    "sprayer boom": Machine({"sprayer": "sprayer_boom", "mission": "sprayer_mission", "computer": "computer"}, 20),
    "tractor with boom": Machine({"tractor": "vehicle", "driver": "vehicle_mission", "sprayer": "sprayer_boom",
                                  "mission": "sprayer_mission"}, 20),
    "tractor": Machine({"tractor": "vehicle", "driver": "vehicle_mission", "computer": "computer"}, 15),
    "air-blast sprayer": Machine({"airblast": "airblast_sprayer", "ultrasonic": "ultrasonic_sensors",
                                  "mission": "airblast_mission"}, 20),
}
SETTLE_NS = 420 * S
"""At the end of a day nothing breaks any more for so long, or for a third of it: what was repaired has cleared, people have reset
the rest."""
MEAN_GAP_S = 100.0
"""Between two faults."""
SHORTEST_S, LONGEST_S = 2.0, 90.0
SLOW: Mapping[str, tuple[float, float]] = {
    "coolant": (40, 240), "alternator": (15, 150), "level_sensor": (20, 150), "main_tank": (20, 90), "bottle": (20, 120),
    "engine": (5, 150),
    "sensor": (4, 60), "boom": (10, 90), "burner": (5, 120), "cpu": (40, 180), "board": (60, 240), "memory": (40, 120),
    "storage": (20, 120), "clock": (90, 400)}
"""Devices whose faults need longer to show, s."""
FILLED: Mapping[str, str] = {"main_tank": "filled", "dis_tank": "filled", "tank": "filled", "bottle": "changed"}
"""Someone fills, or changes, what was emptied."""
NO_FAULTS = {("start_button", "pressed"), ("path", "loaded"), *FILLED.items()}
MAX_COMMANDS = 4


@dataclass(frozen=True)
class Fault:
    """One thing that breaks. until_ns: when it is ended, None: when it happens in a moment. ending: what ends it."""

    t_ns: int
    node: str
    program: str
    statement: Statement
    until_ns: int | None = None
    ending: Statement | None = None

    @property
    def name(self) -> str:
        """As the oracle's table has it."""
        return f"{self.statement.device} {self.statement.action}".strip()


@dataclass(frozen=True)
class Plan:
    """A day. faults: by their beginning. seed: of its nodes, and of those who give orders."""

    number: int
    seed: str
    machine: str
    nodes: tuple[NodePlan, ...]
    length_ns: int
    faults: tuple[Fault, ...]


def plan(seed: int, number: int, length_ns: int, machine: str | None = None) -> Plan:
    """The day of that number of the season of that seed."""
    name = f"{seed}/{number}"
    dice = Random(name)
    settle_ns = min(SETTLE_NS, length_ns // 3)
    machine = machine or dice.choices([*MACHINES], [kind.share for kind in MACHINES.values()])[0]
    programs = MACHINES[machine].programs
    nodes = tuple(NodePlan(node, program, _settings(program, dice)) for node, program in programs.items())
    faults = sorted(_faults(programs, dice, length_ns - settle_ns), key=lambda one: one.t_ns)
    return Plan(number, name, machine, nodes, length_ns, tuple(faults))


def _settings(program: str, dice: Random) -> dict[str, float]:
    match program:
        case "flaming_tool":
            return {"wind": dice.uniform(0, 5), "gust": dice.uniform(7, 13), "gust_every": dice.choice([0, 300, 900, 1800]),
                    "air_temperature": dice.uniform(5, 30), "bottle_level": dice.uniform(40, 95)}
        case "sprayer_boom":
            return {"main_tank": dice.uniform(80, 200), "dis_tank": dice.uniform(4, 10)}
        case "vehicle":
            return {"speed": dice.uniform(0.8, 3), "turn_speed": dice.uniform(0.6, 2), "fuel": dice.uniform(25, 100)}
        case "computer":
            return {"ambient": dice.uniform(5, 35)}
        case "ultrasonic_sensors":
            return {"speed": dice.uniform(1.5, 4), "trees_missing": dice.uniform(0, 30)}
        case _:
            return {}


def _faults(programs: Mapping[str, str], dice: Random, until_ns: int) -> list[Fault]:
    """Faults at random times. One device has one fault at a time: `works` would end them all; devices overlap freely."""
    kinds = [(node, program, phrase) for node, program in programs.items() for phrase in PROGRAMS[program].FAULTS
             if phrase.action != WORKS and (phrase.device, phrase.action) not in NO_FAULTS]
    free_ns: dict[tuple[str, str, int | None], int] = {}
    faults = []
    t_s = dice.uniform(30, 90)
    while t_s * S < until_ns:
        node, program, phrase = dice.choice(kinds)
        fault = _draw(node, program, phrase, round(t_s * 1000) * (S // 1000), dice)
        place = (node, phrase.device, fault.statement.index)
        if free_ns.get(place, 0) <= fault.t_ns:
            free_ns[place] = (fault.until_ns or fault.t_ns) + 30 * S
            faults.append(fault)
        t_s += dice.expovariate(1 / MEAN_GAP_S)
    return faults


def _draw(node: str, program: str, phrase: Phrase, t_ns: int, dice: Random) -> Fault:
    index = dice.randint(1, phrase.count) if phrase.count else None
    low, high = SLOW.get(phrase.device, (SHORTEST_S, LONGEST_S))
    until_ns = t_ns + round(1000 * low * (high / low) ** dice.random()) * (S // 1000)
    filled = FILLED.get(phrase.device)
    if not phrase.lasts and filled is None:
        return Fault(t_ns, node, program, Statement(phrase.device, index, phrase.action))
    ending = Statement(phrase.device, index, WORKS if phrase.lasts else str(filled))
    commands = dice.randint(1, MAX_COMMANDS) if phrase.counted and dice.random() < 0.4 else None
    if commands is not None:
        until_ns = max(until_ns, t_ns + 60 * S)
    return Fault(t_ns, node, program, Statement(phrase.device, index, phrase.action, commands), until_ns, ending)
