"""A scenario: which nodes there are, what the mission orders, which faults happen when. Written in TOML, checked before it runs.

    seed = 7                        # the same seed gives the same run, byte for byte
    duration = "3 min"
    orders = ["at 1 s: flaming on", "at 5 s: burner[2] high"]
    faults = ["at 12 s: flamer.pilot blown out",
              "at 60 s: flamer.burner[2] stuck low for 2 commands",
              "at 90 s: flamer.igniter dead for 30 s",
              "at 2 min: flamer silent"]
    [nodes.flamer]
    program = "flaming_tool"
    wind = "4 m/s"                  # the program's settings
    [nodes.mission]
    program = "mission_controller"

An order or fault reads `at TIME: SUBJECT ACTION [for TIME | for N commands]`. The subject of a fault is the node, with a dot and
the device where it has devices; that of an order is the device: the mission controller that knows it takes the order.
`device[2]` is one of several; without it all are meant.
"""
from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from random import Random
from typing import Any

from firmware_py.airblast_mission import AirblastMission
from firmware_py.airblast_sprayer import AirblastSprayer
from firmware_py.codec import Codec
from firmware_py.computer import Computer
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.flaming_tool import FlamingTool
from firmware_py.mission_controller import MissionController
from firmware_py.node import Node
from firmware_py.participant import BusFrame
from firmware_py.path_driver import PathDriver
from firmware_py.quantity import QuantityError, duration_ns
from firmware_py.sprayer_boom import SprayerBoom
from firmware_py.sprayer_mission import SprayerMission
from firmware_py.ultrasonic_sensors import UltrasonicSensors
from firmware_py.vehicle import Vehicle
from firmware_py.vehicle_mission import VehicleMission

Program = (type[FlamingTool] | type[MissionController] | type[SprayerBoom] | type[SprayerMission] | type[PathDriver]
           | type[AirblastSprayer] | type[AirblastMission] | type[UltrasonicSensors]
           | type[Vehicle] | type[VehicleMission] | type[Computer])
PROGRAMS: Mapping[str, Program] = {
    "flaming_tool": FlamingTool,
    "mission_controller": MissionController,
    "sprayer_boom": SprayerBoom,
    "sprayer_mission": SprayerMission,
    "path_driver": PathDriver,
    "airblast_sprayer": AirblastSprayer,
    "ultrasonic_sensors": UltrasonicSensors,
    "airblast_mission": AirblastMission,
    "vehicle": Vehicle,
    "vehicle_mission": VehicleMission,
    "computer": Computer,
}
KEYS = ("title", "seed", "duration", "nodes", "orders", "faults")
DEFAULT_DURATION_NS = 60_000_000_000

_LINE = re.compile(r"at\s+(?P<time>[^:]+?)\s*:\s*(?P<subject>[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)?)(?:\[(?P<index>\w+)\])?"
                   r"(?:\s+(?P<action>\S.*?))??(?:\s+for\s+(?P<limit>\S.*))?")
_COMMANDS = re.compile(r"(\d+)\s+commands?")


class ScenarioError(Exception):
    """A scenario that can't be run. problems: every mistake found, one line each: where, what is wrong, what to do."""

    def __init__(self, problems: Iterable[str]):
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))


@dataclass(frozen=True)
class NodePlan:
    """A node of a scenario: its program and settings, in their units."""

    name: str
    program: str
    settings: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Step:
    """Something that happens to a node at a time (ns from the start). order: the mission controller is told to do it."""

    t_ns: int
    node: str
    statement: Statement
    order: bool = False


@dataclass(frozen=True)
class Scenario:
    """What was read. steps: in the order of their times."""

    title: str
    seed: int
    duration_ns: int
    nodes: tuple[NodePlan, ...]
    steps: tuple[Step, ...]


class Director:
    """Makes a scenario's steps happen to its nodes. A participant that neither hears nor sends; it comes first in the line."""

    meddles = True

    def __init__(self, steps: Iterable[Step], nodes: Mapping[str, Node]):
        self._steps = [step for step in steps if step.node in nodes]
        self._nodes = nodes
        self._next = 0

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """Nothing reaches it."""

    def hears(self, can_id: int, extended: bool) -> bool:
        """Nothing."""
        return False

    def step(self, now_ns: int) -> list[BusFrame]:
        """Whatever is due happens."""
        while self._next < len(self._steps) and self._steps[self._next].t_ns <= now_ns:
            step = self._steps[self._next]
            self._next += 1
            node = self._nodes[step.node]
            if step.order and isinstance(node, (MissionController, SprayerMission, AirblastMission, VehicleMission)):
                node.order(now_ns, step.statement)
            else:
                node.inject(now_ns, step.statement)
        return []

    def next_deadline(self) -> int | None:
        """The time of the next step."""
        return self._steps[self._next].t_ns if self._next < len(self._steps) else None


@dataclass(frozen=True)
class Cast:
    """The participants of a scenario, ready to run. `participants` lists all of them, the director first."""

    director: Director
    nodes: Mapping[str, Node]

    @property
    def participants(self) -> tuple[Director | Node, ...]:
        """For a bus."""
        return (self.director, *self.nodes.values())


def build(scenario: Scenario, *, seed: int | None = None, only: Collection[str] = (), codec: Codec | None = None) -> Cast:
    """The nodes of a scenario, each with its own chance from the seed. only: build just these; unknown names are ignored.

    codec: of all the files they need, when one is there already.
    """
    chosen = [plan for plan in scenario.nodes if not only or plan.name in only]
    programs = [PROGRAMS[plan.program] for plan in chosen]
    codec = codec or Codec.shipped(*dict.fromkeys(name for program in programs for name in (program.DBC, *program.MORE_DBC)))
    nodes: dict[str, Node] = {}
    for plan in chosen:
        random = Random(f"{scenario.seed if seed is None else seed}/{plan.name}")
        nodes[plan.name] = PROGRAMS[plan.program](plan.name, codec, plan.settings, random)
    return Cast(Director(scenario.steps, nodes), nodes)


def parse(text: str, path: str) -> Scenario:
    """A scenario from its text; path is for messages only. Raises ScenarioError with every mistake."""
    return _Reader(text, path).read()


class _Reader:
    """Reads one scenario and collects its problems on the way."""

    def __init__(self, text: str, path: str):
        self._lines = text.splitlines()
        self._text = text
        self._path = path
        self._problems: list[str] = []

    def read(self) -> Scenario:
        """The scenario. Raises ScenarioError."""
        try:
            table = tomllib.loads(self._text)
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError([f"{self._path}: not valid TOML: {error}"]) from error
        for key in table:
            if key not in KEYS:
                self._problem(key, f'unknown key "{key}"{_hint(key, KEYS)}')
        duration = self._duration(table)
        seed = table.get("seed", 1)
        if not isinstance(seed, int) or isinstance(seed, bool):
            self._problem("seed", f"seed: {seed!r} should be a whole number")
        plans = self._nodes(table.get("nodes"))
        steps = [*self._orders(self._texts(table, "orders"), plans), *self._faults(self._texts(table, "faults"), plans)]
        late = [step for step in steps if step.t_ns > duration and step.statement.action != WORKS]
        for step in late:
            self._problem(f"{step.statement}", f"{step.node} {step.statement}: happens after the end at {duration / 1e9:g} s; "
                          "make duration longer")
        if self._problems:
            raise ScenarioError(self._problems)
        return Scenario(str(table.get("title", "")), seed, duration, tuple(plans.values()),
                        tuple(sorted(steps, key=lambda step: step.t_ns)))

    def _problem(self, needle: str, text: str) -> None:
        """Tell a mistake, with the line of the scenario in which the needle stands."""
        line = next((number for number, content in enumerate(self._lines, 1) if needle in content.partition("#")[0]), None)
        self._problems.append(f"{self._path}{f':{line}' if line else ''}: {text}")

    def _duration(self, table: Mapping[str, Any]) -> int:
        try:
            return duration_ns(table["duration"]) if "duration" in table else DEFAULT_DURATION_NS
        except QuantityError as error:
            self._problem("duration", f"duration: {error}")
            return DEFAULT_DURATION_NS

    def _texts(self, table: Mapping[str, Any], key: str) -> list[str]:
        texts = table.get(key, [])
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            self._problem(key, f'{key}: should be a list of texts such as "at 12 s: …"')
            return []
        return texts

    def _nodes(self, table: Any) -> dict[str, NodePlan]:
        if not isinstance(table, dict) or not table:
            self._problem("nodes", 'no nodes: add a table such as [nodes.flamer] with program = "flaming_tool"')
            return {}
        plans = {}
        for name, settings in table.items():
            if not re.fullmatch(r"[A-Za-z_]\w*", name) or not isinstance(settings, dict):
                self._problem(name, f'nodes.{name}: should be a table [nodes.NAME], the name of letters, digits and "_"')
            elif plan := self._node(name, dict(settings)):
                plans[name] = plan
        return plans

    def _node(self, name: str, settings: dict[str, Any]) -> NodePlan | None:
        program = settings.pop("program", None)
        if program not in PROGRAMS:
            missing = "program is missing" if program is None else f"unknown program {program!r}"
            self._problem(f"nodes.{name}", f"nodes.{name}: {missing}{_hint(str(program), PROGRAMS)}")
            return None
        known = {setting.name: setting for setting in PROGRAMS[program].SETTINGS}
        values = {}
        for key, value in settings.items():
            if key not in known:
                self._problem(key, f'nodes.{name}: unknown setting "{key}"{_hint(key, known)}')
                continue
            try:
                values[key] = known[key].parse(value)
            except QuantityError as error:
                self._problem(key, f"nodes.{name}.{key}: {error}")
        return NodePlan(name, program, values)

    # --- orders and faults ------------------------------------------------------------------------------------------------

    def _orders(self, texts: list[str], plans: Mapping[str, NodePlan]) -> list[Step]:
        takers = [plan for plan in plans.values() if PROGRAMS[plan.program].ORDERS]
        if texts and not takers:
            self._problem("orders", 'orders: no node takes orders; one node needs program = "mission_controller"')
            return []
        steps: list[Step] = []
        for text in texts:
            if (match := self._match(text)) is None:
                continue
            subject = match["subject"]
            of_device = [plan for plan in takers if any(phrase.device == subject for phrase in PROGRAMS[plan.program].ORDERS)]
            if len(of_device) > 1:
                names = " and ".join(plan.name for plan in of_device)
                self._problem(text, f'"{text}": more than one node takes orders to {subject}: {names}')
                continue
            phrases = [phrase for plan in of_device or takers for phrase in PROGRAMS[plan.program].ORDERS]
            steps += self._steps(text, match, (of_device or takers)[0].name, subject, phrases, order=True)
        return steps

    def _faults(self, texts: list[str], plans: Mapping[str, NodePlan]) -> list[Step]:
        steps: list[Step] = []
        for text in texts:
            if (match := self._match(text)) is None:
                continue
            node, _, device = match["subject"].partition(".")
            if node not in plans:
                self._problem(text, f'"{text}": unknown node "{node}"{_hint(node, plans)}')
            else:
                steps += self._steps(text, match, node, device, PROGRAMS[plans[node].program].FAULTS, order=False)
        return steps

    def _match(self, text: str) -> re.Match[str] | None:
        match = _LINE.fullmatch(text.strip())
        if match is None:
            self._problem(text, f'"{text}": should read "at TIME: SUBJECT ACTION", such as "at 12 s: flamer.pilot blown out"')
        return match

    def _steps(self, text: str, match: re.Match[str], node: str, device: str, phrases: Collection[Phrase], *,
               order: bool) -> list[Step]:
        """The step of a line, and the one that ends it after its duration."""
        try:
            t_ns = duration_ns(match["time"])
            phrase = self._phrase(device, match["action"] or "", phrases)
            index = _index(phrase, match["index"])
            commands, lasting_ns = _limit(phrase, match["limit"])
        except ValueError as error:
            self._problem(text, f'"{text}": {error}')
            return []
        steps = [Step(t_ns, node, Statement(device, index, phrase.action, commands), order)]
        if lasting_ns is not None:
            steps.append(Step(t_ns + lasting_ns, node, Statement(device, index, WORKS)))
        return steps

    @staticmethod
    def _phrase(device: str, action: str, phrases: Collection[Phrase]) -> Phrase:
        of_device = {phrase.action: phrase for phrase in phrases if phrase.device == device}
        if not of_device:
            devices = [phrase.device for phrase in phrases if phrase.device]
            raise ValueError(f'unknown device "{device}"{_hint(device, devices)}')
        normal = " ".join(action.split())
        if normal not in of_device:
            wrong = f'unknown action "{normal}"' if normal else "an action is missing"
            raise ValueError(f"{wrong}{_hint(normal, of_device)}")
        return of_device[normal]


def _index(phrase: Phrase, text: str | None) -> int | None:
    if text is None:
        return None
    if not phrase.count:
        raise ValueError(f"there is only one {phrase.device or 'node'}: write it without [{text}]")
    if not text.isdecimal() or not 1 <= int(text) <= phrase.count:
        raise ValueError(f"there is no {phrase.device}[{text}], only {phrase.device}[1] to {phrase.device}[{phrase.count}]")
    return int(text)


def _limit(phrase: Phrase, text: str | None) -> tuple[int | None, int | None]:
    """Number of commands, or duration in ns, after `for`."""
    if text is None:
        return None, None
    if match := _COMMANDS.fullmatch(text):
        if not phrase.counted:
            raise ValueError(f'"{phrase.action}" can\'t be limited to a number of commands')
        if int(match[1]) < 1:
            raise ValueError("for at least 1 command")
        return int(match[1]), None
    if not phrase.lasts:
        raise ValueError(f'"{phrase.action}" happens in a moment: leave out "for {text}"')
    return None, duration_ns(text)


def _hint(word: str, known: Iterable[str]) -> str:
    """`; did you mean "…"?`, or what there is."""
    names = list(dict.fromkeys(known))
    close = get_close_matches(word, names, n=1, cutoff=0.6)
    if close:
        return f'; did you mean "{close[0]}"?'
    return f"; known: {', '.join(names)}" if names else ""
