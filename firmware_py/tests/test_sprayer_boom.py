"""The sprayer boom, its plant, the controller that follows the weed map, and the tractor on its path; in virtual time."""
from __future__ import annotations

import math
import random
from random import Random

import pytest

from firmware_py.codec import Codec, Value
from firmware_py.fault import Statement
from firmware_py.field import LENGTH_M, TURN_RADIUS_M, WIDTH_M, Path, WeedMap, to_degrees, to_metres
from firmware_py.participant import BusFrame
from firmware_py.path_driver import ACCELERATION_M_S2, PathDriver
from firmware_py.sprayer_boom import SprayerBoom, crc8
from firmware_py.sprayer_mission import SprayerMission
from firmware_py.sprayer_plant import SECTIONS
from firmware_py.virtual_bus import Simulation

MS = 1_000_000
SECOND = 1_000_000_000
CODEC = Codec.shipped("sprayer_boom.dbc", "isobus_tractor.dbc")
NAMES = {CODEC.identifier(name): name for name in CODEC.names}
ALL_ON: dict[str, Value] = {f"Valve{n}Wanted": "On" for n in range(1, SECTIONS + 1)}
ALL_OFF: dict[str, Value] = dict.fromkeys(ALL_ON, "Off")


class Commander:
    """Sends what it holds every 100 ms; keeps what it hears, decoded. sections: orders to single ones."""

    def __init__(self) -> None:
        self.commands: dict[str, dict[str, Value]] = {
            "SPRAYER_CMD": {"SprayingWanted": "Off", "Retry": "Off"}, "SPRAYER_BOOM_CMD": {"BoomWanted": "Open", "Retry": "Off"},
            "SPRAYER_MAIN_CMD": {"MainFlowWanted": 6.0, "Retry": "Off"},
            "SPRAYER_DIS_CMD": {"DisFlowWanted": 120.0, "Retry": "Off"},
            "SPRAYER_NOZZLES_CMD": dict(ALL_OFF)}
        self.heard: dict[str, dict[str, Value]] = {}
        self.history: list[tuple[int, str, dict[str, Value]]] = []
        self.raw: list[bytes] = []
        self._next_ns = 0

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        name = NAMES[can_id, extended]
        values = CODEC.decode(name, data)
        assert values is not None
        self.heard[name] = dict(values)
        self.history.append((t_ns, name, dict(values)))
        if name == "SPRAYER_STATUS":
            self.raw.append(data)

    def step(self, now_ns: int) -> list[BusFrame]:
        self._next_ns = now_ns + SECOND // 10
        return [BusFrame(*CODEC.identifier(name), CODEC.encode(name, values)) for name, values in self.commands.items()]

    def next_deadline(self) -> int | None:
        return self._next_ns


class Bench:
    """The boom and its commander on a bus. settings as in a scenario."""

    def __init__(self, seed: int = 1, **settings: float):
        self.sprayer = SprayerBoom("sprayer", CODEC, {"boom_open": 1.0} | settings, Random(seed))
        self.commander = Commander()
        self.simulation = Simulation([self.commander, self.sprayer])

    @property
    def now_ns(self) -> int:
        return self.simulation.now_ns

    def run(self, seconds: float) -> Bench:
        """Let time pass."""
        self.simulation.run(self.now_ns + round(seconds * SECOND))
        return self

    def order(self, **values: Value) -> Bench:
        """Change signals of the commands, wherever they stand."""
        for name, value in values.items():
            for command in self.commander.commands.values():
                if name in command:
                    command[name] = value
        return self

    def retry(self, message: str, value: Value = "On") -> Bench:
        """The retry of one command."""
        self.commander.commands[message]["Retry"] = value
        return self

    def section(self, number: int, order: Value | None) -> Bench:
        """Order one section, None: say nothing to it any more."""
        self.commander.commands.pop(f"SPRAYER_SECTION_{number}", None)
        if order is not None:
            self.commander.commands[f"SPRAYER_SECTION_{number}"] = {"Order": order}
        return self

    def spray(self) -> Bench:
        """All sections open, and settled."""
        return self.order(SprayingWanted="On", **ALL_ON).run(8)

    def break_(self, device: str, action: str, index: int | None = None, commands: int | None = None) -> Bench:
        """Inject a fault."""
        self.sprayer.inject(self.now_ns, Statement(device, index, action, commands))
        return self

    def says(self, message: str, signal: str) -> Value:
        """What the boom last said."""
        return self.commander.heard[message][signal]

    def number(self, message: str, signal: str) -> float:
        """The same, of a number."""
        return float(self.says(message, signal))


# --- sections -----------------------------------------------------------------------------------------------------------------


def test_each_valve_needs_its_own_time_between_0_3_and_2_s() -> None:
    bench = Bench().order(SprayingWanted="On").run(2)
    begin_ns = bench.order(**ALL_ON).now_ns
    bench.run(3)
    times = [next(t_ns for t_ns, name, values in bench.commander.history
                  if t_ns > begin_ns and name == "SPRAYER_NOZZLES" and values[f"Valve{n}"] == "On") - begin_ns
             for n in range(1, SECTIONS + 1)]
    assert all(300 * MS <= time <= 2300 * MS for time in times)
    assert len(set(times)) > 6
    assert [valve.response_ns for valve in Bench(seed=1).sprayer.valves] == [valve.response_ns for valve in bench.sprayer.valves]


def test_sections_close_and_pumps_stop_when_commands_stop() -> None:
    bench = Bench().spray()
    assert all(bench.sprayer.sections_open) and bench.sprayer.spraying
    bench.commander.commands.clear()
    bench.run(0.7)
    assert bench.says("SPRAYER_STATUS", "Control") == "CommandsLost"
    bench.run(2)
    assert not any(bench.sprayer.sections_open)
    assert not bench.sprayer.spraying


def test_a_pattern_that_stops_alone_closes_the_sections() -> None:
    bench = Bench().spray()
    del bench.commander.commands["SPRAYER_NOZZLES_CMD"]
    assert not any(bench.run(3).sprayer.sections_open)
    assert bench.sprayer.spraying


def test_a_stuck_valve_tries_again_only_on_retry_and_once_for_each() -> None:
    bench = Bench().spray().break_("valve", "stuck closed", 7, 2).run(20)
    assert not bench.sprayer.sections_open[6], "no try by itself"
    assert not bench.section(7, "Retry").run(10).sprayer.sections_open[6], "repeated, it is one command"
    bench.section(7, None).run(1.6).section(7, "Retry").run(2.5)
    assert not bench.sprayer.sections_open[6], "the second command that it ignores"
    assert bench.section(7, "Follow").run(0.2).section(7, "Retry").run(2.5).sprayer.sections_open[6]


def test_close_locks_a_section_until_retry_or_follow() -> None:
    bench = Bench().spray().section(7, "Close").run(2.5).section(7, None).run(5)
    assert bench.sprayer.sections_open == tuple(n != 7 for n in range(1, SECTIONS + 1))
    assert bench.says("SPRAYER_STATUS", "SectionsLocked") == 1 << 6
    assert bench.says("SPRAYER_STATUS", "SectionsOpen") == 0xFFF & ~(1 << 6)
    assert all(bench.section(7, "Follow").run(2.5).sprayer.sections_open)
    bench.section(7, "Close").run(2.5)
    assert all(bench.section(7, "Retry").run(2.5).sprayer.sections_open)
    assert bench.says("SPRAYER_STATUS", "SectionsLocked") == 0


def test_a_retry_opens_nothing_that_the_pattern_wants_closed() -> None:
    bench = Bench().order(SprayingWanted="On", **ALL_OFF).run(3).section(7, "Retry").run(3)
    assert not any(bench.sprayer.sections_open)


# --- lines and tanks ----------------------------------------------------------------------------------------------------------


def test_flows_follow_the_share_of_the_open_sections_at_the_same_pressure() -> None:
    bench = Bench().spray()
    assert bench.number("SPRAYER_MAIN", "MainFlow") == pytest.approx(6.0, abs=0.1)
    assert bench.number("SPRAYER_MAIN", "MainPressure") == pytest.approx(2.0, abs=0.1)
    assert bench.number("SPRAYER_DIS", "DisFlow") == pytest.approx(120, abs=2)
    bench.order(**{f"Valve{n}Wanted": "Off" for n in range(1, 10)}).run(4)
    assert bench.number("SPRAYER_MAIN", "MainFlow") == pytest.approx(1.5, abs=0.05)
    assert bench.number("SPRAYER_MAIN", "MainFlowTarget") == 1.5
    assert bench.number("SPRAYER_MAIN", "MainPressure") == pytest.approx(2.0, abs=0.1)
    assert bench.number("SPRAYER_DIS", "DisFlow") == pytest.approx(30, abs=1)


def test_set_points_beyond_the_limits_are_taken_for_the_limits() -> None:
    bench = Bench().spray()
    frame = BusFrame(*CODEC.identifier("SPRAYER_MAIN_CMD"), b"\xff\x0f\x00")
    del bench.commander.commands["SPRAYER_MAIN_CMD"]
    bench.run(0.3).sprayer.receive(bench.now_ns, *frame)
    bench.run(2)
    assert bench.says("SPRAYER_MAIN", "MainFlowSet") == 30
    assert bench.number("SPRAYER_MAIN", "MainPressure") <= 10


def test_a_refused_set_point_is_taken_on_the_retry_that_comes_after() -> None:
    bench = Bench().spray().break_("main_flow", "refuses", commands=2).order(MainFlowWanted=3.0).run(5)
    assert bench.says("SPRAYER_MAIN", "MainFlowSet") == 6
    assert bench.retry("SPRAYER_MAIN_CMD").run(5).says("SPRAYER_MAIN", "MainFlowSet") == 6
    bench.retry("SPRAYER_MAIN_CMD", "Off").run(0.5).retry("SPRAYER_MAIN_CMD").run(0.5)
    assert bench.says("SPRAYER_MAIN", "MainFlowSet") == 3


def test_a_weak_pump_gives_too_little_and_says_so_by_flow_and_target() -> None:
    bench = Bench().spray().break_("pump", "weak").run(3)
    assert bench.number("SPRAYER_MAIN", "MainFlow") < 0.1 * bench.number("SPRAYER_MAIN", "MainFlowTarget")


def test_a_blocked_line_builds_up_pressure_until_a_flush_frees_it() -> None:
    bench = Bench().spray().break_("line", "blocked", commands=2).run(3)
    assert (bench.number("SPRAYER_DIS", "DisPressure"), bench.number("SPRAYER_DIS", "DisFlow")) == (8, 0)
    bench.retry("SPRAYER_DIS_CMD").run(0.5)
    assert bench.number("SPRAYER_DIS", "DisPressure") == 0, "relieved"
    assert bench.run(4).number("SPRAYER_DIS", "DisPressure") == 8
    bench.retry("SPRAYER_DIS_CMD", "Off").run(0.5).retry("SPRAYER_DIS_CMD").run(4)
    assert bench.number("SPRAYER_DIS", "DisPressure") < 3
    assert bench.number("SPRAYER_DIS", "DisFlow") == pytest.approx(120, abs=2)


def test_what_is_sprayed_is_missing_in_the_tanks() -> None:
    bench = Bench().spray().run(600)
    used = bench.number("SPRAYER_TANKS", "MainTankUsed")
    assert used == pytest.approx(60, abs=2)
    assert bench.number("SPRAYER_TANKS", "MainTankLevel") == pytest.approx(150 - used, abs=1.2)
    assert bench.number("SPRAYER_TANKS", "DisTankLevel") == pytest.approx(8 - 0.02 * used, abs=0.1)


@pytest.mark.parametrize(("device", "action", "change_l"), [
    ("main_tank", "leaks", -20), ("level_sensor", "drifts up", 20), ("level_sensor", "drifts down", -20)])
def test_leak_and_drift_show_in_the_level_and_not_in_the_flow(device: str, action: str, change_l: float) -> None:
    bench = Bench().run(1).break_(device, action).run(60).break_(device, "works").run(60)
    assert bench.number("SPRAYER_TANKS", "MainTankLevel") == pytest.approx(150 + change_l, abs=1.3)
    assert bench.number("SPRAYER_TANKS", "MainTankUsed") == 0


def test_an_empty_tank_gives_nothing_and_can_be_filled() -> None:
    bench = Bench().spray().break_("main_tank", "empty").break_("dis_tank", "empty").run(3)
    assert bench.number("SPRAYER_MAIN", "MainFlow") == bench.number("SPRAYER_DIS", "DisFlow") == 0
    bench.break_("main_tank", "filled").break_("dis_tank", "filled").run(4)
    assert bench.number("SPRAYER_MAIN", "MainFlow") == pytest.approx(6, abs=0.1)
    assert bench.number("SPRAYER_TANKS", "MainTankFilled") == 200


# --- boom ---------------------------------------------------------------------------------------------------------------------


def test_the_boom_unfolds_and_folds_in_10_s() -> None:
    bench = Bench(boom_open=0).run(5)
    assert bench.says("SPRAYER_STATUS", "BoomState") == "Opening"
    assert bench.run(5.5).says("SPRAYER_STATUS", "BoomState") == "Open"
    assert bench.order(BoomWanted="Close").run(10.5).says("SPRAYER_STATUS", "BoomState") == "Closed"


def test_it_sprays_with_the_boom_open_only_and_folds_only_when_nothing_is_sprayed() -> None:
    bench = Bench(boom_open=0).order(SprayingWanted="On", **ALL_ON).run(9)
    assert not bench.sprayer.spraying
    assert bench.run(3).sprayer.spraying
    assert bench.order(BoomWanted="Close").run(10).sprayer.boom.opening == 1
    assert bench.order(SprayingWanted="Off").run(12).sprayer.boom.opening == 0


def test_the_boom_stands_when_its_command_stops() -> None:
    bench = Bench(boom_open=0).run(5)
    del bench.commander.commands["SPRAYER_BOOM_CMD"]
    opening = bench.run(1.2).sprayer.boom.opening
    assert (bench.run(20).sprayer.boom.opening, bench.sprayer.boom.state) == (opening, "Stopped")


def test_a_boom_that_gave_up_is_held_to_run() -> None:
    bench = Bench(boom_open=0).run(5).break_("boom", "blocked", commands=1).run(10)
    assert bench.sprayer.boom.state == "Stopped"
    assert bench.retry("SPRAYER_BOOM_CMD").run(1).sprayer.boom.state == "Opening"
    opening = bench.retry("SPRAYER_BOOM_CMD", "Off").run(0.3).sprayer.boom.opening
    assert (bench.run(10).sprayer.boom.opening, bench.sprayer.boom.state) == (opening, "Stopped"), "let go, it stands"
    assert bench.retry("SPRAYER_BOOM_CMD").run(10).sprayer.boom.state == "Open"


def test_a_slow_boom_is_not_stopped_by_a_retry_that_ends() -> None:
    bench = Bench(boom_open=0).break_("boom", "slow").run(5).retry("SPRAYER_BOOM_CMD").run(1).retry("SPRAYER_BOOM_CMD", "Off")
    assert bench.run(1).sprayer.boom.state == "Opening"


def test_after_the_hand_panel_nothing_moves_until_stop_was_commanded() -> None:
    bench = Bench(boom_open=0).run(5).break_("", "manual").run(1)
    opening = bench.sprayer.boom.opening
    bench.break_("", "works").run(5).retry("SPRAYER_BOOM_CMD").run(5)
    assert bench.sprayer.boom.opening == opening
    assert bench.order(BoomWanted="Stop", Retry="Off").run(0.5).order(BoomWanted="Open").run(10).sprayer.boom.state == "Open"


# --- what it says -------------------------------------------------------------------------------------------------------------


def test_the_checksum_is_crc8_sae_j1850() -> None:
    assert crc8(b"123456789") == 0x4B
    assert crc8(bytes(4)) == 0x59


def test_status_counts_and_is_right_by_its_checksum() -> None:
    bench = Bench().run(3)
    counters = [data[6] & 15 for data in bench.commander.raw]
    assert counters == [(counters[0] + n) % 16 for n in range(len(counters))]
    assert all(crc8(data[:7]) == data[7] for data in bench.commander.raw)


def test_a_wrong_counter_runs_backwards_and_a_wrong_checksum_is_none() -> None:
    bench = Bench().run(1).break_("", "wrong counter").run(1)
    last, previous = bench.commander.raw[-1][6], bench.commander.raw[-2][6]
    assert (previous - last) % 16 == 1
    data = bench.break_("", "works").break_("", "wrong checksum").run(1).commander.raw[-1]
    assert crc8(data[:7]) != data[7]


def test_babbling_repeats_one_status_without_end_until_it_works_again() -> None:
    bench = Bench().spray().break_("", "babbling").run(0.2)
    seen = len(bench.commander.raw)
    bench.run(1)
    assert len(bench.commander.raw) - seen > 400
    assert len(set(bench.commander.raw[seen:])) == 1
    bench.run(2).break_("", "works").run(1)
    seen = len(bench.commander.raw)
    assert len(bench.run(1).commander.raw) - seen == 10


def test_a_reset_forgets_locks_and_set_points_and_leaves_boom_and_tanks() -> None:
    bench = Bench().spray().section(7, "Close").run(3).section(7, None)
    used = bench.sprayer.plant.tank.used_l
    bench.break_("", "reset").run(1)
    assert not bench.sprayer.spraying
    bench.run(5)
    assert bench.sprayer.locked == set()
    assert bench.sprayer.spraying and all(bench.sprayer.sections_open)
    assert bench.sprayer.plant.tank.used_l > used


@pytest.mark.parametrize("seed", range(3))
def test_garbage_on_the_bus_does_no_harm(seed: int) -> None:
    dice = random.Random(seed)
    boom = SprayerBoom("sprayer", CODEC, {"boom_open": 1}, Random(seed))
    mission = SprayerMission("mission", CODEC, {}, Random(seed))
    mission.order(0, Statement("spraying", None, "on"))
    mission.order(0, Statement("boom", None, "open"))
    for step in range(2000):
        node = dice.choice((boom, mission))
        can_id, extended = CODEC.identifier(dice.choice(node.HEARS))
        node.receive(step * 20 * MS, can_id, extended, dice.randbytes(dice.choice((8, 8, 8, dice.randint(0, 7)))))
        for frame in (*boom.step(step * 20 * MS), *mission.step(step * 20 * MS)):
            assert CODEC.decode(NAMES[frame.can_id, frame.extended], frame.data) is not None
    assert boom.short_frames > 0


# --- field, path, tractor -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [(0.0, 0.0), (42.5, 41.5), (-10.0, 3.25), (17.0, -4.0)])
def test_degrees_and_metres_are_inverse_within_the_grain_of_the_wire(place: tuple[float, float]) -> None:
    latitude, longitude = to_degrees(*place)
    back = to_metres(round(latitude, 7), round(longitude, 7))
    assert math.dist(back, place) < 0.01


def test_the_map_is_of_half_metre_cells_and_ends_at_the_field() -> None:
    weeds = WeedMap()
    assert (len(weeds.cells), len(weeds.cells[0])) == (83, 85)
    assert weeds.weed(15, 21)
    assert not any(weeds.weed(*place) for place in ((-0.1, 9), (42.6, 9), (4, 41.6), (4, -0.1), (0.1, 0.1)))
    share = sum(map(sum, weeds.cells)) / (83 * 85)
    assert 0.08 < share < 0.25


def test_the_path_covers_the_field_with_turns_of_3_m() -> None:
    path = Path()
    poses = [path.at(distance / 10) for distance in range(round(path.length_m * 10))]
    straight = {round(pose.x_m, 6) for pose in poses if not pose.turning}
    assert straight == {3 + 6 * track for track in range(7)}
    assert all(math.dist(before[:2], after[:2]) < 0.1001 for before, after in zip(poses, poses[1:], strict=False))
    for before, after in zip(poses, poses[1:], strict=False):
        turned = abs((after.heading_deg - before.heading_deg + 180) % 360 - 180)
        assert turned <= math.degrees(0.1 / TURN_RADIUS_M) + 1e-6
    assert all(not 0 < pose.y_m < LENGTH_M and 0 < pose.x_m < WIDTH_M for pose in poses if pose.turning), "turns on the headlands"


class Listener:
    """Keeps what the tractor says."""

    def __init__(self) -> None:
        self.speeds_m_s: list[float] = []
        self.ids: set[int] = set()

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        self.ids.add(can_id)
        name = NAMES[can_id & ~0xFF | 0xFE, extended]
        values = CODEC.decode(name, data)
        assert values is not None
        if name == "GROUND_SPEED":
            self.speeds_m_s.append(float(values["GroundSpeed"]))

    def step(self, now_ns: int) -> list[BusFrame]:
        return []

    def next_deadline(self) -> int | None:
        return None


def test_the_tractor_drives_3_km_h_in_the_field_and_2_in_the_turns() -> None:
    driver, listener = PathDriver("tractor", CODEC, {}, Random(1)), Listener()
    simulation = Simulation([driver, listener])
    while not driver.arrived:
        simulation.run(simulation.now_ns + SECOND)
        if driver.pose.turning:
            assert driver.speed_m_s == pytest.approx(2 / 3.6, abs=0.02)
        elif 3 < driver.pose.y_m < LENGTH_M - 3 and driver.driven_m > 10:
            assert driver.speed_m_s == pytest.approx(3 / 3.6, abs=0.01)
    assert 500 < simulation.now_ns / SECOND < 560
    steps = [abs(after - before) for before, after in zip(listener.speeds_m_s, listener.speeds_m_s[1:], strict=False)]
    assert max(steps[:-2]) <= ACCELERATION_M_S2 / 10 + 0.002
    assert all(can_id & 0xFF == 0x1C for can_id in listener.ids)


def test_the_tractor_can_be_made_to_stand_and_to_drive_on() -> None:
    driver = PathDriver("tractor", CODEC, {"start": 5.0}, Random(1))
    simulation = Simulation([driver])
    simulation.run(5 * SECOND)
    assert driver.driven_m < 0.01
    simulation.run(20 * SECOND)
    driver.inject(simulation.now_ns, Statement("", None, "stands"))
    simulation.run(30 * SECOND)
    assert driver.speed_m_s == 0
    driver.inject(simulation.now_ns, Statement("", None, "works"))
    simulation.run(40 * SECOND)
    assert driver.speed_m_s > 0.8


# --- mission controller -------------------------------------------------------------------------------------------------------


class Field:
    """A mission controller to which a test says what it hears."""

    def __init__(self, **settings: float):
        self.mission = SprayerMission("mission", CODEC, settings, Random(1))
        self.now_ns = 0

    def hear(self, name: str, **values: Value) -> Field:
        """A message; a tractor's from some source address."""
        can_id, extended = CODEC.identifier(name)
        full = dict.fromkeys(CODEC.decode(name, bytes(8)) or (), 0) | values
        self.mission.receive(self.now_ns, can_id & ~0xFF | 0x42 if extended else can_id, extended, CODEC.encode(name, full))
        return self

    def order(self, device: str, action: str, index: int | None = None) -> Field:
        """An order."""
        self.mission.order(self.now_ns, Statement(device, index, action))
        return self

    def stand(self, x_m: float, y_m: float, heading_deg: float = 0.0, speed_m_s: float = 0.0) -> Field:
        """The tractor says where it is."""
        latitude, longitude = to_degrees(x_m, y_m)
        self.hear("VP", Latitude=latitude, Longitude=longitude).hear("VDS", Heading=heading_deg)
        return self.hear("GROUND_SPEED", GroundSpeed=speed_m_s)

    def run(self, seconds: float = 0.2) -> dict[str, dict[str, Value]]:
        """Let time pass; the last of each message that it sent."""
        sent: dict[str, dict[str, Value]] = {}
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns += 50 * MS
            for frame in self.mission.step(self.now_ns):
                name = NAMES[frame.can_id, frame.extended]
                sent[name] = dict(CODEC.decode(name, frame.data) or {})
        return sent

    def open_sections(self, seconds: float = 0.2) -> list[int]:
        """Sections it wants open."""
        pattern = self.run(seconds)["SPRAYER_NOZZLES_CMD"]
        return [n for n in range(1, SECTIONS + 1) if pattern[f"Valve{n}Wanted"] == "On"]


def spraying(**settings: float) -> Field:
    """One that sprays."""
    return Field(**settings).order("boom", "open").order("spraying", "on").hear(
        "SPRAYER_STATUS", BoomState="Open", Control="Remote", Spraying="On")


def test_sections_follow_the_map_from_left_to_right() -> None:
    """A patch from x = 6.5 to 10.5 m."""
    field = spraying(boom_behind=0)
    assert field.stand(9, 32, 0).open_sections() == [2, 3, 4, 5, 6, 7, 8, 9]
    assert field.stand(9, 32, 180).open_sections() == [4, 5, 6, 7, 8, 9, 10, 11]


def test_without_an_order_or_a_position_nothing_is_opened() -> None:
    assert Field().stand(15, 21).open_sections() == []
    assert spraying().open_sections() == []
    field = spraying().stand(15, 21)
    assert field.open_sections()
    assert field.open_sections(1.2) == [], "a position grows old"


def test_it_looks_ahead_by_the_time_that_valves_need() -> None:
    early, late = spraying(lookahead=2, boom_behind=0), spraying(lookahead=0, boom_behind=0)
    assert early.stand(15, 12.3, 0, 0.83).open_sections()
    assert not late.stand(15, 12.3, 0, 0.83).open_sections()


def test_speed_that_is_none_leaves_the_assumed_one_and_set_points_follow_speed_and_dose() -> None:
    field = spraying()
    assert field.run()["SPRAYER_MAIN_CMD"]["MainFlowWanted"] == 6
    assert field.stand(3, 3, 0, 2 / 3.6).run()["SPRAYER_MAIN_CMD"]["MainFlowWanted"] == 4
    assert field.hear("GROUND_SPEED", GroundSpeed=64.2).run()["SPRAYER_MAIN_CMD"]["MainFlowWanted"] == 6
    sent = field.order("dose", "half").run()
    assert (sent["SPRAYER_MAIN_CMD"]["MainFlowWanted"], sent["SPRAYER_DIS_CMD"]["DisFlowWanted"]) == (3, 60)


@pytest.mark.parametrize(("alarm", "message"), [
    ("SprayingStartStopFailure", "SPRAYER_CMD"), ("SectionStaysOpen", "SPRAYER_CMD"),
    ("OpenCloseBoomFailure", "SPRAYER_BOOM_CMD"), ("BoomOpeningNotAdjusted", "SPRAYER_BOOM_CMD"),
    ("SetMainFlowFailure", "SPRAYER_MAIN_CMD"), ("MainFlowNotAdjusted", "SPRAYER_MAIN_CMD"),
    ("SetDisFlowFailure", "SPRAYER_DIS_CMD"), ("HerbicideLineBlocked", "SPRAYER_DIS_CMD")])
def test_what_level_1_holds_is_not_sent_and_nothing_else_is_left_out(alarm: str, message: str) -> None:
    field = spraying()
    always = set(field.run(0.5))
    assert set(field.hear("SPRAYER_ALARMS", **{alarm: "Repairing"}).run(0.5)) == always - {message}
    assert set(field.hear("SPRAYER_ALARMS", **{alarm: "Active"}).run(0.5)) == always
    field.hear("SPRAYER_ALARMS", **{alarm: "LockedOut"}).run(0.5)
    sent = field.hear("SPRAYER_ALARMS").run(0.5)
    assert sent["SPRAYER_CMD"]["SprayingWanted"] == "Off", "a lock-out withdraws the order"


def test_one_that_ignores_repairs_goes_on_sending() -> None:
    field = spraying()
    field.mission.inject(0, Statement("", None, "ignores repairs"))
    assert "SPRAYER_CMD" in field.hear("SPRAYER_ALARMS", SprayingStartStopFailure="Repairing").run(0.5)


def test_a_locked_out_section_is_left_out_and_told_to_follow_afterwards() -> None:
    field = spraying().order("section", "on")
    assert field.open_sections() == list(range(1, SECTIONS + 1))
    assert 7 in field.hear("SPRAYER_ALARMS", Section7NotSet="Repairing").open_sections(), "a repair goes by the pattern"
    field.hear("SPRAYER_ALARMS", Section7NotSet="LockedOut")
    assert field.open_sections(1) == [1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12]
    sent = field.hear("SPRAYER_ALARMS").run(1)
    assert sent["SPRAYER_SECTION_7"] == {"Order": "Follow"}
    assert sent["SPRAYER_NOZZLES_CMD"]["Valve7Wanted"] == "On"
    field.run(2)
    assert "SPRAYER_SECTION_7" not in field.run(2)


def test_it_waits_with_folding_until_nothing_is_sprayed_and_with_spraying_until_the_boom_is_open() -> None:
    field = spraying().order("boom", "close")
    sent = field.run(0.5)
    assert (sent["SPRAYER_CMD"]["SprayingWanted"], sent["SPRAYER_BOOM_CMD"]["BoomWanted"]) == ("Off", "Stop")
    sent = field.hear("SPRAYER_STATUS", BoomState="Open").run(0.5)
    assert sent["SPRAYER_BOOM_CMD"]["BoomWanted"] == "Close"
    sent = field.order("boom", "open").order("spraying", "on").hear("SPRAYER_STATUS", BoomState="Opening").run(0.5)
    assert sent["SPRAYER_CMD"]["SprayingWanted"] == "Off"


def test_the_hand_panel_and_a_reset_withdraw_every_order() -> None:
    field = spraying()
    sent = field.hear("SPRAYER_STATUS", Control="Manual", BoomState="Open").run(0.5)
    assert (sent["SPRAYER_CMD"]["SprayingWanted"], sent["SPRAYER_BOOM_CMD"]["BoomWanted"]) == ("Off", "Stop")
    field = spraying()
    field.mission.inject(field.now_ns, Statement("", None, "reset"))
    assert field.run(3)["SPRAYER_CMD"]["SprayingWanted"] == "Off"


def test_an_unknown_order_is_refused() -> None:
    with pytest.raises(ValueError, match="knows no order"):
        Field().order("plough", "down")
