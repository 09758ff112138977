"""A GNSS receiver on the tractor's bus speaks by PGN 65267 and 65256: `isobus_tractor.dbc` reads it like everything else, and as
the receiver of the unit it has the alarms of one on a serial line."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.event import Event, Monitor
from level1.frame import Frame, frame_key
from level1.io.definitions import load
from level1.supervisor import Supervisor

S = 1_000_000_000
POSITION, MOTION = 0x18FEF31C, 0x18FEE81C
WHERE, HOW = bytes.fromhex("00F90295001BC97A"), bytes.fromhex("002D00060065A050")
CATALOG = load(["isobus_tractor.dbc"])


def monitored(frames: Sequence[tuple[int, bytes]]) -> tuple[dict[str, Any], dict[str, str]]:
    """Values and qualities of the monitoring message `motion` after these."""
    supervisor = Supervisor(CATALOG, unit="a", start_ns=0, monitor_ns=S)
    outputs = supervisor.receive_many([Frame(S // 2, frame_key(can_id, True), data) for can_id, data in frames])
    values: dict[str, Any] = {}
    quality: dict[str, str] = {}
    for output in [*outputs, *supervisor.tick(S)]:
        if isinstance(output, Monitor) and output.message == "motion":
            values, quality = values | output.values, quality | output.quality
    return values, quality


def test_position_and_motion_are_monitored() -> None:
    values, _ = monitored([(POSITION, WHERE), (MOTION, HOW)])
    assert (values["Latitude"], values["Longitude"]) == (40.0, -4.0)
    assert (values["Heading"], values["NavigationSpeed"], values["Altitude"]) == (90.0, 6.0, 80.0)


def test_a_receiver_without_a_fix_has_no_position() -> None:
    values, quality = monitored([(POSITION, bytes.fromhex("FF" * 8)), (MOTION, HOW)])
    assert (values["Latitude"], quality["Latitude"]) == (None, "unavailable")
    assert values["NavigationSpeed"] == 6.0


# --- as the receiver of the unit ----------------------------------------------------------------------------------------------

GNSS = load(["ucs.dbc", "isobus_tractor.dbc"])
RAPID_POSITION, RAPID_MOTION, TIME = 0x09F8011C, 0x09F8021C, 0x18FEE61C
NOON_NS = 1_764_417_600 * S
"""29 November 2025, 12:00 UTC."""
MUNICH = (48.1173, 11.5167)
METRE = 1 / 111_195
"""Degrees of latitude."""


def unit(**more: Any) -> Supervisor:
    return Supervisor(GNSS, unit="a", start_ns=0, gnss_bus=0, broadcast=False, utc_offset_ns=NOON_NS, **more)


def frame(t_s: float, can_id: int, data: bytes, bus: int = 0) -> Frame:
    return Frame(round(t_s * S), frame_key(can_id, True, bus), data)


def vehicle_position(t_s: float, latitude: float, longitude: float = MUNICH[1], source: int = 0x1C) -> Frame:
    raws = (round((degrees + 210) * 1e7).to_bytes(4, "little") for degrees in (latitude, longitude))
    return frame(t_s, POSITION & ~0xFF | source, b"".join(raws))


def rapid_position(t_s: float, latitude: float, longitude: float = MUNICH[1]) -> Frame:
    return frame(t_s, RAPID_POSITION, b"".join(round(degrees * 1e7).to_bytes(4, "little", signed=True)
                                               for degrees in (latitude, longitude)))


def motion(t_s: float, km_h: float) -> Frame:
    return frame(t_s, MOTION, bytes(2) + round(km_h * 256).to_bytes(2, "little") + b"\xff" * 4)


def time_and_date(t_s: float, late_s: float = 0.0) -> Frame:
    """12:00 of that day at 0 s, or later."""
    seconds = t_s + late_s
    return frame(t_s, TIME, bytes([round(seconds % 60 * 4), int(seconds // 60), 12, 11, 29 * 4, 40, 125, 125]))


def told(outputs: Sequence[Any]) -> list[tuple[float, str, str]]:
    return [(float(output.t), output.alarm, output.event) for output in outputs if isinstance(output, Event)]


@pytest.mark.parametrize("position", [vehicle_position, rapid_position])
def test_a_receiver_that_drives_along_raises_nothing(position: Callable[..., Frame]) -> None:
    target = unit()
    metres = 0.0
    outputs = []
    for n in range(200):
        metres += 6 / 3.6 * 0.2
        outputs += target.receive_many([motion(n / 5, 6.0), position(n / 5 + 0.01, MUNICH[0] + metres * METRE)])
    assert told(outputs) == []
    values = target.board.cells
    assert "UCS_GNSS_STATUS.GnssFix" in values and target.counters["short frames"] == 0


def test_a_jump_is_told_wherever_it_comes_from() -> None:
    for position in (vehicle_position, rapid_position):
        target = unit()
        frames = [position(n, MUNICH[0] + (40 * METRE if n >= 20 else 0)) for n in range(40)]
        assert told(target.receive_many(frames)) == [(20, "GnssJump", "raised"), (31, "GnssJump", "cleared")]


def test_two_positions_that_an_adapter_hands_over_at_once_are_no_jump() -> None:
    target = unit()
    drive = [vehicle_position(n * 0.2, MUNICH[0] + n * 4 * 0.2 * METRE) for n in range(100)]
    bursts = [one._replace(t_ns=one.t_ns // S * S) for one in drive]
    assert told(target.receive_many(bursts)) == []


def test_five_seconds_between_two_positions_are_as_good_and_a_jump_is_told_there_too() -> None:
    target = unit()
    frames = [vehicle_position(n * 5, MUNICH[0] + n * 40 * METRE + (60 * METRE if n >= 8 else 0)) for n in range(12)]
    assert told(target.receive_many(frames))[0] == (40, "GnssJump", "raised")


def test_a_receiver_that_falls_silent_is_told_and_over_when_it_speaks_again() -> None:
    target = unit()
    target.receive_many([vehicle_position(n, MUNICH[0]) for n in range(11)])
    outputs = told(target.tick(60 * S))
    assert [one[1:] for one in outputs] == [("GnssNoData", "raised")] and 26.5 <= outputs[0][0] <= 27.5
    assert [one[1:] for one in told(target.receive_many([vehicle_position(60 + n, MUNICH[0]) for n in range(11)]))] == [
        ("GnssNoData", "cleared")]


def test_one_that_never_speaks_is_told() -> None:
    outputs = told(unit().tick(60 * S))
    assert [one[1:] for one in outputs] == [("GnssNoData", "raised")] and outputs[0][0] < 18


@pytest.mark.parametrize("data", [b"\xff" * 8, b"\xfe" * 8, (0xFFFF_FFFF).to_bytes(4, "little") + bytes(4)])
def test_one_without_a_position_has_no_fix(data: bytes) -> None:
    target = unit()
    assert told(target.receive_many([frame(n, POSITION, data) for n in range(20)])) == [(10, "GnssNoFix", "raised")]


def test_another_source_is_not_believed_while_the_first_speaks() -> None:
    target = unit()
    frames = [one for n in range(30) for one in (vehicle_position(n, MUNICH[0]), vehicle_position(n + 0.1, 40.0, source=0x22),
                                                 frame(n + 0.2, POSITION, b"\xff" * 8, bus=1))]
    assert told(target.receive_many(frames)) == []


def test_a_wall_clock_that_disagrees_with_its_time_is_told_and_one_without_a_position_does_not_count() -> None:
    for late_s, has_place, expected in ((0.5, True, []), (5.0, True, [(60, "GnssClockWrong", "raised")]), (5.0, False, [])):
        target = unit()
        frames = [one for n in range(80) for one in (vehicle_position(n, MUNICH[0]), time_and_date(n, late_s))[not has_place:]]
        outputs = [one for one in told(target.receive_many(frames)) if one[1] == "GnssClockWrong"]
        assert [(round(t_s), *rest) for t_s, *rest in outputs] == expected


@settings(deadline=None, max_examples=30)
@given(st.lists(st.tuples(st.sampled_from([POSITION, MOTION, TIME, RAPID_POSITION, RAPID_MOTION]), st.binary(max_size=9)),
                max_size=30))
def test_whatever_it_says_nothing_breaks(said: list[tuple[int, bytes]]) -> None:
    target = unit()
    target.receive_many([frame(n / 10, can_id, data) for n, (can_id, data) in enumerate(said)])
    target.tick(60 * S)
