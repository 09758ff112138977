"""The bridge over a real broker: what leaves, what comes back, and what happens when anything in between dies."""
from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge import wire
from bridge.delivered import delivered_path, delivered_upto
from bridge.link import RunLink
from bridge.mqtt import Address, MqttConnection, Tls
from bridge.session import Bridge, BridgeThread, Settings, client_id
from bridge.tests import brokers
from bridge.tests.brokers import Broker
from bridge.tests.peer import FLEET, UNIT, Peer, Unit, an_event, eventually
from level1.event import Monitor, seconds
from level1.io.error import OutsideError


@pytest.fixture(params=brokers.KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def broker(kind: str) -> Iterator[Broker]:
    broker = brokers.start(kind)
    yield broker
    broker.close()


@pytest.fixture
def peer(broker: Broker) -> Iterator[Peer]:
    peer = Peer(broker.address)
    yield peer
    peer.connection.close()


@pytest.fixture
def unit(tmp_path: Path, broker: Broker) -> Iterator[Unit]:
    unit = Unit(tmp_path, broker.address)
    yield unit
    unit.journal.close()


def start(unit: Unit) -> BridgeThread:
    return BridgeThread(unit.settings, unit.said.append)


# Events


def test_an_event_is_sent_until_level_2_acknowledges_it_and_not_after(unit: Unit, peer: Peer) -> None:
    with start(unit):
        unit.write(1)
        peer.until(lambda: peer.seqs().count(1) >= 3)
        peer.acknowledge(1, 1)
        eventually(lambda: delivered_upto(delivered_path(unit.path)) == {1: 1})
        unit.write(2)
        peer.until(lambda: 2 in peer.seqs())  # what was sent before it has come before it
        sent = peer.seqs().count(1)
        peer.until(lambda: peer.seqs().count(2) >= 4)
        assert peer.seqs().count(1) == sent


def test_an_event_arrives_whole(unit: Unit, peer: Peer) -> None:
    unit.write(1)
    with start(unit):
        peer.until(peer.seqs)
    alarm = peer.messages(wire.Alarm)[0]
    assert wire.event_of(alarm) == an_event(1)
    assert (alarm.historical, alarm.prev) == (True, 0)


def test_a_bridge_without_journal_waits_for_it(tmp_path: Path, broker: Broker, peer: Peer) -> None:
    unit = Unit(tmp_path / "first", broker.address)
    unit.journal.close()
    settings = unit.settings
    said: list[str] = []
    with BridgeThread(type(settings)(tmp_path / "journal.db", UNIT, FLEET, broker.address), said.append):
        eventually(lambda: said)
        later = Unit(tmp_path, broker.address)
        later.write(1)
        peer.until(peer.seqs)
        later.journal.close()
    assert "no such file" in said[0] and "waits for it" in said[0]


def test_the_journal_of_another_unit_is_not_sent(tmp_path: Path, broker: Broker) -> None:
    unit = Unit(tmp_path, broker.address, unit="tractor-8")
    unit.journal.close()
    settings = type(unit.settings)(unit.path, UNIT, FLEET, broker.address)
    said: list[str] = []
    with BridgeThread(settings, said.append):
        eventually(lambda: said)
    assert 'belongs to the unit "tractor-8"' in said[0]


@pytest.mark.fault("the journal takes nothing", "events leave beside it")
def test_what_the_journal_cannot_take_arrives_too(unit: Unit, peer: Peer) -> None:
    link = RunLink(unit.path)
    with start(unit) as bridge:
        unit.write(1)
        eventually(lambda: bridge.online)
        eventually(lambda: link.send_beside((an_event(2),)))
        peer.until(lambda: {1, 2} <= set(peer.seqs()))
    link.close()


def test_no_unit_has_the_client_id_of_another_nor_can_guess_it(tmp_path: Path) -> None:
    (tmp_path / "key.pem").write_text("secret")
    address, key = Address("localhost", 1, True), Tls(key=str(tmp_path / "key.pem"))
    names = [("a", "b-c", Tls()), ("a-b", "c", Tls()), ("a", "b.c", Tls()), ("a", "b-c", key)]
    ids = [client_id(Settings(tmp_path, unit, fleet, address, tls)) for fleet, unit, tls in names]
    assert len(set(ids)) == len(ids) and all(re.fullmatch("[A-Za-z0-9_-]+", id) for id in ids)
    assert ids[3] == client_id(Settings(tmp_path, "b-c", "a", address, key))


def test_a_second_bridge_on_a_journal_is_refused(unit: Unit) -> None:
    with start(unit), pytest.raises(OutsideError, match="another `ucs bridge`"):
        Bridge(unit.settings, unit.said.append)


# Acknowledgements


@pytest.mark.fault("malformed, huge, retained or foreign acknowledgements", "refused, counted, told once")
@pytest.mark.parametrize("payload", [b"", b"null", b"{" * 100, b"\xff" * 10, b'{"unit":"tractor-7","boot":1,"seq":"1","t":0}',
                                     b'{"schema":9,"unit":"tractor-7"}', b" " * 100_000])
def test_a_malformed_acknowledgement_is_counted_and_told_once(unit: Unit, peer: Peer, payload: bytes) -> None:
    unit.write(1)
    with start(unit) as bridge:
        peer.until(peer.seqs)
        peer.send("ack", payload)
        peer.send("ack", payload)
        peer.until(lambda: bridge.counters["ack refused"] == 2)
        assert delivered_upto(delivered_path(unit.path)) == {}
    assert len([line for line in unit.said if "refused" in line]) == 1


@pytest.mark.fault("level 2 acknowledges what it never got, or goes backwards", "nothing is taken out of the outbox; told once")
def test_an_acknowledgement_of_what_was_never_sent_is_refused(unit: Unit, peer: Peer) -> None:
    unit.write(1, 2)
    with start(unit) as bridge:
        peer.until(lambda: set(peer.seqs()) == {1, 2})
        peer.acknowledge(1, 3)
        peer.acknowledge(7, 1)
        peer.acknowledge(1, 2, unit="tractor-8")
        peer.until(lambda: bridge.counters["ack refused"] == 3)
        assert delivered_upto(delivered_path(unit.path)) == {}
        peer.acknowledge(1, 2)
        eventually(lambda: delivered_upto(delivered_path(unit.path)) == {1: 2})


@pytest.mark.fault("malformed, huge, retained or foreign acknowledgements")
def test_a_retained_acknowledgement_is_refused(unit: Unit, peer: Peer) -> None:
    unit.write(1)
    ack = wire.encode(wire.Ack(unit=UNIT, boot=1, seq=1, t=seconds(1)))
    peer.connection.publish(wire.topic(FLEET, UNIT, "ack"), ack, 1, retain=True)
    with start(unit) as bridge:
        peer.until(lambda: bridge.counters["ack refused"] == 1)
        peer.until(lambda: peer.seqs().count(1) >= 2)
    assert any("retained: it may be of any age" in line for line in unit.said)


@pytest.mark.fault("a packet of 10 MB", "ends that connection before it is read; the next one goes on")
def test_a_packet_of_10_mb_ends_a_connection_and_nothing_else(unit: Unit, peer: Peer, broker: Broker) -> None:
    unit.write(1)
    with start(unit) as bridge:
        peer.until(peer.seqs)
        stranger = Peer(broker.address, subscribe="x")
        stranger.send("ack", bytes(10_000_000))
        while bridge.online and not stranger.connection.lost:  # whichever the broker ends, ours or the sender's
            stranger.connection.wait(0.02)
        stranger.connection.abandon()
        eventually(lambda: bridge.online)
        unit.write(2)
        peer.until(lambda: 2 in peer.seqs())


# Connection and monitoring


def states(peer: Peer) -> list[str]:
    return [message.state for message in peer.messages(wire.Connection)]


def test_the_connection_is_announced_kept_and_taken_back(unit: Unit, peer: Peer, broker: Broker) -> None:
    with start(unit):
        peer.until(lambda: states(peer) == ["ONLINE"])
        latecomer = Peer(broker.address)
        latecomer.until(lambda: "ONLINE" in states(latecomer))
        latecomer.connection.close()
    peer.until(lambda: states(peer) == ["ONLINE", "OFFLINE"])


@pytest.mark.fault("bridge vanishes", "the broker says CONNECTION_BROKEN")
def test_a_bridge_that_vanishes_is_told_by_the_broker(peer: Peer, broker: Broker) -> None:
    will = (wire.topic(FLEET, UNIT, "connection"), b'{"unit":"tractor-7","boot":1,"seq":1,"t":0,"state":"CONNECTION_BROKEN",'
                                                   b'"supervising":false,"waiting":0}')
    victim = MqttConnection(broker.address, "victim", subscribe=[("x", 0)], will=will)
    while not victim.ready:
        victim.wait(0.1)
    victim.abandon()
    peer.until(lambda: states(peer) == ["CONNECTION_BROKEN"])


@pytest.mark.fault("supervision ends while the bridge runs", "level 2 is told within 2 s")
def test_level_2_is_told_whether_supervision_runs(unit: Unit, peer: Peer) -> None:
    link = RunLink(unit.path)
    with start(unit):
        peer.until(lambda: states(peer))
        assert not peer.messages(wire.Connection)[-1].supervising
        eventually(link.send_samples)
        peer.until(lambda: any(told.supervising for told in peer.messages(wire.Connection)))
        peer.until(lambda: not peer.messages(wire.Connection)[-1].supervising)
    link.close()


def a_sample(number: int) -> Monitor:
    return Monitor(UNIT, 1, seconds(number), None, False, "burners", {"number": number}, {"number": 0.0}, {})


def test_only_the_latest_sample_is_sent_and_at_the_period(unit: Unit, peer: Peer) -> None:
    link = RunLink(unit.path)
    with start(unit) as bridge:
        eventually(lambda: bridge.online)
        begin = time.monotonic()
        for number in range(1, 101):
            eventually(lambda number=number: link.send_samples(a_sample(number)))  # type: ignore[misc]
            time.sleep(0.005)
        peer.until(lambda: peer.messages(wire.MonitorMessage) and peer.messages(wire.MonitorMessage)[-1].t == seconds(100))
        periods = (time.monotonic() - begin) / 0.05
    numbers = [message.values["number"] for message in peer.messages(wire.MonitorMessage)]
    assert numbers == sorted(set(numbers))
    assert len(numbers) <= periods + 2
    assert [message.seq for message in peer.messages(wire.MonitorMessage)] == [*range(1, len(numbers) + 1)]
    link.close()


# Brokers that are not there


@pytest.mark.fault("no broker, or gone after its acknowledgement",
                   "told once; kept in the journal, sent again on the next connection")
def test_an_unreachable_broker_is_told_once_and_tried_on(tmp_path: Path, kind: str) -> None:
    port = brokers.free_port()
    unit = Unit(tmp_path, Address("127.0.0.1", port, False))
    unit.write(1)
    with start(unit):
        eventually(lambda: unit.said)
        time.sleep(1.0)
        assert len(unit.said) == 1 and "can't be reached (Connection refused)" in unit.said[0]
        broker = brokers.start(kind, port)
        peer = Peer(broker.address)
        peer.until(peer.seqs)
        broker.close()
    unit.journal.close()


@pytest.mark.fault("no broker, or gone after its acknowledgement")
def test_a_broker_killed_after_its_acknowledgement_loses_nothing(tmp_path: Path, kind: str) -> None:
    broker = brokers.start(kind)
    unit = Unit(tmp_path, broker.address)
    unit.write(*range(1, 21))
    with start(unit) as bridge:
        eventually(lambda: bridge.counters["alarm sent"] >= 20)  # nobody subscribes: the broker takes and forgets them
        broker.close()
        eventually(lambda: not bridge.online)
        broker = brokers.start(kind, broker.address.port)
        peer = Peer(broker.address)
        peer.until(lambda: set(peer.seqs()) == {*range(1, 21)})
        assert all(alarm.historical for alarm in peer.messages(wire.Alarm))
        peer.acknowledge(1, 20)
        eventually(lambda: delivered_upto(delivered_path(unit.path)) == {1: 20})
        broker.close()
    unit.journal.close()
