"""A bus that is missing, goes down, or is taken away and comes back, seen by `ucs run` on real SocketCAN."""
from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from hil_tests.conftest import SOON_S, START_S, Process, flamer_status, lose_the_flame
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan


@pytest.fixture
def unit(tmp_path: Path) -> Callable[[str], Path]:
    """Writes a unit.toml for a channel."""

    def write(channel: str) -> Path:
        file = tmp_path / f"{channel}.toml"
        file.write_text(unit_toml("flaming_tool.dbc", channel=channel))
        return file

    return write


@pytest.fixture
def remake() -> Iterator[Callable[[], None]]:
    """Takes vcan0 away when called; makes it anew when called again, and at the end if need be."""
    gone = False

    def link(*words: str) -> None:
        subprocess.run(["ip", "link", *words], check=True)

    def toggle() -> None:
        nonlocal gone
        if gone:
            link("add", "vcan0", "type", "vcan")
            link("set", "vcan0", "mtu", "72", "up")
        else:
            link("del", "vcan0")
        gone = not gone

    yield toggle
    if gone:
        toggle()


@pytest.mark.parametrize("away", ["down", "deleted"])
def test_a_bus_that_comes_back_is_heard_again_without_a_restart(
        away: str, process: Callable[..., Process], unit: Callable[[str], Path], set_link: Callable[[str, bool], None],
        remake: Callable[[], None]) -> None:
    run = process("run", unit("vcan0"))
    run.expect("; supervising$", START_S)
    if away == "down":
        set_link("vcan0", False)
    else:
        remake()
    run.expect("bus implement: lost .*trying again", SOON_S)
    if away == "down":
        set_link("vcan0", True)
    else:
        remake()
    run.expect("bus implement: back after", SOON_S)
    with can.Bus(channel="vcan0", interface="socketcan") as bus:
        lose_the_flame(run, lambda can_id, data: bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=data)))
    assert run.stop() == 0


def test_a_missing_interface_and_one_that_is_down_say_what_to_do(
        process: Callable[..., Process], unit: Callable[[str], Path], set_link: Callable[[str, bool], None]) -> None:
    missing = process("run", unit("vcan7"))
    assert missing.wait(START_S) == 2
    assert missing.err == ["ucs: bus implement: there is no interface vcan7; create it: ip link add vcan7 type vcan && "
                           "ip link set vcan7 up"]
    set_link("vcan0", False)
    down = process("run", unit("vcan0"))
    assert down.wait(START_S) == 2
    assert down.err == ["ucs: bus implement: the interface vcan0 is down; bring it up: ip link set vcan0 up"]


@pytest.mark.parametrize("away", ["down", "deleted"])
def test_nodes_on_a_bus_that_goes_away_survive_and_go_on_when_it_is_back(
        away: str, process: Callable[..., Process], set_link: Callable[[str, bool], None], remake: Callable[[], None]) -> None:
    message = flamer_status()
    node = process("simulate", "healthy.toml", "--bus", "vcan0", "--duration", "1 min")
    node.expect("flaming on", START_S)
    set_link("vcan0", False) if away == "down" else remake()
    node.expect("bus vcan0 is lost .*the nodes live on and try again", SOON_S)
    set_link("vcan0", True) if away == "down" else remake()
    node.expect("bus vcan0 is back", SOON_S)
    with can.Bus(channel="vcan0", interface="socketcan", can_filters=[{"can_id": message.can_id, "can_mask": 0x7FF}]) as bus:
        assert bus.recv(SOON_S) is not None, "it sends again"
    assert node.stop() == 0


def test_nodes_give_up_on_a_bus_that_stays_away_and_say_so(
        process: Callable[..., Process], set_link: Callable[[str, bool], None]) -> None:
    node = process("simulate", "healthy.toml", "--bus", "vcan0", "--patience", "1 s")
    node.expect("flaming on", START_S)
    set_link("vcan0", False)
    assert node.wait(10) == 2
    assert "vcan0" in node.err[-1]
