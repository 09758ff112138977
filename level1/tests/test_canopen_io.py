"""CANopen where it touches the world: configured devices and their data sheets, error histories read by SDO."""
from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

import dbc
from level1.canopen import LIFE_FACTOR, SDO, Device
from level1.event import Event, Send, seconds
from level1.io import canopen as module
from level1.io import config
from level1.io.canopen import HistoryReader, _Line, devices
from level1.io.config import Bus, CanopenDevice
from level1.io.definitions import load as load_definitions
from level1.supervisor import Supervisor

WAIT_S = 30.0
UNIT = """
[unit]
name = "tractor-7"
[[bus]]
name = "implement"
channel = "can0"
dbc = ["airblast_sprayer.dbc"]
"""


def load(folder: Path, text: str) -> tuple[Device, ...]:
    (folder / "unit.toml").write_text(UNIT + text)
    return devices(config.load(folder / "unit.toml"))


def problems(folder: Path, text: str) -> list[str]:
    with pytest.raises(config.ConfigError) as error:
        load(folder, text)
    return [problem.removeprefix(f"{folder / 'unit.toml'}: ") for problem in error.value.problems]


# --- configuration --------------------------------------------------------------------------------------------------------------


def test_a_device_is_what_its_data_sheet_says_unless_the_configuration_says_otherwise(tmp_path: Path) -> None:
    found = load(tmp_path, '[[bus.canopen]]\nnode = 42\neds = "airblast_sprayer.eds"\n'
                           '[[bus.canopen]]\nnode = 43\neds = "ultrasonic_sensors.eds"\nname = "Sensors"\nheartbeat = "2 s"\n'
                           '[[bus.canopen]]\nnode = 7\nheartbeat = "0 s"\nrequired = true\n')
    assert [(device.bus, device.node, device.name, device.heartbeat_ns, device.required) for device in found] == [
        (0, 42, "Air-blast sprayer", 500_000_000, False), (0, 43, "Sensors", 2_000_000_000, False), (0, 7, "", 0, True)]
    assert found[1].errors[0xFF03] == "sensor 3 gives no echo (left lower middle)"
    assert load(tmp_path, "") == ()


def test_a_device_without_heartbeat_is_guarded_as_its_data_sheet_says_unless_the_configuration_says_otherwise(
        tmp_path: Path) -> None:
    guarded = "[DeviceInfo]\nProductName=Old valve\n[100C]\nDefaultValue=200\n[100D]\nDefaultValue=4\n"
    (tmp_path / "old.eds").write_text(guarded)
    (tmp_path / "both.eds").write_text(guarded + "[1017]\nDefaultValue=500\n")
    found = load(tmp_path, "".join(f"[[bus.canopen]]\nnode = {node}\n{lines}\n" for node, lines in enumerate((
        'eds = "old.eds"', 'eds = "old.eds"\nguard = "1 s"\nlife_factor = 2', 'eds = "old.eds"\nguard = "0 s"', 'eds = "both.eds"',
        'eds = "both.eds"\nguard = "1 s"', 'eds = "both.eds"\nheartbeat = "0 s"', 'guard = "1 s"'), 1)))
    assert [(device.guard_ns, device.life_factor, device.heartbeat_ns) for device in found] == [
        (200_000_000, 4, 0), (1_000_000_000, 2, 0), (None, 4, None), (None, 4, 500_000_000),
        (1_000_000_000, 4, 0), (200_000_000, 4, 0), (1_000_000_000, LIFE_FACTOR, 0)]


def test_guarding_that_can_not_be_is_told(tmp_path: Path) -> None:
    assert problems(tmp_path, '[[bus.canopen]]\nnode = 1\nguard = "5 ms"\nlife_factor = 0\n'
                              '[[bus.canopen]]\nnode = 2\nguard = "1 s"\nheartbeat = "1 s"\n') == [
        "bus[0].canopen[0].life_factor: 0 is outside 1 to 255",
        'bus[0].canopen[0].guard: "5 ms" is outside 20 ms to 65.535 s',
        "bus[0].canopen[1]: a device is watched by its heartbeat or by guarding; take one of the two out"]


def test_a_data_sheet_beside_the_configuration_comes_first_and_may_be_of_an_old_editor(tmp_path: Path) -> None:
    (tmp_path / "airblast_sprayer.eds").write_bytes("[DeviceInfo]\nProductName=Pümpe\n".encode("cp1252"))
    assert load(tmp_path, '[[bus.canopen]]\nnode = 42\neds = "airblast_sprayer.eds"\n')[0].name == "Pümpe"


def test_every_mistake_is_told_with_its_place(tmp_path: Path) -> None:
    (tmp_path / "mine.eds").write_text("VERSION \"1.0\"")
    assert problems(tmp_path, "".join(f'[[bus.canopen]]\nnode = {node}\neds = "{name}"\n' for node, name in (
        (1, "ultrasonic_sensor.eds"), (2, "mine.eds"), (3, ".")))) == [
        "bus[0].canopen[0].eds: ultrasonic_sensor.eds can't be read (No such file or directory); "
        'did you mean "ultrasonic_sensors.eds"?',
        f"bus[0].canopen[1].eds: {tmp_path / 'mine.eds'} is no data sheet: File contains no section headers.",
        f"bus[0].canopen[2].eds: {tmp_path} can't be read (Is a directory); known: airblast_sprayer.eds, ultrasonic_sensors.eds"]
    assert problems(tmp_path, "[[bus.canopen]]\nnode = 128\n" + "[[bus.canopen]]\nnode = 5\n" * 2 + "heartbeat = 3\n") == [
        'bus[0].canopen[2].heartbeat: expected a duration with its unit, such as "250 ms", found a whole number (3)',
        "bus[0].canopen: 128 is no node id; take one of 1 to 127",
        "bus[0].canopen: 2 devices have the node id 5; each on a bus has its own"]


# --- error history ----------------------------------------------------------------------------------------------------------------


class Sprayer:
    """A device with a history, by the package itself, on a bus of python-can within this process."""

    def __init__(self, channel: str):
        package: Any = canopen
        self.network = package.Network(can.Bus(interface="virtual", channel=channel))
        self.network.connect()
        self.node = self.network.create_node(42, str(dbc.path("airblast_sprayer.eds")))

    def remember(self, *codes: int) -> None:
        for place, code in enumerate(codes, 1):
            self.node.set_data(0x1003, place, code.to_bytes(4, "little"))
        self.node.set_data(0x1003, 0, bytes([len(codes)]))


@pytest.fixture
def channel() -> str:
    return uuid.uuid4().hex


@pytest.fixture
def sprayer(channel: str) -> Iterator[Sprayer]:
    device = Sprayer(channel)
    yield device
    device.network.disconnect()


class Loop:
    """Stands for the live loop: what its supervisor lets pass goes out on a bus of its own. sent: what left."""

    def __init__(self, channel: str):
        self.supervisor = Supervisor(load_definitions(["ucs.dbc"]), unit="tractor-7", start_ns=0,
                                     devices=[Device(0, 42, history=True), Device(0, 43)])
        self.supervisor.tick(0)
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.sent: list[bytes] = []

    def ask(self, bus: int, can_id: int, data: bytes) -> None:
        for output in self.supervisor.ask(bus, can_id, data, self.supervisor.now_ns + 1):
            if isinstance(output, Send) and output.message == SDO:
                self.sent.append(output.data)
                self.bus.send(can.Message(arbitration_id=output.key & 0x7FF, is_extended_id=False, data=output.data))


@pytest.fixture
def loop(channel: str) -> Iterator[Loop]:
    one = Loop(channel)
    yield one
    one.bus.shutdown()


@pytest.fixture
def reader(channel: str, loop: Loop) -> Iterator[Callable[..., HistoryReader]]:
    started: list[HistoryReader] = []

    def start(notice: Callable[[str], None], interface: str = "virtual", clock: Callable[[], float] = lambda: 0.0) -> HistoryReader:
        bus = Bus("implement", channel, interface=interface, canopen=(CanopenDevice(42, history=True), CanopenDevice(43)))
        started.append(HistoryReader([bus], notice, loop.ask, clock))
        return started[-1]
    yield start
    for one in started:
        one.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "error histories"]


def wait_for(happened: Callable[[], bool]) -> None:
    """Until something has happened in another thread."""
    end = time.monotonic() + WAIT_S
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def emergency(node: int = 42, event: str = "raised", alarm: str = "DeviceEmergency") -> Event:
    return Event("tractor-7", 1, 1, seconds(0), None, False, alarm, 1021, "High", event, 1, 0, {"Bus": 0, "Node": node}, "")


def test_an_emergency_is_followed_by_reading_the_history_whose_answers_pass_on_the_bus(
        channel: str, sprayer: Sprayer, reader: Callable[..., HistoryReader], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ANSWER_S", WAIT_S)
    sprayer.remember(0x3120, 0x0001_FF10, 0x8250)
    notices: list[str] = []
    with can.Bus(interface="virtual", channel=channel) as listener:
        one = reader(notices.append)
        one.told(emergency())
        answers: list[bytes] = []
        while len(answers) < 4 and (message := listener.recv(WAIT_S)) is not None:
            if message.arbitration_id == 0x5AA:
                answers.append(bytes(message.data))
    wait_for(lambda: one.read == 1)
    assert [(answer[3], int.from_bytes(answer[4:6], "little")) for answer in answers] == [
        (0, 3), (1, 0x3120), (2, 0xFF10), (3, 0x8250)]
    assert (one.read, notices) == (1, [])


def test_only_wanted_devices_are_asked_and_not_again_and_again(channel: str, reader: Callable[..., HistoryReader]) -> None:
    asked: list[str] = []
    now_s = [0.0]
    one = reader(asked.append, clock=lambda: now_s[0])
    for event in (emergency(43), emergency(99), emergency(event="cleared"), emergency(alarm="DeviceSilent")):
        one.told(event)
    for now_s[0] in (0.0, 5.0, 10.0):
        one.told(emergency())
    wait_for(lambda: len(asked) == 2)
    one.stop()
    assert len(asked) == 2, "nobody answers on this bus"
    assert asked[0] == "bus implement: the error history of node 42 can't be read (No SDO response received)"


def test_a_bus_that_can_not_be_opened_is_told_and_the_reader_lives_on(reader: Callable[..., HistoryReader]) -> None:
    notices: list[str] = []
    one = reader(notices.append, "nosuch")
    one.told(emergency())
    wait_for(lambda: bool(notices))
    assert len(notices) == 1 and "can't be read" in notices[0]


def test_what_the_package_would_write_does_not_leave_and_what_it_reads_does(channel: str, sprayer: Sprayer, loop: Loop) -> None:
    package: Any = canopen
    sprayer.remember(0x3120)
    with _Line(0, Bus("implement", channel, interface="virtual"), 42, loop.ask) as line:
        client = package.sdo.SdoClient(0x62A, 0x5AA, package.ObjectDictionary())
        client.network = client.responses = line
        client.RESPONSE_TIMEOUT = WAIT_S
        assert client.upload(0x1003, 1)[:2] == b"\x20\x31"
        client.RESPONSE_TIMEOUT = 0.05
        assert [request[0] for request in loop.sent] == [0x40]
        for size in (1, 4, 100):
            with pytest.raises(package.SdoCommunicationError):
                client.download(0x1003, 0, bytes(size))
        with pytest.raises(package.SdoCommunicationError):
            client.upload(0x1018, 1)
    assert {request[0] for request in loop.sent} <= {0x40, 0x80}, "nothing that writes"
    assert sprayer.node.get_data(0x1003, 0) == b"\1"
    assert loop.supervisor.counters["frames refused by the gate"] >= 4
