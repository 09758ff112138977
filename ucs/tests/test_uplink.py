"""The live loop's end of the way to the bridge: alive, never waiting, orders in, answers out."""
from __future__ import annotations

import time
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import cast

import pytest

from bridge.link import Answer, Beside, BridgeLink, Poke, Samples
from level1.command import Order
from level1.event import Event, Monitor, Result
from level1.io.inbox import Inbox
from level1.io.journal import Journal
from ucs.uplink import ALIVE_NS, BESIDE_NS, Uplink

EVENT = Event("a", 1, 1, Decimal(1), None, False, "PilotFlameOut", 3101, "High", "raised", 1, 0, {}, "")
MONITOR = Monitor("a", 1, Decimal(1), None, False, "burners", {}, {}, {})
WAIT_S = 30.0


class Store:
    """What the uplink needs of a journal."""

    def __init__(self, path: Path):
        self.path = path
        self.pending: tuple[Event, ...] = ()


class Ends:
    """Both ends, and a clock that stands until it is told."""

    def __init__(self, folder: Path):
        self.now_ns = 10**9
        self.store = Store(folder / "journal.db")
        self.inbox = Inbox()
        self.bridge = BridgeLink(self.store.path)
        self.uplink = Uplink(cast(Journal, self.store), self.inbox, lambda: self.now_ns)


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[Ends]:
    both = Ends(tmp_path)
    with both.uplink:
        yield both
    both.bridge.close()


def test_events_poke_monitors_and_answers_are_handed_over(ends: Ends) -> None:
    ends.uplink.publish([EVENT], [MONITOR, Result("c1", "done")])
    assert ends.bridge.receive() == [Poke(), Answer(Result("c1", "done")), Samples((MONITOR,))]


def test_a_quiet_unit_still_says_that_supervision_is_alive(ends: Ends) -> None:
    ends.uplink.publish([], [])
    ends.uplink.publish([], [])
    assert ends.bridge.receive() == [Samples()]
    ends.now_ns += ALIVE_NS
    ends.uplink.publish([], [])
    assert ends.bridge.receive() == [Samples()]


def test_events_the_journal_can_not_take_go_beside_it_again_and_again(ends: Ends) -> None:
    ends.store.pending = (EVENT,)
    for _ in range(3):
        ends.uplink.publish([], [])
        ends.now_ns += BESIDE_NS // 2
    assert [message for message in ends.bridge.receive() if isinstance(message, Beside)] == [Beside((EVENT,))] * 2


def test_an_order_comes_in(ends: Ends) -> None:
    assert ends.bridge.instruct(Order("c1", "pause"))
    end = time.monotonic() + WAIT_S
    orders: list[Order] = []
    while not orders and time.monotonic() < end:
        ends.inbox.wait(0.1)
        orders += ends.inbox.take().orders
    assert orders == [Order("c1", "pause")]


def test_without_a_bridge_nothing_waits(tmp_path: Path) -> None:
    with Uplink(cast(Journal, Store(tmp_path / "journal.db")), Inbox(), time.monotonic_ns) as uplink:
        uplink.publish([EVENT], [MONITOR])


