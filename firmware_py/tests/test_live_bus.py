"""Nodes on a bus of python-can, which is lost and returns. The clock is the test's."""
from __future__ import annotations

import errno
from collections.abc import Callable
from random import Random
from typing import Any

import can
import pytest

from firmware_py.fault import Statement
from firmware_py.flaming_tool import FlamingTool
from firmware_py.live_bus import BusLost, LiveBus
from firmware_py.mission_controller import MissionController
from firmware_py.participant import BusFrame, Participant
from firmware_py.tests.bench import CODEC, SECOND

COMMAND = CODEC.identifier("FLAMER_CMD")


class Clock:
    """Moves only when somebody waits, and a little with each look."""

    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        self.t_ns += 1000
        return self.t_ns

    def sleep(self, duration_ns: int) -> None:
        self.t_ns += duration_ns


class Wire(can.BusABC):
    """A bus without hardware. fault(t_ns): what it raises at that time, if anything."""

    def __init__(self, clock: Clock, fault: Callable[[int], Exception | None] = lambda t_ns: None):
        super().__init__(channel="test")
        self._clock = clock
        self._fault = fault
        self.incoming: list[can.Message] = []
        self.sent: list[tuple[int, int]] = []

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._check()
        if self.incoming:
            return self.incoming.pop(0)
        self._clock.sleep(round((timeout or 0) * 1e9))
        return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check()
        self.sent.append((self._clock.t_ns, msg.arbitration_id))

    def _check(self) -> None:
        if (error := self._fault(self._clock.t_ns)) is not None:
            raise error


class Live:
    """Tool and mission controller on a wire that `open_bus` gives."""

    def __init__(self, fault: Callable[[int], Exception | None] = lambda t_ns: None, patience_s: float = 10,
                 open_fails: Callable[[int], bool] = lambda t_ns: False, alone: bool = False):
        self.clock = Clock()
        self.tool = FlamingTool("flamer", CODEC, {}, Random(1))
        self.wires: list[Wire] = []
        self.told: list[str] = []
        self.mission = MissionController("mission", CODEC, {}, Random(1))
        nodes: list[Participant] = [self.tool, *([] if alone else [self.mission])]

        def open_bus() -> can.BusABC:
            if open_fails(self.clock.t_ns):
                raise OSError(errno.ENODEV, "No such device")
            self.wires.append(Wire(self.clock, fault))
            return self.wires[-1]
        self.bus = LiveBus(open_bus, "test0", nodes, self.clock, lambda t_ns, text: self.told.append(text),
                           patience_ns=round(patience_s * SECOND))

    def run(self, seconds: float) -> Live:
        self.bus.run(round(seconds * SECOND))
        return self


def down(start_s: float, end_s: float, error: Exception) -> Callable[[int], Exception | None]:
    """A wire that fails for a while."""
    return lambda t_ns: error if start_s * SECOND <= t_ns < end_s * SECOND else None


def test_nodes_talk_at_their_cycle_times() -> None:
    live = Live().run(10)
    sent = [can_id for _, can_id in live.wires[0].sent]
    assert sent.count(COMMAND[0]) == pytest.approx(100, abs=2)
    assert sent.count(CODEC.identifier("FLAMER_STATUS")[0]) == pytest.approx(100, abs=2)


def test_nodes_of_one_process_hear_each_other() -> None:
    live = Live().run(1)
    assert live.tool.safeguard.state == "Ready"
    assert live.tool._commanded_ns is not None


def test_frames_of_others_reach_the_nodes_and_odd_ones_do_not() -> None:
    live = Live(alone=True)
    live.run(0.01)
    wire_data: dict[str, Any] = {"arbitration_id": COMMAND[0], "is_extended_id": False}
    messages = [can.Message(**wire_data, is_remote_frame=True, dlc=4), can.Message(**wire_data, data=bytes(12), is_fd=True),
                can.Message(is_error_frame=True)]
    heard: list[BusFrame] = []
    bus = LiveBus(lambda: _loaded(live.clock, messages), "test0", [live.tool], live.clock, lambda t_ns, text: None,
                  patience_ns=SECOND, on_frame=lambda t_ns, frame: heard.append(frame))
    bus.run(SECOND // 2)
    assert all(frame.can_id != COMMAND[0] for frame in heard)
    bus = LiveBus(lambda: _loaded(live.clock, [can.Message(**wire_data, data=bytes(4))]), "test0", [live.tool], live.clock,
                  lambda t_ns, text: None, patience_ns=SECOND)
    bus.run(SECOND)
    assert live.tool._commanded_ns is not None


@pytest.mark.parametrize(("echoes", "count"), [(True, 1), (False, 2)])
def test_where_one_hears_oneself_each_own_frame_counts_once(echoes: bool, count: int) -> None:
    class Mirror(Wire):
        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            super().send(msg)
            self.incoming.append(msg)

    live = Live(alone=True)
    heard: list[int] = []
    bus = LiveBus(lambda: Mirror(live.clock), "test0", [live.tool], live.clock, lambda t_ns, text: None, patience_ns=SECOND,
                  on_frame=lambda t_ns, frame: heard.append(frame.can_id), echoes=echoes)
    bus.run(SECOND)
    assert heard.count(0x210) // 10 == count


def _loaded(clock: Clock, messages: list[can.Message]) -> Wire:
    wire = Wire(clock)
    wire.incoming += messages
    return wire


@pytest.mark.parametrize("error", [can.CanOperationError("Network is down", 100), OSError(errno.ENODEV, "No such device")])
def test_nodes_survive_a_lost_bus_and_resume(error: Exception) -> None:
    live = Live(down(3, 5, error)).run(10)
    assert len(live.told) == 2
    assert "bus test0 is lost" in live.told[0]
    assert live.told[1] == "bus test0 is back"
    back = [t_ns for wire in live.wires for t_ns, can_id in wire.sent if can_id == COMMAND[0] and t_ns > 5 * SECOND]
    assert back[0] < 6 * SECOND
    assert len(back) == pytest.approx(45, abs=6), "what could not be sent is not sent later"


def test_the_gas_valve_closes_while_the_bus_is_lost() -> None:
    live = Live(down(10, 1e9, OSError(errno.ENETDOWN, "Network is down")), patience_s=60)
    live.run(1)
    live.mission.order(live.clock.t_ns, Statement("flaming", None, "on"))
    live.run(9)
    assert live.tool.plant.flame
    live.run(12)
    assert live.tool.safeguard.state == "CommandsLost"
    assert not live.tool.plant.flame


def test_a_bus_that_stays_away_ends_the_run_with_its_name() -> None:
    with pytest.raises(BusLost, match="bus test0 has been away for 10 s"):
        Live(down(3, 1e9, OSError(errno.ENODEV, "No such device"))).run(60)


def test_a_bus_that_is_missing_at_the_start_is_told_at_once() -> None:
    with pytest.raises(BusLost, match="bus test0 can't be opened: .*No such device"):
        Live(open_fails=lambda t_ns: True).run(60)


def test_an_interface_that_is_gone_for_a_while_is_opened_again() -> None:
    live = Live(down(3, 3.2, OSError(errno.ENODEV, "No such device")), open_fails=lambda t_ns: 3 * SECOND < t_ns < 6 * SECOND)
    live.run(10)
    assert live.told[-1] == "bus test0 is back"
    assert len(live.wires) == 2


@pytest.mark.parametrize("error", [can.CanOperationError("Failed to transmit", errno.ENOBUFS),
                                   can.CanOperationError("Transmit buffer full")])
def test_a_full_queue_drops_frames_and_is_no_lost_bus(error: Exception) -> None:
    live = Live()
    live.bus._open_bus = lambda: _FullWire(live.clock, error)
    live.run(2)
    assert live.told == []
    assert live.bus.dropped > 10


class _FullWire(Wire):
    def __init__(self, clock: Clock, error: Exception):
        super().__init__(clock)
        self._error = error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise self._error
