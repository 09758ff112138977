"""The whole chain over recordings of a real tractor: real faults are found, nothing else is.

Truth about the recordings: README.md beside them. Faults that no recording holds are planted into one: the traffic stays
real, only the signal in question is changed.
"""
from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import pytest

from level1.catalog import Catalog
from level1.decode import encode
from level1.event import Event
from level1.event import encode as encode_event
from level1.frame import EXTENDED, Frame, j1939_pgn
from level1.io import definitions
from level1.io.replay import Log, LogError
from level1.supervisor import Supervisor

DATA = Path(__file__).parents[2].parent / "shared" / "data"
TRACTOR = DATA / "jd5055e-tractor"
pytestmark = pytest.mark.skipif(not TRACTOR.is_dir(), reason=f"the shared recordings are not at {DATA}")

S = 1_000_000_000
LOGS = sorted(path.name for path in TRACTOR.glob("*.log"))
FAULTS = {
    "LeftSensorUnplugged-CheckEngine-1of3.log": {"OilPressureSensorFault", "EngineWarningLamp", "TroubleCode"},
    "noStartInGear1.log": {"TransmissionFault", "TroubleCode"},
}
"""What is wrong in a recording; in all others nothing is."""
RUNNING = "transmision123inGear20Seconds.log"
"""Key on, start, 25 s at idle, key off, after-run of the engine controller."""
ENGINE, TRANSMISSION = 0x00, 0x03

Frames = Sequence[tuple[int, int, bytes]]


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["isobus_tractor.dbc", "ucs.dbc"])


@cache
def frames_of(name: str) -> tuple[Frame, ...]:
    return tuple(Log(TRACTOR / name).frames())


def replay(catalog: Catalog, frames: Frames) -> list[Event]:
    """The events of a recording, up to its last time stamp."""
    supervisor = Supervisor(catalog, unit="replay", broadcast=False)
    outputs = [*supervisor.receive_many(frames), *supervisor.tick(max(frame[0] for frame in frames))]
    return [output for output in outputs if isinstance(output, Event)]


def raised(events: Sequence[Event]) -> set[str]:
    return {event.alarm for event in events if event.event == "raised"}


def is_from(frame: tuple[int, int, bytes], pgn: int, source: int | None = None) -> bool:
    return bool(frame[1] & EXTENDED) and j1939_pgn(frame[1] & 0x1FFF_FFFF) == pgn and source in (None, frame[1] & 0xFF)


def planted(catalog: Catalog, frames: Frames, message: str, begin_s: float, end_s: float = 1e9,
            **raws: int) -> list[tuple[int, int, bytes]]:
    """The recording with signals of a message set to other raw values for a while."""
    definition = catalog.messages[message]
    assert definition.pgn is not None
    begin, end = frames[0][0] + begin_s * S, frames[0][0] + end_s * S
    return [(t, key, encode(definition, raws, data))
            if begin <= t < end and is_from((t, key, data), definition.pgn, definition.source) else (t, key, data)
            for t, key, data in frames]


@pytest.mark.parametrize("name", LOGS)
def test_a_recording_raises_its_faults_and_nothing_else(catalog: Catalog, name: str) -> None:
    assert raised(replay(catalog, frames_of(name))) == FAULTS.get(name, set())


def test_the_unplugged_oil_pressure_sensor_is_told_with_its_value_and_trouble_code(catalog: Catalog) -> None:
    events = {event.alarm: event for event in replay(catalog, frames_of("LeftSensorUnplugged-CheckEngine-1of3.log"))}
    assert events["OilPressureSensorFault"].values == {"EFL_P1.EngineOilPressure": "error"}
    code = events["TroubleCode"].values
    assert (code["SourceAddress"], code["SPN"], code["FMI"]) == (ENGINE, 100, 4)


def test_the_refused_start_in_gear_is_told_with_its_trouble_code(catalog: Catalog) -> None:
    events = {event.alarm: event for event in replay(catalog, frames_of("noStartInGear1.log"))}
    code = events["TroubleCode"].values
    assert (code["SourceAddress"], code["SPN"], code["FMI"]) == (TRANSMISSION, 524020, 31)


def test_two_replays_give_the_same_bytes(catalog: Catalog) -> None:
    def lines() -> list[bytes]:
        return [encode_event(event) for name in FAULTS for event in replay(catalog, frames_of(name))]
    assert lines() == lines() != []


@pytest.mark.parametrize("name", [*FAULTS, "startUp.log"])
def test_frame_by_frame_gives_the_same_as_at_once(catalog: Catalog, name: str) -> None:
    frames = frames_of(name)
    supervisor = Supervisor(catalog, unit="replay", broadcast=False)
    single = [output for frame in frames for output in supervisor.receive(frame)]
    single.extend(supervisor.tick(frames[-1].t_ns))
    assert [output for output in single if isinstance(output, Event)] == replay(catalog, frames)


# -- faults planted into a real start and run ------------------------------------------------------------------------------

@pytest.mark.parametrize(("message", "raws", "alarms"), [
    ("EFL_P1", {"EngineOilPressure": 10}, {"EngineOilPressureLow"}),
    ("EFL_P1", {"EngineOilPressure": 0xFE}, {"OilPressureSensorFault"}),
    ("ET1", {"CoolantTemperature": 40 + 106}, {"CoolantHot"}),
    ("ET1", {"CoolantTemperature": 40 + 113}, {"CoolantHot", "CoolantCritical"}),
    ("ET1", {"CoolantTemperature": 0xFE}, {"CoolantSensorFault"}),
    ("EEC1", {"EngineSpeed": 8 * 3001}, {"EngineOverspeed"}),
    ("VEP1", {"KeySwitchVoltage": 20 * 16}, {"ChargingVoltageHigh"}),
    ("REAR_PTO", {"RearPtoSpeed": 8 * 540}, {"RearPtoStillTurning"}),
    ("REAR_PTO", {"RearPtoSpeed": 8 * 640, "RearPtoEngaged": 1, "RearPtoMode": 0}, {"RearPtoOverspeed"}),
    ("REAR_PTO", {"RearPtoEngageRequest": 1}, {"RearPtoNotEngaging"}),
    ("DD", {"FuelLevel": 24}, set()),
])
def test_a_planted_fault_is_found_and_no_other(catalog: Catalog, message: str, raws: dict[str, int], alarms: set[str]) -> None:
    frames = planted(catalog, frames_of(RUNNING), message, 8.0, 20.0, **raws)
    assert raised(replay(catalog, frames)) == alarms


def test_a_fuel_level_that_stays_low_for_a_minute_is_told(catalog: Catalog) -> None:
    frames = planted(catalog, held_running(frames_of(RUNNING), 60), "DD", 8.0, FuelLevel=24)
    assert raised(replay(catalog, frames)) == {"FuelLow"}


def test_charging_voltage_that_stays_low_for_half_a_minute_is_told(catalog: Catalog) -> None:
    frames = planted(catalog, held_running(frames_of(RUNNING), 40), "VEP1", 8.0, KeySwitchVoltage=20 * 12)
    assert raised(replay(catalog, frames)) == {"ChargingVoltageLow"}


def test_a_battery_that_runs_down_with_the_key_on_is_told(catalog: Catalog) -> None:
    first, *_ = frames = frames_of("idle10sec.log")
    slow = [(first.t_ns + 2 * (t - first.t_ns), key, data) for t, key, data in frames]
    assert raised(replay(catalog, planted(catalog, slow, "VEP1", 5.0, KeySwitchVoltage=20 * 11))) == {"BatteryLow"}


def held_running(frames: Frames, more_s: int) -> list[tuple[int, int, bytes]]:
    """The recording with its seconds 10 to 20 repeated until the engine has run for so much longer."""
    start = frames[0][0]
    piece = [frame for frame in frames if 10 * S <= frame[0] - start < 20 * S]
    head = [tuple(frame) for frame in frames if frame[0] - start < 20 * S]
    repeats = [(t + 10 * S * turn, key, data) for turn in range(1, more_s // 10 + 1) for t, key, data in piece]
    return [*head, *repeats]  # type: ignore[list-item]


def test_low_oil_pressure_is_told_five_seconds_after_the_first_low_sample(catalog: Catalog) -> None:
    frames = planted(catalog, frames_of(RUNNING), "EFL_P1", 8.0, EngineOilPressure=10)
    first = next(t for t, key, data in frames if is_from((t, key, data), 65263) and data[3] == 10)
    event = next(event for event in replay(catalog, frames) if event.event == "raised")
    assert event.t * S == first + 5 * S


def test_an_alarm_of_the_running_engine_clears_when_it_is_switched_off(catalog: Catalog) -> None:
    frames = planted(catalog, frames_of(RUNNING), "EFL_P1", 8.0, EngineOilPressure=10)
    assert [event.event for event in replay(catalog, frames)] == ["raised", "cleared"]


def test_an_engine_controller_that_falls_silent_is_told_while_others_talk(catalog: Catalog) -> None:
    frames = frames_of(RUNNING)
    cut = frames[0].t_ns + 12 * S
    quiet = [frame for frame in frames if frame.t_ns < cut or frame.key & 0xFF != ENGINE]
    last = max(frame.t_ns for frame in quiet if is_from(frame, 61444))
    events = replay(catalog, quiet)
    assert raised(events) == {"EngineEcuSilent"}
    assert events[0].t * S == last + 5 * S


def test_an_engine_controller_that_never_talks_is_told_while_others_do(catalog: Catalog) -> None:
    quiet = [frame for frame in frames_of(RUNNING) if frame.key & 0xFF != ENGINE]
    assert raised(replay(catalog, quiet)) == {"EngineEcuSilent"}


@pytest.mark.parametrize(("source", "alarm"), [(0x03, "TransmissionEcuSilent"), (0x47, "TractorEcuSilent")])
def test_a_controller_that_falls_silent_while_the_engine_runs_is_told(catalog: Catalog, source: int, alarm: str) -> None:
    frames = frames_of(RUNNING)
    quiet = [frame for frame in frames if frame.t_ns < frames[0].t_ns + 12 * S or frame.key & 0xFF != source]
    assert raised(replay(catalog, quiet)) == {alarm}


def test_a_red_lamp_of_the_engine_controller_is_told(catalog: Catalog) -> None:
    frames = frames_of(RUNNING)
    codes = [Frame(frames[0].t_ns + n * S, EXTENDED | 0x18FECA00, bytes.fromhex("10FF6E000001FFFF")) for n in range(8, 20)]
    assert raised(replay(catalog, sorted([*frames, *codes]))) == {"EngineStopLamp", "TroubleCode"}


# -- mishaps of the recording that are no fault of the tractor ----------------------------------------------------------------

def half_lost(frames: Frames, chance: random.Random) -> Frames:
    """Every other frame is missing."""
    return [frame for frame in frames if chance.random() < 0.5]


def begun_late(frames: Frames, chance: random.Random) -> Frames:
    """The recorder was switched on at some moment."""
    return frames[chance.randrange(len(frames) // 2 + 1):]


def ended_early(frames: Frames, chance: random.Random) -> Frames:
    """The recorder was switched off at some moment."""
    return frames[:chance.randrange(len(frames) // 2, len(frames)) + 1]


def with_a_gap(frames: Frames, chance: random.Random) -> Frames:
    """All nodes are missing for some seconds."""
    begin = chance.randint(frames[0][0], frames[-1][0])
    end = begin + chance.randint(1, 20) * S
    return [frame for frame in frames if not begin < frame[0] < end]


def paused(frames: Frames, chance: random.Random) -> Frames:
    """The recorder stood still for some seconds."""
    begin, length = chance.randint(frames[0][0], frames[-1][0]), chance.randint(1, 60) * S
    return [(t + length if t > begin else t, key, data) for t, key, data in frames]


def with_wild_samples(frames: Frames, chance: random.Random) -> Frames:
    """One payload in two hundred is garbage (not those of trouble codes: they are sent once and stand until revoked)."""
    return [(t, key, chance.randbytes(len(data))) if chance.random() < 0.005 and not is_from((t, key, data), 65226)
            else (t, key, data) for t, key, data in frames]


def doubled(frames: Frames, chance: random.Random) -> Frames:
    """Two adapters on one bus: one frame in ten comes twice."""
    return [frame for frame in frames for _ in range(1 + (chance.random() < 0.1))]


def reordered(frames: Frames, chance: random.Random) -> Frames:
    """One frame in twenty changes places with one of the next four."""
    mixed = list(frames)
    for _ in range(len(mixed) // 20):
        here = chance.randrange(len(mixed))
        there = min(here + chance.randint(1, 4), len(mixed) - 1)
        mixed[here], mixed[there] = mixed[there], mixed[here]
    return mixed


def set_back(frames: Frames, chance: random.Random) -> Frames:
    """The clock of the recorder is set back at some moment."""
    when, by = chance.randrange(len(frames)), chance.randint(1, 100) * S
    return [(t - by if number > when else t, key, data) for number, (t, key, data) in enumerate(frames)]


def in_bursts(frames: Frames, chance: random.Random) -> Frames:
    """The adapter hands frames over every 0.3 s, with the time of the handing over."""
    return [(t // (300 * S // 1000) * (300 * S // 1000), key, data) for t, key, data in frames]


def shortened(frames: Frames, chance: random.Random) -> Frames:
    """One payload in two hundred is cut (not those of trouble codes)."""
    return [(t, key, data[:chance.randrange(len(data) + 1)]) if chance.random() < 0.005 and not is_from((t, key, data), 65226)
            else (t, key, data) for t, key, data in frames]


MISHAPS = (half_lost, begun_late, ended_early, with_a_gap, paused, with_wild_samples)
RARE_MISHAPS = (doubled, reordered, set_back, in_bursts, shortened)
"""Each over every third recording."""
HEALTHY = [name for name in LOGS if name not in FAULTS]


@pytest.mark.parametrize(("name", "mishap"), [
    *((name, mishap) for mishap in MISHAPS for name in HEALTHY),
    *((name, mishap) for number, mishap in enumerate(RARE_MISHAPS) for name in HEALTHY[number % 3::3])])
def test_a_mishap_of_the_recording_raises_nothing(
        catalog: Catalog, name: str, mishap: Callable[[Frames, random.Random], Frames]) -> None:
    frames = mishap(frames_of(name), random.Random(f"{name} {mishap.__name__}"))
    assert not frames or raised(replay(catalog, frames)) == set()


def test_one_recording_after_the_other_raises_only_what_each_does(catalog: Catalog) -> None:
    healthy = [name for name in LOGS if name not in FAULTS]
    frames: list[tuple[int, int, bytes]] = []
    for name in healthy:
        new = frames_of(name)
        shift = frames[-1][0] + 5 * S - new[0].t_ns if frames else 0
        frames.extend((t + shift, key, data) for t, key, data in new)
    assert raised(replay(catalog, frames)) == set()


# -- other machines ------------------------------------------------------------------------------------------------------------

OTHERS = sorted(str(path.relative_to(DATA)) for folder in ("canboat-nmea2000", "kona-ev-battery", "python-can-formats")
                for path in (DATA / folder).glob("*") if path.suffix in {".asc", ".blf", ".csv", ".gz", ".trc", ".txt"})


@pytest.mark.parametrize("name", OTHERS)
def test_recordings_of_other_machines_raise_nothing_and_break_nothing(catalog: Catalog, name: str) -> None:
    try:
        frames = list(Log(DATA / name).frames())
    except LogError as refused:
        assert str(DATA / name) in str(refused)
        return
    assert raised(replay(catalog, frames)) == set()
