"""Transport protocol and trouble codes: what subsystems report joins the list of alarms, cause by cause."""
from __future__ import annotations

from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from level1.command import Order
from level1.event import Event
from level1.expression import Boolean, TroubleCode
from level1.frame import EXTENDED, Frame
from level1.j1939 import MAX_SESSIONS, Transport, parse_dm1
from level1.supervisor import Supervisor
from level1.tests.build import MS, SECOND, alarm, catalog, events, supervisor

REPORTED = alarm("TroubleCode", Boolean(False), 1020, off_delay_ns=0)
DTC = alarm("OilSensor", TroubleCode(100, 4), 2)


def dtc(spn: int, fmi: int, count: int = 1) -> bytes:
    return bytes([spn & 0xFF, spn >> 8 & 0xFF, spn >> 16 << 5 | fmi, count])


def dm1(t_ns: int, source: int, *codes: bytes, lamps: int = 0x04) -> Frame:
    return Frame(t_ns, 0x18FECA00 | source | EXTENDED, (bytes([lamps, 0xFF]) + b"".join(codes)).ljust(8, b"\xff"))


def broadcast(t_ns: int, source: int, pgn: int, message: bytes, gap_ns: int = 50 * MS) -> list[Frame]:
    """A message as BAM and packets."""
    count = (len(message) + 6) // 7
    head = bytes([32, len(message) & 0xFF, len(message) >> 8, count, 0xFF, pgn & 0xFF, pgn >> 8 & 0xFF, pgn >> 16])
    frames = [Frame(t_ns, 0x18ECFF00 | source | EXTENDED, head)]
    for number in range(count):
        body = message[7 * number:7 * number + 7].ljust(7, b"\xff")
        frames.append(Frame(t_ns + (number + 1) * gap_ns, 0x18EBFF00 | source | EXTENDED, bytes([number + 1]) + body))
    return frames


def told(target: Supervisor, frames: list[Frame]) -> list[tuple[str, object, object]]:
    outputs = target.receive_many(frames)
    return [(out.event, out.values.get("SPN"), out.values.get("FMI")) for out in outputs if isinstance(out, Event)]


def test_trouble_codes_appear_and_vanish_as_causes_of_one_alarm() -> None:
    target = supervisor([], [REPORTED])
    assert told(target, [dm1(0, 0, dtc(100, 4))]) == [("raised", 100, 4)]
    assert told(target, [dm1(SECOND, 0, dtc(100, 4, 2))]) == []
    assert told(target, [dm1(SECOND, 3, dtc(524020, 31))]) == [("raised", 524020, 31)]
    assert told(target, [dm1(2 * SECOND, 0, bytes(4))]) == [("cleared", 100, 4)]
    assert target.alarm_states() == {"TroubleCode": 1}
    assert told(target, [dm1(3 * SECOND, 3, bytes(4))]) == [("cleared", 524020, 31)]
    assert target.alarm_states() == {"TroubleCode": 0}


def test_many_codes_come_as_a_broadcast_in_packets() -> None:
    target = supervisor([], [REPORTED, DTC])
    codes = [dtc(90 + n, n % 31) for n in range(50)] + [dtc(100, 4)]
    outcome = told(target, broadcast(0, 0, 65226, b"\x04\xff" + b"".join(codes)))
    assert len([one for one in outcome if one[1] is not None]) == 51
    assert target.alarm_states() == {"TroubleCode": 1, "OilSensor": 1}


def test_dtc_is_unknown_until_someone_reports() -> None:
    target = supervisor([], [DTC])
    assert target.receive_many([Frame(0, 0x18FEE000 | EXTENDED, bytes(8))]) == []
    assert target._watches[0].outcome == 2
    outputs = target.receive_many([dm1(1, 0, dtc(100, 4)), dm1(2, 0, dtc(100, 3))])
    assert [what for _, _, what in events(outputs)] == ["raised", "cleared"]


def test_a_lost_packet_or_a_late_one_ends_the_session_and_is_counted() -> None:
    frames = broadcast(0, 0, 65226, b"\x04\xff" + dtc(100, 4) * 5)
    target = supervisor([], [REPORTED])
    assert told(target, frames[:2] + frames[3:]) == [] and target.counters["transport: lost packets"] == 1
    late = [frames[0], frames[1], *(Frame(frame.t_ns + SECOND, frame.key, frame.data) for frame in frames[2:])]
    target = supervisor([], [REPORTED])
    assert told(target, late) == [] and target.counters["transport: time-outs"] == 1


def test_senders_do_not_disturb_each_other() -> None:
    target = supervisor([], [REPORTED])
    one, two = (broadcast(0, source, 65226, b"\x04\xff" + dtc(100 + source, 4) + dtc(200 + source, 4)) for source in (0, 3))
    assert len(told(target, sorted(one + two))) == 4


def test_causes_are_bounded() -> None:
    target = supervisor([], [REPORTED])
    for n in range(40):
        target.receive_many(broadcast(n * 10 * SECOND, n, 65226, b"\x04\xff" + b"".join(dtc(50 * n + k, 1) for k in range(40)), MS))
    assert len(target._reported["TroubleCode"]) == 256 and target.counters["causes of TroubleCode beyond the limit"] > 0


def test_a_reported_cause_survives_a_restart_and_clears_then() -> None:
    target = supervisor([], [REPORTED])
    told(target, [dm1(0, 0, dtc(100, 4))])
    again = supervisor([], [REPORTED], boot=2, restored=target.state())
    assert told(again, [dm1(0, 0, dtc(100, 4))]) == []
    assert told(again, [dm1(1, 0, bytes(4))]) == [("cleared", 100, 4)]


def test_a_cause_that_vanished_while_the_unit_was_off_clears_at_the_first_report() -> None:
    target = supervisor([], [REPORTED])
    told(target, [dm1(0, 0, dtc(100, 4)), dm1(0, 3, dtc(7, 7))])
    again = supervisor([], [REPORTED], boot=2, restored=target.state())
    assert told(again, [dm1(0, 0, bytes(4))]) == [("cleared", 100, 4)]
    assert again.alarm_states() == {"TroubleCode": 1}


def test_causes_are_acknowledged_together() -> None:
    target = supervisor([], [alarm("TroubleCode", Boolean(False), 1020, latch=True)])
    told(target, [dm1(0, 0, dtc(100, 4)), dm1(1, 3, dtc(7, 7)), dm1(2, 0, bytes(4)), dm1(3, 3, bytes(4))])
    assert [what for _, _, what in events(target.command(Order("1", "acknowledge", "TroubleCode"), 4))] == \
        ["acknowledged", "cleared"] * 2


@given(st.lists(st.tuples(st.integers(0, 2 * SECOND), st.sampled_from([0x18ECFF00, 0x18EBFF00, 0x18EC0500, 0x18EB0500, 0x18FECA00]),
                          st.integers(0, 4), st.binary(max_size=10)), max_size=60))
@settings(max_examples=200, deadline=None)
def test_no_traffic_breaks_it(steps: list[tuple[int, int, int, bytes]]) -> None:
    target = Supervisor(catalog([], [REPORTED, DTC]), unit="u", broadcast=False)
    now = 0
    for gap, can_id, source, data in steps:
        now += gap
        target.receive(Frame(now, can_id | source | EXTENDED, data))


def test_sessions_are_bounded() -> None:
    counters: Counter[str] = Counter()
    transport = Transport(lambda t, key, data: None, counters)
    for bus in range(20):
        for source in range(200):
            transport.connection(0, bus << 32 | 0x18ECFF00 | source | EXTENDED, bytes([32, 20, 0, 3, 255, 0xCA, 0xFE, 0]))
    assert len(transport.sessions) <= MAX_SESSIONS and counters["transport: too many sessions"] > 0


def test_lamps_of_iso_11783_senders_are_off() -> None:
    diagnosis = parse_dm1(b"\xff\xff" + dtc(100, 4))
    assert diagnosis is not None and diagnosis.lamps == () and diagnosis.codes[0].spn == 100
    assert parse_dm1(b"\x04") is None
