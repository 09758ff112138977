"""`unit.toml`: what loads, and that every mistake is one line with the key's path and what to do."""
from __future__ import annotations

from pathlib import Path

import pytest

from level1.catalog import Alarm, Catalog, Repair
from level1.expression import Boolean
from level1.io import config

GOOD = """
[unit]
name = "tractor-7"
fleet = "north-farm"
[[bus]]
name = "implement"
interface = "socketcan"
channel = "can0"
dbc = ["ucs.dbc", "flaming_tool.dbc"]
[gnss]
port = "/dev/ttyUSB0"
baud = 115200
[repairs]
armed = ["NozzlesNotSet"]
[journal]
path = "/var/lib/ucs/journal.db"
[bridge]
broker = "mqtts://level2.local:8883"
period = "250 ms"
"""


def load(tmp_path: Path, text: str) -> config.Config:
    file = tmp_path / "unit.toml"
    file.write_text(text)
    return config.load(file)


def problems(tmp_path: Path, text: str) -> list[str]:
    """The problems without the file's name, which must stand before each."""
    with pytest.raises(config.ConfigError) as caught:
        load(tmp_path, text)
    head = f"{tmp_path / 'unit.toml'}: "
    assert all(line.startswith(head) and "\n" not in line for line in caught.value.problems)
    return [line.removeprefix(head) for line in caught.value.problems]


def test_the_example_of_the_design_loads(tmp_path: Path) -> None:
    loaded = load(tmp_path, GOOD)
    assert loaded.unit == config.Unit("tractor-7", "north-farm")
    assert loaded.bus == (config.Bus("implement", "can0", ("ucs.dbc", "flaming_tool.dbc")),)
    assert loaded.bus_files == {0: ("ucs.dbc", "flaming_tool.dbc")}
    assert loaded.repairs.armed == ("NozzlesNotSet",)
    assert loaded.journal == config.JournalFile("/var/lib/ucs/journal.db")
    assert loaded.bridge == config.BridgeSettings("mqtts://level2.local:8883", 250_000_000)
    assert loaded.gnss == config.Gnss("/dev/ttyUSB0", 115200)


def test_recorder_and_health_have_a_bound_and_a_period(tmp_path: Path) -> None:
    loaded = load(tmp_path, GOOD + '[recorder]\npath = "traffic"\nmax_mb = 200\n[health]\nperiod = "500 ms"\nbroadcast = false\n')
    assert loaded.recorder == config.Recording(str(tmp_path / "traffic"), 200)
    assert loaded.health == config.Health(500_000_000, False)
    assert load(tmp_path, GOOD).recorder is None and load(tmp_path, GOOD).health == config.Health(1_000_000_000, True)


@pytest.mark.parametrize(("more", "problem"), [
    ('[recorder]\npath = "traffic"\nmax_mb = 1\n', "recorder.max_mb: 1 is outside 2 to 10000000 megabytes"),
    ("[recorder]\nmax_mb = 10\n", 'recorder.path: missing; add path = "…"'),
    ('[health]\nperiod = "2 s"\n', 'health.period: "2 s" is outside 100 ms to 1 s'),
    ('[health]\nperiod = "50 ms"\n', 'health.period: "50 ms" is outside 100 ms to 1 s'),
    ('[health]\nbroadcast = "yes"\n', "health.broadcast: expected true or false, found a text ('yes')"),
])
def test_mistakes_about_recorder_and_health(tmp_path: Path, more: str, problem: str) -> None:
    assert problems(tmp_path, GOOD + more) == [problem]


def test_the_monitoring_history_has_a_bound(tmp_path: Path) -> None:
    path = 'path = "/var/lib/ucs/journal.db"'
    journal = load(tmp_path, GOOD.replace(path, f"{path}\nmonitor_mb = 0")).journal
    assert journal == config.JournalFile("/var/lib/ucs/journal.db", 0)
    assert problems(tmp_path, GOOD.replace(path, f"{path}\nmonitor_mb = -1")) == [
        "journal.monitor_mb: -1 is outside 0 to 10000000 megabytes"]


def test_the_smallest_configuration_arms_nothing(tmp_path: Path) -> None:
    loaded = load(tmp_path, '[unit]\nname = "a"\n[[bus]]\nname = "b"\nchannel = "can0"\ndbc = ["ucs.dbc"]\n')
    assert loaded.repairs.armed == () and loaded.journal is None and loaded.bridge is None


def test_paths_count_from_the_folder_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "own.dbc").touch()
    text = GOOD.replace('"flaming_tool.dbc"', '"own.dbc"').replace("/var/lib/ucs/", "")
    text += 'ca = "ca.pem"\n'
    loaded = load(tmp_path, text)
    assert loaded.bus[0].dbc == ("ucs.dbc", str(tmp_path / "own.dbc"))
    assert loaded.journal and loaded.journal.path == str(tmp_path / "journal.db")
    assert loaded.bridge and loaded.bridge.ca == str(tmp_path / "ca.pem")


@pytest.mark.parametrize(("old", "new", "problem"), [
    ('channel = "can0"', 'chanel = "can0"', 'bus[0].chanel: unknown key; did you mean "channel"?'),
    ("[repairs]", "[repair]", 'repair: unknown key; did you mean "repairs"?'),
    ('channel = "can0"', "channel = 0", "bus[0].channel: expected a text, found a whole number (0)"),
    ('port = "/dev/ttyUSB0"', "", 'gnss: a receiver speaks on a serial line or on a bus; give port = "/dev/…" or bus = "…"'),
    ('port = "/dev/ttyUSB0"', 'bus = "implemnt"', 'gnss.bus: no bus is called "implemnt"; did you mean "implement"?'),
    ("baud = 115200", 'baud = "fast"', "gnss.baud: expected a whole number, found a text ('fast')"),
    ("baud = 115200", "baud = true", "gnss.baud: expected a whole number, found true or false (True)"),
    ("baud = 115200", "baud = 1", "gnss.baud: 1 is outside 1200 to 4000000 bit/s"),
    ('["NozzlesNotSet"]', '"NozzlesNotSet"',
     "repairs.armed: expected a list such as [\"…\", \"…\"], found a text ('NozzlesNotSet')"),
    ('["NozzlesNotSet"]', "[3]", "repairs.armed[0]: expected a text, found a whole number (3)"),
    ("[[bus]]", "[bus]", "bus: expected [[bus]] tables, found a table"),
    ('"250 ms"', "250",
     'bridge.period: expected a duration with its unit, such as "250 ms", found a whole number (250)'),
    ('"250 ms"', '"250"',
     'bridge.period: "250" is no duration; write a number and a unit (us, ms, s, min, h), such as "250 ms"'),
    ('"250 ms"', '"1 h"', 'bridge.period: "1 h" is outside 10 ms to 1 min'),
    ('name = "tractor-7"', 'name = "tractor 7"',
     'unit.name: "tractor 7" can\'t stand in an MQTT topic; '
     'leave out spaces, "/", "+", "#" and a "$" at the start, and take at most 64 letters'),
    ("mqtts://level2.local:8883", "level2.local",
     'bridge.broker: "level2.local" is no MQTT address; write "mqtt://host:1883" or "mqtts://host:8883"'),
    ("mqtts://level2.local:8883", "mqtt://host:99999999",
     'bridge.broker: "mqtt://host:99999999" has a wrong port; write "mqtt://host:1883" or "mqtts://host:8883"'),
    ('dbc = ["ucs.dbc", "flaming_tool.dbc"]', "",
     'bus[0].dbc: no bus has definitions; name the DBC files, such as dbc = ["flaming_tool.dbc"]'),
])
def test_a_mistake_is_one_line_that_says_what_to_do(tmp_path: Path, old: str, new: str, problem: str) -> None:
    assert old in GOOD
    assert problem in problems(tmp_path, GOOD.replace(old, new))


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("channel", "chanel").replace('"250 ms"', "250").replace("[unit]", "[unti]")
    assert [line.split(":")[0] for line in problems(tmp_path, text)] == [
        "unti", "unit", "bus[0].chanel", "bus[0].channel", "bridge.period"]


def test_buses_may_not_share_a_name_or_a_channel(tmp_path: Path) -> None:
    bus = '[[bus]]\nname = "implement"\nchannel = "can0"\n'
    assert problems(tmp_path, GOOD + bus) == [
        'bus: 2 buses are called "implement"; give each its own name',
        'bus: 2 buses use the socketcan channel "can0"; join their dbc lists']


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match=r"nowhere\.toml: no such file; give the path of a unit\.toml"):
        config.load(tmp_path / "nowhere.toml")


def test_a_folder_and_a_binary_file_say_so(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match="can't be read: Is a directory"):
        config.load(tmp_path)
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(config.ConfigError, match="can't be read: not a text in UTF-8"):
        config.load(tmp_path / "binary")


def test_broken_toml_names_the_line(tmp_path: Path) -> None:
    assert problems(tmp_path, "[unit\n") == [
        "not TOML: Expected ']' at the end of a table declaration (at line 1, column 6)"]


@pytest.mark.parametrize(("text", "expected"), [
    ("250 ms", 250_000_000), ("1s", 10**9), ("0.5 s", 500_000_000), ("2 min", 120 * 10**9), ("1.5 h", 5400 * 10**9),
    ("7 us", 7000)])
def test_durations_are_exact(text: str, expected: int) -> None:
    assert config.duration_ns(text) == expected


def catalog() -> Catalog:
    always = Boolean(True)
    alarms = {
        "PilotFlameOut": Alarm("PilotFlameOut", "A", 1, "High", always, repair=Repair(())),
        "BottleEmpty": Alarm("BottleEmpty", "A", 2, "High", always),
    }
    return Catalog((), {}, alarms)


def armed(*names: str) -> config.Config:
    return config.Config(config.Unit("a"), (), config.Repairs(names), path="unit.toml")


def test_armed_names_must_be_alarms_with_a_repair() -> None:
    config.check_armed(armed("PilotFlameOut"), catalog())
    with pytest.raises(config.ConfigError) as caught:
        config.check_armed(armed("PilotFlameOut", "PilotFlamOut", "BottleEmpty"), catalog())
    assert caught.value.problems == (
        'unit.toml: repairs.armed[1]: no alarm is called "PilotFlamOut"; did you mean "PilotFlameOut"?',
        'unit.toml: repairs.armed[2]: the alarm "BottleEmpty" has no repair; take it out of the list')


