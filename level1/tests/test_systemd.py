"""sd_notify(3): what a service tells, and how often."""
from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from level1.io.systemd import Supervised


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        yield listening


def heard(listening: socket.socket) -> list[str]:
    found = []
    while True:
        try:
            found.append(listening.recv(1000).decode())
        except BlockingIOError:
            return found


def test_ready_alive_and_stopping_reach_systemd(systemd: socket.socket) -> None:
    service = Supervised({"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "7"}, pid=7)
    service.ready("supervising tractor-7")
    for now_ms in range(0, 2001, 100):
        service.alive(now_ms * 1_000_000)
    service.stopping()
    assert heard(systemd) == ["READY=1\nSTATUS=supervising tractor-7", "WATCHDOG=1", "WATCHDOG=1", "WATCHDOG=1", "STOPPING=1"]


@pytest.mark.parametrize("environ", [
    {"WATCHDOG_PID": "8", "WATCHDOG_USEC": "3000000"},
    {"WATCHDOG_USEC": "often"},
    {},
])
def test_no_sign_of_life_where_none_is_asked_for(systemd: socket.socket, environ: dict[str, str]) -> None:
    service = Supervised({"NOTIFY_SOCKET": systemd.getsockname(), **environ}, pid=7)
    service.alive(10**12)
    assert heard(systemd) == []


def test_without_systemd_or_with_one_that_went_away_nothing_happens(tmp_path: Path) -> None:
    for environ in ({}, {"NOTIFY_SOCKET": str(tmp_path / "gone")}, {"NOTIFY_SOCKET": "@ucs-test-nobody"}):
        service = Supervised({**environ, "WATCHDOG_USEC": "1000000"})
        service.ready("")
        service.alive(0)
        service.stopping()
