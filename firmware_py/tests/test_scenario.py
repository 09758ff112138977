"""Scenario files: what they say, and every mistake told with its line."""
from __future__ import annotations

import re
from pathlib import Path

import pytest

from firmware_py.fault import Statement
from firmware_py.scenario import PROGRAMS, Scenario, ScenarioError, Step, build, parse
from firmware_py.virtual_bus import Simulation

NODES = """
[nodes.flamer]
program = "flaming_tool"
wind = "4 m/s"
gust_every = "2 min"
purged = false
[nodes.mission]
program = "mission_controller"
"""
S = 1_000_000_000


def read(head: str, nodes: str = NODES) -> Scenario:
    return parse(head + nodes, "test.toml")


def problems(head: str, nodes: str = NODES) -> tuple[str, ...]:
    with pytest.raises(ScenarioError) as caught:
        read(head, nodes)
    return caught.value.problems


def test_a_scenario_with_everything() -> None:
    scenario = read('title = "T"\nseed = 7\nduration = "3 min"\n'
                    'orders = ["at 5 s: burner[2] high", "at 1 s: flaming on"]\n'
                    'faults = ["at 12 s: flamer.pilot blown out", "at 60 s: flamer.burner[2] stuck low for 2 commands",\n'
                    '          "at 90 s: flamer.igniter dead for 30 s", "at 2 min: flamer silent"]\n')
    assert (scenario.title, scenario.seed, scenario.duration_ns) == ("T", 7, 180 * S)
    assert scenario.nodes[0].settings == {"wind": 4.0, "gust_every": 120.0, "purged": 0.0}
    assert scenario.steps == (
        Step(S, "mission", Statement("flaming", None, "on"), order=True),
        Step(5 * S, "mission", Statement("burner", 2, "high"), order=True),
        Step(12 * S, "flamer", Statement("pilot", None, "blown out")),
        Step(60 * S, "flamer", Statement("burner", 2, "stuck low", 2)),
        Step(90 * S, "flamer", Statement("igniter", None, "dead")),
        Step(120 * S, "flamer", Statement("igniter", None, "works")),
        Step(120 * S, "flamer", Statement("", None, "silent")),
    )


@pytest.mark.parametrize(("line", "wrong"), [
    ("at 12 s: flmer.pilot blown out", 'unknown node "flmer"; did you mean "flamer"?'),
    ("at 12 s: flamer.pillot blown out", 'unknown device "pillot"; did you mean "pilot"?'),
    ("at 12 s: flamer.pilot blown away", 'unknown action "blown away"; did you mean "blown out"?'),
    ("at 12 s: flamer.pilot", "an action is missing"),
    ("at noon: flamer.pilot blown out", "should be a duration"),
    ("at 12 parsec: flamer.pilot blown out", "is no duration"),
    ("at -1 s: flamer.pilot blown out", "is not between"),
    ("12 s flamer.pilot blown out", 'should read "at TIME: SUBJECT ACTION"'),
    ("at 12 s: flamer.burner[9] stuck", "there is no burner[9], only burner[1] to burner[4]"),
    ("at 12 s: flamer.burner[x] stuck", "there is no burner[x]"),
    ("at 12 s: flamer.pilot[1] blown out", "there is only one pilot"),
    ("at 12 s: flamer.pilot blown out for 3 s", "happens in a moment"),
    ("at 12 s: flamer.igniter dead for 3 commands", "can't be limited to a number of commands"),
    ("at 12 s: flamer.burner[1] stuck for 0 commands", "for at least 1 command"),
    ("at 12 s: flamer.igniter dead for ever", "should be a duration"),
    ("at 2 h: flamer silent", "happens after the end at 60 s"),
])
def test_a_wrong_fault_is_told_with_its_line(line: str, wrong: str) -> None:
    (problem,) = problems(f'seed = 1\nfaults = ["{line}"]\n')
    assert wrong in problem
    assert problem.startswith("test.toml:2:")


@pytest.mark.parametrize(("head", "wrong"), [
    ("sede = 3\n", 'test.toml:1: unknown key "sede"; did you mean "seed"?'),
    ('seed = "x"\n', "seed: 'x' should be a whole number"),
    ("duration = 3\n", "duration: 3 should be a duration"),
    ('duration = "3 days"\n', "duration: '3 days' is no duration"),
    ('orders = "at 1 s: flaming on"\n', "orders: should be a list of texts"),
    ('orders = ["at 1 s: flaming maybe"]\n', 'unknown action "maybe"; known: on, off'),
    ("faults = [1]\n", "faults: should be a list of texts"),
    ("duration = \n", "not valid TOML"),
])
def test_a_wrong_key_is_told(head: str, wrong: str) -> None:
    assert wrong in problems(head)[0]


@pytest.mark.parametrize(("nodes", "wrong"), [
    ("", "no nodes"),
    ("[nodes.flamer]\nwind = '1 m/s'\n", "nodes.flamer: program is missing"),
    ("[nodes.flamer]\nprogram = 'flaming_tol'\n", "unknown program 'flaming_tol'; did you mean \"flaming_tool\"?"),
    ("[nodes.flamer]\nprogram = 'flaming_tool'\nwnd = '1 m/s'\n", 'unknown setting "wnd"; did you mean "wind"?'),
    ("[nodes.flamer]\nprogram = 'flaming_tool'\nwind = 1\n", 'should be a text such as "3 m/s"'),
    ("[nodes.flamer]\nprogram = 'flaming_tool'\nwind = '1 km/h'\n", "should be in m/s"),
    ("[nodes.flamer]\nprogram = 'flaming_tool'\nwind = '99 m/s'\n", "is not between 0 and 40 m/s"),
    ("[nodes.flamer]\nprogram = 'flaming_tool'\npurged = 'yes'\n", "should be true or false"),
    ("[nodes]\nflamer = 3\n", "should be a table [nodes.NAME]"),
])
def test_a_wrong_node_is_told(nodes: str, wrong: str) -> None:
    assert wrong in problems("", nodes)[0]


def test_orders_need_one_node_that_takes_them() -> None:
    nodes = "[nodes.flamer]\nprogram = 'flaming_tool'\n"
    assert "no node takes orders" in problems('orders = ["at 1 s: flaming on"]\n', nodes)[0]
    twice = "[nodes.a]\nprogram = 'mission_controller'\n[nodes.b]\nprogram = 'mission_controller'\n"
    assert "more than one node takes orders" in problems('orders = ["at 1 s: flaming on"]\n', twice)[0]


def test_an_order_goes_to_the_mission_controller_that_knows_its_device() -> None:
    nodes = "[nodes.a]\nprogram = 'sprayer_mission'\n[nodes.b]\nprogram = 'vehicle_mission'\n"
    scenario = parse('orders = ["at 1 s: mission start", "at 2 s: boom open"]\n' + nodes, "test.toml")
    assert [step.node for step in scenario.steps] == ["b", "a"]
    assert 'unknown device "bom"; did you mean "boom"?' in problems('orders = ["at 1 s: bom open"]\n', nodes)[0]


def test_all_mistakes_are_told_at_once() -> None:
    found = problems('sede = 3\nduration = "x"\nfaults = ["at 1 s: flmer silent", "at x: flamer silent"]\n')
    assert len(found) == 4


def test_only_the_chosen_nodes_are_built_and_act() -> None:
    scenario = read('orders = ["at 1 s: flaming on"]\nfaults = ["at 2 s: flamer.pilot blown out"]\n')
    cast = build(scenario, only=["flamer"])
    assert list(cast.nodes) == ["flamer"]
    Simulation(cast.participants).run(5 * S)


def test_faults_happen_at_their_times() -> None:
    scenario = read('faults = ["at 2 s: flamer silent for 3 s"]\n')
    happenings: list[tuple[int, str]] = []
    Simulation(build(scenario).participants,
               on_happening=lambda happening: happenings.append((happening.t_ns, happening.text))).run(10 * S)
    assert happenings == [(2 * S, "fault: silent"), (5 * S, "works again")]


def test_the_scenario_of_the_readme_runs() -> None:
    text = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    simulation = Simulation(build(parse(example, "README.md")).participants)
    simulation.run(10 * S)
    assert simulation.frames > 100


def test_every_phrase_of_every_program_can_be_written() -> None:
    for program, node in PROGRAMS.items():
        for phrase in node.FAULTS:
            subject = f"node.{phrase.device}" if phrase.device else "node"
            index = "[1]" if phrase.count else ""
            text = f'faults = ["at 1 s: {subject}{index} {phrase.action}"]\n[nodes.node]\nprogram = "{program}"\n'
            (step, *_) = parse(text, "test.toml").steps
            assert step.statement.action == phrase.action


KINDS = ("stuck blocked", "slow", "refuses", "drifts", "silent", "frozen", "babbling", "wrong counter", "reset")
"""What a machine does wrong; the first: either word."""


@pytest.mark.parametrize("program", ["flaming_tool", "sprayer_boom", "airblast_sprayer", "vehicle"])
def test_every_machine_knows_every_kind_of_fault(program: str) -> None:
    said = [phrase.action for phrase in PROGRAMS[program].FAULTS]
    words = {word for action in said for word in action.split()}
    assert [kind for kind in KINDS if kind not in said and not words & set(kind.split())] == []
    assert len({(phrase.device, phrase.action) for phrase in PROGRAMS[program].FAULTS}) == len(said), "each is told once"
