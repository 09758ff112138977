"""The short way between `ucs run` and the bridge: neither waits for the other, neither minds the other's end."""
from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from bridge.link import Answer, Beside, BridgeLink, Instruct, LocalEnd, Poke, RunLink, Samples
from level1.command import Order
from level1.event import Event, Monitor, Result, seconds

MONITOR = Monitor("tractor-7", 1, seconds(5), None, False, "burners", {"a": 1}, {"a": 0.0}, {})
ORDER = Order("c-1", "pause")
EVENT = Event("tractor-7", 1, 1, seconds(1), None, False, "PilotFlameOut", 3101, "High", "raised", 1, 0, {}, "")


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    return tmp_path / "journal.db"


@pytest.fixture
def ends(journal: Path) -> Iterator[tuple[RunLink, BridgeLink]]:
    run, bridge = RunLink(journal), BridgeLink(journal)
    yield run, bridge
    run.close()
    bridge.close()


def test_messages_arrive_as_they_were_sent(ends: tuple[RunLink, BridgeLink]) -> None:
    run, bridge = ends
    assert run.poke() and run.send_samples(MONITOR) and run.send_beside((EVENT,)) and run.answer(Result("c-1", "done"))
    assert bridge.receive() == [Poke(), Samples((MONITOR,)), Beside((EVENT,)), Answer(Result("c-1", "done"))]
    assert bridge.instruct(ORDER)
    assert run.receive() == [Instruct(ORDER)]
    assert run.receive() == []


def test_nobody_at_the_other_end_is_told_and_no_error(journal: Path) -> None:
    run = RunLink(journal)
    assert not run.poke()
    run.close()
    assert not journal.with_name("journal.db.run.sock").exists()


@pytest.mark.parametrize("value", ['"Infinity"', '"NaN"', "1E+999999999", '"1E+99999999999999999999"'])
def test_an_order_with_a_value_that_nobody_can_reckon_with_does_not_reach_supervision(journal: Path, value: str) -> None:
    run, stranger = LocalEnd(journal), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    good = msgspec.json.encode(Instruct(ORDER))
    for datagram in (good.replace(b'"value":null', f'"value":{value}'.encode()), good):
        stranger.sendto(datagram, str(journal.with_name("journal.db.local.sock")))
    assert run.receive() == [Instruct(ORDER)] and run.malformed == 1
    run.close()
    stranger.close()


def test_an_end_that_was_killed_is_replaced(journal: Path, ends: tuple[RunLink, BridgeLink]) -> None:
    run, _ = ends
    successor = BridgeLink(journal)
    assert run.poke()
    assert successor.receive() == [Poke()]
    successor.close()


def test_a_full_socket_does_not_hold_up_the_sender(ends: tuple[RunLink, BridgeLink]) -> None:
    run, bridge = ends
    taken = sum(run.poke() for _ in range(5000))
    assert 0 < taken < 5000
    while bridge.receive():
        pass
    assert run.poke()


def test_malformed_datagrams_are_counted_and_left_out(journal: Path, ends: tuple[RunLink, BridgeLink]) -> None:
    _, bridge = ends
    stranger = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    here = os.getcwd()
    os.chdir(journal.parent)
    for datagram in (b"", b"{}", b"\xff", b'{"type":"Poke"', b'{"type":"Poke"}'):
        stranger.sendto(datagram, "journal.db.bridge.sock")
    os.chdir(here)
    stranger.close()
    assert bridge.receive() == [Poke()]
    assert bridge.malformed == 4


def test_a_long_path_is_no_obstacle(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    run, bridge = RunLink(folder / "journal.db"), BridgeLink(folder / "journal.db")
    assert run.poke()
    run.close()
    bridge.close()


def test_only_the_owner_may_send_orders(journal: Path, ends: tuple[RunLink, BridgeLink]) -> None:
    mode = journal.with_name("journal.db.run.sock").stat().st_mode
    assert stat.S_IMODE(mode) == 0o600
