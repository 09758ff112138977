"""An interface on which one hears oneself: one's own frames are left out, those of others that look alike are not."""
from __future__ import annotations

import time
from collections.abc import Iterator

import can
import pytest

from level1.io.python_can import ECHO_NS, PythonCan


class Wire(can.BusABC):
    """Gives back what was sent, and what the test puts in."""

    def __init__(self) -> None:
        self.queue: list[can.Message] = []
        super().__init__(channel="test")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.queue.append(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.queue.pop(0) if self.queue else None


@pytest.fixture
def wire() -> Iterator[Wire]:
    with Wire() as bus:
        yield bus


def send(interface: PythonCan, data: bytes) -> None:
    while not interface.send(0x110, data):
        time.sleep(0.001)


def heard(interface: PythonCan, wire: Wire) -> list[bytes]:
    found = []
    while wire.queue:
        found += [frame.data for frame in interface.receive(0)]
    return found


def test_each_frame_sent_is_left_out_once_and_lost_echoes_are_forgotten(wire: Wire) -> None:
    now_ns = [0]
    interface = PythonCan(wire, lambda: now_ns[0], lambda: now_ns[0], echoes=True)
    for data in (b"a", b"b", b"c"):
        send(interface, data)
    del wire.queue[1]
    wire.queue.insert(1, can.Message(arbitration_id=0x210, is_extended_id=False, data=b"a"))
    wire.queue.append(can.Message(arbitration_id=0x110, is_extended_id=False, data=b"c"))
    assert heard(interface, wire) == [b"a", b"c"], "of another identifier, and sent by another after the echo"
    send(interface, b"d")
    now_ns[0] += ECHO_NS + 1
    assert heard(interface, wire) == [b"d"], "too late to be an echo"


def test_elsewhere_what_looks_like_an_own_frame_is_a_second_talker(wire: Wire) -> None:
    interface = PythonCan(wire, lambda: 0, lambda: 0)
    send(interface, b"a")
    assert heard(interface, wire) == [b"a"]
