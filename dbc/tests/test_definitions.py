"""The shipped definitions of this folder: they load without a word, and say what the standards and the devices say."""
from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import pytest

import dbc
from level1 import definitions
from level1.catalog import Alarm, Catalog, Message
from level1.condition import walk
from level1.decode import raw_of
from level1.event import Event
from level1.expression import Elapsed, Quality, Rate, SignalValue, Silent
from level1.frame import EXTENDED, Frame, frame_key
from level1.supervisor import Supervisor

MS, S = 1_000_000, 1_000_000_000
GLOBAL_CODES = {"ucs.dbc": range(1001, 2000), "isobus_tractor.dbc": range(2001, 2100)}
"""Codes of a file by the numbering plan in README.md."""
ALARMS_SENT_AT_NS = S
DM1_PGN = 65226


def load(*names: str) -> Catalog:
    """Some shipped files together, without any problem."""
    catalog, problems = definitions.build([definitions.Source(name, dbc.path(name).read_text()) for name in names])
    assert catalog is not None and not problems, "\n".join(map(str, problems))
    return catalog


CATALOG = load("ucs.dbc", "isobus_tractor.dbc")
ALARMS = sorted(CATALOG.alarms.values(), key=lambda alarm: alarm.code)


def physical(message: Message, payload: str) -> Mapping[str, float]:
    """Every value of a payload, reserved raw values left out."""
    data = bytes.fromhex(payload)
    values = {}
    for signal in message.signals:
        raw = raw_of(signal, data)
        assert isinstance(raw, int)
        value = Fraction(raw) * Fraction(signal.factor) + Fraction(signal.offset)
        if signal.maximum is None or value <= Fraction(signal.maximum):
            values[signal.name] = float(value)
    return values


@pytest.mark.parametrize("name", GLOBAL_CODES)
def test_a_file_loads_alone(name: str) -> None:
    assert load(name).alarms


@pytest.mark.parametrize("alarm", ALARMS, ids=lambda alarm: alarm.name)
class TestEveryAlarm:
    """What holds for each alarm of these files."""

    def test_its_code_follows_the_numbering_plan(self, alarm: Alarm) -> None:
        assert alarm.code in GLOBAL_CODES[Path(alarm.file).name]

    def test_the_driver_is_told_why_what_follows_and_what_to_do(self, alarm: Alarm) -> None:
        for text in (alarm.cause, alarm.consequence, alarm.action):
            assert text.endswith(".") and text.isascii() and len(text) <= 250

    def test_one_corrupted_frame_can_not_raise_it(self, alarm: Alarm) -> None:
        """Its on-delay outlasts the time until the value of a lone frame is stale. Not so for lamps, which a controller may send
        only for a short time, and for events and what devices report themselves."""
        inputs = [CATALOG.messages[node.message] for node in walk(alarm.when)
                  if isinstance(node, (SignalValue, Rate, Elapsed)) or isinstance(node, Quality) and node.kind == "error"]
        judged = [message for message in inputs if message.pgn != DM1_PGN and not message.sent_by_ucs]
        if alarm.is_fault:
            assert all(message.cycle_ns and alarm.on_delay_ns > 3 * message.cycle_ns for message in judged)

    def test_silence_is_judged_with_more_than_the_cycle_time(self, alarm: Alarm) -> None:
        for node in walk(alarm.when):
            if isinstance(node, Silent):
                cycle_ns = CATALOG.messages[node.message].cycle_ns
                assert cycle_ns and node.limit_ns >= 3 * cycle_ns

    def test_its_signal_shows_the_four_states(self, alarm: Alarm) -> None:
        signal = CATALOG.messages[alarm.message].signal(alarm.name)
        assert signal.choices == {0: "Normal", 1: "Active", 2: "Repairing", 3: "LockedOut"}


def test_alarm_messages_are_sent_every_second_from_proprietary_groups_of_their_own() -> None:
    messages = {alarm.message for alarm in ALARMS}
    assert messages == {"UCS_ALARMS", "TRACTOR_ALARMS"}
    for message in (CATALOG.messages[name] for name in messages):
        assert message.sent_by_ucs and message.cycle_ns == ALARMS_SENT_AT_NS
        assert message.extended and not message.j1939  # all ones in two bits is LockedOut, not "not available"
        assert 0xFF50 <= message.can_id >> 8 & 0xFFFF <= 0xFF5F


# -- payloads from recordings and from the published definitions of the groups --------------------------------------------------

@pytest.mark.parametrize(("message", "payload", "values"), [
    ("EEC1", "FFFFA5C45DFFFFFF", {"EngineSpeed": 3000.5, "EngineTorque": 40}),
    ("ET1", "7D4B602DFFFFFFFF", {"CoolantTemperature": 85, "FuelTemperature": 35, "EngineOilTemperature": 90}),
    ("EFL_P1", "FFFFFF4BFFFFFFFF", {"EngineOilPressure": 300}),
    ("EFL_P1", "FFFFFFFEFFFFFFFF", {}),
    ("VEP1", "FFFFFFFFFFFF1801", {"KeySwitchVoltage": 14}),
    ("LFE", "6400FFFFFFFFFFFF", {"FuelRate": 5}),
    ("ETC2", "7DFFFFFFFFFFFFFF", {"SelectedGear": 0}),
    ("ETC2", "80FFFF80FFFFFFFF", {"SelectedGear": 3, "CurrentGear": 3}),
    ("DD", "FF7DFFFFFFFFFFFF", {"FuelLevel": 50}),
    ("CCVS", "FF0006FFFFFFFFFF", {"VehicleSpeed": 6}),
    ("REAR_HITCH", "7DFF7D00E204FFFF", {"RearHitchPosition": 50, "RearLinkForce": 0}),
    ("VP", "00F90295001BC97A", {"Latitude": 40, "Longitude": -4}),
    ("VDS", "002D 0006 0065 A050", {"Heading": 90, "NavigationSpeed": 6, "Pitch": 2, "Altitude": 80}),
    ("TD", "C83B1706 7E287D7D", {"Second": 50, "Minute": 59, "Hour": 23, "Month": 6, "Day": 31.5, "Year": 2025,
                               "LocalMinuteOffset": 0, "LocalHourOffset": 0}),
    ("AUX_VALVE_3", "C87D C800 6400 7DFF", {"ExtendFlow": 75, "RetractFlow": 0, "ExtendPressure": 1000, "RetractPressure": 500,
                                         "ReturnPressure": 2000}),
])
def test_a_payload_reads_as_the_standard_says(message: str, payload: str, values: dict[str, float]) -> None:
    got = physical(CATALOG.messages[message], payload)
    assert {name: got.get(name) for name in values} == pytest.approx(values)
    if not values:
        assert not got


@pytest.mark.parametrize(("message", "pgn"), [
    ("WHEEL_SPEED", 65096), ("GROUND_SPEED", 65097), ("SELECTED_SPEED", 61474), ("REAR_HITCH", 65093), ("FRONT_HITCH", 65094),
    ("REAR_PTO", 65091), ("FRONT_PTO", 65092), ("MAINTAIN_POWER", 65095), ("AUX_VALVE_0", 65056), ("AUX_VALVE_15", 65071),
    ("AUX_VALVE_0_CMD", 65072), ("AUX_VALVE_15_CMD", 65087), ("STOP_ALL_IMPLEMENTS", 64770), ("EEC1", 61444), ("ETC2", 61445),
    ("ET1", 65262), ("EFL_P1", 65263), ("LFE", 65266), ("CCVS", 65265), ("DD", 65276), ("VEP1", 65271), ("VP", 65267),
    ("VDS", 65256), ("TD", 65254), ("DM1", 65226), ("PROCESS_DATA", 51968),
])
def test_a_message_is_matched_by_its_parameter_group(message: str, pgn: int) -> None:
    assert (CATALOG.messages[message].j1939, CATALOG.messages[message].pgn) == (True, pgn)


def test_only_what_must_come_from_one_device_names_a_source() -> None:
    named = {message.name: message.source for message in CATALOG.messages.values()
             if message.source is not None and (message.name == "UCS_HEALTH" or not message.sent_by_ucs)}
    assert named == {"ETC2": 0x03, "DM1_ENGINE": 0x00, "DM1_TRANSMISSION": 0x03, "DM1_TRANSMISSION_2": 0x06,
                     "DM1_TRACTOR_ECU": 0x47, "UCS_HEALTH": 0x80}


def test_sections_of_process_data_count_from_the_lowest_bits() -> None:
    message = CATALOG.messages["PROCESS_DATA"]
    sections = [message.signal(f"ActualSection{number}") for number in range(1, 17)]
    assert [section.start for section in sections] == list(range(32, 64, 2))
    assert {section.multiplexer_ids for section in sections} == {(161,)}


# -- behaviour -----------------------------------------------------------------------------------------------------------------

HEALTHY = {"CpuTemperature": 40 + 60, "MainboardTemperature": 40 + 50, "RamUsed": 100, "StorageUsed": 100, "TimeSync": 1}


def health_events(seconds: int, raws: Mapping[str, int]) -> list[str]:
    """What the supervisor says to a computer in that state: name and time in seconds of all that is raised."""
    message = CATALOG.messages["UCS_HEALTH"]
    supervisor = Supervisor(CATALOG, unit="test", broadcast=False)
    word = sum(raw << message.signal(name).start for name, raw in {**HEALTHY, **raws}.items())
    key, events = frame_key(message.can_id, True), []
    for second in range(seconds):
        outputs = supervisor.receive(Frame(second * S, key, word.to_bytes(8, "little")))
        events += [f"{output.alarm} {output.t:.0f}" for output in outputs if isinstance(output, Event) and output.event == "raised"]
    return events


@pytest.mark.parametrize(("raws", "told"), [
    ({}, []),
    ({"MainboardTemperature": 40 + 81}, ["MainboardTemperatureCritical 10"]),
    ({"CpuTemperature": 40 + 93}, ["CpuTemperatureCritical 10"]),
    ({"RamUsed": 231}, ["RamCritical 30"]),
    ({"StorageUsed": 238}, ["StorageCritical 30"]),
    ({"StorageWrite": 1}, ["StorageWriteFailed 2"]),
    ({"TrafficLog": 1}, ["TrafficLogFailed 2"]),
    ({"TimeSync": 0}, ["TimeSyncLost 120"]),
    ({"JournalState": 2}, ["JournalFault 2"]),
    ({"LoopLateness": 51}, ["LoopLate 5"]),
    ({"BusState": 4}, []),  # reported by who looks after the bus
    ({"CpuTemperature": 0xFE}, ["HealthNotMeasured 2"]),
    ({"BusLoad": 201}, ["BusOverloaded 10"]),
    ({"CpuTemperature": 0xFF, "MainboardTemperature": 0xFF, "TimeSync": 3, "BusState": 15, "GnssQuality": 7}, []),
])
def test_the_state_of_the_computer_raises_its_alarm(raws: dict[str, int], told: list[str]) -> None:
    assert health_events(130, raws) == told


def test_a_health_task_that_hangs_is_told() -> None:
    message = CATALOG.messages["UCS_HEALTH"]
    supervisor = Supervisor(CATALOG, unit="test", broadcast=False)
    supervisor.receive(Frame(0, frame_key(message.can_id, True), bytes(8)))
    events = [output for output in supervisor.tick(10 * S) if isinstance(output, Event)]
    assert [(event.alarm, event.t) for event in events if event.code == 1012] == [("HealthNotMeasured", Decimal(5))]


def test_the_switch_that_stops_all_implements_is_an_event_and_no_fault() -> None:
    supervisor = Supervisor(CATALOG, unit="test", broadcast=False)
    key = EXTENDED | 0x0CFD0226
    outputs = [*supervisor.receive(Frame(0, key, bytes.fromhex("FFFFFFFFFFFF01FD"))),
               *supervisor.receive(Frame(S, key, bytes.fromhex("FFFFFFFFFFFF02FC"))),
               *supervisor.receive(Frame(2 * S, key, bytes.fromhex("FFFFFFFFFFFF02FD")))]
    events = [output for output in outputs if isinstance(output, Event)]
    assert [(event.alarm, event.event, event.priority) for event in events] == [
        ("ImplementsStopped", "raised", "Event"), ("ImplementsStopped", "cleared", "Event")]
