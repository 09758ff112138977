"""The computer's own state and the recorder of the traffic, in a running `ucs run` on real SocketCAN."""
from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from hil_tests.conftest import SOON_S, START_S, Process, told
from level1.io.definitions import load
from level1.io.replay import Log
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

UNIT = unit_toml("ucs.dbc", armed=["TrafficLogFailed"], more='[recorder]\npath = "traffic"\nmax_mb = 10')


@pytest.fixture
def run(tmp_path: Path, process: Callable[..., Process]) -> Process:
    """`ucs run`, supervising and recording."""
    file = tmp_path / "unit.toml"
    file.write_text(UNIT)
    started = process("run", file)
    started.expect("; supervising$", START_S)
    return started


def test_the_state_of_the_computer_is_on_the_bus_every_second(run: Process) -> None:
    message = load(["ucs.dbc"]).messages["UCS_HEALTH"]
    stamps: list[float] = []
    with can.Bus(channel="vcan0", interface="socketcan") as bus:
        while len(stamps) < 4:
            heard = bus.recv(SOON_S)
            assert heard is not None
            if heard.arbitration_id == message.can_id:
                stamps.append(heard.timestamp)
    assert all(0.5 < later - earlier < 2 for earlier, later in zip(stamps, stamps[1:], strict=False))
    assert run.stop() == 0


def test_what_was_heard_and_said_can_be_read_from_the_recording(run: Process, tmp_path: Path) -> None:
    sent = [can.Message(arbitration_id=0x321, is_extended_id=False, data=number.to_bytes(2, "big")) for number in range(500)]
    with can.Bus(channel="vcan0", interface="socketcan") as bus:
        for message in sent:
            bus.send(message)
            time.sleep(0.002)
        time.sleep(1.5)
    assert run.stop() == 0
    recording, = (tmp_path / "traffic").glob("*.blf")
    frames = list(Log(recording).frames())
    assert [frame.data for frame in frames if frame.key == 0x321] == [bytes(message.data) for message in sent]
    with can.BLFReader(recording) as reader:
        said = {message.arbitration_id for message in reader if not message.is_rx}
    messages = load(["ucs.dbc"]).messages
    assert said >= {messages["UCS_HEALTH"].can_id, messages["UCS_ALARMS"].can_id}
    assert abs(frames[0].t_ns / 1e9 - time.time()) < 120


@pytest.mark.covers("TrafficLogFailed", "raised", "repair_started", "repaired", "cleared")
def test_a_recorder_that_can_not_write_is_an_alarm_and_begins_anew_when_it_can(run: Process, tmp_path: Path) -> None:
    def chatter(seconds: float) -> None:
        with can.Bus(channel="vcan0", interface="socketcan") as bus:
            for _ in range(int(seconds * 20)):
                bus.send(can.Message(arbitration_id=0x321, is_extended_id=False))
                time.sleep(0.05)
    chatter(1)
    (tmp_path / "traffic").rename(tmp_path / "away")
    (tmp_path / "traffic").write_text("not a folder")
    chatter(6)
    run.expect("traffic recorder .*traffic: not recorded .*trying again", SOON_S)
    run.expect("TrafficLogFailed +raised", SOON_S)
    run.expect("TrafficLogFailed +repair started", SOON_S)
    (tmp_path / "traffic").unlink()
    chatter(8)
    run.expect("traffic recorder .*traffic: works again", SOON_S)
    run.expect("TrafficLogFailed +repaired", SOON_S)
    run.expect("TrafficLogFailed +cleared", SOON_S)
    assert run.stop() == 0
    life = [event.event for event in told(tmp_path, "TrafficLogFailed")]
    assert (life[:2], life[-2:]) == (["raised", "repair_started"], ["repaired", "cleared"])
    assert list((tmp_path / "traffic").glob("*.blf")) and list((tmp_path / "away").glob("*.blf"))
