"""The shipped air-blast sprayer under level 1: a healthy pass raises nothing; each fault raises its alarms, is repaired, clears."""
from __future__ import annotations

import json
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import pytest

import dbc
from firmware_py.airblast_sprayer import AirblastSprayer
from firmware_py.scenario import build, parse
from firmware_py.ultrasonic_sensors import UltrasonicSensors
from firmware_py.virtual_bus import Simulation
from level1.canopen import Device
from level1.catalog import Catalog
from level1.command import Order
from level1.eds import parse as parse_eds
from level1.event import Event, Output, Result, Send
from level1.frame import Frame, frame_key
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.main import main
from ucs.simulate import SHIPPED, load
from ucs.simulated_unit import SimulatedUnit
from ucs.tests.proof import proves

SECOND = 1_000_000_000
NODES = "".join(f'[nodes.{name}]\nprogram = "{program}"\n' for name, program in (
    ("sprayer", "airblast_sprayer"), ("sensors", "ultrasonic_sensors"), ("mission", "airblast_mission")))
ORDERS = ("at 2 s: spraying on", "at 40 s: spraying off")
DEVICES = tuple(Device(0, node, sheet.name, sheet.heartbeat_ns, errors=sheet.errors) for node, name in (
    (42, "airblast_sprayer.eds"), (43, "ultrasonic_sensors.eds")) for sheet in [parse_eds(dbc.path(name).read_text("utf-8"))])
REPORTED = {"DeviceEmergency", "DeviceSilent"}
SCENARIOS = sorted(file.name for file in SHIPPED.glob("airblast_*.toml"))


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["airblast_sprayer.dbc", "ucs.dbc"])


class Orchard:
    """A scenario with level 1 attached, in virtual time. events: what level 1 reported; sent: what it sent."""

    def __init__(self, catalog: Catalog, text: str, *, seed: int | None = None, devices: Sequence[Device] = DEVICES,
                 armed: Sequence[str] | None = None):
        self.scenario = parse(text, "test.toml")
        cast = build(self.scenario, seed=seed)
        self.events: list[Event] = []
        self.sent: list[Send] = []
        self.supervisor = Supervisor(catalog, unit="tractor-7", start_ns=0, armed=armed, devices=devices)
        self.simulation = Simulation([*cast.participants, SimulatedUnit(self.supervisor, self._deliver)])
        sprayer, sensors = cast.nodes["sprayer"], cast.nodes["sensors"]
        assert isinstance(sprayer, AirblastSprayer) and isinstance(sensors, UltrasonicSensors)
        self.sprayer, self.sensors = sprayer, sensors

    def _deliver(self, outputs: Sequence[Output]) -> None:
        self.events += [output for output in outputs if isinstance(output, Event)]
        self.sent += [output for output in outputs if isinstance(output, Send)]

    def run(self, until_s: float | None = None) -> Orchard:
        """Up to a time, or to the scenario's end."""
        self.simulation.run(self.scenario.duration_ns if until_s is None else round(until_s * SECOND))
        return self

    def reset(self, alarm: str) -> str:
        """Somebody resets a lock-out at the machine; gives the reason of a refusal."""
        outputs = self.supervisor.command(Order("1", "reset", alarm, origin="local"), self.simulation.now_ns)
        self._deliver(outputs)
        return next(output.reason for output in outputs if isinstance(output, Result))

    def life(self, alarm: str) -> list[str]:
        """What was reported of an alarm."""
        return [event.event for event in self.events if event.alarm == alarm]

    @property
    def raised(self) -> set[str]:
        """Alarms that were raised at all."""
        return {event.alarm for event in self.events}


def orchard(catalog: Catalog, *faults: str, orders: Sequence[str] = ORDERS, duration: str = "50 s", trees: str = "",
            armed: Sequence[str] | None = None, devices: Sequence[Device] = DEVICES) -> Orchard:
    """A mission with faults. trees: further lines of the sensors' table."""
    head = f'duration = "{duration}"\norders = {list(orders)}\nfaults = {list(faults)}\n'
    return Orchard(catalog, head + NODES.replace('sensors"\n', f'sensors"\n{trees}\n'), armed=armed, devices=devices)


REPAIRED = ["raised", "repair_started", "repaired", "cleared"]
SECOND_TRY = ["raised", "repair_started", "repair_failed", "repair_started", "repaired", "cleared"]
LOCKED_OUT = ["raised", "repair_started", "repair_failed", "repair_started", "repair_failed", "locked_out"]
PASSED = ["raised", "cleared"]
STAYS = ["raised"]
Lives = dict[str, list[str]]
NOBODY: Lives = {}

TABLE: list[tuple[str, Lives]] = [
    # start, stop, line and tank
    ("at 1 s: sprayer refuses start for 1 command", {"AirblastStartStopFailure": REPAIRED}),
    ("at 1 s: sprayer refuses start for 2 commands", {"AirblastStartStopFailure": SECOND_TRY}),
    ("at 1 s: sprayer refuses start", {"AirblastStartStopFailure": [*LOCKED_OUT[:-1], *LOCKED_OUT[-3:]]}),
    ("at 30 s: sprayer refuses stop for 1 command", {"AirblastStartStopFailure": REPAIRED}),
    ("at 20 s: sprayer.line blocked for 1 command", {"NoMainFlow": REPAIRED}),
    ("at 20 s: sprayer.line blocked for 2 commands", {"NoMainFlow": SECOND_TRY}),
    ("at 20 s: sprayer.line blocked", {"NoMainFlow": LOCKED_OUT}),
    ("at 20 s: sprayer.tank low", {"AirblastTankLow": STAYS}),
    ("at 20 s: sprayer.tank empty", {"AirblastTankCritical": STAYS, "AirblastTankLow": STAYS, "DeviceEmergency": STAYS}),
    # sensors
    ("at 15 s: sensors.sensor[3] dead", {"Ultrasonic3NotWorking": REPAIRED, "DeviceEmergency": PASSED}),
    ("at 15 s: sensors.sensor[3] dead for 1 command", {"Ultrasonic3NotWorking": SECOND_TRY, "DeviceEmergency": PASSED * 2}),
    ("at 15 s: sensors.sensor[3] broken", {"Ultrasonic3NotWorking": LOCKED_OUT, "DeviceEmergency": PASSED * 2 + STAYS}),
    ("at 15 s: sensors.sensor[7] frozen", {"UltrasonicFrozen": REPAIRED}),
    ("at 15 s: sensors.sensor[7] frozen for 1 command", {"UltrasonicFrozen": SECOND_TRY}),
    ("at 15 s: sensors.sensor[7] frozen for 9 commands", {"UltrasonicFrozen": LOCKED_OUT}),
    # devices
    ("at 15 s: sprayer silent for 5 s", {"AirblastSilent": PASSED, "DeviceSilent": PASSED}),
    ("at 15 s: sensors silent for 6 s", {"UltrasonicSilent": PASSED, "DeviceSilent": PASSED}),
    ("at 15 s: sprayer silent", {"AirblastSilent": STAYS, "DeviceSilent": STAYS}),
    ("at 1 s: sprayer slow for 20 s", {"AirblastStartStopFailure": REPAIRED}),
    ("at 10 s: sprayer.level_sensor drifts down for 28 s", {"AirblastTankCritical": PASSED}),
    ("at 15 s: sprayer wrong counter for 5 s", {"AirblastFrozen": PASSED}),
    ("at 15 s: sprayer frozen for 5 s", {"AirblastFrozen": PASSED, "DeviceEmergency": PASSED}),
    ("at 15 s: sensors frozen for 8 s", {"UltrasonicFrozen": ["raised", "repair_started", "repair_failed", "cleared"]}),
    ("at 15 s: sensors frozen", {"UltrasonicFrozen": LOCKED_OUT}),
    ("at 15 s: sprayer reset", {"AirblastSilent": PASSED, "DeviceSilent": PASSED, "AirblastRestarted": PASSED}),
    ("at 15 s: sensors reset", {"DeviceSilent": PASSED}),
    ("at 15 s: sprayer stopped", {"AirblastNotOperational": REPAIRED, "AirblastSilent": PASSED, "AirblastCommandsLost": PASSED}),
    ("at 15 s: sensors stopped", {"UltrasonicNotOperational": REPAIRED}),
    ("at 15 s: sprayer emergency for 5 s", {"DeviceEmergency": PASSED}),
    ("at 15 s: sensors emergency", {"DeviceEmergency": STAYS}),
    ("at 15 s: sprayer heartbeat off for 6 s", {"AirblastHeartbeatLost": PASSED, "DeviceSilent": PASSED}),
    ("at 15 s: sensors heartbeat off for 6 s", {"UltrasonicHeartbeatLost": PASSED, "DeviceSilent": PASSED}),
    ("at 15 s: sprayer babbling for 300 ms", {"DeviceEmergency": STAYS * 15 + ["cleared"] * 15}),
    # who commands
    ("at 15 s: mission silent for 3 s", {"AirblastCommandsLost": PASSED, "DeviceEmergency": PASSED}),
    ("at 15 s: mission reset", {"AirblastCommandsLost": PASSED, "DeviceEmergency": PASSED}),
    ("at 15 s: mission frozen", NOBODY),
    # what is within the response times
    ("at 15 s: sprayer silent for 600 ms", NOBODY),
    ("at 15 s: mission silent for 250 ms", NOBODY),
    ("at 15 s: sensors.sensor[2] dead for 1 s", {"DeviceEmergency": PASSED}),
    ("at 15 s: sensors.sensor[2] frozen for 3 s", NOBODY),
]


@pytest.mark.parametrize(("fault", "lives"), [proves(lives, fault, lives) for fault, lives in TABLE],
                         ids=[fault for fault, _ in TABLE])
def test_each_fault_raises_its_alarms_and_no_others(catalog: Catalog, fault: str, lives: Lives) -> None:
    field = orchard(catalog, fault).run()
    assert {alarm: field.life(alarm) for alarm in sorted(field.raised)} == lives
    assert "repair_started" not in [event.event for event in field.events if event.alarm in REPORTED]


@pytest.mark.parametrize("sensor", [proves({f"Ultrasonic{n}NotWorking": REPAIRED}, n) for n in range(1, 9)])
def test_each_sensor_has_its_alarm_and_its_repair(catalog: Catalog, sensor: int) -> None:
    field = orchard(catalog, f"at 10 s: sensors.sensor[{sensor}] dead").run(18)
    assert field.life(f"Ultrasonic{sensor}NotWorking") == REPAIRED
    emergency = next(event for event in field.events if event.alarm == "DeviceEmergency")
    assert emergency.text.startswith(f"Ultrasonic sensors (node 43): sensor {sensor} gives no echo")


@pytest.mark.parametrize("lives", [proves(lives, lives) for lives in [
    {f"Ultrasonic{n}NotWorking": LOCKED_OUT for n in range(1, 9)}]], ids=["each"])
def test_each_sensor_that_no_reset_helps_is_locked_out(catalog: Catalog, lives: Lives) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor broken", duration="3 min").run()
    assert {alarm: field.life(alarm) for alarm in sorted(field.raised) if alarm in lives} == lives


@pytest.mark.covers("AirblastTankCritical", "raised", "cleared")
@pytest.mark.covers("AirblastTankLow", "raised", "cleared")
def test_a_tank_that_is_filled_again_is_no_alarm_any_more(catalog: Catalog) -> None:
    field = orchard(catalog, "at 12 s: sprayer.tank empty", "at 25 s: sprayer.tank filled").run()
    assert (field.life("AirblastTankCritical"), field.life("AirblastTankLow")) == (PASSED, PASSED)


@pytest.mark.parametrize(("alarm", "device"), [
    proves({alarm: [*REPAIRED, "locked_out"]}, alarm, device)
    for alarm, device in (("AirblastNotOperational", "sprayer"), ("UltrasonicNotOperational", "sensors"))])
def test_a_device_that_is_stopped_again_and_again_is_locked_out(catalog: Catalog, alarm: str, device: str) -> None:
    field = orchard(catalog, *(f"at {t_s} s: {device} stopped" for t_s in (15, 25, 35))).run()
    assert field.life(alarm)[:2 * len(REPAIRED) + 2] == [*REPAIRED * 2, "raised", "locked_out"]


def test_every_alarm_of_the_definition_is_raised_by_some_fault(catalog: Catalog) -> None:
    own = {name for name, alarm in catalog.alarms.items() if alarm.message == "AIRBLAST_ALARMS"}
    assert own | REPORTED == {alarm for _, lives in TABLE for alarm in lives} | {f"Ultrasonic{n}NotWorking" for n in range(1, 9)}


# --- healthy ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_healthy_pass_raises_nothing(catalog: Catalog, seed: int) -> None:
    healthy = Orchard(catalog, (SHIPPED / "airblast_healthy.toml").read_text("utf-8"), seed=seed).run()
    assert healthy.events == []
    assert not healthy.sprayer.errors


@pytest.mark.parametrize("trees", [
    'trees_missing = "100 %"', 'speed = "0 km/h"', 'tree_height = "1.2 m"\nspeed = "6 km/h"'])
def test_whatever_the_trees_nothing_is_raised(catalog: Catalog, trees: str) -> None:
    assert orchard(catalog, trees=trees).run().events == []


def test_devices_that_are_not_configured_are_learned(catalog: Catalog) -> None:
    field = orchard(catalog, "at 15 s: sprayer silent for 5 s", "at 30 s: sensors.sensor[1] dead", devices=()).run()
    texts = [event.text for event in field.events if event.alarm in REPORTED and event.event == "raised"]
    assert texts[0].startswith("node 42: no heartbeat for 1.7")
    assert texts[1] == "node 43: an error of its own kind (0xFF01)"


def test_the_mission_controller_may_be_absent_then_level_1_starts_the_devices(catalog: Catalog) -> None:
    field = orchard(catalog, "at 0 s: mission silent").run()
    assert field.life("AirblastNotOperational") == REPAIRED
    assert field.life("UltrasonicNotOperational") == REPAIRED
    assert set(field.sensors.states) == {"Working"}


# --- repairs ------------------------------------------------------------------------------------------------------------------


def test_a_sensor_is_repaired_by_one_reset_that_its_boot_up_verifies(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor[3] dead").run(20)
    nmt = [(send.data.hex(), send.reason) for send in field.sent if send.message == "NMT"]
    assert nmt == [("812b", "repair of Ultrasonic3NotWorking"), ("012b", "repair of Ultrasonic3NotWorking")]
    began, ended = (event.t for event in field.events if event.event in ("repair_started", "repaired"))
    assert Decimal("0.8") < ended - began < 4


def test_all_sensors_dead_at_once_are_reset_once(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor dead").run(25)
    assert [send.data.hex() for send in field.sent if send.message == "NMT"] == ["812b", "012b"]
    assert all(field.life(f"Ultrasonic{n}NotWorking")[-1] == "cleared" for n in range(1, 9))


def test_a_sensor_that_is_locked_out_does_not_keep_the_others_from_being_repaired(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor[1] broken", "at 30 s: sensors.sensor[5] dead").run()
    assert field.life("Ultrasonic1NotWorking") == LOCKED_OUT
    assert field.life("Ultrasonic5NotWorking") == REPAIRED


@pytest.mark.covers("Ultrasonic1NotWorking", "locked_out", "cleared")
def test_a_locked_out_sensor_can_be_reset_at_the_machine_once_it_works(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor[1] broken for 20 s").run(25)
    assert "still there" in field.reset("Ultrasonic1NotWorking")
    field.run(35)
    assert field.reset("Ultrasonic1NotWorking") == ""
    assert field.life("Ultrasonic1NotWorking")[-2:] == ["acknowledged", "cleared"]


def test_the_sprayer_works_on_while_the_sensors_are_reset(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor[3] dead")
    while field.simulation.now_ns < 20 * SECOND:
        field.run(field.simulation.now_ns / SECOND + 0.5)
        assert field.simulation.now_ns < 4 * SECOND or field.sprayer.plant.flow_l_min > 20


@pytest.mark.covers("NoMainFlow", "locked_out", "cleared")
def test_a_blocked_line_ends_with_the_sprayer_off_and_a_reset_with_a_new_order_starts_it_again(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sprayer.line blocked for 40 s", orders=("at 2 s: spraying on", "at 70 s: spraying on"),
                    duration="80 s").run(50)
    assert field.life("NoMainFlow") == LOCKED_OUT
    assert field.sprayer.plant.flow_l_min < 1
    assert [send.data.hex() for send in field.sent if send.message == "AIRBLAST_CMD"][-1][0:2] == "00", "held off"
    field.run(60)
    assert field.reset("NoMainFlow") == ""
    assert field.run(69).sprayer.plant.flow_l_min < 1, "a reset starts nothing by itself"
    assert field.run().sprayer.plant.flow_l_min > 20


def test_repairs_wait_while_the_unit_is_stopped_from_above_but_sensors_are_reset(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sprayer.line blocked for 1 command", "at 15 s: sensors.sensor[2] dead").run(5)
    field.supervisor.command(Order("1", "stop"), field.simulation.now_ns)
    field.run()
    assert "repair_started" not in field.life("NoMainFlow")
    assert field.life("Ultrasonic2NotWorking") == REPAIRED


def test_an_unarmed_repair_sends_nothing(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor[3] dead", armed=[]).run()
    assert field.life("Ultrasonic3NotWorking") == ["raised", "repair_started"]
    assert not [send for send in field.sent if send.message in ("NMT", "AIRBLAST_CMD")]


def test_a_controller_that_does_not_come_back_from_its_reset_is_silent(catalog: Catalog) -> None:
    field = orchard(catalog, "at 10 s: sensors.sensor[3] dead").run(12)
    field.simulation.detach(field.sensors)
    field.run()
    assert field.life("Ultrasonic3NotWorking")[:3] == ["raised", "repair_started", "repair_failed"]
    assert {"UltrasonicSilent", "DeviceSilent"} <= field.raised
    silent = next(event for event in field.events if event.alarm == "DeviceSilent")
    assert "has not come back" in silent.text


def test_a_mission_controller_that_sends_on_during_a_repair_does_no_harm(catalog: Catalog) -> None:
    field = orchard(catalog, "at 5 s: mission ignores repairs", "at 10 s: sprayer.line blocked for 1 command",
                    "at 25 s: sensors.sensor[4] dead").run()
    assert field.life("Ultrasonic4NotWorking") == REPAIRED
    assert field.life("NoMainFlow")[0] == "raised"


# --- the command --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENARIOS)
def test_each_shipped_scenario_runs_and_tells(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert load(name).title
    assert main(["simulate", name, "--duration", "65 s"]) == 0
    assert "spraying on" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "never"), [
    ("airblast_sensors.toml", {"DeviceSilent", "UltrasonicSilent", "NoMainFlow"}), ("airblast_line.toml", {"DeviceSilent"}),
    ("airblast_network.toml", {"NoMainFlow", "AirblastTankCritical"})])
def test_the_shipped_scenarios_raise_what_their_faults_say(catalog: Catalog, name: str, never: set[str]) -> None:
    field = Orchard(catalog, (SHIPPED / name).read_text("utf-8")).run()
    assert len(field.raised) >= 4
    assert not field.raised & never


def test_the_same_seed_gives_the_same_events(catalog: Catalog) -> None:
    def events() -> list[Event]:
        return Orchard(catalog, (SHIPPED / "airblast_sensors.toml").read_text("utf-8")).run(60).events
    assert events() == events()


def test_a_recording_tells_of_the_devices_what_was_told_live(catalog: Catalog) -> None:
    field = Orchard(catalog, (SHIPPED / "airblast_network.toml").read_text("utf-8"))
    frames: list[Frame] = []
    field.simulation.on_frame = lambda t_ns, frame: frames.append(Frame(t_ns, frame_key(frame.can_id, frame.extended), frame.data))
    field.run()
    replayed = Supervisor(catalog, unit="tractor-7", broadcast=False, armed=(), devices=DEVICES)
    outputs = [*replayed.receive_many(frames), *replayed.tick(field.simulation.now_ns)]

    def story(events: Sequence[Output]) -> list[tuple[object, ...]]:
        return [(event.t, event.alarm, event.event, event.text, event.values) for event in events
                if isinstance(event, Event) and event.alarm in REPORTED]
    assert story(outputs) == story(field.events)
    assert len(story(outputs)) > 20


def test_the_command_replays_a_recording_of_devices_it_never_heard_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "bus.log"
    assert main(["simulate", "airblast_network.toml", "--duration", "65 s", "--log", str(log)]) == 0
    assert main(["replay", str(log), "--dbc", "airblast_sprayer.dbc", "ucs.dbc", "--events", str(tmp_path / "events.jsonl")]) == 0
    capsys.readouterr()
    told = [(event["alarm"], event["event"], event["text"]) for event in map(json.loads, (tmp_path / "events.jsonl").open())]
    assert ("DeviceEmergency", "raised", "node 42: supply voltage (0x3120)") in told
    assert ("DeviceSilent", "cleared", "") in told
