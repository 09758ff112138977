"""Commands over a real broker: through the gate to supervision and back, and what strangers, repeats and silence meet."""
from __future__ import annotations

import time
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from bridge import wire
from bridge.broker import EmbeddedBroker
from bridge.keys import Key, add_key, make_private, public_bytes
from bridge.link import RunLink
from bridge.session import BridgeThread
from bridge.signing import signed
from bridge.tests.peer import FLEET, UNIT, Peer, Unit, eventually
from level1.command import Order
from level1.event import Monitor, Result, seconds


class Site:
    """A unit with a bridge, its supervision played by hand, and a level 2 with the chief's key."""

    def __init__(self, folder: Path):
        self.broker = EmbeddedBroker()
        self.unit = Unit(folder, self.broker.address)
        self.chief = make_private(folder / "chief.key")
        self.keys = folder / "keys.toml"
        add_key(self.keys, Key("chief", "reset", public_bytes(self.chief)))
        self.peer = Peer(self.broker.address)
        self.link = RunLink(self.unit.path)
        self.obeyed: list[Order] = []
        self.thread = BridgeThread(msgspec.structs.replace(self.unit.settings, keys=self.keys), self.unit.said.append)
        eventually(lambda: self.thread.bridge.online)

    def send(self, seq: int = 1, private: Ed25519PrivateKey | None = None, **changes: Any) -> bytes:
        now = seconds(time.monotonic_ns())
        order = wire.Order(unit=UNIT, boot=self.unit.journal.boot, seq=seq, t=now, id=f"c-{seq}", name="pause", expires_t=now + 25)
        order = msgspec.structs.replace(order, **changes)
        payload = wire.encode(signed(order, FLEET, "chief", private or self.chief))
        self.peer.send("command", payload)
        return payload

    def supervise(self, outcome: str = "done", reason: str = "") -> None:
        """Take orders, as `ucs run` would."""
        for instruct in self.link.receive():
            self.obeyed.append(instruct.order)
            self.link.answer(Result(instruct.order.id, outcome, reason))

    def results(self, count: int, supervised: bool = True) -> list[tuple[str, int, str, str]]:
        def come() -> bool:
            if supervised:
                self.supervise()
            return len(self.peer.messages(wire.Result)) >= count

        self.peer.until(come)
        return [(result.id, result.seq, result.outcome, result.reason) for result in self.peer.messages(wire.Result)]

    def close(self) -> None:
        self.thread.__exit__()
        self.link.close()
        self.peer.connection.close()
        self.unit.journal.close()
        self.broker.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    yield site
    site.close()


def test_a_good_command_is_obeyed_and_answered(site: Site) -> None:
    site.send(3, name="reduce_speed", value=Decimal("2"))
    assert site.results(1) == [("c-3", 3, "done", "")]
    assert [(order.name, order.value, order.origin) for order in site.obeyed] == [("reduce_speed", Decimal(2), "above")]


def test_supervisions_refusal_comes_back_with_its_reason(site: Site) -> None:
    site.send()
    eventually(lambda: site.supervise("refused", "Mode is stale") or site.obeyed)  # type: ignore[func-returns-value]
    assert site.results(1) == [("c-1", 1, "refused", "Mode is stale")]


def test_a_command_sent_twice_is_obeyed_once_and_answered_twice(site: Site) -> None:
    payload = site.send()
    assert site.results(1) == [("c-1", 1, "done", "")]
    site.peer.send("command", payload)
    assert site.results(2) == [("c-1", 1, "done", "")] * 2
    assert len(site.obeyed) == 1


def test_a_stranger_is_refused_and_supervision_told(site: Site) -> None:
    payload = site.send(private=Ed25519PrivateKey.generate())
    assert site.results(1) == [("", 0, "refused", "wrong signature")]
    assert site.peer.messages(wire.Result)[0].digest == wire.digest(payload)
    eventually(lambda: site.link.receive() or site.link.refusals)
    assert (site.link.refusals[0].reason, site.link.refusals[0].key) == ("wrong signature", "chief")
    assert site.obeyed == []


@pytest.mark.fault("a flood of strangers' commands", "counted, a few a second answered; the next good one is obeyed")
def test_a_flood_of_strangers_is_counted_but_hardly_answered(site: Site) -> None:
    stranger = Ed25519PrivateKey.generate()
    begin = time.monotonic()
    for seq in range(1, 301):
        site.send(seq, private=stranger)
    site.peer.until(lambda: site.thread.bridge.counters["command refused"] == 300)
    allowed = (time.monotonic() - begin) / 0.2 + 2
    site.send(1)

    def obeyed() -> bool:
        site.supervise()
        return any(result.outcome == "done" for result in site.peer.messages(wire.Result))

    site.peer.until(obeyed)
    assert len(site.peer.messages(wire.Result)) - 1 <= allowed
    for number in range(200):  # names and rubbish of every kind
        site.peer.send("command", wire.encode(wire.Command(key=f"stranger-{number}", body="", signature="")))
        site.peer.send("command", b"{" + b" " * number)
    site.peer.until(lambda: site.thread.bridge.counters["command refused"] == 700)
    eventually(lambda: site.link.receive() or sum(refusal.count for refusal in site.link.refusals) == 700)
    assert {(refusal.reason, refusal.key) for refusal in site.link.refusals} == {
        ("wrong signature", "chief"), ("unknown key", ""), ("malformed", "")}
    assert len(site.link.refusals) < 20


@pytest.mark.fault("a retained command", "refused")
def test_a_retained_command_is_refused(site: Site) -> None:
    site.thread.__exit__()
    now = seconds(time.monotonic_ns())
    order = wire.Order(unit=UNIT, boot=1, seq=1, t=now, id="c-1", name="stop", expires_t=now + 25)
    payload = wire.encode(signed(order, FLEET, "chief", site.chief))
    site.peer.connection.publish(wire.topic(FLEET, UNIT, "command"), payload, 1, retain=True)
    site.thread = BridgeThread(msgspec.structs.replace(site.unit.settings, keys=site.keys), site.unit.said.append)
    assert site.results(1) == [("", 0, "refused", "retained: it may be of any age")]
    assert site.obeyed == []


@pytest.mark.fault("supervision not running when a command comes", "refused, and said")
def test_a_command_without_supervision_is_refused(site: Site) -> None:
    site.link.close()
    site.send()
    assert site.results(1, supervised=False) == [("c-1", 1, "refused", "supervision is not running")]
    site.link = RunLink(site.unit.path)


def test_the_period_of_monitoring_is_lengthened_and_given_back(site: Site) -> None:
    for seq, (value, outcome) in enumerate([(Decimal(10), "done"), (Decimal("0.001"), "refused"), (None, "done")], 1):
        site.send(seq, name="monitor_period", value=value)
        assert site.results(seq)[-1][2] == outcome
    assert site.obeyed == []


def test_a_longer_period_thins_the_monitoring_out(site: Site) -> None:
    site.send(name="monitor_period", value=Decimal(3600))
    site.results(1)
    for number in range(20):
        eventually(lambda: site.link.send_samples(Monitor(UNIT, 1, seconds(0), None, False, "motion", {}, {}, {})))
        site.peer.until(lambda number=number: site.peer.connection.wait(0.02) is not None)  # type: ignore[misc]
    assert len(site.peer.messages(wire.MonitorMessage)) <= 1


@pytest.mark.fault("a key taken out of the file while running", "commands no more, at once")
def test_whoever_is_taken_out_of_the_key_file_commands_no_more(site: Site) -> None:
    site.send(1)
    assert site.results(1)[-1][2] == "done"
    site.keys.write_text("")
    site.send(2)
    assert site.results(2)[-1] == ("", 0, "refused", "unknown key")


@pytest.mark.fault("a command that comes again")
def test_a_restarted_bridge_obeys_nothing_again(site: Site) -> None:
    payload = site.send(5)
    assert site.results(1)[-1][2] == "done"
    site.thread.__exit__()
    site.thread = BridgeThread(msgspec.structs.replace(site.unit.settings, keys=site.keys), site.unit.said.append)
    eventually(lambda: site.thread.bridge.online)
    site.peer.send("command", payload)
    assert site.results(2)[-1] == ("c-5", 5, "done", "")
    site.send(4)
    assert site.results(3)[-1] == ("c-4", 4, "refused", "its counter was used before")
    assert len(site.obeyed) == 1
