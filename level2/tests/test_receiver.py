"""The receiver over a real broker, with hand-made units: what it acknowledges, and when; gaps, silence, hostile senders."""
from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bridge import wire
from bridge.broker import EmbeddedBroker
from bridge.error import OutsideError
from bridge.mqtt import MqttConnection
from bridge.tests.brokers import WAIT_S, free_port
from bridge.wire import Event, Monitor, seconds
from level2.receiver import Receiver, ReceiverThread, Settings, event_line
from level2.store import Arrival, Outcome, Store

FLEET, UNIT = "north-farm", "tractor-7"


def an_event(seq: int, boot: int = 1) -> Event:
    return Event(UNIT, boot, seq, seconds(seq), None, False, "PilotFlameOut", 3101, "High", "raised", seq, 0, {}, "Pilot flame out")


class Setup:
    """A broker, a receiver in a thread, and a unit that does only what it is told to."""

    def __init__(self, folder: Path, silent_ns: int = 300_000_000):
        self.broker = EmbeddedBroker(port=free_port())
        self.store = Store(folder / "level2.db")
        self.arrivals: list[Arrival] = []
        self.said: list[str] = []
        settings = Settings(self.broker.address, silent_ns=silent_ns, ask_ns=300_000_000)
        self.receiver = Receiver(settings, self.store, told=self.arrivals.append, say=self.said.append)
        self.thread = ReceiverThread(self.receiver)
        self.unit = MqttConnection(self.broker.address, "unit", subscribe=[(f"ucs/v1/{FLEET}/{UNIT}/ack", 1)])
        self.acks: list[wire.Ack] = []
        self.until(lambda: self.unit.ready and self.receiver.online)

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f"did not happen; said: {self.said}, acks: {self.acks}"
            assert not self.unit.lost, self.unit.lost
            self.unit.wait(0.02)
            self.acks += [wire.decode(message.payload, wire.Ack) for message in self.unit.take()]

    def send(self, *seqs: int, prev: int | None = None, boot: int = 1) -> None:
        for seq in seqs:
            message = wire.alarm_message(an_event(seq, boot), seq - 1 if prev is None else prev, False)
            self.publish("alarm", wire.encode(message))

    def publish(self, kind: str, payload: bytes, name: str = "") -> None:
        self.unit.publish(wire.topic(FLEET, UNIT, kind, name), payload, qos=1)

    def close(self) -> None:
        self.unit.close()
        self.thread.__exit__()
        self.store.close()
        self.broker.close()


@pytest.fixture
def setup(tmp_path: Path) -> Iterator[Setup]:
    setup = Setup(tmp_path)
    yield setup
    setup.close()


def test_an_acknowledged_event_is_on_the_disk(setup: Setup) -> None:
    setup.send(1, 2)
    setup.until(lambda: setup.acks and setup.acks[-1].seq == 2)
    other = sqlite3.connect(setup.store.path)
    assert other.execute("SELECT count(*) FROM event").fetchone() == (2,)
    other.close()
    setup.until(lambda: [arrival.alarm.seq for arrival in setup.arrivals] == [1, 2])


def test_a_duplicate_is_acknowledged_again_and_told_once(setup: Setup) -> None:
    setup.send(1)
    setup.until(lambda: len(setup.acks) == 1)
    setup.send(1)
    setup.until(lambda: len(setup.acks) == 2)
    assert setup.acks[0].seq == setup.acks[1].seq == 1
    assert len(setup.arrivals) == 1
    setup.until(lambda: setup.receiver.counters["duplicate"] == 1)


def test_what_lies_above_a_gap_is_acknowledged_apart(setup: Setup) -> None:
    setup.send(1, 2, 5)
    setup.until(lambda: setup.acks and setup.acks[-1].also)
    assert (setup.acks[-1].seq, setup.acks[-1].also) == (2, ((5, 5),))


@pytest.mark.fault("events lost or late", "a gap is asked for; what the unit no longer has is told and holds nothing up")
def test_a_gap_that_stays_is_asked_for_and_its_end_told(setup: Setup) -> None:
    setup.send(1, 5)
    setup.until(lambda: setup.acks and setup.acks[-1].missing)
    assert setup.acks[-1].missing == ((2, 4),)
    assert "of boot 1 the events 2 to 4 are missing, asked for" in setup.said[-1]
    setup.send(2, 3, 4)
    setup.until(lambda: setup.acks[-1].seq == 5)
    setup.until(lambda: "is closed" in setup.said[-1])


@pytest.mark.fault("events lost or late")
def test_lost_events_are_told_and_hold_nothing_up(setup: Setup) -> None:
    setup.send(1)
    setup.send(9, prev=1)
    setup.until(lambda: setup.acks and setup.acks[-1].seq == 9)
    setup.until(lambda: any("has lost its events 2 to 8 of boot 1" in line for line in setup.said))


@pytest.mark.fault("level 2's disk takes nothing", "nothing is acknowledged, everything comes again")
def test_nothing_is_acknowledged_that_could_not_be_stored(setup: Setup) -> None:
    other = sqlite3.connect(setup.store.path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    setup.send(1)
    setup.until(lambda: any("nothing is acknowledged" in line for line in setup.said))
    assert setup.acks == []
    other.execute("ROLLBACK")
    other.close()
    setup.send(1)
    setup.until(lambda: setup.acks and setup.acks[-1].seq == 1)


@pytest.mark.fault("monitoring stops", "told within 2 s, without waiting for the last will")
def test_a_unit_whose_monitoring_stops_is_told_silent_and_heard_again(setup: Setup) -> None:
    sample = wire.encode(wire.monitor_message(Monitor(UNIT, 1, seconds(5), None, False, "burners", {"a": 1}, {}, {}), 1))
    setup.publish("monitor", sample, "burners")
    setup.until(lambda: "tractor-7 is silent: no monitoring message for 0.3 s" in setup.said)
    assert setup.receiver.latest[FLEET, UNIT]["burners"].values == {"a": 1}
    setup.publish("monitor", sample, "burners")
    setup.until(lambda: "tractor-7 is heard again" in setup.said)
    seldom = wire.encode(wire.monitor_message(Monitor(UNIT, 1, seconds(5), None, False, "burners", {"a": 1}, {}, {}), 2, 0.75))
    setup.publish("monitor", seldom, "burners")
    setup.until(lambda: "tractor-7 is silent: no monitoring message for 1.3 s" in setup.said)


@pytest.mark.fault("level 2's own disk is slow", "acknowledged later; no unit is told silent for it")
def test_no_unit_is_told_silent_because_our_own_disk_is_slow(tmp_path: Path) -> None:
    setup = Setup(tmp_path, silent_ns=900_000_000)  # the disk takes a second, SQLite's patience
    sample = wire.encode(wire.monitor_message(Monitor(UNIT, 1, seconds(5), None, False, "burners", {"a": 1}, {}, {}), 1))
    other = sqlite3.connect(setup.store.path, isolation_level=None)
    setup.publish("monitor", sample, "burners")
    setup.until(lambda: setup.receiver.counters["monitor"])
    other.execute("BEGIN IMMEDIATE")
    setup.send(1)
    while not any("nothing is acknowledged" in line for line in setup.said):
        setup.publish("monitor", sample, "burners")
        setup.unit.wait(0)
        time.sleep(0.05)
    before = setup.receiver.counters["monitor"]
    setup.publish("monitor", sample, "burners")
    setup.until(lambda: setup.receiver.counters["monitor"] > before)
    other.execute("ROLLBACK")
    other.close()
    assert not any("is silent:" in line for line in setup.said), setup.said
    setup.close()


def test_connections_are_told_and_greeted(setup: Setup) -> None:
    message = wire.Connection(unit=UNIT, boot=1, seq=1, t=seconds(1), state="ONLINE", supervising=False, waiting=3)
    setup.publish("connection", wire.encode(message))
    setup.until(lambda: [(ack.boot, ack.seq) for ack in setup.acks] == [(1, 0)])
    setup.until(lambda: "tractor-7 is ONLINE, its supervision is not running, 3 events to come" in setup.said)


@pytest.mark.fault("malformed, huge or foreign payloads at level 2", "refused, counted, told once")
@pytest.mark.parametrize("payload", [b"", b"{", b"\xff", b"null", b" " * 100_000, b'{"unit":"tractor-8","boot":1,"seq":1,"t":0}'])
def test_hostile_payloads_are_refused_once_and_counted(setup: Setup, payload: bytes) -> None:
    setup.publish("alarm", payload)
    setup.publish("alarm", payload)
    setup.until(lambda: setup.receiver.counters["refused"] == 2)
    setup.send(1)
    setup.until(lambda: setup.acks)
    assert len([line for line in setup.said if "refused" in line]) == 1


@pytest.mark.fault("malformed, huge or foreign payloads at level 2")
def test_an_event_under_another_units_topic_is_refused(setup: Setup) -> None:
    message = wire.alarm_message(an_event(1), 0, False)
    setup.unit.publish(wire.topic(FLEET, "tractor-8", "alarm"), wire.encode(message), qos=1)
    setup.until(lambda: setup.receiver.counters["refused"] == 1)
    assert setup.arrivals == []


def test_a_broker_that_comes_back_is_found_again(tmp_path: Path) -> None:
    setup = Setup(tmp_path)
    address = setup.broker.address
    setup.unit.abandon()
    setup.broker.close()
    end = time.monotonic() + WAIT_S
    while not any("trying on" in line for line in setup.said):
        assert time.monotonic() < end
        time.sleep(0.02)
    setup.broker = EmbeddedBroker(port=address.port)
    setup.unit = MqttConnection(address, "unit", subscribe=[(f"ucs/v1/{FLEET}/{UNIT}/ack", 1)])
    setup.until(lambda: setup.unit.ready and setup.receiver.online)
    setup.send(1)
    setup.until(lambda: setup.acks)
    setup.close()


def test_a_line_says_when_who_what_and_how_it_came() -> None:
    alarm = wire.alarm_message(an_event(1), 0, True)
    line = event_line(Arrival(FLEET, alarm, Outcome.NEW, ()))
    assert line == "0.000 s tractor-7 PilotFlameOut raised  Pilot flame out (late)"


def test_a_fleet_name_that_cannot_stand_in_a_topic_is_told(tmp_path: Path) -> None:
    with EmbeddedBroker() as broker, Store(tmp_path / "level2.db") as store, pytest.raises(OutsideError, match="MQTT topic"):
        Receiver(Settings(broker.address, "a/b"), store, told=print, say=print)
