"""CANopen on real SocketCAN: the air-blast sprayer's devices as processes, and nodes of the package `canopen` as peers."""
from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

import dbc
from hil_tests.conftest import SOON_S, START_S, Process, told
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

SILENT_S = 1.75
"""Three and a half heartbeats of 500 ms."""
ARMED = ["Ultrasonic3NotWorking", "UltrasonicNotOperational", "AirblastNotOperational"]
UNIT = unit_toml("airblast_sprayer.dbc", "ucs.dbc", armed=ARMED, more="""
[[bus.canopen]]
node = 42
eds = "airblast_sprayer.eds"
history = true
[[bus.canopen]]
node = 43
eds = "ultrasonic_sensors.eds"
""")
SCENARIO = """
duration = "10 min"
orders = ["at 3 s: spraying on"]
faults = [{faults}]
[nodes.sprayer]
program = "airblast_sprayer"
[nodes.sensors]
program = "ultrasonic_sensors"
[nodes.mission]
program = "airblast_mission"
"""
SPRAYER, SENSORS, UNKNOWN, GUARDED = 42, 43, 7, 11
Start = Callable[..., Process]


@pytest.fixture
def run(process: Start, tmp_path: Path) -> Process:
    """`ucs run`, supervising vcan0."""
    (tmp_path / "unit.toml").write_text(UNIT)
    started = process("run", "unit.toml")
    started.expect("; supervising$", START_S)
    return started


@pytest.fixture
def simulate(process: Start, tmp_path: Path) -> Callable[..., Process]:
    """Starts nodes of the orchard's scenario as a process of their own: `simulate("sensors", faults='…')`."""

    def start(*nodes: str, faults: str = "") -> Process:
        scenario = tmp_path / f"{'-'.join(nodes)}.toml"
        scenario.write_text(SCENARIO.format(faults=faults))
        return process("simulate", scenario, "--bus", "vcan0", *(word for node in nodes for word in ("--node", node)))
    return start


class Peer:
    """The package's own network on vcan0."""

    def __init__(self) -> None:
        package: Any = canopen
        self.network = package.Network(can.Bus(channel="vcan0", interface="socketcan"))
        self.network.connect()

    def device(self, node: int, eds: str = "") -> Any:
        """A device by the package: booted, operational, with its heartbeat."""
        local = self.network.create_node(node, str(dbc.path(eds or "airblast_sprayer.eds")))
        for state in ("INITIALISING", "PRE-OPERATIONAL", "OPERATIONAL"):
            local.nmt.state = state
        return local


@pytest.fixture
def peer() -> Iterator[Peer]:
    one = Peer()
    yield one
    one.network.disconnect()


@pytest.mark.covers("Ultrasonic3NotWorking", "raised", "repair_started", "repaired", "cleared")
def test_a_dead_sensor_is_reset_by_nmt_and_verified_by_its_heartbeat(run: Process, simulate: Callable[..., Process]) -> None:
    sprayer = simulate("sprayer", "mission")
    sensors = simulate("sensors", faults='"at 12 s: sensors.sensor[3] dead"')
    sprayer.expect("spraying on", START_S)
    sensors.expect("sensor 3 has failed", START_S)
    run.expect("DeviceEmergency +raised.*sensor 3 gives no echo", SOON_S)
    run.expect("Ultrasonic3NotWorking +raised", SOON_S)
    run.expect("Ultrasonic3NotWorking +repair started", SOON_S)
    sensors.expect("is reset by NMT", SOON_S)
    sensors.expect("starts anew", SOON_S)
    run.expect("Ultrasonic3NotWorking +repaired", SOON_S)
    run.expect("Ultrasonic3NotWorking +cleared", SOON_S)
    assert not any("Silent" in line for line in run.out), "a reset that was ordered is no silence"


@pytest.mark.covers("DeviceSilent", "raised", "cleared")
@pytest.mark.covers("UltrasonicSilent", "raised")
def test_a_device_that_dies_is_told_as_silent_and_cleared_when_it_is_back(
        run: Process, simulate: Callable[..., Process], tmp_path: Path) -> None:
    simulate("sprayer", "mission")
    sensors = simulate("sensors")
    with can.Bus(channel="vcan0", interface="socketcan", can_filters=[{"can_id": 0x72B, "can_mask": 0x7FF}]) as bus:
        while (message := bus.recv(START_S)) is not None and bytes(message.data) != b"\5":
            pass
        assert message is not None, "operational"
    time.sleep(1)
    sensors.kill()
    run.expect("DeviceSilent +raised.*Node 43, Device Ultrasonic sensors", SILENT_S + SOON_S)
    run.expect("UltrasonicSilent +raised", 4 + SOON_S)
    simulate("sensors")
    run.expect("DeviceSilent +cleared", START_S)
    assert run.stop() == 0
    events = told(tmp_path, "DeviceSilent")
    assert [event.event for event in events] == ["raised", "cleared"]
    assert events[0].values["LastState"] == "operational"
    assert events[0].text == "Ultrasonic sensors (node 43): no heartbeat for 1.75 s"


@pytest.mark.covers("UltrasonicNotOperational", "raised", "repaired")
def test_level_1_starts_devices_that_nobody_started(run: Process, simulate: Callable[..., Process], peer: Peer) -> None:
    simulate("sensors")
    run.expect("UltrasonicNotOperational +raised", START_S)
    run.expect("UltrasonicNotOperational +repaired", SOON_S)


@pytest.mark.covers("DeviceEmergency", "raised", "cleared")
def test_emergencies_and_error_history_of_a_node_by_the_package(run: Process, peer: Peer, tmp_path: Path) -> None:
    device = peer.device(SPRAYER)
    device.set_data(0x1003, 1, (0x3120).to_bytes(4, "little"))
    device.set_data(0x1003, 2, (0x8130).to_bytes(4, "little"))
    device.set_data(0x1003, 0, b"\2")
    time.sleep(1)
    device.emcy.send(0x3120, 0x05, b"\1\2\3\4\5")
    run.expect("DeviceEmergency +raised.*Device Air-blast sprayer.*supply voltage too low", SOON_S)
    time.sleep(3)
    device.emcy.reset()
    run.expect("DeviceEmergency +cleared", SOON_S)
    assert run.stop() == 0
    raised, cleared = told(tmp_path, "DeviceEmergency")
    assert raised.values["ErrorRegister"] == "generic, voltage"
    assert raised.values["MakerBytes"] == "0102030405"
    assert cleared.values["ErrorHistory"] == "0x3120 0x8130", "read by SDO from the node"


class Guarded:
    """A device that only answers guarding: by the frames of CiA 301 alone, as the package's own nodes answer no remote frame."""

    def __init__(self) -> None:
        self.alternates = True
        self.asked = 0
        self._toggle = 0
        self._bus = can.Bus(channel="vcan0", interface="socketcan", can_filters=[{"can_id": 0x700 + GUARDED, "can_mask": 0x7FF}])
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def _answer(self) -> None:
        while not self._ended.is_set():
            question = self._bus.recv(0.1)
            if question is not None and question.is_remote_frame and question.dlc == 1:
                self.asked += 1
                self._bus.send(can.Message(arbitration_id=0x700 + GUARDED, is_extended_id=False, data=[5 | self._toggle]))
                self._toggle ^= 0x80 if self.alternates else 0

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()


def test_a_guarded_device_is_asked_and_told_by_the_name_of_its_data_sheet_when_it_does_not_answer(
        process: Start, tmp_path: Path) -> None:
    (tmp_path / "valve.eds").write_text("[DeviceInfo]\nProductName=Old valve\n[100C]\nDefaultValue=100\n[100D]\nDefaultValue=8\n")
    (tmp_path / "unit.toml").write_text(
        f'{UNIT}[[bus.canopen]]\nnode = {GUARDED}\neds = "valve.eds"\n')
    started = process("run", "unit.toml")
    started.expect("; supervising$", START_S)
    device = Guarded()
    try:
        while device.asked < 20:
            time.sleep(0.1)
    finally:
        device.stop()
    started.expect(f"DeviceSilent +raised.*Node {GUARDED}, Device Old valve", SOON_S)
    device = Guarded()
    try:
        started.expect("DeviceSilent +cleared", SOON_S)
        device.alternates = False
        started.expect("DeviceSilent +raised", SOON_S)
    finally:
        device.stop()
    assert started.stop() == 0
    assert [event.text for event in told(tmp_path, "DeviceSilent") if event.event == "raised"] == [
        f"Old valve (node {GUARDED}): no answer to guarding for 0.85 s",
        f"Old valve (node {GUARDED}): no right answer to guarding (its toggle bit stands still) for 0.85 s"]


def test_a_node_nobody_configured_is_learned_and_missed(run: Process, peer: Peer) -> None:
    device = peer.device(UNKNOWN)
    time.sleep(3)
    device.emcy.send(0x8130, 0x11)
    run.expect("DeviceEmergency +raised.*Node 7,.*a heartbeat or life guard it waits for is missing", SOON_S)
    device.nmt.stop_heartbeat()
    run.expect("DeviceSilent +raised.*Node 7,", SILENT_S + SOON_S)
    device.nmt.start_heartbeat(500)
    run.expect("DeviceSilent +cleared", SOON_S)
    device.nmt.stop_heartbeat()


def test_the_simulated_devices_are_understood_by_the_package(simulate: Callable[..., Process], peer: Peer) -> None:
    simulate("sprayer", "sensors", "mission").expect("spraying on", START_S)
    sensors = peer.network.add_node(SENSORS, str(dbc.path("ultrasonic_sensors.eds")))
    sprayer = peer.network.add_node(SPRAYER, str(dbc.path("airblast_sprayer.eds")))
    assert sensors.nmt.wait_for_heartbeat(SOON_S) == "OPERATIONAL"
    assert sprayer.sdo[0x1008].raw == "Air-blast sprayer"
    assert sprayer.sdo[0x1018][2].raw == 42
    sprayer.tpdo.read()
    assert sprayer.tpdo[2].wait_for_reception(SOON_S) is not None
    assert 150 < sprayer.tpdo[2]["Main line.Tank level"].raw <= 200, "half per cents"
    sensors.nmt.state = "RESET"
    sensors.nmt.wait_for_bootup(SOON_S)
    assert sensors.nmt.wait_for_heartbeat(SOON_S) == "OPERATIONAL", "the mission controller has started it"
