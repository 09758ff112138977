"""The UCS as a node: address claim, own trouble codes, messages addressed to it."""
from __future__ import annotations

from collections.abc import Iterable

import pytest
from msgspec import structs

from level1.catalog import Alarm
from level1.command import Order
from level1.event import Event, Monitor, Output, Result, Send
from level1.expression import Boolean
from level1.frame import BUS_SHIFT, EXTENDED, Frame
from level1.gate import BURST, Refused
from level1.j1939 import parse_dm1
from level1.j1939_node import name_of
from level1.memory import State
from level1.subsystems import QUIET_NS
from level1.supervisor import Supervisor
from level1.tests.build import MS, SECOND, alarm, catalog, compare, message, signal
from level1.tests.test_j1939 import broadcast, dtc

TANK = message("TANK", 0x100, [signal("Level", 0, 8)])
CONFLICT = [alarm("AddressConflict", Boolean(False), 90), alarm("SecondTalker", Boolean(False), 91)]
LOW, LOWER = (alarm(name, compare("TANK.Level", "<", limit), code, spn=spn, fmi=fmi, priority=priority)
              for name, limit, code, spn, fmi, priority in
              (("Low", 20, 1, 96, 18, "Low"), ("Lower", 10, 2, 0x7A001, 1, "Critical")))


def supervisor(*alarms: Alarm, address: int = 0x80, restored: State | None = None) -> Supervisor:
    return Supervisor(catalog([TANK], [*alarms, *CONFLICT]), unit="tractor-7", start_ns=0, j1939={0: address}, restored=restored)


def sent(outputs: list[Output], pgn: int) -> list[Send]:
    return [out for out in outputs if isinstance(out, Send) and out.reason == "J1939" and _pgn(out.key) == pgn]


def _pgn(key: int) -> int:
    group = key >> 8 & 0x3FFFF
    return group if (group >> 8 & 0xFF) >= 240 else group & 0x3FF00


def claim(t_ns: int, address: int, name: bytes) -> Frame:
    return Frame(t_ns, 0x18EEFF00 | address | EXTENDED, name)


def test_it_claims_its_address_and_answers_who_asks() -> None:
    target = supervisor()
    first = sent(list(target.tick(0)), 0xEE00)
    assert [(send.key & 0x1FFFFFFF, len(send.data)) for send in first] == [(0x18EEFF80, 8)]
    target.tick(SECOND)
    asked = target.receive(Frame(SECOND, 0x18EAFF22 | EXTENDED, bytes([0x00, 0xEE, 0x00])))
    assert [send.data for send in sent(list(asked), 0xEE00)] == [first[0].data]


def test_a_stronger_name_takes_the_address_and_the_conflict_is_told() -> None:
    target = supervisor()
    target.tick(0)
    outputs = list(target.receive(claim(100 * MS, 0x80, bytes(8))))
    assert [send.key & 0xFF for send in sent(outputs, 0xEE00)] == [0x81]
    assert [out.alarm for out in outputs if isinstance(out, Event)] == ["AddressConflict"]
    assert target.subsystems._nodes[0].address is None
    cleared = target.tick(SECOND)
    assert [out.event for out in cleared if isinstance(out, Event)] == ["cleared"] and target.subsystems._nodes[0].address == 0x81


def test_a_weaker_name_is_sent_away() -> None:
    target = supervisor()
    target.tick(SECOND)
    outputs = list(target.receive(claim(SECOND, 0x80, b"\xff" * 8)))
    assert [send.key & 0xFF for send in sent(outputs, 0xEE00)] == [0x80] and target.subsystems._nodes[0].address == 0x80


def test_without_a_free_address_it_says_so_and_stays_silent() -> None:
    target = supervisor(LOW)
    target.tick(0)
    for address in range(128, 248):
        target.receive(claim(1 + address, address, bytes(8)))
    outputs = list(target.tick(SECOND)) + list(target.receive(Frame(SECOND, 0x100, bytes(8))))
    assert [send.key & 0xFF for send in sent(outputs, 0xEE00)] == [0xFE] and sent(outputs, 65226) == []


def test_its_alarms_go_out_as_trouble_codes() -> None:
    target = supervisor(LOW)
    outputs = list(target.receive_many([Frame(0, 0x100, bytes([50] + [0] * 7)), Frame(SECOND, 0x100, bytes([15] + [0] * 7))]))
    dm1 = sent(outputs, 65226)
    diagnosis = parse_dm1(dm1[0].data)
    assert diagnosis is not None and [(code.spn, code.fmi) for code in diagnosis.codes] == [(96, 18)]
    assert diagnosis.lamps == ("amber",) and dm1[0].t_ns == SECOND
    outputs = list(target.tick(4 * SECOND + 500 * MS))
    assert [send.t_ns // MS for send in sent(outputs, 65226)] == [2000, 3000, 4000]
    outputs = list(target.receive(Frame(4 * SECOND + 600 * MS, 0x100, bytes([50] + [0] * 7)))) + list(target.tick(9 * SECOND))
    assert [(send.t_ns // MS, send.data[2:6]) for send in sent(outputs, 65226)] == [(5000, bytes(4))]


def test_several_codes_go_out_in_packets_that_others_can_read() -> None:
    target = supervisor(LOW, LOWER)
    target.tick(SECOND)
    outputs = list(target.receive(Frame(SECOND, 0x100, bytes(8)))) + list(target.tick(3 * SECOND))
    listener = Supervisor(catalog([], [alarm("TroubleCode", Boolean(False), 5)]), unit="other", broadcast=False)
    heard: list[Output] = []
    for send in outputs:
        if isinstance(send, Send) and send.reason == "J1939":
            heard += listener.receive(Frame(send.t_ns, send.key, send.data))
    assert {(out.values["SPN"], out.values["FMI"]) for out in heard if isinstance(out, Event)} == {(96, 18), (0x7A001, 1)}
    packets = sent(outputs, 0xEB00)
    assert {later.t_ns - early.t_ns for early, later in zip(packets[:2], packets[1:2], strict=False)} == {50 * MS}


def test_a_message_sent_to_it_is_granted_window_by_window_and_acknowledged() -> None:
    target = supervisor(alarm("TroubleCode", Boolean(False), 5))
    target.tick(SECOND)
    body = b"\x04\xff" + b"".join(dtc(100 + n, 4) for n in range(40))
    frames = [Frame(frame.t_ns, frame.key & ~0xFF00 | 0x8000, frame.data) for frame in broadcast(SECOND, 0, 65226, body, MS)]
    request = Frame(frames[0].t_ns, frames[0].key, bytes([16]) + frames[0].data[1:4] + b"\xff" + frames[0].data[5:])
    said = [send.data for frame in [request, *frames[1:]] for send in sent(list(target.receive(frame)), 0xEC00)]
    assert [data[0] for data in said] == [17, 17, 19]
    assert len(target._reported["TroubleCode"]) == 40


def told(outputs: Iterable[Output]) -> list[tuple[float, str, str]]:
    return [(float(out.t), out.alarm, out.event) for out in outputs if isinstance(out, Event)]


def test_someone_elses_frame_under_an_own_identifier_is_told() -> None:
    target = supervisor(LOW)
    target.tick(SECOND)
    outputs = target.receive_many([Frame(SECOND, 0x650, bytes(8)), Frame(SECOND, 0x18FF0080 | EXTENDED, bytes(8))])
    assert [out.alarm for out in outputs if isinstance(out, Event)] == ["SecondTalker", "AddressConflict"]


STRANGE = {"SecondTalker": 0x650, "AddressConflict": 0x18FF0080 | EXTENDED}


@pytest.mark.parametrize("alarm", STRANGE)
def test_a_stranger_is_told_once_and_is_over_when_it_has_been_quiet(alarm: str) -> None:
    target = supervisor(LOW)
    target.tick(SECOND)
    talk = [Frame(t * SECOND, STRANGE[alarm], bytes([t])) for t in range(1, 20)]
    assert told(target.receive_many(talk)) == [(1, alarm, "raised")]
    assert told(target.tick(60 * SECOND)) == [(19 + QUIET_NS / SECOND, alarm, "cleared")]
    assert told(target.receive(Frame(61 * SECOND, STRANGE[alarm], b"")))[0] == (61, alarm, "raised"), "the same again"


@pytest.mark.parametrize("alarm", STRANGE)
def test_a_stranger_of_an_earlier_boot_is_over_unless_it_still_talks(alarm: str) -> None:
    before = supervisor(LOW)
    before.tick(SECOND)
    before.receive(Frame(SECOND, STRANGE[alarm], b""))
    quiet, talking = (supervisor(LOW, restored=before.state()) for _ in range(2))
    assert told(quiet.tick(20 * SECOND)) == [(QUIET_NS / SECOND, alarm, "cleared")]
    talking.tick(0)
    assert told(talking.receive_many(Frame(t * SECOND, STRANGE[alarm], b"") for t in range(1, 20))) == []
    assert told(talking.tick(60 * SECOND)) == [(19 + QUIET_NS / SECOND, alarm, "cleared")]


def test_a_node_that_was_there_before_the_address_was_claimed_is_noticed_as_well() -> None:
    target = supervisor(LOW)
    target.tick(0)
    early = [Frame(t, 0x18FF0081 | EXTENDED, b"") for t in range(10)]
    assert told(target.receive_many(early)) == []
    target.receive(claim(100 * MS, 0x80, bytes(8)))
    target.tick(SECOND)
    outputs = target.receive(Frame(SECOND, 0x18FF0081 | EXTENDED, b""))
    assert told(outputs) == [(1, "AddressConflict", "raised")]
    assert [send.key & 0xFF for send in sent(list(outputs), 0xEE00)] == [0x81], "it is told whose the address is"


def test_a_node_sends_no_group_but_those_of_its_protocols() -> None:
    gate = supervisor(LOW).gate
    for key, allowed in ((0x18FECA80, True), (0x18EAFF80, True), (0x18FEF180, False), (0x0CFE6E80, False), (0x1CEBFF80, True)):
        send = Send(0, key | EXTENDED, bytes(8), "a frame", "J1939", SECOND)
        for where in (send, structs.replace(send, key=send.key | 1 << BUS_SHIFT)):
            try:
                gate.check_protocol(where)
            except Refused as refusal:
                assert "is not on the list" in str(refusal) and not (allowed and where is send)
            else:
                assert allowed and where is send, "the UCS has an address on that bus only"


def test_frames_of_a_protocol_have_a_limit_too() -> None:
    target = supervisor(LOW)
    target.tick(SECOND)
    request = Frame(SECOND, 0x18EAFF22 | EXTENDED, bytes([0x00, 0xEE, 0x00]))
    assert len(sent(target.receive_many([request] * 1000), 0xEE00)) == BURST
    assert target.counters["frames refused by the gate"] == 1000 - BURST


def test_stored_codes_are_asked_for_and_told() -> None:
    target = supervisor(LOW)
    target.tick(SECOND)
    outputs = list(target.command(Order("1", "request_dm2", "0"), SECOND))
    assert [(send.key & 0x1FFFFFFF, send.data) for send in sent(outputs, 0xEA00)] == [(0x18EA0080, bytes([0xCB, 0xFE, 0]))]
    answer = target.receive(Frame(SECOND, 0x18FECB00 | EXTENDED, b"\x04\xff" + dtc(100, 4, 3) + b"\xff\xff"))
    assert [(out.message, out.values["Codes"]) for out in answer if isinstance(out, Monitor)] == [("dm2", "SPN 100 FMI 4 × 3")]
    assert [out.outcome for out in target.command(Order("2", "request_dm2", "x"), SECOND) if isinstance(out, Result)] == ["refused"]


def test_names_order_by_their_fields() -> None:
    low, high = name_of(1), name_of(2)
    assert len(low) == 8 and int.from_bytes(low, "little") < int.from_bytes(high, "little") and high[7] >> 7 == 1
