"""The air-blast sprayer and its ultrasonic sensors on their bus: CANopen, physics, and each fault."""
from __future__ import annotations

import statistics
from random import Random

import pytest

from firmware_py.airblast_mission import AirblastMission
from firmware_py.airblast_plant import AirblastPlant
from firmware_py.airblast_sprayer import AirblastSprayer
from firmware_py.canopen_node import CanopenNode, Wire
from firmware_py.canopy import Canopy
from firmware_py.codec import Codec, Value
from firmware_py.fault import Statement
from firmware_py.participant import BusFrame, Participant
from firmware_py.ultrasonic_sensors import UltrasonicSensors
from firmware_py.virtual_bus import Simulation

SECOND = 1_000_000_000
CODEC = Codec.shipped("airblast_sprayer.dbc")
DEVICES: tuple[type[CanopenNode], ...] = (AirblastSprayer, UltrasonicSensors)
SPRAYER, SENSORS = 42, 43
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130


class Listener:
    """Hears everything, and sends what it is given."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, int, bytes]] = []
        self.outbox: list[BusFrame] = []
        self._names = {CODEC.identifier(name)[0]: name for name in CODEC.names}

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        self.frames.append((t_ns, can_id, data))

    def step(self, now_ns: int) -> list[BusFrame]:
        frames, self.outbox = self.outbox, []
        return frames

    def next_deadline(self) -> int | None:
        return 0 if self.outbox else None

    def values(self, message: str) -> list[dict[str, Value]]:
        """What came of a message."""
        return [dict(values) for _, can_id, data in self.frames if self._names.get(can_id) == message
                if (values := CODEC.decode(message, data)) is not None]


class Bench:
    """Sprayer, sensors and mission controller on a bus, with one who listens. settings: of the sensors' trees and the sprayer."""

    def __init__(self, seed: int = 1, trees: dict[str, float] | None = None, mission: bool = True, **settings: float):
        self.sprayer = AirblastSprayer("sprayer", CODEC, settings, Random(f"{seed}/sprayer"))
        self.sensors = UltrasonicSensors("sensors", CODEC, trees or {}, Random(f"{seed}/sensors"))
        self.mission = AirblastMission("mission", CODEC, {}, Random(seed))
        self.bus = Listener()
        self.told: list[str] = []
        nodes: list[Participant] = [self.sprayer, self.sensors, *([self.mission] if mission else []), self.bus]
        self.simulation = Simulation(nodes, on_happening=lambda happening: self.told.append(f"{happening.who}: {happening.text}"))

    def run(self, seconds: float) -> Bench:
        self.simulation.run(self.simulation.now_ns + round(seconds * SECOND))
        return self

    def order(self, device: str, action: str) -> Bench:
        self.mission.order(self.simulation.now_ns, Statement(device, None, action))
        return self

    def break_(self, node: CanopenNode | AirblastMission, device: str, action: str, index: int | None = None,
               commands: int | None = None) -> Bench:
        node.inject(self.simulation.now_ns, Statement(device, index, action, commands))
        return self

    def send(self, can_id: int, *data: int) -> Bench:
        self.bus.outbox.append(BusFrame(can_id, False, bytes(data)))
        return self.run(0.01)

    def spray(self) -> Bench:
        """Started, and at work."""
        return self.run(1).order("spraying", "on").run(3)

    def last(self, message: str) -> dict[str, Value]:
        return self.bus.values(message)[-1]

    def since(self, can_id: int, from_ns: int) -> list[bytes]:
        """Payloads of an identifier from a time on."""
        return [data for t_ns, heard, data in self.bus.frames if heard == can_id and t_ns >= from_ns]


# --- data sheets and definition -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", DEVICES, ids=lambda kind: kind.__name__)
def test_the_data_sheet_maps_the_bytes_that_the_definition_describes(kind: type[CanopenNode]) -> None:
    device = kind("device", CODEC, {}, Random(1)).device  # type: ignore[call-arg,arg-type]
    for number, message in enumerate(kind.SENDS, 1):
        pdo = device.tpdo[number]
        can_id, extended = CODEC.identifier(message)
        assert (pdo.cob_id, extended, len(pdo.data)) == (can_id, False, len(CODEC.encode(message, first_values(message))))
        assert 1 <= pdo.inhibit_time * 100_000 <= pdo.event_timer * 1_000_000 <= CODEC.cycle_ns(message)
        assert sum(variable.length for variable in pdo) == 8 * len(pdo.data)
    assert device.sdo[0x1017].raw * 1_000_000 == CODEC.cycle_ns("AIRBLAST_HEARTBEAT") == CODEC.cycle_ns("US_HEARTBEAT")


def first_values(message: str) -> dict[str, Value]:
    zeros = CODEC.decode(message, bytes(8))
    assert zeros is not None
    return dict(zeros)


def test_the_command_is_the_receive_pdo_of_the_sprayer() -> None:
    device = Bench().sprayer.device
    assert device.rpdo[1].cob_id == CODEC.identifier("AIRBLAST_CMD")[0]
    assert device.rpdo[1].event_timer == 400


# --- CANopen --------------------------------------------------------------------------------------------------------------------


def test_a_device_boots_sends_its_heartbeat_and_says_nothing_else_until_it_is_started() -> None:
    bench = Bench(mission=False).run(3)
    heard = {can_id for _, can_id, _ in bench.bus.frames}
    assert heard == {0x700 + SPRAYER, 0x700 + SENSORS}
    assert bench.since(0x700 + SPRAYER, 0) == [b"\0", *[b"\x7f"] * 5]
    bench.send(0, START, SPRAYER).run(1)
    assert bench.since(0x180 + SPRAYER, 0) and not bench.since(0x180 + SENSORS, 0)
    assert bench.last("AIRBLAST_HEARTBEAT") == {"AirblastNmtState": "Operational"}


def test_a_stopped_device_sends_its_heartbeat_only_and_answers_nobody() -> None:
    bench = Bench().run(2).send(0, STOP, SPRAYER)
    now_ns = bench.simulation.now_ns
    bench.send(0x600 + SPRAYER, 0x40, 0x08, 0x10, 0, 0, 0, 0, 0).run(2)
    assert {can_id for t_ns, can_id, _ in bench.bus.frames if t_ns > now_ns + SECOND // 10 and can_id & 0x7F == SPRAYER
            and can_id not in (0x22A, 0x62A)} == {0x700 + SPRAYER}
    assert bench.last("AIRBLAST_HEARTBEAT") == {"AirblastNmtState": "Stopped"}
    bench.send(0, PRE_OPERATIONAL, 0).run(1)
    assert bench.last("US_HEARTBEAT") == {"UsNmtState": "PreOperational"}


@pytest.mark.parametrize("command", [RESET_NODE, RESET_COMMUNICATION])
def test_a_reset_by_nmt_ends_in_a_boot_up_message_and_the_mission_controller_starts_the_device_again(command: int) -> None:
    bench = Bench().run(2.1).send(0, command, SENSORS)
    reset_ns = bench.simulation.now_ns
    bench.run(0.5)
    assert not bench.since(0x700 + SENSORS, reset_ns)
    bench.run(1)
    assert bench.since(0x700 + SENSORS, reset_ns)[0] == b"\0"
    assert bench.last("US_HEARTBEAT") == {"UsNmtState": "Operational"}


def test_one_that_was_stopped_on_purpose_is_left_alone() -> None:
    bench = Bench().run(2).send(0, PRE_OPERATIONAL, SENSORS).run(3)
    assert bench.last("US_HEARTBEAT") == {"UsNmtState": "PreOperational"}


def test_a_mission_controller_that_comes_late_starts_what_waits() -> None:
    bench = Bench(mission=False).run(3)
    bench.simulation.attach(bench.mission)
    bench.run(1)
    assert bench.last("US_HEARTBEAT") == {"UsNmtState": "Operational"}


def test_the_object_dictionary_can_be_read_and_written() -> None:
    bench = Bench().spray()

    def read(node: int, index: int, sub: int) -> bytes:
        from_ns = bench.simulation.now_ns
        bench.send(0x600 + node, 0x40, index & 0xFF, index >> 8, sub, 0, 0, 0, 0).run(0.05)
        return bench.since(0x580 + node, from_ns)[0]
    assert read(SPRAYER, 0x1000, 0) == bytes.fromhex("4300100000000000")
    assert read(SPRAYER, 0x1001, 0)[4] == 0
    level = read(SPRAYER, 0x2001, 3)[4] / 2
    assert level == pytest.approx(80, abs=2), "what the last PDO held"
    assert read(SPRAYER, 0x2100, 1)[4] & 3 == 1, "and what was commanded"
    assert read(SPRAYER, 0x7777, 0)[0] == 0x80, "an abort"
    bench.send(0x600 + SPRAYER, 0x2B, 0x17, 0x10, 0, 0xFA, 0, 0, 0)
    from_ns = bench.run(1).simulation.now_ns
    assert len(bench.run(2).since(0x700 + SPRAYER, from_ns)) == 8, "a heartbeat every 250 ms"


def test_an_error_stands_in_the_register_and_in_the_history_until_it_is_cleared() -> None:
    bench = Bench().run(2)
    device = bench.sprayer
    bench.break_(device, "", "emergency").run(0.1)
    assert bench.since(0x80 + SPRAYER, 0) == [bytes.fromhex("2031050000000000")]
    assert device.device.sdo[0x1001].raw == 0x05
    assert [device.device.sdo[0x1003][place].raw for place in (0, 1)] == [1, 0x3120]
    bench.break_(device, "", "works").run(0.1)
    assert bench.since(0x80 + SPRAYER, 0)[-1] == bytes(8)
    assert device.device.sdo[0x1001].raw == 0
    assert device.device.sdo[0x1003][0].raw == 1, "the history remembers"
    device.device.sdo[0x1003][0].raw = 0
    assert device.device.sdo[0x1003][0].raw == 0


def test_an_end_of_an_error_that_nobody_hears_is_told_apart() -> None:
    bench = Bench().run(2)
    device = bench.sprayer
    bench.break_(device, "tank", "empty").run(0.1)
    bench.break_(device, "", "silent").break_(device, "tank", "filled").run(0.1)
    assert device.ended_unheard and not device.errors
    bench.break_(device, "", "works").break_(device, "", "emergency").run(0.1).break_(device, "", "works").run(0.1)
    assert not device.ended_unheard


@pytest.mark.parametrize(("can_id", "data"), [(0, b"\x81"), (0, b""), (0x62A, b""), (0x62A, b"\xff"), (0x62A, bytes(8)),
                                              (0x62A, b"\x70" + bytes(7)), (0x62A, b"\x60" + bytes(7)),
                                              (0x22A, b"\1"), (0x22A, b"")])
def test_frames_that_make_no_sense_do_no_harm(can_id: int, data: bytes) -> None:
    bench = Bench(mission=False).send(0, START, 0)
    bench.bus.outbox.append(BusFrame(can_id, False, data))
    bench.run(2)
    assert bench.last("AIRBLAST_HEARTBEAT") == {"AirblastNmtState": "Operational"}


def test_a_wire_sends_periodic_frames_once_however_late_it_is_asked() -> None:
    wire = Wire(0)
    task = wire.send_periodic(0x72A, b"\5", 0.5)
    wire.advance(10 * SECOND)
    assert wire.take() == [BusFrame(0x72A, False, b"\5")]
    wire.advance(10 * SECOND + SECOND // 2)
    assert len(wire.take()) == 1
    task.stop()
    wire.advance(20 * SECOND)
    assert wire.take() == []
    wire.subscribe(1, print)
    wire.unsubscribe(1)
    assert wire.notify(1, b"")


# --- physics ----------------------------------------------------------------------------------------------------------------------


def test_a_healthy_start_flows_within_its_time_and_a_stop_ends_it() -> None:
    bench = Bench().run(1).order("spraying", "on").run(2)
    status, line = bench.last("AIRBLAST_STATUS"), bench.last("AIRBLAST_LINE")
    assert (status["Airblast"], status["MainValve"], status["AirblastState"]) == ("On", "Open", "Working")
    assert float(line["AirblastFlow"]) > 15 and float(line["AirblastPressure"]) > 7
    bench.run(3)
    assert float(bench.last("AIRBLAST_LINE")["AirblastFlow"]) == pytest.approx(24, abs=0.5)
    bench.order("spraying", "off").run(4)
    assert bench.last("AIRBLAST_STATUS")["Airblast"] == "Off"
    assert float(bench.last("AIRBLAST_LINE")["AirblastFlow"]) < 0.1


def test_nozzles_open_before_leaves_only_and_all_close_at_the_end_of_the_row() -> None:
    bench = Bench(trees={"row_length": 20, "turn": 10, "speed": 3}).run(1).order("spraying", "on")
    opened: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(600):
        bench.run(0.1)
        t_s = bench.simulation.now_ns / SECOND
        _, along_m = bench.sensors.canopy.place(t_s - 1.5)
        status = bench.last("AIRBLAST_STATUS")
        turning = along_m is None and bench.sensors.canopy.place(t_s)[1] is None
        opened[turning].append(sum(status[f"Nozzle{number}"] == "Open" for number in range(1, 9)))
    assert max(opened[True]) == 0
    assert 2 < statistics.mean(opened[False]) < 8


def test_without_sensors_nozzles_stay_closed_unless_all_are_ordered_open() -> None:
    bench = Bench(trees={"trees_missing": 0, "tree_spacing": 1, "turn": 0}).spray()
    assert "Open" in bench.last("AIRBLAST_STATUS").values()
    bench.break_(bench.sensors, "", "silent").run(2)
    nozzles = [f"Nozzle{number}" for number in range(1, 9)]
    assert {bench.last("AIRBLAST_STATUS")[name] for name in nozzles} == {"Closed"}
    bench.order("nozzles", "open").run(1)
    assert {bench.last("AIRBLAST_STATUS")[name] for name in nozzles} == {"Open"}
    bench.order("nozzles", "closed").run(1)
    assert {bench.last("AIRBLAST_STATUS")[name] for name in nozzles} == {"Closed"}


def test_upper_nozzles_turn_down_and_lower_ones_up_while_they_see_nothing() -> None:
    bench = Bench(trees={"trees_missing": 100}).spray().run(3)
    status = bench.last("AIRBLAST_STATUS")
    assert [status[f"Angle{side}{row}"] for side in ("Left", "Right") for row in ("Upper", "Lower")] == [-30, 30, -30, 30]
    bench.order("turning", "level").run(8)
    assert bench.last("AIRBLAST_STATUS")["AngleLeftUpper"] == 0


def test_turning_finds_the_leaves_of_small_trees() -> None:
    def open_part(turning: str) -> float:
        bench = Bench(trees={"tree_height": 1.9, "trees_missing": 0, "turn": 0}).order("turning", turning).spray()
        states = []
        for _ in range(200):
            states.append(bench.run(0.1).last("AIRBLAST_STATUS")["Nozzle1"] == "Open")
        return statistics.mean(states)
    assert open_part("automatic") > open_part("level") + 0.1


def test_the_tank_falls_by_what_the_nozzles_take() -> None:
    bench = Bench(tank_level=50, trees={"trees_missing": 0}).order("nozzles", "open").spray()
    before = dict(bench.last("AIRBLAST_LINE"))
    bench.run(120)
    after = bench.last("AIRBLAST_LINE")
    litres = float(after["AirblastSprayed"]) - float(before["AirblastSprayed"])
    assert litres == pytest.approx(8 * 2.0 * 2, rel=0.05)
    fallen = float(before["AirblastTankLevel"]) - float(after["AirblastTankLevel"])
    assert fallen == pytest.approx(litres / 4, abs=1.0)


def test_a_blocked_line_lets_nothing_through_and_the_pressure_rises() -> None:
    plant = AirblastPlant(Random(1), 400, 50, 0.02)
    for _ in range(200):
        plant.advance(pumps=True, valve_open=True, wanted_l_min=24, nozzles=8)
    assert (round(plant.flow_l_min), round(plant.bar)) == (24, 10)
    plant.blocked = True
    for _ in range(200):
        plant.advance(pumps=True, valve_open=True, wanted_l_min=24, nozzles=8)
    assert (round(plant.flow_l_min), round(plant.bar)) == (0, 16)


def test_the_distance_to_a_crown_is_that_of_geometry() -> None:
    canopy = Canopy("1", speed_m_s=1.0, spacing_m=4, height_m=2.4, row_m=40, turn_s=10, missing=0, lane_m=1.6)
    tree = canopy._trees(0)[0][1]
    assert tree is not None
    middle = canopy.distance_m(4.0, 0, tree.centre_m, 0)
    assert middle == pytest.approx(1.6 - tree.radius_m)
    higher = canopy.distance_m(4.0, 0, tree.centre_m + tree.half_m / 2, 0)
    assert higher is not None and middle is not None and higher > middle
    assert canopy.distance_m(4.0, 0, tree.centre_m + tree.half_m + 0.1, 0) is None
    assert canopy.distance_m(4.0, 0, tree.centre_m + tree.half_m + 0.1, -30) is not None
    assert canopy.distance_m(2.0, 0, tree.centre_m, 0) is None, "between two trunks"
    assert canopy.distance_m(45.0, 0, tree.centre_m, 0) is None, "it turns"
    assert canopy.place(50.0) == (1, 0.0)


def test_a_living_echo_is_never_still_with_and_without_leaves() -> None:
    for missing in (0.0, 100.0):
        bench = Bench(trees={"trees_missing": missing}).run(60)
        echoes = [values["Echo3"] for values in bench.bus.values("US_LEFT")[10:]]
        longest = max(len(run) for run in _runs(echoes))
        assert longest < 8, "of the 50 that count as frozen"


def _runs(values: list[Value]) -> list[list[Value]]:
    runs: list[list[Value]] = [[]]
    for value in values:
        if runs[-1] and runs[-1][-1] != value:
            runs.append([])
        runs[-1].append(value)
    return runs


# --- faults -----------------------------------------------------------------------------------------------------------------------


def test_a_dead_sensor_fails_with_an_emergency_and_a_reset_revives_it() -> None:
    bench = Bench().run(2)
    bench.break_(bench.sensors, "sensor", "dead", 3).run(1)
    assert bench.last("US_STATE")["Sensor3"] == "Failed"
    assert bench.last("US_LEFT")["Distance3"] == "NoEcho"
    assert bench.since(0x80 + SENSORS, 0) == [bytes.fromhex("03ff810300000000")]
    bench.run(5)
    assert bench.last("US_STATE")["Sensor3"] == "Failed", "by itself it does not come back"
    bench.send(0, RESET_NODE, SENSORS).run(2)
    assert bench.last("US_STATE")["Sensor3"] == "Working"


def test_a_sensor_that_survives_two_resets_comes_back_with_the_third_and_a_broken_one_never() -> None:
    bench = Bench().run(2)
    bench.break_(bench.sensors, "sensor", "dead", 1, commands=2).break_(bench.sensors, "sensor", "broken", 2).run(1)
    states = []
    for _ in range(3):
        bench.send(0, RESET_NODE, SENSORS).run(2)
        states.append((bench.last("US_STATE")["Sensor1"], bench.last("US_STATE")["Sensor2"]))
    assert states == [("Failed", "Failed"), ("Failed", "Failed"), ("Working", "Failed")]
    bench.break_(bench.sensors, "sensor", "works", 2).run(1)
    assert bench.last("US_STATE")["Sensor2"] == "Working"


def test_a_frozen_sensor_repeats_itself_and_says_that_it_works() -> None:
    bench = Bench().run(2)
    bench.break_(bench.sensors, "sensor", "frozen", 5).run(0.5)
    from_place = len(bench.bus.values("US_RIGHT"))
    bench.run(5)
    later = bench.bus.values("US_RIGHT")[from_place:]
    assert len({(values["Distance5"], values["Echo5"]) for values in later}) == 1
    assert len({values["Echo6"] for values in later}) > 3
    assert bench.last("US_STATE")["Sensor5"] == "Working"
    bench.send(0, RESET_NODE, SENSORS).run(4)
    assert len({values["Echo5"] for values in bench.bus.values("US_RIGHT")[-10:]}) > 3


def test_an_empty_tank_stops_the_pump_with_an_emergency_until_it_is_filled() -> None:
    bench = Bench().spray()
    bench.break_(bench.sprayer, "tank", "empty").run(2)
    assert bench.last("AIRBLAST_STATUS")["AirblastState"] == "TankEmpty"
    assert bench.last("AIRBLAST_STATUS")["Airblast"] == "Off"
    assert bench.since(0x80 + SPRAYER, 0)[-1][:3] == bytes.fromhex("10ff81")
    bench.break_(bench.sprayer, "tank", "filled").run(3)
    assert bench.last("AIRBLAST_STATUS")["Airblast"] == "On"
    assert bench.since(0x80 + SPRAYER, 0)[-1] == bytes(8)


def test_commands_that_stop_close_the_main_valve_within_a_second() -> None:
    bench = Bench().spray()
    bench.break_(bench.mission, "", "silent").run(1)
    assert bench.last("AIRBLAST_STATUS")["MainValve"] == "Closed"
    assert bench.last("AIRBLAST_STATUS")["AirblastState"] == "CommandsLost"
    bench.break_(bench.mission, "", "works").run(2)
    assert bench.last("AIRBLAST_STATUS")["Airblast"] == "On"


def test_commands_that_come_back_clear_their_emergency_although_the_tank_ran_empty_meanwhile() -> None:
    bench = Bench().spray()
    bench.break_(bench.mission, "", "silent").run(1)
    bench.break_(bench.sprayer, "tank", "empty").run(1)
    bench.break_(bench.mission, "", "works").run(2)
    assert [*bench.sprayer.errors] == [(0xFF10, b"")]
    bench.break_(bench.sprayer, "tank", "filled").run(3)
    assert bench.since(0x80 + SPRAYER, 0)[-1] == bytes(8)


def test_a_sprayer_that_refuses_tries_again_on_retry_only_and_one_blocked_for_two_openings_is_freed_by_them() -> None:
    bench = Bench().run(1)
    bench.break_(bench.sprayer, "", "refuses start", commands=2).order("spraying", "on").run(5)
    assert bench.last("AIRBLAST_STATUS")["Airblast"] == "Off", "it tries once"
    for expected in ("Off", "On"):
        bench.break_(bench.mission, "", "silent")
        for _ in range(10):
            bench.bus.outbox.append(BusFrame(0x22A, False, bytes([0b01000001, 48])))
            bench.run(0.1)
        bench.break_(bench.mission, "", "works").run(0.5)
        assert bench.last("AIRBLAST_STATUS")["Airblast"] == expected, "once more on each Retry"
    bench.break_(bench.sprayer, "line", "blocked", commands=2).run(3)
    flows = [float(bench.last("AIRBLAST_LINE")["AirblastFlow"])]
    for _ in range(2):
        bench.order("spraying", "off").run(3).order("spraying", "on").run(4)
        flows.append(float(bench.last("AIRBLAST_LINE")["AirblastFlow"]))
    assert [flow > 20 for flow in flows] == [False, False, True]


def test_a_babbling_device_sends_without_a_pause_and_clears_its_emergencies_in_the_end() -> None:
    bench = Bench().spray()
    from_ns = bench.simulation.now_ns
    bench.break_(bench.sprayer, "", "babbling").run(1)
    assert len(bench.since(0x80 + SPRAYER, from_ns)) > 40
    assert len(bench.since(0x180 + SPRAYER, from_ns)) > 40
    bench.break_(bench.sprayer, "", "works").run(0.1)
    assert bench.since(0x80 + SPRAYER, from_ns)[-1] == bytes(8)


def test_a_device_without_heartbeat_works_on() -> None:
    bench = Bench().run(2)
    bench.break_(bench.sensors, "", "heartbeat off").run(0.6)
    from_ns = bench.simulation.now_ns
    bench.run(2)
    assert not bench.since(0x700 + SENSORS, from_ns) and bench.since(0x180 + SENSORS, from_ns)
    bench.break_(bench.sensors, "", "works").run(1)
    assert bench.since(0x700 + SENSORS, from_ns)


def test_a_frozen_device_repeats_itself_and_obeys_nobody() -> None:
    bench = Bench().spray()
    bench.break_(bench.sprayer, "", "frozen").run(0.2)
    from_ns = bench.simulation.now_ns
    bench.order("spraying", "off").send(0, RESET_NODE, SPRAYER).run(2)
    assert len(set(bench.since(0x180 + SPRAYER, from_ns))) == 1
    assert bench.since(0x700 + SPRAYER, from_ns)
    assert bench.sprayer.plant.flow_l_min > 20, "it sprays on"


def test_a_silent_device_works_on_and_one_that_is_reset_begins_anew() -> None:
    bench = Bench().spray()
    bench.break_(bench.sprayer, "", "silent")
    from_ns = bench.simulation.now_ns
    bench.run(1)
    assert not bench.since(0x180 + SPRAYER, from_ns) and bench.sprayer.plant.flow_l_min > 20
    bench.break_(bench.sprayer, "", "works").run(0.1).break_(bench.sprayer, "", "reset").run(1)
    assert bench.sprayer.plant.flow_l_min < 5
    bench.run(3)
    assert bench.last("AIRBLAST_STATUS")["Airblast"] == "On"


@pytest.mark.parametrize("kind", ["sprayer", "sensors", "mission"])
def test_every_fault_of_the_vocabulary_can_be_injected(kind: str) -> None:
    for phrase in getattr(Bench(), kind).FAULTS:
        bench = Bench().spray()
        node = getattr(bench, kind)
        bench.break_(node, phrase.device, phrase.action, 1 if phrase.count else None).run(2)
        bench.break_(node, phrase.device, "works", 1 if phrase.count else None) if phrase.lasts else None
        bench.run(1)


def test_an_unknown_fault_or_order_is_refused() -> None:
    bench = Bench()
    for node in (bench.sprayer, bench.sensors, bench.mission):
        with pytest.raises(ValueError, match="knows no fault"):
            node.inject(0, Statement("", None, "sings"))
    with pytest.raises(ValueError, match="knows no order"):
        bench.mission.order(0, Statement("song", None, "on"))


def test_a_second_device_with_the_same_number_is_told() -> None:
    bench = Bench().run(1).send(0x1AA, *bytes(8)).run(0.1)
    assert any("sprayer: hears its own AIRBLAST_STATUS" in text for text in bench.told)


def test_the_same_seed_gives_the_same_frames() -> None:
    def traffic(seed: int) -> list[tuple[int, int, bytes]]:
        return Bench(seed).spray().run(20).bus.frames
    assert traffic(4) == traffic(4)
    assert traffic(4) != traffic(5)
