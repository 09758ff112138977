"""The vehicle by itself: controller states, brakes, interlocks, engine, and what it says on the bus and on its serial line."""
from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.codec import Codec, Value
from firmware_py.drive import KMH, Drive
from firmware_py.engine import Engine
from firmware_py.fault import WORKS, Statement
from firmware_py.field import TURN_RADIUS_M
from firmware_py.linkage import Hitch, Pto
from firmware_py.nmea import sentence, sentences
from firmware_py.participant import BusFrame
from firmware_py.vehicle import ISOBUS, Vehicle
from firmware_py.vehicle_mission import VehicleMission
from firmware_py.virtual_bus import Simulation

SECOND = 1_000_000_000
CODEC = Codec.shipped("vehicle.dbc", "isobus_tractor.dbc")
SMALLEST_RADIUS_M = 2.89
TOP_KMH = 6.0


class Listener:
    """Hears everything: frames by message, J1939 from any source; sends nothing."""

    def __init__(self) -> None:
        self.frames: dict[str, list[tuple[int, BusFrame]]] = {}
        self._names = {CODEC.identifier(name): name for name in CODEC.names}

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        frame = BusFrame(can_id, extended, data)
        name = self._names.get((can_id, extended)) or self._names[can_id & ~0xFF | 0xFE, extended]
        self.frames.setdefault(name, []).append((t_ns, frame))

    def step(self, now_ns: int) -> list[BusFrame]:
        return []

    def next_deadline(self) -> int | None:
        return None

    def last(self, message: str) -> BusFrame:
        return self.frames[message][-1][1]


class Bench:
    """Vehicle, its mission controller, and a listener, on a bus. settings: of the vehicle, as in a scenario."""

    def __init__(self, **settings: float):
        self.vehicle = Vehicle("tractor", CODEC, settings, Random(1))
        self.mission = VehicleMission("mission", CODEC, {}, Random(2))
        self.listener = Listener()
        self.simulation = Simulation([self.mission, self.vehicle, self.listener])

    @property
    def kmh(self) -> float:
        return self.vehicle.drive.speed_m_s * KMH

    def run(self, seconds: float) -> Bench:
        self.simulation.run(self.simulation.now_ns + round(seconds * SECOND))
        return self

    def order(self, device: str, action: str) -> Bench:
        self.mission.order(self.simulation.now_ns, Statement(device, None, action))
        return self

    def start(self) -> Bench:
        return self.run(0.5).order("mission", "start")

    def break_(self, device: str, action: str, commands: int | None = None) -> Bench:
        self.vehicle.inject(self.simulation.now_ns, Statement(device, None, action, commands))
        return self

    def send(self, message: str, **values: Value) -> Bench:
        """A frame from somebody else, whatever it may be."""
        self.vehicle.receive(self.simulation.now_ns, *CODEC.identifier(message), CODEC.encode(message, values))
        return self

    def says(self, message: str, signal: str) -> Value:
        values = CODEC.decode(message, self.listener.last(message).data)
        assert values is not None
        return values[signal]


# --- the mission --------------------------------------------------------------------------------------------------------------


def test_it_drives_3_km_h_in_the_field_2_in_the_turns_and_no_tighter_than_it_can() -> None:
    bench = Bench(passes=3).start()
    poses, fastest = [], {True: 0.0, False: 0.0}
    for _ in range(2200):
        bench.run(0.1)
        pose = bench.vehicle.drive.pose
        poses.append((pose, bench.kmh))
        fastest[pose.turning] = max(fastest[pose.turning], bench.kmh)
    assert fastest[False] == pytest.approx(3)
    assert fastest[True] == pytest.approx(2, abs=0.02)
    for (before, _), (after, kmh) in itertools.pairwise(poses):
        way_m = math.dist(before[:2], after[:2])
        turned = math.radians((after.heading_deg - before.heading_deg + 180) % 360 - 180)
        assert way_m <= (kmh + 0.2) / KMH * 0.1 + 1e-3, "it does not jump"
        if way_m > 0.01:
            assert abs(turned) <= way_m / SMALLEST_RADIUS_M + 0.002
    assert bench.vehicle.mission == "Finished"
    assert TURN_RADIUS_M >= SMALLEST_RADIUS_M
    assert bench.says("VEHICLE_MISSION", "MissionProgress") == 100
    assert bench.says("VEHICLE_MISSION", "MissionPass") == 3


def test_it_stands_at_the_end_of_the_path_and_not_behind_it() -> None:
    bench = Bench(passes=1, speed=6).start().run(60)
    assert bench.kmh == 0
    assert bench.vehicle.drive.driven_m == pytest.approx(bench.vehicle.drive.length_m)


@pytest.mark.parametrize(("kmh", "hard", "most_m"), [(3, False, 0.5), (6, False, 1.85), (3, True, 0.22), (6, True, 0.78)])
def test_braking_takes_its_way(kmh: float, hard: bool, most_m: float) -> None:
    drive = Drive(0.05, kmh, 2, 7)
    for _ in range(400):
        drive.advance(limit_kmh=6, hard=False, pulls=True)
    assert drive.speed_m_s * KMH == pytest.approx(kmh)
    from_m = drive.driven_m
    while drive.speed_m_s:
        before_m_s = drive.speed_m_s
        drive.advance(limit_kmh=0, hard=hard, pulls=True)
        assert before_m_s - drive.speed_m_s <= 2.0 * 0.05 + 1e-9
    assert 0.1 < drive.driven_m - from_m <= most_m


@given(st.lists(st.tuples(st.floats(0, 6), st.booleans(), st.booleans(), st.booleans()), max_size=60))
@settings(max_examples=60, deadline=None)
def test_nothing_makes_it_faster_than_its_limit_or_drive_backwards(ticks: list[tuple[float, bool, bool, bool]]) -> None:
    drive = Drive(0.05, 6, 6, 7)
    for limit_kmh, hard, pulls, blocked in ticks:
        drive.blocked = blocked
        before_m, before_m_s = drive.driven_m, drive.speed_m_s
        for _ in range(10):
            drive.advance(limit_kmh=limit_kmh, hard=hard, pulls=pulls)
        assert 0 <= drive.speed_m_s * KMH <= max(limit_kmh, before_m_s * KMH) + 1e-9
        assert drive.driven_m >= before_m


# --- the controller -----------------------------------------------------------------------------------------------------------

WAYS: Sequence[tuple[str, str, str]] = [
    ("Ready", "Pause", "Paused"), ("Ready", "Resume", "Ready"), ("Ready", "Stop", "Stopped"), ("Ready", "Start", "Executing"),
    ("Executing", "Pause", "Paused"), ("Executing", "Resume", "Executing"), ("Executing", "Stop", "Stopped"),
    ("Executing", "Start", "Executing"), ("Paused", "Pause", "Paused"), ("Paused", "Resume", "Executing"),
    ("Paused", "Stop", "Stopped"), ("Paused", "Start", "Paused"), ("Stopped", "Pause", "Stopped"), ("Stopped", "Resume", "Ready"),
    ("Stopped", "Stop", "Stopped"), ("Stopped", "Start", "Stopped"), ("Manual", "Pause", "Manual"), ("Manual", "Resume", "Manual"),
    ("Manual", "Stop", "Stopped"), ("Manual", "Start", "Manual"), ("Disabled", "Pause", "Disabled"),
    ("Disabled", "Resume", "Disabled"), ("Disabled", "Stop", "Disabled"), ("Disabled", "Start", "Disabled")]


@pytest.mark.parametrize(("state", "request_", "then"), WAYS)
def test_each_request_in_each_state(state: str, request_: str, then: str) -> None:
    bench = Bench(enabled=state != "Disabled").run(0.5)
    if state in ("Executing", "Paused"):
        bench.order("mission", "start").run(2)
    if state in ("Paused", "Stopped"):
        bench.order("mission", {"Paused": "pause", "Stopped": "stop"}[state]).run(2)
    if state == "Manual":
        bench.break_("", "manual").run(1)
    assert bench.vehicle.controller == state
    bench.send("VEHICLE_CMD", Request=request_, DriveSpeedLimit=6).run(0.3)
    assert bench.vehicle.controller == then
    assert bench.says("VEHICLE_STATUS", "Controller") == then


def test_a_pressed_stop_switch_can_not_be_overruled() -> None:
    bench = Bench().start().run(5).break_("stop_switch", "pressed").run(1)
    for request in ("Resume", "Start"):
        bench.send("VEHICLE_CMD", Request=request, DriveSpeedLimit=6).run(0.5)
        assert bench.vehicle.controller == "Stopped"
    bench.break_("stop_switch", WORKS).run(5)
    assert bench.vehicle.controller == "Stopped", "released it stays stopped"
    assert bench.order("mission", "resume").run(1).vehicle.controller == "Stopped", "level 2 does not end it either"
    bench.break_("start_button", "pressed").run(1).order("mission", "start").run(5)
    assert bench.kmh == pytest.approx(3)


def test_a_stop_lasts_until_it_has_been_told() -> None:
    bench = Bench().start().run(5).order("mission", "stop").run(0.1)
    assert bench.break_("start_button", "pressed").run(0.2).vehicle.controller == "Stopped"
    assert bench.run(0.5).break_("start_button", "pressed").run(0.2).vehicle.controller == "Ready"


def test_a_pressed_stop_switch_is_stronger_than_a_stop_on_command_and_the_start_button() -> None:
    bench = Bench().start().run(5).order("mission", "stop").run(1).break_("stop_switch", "pressed").run(1)
    assert bench.says("VEHICLE_STATUS", "StopReason") == "Switch"
    assert bench.break_("start_button", "pressed").run(1).vehicle.controller == "Stopped"


def test_who_is_paused_before_the_start_does_not_start_and_is_ready_again_when_resumed() -> None:
    bench = Bench().run(1).order("mission", "pause").run(1).order("mission", "start").run(5)
    assert bench.vehicle.controller == "Paused"
    assert bench.kmh == 0
    assert bench.order("mission", "resume").run(1).vehicle.controller == "Ready"
    assert bench.order("mission", "start").run(5).kmh == pytest.approx(3)


@pytest.mark.parametrize("fault", ["silent", "frozen", "reset"])
def test_a_mission_controller_that_is_lost_makes_it_pause_within_a_second(fault: str) -> None:
    bench = Bench().start().run(10)
    bench.mission.inject(bench.simulation.now_ns, Statement("", None, fault))
    bench.run(0.75)
    assert bench.vehicle.controller == "Paused"
    assert bench.says("VEHICLE_STATUS", "StopReason") == "CommandsLost"
    assert bench.run(2).kmh == 0


def test_without_a_position_it_pauses_and_is_not_resumed() -> None:
    bench = Bench().start().run(10).break_("gnss", "lost").run(1.2)
    assert bench.vehicle.controller == "Paused"
    assert bench.order("mission", "resume").run(1).vehicle.controller == "Paused"
    assert bench.break_("gnss", WORKS).order("mission", "resume").run(1).vehicle.controller == "Executing"


def test_a_vehicle_that_can_not_move_gives_up() -> None:
    bench = Bench().start().run(10).break_("wheels", "blocked").run(9.5)
    assert bench.vehicle.controller == "Executing"
    assert bench.run(1).vehicle.controller == "Stopped"
    assert bench.says("VEHICLE_STATUS", "StopReason") == "NotMoving"
    assert bench.says("VEHICLE_STATUS", "MissionState") == "Aborted"


def test_a_speed_limit_of_zero_is_no_fault() -> None:
    bench = Bench().start().run(10).send("VEHICLE_CMD", Request="None", DriveSpeedLimit=0).run(30)
    assert bench.vehicle.controller == "Executing"
    assert bench.kmh == 0


def test_silence_of_the_vehicle_ends_the_signs_of_life() -> None:
    bench = Bench().start().run(10)
    bench.vehicle.inject(bench.simulation.now_ns, Statement("", None, "silent"))
    assert bench.run(3).kmh == 0


# --- hitch, PTO, implement ----------------------------------------------------------------------------------------------------


def test_hitch_pto_and_implement_need_their_time() -> None:
    bench = Bench().run(1).order("pto", "on").order("implement", "set").order("hitch", "lower").run(1.5)
    assert bench.says("VEHICLE_IMPLEMENT", "ImplementState") == "Setting"
    assert bench.says("VEHICLE_HITCH", "HitchState") == "Lowering"
    assert 30 < bench.vehicle.hitch.position < 90
    bench.run(4)
    assert bench.says("VEHICLE_PTO", "PtoState") == "On"
    assert bench.says("VEHICLE_PTO", "PtoSpeed") == pytest.approx(540, abs=1)
    assert bench.says("VEHICLE_IMPLEMENT", "ImplementState") == "Set"
    assert bench.says("VEHICLE_HITCH", "HitchPosition") == 0
    bench.order("pto", "off").run(2)
    assert bench.says("VEHICLE_PTO", "PtoState") == "RunningDown"
    assert bench.run(3).says("VEHICLE_PTO", "PtoState") == "Off"


@pytest.mark.parametrize("state", ["Manual", "Stopped", "Paused"])
def test_nothing_begins_to_move_while_somebody_may_be_near(state: str) -> None:
    bench = Bench().start().run(3)
    if state == "Manual":
        bench.break_("", "manual")
    else:
        bench.order("mission", {"Paused": "pause", "Stopped": "stop"}[state])
    bench.run(1)
    for device, action in (("pto", "on"), ("implement", "set"), ("hitch", "lower")):
        bench.order(device, action)
    for retry in ("On", "Off") * 3:
        bench.send("VEHICLE_PTO_CMD", PtoWanted="On", Retry=retry)
        bench.send("VEHICLE_HITCH_CMD", HitchMove="Move", Retry=retry, HitchWanted=0)
        bench.send("VEHICLE_IMPLEMENT_CMD", ImplementWanted="Set", Retry=retry).run(1)
    assert bench.vehicle.pto.rpm == 0
    assert bench.vehicle.hitch.position == 100
    assert bench.vehicle.implement.position == "Unset"


REQUESTS = st.sampled_from(["None", "Pause", "Resume", "Stop", "Start"])
ON_OFF = st.sampled_from(["On", "Off"])
DEEDS = st.one_of(
    st.tuples(st.just("VEHICLE_CMD"), st.fixed_dictionaries({"Request": REQUESTS, "DriveSpeedLimit": st.sampled_from([0, 1, 6])})),
    st.tuples(st.just("VEHICLE_PTO_CMD"), st.fixed_dictionaries({"PtoWanted": ON_OFF, "Retry": ON_OFF})),
    st.tuples(st.just("VEHICLE_HITCH_CMD"), st.fixed_dictionaries(
        {"HitchMove": st.sampled_from(["Hold", "Move"]), "Retry": ON_OFF, "HitchWanted": st.sampled_from([0, 50, 100])})),
    st.tuples(st.just("VEHICLE_IMPLEMENT_CMD"), st.fixed_dictionaries(
        {"ImplementWanted": st.sampled_from(["Set", "Unset"]), "Retry": ON_OFF})),
    st.sampled_from([("fault", deed) for deed in (
        ("", "manual"), ("", WORKS), ("stop_switch", "pressed"), ("stop_switch", WORKS), ("start_button", "pressed"),
        ("engine", "dies"), ("engine", WORKS), ("gnss", "lost"), ("gnss", WORKS), ("", "reset"), ("hitch", "stuck"),
        ("hitch", WORKS), ("pto", "refuses"), ("pto", WORKS), ("implement", "refuses"), ("implement", WORKS))]))


@given(st.lists(st.tuples(DEEDS, st.sampled_from([0.05, 0.2, 1.0, 3.0])), max_size=40))
@settings(max_examples=150, deadline=None)
def test_no_sequence_of_inputs_begins_a_movement_where_somebody_may_be_near(deeds: list[tuple[tuple[str, object], float]]) -> None:
    bench = Bench().run(0.2)
    bench.simulation.detach(bench.mission)
    vehicle = bench.vehicle
    commands: dict[str, dict[str, Value]] = {}
    for number, ((message, what), seconds) in enumerate(deeds):
        if isinstance(what, tuple):
            bench.break_(*what)
        elif isinstance(what, dict):
            bench.send(message, **what)
            if message != "VEHICLE_CMD":
                commands[message] = what
        for step in range(round(seconds / 0.05)):
            bench.send("VEHICLE_GUIDE", GuideCounter=(number + step) % 16)
            for cyclic, values in commands.items():
                bench.send(cyclic, **values)
            before = (vehicle.controller, vehicle.hitch.position, vehicle.pto.clutch.position, vehicle.implement.position,
                      vehicle.drive.speed_m_s)
            bench.run(0.05)
            state, hitch, clutch, implement, speed_m_s = before
            if state == vehicle.controller and state not in ("Ready", "Executing"):
                assert vehicle.hitch.position == hitch
                assert (clutch, vehicle.pto.clutch.position) != ("Off", "On")
                assert (implement, vehicle.implement.position) != ("Unset", "Set")
                assert vehicle.drive.speed_m_s <= speed_m_s


@pytest.mark.parametrize("how", ["manual", "stop", "reset"])
def test_nothing_comes_back_by_itself_when_it_is_ready_again(how: str) -> None:
    bench = Bench().run(0.5)
    bench.simulation.detach(bench.mission)

    def command(pto: str, hitch: str, implement: str) -> None:
        for _ in range(40):
            bench.send("VEHICLE_PTO_CMD", PtoWanted=pto, Retry="Off")
            bench.send("VEHICLE_HITCH_CMD", HitchMove=hitch, Retry="Off", HitchWanted=0)
            bench.send("VEHICLE_IMPLEMENT_CMD", ImplementWanted=implement, Retry="Off").run(0.1)
    command("Off", "Hold", "Unset")
    command("On", "Move", "Set")
    assert bench.vehicle.pto.state == "On"
    bench.vehicle.hitch.position = 50.0
    if how == "reset":
        bench.break_("", "reset")
    else:
        bench.break_("", "manual") if how == "manual" else bench.break_("stop_switch", "pressed")
        bench.run(5).break_("", WORKS).break_("stop_switch", WORKS).break_("start_button", "pressed")
    command("On", "Move", "Set")
    command("On", "Move", "Set")
    assert bench.vehicle.controller == "Ready"
    assert (bench.vehicle.pto.rpm, bench.vehicle.hitch.position, bench.vehicle.implement.position) == (0, 50, "Unset")
    command("Off", "Hold", "Unset")
    command("On", "Move", "Set")
    assert (bench.vehicle.pto.state, bench.vehicle.hitch.position, bench.vehicle.implement.position) == ("On", 0, "Set")


def test_a_mission_controller_that_was_silent_when_the_vehicle_became_ready_is_obeyed_later() -> None:
    bench = Bench().run(1).break_("", "manual").run(1)
    bench.mission.inject(bench.simulation.now_ns, Statement("", None, "silent"))
    bench.break_("", WORKS).run(5).order("hitch", "lower").order("implement", "set")
    bench.mission.inject(bench.simulation.now_ns, Statement("", None, WORKS))
    bench.run(10)
    assert (bench.vehicle.hitch.position, bench.vehicle.implement.position) == (0, "Set")


def test_after_an_engine_stop_the_pto_stays_off_until_off_was_commanded() -> None:
    bench = Bench().run(1).order("pto", "on").run(5)
    bench.break_("engine", "dies").run(10)
    assert bench.vehicle.pto.rpm == 0
    bench.break_("engine", WORKS)
    for _ in range(10):
        bench.send("VEHICLE_PTO_CMD", PtoWanted="On", Retry="On").run(0.15)
        bench.mission._pto = True
    assert bench.vehicle.pto.rpm == 0
    assert bench.order("pto", "off").run(1).order("pto", "on").run(5).says("VEHICLE_PTO", "PtoState") == "On"


def test_lost_commands_hold_the_hitch_and_switch_the_pto_off() -> None:
    bench = Bench().run(1).order("pto", "on").run(5).order("hitch", "lower").run(1)
    bench.simulation.detach(bench.mission)
    bench.run(8)
    assert bench.vehicle.pto.rpm < 20
    assert 0 < bench.vehicle.hitch.position < 100


def test_a_hitch_refuses_so_many_commands() -> None:
    hitch = Hitch(100)
    hitch.jam(2)
    hitch.advance(0, 0.05)
    assert hitch.position == 100
    hitch.again()
    hitch.advance(0, 0.05)
    assert hitch.position == 100
    hitch.again()
    hitch.advance(0, 0.05)
    assert hitch.position < 100


def test_a_pto_that_stays_on_runs_on() -> None:
    pto = Pto()
    for tick in range(200):
        pto.advance(tick * 50_000_000, "On", 1800, 0.05)
    assert pto.rpm == pytest.approx(540)
    pto.clutch.jam(("Off",))
    for tick in range(200, 400):
        pto.advance(tick * 50_000_000, "Off", 1800, 0.05)
    assert pto.state == "On"


@pytest.mark.parametrize(("wanted", "fault", "after"), [("Off", "Off", "Off"), ("On", "On", "Off")])
def test_a_mended_clutch_lets_go_by_itself_and_engages_only_when_told_again(wanted: str, fault: str, after: str) -> None:
    pto = Pto()
    ticks = iter(range(0, 10**12, 50_000_000))

    def run(wanted: str) -> str:
        for _ in range(200):
            pto.advance(next(ticks), wanted, 1800, 0.05)
        return pto.state

    run("Off" if wanted == "On" else "On")
    pto.clutch.jam((fault,))
    assert run(wanted) != wanted
    pto.mend(next(ticks))
    assert run(wanted) == after


# --- the engine ---------------------------------------------------------------------------------------------------------------


def run_engine(engine: Engine, seconds: float) -> Engine:
    for _ in range(round(seconds / 0.05)):
        engine.advance(works=True)
    return engine


def test_a_healthy_engine_stays_within_its_limits() -> None:
    engine = run_engine(Engine(0.05, 80), 1800)
    assert engine.rpm == 1800
    assert 200 < engine.oil_kpa < 400
    assert engine.coolant_c == pytest.approx(85)
    assert engine.volts == pytest.approx(14.1)
    assert 70 < engine.fuel_percent < 78


def test_an_engine_without_coolant_overheats_and_cools_when_filled() -> None:
    engine = Engine(0.05, 80)
    engine.leaks = True
    assert 85 <= run_engine(engine, 20).coolant_c < 90
    assert run_engine(engine, 60).coolant_c > 112
    engine.fill_coolant()
    assert run_engine(engine, 300).coolant_c < 95


def test_an_empty_tank_stops_the_engine() -> None:
    assert not run_engine(Engine(0.05, 0.01), 60).running


def test_a_dead_alternator_drains_the_battery() -> None:
    engine = run_engine(Engine(0.05, 80), 1)
    engine.alternator = False
    assert run_engine(engine, 1).volts < 12.4
    assert run_engine(engine, 600).volts < 12
    engine.alternator = True
    assert run_engine(engine, 1).volts == pytest.approx(14.1)


# --- what it says -------------------------------------------------------------------------------------------------------------


def test_each_message_comes_at_its_cycle_from_the_source_of_its_device() -> None:
    bench = Bench().start().run(10)
    for message, (source, cycle_ms) in ISOBUS.items():
        times = [t_ns for t_ns, _ in bench.listener.frames[message]]
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(cycle_ms * 1e6, rel=0.02)
        assert bench.listener.last(message).can_id & 0xFF == source
    for message in ("VEHICLE_STATUS", "VEHICLE_MOTION", "VEHICLE_POSITION", "VEHICLE_PTO", "VEHICLE_HITCH", "VEHICLE_MISSION"):
        times = [t_ns for t_ns, _ in bench.listener.frames[message]]
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(CODEC.cycle_ns(message), rel=0.02)


def test_an_unplugged_oil_sensor_reads_error_and_is_a_trouble_code() -> None:
    bench = Bench().run(3)
    assert bench.says("DM1_ENGINE", "EngineSpnLow") == 0
    assert bench.says("DM1_ENGINE", "EngineAmberLamp") == "Off"
    bench.break_("oil_sensor", "unplugged").run(2)
    assert bench.listener.last("EFL_P1").data[3] == 0xFE
    lamps, _, spn_low, spn_mid, fmi, count = bench.listener.last("DM1_ENGINE").data[:6]
    assert (spn_low | spn_mid << 8, fmi, count & 0x7F, lamps >> 2 & 3) == (100, 4, 1, 1)
    bench.break_("oil_sensor", WORKS).run(2)
    assert bench.listener.last("EFL_P1").data[3] * 4 > 200
    assert bench.says("DM1_ENGINE", "EngineSpnLow") == 0


def test_unused_bits_of_j1939_are_ones() -> None:
    bench = Bench().run(2)
    assert bench.listener.last("EFL_P1").data[:3] == b"\xff\xff\xff"
    assert bench.listener.last("EEC1").data[5:] == b"\xff\xff\xff"


def test_a_lost_position_is_not_available() -> None:
    bench = Bench().run(2).break_("gnss", "lost").run(1)
    assert bench.listener.last("VP").data == bytes([0xFF] * 8)
    assert bench.listener.last("VDS").data[:4] == bytes([0xFF] * 4)
    assert bench.listener.last("VEHICLE_POSITION").data == bytes([0xFF] * 8)
    assert bench.says("VEHICLE_MOTION", "PositionFix") == "NoFix"


@pytest.mark.parametrize("rate", [1, 10, 20])
def test_its_receiver_speaks_at_its_rate(rate: int) -> None:
    bench = Bench(nmea_rate=rate)
    said: list[bytes] = []
    bench.vehicle.nmea = said.append
    bench.run(9.99)
    assert [line[3:6] for line in said[:4]] == [b"GGA", b"RMC", b"VTG", b"HDT"]
    assert len(said) == 4 * rate * 10


def test_a_sentence_has_its_checksum() -> None:
    assert sentence("GPGLL,5057.970,N,00146.110,E,142451,A") == b"$GPGLL,5057.970,N,00146.110,E,142451,A*27\r\n"


@pytest.mark.parametrize(("latitude", "longitude", "words"), [
    (40.5, -3.5, b"4030.0000000,N,00330.0000000,W"), (-0.00001, 179.99999, b"0000.0006000,S,17959.9994000,E"),
    (59.99999999999, 0.0, b"6000.0000000,N,00000.0000000,E")])
def test_angles_are_degrees_and_minutes(latitude: float, longitude: float, words: bytes) -> None:
    assert words in next(sentences(0, latitude, longitude, 0, 0, "RtkFixed", 0))
