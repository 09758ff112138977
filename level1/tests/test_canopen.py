"""CANopen devices: heartbeats that fail, emergencies that come and go, whatever else is on the bus."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.canopen import BOOT_NS, ERRORS, MARGIN, MAX_ERRORS, SDO, Device, describe, outlives, parse_emergency
from level1.catalog import Message, Repair
from level1.command import Order
from level1.event import Event, Output, Result, Send
from level1.expression import Boolean, SendStep
from level1.frame import BUS_SHIFT, EXTENDED, REMOTE, Frame, frame_key
from level1.gate import BURST
from level1.supervisor import Supervisor
from level1.tests.build import MS, SECOND, alarm, compare, message, signal, supervisor

EMERGENCY = alarm("DeviceEmergency", Boolean(False), 1021)
SILENT = alarm("DeviceSilent", Boolean(False), 1022)
SPRAYER = Device(0, 42, "Air-blast sprayer", 500 * MS, errors={0xFF01: "the first sensor gives no echo"})
SILENT_SPRAYER = Device(0, 42, "Air-blast sprayer", 0, errors=SPRAYER.errors)
"""The same, configured to send no heartbeat."""
OPERATIONAL, STOPPED, BOOT_UP = 5, 4, 0
VOLTAGE, SENSOR = 0x3120, 0xFF01


def unit(*devices: Device, messages: Sequence[Message] = (), **more: Any) -> Supervisor:
    return supervisor(messages, [EMERGENCY, SILENT], devices=devices, **more)


def heartbeat(t_ns: int, state: int = OPERATIONAL, node: int = 42, bus: int = 0) -> Frame:
    return Frame(t_ns, frame_key(0x700 + node, False, bus), bytes([state]))


def emcy(t_ns: int, code: int, register: int = 1, maker: bytes = bytes(5), node: int = 42, bus: int = 0) -> Frame:
    return Frame(t_ns, frame_key(0x080 + node, False, bus), code.to_bytes(2, "little") + bytes([register]) + maker)


def nmt(t_ns: int, command: int, node: int = 42) -> Frame:
    return Frame(t_ns, frame_key(0, False), bytes([command, node]))


def beats(first_ns: int, last_ns: int, period_ns: int = 500 * MS, node: int = 42) -> list[Frame]:
    return [heartbeat(t_ns, node=node) for t_ns in range(first_ns, last_ns + 1, period_ns)]


def told(outputs: Iterable[Output]) -> list[tuple[float, str, str]]:
    return [(float(output.t), output.alarm, output.event) for output in outputs if isinstance(output, Event)]


def raised(outputs: Iterable[Output]) -> list[Event]:
    return [output for output in outputs if isinstance(output, Event) and output.event == "raised"]


# --- heartbeat --------------------------------------------------------------------------------------------------------------


def test_a_lost_heartbeat_is_told_exactly_after_three_and_a_half_of_them() -> None:
    target = unit(SPRAYER)
    assert told(target.receive_many(beats(0, 10 * SECOND))) == []
    outputs = target.tick(20 * SECOND)
    assert told(outputs) == [(11.75, "DeviceSilent", "raised")]
    event = raised(outputs)[0]
    assert event.text == "Air-blast sprayer (node 42): no heartbeat for 1.75 s"
    assert event.values == {"Bus": 0, "Node": 42, "Device": "Air-blast sprayer", "LastState": "operational", "Silent": "1.750 s"}
    assert told(target.receive_many(beats(25 * SECOND, 30 * SECOND))) == [(25, "DeviceSilent", "cleared")]
    assert told(target.tick(40 * SECOND)) == [(31.75, "DeviceSilent", "raised")]


def test_two_lost_heartbeats_and_a_late_one_are_no_silence() -> None:
    target = unit(SPRAYER)
    frames = beats(0, 2 * SECOND) + beats(3600 * MS, 5 * SECOND)
    assert told(target.receive_many(frames)) == []


def test_a_device_that_was_never_heard_is_not_missed_unless_it_is_required() -> None:
    assert told(unit(SPRAYER, start_ns=0).tick(100 * SECOND)) == []
    required = unit(Device(0, 42, "Air-blast sprayer", 500 * MS, required=True), start_ns=0)
    outputs = required.tick(100 * SECOND)
    assert told(outputs) == [(BOOT_NS / SECOND, "DeviceSilent", "raised")]
    assert raised(outputs)[0].values["LastState"] == "never heard"
    assert told(required.receive(heartbeat(101 * SECOND, BOOT_UP))) == [(101, "DeviceSilent", "cleared")]


def test_without_a_configuration_the_heartbeat_time_is_learned_when_the_device_is_heard() -> None:
    target = unit()
    frames = [heartbeat(0, BOOT_UP), heartbeat(10 * MS), heartbeat(1010 * MS), heartbeat(1960 * MS), heartbeat(2990 * MS)]
    assert told(target.receive_many(frames)) == []
    assert told(target.tick(20 * SECOND)) == [(2.990 + float(MARGIN), "DeviceSilent", "raised")]


def test_one_or_two_heartbeats_teach_nothing() -> None:
    target = unit()
    assert told(target.receive_many([heartbeat(0), heartbeat(SECOND)])) == []
    assert told(target.tick(100 * SECOND)) == []


def test_a_gap_that_was_told_as_silence_does_not_stretch_the_learned_time() -> None:
    target = unit()
    target.receive_many(beats(0, 5 * SECOND, SECOND))
    assert len(told(target.tick(60 * SECOND))) == 1
    target.receive_many(beats(60 * SECOND, 65 * SECOND, SECOND))
    assert told(target.tick(90 * SECOND)) == [(68.5, "DeviceSilent", "raised")]


def test_heartbeats_of_a_few_milliseconds_are_given_some_time() -> None:
    target = unit()
    target.receive_many(beats(0, SECOND, 10 * MS))
    assert told(target.tick(2 * SECOND)) == [(1.3, "DeviceSilent", "raised")]


def test_a_device_without_heartbeat_is_not_missed() -> None:
    target = unit(Device(0, 42, heartbeat_ns=0))
    target.receive_many(beats(0, 5 * SECOND))
    assert told(target.tick(100 * SECOND)) == []


def test_a_device_that_is_reset_has_time_to_come_back() -> None:
    for command, node in ((129, 42), (129, 0), (130, 42)):
        target = unit(SPRAYER)
        target.receive_many([*beats(0, 2 * SECOND), nmt(2100 * MS, command, node)])
        assert told(target.tick(6 * SECOND)) == []
        assert told(target.receive(heartbeat(6100 * MS, BOOT_UP))) == []
        assert told(target.tick(60 * SECOND)) == [(7.85, "DeviceSilent", "raised")]
        assert target.counters["CANopen: devices that booted by themselves"] == 0


def test_one_that_dies_right_after_it_has_come_back_is_told_as_soon_as_any_other() -> None:
    target = unit(SPRAYER)
    target.receive_many([*beats(0, 2 * SECOND), nmt(2 * SECOND, 129)])
    target.tick(4 * SECOND)
    target.receive_many([heartbeat(4 * SECOND, BOOT_UP)])
    assert told(target.tick(60 * SECOND)) == [(5.75, "DeviceSilent", "raised")]


def test_a_device_that_does_not_come_back_from_a_reset_is_silent() -> None:
    target = unit(SPRAYER)
    target.receive_many([*beats(0, 2 * SECOND), nmt(2100 * MS, 129)])
    outputs = target.tick(60 * SECOND)
    assert told(outputs) == [(7.1, "DeviceSilent", "raised")]
    assert raised(outputs)[0].text == "Air-blast sprayer (node 42): has not come back 5.1 s after it was reset"


def test_a_reset_of_another_device_gives_no_time() -> None:
    target = unit(SPRAYER)
    target.receive_many([*beats(0, 2 * SECOND), nmt(2100 * MS, 129, 43)])
    assert told(target.tick(60 * SECOND)) == [(3.75, "DeviceSilent", "raised")]


def test_a_reset_that_level_1_itself_orders_gives_time_as_well() -> None:
    command = message("NMT", 0, [signal("Command", 0, 8), signal("Node", 8, 8)], length=2, cycle_ns=None, senders=("UCS",))
    status = message("STATUS", 0x1AA, [signal("Sensor", 0, 2)])
    reset = Repair((SendStep("NMT", {"Command": 129, "Node": 42}),), attempts=1)
    target = supervisor([command, status], [alarm("SensorFailed", compare("STATUS.Sensor", "==", 2), repair=reset),
                                            SILENT, EMERGENCY], devices=[SPRAYER])
    target.receive_many(beats(0, 2 * SECOND))
    events = told(target.receive(Frame(2100 * MS, 0x1AA, bytes([2, *bytes(7)]))))
    assert (2.1, "SensorFailed", "repair_started") in events
    assert not [event for event in told(target.tick(7 * SECOND)) if event[1] == "DeviceSilent"]
    assert told(target.tick(8 * SECOND)) == [(7.1, "DeviceSilent", "raised")]


def test_a_boot_that_nobody_ordered_is_counted() -> None:
    target = unit(SPRAYER)
    target.receive_many([*beats(0, 2 * SECOND), heartbeat(3 * SECOND, BOOT_UP)])
    assert target.counters["CANopen: devices that booted by themselves"] == 1


def test_a_stopped_device_is_alive() -> None:
    target = unit(SPRAYER)
    target.receive_many([heartbeat(t * SECOND, STOPPED) for t in range(10)])
    assert raised(target.tick(20 * SECOND))[0].values["LastState"] == "stopped"


def test_the_answers_of_a_guarded_node_are_signs_of_life() -> None:
    target = unit(SPRAYER)
    frames = [heartbeat(t * SECOND, OPERATIONAL | t % 2 << 7) for t in range(10)]
    assert told(target.receive_many(frames)) == []
    assert told(target.tick(20 * SECOND)) == [(10.75, "DeviceSilent", "raised")]


def test_devices_are_told_apart_also_on_two_buses() -> None:
    target = unit(SPRAYER, Device(1, 42, "Second sprayer", 500 * MS))
    frames = [heartbeat(t * 500 * MS, bus=bus) for t in range(20) for bus in (0, 1) if bus or t < 10]
    outputs = target.receive_many(frames)
    assert [(event.values["Bus"], event.values["Device"]) for event in raised(outputs)] == [(0, "Air-blast sprayer")]


def test_a_device_taken_off_on_purpose_is_forgotten_when_someone_at_the_machine_says_so() -> None:
    target = unit(SPRAYER, Device(0, 43, "Sensors", 500 * MS, required=True), start_ns=0)
    target.receive_many([*beats(0, 2 * SECOND), heartbeat(2 * SECOND, node=43)])
    target.tick(10 * SECOND)

    def reset(t_ns: int, origin: Literal["local", "above"] = "local") -> tuple[str, list[tuple[float, str, str]]]:
        outputs = target.command(Order("1", "reset", "DeviceSilent", origin=origin), t_ns)
        return next(output.reason for output in outputs if isinstance(output, Result)), told(outputs)
    assert reset(11 * SECOND, "above") == ("DeviceSilent can only be reset at the machine", [])
    assert reset(12 * SECOND) == ("Sensors (node 43) must be there by the configuration", [(12, "DeviceSilent", "cleared")])
    assert told(target.receive(heartbeat(13 * SECOND, node=43))) == [(13, "DeviceSilent", "cleared")]
    assert reset(13 * SECOND) == ("no device is silent", [])
    assert told(target.receive_many([heartbeat(14 * SECOND, BOOT_UP), heartbeat(14 * SECOND, node=43)])) == []
    assert told(target.tick(30 * SECOND)) == [(15.75, "DeviceSilent", "raised")] * 2


# --- node guarding ----------------------------------------------------------------------------------------------------------

GUARDED = Device(0, 42, "Old valve", 0, guard_ns=200 * MS, life_factor=3)


class Valve:
    """A guarded device: answers each remote frame with its state, whose highest bit alternates (CiA 301 §7.2.8.3.2.2.1)."""

    def __init__(self, target: Supervisor):
        self.target = target
        self.there = self.alternates = True
        self.loses: set[int] = set()
        self.asked: list[Send] = []
        self.toggle = 0

    def run(self, until_ns: int) -> list[Event]:
        """Time passes; an answer comes 2 ms after its question. Gives the events."""
        events: list[Event] = []
        while (due := self.target.next_deadline()) is not None and due <= until_ns:
            outputs = list(self.target.tick(due))
            while outputs:
                output = outputs.pop(0)
                if isinstance(output, Event):
                    events.append(output)
                elif isinstance(output, Send) and output.key & REMOTE:
                    outputs += self.answer(output)
        return events + [output for output in self.target.tick(until_ns) if isinstance(output, Event)]

    def answer(self, question: Send) -> Sequence[Output]:
        self.asked.append(question)
        if not self.there:
            return ()
        state = OPERATIONAL | self.toggle
        self.toggle ^= 0x80 if self.alternates else 0
        if len(self.asked) in self.loses:
            return ()
        return self.target.receive(heartbeat(question.t_ns + 2 * MS, state))


def test_a_guarded_device_is_asked_every_guard_time_and_silent_after_its_life_time() -> None:
    valve = Valve(unit(GUARDED, start_ns=0, broadcast=True))
    assert valve.run(10 * SECOND) == []
    assert [question.t_ns for question in valve.asked] == [(42 + 200 * n) * MS for n in range(50)]
    assert {(question.key, question.data, question.expires_ns - question.t_ns) for question in valve.asked} == {
        (0x72A | REMOTE, b"\0", SECOND)}
    valve.there = False
    events = valve.run(20 * SECOND)
    assert told(events) == [(10.544, "DeviceSilent", "raised")]
    assert events[0].text == "Old valve (node 42): no answer to guarding for 0.7 s"
    assert events[0].values["LastState"] == "operational"
    valve.there = True
    assert told(valve.run(30 * SECOND)) == [(20.044, "DeviceSilent", "cleared")]
    assert valve.target.counters["CANopen: answers to guarding that do not alternate"] == 0


def test_two_answers_that_are_lost_are_no_silence_whichever_bit_the_next_one_has() -> None:
    valve = Valve(unit(GUARDED, start_ns=0, broadcast=True))
    valve.loses = {10, 20, 30, 31, 40, 41}
    assert valve.run(20 * SECOND) == []
    assert valve.target.counters["CANopen: answers to guarding that do not alternate"] == 0
    valve.loses = {110, 111, 112}
    assert told(valve.run(30 * SECOND)) == [(22.344, "DeviceSilent", "raised"), (22.444, "DeviceSilent", "cleared")]


def test_answers_that_do_not_alternate_are_those_of_a_dead_program() -> None:
    valve = Valve(unit(GUARDED, start_ns=0, broadcast=True))
    valve.run(10 * SECOND)
    valve.alternates = False
    events = valve.run(20 * SECOND)
    assert told(events) == [(10.744, "DeviceSilent", "raised")], "the first that stands still looks right"
    assert events[0].text == "Old valve (node 42): no right answer to guarding (its toggle bit stands still) for 0.7 s"
    valve.alternates = True
    assert [event for _, _, event in told(valve.run(21 * SECOND))] == ["cleared"]


def test_a_guarded_device_that_boots_begins_anew() -> None:
    valve = Valve(unit(GUARDED, start_ns=0, broadcast=True))
    valve.run(10 * SECOND)
    valve.target.receive(heartbeat(10 * SECOND, BOOT_UP))
    valve.toggle = 0x80
    assert valve.run(12 * SECOND) == []
    assert valve.target.counters["CANopen: answers to guarding that do not alternate"] == 0


def test_a_guarded_device_that_was_never_there_is_missed_only_where_it_is_required() -> None:
    absent = Valve(unit(GUARDED, start_ns=0, broadcast=True))
    absent.there = False
    assert absent.run(20 * SECOND) == [] and len(absent.asked) == 100, "it may be coupled at any time"
    required = Valve(unit(msgspec.structs.replace(GUARDED, required=True), start_ns=0, broadcast=True))
    required.there = False
    events = required.run(20 * SECOND)
    assert told(events) == [(BOOT_NS / SECOND, "DeviceSilent", "raised")]


def test_a_program_that_was_held_up_asks_once_and_waits_for_the_answer() -> None:
    valve = Valve(unit(GUARDED, start_ns=0, broadcast=True))
    valve.run(10 * SECOND)
    asked = len(valve.asked)
    outputs = valve.target.tick(15 * SECOND + 50 * MS)
    question, = (output for output in outputs if isinstance(output, Send) and output.key & REMOTE)
    assert told([*outputs, *valve.answer(question)]) == [] and valve.run(20 * SECOND) == []
    assert len(valve.asked) == asked + 1 + 24
    valve.there = False
    valve.target.tick(25 * SECOND)
    assert told(valve.run(30 * SECOND)) == [(25.3, "DeviceSilent", "raised")]


def test_only_configured_devices_are_asked_and_nobody_in_a_replay() -> None:
    assert not unit(SPRAYER, broadcast=True)._devices.questions  # type: ignore[union-attr]
    listener = Valve(unit(GUARDED, start_ns=0, broadcast=False))
    listener.run(10 * SECOND)
    assert listener.asked == []
    frames = [heartbeat(11 * SECOND + n * 200 * MS, OPERATIONAL | (n % 2) << 7) for n in range(10)]
    assert told(listener.target.receive_many(frames)) == []
    assert told(listener.target.tick(60 * SECOND)) == [(13.5, "DeviceSilent", "raised")], "what the traffic says counts"


def test_no_remote_frame_but_that_of_a_guarded_device_passes_the_gate() -> None:
    target = unit(GUARDED, start_ns=0, broadcast=True)
    for key in (0x72B | REMOTE, 0x72A, 0x1AA | REMOTE, 0x72A | REMOTE | 1 << BUS_SHIFT):
        target.hand_out(Send(0, key, b"\0", "node guarding", "CANopen", SECOND))
    assert not [output for output in target.tick(0) if isinstance(output, Send) and output.reason == "CANopen"]
    assert target.counters["frames refused by the gate"] == 4


# --- emergencies ------------------------------------------------------------------------------------------------------------


def test_an_emergency_is_a_cause_until_the_device_says_that_it_is_over() -> None:
    target = unit(SILENT_SPRAYER)
    outputs = target.receive_many([heartbeat(0), emcy(SECOND, VOLTAGE, 0x05, b"\1\2\3\4\5")])
    assert told(outputs) == [(1, "DeviceEmergency", "raised")]
    event = raised(outputs)[0]
    assert event.values == {"Bus": 0, "Node": 42, "Device": "Air-blast sprayer", "ErrorCode": "0x3120", "Error": "supply voltage",
                            "ErrorRegister": "generic, voltage", "MakerBytes": "0102030405"}
    assert event.text == "Air-blast sprayer (node 42): supply voltage (0x3120)"
    assert told(target.receive(emcy(2 * SECOND, VOLTAGE, 0x05, b"\1\2\3\4\5"))) == [], "the same again"
    assert told(target.receive(emcy(3 * SECOND, 0x0000, 0))) == [(3, "DeviceEmergency", "cleared")]
    assert target.alarm_states()["DeviceEmergency"] == 0


def test_the_texts_of_the_data_sheet_come_first() -> None:
    target = unit(SPRAYER)
    assert raised(target.receive(emcy(0, SENSOR)))[0].text == "Air-blast sprayer (node 42): the first sensor gives no echo (0xFF01)"
    assert raised(target.receive(emcy(0, 0xFF77)))[0].values["Error"] == "an error of its own kind"


def test_each_error_is_a_cause_of_its_own_and_a_reset_with_an_error_register_clears_only_what_it_may() -> None:
    target = unit(SILENT_SPRAYER)
    target.receive_many([heartbeat(0), emcy(0, VOLTAGE, 0x05), emcy(0, 0x4210, 0x0D), emcy(0, SENSOR, 0x8D, b"\1\0\0\0\0"),
                         emcy(0, SENSOR, 0x8D, b"\2\0\0\0\0")])
    outputs = target.receive(emcy(SECOND, 0x0000, 0x81))
    assert sorted(event.values["ErrorCode"] for event in outputs if isinstance(event, Event)) == ["0x3120", "0x4210"]
    outputs = target.receive(emcy(2 * SECOND, 0x0000, 0x00))
    assert [event.event for event in outputs if isinstance(event, Event)] == ["cleared", "cleared"]


def test_a_boot_forgets_all_errors() -> None:
    target = unit(SILENT_SPRAYER)
    target.receive_many([heartbeat(0), emcy(0, VOLTAGE), emcy(0, SENSOR)])
    assert [event for _, _, event in told(target.receive(heartbeat(SECOND, BOOT_UP)))] == ["cleared", "cleared"]


def test_emergencies_of_a_device_that_is_only_heard_are_causes_too() -> None:
    target = unit()
    outputs = target.receive_many([heartbeat(0, BOOT_UP, node=7), emcy(SECOND, 0x8130, 0x11, node=7)])
    assert raised(outputs)[0].text == "node 7: a heartbeat or life guard it waits for is missing (0x8130)"


def test_a_babbling_device_can_not_crowd_the_others_out() -> None:
    target = unit(SPRAYER, Device(0, 43, "Sensors", 500 * MS))
    babble = [emcy(n * MS, SENSOR, maker=n.to_bytes(5, "little")) for n in range(1000)]
    assert len(raised(target.receive_many(babble))) == MAX_ERRORS
    assert target.counters["CANopen: emergencies of one device beyond the limit"] == 1000 - MAX_ERRORS
    assert len(raised(target.receive(emcy(2 * SECOND, VOLTAGE, node=43)))) == 1
    assert len(told(target.receive(emcy(3 * SECOND, 0, 0)))) == MAX_ERRORS


def test_an_error_history_that_someone_reads_goes_along() -> None:
    def answer(place: int, value: int, size: int = 4) -> Frame:
        return Frame(2 * SECOND, 0x580 + 42, bytes([0x43 | 4 - size << 2, 0x03, 0x10, place]) + value.to_bytes(4, "little"))

    target = unit(SILENT_SPRAYER)
    target.receive_many([heartbeat(0), emcy(SECOND, VOLTAGE)])
    target.receive_many([answer(0, 2, 1), answer(1, 0x0001_3120), answer(2, 0x8130)])
    cleared = [event for event in target.receive(emcy(3 * SECOND, 0, 0)) if isinstance(event, Event)]
    assert cleared[0].values["ErrorHistory"] == "0x3120 0x8130"
    assert raised(target.receive(emcy(4 * SECOND, SENSOR)))[0].values["ErrorHistory"] == "0x3120 0x8130"
    target.receive_many([emcy(4 * SECOND, 0, 0), answer(0, 0, 1)])
    assert "ErrorHistory" not in raised(target.receive(emcy(5 * SECOND, SENSOR)))[0].values


@pytest.mark.parametrize(("code", "words"), [
    (0x8130, "a heartbeat or life guard it waits for is missing"), (0x2310, "current on the output side"), (0x3456, "voltage"),
    (0x5001, "its hardware"), (0x1234, "an error it does not name"), (0xFF01, "mine"), (0xB000, "an unknown error")])
def test_every_code_has_words(code: int, words: str) -> None:
    assert describe(code, {0xFF01: "mine"}) == words


def test_the_table_has_a_group_for_each_kind_of_the_standard() -> None:
    assert {code >> 12 for code in ERRORS} == {1, 2, 3, 4, 5, 6, 7, 8, 9, 15}
    assert not any(outlives(code, 0) for code in range(0x1_0000))


# --- what is none -----------------------------------------------------------------------------------------------------------


def test_without_a_heartbeat_on_the_bus_its_identifiers_mean_something_else() -> None:
    target = unit()
    assert told(target.receive_many([emcy(0, VOLTAGE), Frame(0, 0x72A, bytes(8)), Frame(0, 0x72A, b"\x63"), nmt(0, 129)])) == []
    assert told(target.tick(100 * SECOND)) == []


def test_an_identifier_that_a_definition_gives_to_another_message_is_no_emergency_and_no_heartbeat() -> None:
    command = message("CART_CMD", 0x0A0, [signal("Go", 0, 8)])
    status = message("CART_STATUS", 0x720, [signal("State", 0, 8)])
    target = unit(SPRAYER, messages=[command, status])
    frames = [heartbeat(0), emcy(0, VOLTAGE, node=0x20), Frame(0, 0x720, b"\5"), Frame(SECOND // 2, 0x720, b"\5")]
    assert told(target.receive_many(frames)) == []


def test_a_heartbeat_that_a_definition_describes_is_one() -> None:
    described = message("SPRAYER_HEARTBEAT", 0x72A, [signal("State", 0, 7)], length=1)
    target = unit(SPRAYER, messages=[described])
    target.receive(heartbeat(0))
    assert told(target.tick(10 * SECOND)) == [(1.75, "DeviceSilent", "raised")]


def test_malformed_and_remote_frames_and_29_bit_ones_are_none() -> None:
    target = unit(SPRAYER)
    target.receive(heartbeat(0))
    frames = [Frame(SECOND, 0x72A, b""), Frame(SECOND, 0x72A, b"\7"), Frame(SECOND, 0x72A | REMOTE, b""),
              Frame(SECOND, 0x72A | EXTENDED, b"\5"), Frame(SECOND, 0x0AA, bytes(7)), Frame(SECOND, 0, b"\x81"),
              Frame(SECOND, 0x5AA, b"\x43"), Frame(SECOND, 0x72A | 1 << BUS_SHIFT, b"\5")]
    assert told(target.receive_many(frames)) == []
    assert told(target.tick(10 * SECOND)) == [(1.75, "DeviceSilent", "raised")]
    assert target.counters["CANopen: malformed heartbeats"] == 2
    assert target.counters["CANopen: malformed emergencies"] == 1


def test_without_these_alarms_nobody_listens() -> None:
    target = supervisor([], [alarm("Other", Boolean(False))], devices=[SPRAYER])
    assert told(target.receive_many([heartbeat(0), emcy(0, VOLTAGE)])) == []
    assert target.counters["ids nobody asks for"] == 2


# --- restart, replay ---------------------------------------------------------------------------------------------------------


def test_what_was_active_before_a_restart_clears_when_it_is_over() -> None:
    before = unit(SPRAYER)
    before.receive_many([heartbeat(0), emcy(SECOND, VOLTAGE)])
    before.tick(10 * SECOND)
    assert before.alarm_states() == {"DeviceEmergency": 1, "DeviceSilent": 1}
    after = unit(SPRAYER, boot=2, restored=before.state())
    assert told(after.tick(0)) == []
    assert after.alarm_states() == {"DeviceEmergency": 1, "DeviceSilent": 1}
    assert told(after.receive(heartbeat(SECOND))) == [(1, "DeviceSilent", "cleared")]
    assert told(after.receive(emcy(1100 * MS, VOLTAGE))) == [], "it was told before the restart"
    assert told(after.receive(emcy(1200 * MS, 0, 0))) == [(1.2, "DeviceEmergency", "cleared")]


FRAMES = st.one_of(
    st.builds(heartbeat, st.just(0), st.sampled_from([0, 4, 5, 127, 133, 99]), st.sampled_from([42, 43, 127])),
    st.builds(emcy, st.just(0), st.sampled_from([0, 0x3120, 0x8130, 0xFF01, 0x00FF]), st.integers(0, 255),
              st.binary(min_size=5, max_size=5), st.sampled_from([42, 43])),
    st.builds(nmt, st.just(0), st.sampled_from([1, 2, 128, 129, 130, 7]), st.sampled_from([0, 42, 43])),
    st.builds(Frame, st.just(0), st.integers(0, 0x7FF), st.binary(max_size=8)))


@settings(deadline=None, max_examples=200)
@given(st.lists(st.tuples(st.integers(0, 3 * SECOND), FRAMES), max_size=60), st.booleans())
def test_one_by_one_and_in_batches_give_the_same_and_what_is_raised_is_cleared_before_it_is_raised_again(
        steps: list[tuple[int, Frame]], configured: bool) -> None:
    t_ns, frames = 0, []
    for gap_ns, frame in steps:
        t_ns += gap_ns
        frames.append(frame._replace(t_ns=t_ns))
    devices = [SPRAYER] if configured else []
    single, batch = unit(*devices, start_ns=0), unit(*devices, start_ns=0)
    one_by_one = [output for frame in frames for output in single.receive(frame)] + list(single.tick(t_ns + 100 * SECOND))
    assert one_by_one == [*batch.receive_many(frames), *batch.tick(t_ns + 100 * SECOND)]
    there: set[int] = set()
    for event in one_by_one:
        assert isinstance(event, Event)
        if event.event == "raised":
            there.add(event.instance)
        else:
            there.remove(event.instance)


@given(st.binary(max_size=10))
def test_any_bytes_are_an_emergency_or_none(data: bytes) -> None:
    parsed = parse_emergency(data)
    assert (parsed is None) == (len(data) != 8)


# --- reading error histories ------------------------------------------------------------------------------------------------


READABLE = msgspec.structs.replace(SPRAYER, history=True)
READ = bytes([0x40, 0x03, 0x10, 1, 0, 0, 0, 0])


def asked(target: Supervisor, data: bytes, node: int = 42, bus: int = 0) -> list[bytes]:
    """What leaves for a request; a moment later, so that the limit on their number is not met."""
    outputs = target.ask(bus, 0x600 + node, data, target.now_ns + SECOND)
    return [output.data for output in outputs if isinstance(output, Send) and output.message == SDO]


def test_of_all_sdo_requests_only_those_that_read_the_error_history_leave() -> None:
    target = unit(READABLE, start_ns=0, broadcast=True)
    passed = {first for first in range(256) if asked(target, bytes([first]) + READ[1:])}
    assert passed == {0x40, 0x60, 0x70, 0x80}, "no download (0x2x, 0x0x, 0x1x), no blocks"
    assert target.counters["frames refused by the gate"] == 252
    for data in (b"", READ[:7], READ + b"\0", b"\x40\x18\x10" + READ[3:], b"\x40\x03\x20" + READ[3:]):
        assert asked(target, data) == [], "of another length, or of another object"


@given(data=st.binary(max_size=9), can_id=st.integers(0, 0x7FF), bus=st.integers(0, 2))
@settings(max_examples=100, deadline=None)
def test_nothing_else_can_be_sent_by_asking(data: bytes, can_id: int, bus: int) -> None:
    target = unit(READABLE, start_ns=0, broadcast=True)
    sent = [output for output in target.ask(bus, can_id, data, SECOND) if isinstance(output, Send) and output.message == SDO]
    assert not sent or (bus, can_id) == (0, 0x62A) and data[0] in (0x40, 0x60, 0x70, 0x80) and len(data) == 8


def test_only_devices_whose_history_is_wanted_are_asked_for_it_and_on_their_bus() -> None:
    target = unit(READABLE, msgspec.structs.replace(SPRAYER, node=43), start_ns=0, broadcast=True)
    assert asked(target, READ) == [READ]
    assert asked(target, READ, node=43) == asked(target, READ, node=44) == asked(target, READ, bus=1) == []
    assert asked(unit(READABLE, start_ns=0, broadcast=False), READ) == [], "nothing is sent in a replay"


def test_requests_have_a_limit_and_are_soon_out_of_date() -> None:
    target = unit(READABLE, start_ns=0, broadcast=True)
    outputs = [output for _ in range(1000) for output in target.ask(0, 0x62A, READ, SECOND) if isinstance(output, Send)]
    requests = [output for output in outputs if output.message == SDO]
    assert len(requests) == BURST and target.counters["frames refused by the gate"] == 1000 - BURST
    assert requests[0].expires_ns == SECOND + 200 * MS
