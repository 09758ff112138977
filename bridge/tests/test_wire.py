"""The contract with any other level 2: topics, payloads, published schemas."""
from __future__ import annotations

import json
from decimal import Decimal
from pathlib import Path
from typing import Any, get_args

import jsonschema
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge import wire
from bridge.contract import schemas
from level1.event import EVENTS, PRIORITIES, Event, Monitor, SentFrame, encode, seconds

FOLDER = Path(wire.__file__).parent / "schema"
EVENT = Event("tractor-7", 3, 17, seconds(12_300_000_001), "2025-05-01T10:00:00.123Z", True, "PilotFlameOut", 3101, "High",
              "repair_started", 16, 1, {"FLAMER_STATUS.PilotFlame": "Off", "x.y": 0.1}, "Pilot flame out",
              (SentFrame("FLAMER_CMD", "650", "00ff"),), True)
HEAD: dict[str, Any] = {"unit": "tractor-7", "boot": 3, "seq": 17, "t": Decimal("12.3"), "utc": None, "utc_trusted": False}
EXAMPLES: dict[str, msgspec.Struct] = {
    "connection": wire.Connection(**HEAD, state="ONLINE", supervising=True, waiting=4),
    "monitor": wire.MonitorMessage(**HEAD, message="burners", values={"a": 1, "b": None, "c": "On"}, age_s={"a": 0.1, "b": None},
                                   quality={"a": "ok"}),
    "alarm": wire.alarm_message(EVENT, prev=16, historical=True),
    "ack": wire.Ack(**HEAD, also=((19, 22), (30, 30)), missing=((18, 18),)),
    "command": wire.Command(key="chief", body="{}", signature="AAAA"),
    "result": wire.Result(**HEAD, id="c-1", outcome="refused", reason="expired"),
    "order": wire.Order(**HEAD, id="c-1", name="reduce_speed", value=Decimal("0.1"), expires_t=Decimal("20")),
}


@pytest.mark.parametrize("kind", EXAMPLES)
def test_every_message_survives_the_way(kind: str) -> None:
    assert wire.decode(wire.encode(EXAMPLES[kind]), type(EXAMPLES[kind])) == EXAMPLES[kind]


def test_an_alarm_carries_its_event_unchanged() -> None:
    alarm = wire.decode(wire.encode(wire.alarm_message(EVENT, 16, False)), wire.Alarm)
    assert encode(wire.event_of(alarm)) == encode(EVENT)


def test_an_alarm_begins_with_the_keys_of_an_event_line() -> None:
    keys = [*json.loads(wire.encode(wire.alarm_message(EVENT, 16, False)))]
    assert keys[:14] == ["schema", "unit", "boot", "seq", "t", "utc", "utc_trusted", "alarm", "code", "priority", "event",
                         "instance", "attempt", "values"]


def test_times_keep_every_nanosecond() -> None:
    assert b'"t":12.300000001,' in wire.encode(wire.alarm_message(EVENT, 16, False))


def test_a_monitoring_sample_becomes_its_message() -> None:
    sample = Monitor("tractor-7", 3, seconds(5), None, False, "motion", {"v": 3.0}, {"v": 0.0}, {})
    message = wire.monitor_message(sample, 8)
    assert (message.seq, message.message, message.values) == (8, "motion", {"v": 3.0})


@pytest.mark.parametrize("name", schemas())
def test_the_published_schema_is_the_generated_one(name: str) -> None:
    assert (FOLDER / name).read_text(encoding="utf-8") == schemas()[name], "run `python -m bridge.contract` and commit"


def test_no_other_schema_is_published() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(schemas())


@pytest.mark.parametrize("kind", EXAMPLES)
def test_messages_keep_their_published_schema(kind: str) -> None:
    schema = json.loads((FOLDER / f"{kind}.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(json.loads(wire.encode(EXAMPLES[kind])), schema)


def test_the_description_covers_every_kind_and_refers_to_its_schema() -> None:
    described = json.loads((FOLDER / "asyncapi.json").read_text(encoding="utf-8"))
    assert set(described["channels"]) == set(described["operations"]) == {*wire.KINDS} == {*wire.UP, *wire.DOWN}
    for kind, channel in described["channels"].items():
        assert (FOLDER / channel["messages"][kind]["payload"]["$ref"]).is_file()
        address = channel["address"].format(fleet="farm", unit="t7", message="motion")
        assert wire.parse_topic(address).kind == kind
        assert described["operations"][kind]["action"] == ("receive" if kind in wire.UP else "send")


def test_the_words_of_the_wire_are_those_of_the_core() -> None:
    fields = {field.name: field for field in msgspec.structs.fields(wire.Alarm)}
    assert set(get_args(fields["event"].type)) == set(EVENTS)
    assert set(get_args(fields["priority"].type)) == set(PRIORITIES)
    assert set(Event.__struct_fields__) < set(wire.Alarm.__struct_fields__)
    assert set(Monitor.__struct_fields__) < set(wire.MonitorMessage.__struct_fields__)


# Topics


@pytest.mark.parametrize(("kind", "message", "text"), [
    ("alarm", "", "ucs/v1/north-farm/tractor-7/alarm"), ("monitor", "burners", "ucs/v1/north-farm/tractor-7/monitor/burners")])
def test_topics_are_built_and_taken_apart(kind: str, message: str, text: str) -> None:
    assert wire.topic("north-farm", "tractor-7", kind, message) == text
    assert wire.parse_topic(text) == ("north-farm", "tractor-7", kind, message)


@pytest.mark.parametrize("name", ["", "a/b", "a+b", "#", "$SYS", "two words", "a\0b", "x" * 65, "tab\t", "ü" * 40, "esc\x1b[2J",
                                  "csi\x9b2J", "line\n", "*", ">"])
def test_names_that_cannot_stand_in_a_topic_are_refused(name: str) -> None:
    with pytest.raises(wire.WireError, match="can't stand in an MQTT topic"):
        wire.topic("farm", name, "alarm")


@pytest.mark.parametrize("topic", ["", "ucs/v1/farm/t7", "ucs/v2/farm/t7/alarm", "ucs/v1/farm/t7/alarm/x", "ucs/v1/farm/t7/monitor",
                                   "ucs/v1/farm//alarm", "ucs/v1/farm/t7/other", "$SYS/v1/farm/t7/alarm"])
def test_other_topics_are_refused(topic: str) -> None:
    with pytest.raises(wire.WireError):
        wire.parse_topic(topic)


@pytest.mark.parametrize("name", ["", "a/b", "$SYS", "two words", "esc\x1b[2J", "csi\x9b2J", "line\n", "x" * 65])
def test_names_in_messages_keep_the_same_rules(name: str) -> None:
    with pytest.raises(wire.WireError):
        wire.decode(json.dumps({"key": name, "body": "", "signature": ""}).encode(), wire.Command)


def test_what_would_steer_a_terminal_or_feign_a_line_is_spelt_out() -> None:
    assert wire.shown("Düse \x1b[2J\nunit \u202e") == r"Düse \x1b[2J\nunit \u202e"


# Hostile and future payloads


@pytest.mark.parametrize("payload", [
    b"", b"null", b"[]", b"{", b'"ack"', b"\xff\xfe", b'{"unit":"t7"}', b"[" * 20000,
    b'{"unit":"t7","boot":1,"seq":"2","t":1}', b'{"unit":"t7","boot":-1,"seq":2,"t":1}', b'{"unit":"t/7","boot":1,"seq":2,"t":1}',
    b'{"unit":"t7","boot":1,"seq":99999999999999999999,"t":1}', b'{"unit":"t7","boot":1,"seq":2,"t":1,"also":[[0,3]]}',
    b'{"unit":"t7","boot":1,"seq":2,"t":1,"also":[' + b"[1,2]," * 80 + b"[1,2]]}"])
def test_malformed_payloads_are_refused(payload: bytes) -> None:
    with pytest.raises(wire.WireError):
        wire.decode(payload, wire.Ack)


@pytest.mark.parametrize("number", ["1E999999999", "-1e400", "1E-999999999", "1" * 100])
def test_numbers_that_would_fill_the_memory_are_refused(number: str) -> None:
    with pytest.raises(wire.WireError, match="t is no plain number"):
        wire.decode(b'{"unit":"t7","boot":1,"seq":2,"t":%s}' % number.encode(), wire.Ack)


def test_a_huge_payload_is_refused_unread() -> None:
    with pytest.raises(wire.WireError, match="bytes, at most"):
        wire.decode(b" " * (wire.PAYLOAD_BYTES + 1), wire.Ack)


def test_a_newer_schema_is_refused_by_name() -> None:
    with pytest.raises(wire.WireError, match="schema 2 is newer than 1"):
        wire.decode(b'{"schema":2,"unit":"t7"}', wire.Ack)


def test_fields_of_a_later_version_are_ignored() -> None:
    assert wire.decode(b'{"unit":"t7","boot":1,"seq":2,"t":1,"colour":"green"}', wire.Ack).seq == 2


@given(st.binary(max_size=200), st.sampled_from([*wire.SCHEMAS.values()]))
def test_no_payload_raises_anything_but_a_wire_error(payload: bytes, kind: type[msgspec.Struct]) -> None:
    try:
        wire.decode(payload, kind)
    except wire.WireError:
        pass
