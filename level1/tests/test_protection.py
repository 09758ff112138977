"""Counters and checksums: corrupt, frozen and lost are told apart, and none of them looks healthy."""
from __future__ import annotations

from level1.expression import Quality
from level1.frame import Frame
from level1.protection import crc8
from level1.supervisor import Supervisor
from level1.tests.build import MS, alarm, compare, events, message, signal, supervisor

SAFE = message("SAFE", 0x300, [signal("Level", 0, 8), signal("Count", 8, 4, role="Counter"), signal("Crc", 56, 8, role="Checksum")])
ALARMS = [alarm("High", compare("SAFE.Level", ">", 100)), alarm("Bad", Quality("corrupt", "SAFE", ""), 2),
          alarm("Stuck", Quality("frozen", "SAFE", ""), 3), alarm("Err", Quality("error", "SAFE", "Level"), 4)]


def safe(t_ms: int, level: int, count: int, spoil: int = 0) -> Frame:
    body = bytes([level, count % 16, 0, 0, 0, 0, 0])
    return Frame(t_ms * MS, 0x300, body + bytes([crc8(body, 0x1D) ^ spoil]))


def told(target: Supervisor, *frames: Frame) -> list[tuple[str, str]]:
    return [(name, what) for _, name, what in events(target.receive_many(frames))]


def test_check_values_of_the_catalogue_of_parametrised_crc_algorithms() -> None:
    assert crc8(b"123456789", 0x1D) == 0x4B
    assert crc8(b"123456789", 0x2F) == 0xDF


def test_a_wrong_checksum_neither_raises_nor_clears_but_is_told() -> None:
    target = supervisor([SAFE], ALARMS)
    assert told(target, safe(0, 50, 0), safe(100, 200, 1, spoil=1)) == [("Bad", "raised"), ("Err", "raised")]
    assert told(target, safe(200, 200, 2)) == [("High", "raised"), ("Bad", "cleared"), ("Err", "cleared")]
    assert told(target, safe(300, 50, 3, spoil=4)) == [("Bad", "raised"), ("Err", "raised")]
    assert target.alarm_states()["High"] == 1


def test_a_counter_that_stands_still_is_frozen() -> None:
    target = supervisor([SAFE], ALARMS)
    assert told(target, *(safe(100 * n, 50, 7) for n in range(3))) == []
    assert told(target, safe(300, 50, 7)) == [("Stuck", "raised"), ("Err", "raised")]
    assert told(target, safe(400, 50, 8)) == [("Stuck", "cleared"), ("Err", "cleared")]


def test_lost_frames_are_not_corrupt_but_a_step_back_is() -> None:
    target = supervisor([SAFE], ALARMS)
    assert told(target, safe(0, 50, 0), safe(100, 50, 5)) == []
    assert told(target, safe(200, 50, 3)) == [("Bad", "raised"), ("Err", "raised")]


def test_after_a_silence_the_counter_may_begin_anywhere() -> None:
    target = supervisor([SAFE], ALARMS)
    assert told(target, safe(0, 50, 9), safe(5000, 50, 3)) == []


def test_a_protected_frame_that_is_cut_short_is_corrupt() -> None:
    target = supervisor([SAFE], ALARMS)
    assert told(target, safe(0, 50, 0), Frame(1, 0x300, b"\x50")) == [("Bad", "raised"), ("Err", "raised")]
