"""What the tests of the bridge are made of: a hand-driven level 2, a unit with a journal, waiting."""
from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import jsonschema
import msgspec

from bridge import wire
from bridge.mqtt import Address, MqttConnection, Received
from bridge.session import Settings
from bridge.tests.brokers import WAIT_S
from level1.event import Event, seconds
from level1.io.journal import Journal

FLEET, UNIT = "north-farm", "tractor-7"
M = TypeVar("M", bound=msgspec.Struct)
_SCHEMAS = Path(wire.__file__).parent / "schema"
_VALIDATORS = {kind: jsonschema.Draft202012Validator(json.loads((_SCHEMAS / f"{kind}.json").read_text(encoding="utf-8")))
               for kind in wire.SCHEMAS}
"""Whatever the tests receive is checked against what is published."""


def an_event(seq: int, boot: int = 1) -> Event:
    return Event(UNIT, boot, seq, seconds(seq), None, False, "PilotFlameOut", 3101, "High", "raised", seq, 0, {}, "Pilot flame out")


def eventually(condition: Callable[[], object]) -> None:
    """Wait for what another thread or process will do; a minute is far beyond any of it."""
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.01)


class Peer:
    """A level 2 that does only what it is told to."""

    def __init__(self, broker: Address, subscribe: str = f"ucs/v1/{FLEET}/{UNIT}/"):
        topics = [subscribe + kind + "/+" * (kind == "monitor") for kind in wire.UP]
        self.connection = MqttConnection(broker, f"peer-{id(self)}", subscribe=[(topic, 1) for topic in topics])
        self.received: list[Received] = []
        self.until(lambda: self.connection.ready)

    def until(self, condition: Callable[[], object]) -> None:
        """Take in what comes until a condition holds."""
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f"did not happen; came: {[message.topic for message in self.received]}"
            assert not self.connection.lost, self.connection.lost
            self.connection.wait(0.02)
            self.received += self.connection.take()

    def messages(self, kind: type[M]) -> list[M]:
        """What came of a kind."""
        names = {content: name for name, content in wire.KINDS.items()}
        name = names[kind]  # type: ignore[index]
        found = [message.payload for message in self.received if wire.parse_topic(message.topic).kind == name]
        for payload in found:
            _VALIDATORS[name].validate(json.loads(payload))
        return [wire.decode(payload, kind) for payload in found]

    def seqs(self) -> list[int]:
        """The seqs of the events that came, in the order in which they came."""
        return [alarm.seq for alarm in self.messages(wire.Alarm)]

    def send_checked(self, kind: str, message: msgspec.Struct) -> None:
        """Publish to the unit what keeps the published schema."""
        payload = wire.encode(message)
        _VALIDATORS[kind].validate(json.loads(payload))
        self.send(kind, payload)

    def send(self, kind: str, payload: bytes) -> None:
        """Publish to the unit."""
        self.connection.publish(wire.topic(FLEET, UNIT, kind), payload, qos=1)

    def acknowledge(self, boot: int, upto: int, also: tuple[tuple[int, int], ...] = (), unit: str = UNIT) -> None:
        """Say that events are on our disk."""
        self.send_checked("ack", wire.Ack(unit=unit, boot=boot, seq=upto, also=also, t=seconds(1)))


class Unit:
    """A unit with a journal; `settings` for its bridge, quick to retry."""

    def __init__(self, folder: Path, broker: Address, unit: str = UNIT):
        self.path = folder / "journal.db"
        self.journal = Journal(self.path, unit, patience_ns=round(WAIT_S * 1e9))
        self.settings = Settings(self.path, unit, FLEET, broker, retry_ns=200_000_000, period_ns=50_000_000)
        self.said: list[str] = []

    def write(self, *seqs: int) -> None:
        """Append events."""
        assert self.journal.append([an_event(seq, self.journal.boot) for seq in seqs], b"")
