"""The live loop and its buses: nothing lost silently, nothing sent late, no jump of the wall clock believed."""
from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1.bus_health import Report
from level1.canopen import Device
from level1.catalog import Catalog
from level1.command import Order
from level1.decode import encode
from level1.event import Commanded, Event, Monitor, Result, Send, SentFrame
from level1.frame import ERROR, EXTENDED, REMOTE, Frame, Row, frame_key
from level1.gate import Gate
from level1.health import Reading
from level1.io import live
from level1.io.can import WAITING_SENDS, BusError, Interface, Port, open_bus
from level1.io.config import Bus
from level1.io.definitions import load
from level1.io.host import clock_is_synchronised
from level1.io.inbox import NOTHING, Inbox
from level1.io.listening import Listening
from level1.io.python_can import PythonCan
from level1.io.socketcan import Filter
from level1.io.stamps import PLAUSIBLE_AGE_NS, Stamps
from level1.supervisor import Supervisor

MS = 1_000_000
WAIT_S = 30.0
"""How long a test waits for another thread before it fails; none passes by waiting."""
BUS = Bus("implement", "can0")


class Clock:
    """A clock that stands until it is told."""

    def __init__(self, now_ns: int = 1_000 * MS):
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


class Wire:
    """Stands for a bus of python-can: gives what the script says (a message, None for quiet, an exception to raise), then is
    quiet."""

    def __init__(self, *script: Any, send: Callable[[can.Message], None] | None = None):
        self.script = list(script)
        self.sent: list[can.Message] = []
        self.closed = False
        self._send = send

    def recv(self, timeout: float) -> can.Message | None:
        if not self.script:
            time.sleep(0.001)
            return None
        step = self.script.pop(0)
        if isinstance(step, Exception):
            raise step
        return step  # type: ignore[no-any-return]

    def send(self, message: can.Message, timeout: float) -> None:
        if self._send:
            self._send(message)
        self.sent.append(message)

    def shutdown(self) -> None:
        self.closed = True


class Direct:
    """Stands for an interface with a descriptor, which the loop reads itself."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.heard: list[Frame] = []
        self.filters: Sequence[Filter] | None = None
        self.error: OSError | None = None
        self.full = self.closed = False
        self.lost = self.impossible = 0
        self.last_ns: int | None = None
        self._end, self._other = socket.socketpair()

    def fileno(self) -> int:
        return self._end.fileno()

    def receive(self, bus: int) -> list[Frame]:
        if self.error is not None:
            raise self.error
        frames, self.frames = self.frames, []
        return frames

    def errors(self, bus: int) -> list[Frame]:
        heard, self.heard = self.heard, []
        return heard

    def listen(self, filters: Sequence[Filter] | None) -> None:
        self.filters = filters

    def send(self, key: int, data: bytes) -> bool:
        return not self.full

    def traffic(self) -> None:
        return None

    def close(self) -> None:
        self.closed = True
        self._end.close()
        self._other.close()


class Opener:
    """Opens the wires in turn, through python-can's adapter; an exception in their place is raised."""

    def __init__(self, *wires: Any):
        self.wires = list(wires)

    def __call__(self, settings: Bus, clock: Callable[[], int], wall: Callable[[], int]) -> Interface:
        wire: Any = self.wires.pop(0) if self.wires else Wire()
        if isinstance(wire, Exception):
            raise wire
        return wire if isinstance(wire, Direct) else adapted(wire)


def adapted(wire: Any) -> PythonCan:
    """A wire as the port takes it."""
    return PythonCan(wire, time.monotonic_ns, time.time_ns)


def message(number: int = 1, stamp_s: float = 0.0) -> can.Message:
    return can.Message(timestamp=stamp_s, arbitration_id=0x123, is_extended_id=False, data=[number])


def until(condition: Callable[[], Any]) -> Any:
    """What the condition gives once it holds."""
    end = time.monotonic() + WAIT_S
    while not (value := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.001)
    return value


@pytest.fixture
def started() -> Iterator[Callable[..., tuple[Port, Inbox]]]:
    """Starts a port over the given wires; stopped at the end, when its thread must have ended."""
    ports = []

    def start(*wires: Any, bus: Bus = BUS, index: int = 0) -> tuple[Port, Inbox]:
        inbox = Inbox()
        port = Port(index, bus, inbox, time.monotonic_ns, time.time_ns, Opener(*wires))
        port.start()
        ports.append(port)
        return port, inbox

    yield start
    for port in ports:
        assert port._thread.is_alive()
        port.stop()
        assert not port._thread.is_alive()


def come(stamps: Stamps, stamp_ns: int, now_ns: int, wall_ns: int) -> int:
    """When a frame came, with both clocks read at once."""
    return stamps.monotonic_ns(stamp_ns, now_ns, wall_ns, now_ns)


class TestStamps:
    """Wall-clock stamps become times of the monotonic clock."""

    def test_a_plausible_age_is_believed(self) -> None:
        stamps = Stamps()
        assert come(stamps, 50_000 * MS - 7 * MS, 1_000 * MS, 50_000 * MS) == 993 * MS

    def test_a_stamp_from_the_future_or_of_another_clock_counts_from_now(self) -> None:
        stamps = Stamps()
        for stamp in (50_001 * MS, 0, 50_000 * MS - PLAUSIBLE_AGE_NS):
            assert come(stamps, stamp, 1_000 * MS, 50_000 * MS) == 1_000 * MS

    @pytest.mark.parametrize("jump_ms", [-3_600_000, -300, 300, 3_600_000])
    def test_after_a_jump_of_the_wall_clock_stamps_are_not_believed_for_a_while(self, jump_ms: int) -> None:
        stamps = Stamps()
        assert come(stamps, 50_000 * MS, 1_000 * MS, 50_000 * MS) == 1_000 * MS
        # Stamped 5 ms ago, before the clock jumped.
        assert come(stamps, 50_005 * MS, 1_010 * MS, (50_010 + jump_ms) * MS) == 1_010 * MS
        later = 1_010 * MS + PLAUSIBLE_AGE_NS
        wall = (50_010 + jump_ms) * MS + PLAUSIBLE_AGE_NS
        assert come(stamps, wall - 2 * MS, later, wall) == later - 2 * MS

    def test_an_interruption_between_the_clocks_is_no_jump(self) -> None:
        stamps = Stamps()
        assert come(stamps, 50_000 * MS, 1_000 * MS, 50_000 * MS) == 1_000 * MS
        # 20 ms pass between the look at the wall clock and the one at the monotonic clock.
        assert stamps.monotonic_ns(50_009 * MS, 1_010 * MS, 50_010 * MS, 1_030 * MS) == 1_009 * MS
        assert come(stamps, 50_038 * MS, 1_040 * MS, 50_040 * MS) == 1_038 * MS

    @given(st.lists(st.tuples(st.integers(0, 10**9), st.integers(-10**12, 10**12), st.integers(-10**13, 10**13)), max_size=20))
    def test_no_stamp_lies_in_the_future_or_far_back(self, steps: list[tuple[int, int, int]]) -> None:
        stamps, now, wall = Stamps(), 10**12, 10**15
        for passed, jump, age in steps:
            now, wall = now + passed, wall + passed + jump
            assert now - PLAUSIBLE_AGE_NS < come(stamps, wall - age, now, wall) <= now


class TestInbox:
    def test_the_oldest_frames_are_dropped_and_counted(self) -> None:
        inbox = Inbox(frames=3)
        for number in range(5):
            inbox.put([Frame(number, 1, b"")])
        load = inbox.take()
        assert [frame.t_ns for frame in load.frames] == [2, 3, 4] and load.dropped == 2
        assert inbox.take() == NOTHING

    def test_orders_and_notices_are_never_dropped(self) -> None:
        inbox = Inbox(frames=1)
        for number in range(3):
            inbox.put([Frame(number, 1, b"")])
            inbox.order(Order(str(number), "pause"))
            inbox.notice(str(number))
        load = inbox.take()
        assert [order.id for order in load.orders] == ["0", "1", "2"] and load.notices == ["0", "1", "2"]

    def test_what_comes_ends_a_wait(self) -> None:
        inbox = Inbox()
        threading.Timer(0.01, inbox.wake).start()
        began = time.monotonic()
        inbox.wait(WAIT_S)
        assert time.monotonic() - began < WAIT_S


class TestPort:
    def test_frames_come_with_their_bus_and_time(self, started: Any) -> None:
        extended = can.Message(timestamp=time.time(), arbitration_id=0x18FEF100, data=b"\1\2")
        before = time.monotonic_ns()
        _, inbox = started(Wire(message(5, time.time()), extended), index=2)
        frames: list[Frame] = []

        def both() -> bool:
            frames.extend(inbox.take().frames)
            return len(frames) == 2

        until(both)
        assert [(frame.key, frame.data) for frame in frames] == [
            (frame_key(0x123, False, 2), b"\5"), (frame_key(0x18FEF100, True, 2), b"\1\2")]
        assert all(before - PLAUSIBLE_AGE_NS < frame.t_ns <= time.monotonic_ns() for frame in frames)

    @pytest.mark.parametrize("failure", [
        can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN), OSError(errno.ENODEV, "No such device"),
        RuntimeError("a bug of a driver"), ValueError()])
    def test_a_lost_interface_is_told_opened_anew_and_told_again(self, started: Any, failure: Exception) -> None:
        deaf = Wire(message(1), failure)
        port, inbox = started(deaf, BusError("still gone"), Wire(can.CanOperationError("down")), Wire(message(2)))
        frames: list[Frame] = []
        notices: list[str] = []

        def both() -> bool:
            load = inbox.take()
            frames.extend(load.frames)
            notices.extend(load.notices)
            return len(frames) == 2 and len(notices) == 2

        until(both)
        assert [frame.data for frame in frames] == [b"\1", b"\2"]
        assert notices[0].startswith("bus implement: lost (") and notices[0].endswith("); trying again")
        assert notices[1].startswith("bus implement: back after ")
        assert deaf.closed and not port.is_lost and port.counters["lost"] == 1

    def test_an_error_that_only_sending_meets_makes_the_reader_open_anew(self, started: Any) -> None:
        def fail(_: can.Message) -> None:
            raise can.CanOperationError("Failed to transmit: No such device", errno.ENODEV)

        port, inbox = started(Wire(send=fail), Wire(message(7)))
        port.send(send(0, 10**18), 0)
        assert until(lambda: inbox.take().frames)[0].data == b"\7"
        assert port.counters["failed"] == 1 and port.counters["lost"] == 1

    def test_a_frame_that_can_not_be_is_counted(self, started: Any) -> None:
        port, inbox = started(Wire(can.Message(arbitration_id=0x123, data=bytes(12)), message()))
        assert len(until(lambda: inbox.take().frames)) == 1 and until(lambda: port.counters["impossible"]) == 1

    def test_python_cans_own_interfaces_work(self, started: Any) -> None:
        bus = Bus("virtual", "test_live", interface="virtual")
        inbox = Inbox()
        port = Port(0, bus, inbox, time.monotonic_ns, time.time_ns)
        port.start()
        with can.Bus("test_live", interface="virtual") as other:
            other.send(message(9))
            assert until(lambda: inbox.take().frames)[0].data == b"\x09"
            port.send(send(0, 10**18, key=0x18FEF100 | EXTENDED), 0)
            received = other.recv(WAIT_S)
        port.stop()
        assert received and received.arbitration_id == 0x18FEF100 and received.is_extended_id


class TestDirectPort:
    """An interface with a descriptor: the loop reads it, the bus's thread looks after it."""

    def reports(self, inbox: Inbox, wanted: int) -> list[tuple[str, bool]]:
        """So many reports, as soon as they are there."""
        got: list[tuple[str, bool]] = []

        def enough() -> bool:
            got.extend((report.alarm, report.present) for report in inbox.take().reports)
            return len(got) >= wanted
        until(enough)
        return got

    def test_a_loop_that_is_late_is_helped_out(self, started: Any) -> None:
        wire = Direct()
        _, inbox = started(wire)
        wire.frames.append(Frame(1, 0x123, b""))
        assert until(lambda: inbox.take().frames) == [Frame(1, 0x123, b"")]

    def test_an_interface_lost_while_the_loop_reads_is_reported_and_opened_anew(self, started: Any) -> None:
        wire, anew = Direct(), Direct()
        port, inbox = started(wire, BusError("still gone"), anew)
        wire.error = OSError(errno.ENETDOWN, "Network is down")
        assert port.fetch() == []
        assert self.reports(inbox, 2) == [("CanBusDown", True), ("CanBusDown", False)]
        assert wire.closed and not port.is_lost
        anew.frames.append(Frame(1, 0x123, b""))
        assert port.fetch() or until(lambda: inbox.take().frames)

    def test_the_filters_hold_after_it_was_opened_anew(self, started: Any) -> None:
        wire, anew = Direct(), Direct()
        port, inbox = started(wire, anew)
        port.listen(Listening(((1, 2),), lambda can_id: None))
        wire.error = OSError(errno.ENODEV, "No such device")
        self.reports(inbox, 2)
        assert wire.filters == anew.filters == ((1, 2),)

    def test_error_frames_are_understood_and_handed_on(self, started: Any) -> None:
        wire = Direct()
        port, inbox = started(wire)
        wire.heard.append(Frame(5, ERROR | 0x40, bytes(8)))
        load_ = until(lambda: next((load_ for load_ in [inbox.take()] if load_.reports), None))
        assert load_.reports[0].alarm == "CanBusOff" and load_.reports[0].t_ns == 5 and port.state == "BusOff"
        wire.last_ns = 6
        assert self.reports(inbox, 1) == [("CanBusOff", False)]

    def test_frames_lost_on_the_way_in_and_out_are_reported(self, started: Any) -> None:
        wire = Direct()
        port, inbox = started(wire)
        wire.lost = 7
        assert self.reports(inbox, 1) == [("FramesLost", True)] and port.counters["lost on the way in"] == 7
        wire.full = True
        port.send(send(0, 5), 0)
        assert port.flush(6) is None
        assert ("SendFailed", True) in self.reports(inbox, 1) + self.reports(inbox, 1)


def send(t_ns: int, expires_ns: int, number: int = 0, key: int = 0x110) -> Send:
    return Send(t_ns, key, bytes([number]), "FLAMER_CMD", "test", expires_ns)


def gone(port: Port, now_ns: int) -> None:
    """Wait until nothing waits: the thread that sends may find the time later than the port looks."""
    until(lambda: port.flush(now_ns) is None)


class TestSending:
    """Out of the loop's thread, never waiting, never late."""

    def port(self, wire: Any) -> Port:
        port = Port(0, BUS, Inbox(), Clock(), Clock(), Opener(wire))
        if wire is not None:
            port._adopt(adapted(wire))
        return port

    def test_frames_go_out_in_order(self) -> None:
        wire = Wire()
        port = self.port(wire)
        for number in range(3):
            port.send(send(0, 10, number), 0)
        gone(port, 0)
        assert [bytes(sent.data)[0] for sent in wire.sent] == [0, 1, 2] and port.counters == {"sent": 3}

    def test_the_question_of_node_guarding_is_a_remote_frame(self) -> None:
        wire = Wire()
        port = self.port(wire)
        port.send(Send(0, frame_key(0x72A, False) | REMOTE, b"\0", "node guarding", "CANopen", 10), 0)
        gone(port, 0)
        sent, = wire.sent
        assert (sent.arbitration_id, sent.is_remote_frame, sent.dlc, sent.is_extended_id) == (0x72A, True, 1, False)

    def test_a_driver_that_hangs_holds_nobody_up_and_what_it_sends_at_last_is_sent_once(self) -> None:
        hangs = threading.Event()
        wire = Wire(send=lambda _: None if hangs.wait(WAIT_S) else None)
        port = self.port(wire)
        port.send(send(0, 10, 1), 0)
        assert port.flush(0) is not None and wire.sent == []
        hangs.set()
        gone(port, 0)
        assert [bytes(sent.data)[0] for sent in wire.sent] == [1] and port.counters == {"sent": 1}

    @pytest.mark.parametrize("full", [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"), can.CanTimeoutError("busy"), OSError(errno.EAGAIN, "busy")])
    def test_a_full_buffer_is_tried_again_until_the_frame_expires(self, full: Exception) -> None:
        failures = [full] * 3

        def busy(_: can.Message) -> None:
            if failures:
                raise failures.pop()

        wire = Wire(send=busy)
        port = self.port(wire)
        port.send(send(0, 5 * MS, 1), 0)
        assert port.flush(1 * MS) == 2 * MS
        assert port.flush(2 * MS) == 3 * MS
        port.send(send(3 * MS, 9 * MS, 2), 3 * MS)
        gone(port, 3 * MS)
        assert [bytes(sent.data)[0] for sent in wire.sent] == [1, 2]

    def test_what_is_past_its_time_is_dropped_and_counted(self) -> None:
        wire = Wire()
        port = self.port(None)
        port.send(send(0, 5 * MS, 1), 0)
        port.send(send(0, 50 * MS, 2), 0)
        port._adopt(adapted(wire))
        gone(port, 5 * MS + 1)
        assert [bytes(sent.data)[0] for sent in wire.sent] == [2]
        assert port.counters == {"expired": 1, "sent": 1}

    def test_a_lost_interface_holds_a_bounded_number_of_frames(self) -> None:
        port = self.port(None)
        for _ in range(WAITING_SENDS + 5):
            port.send(send(0, 10**18), 0)
        assert port.counters == {"dropped": 5}


class TestOpening:
    """One line that says what to do."""

    def test_an_unknown_interface(self) -> None:
        with pytest.raises(BusError, match=r'^bus b: no interface is called "socketkan"; did you mean "socketcan"\?$'):
            open_bus(Bus("b", "can0", interface="socketkan"), time.monotonic_ns, time.time_ns)

    @pytest.mark.parametrize(("channel", "advice"), [
        ("vcan9", "there is no interface vcan9; create it: ip link add vcan9 type vcan && ip link set vcan9 up"),
        ("can9", "there is no interface can9; plug the adapter in .*ip link set can9 up type can bitrate 250000"),
    ])
    def test_a_missing_interface_or_a_kernel_without_can(self, channel: str, advice: str) -> None:
        with pytest.raises(BusError, match=f"^bus b: ({advice}|this kernel has no SocketCAN .*: modprobe can-raw)$"):
            open_bus(Bus("b", channel), time.monotonic_ns, time.time_ns)

    def test_options_an_interface_does_not_take(self) -> None:
        with pytest.raises(BusError, match="^bus b: slcan /nowhere can't be opened: .*; check the adapter") as caught:
            open_bus(Bus("b", "/nowhere", interface="slcan"), time.monotonic_ns, time.time_ns)
        assert "\n" not in str(caught.value)


class Journal:
    """Records in what order things happened."""

    def __init__(self, log: list[Any]):
        self.log = log
        self.fault: str | None = None
        self.incidents: tuple[str, ...] = ()
        self.commands: list[Commanded] = []

    def append(self, events: Sequence[Event], state: bytes, commands: Sequence[Commanded] = ()) -> bool:
        live.decode_state(state)
        self.commands += commands
        self.log.append(("journal", [event.event for event in events]))
        return self.fault is None

    def record(self, monitors: Sequence[Monitor]) -> None:
        self.log.append(("history", [monitor.message for monitor in monitors]))


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return load(["flaming_tool.dbc"])


@pytest.fixture(scope="module")
def own() -> Catalog:
    """The alarms of the UCS itself."""
    return load(["ucs.dbc"])


class Unit:
    """A live loop over the flaming tool's definitions, with clocks that stand; `log` is what happened, in order."""

    def __init__(self, catalog: Catalog, monitor_ns: int | None = None, nap: Callable[[float], None] = time.sleep, **more: Any):
        self.catalog = catalog
        self.clock, self.wall = Clock(), Clock(1_700_000_000_000 * MS)
        self.log: list[Any] = []
        self.wire = Wire(send=lambda sent: self.log.append(("bus", sent.arbitration_id, bytes(sent.data))))
        self.inbox = Inbox(frames=100)
        self.port = Port(0, BUS, self.inbox, self.clock, self.wall, Opener(self.wire))
        self.port._adopt(adapted(self.wire))
        self.journal = Journal(self.log)
        supervisor = Supervisor(catalog, unit="a", boot=1, start_ns=self.clock(), monitor_ns=monitor_ns, **more)
        self.live = live.Live(supervisor, self.journal, [self.port], self.inbox, clock=self.clock, wall=self.wall,
                              told=lambda event: self.log.append(("told", event)),
                              notice=lambda text: self.log.append(("notice", text)), link=self, nap=nap)

    def publish(self, events: Sequence[Event], outputs: Sequence[Monitor | Result]) -> None:
        self.log.extend(("heads up", event.event) for event in events)
        self.log.extend(("link", output) for output in outputs)

    def status(self, t_ns: int, **raws: int) -> None:
        """A FLAMER_STATUS that came at t_ns; flaming with the pilot flame out unless said otherwise."""
        payload = encode(self.catalog.messages["FLAMER_STATUS"], {"Flaming": 1, "PilotFlame": 0, "Safeguard": 4} | raws, None)
        self.inbox.put([Frame(t_ns, 0x210, payload)])

    def turn_at(self, ms: float) -> list[Any]:
        """What happened in a turn at that time."""
        self.clock.now_ns = round(ms * MS)
        before = len(self.log)
        self.live.turn(0)
        return self.log[before:]

    def told(self) -> list[tuple[float, str]]:
        return [(float(event.t), event.event) for kind, event in (entry for entry in self.log if entry[0] == "told")]


class TestLive:
    def test_an_event_is_durable_before_a_frame_leaves_and_before_anyone_hears(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.turn_at(1_000)
        for ms in range(1_000, 1_400, 100):
            unit.status(ms * MS)
        happened = unit.turn_at(1_310)
        journal = happened.index(("journal", ["raised", "repair_started"]))
        assert all(entry[0] != "told" for entry in happened[:journal])
        commands = [place for place, entry in enumerate(happened) if entry[:2] == ("bus", 0x110)]
        upward = happened.index(("heads up", "raised"))
        told = [place for place, entry in enumerate(happened) if entry[0] == "told"]
        assert commands and told and journal < min(commands) and max(commands) < upward < min(told)

    def test_a_deadline_counts_at_its_own_time_however_late_it_is_served(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.status(1_000 * MS)
        unit.turn_at(1_001)
        unit.status(1_250 * MS)
        unit.turn_at(1_251)
        unit.turn_at(1_301)  # too early by the time a frame may be late
        assert unit.told() == []
        unit.turn_at(1_340)
        assert unit.told()[0] == (1.3, "raised")

    def test_a_frame_stamped_before_a_deadline_that_comes_a_moment_after_it_still_counts(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        for ms in range(1_000, 1_300, 100):
            unit.status(ms * MS)
        unit.turn_at(1_201)
        unit.turn_at(1_300.5)
        unit.status(1_299 * MS, PilotFlame=1)
        unit.turn_at(1_301)
        unit.turn_at(1_400)
        assert unit.told() == []

    def test_it_waits_until_the_next_deadline_and_no_longer_than_a_second(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        assert unit.live.patience_s() == pytest.approx(live.LAG_NS / 1e9), "the time line begins now"
        unit.turn_at(1_002)
        unit.status(1_002 * MS)
        unit.turn_at(1_003)
        due = unit.live.supervisor.next_deadline()
        assert due is not None and due <= 1_302 * MS
        assert unit.live.patience_s() == pytest.approx((due + live.LAG_NS - unit.clock()) / 1e9)
        unit.clock.now_ns = due - 5_000 * MS
        assert unit.live.patience_s() == live.LONGEST_WAIT_S
        unit.clock.now_ns = due + 5_000 * MS
        assert unit.live.patience_s() == 0

    def test_frames_of_several_buses_are_put_in_order(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.turn_at(1_002)
        unit.status(1_100 * MS)
        unit.status(1_050 * MS)
        unit.turn_at(1_101)
        assert unit.live.supervisor.counters["time stamps that ran backwards"] == 0

    def test_a_frame_the_interface_can_not_take_now_is_tried_again_soon(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.port._adopt(None)
        unit.turn_at(1_003)
        assert not [entry for entry in unit.log if entry[0] == "bus"]
        assert unit.live.patience_s() <= 0.001
        unit.port._adopt(adapted(unit.wire))
        assert [entry[1] for entry in unit.turn_at(1_004)] == [0x650]

    def test_a_device_is_asked_through_the_gate_which_lets_nothing_pass_that_writes(self, own: Catalog) -> None:
        unit = Unit(own, devices=[Device(0, 42, history=True)])
        unit.turn_at(1_002)
        read, write = bytes([0x40, 0x03, 0x10, 0, 0, 0, 0, 0]), bytes([0x2F, 0x03, 0x10, 0, 0, 0, 0, 0])
        for data in (write, read):
            unit.inbox.ask(0, 0x62A, data)
        assert [entry for entry in unit.turn_at(1_004) if entry[0] == "bus" and entry[1] >= 0x580 and entry[1] < 0x680] == [
            ("bus", 0x62A, read)]
        assert unit.live.supervisor.counters["frames refused by the gate"] == 1

    def test_an_order_is_answered_upward_and_its_effect_stored(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.turn_at(1_002)
        unit.inbox.order(Order("c1", "pause"))
        happened = unit.turn_at(1_010)
        assert happened[0] == ("journal", []) and ("link", Result("c1", "done", "")) in happened

    def test_a_command_is_journaled_with_its_frames_and_what_came_of_it(self) -> None:
        unit = Unit(load(["vehicle.dbc"]))
        unit.turn_at(1_002)
        unit.inbox.order(Order("c1", "reduce_speed", value=Decimal(2), by="chief", called="c-17"))
        unit.inbox.order(Order("c2", "reduce_speed", expires_ns=1_007 * MS))
        unit.turn_at(1_010)
        done, late = unit.journal.commands
        assert (done.command, done.value, done.by, done.id, done.outcome) == ("reduce_speed", Decimal(2), "chief", "c-17", "done")
        frame, = [entry for entry in unit.log if entry[0] == "bus" and entry[1] == 0x100]
        assert done.frames == (SentFrame("VEHICLE_CMD", "100", frame[2].hex().upper()),)
        assert (late.id, late.outcome, late.frames) == ("c2", "refused", ())
        assert late.reason == "expired before supervision could obey it"

    def test_monitoring_goes_upward_and_then_into_the_history_without_a_commit(self, catalog: Catalog) -> None:
        unit = Unit(catalog, monitor_ns=250 * MS)
        unit.turn_at(1_002)
        unit.status(1_003 * MS)
        happened = unit.turn_at(1_253)
        assert {entry[1].message for entry in happened if entry[0] == "link"} == {"implement", "burners"}
        assert not [entry for entry in happened if entry[0] == "journal"]
        assert happened[-1] == ("history", ["implement", "burners"])

    def test_utc_is_a_label_that_follows_the_wall_clock(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.turn_at(1_000)
        unit.wall.now_ns = 1_800_000_000_000 * MS
        for ms in range(1_000, 1_400, 100):
            unit.status(ms * MS)
        unit.turn_at(1_310)
        raised = next(event for kind, event in (entry for entry in unit.log if entry[0] == "told"))
        assert raised.utc == "2027-01-15T07:59:59.990000Z" and float(raised.t) == 1.3

    def test_what_befalls_the_journal_is_told_once(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.journal.incidents = ("the journal was corrupt",)
        unit.journal.fault = "the disk is full"
        told = [unit.turn_at(1_000 + 100 * step) for step in range(2)]
        unit.journal.fault = None
        told.append(unit.turn_at(1_200))
        assert [text for turn in told for kind, text, *_ in turn if kind == "notice"] == [
            "the journal was corrupt", "the disk is full", "the journal works again; nothing waits in memory"]

    def test_dropped_frames_are_told(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        for step in range(150):
            unit.status(1_000 * MS + step)
        happened = unit.turn_at(1_001)
        assert happened[0] == ("notice", "50 frames dropped, the oldest first: supervision can't keep up")
        assert unit.live.dropped == 50

    def test_frames_of_an_interface_with_a_descriptor_are_fetched_by_the_loop(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        unit.turn_at(1_000)
        wire = Direct()
        unit.port._adopt(wire)
        for ms in range(1_000, 1_400, 100):
            wire.frames.append(Frame(ms * MS, 0x210, encode(
                catalog.messages["FLAMER_STATUS"], {"Flaming": 1, "PilotFlame": 0, "Safeguard": 4}, None)))
        unit.turn_at(1_310)
        assert unit.told()[0] == (1.3, "raised")

    def test_what_the_last_boot_left_of_a_bus_is_over_unless_it_is_reported_again(self, own: Catalog) -> None:
        first = Supervisor(own, unit="a", boot=1, start_ns=0)
        first.tick(0)
        for bus in ("implement", "gone"):
            first.report(0, "CanBusDown", bus, True, {"Bus": bus}, "")
        first.tick(1)
        unit = Unit(own, restored=first.state())
        unit.inbox.report([Report(1_000 * MS, "CanBusDown", "implement", True, {"Bus": "implement"}, "still")])
        unit.turn_at(1_003)
        causes = unit.live.supervisor.causes("CanBusDown")
        assert list(causes) == ["implement"]
        unit.inbox.report([Report(1_500 * MS, "CanBusDown", "implement", False, {"Bus": "implement"}, "")])
        unit.turn_at(1_503)
        cleared = [event for kind, event in (entry for entry in unit.log if entry[0] == "told") if event.event == "cleared"][-1]
        assert cleared.values == {"Bus": "implement", "AwaySeconds": 0.5} and float(cleared.t) == 1.5

    @pytest.mark.parametrize(("turn_ms", "raised_s"), [(1_400, 1.5), (1_520, 1.518)], ids=["late loop", "late thread"])
    def test_what_befalls_a_bus_stands_at_its_time_and_the_bus_was_away_between_its_events(
            self, own: Catalog, turn_ms: int, raised_s: float) -> None:
        unit = Unit(own, monitor_ns=6 * MS)  # something is due every 6 ms
        unit.turn_at(turn_ms)
        unit.inbox.report([Report(1_500 * MS, "CanBusDown", "implement", True, {"Bus": "implement"}, "lost")])
        unit.turn_at(2_000)
        unit.inbox.report([Report(2_600 * MS, "CanBusDown", "implement", False, {"Bus": "implement"}, "lost")])
        unit.turn_at(3_000)
        raised, cleared = (event for kind, event in (entry for entry in unit.log if entry[0] == "told"))
        assert (float(raised.t), float(cleared.t)) == (raised_s, 2.6)
        assert cleared.values["AwaySeconds"] == round(float(cleared.t - raised.t), 3)

    def test_all_that_was_not_sent_while_the_alarm_stood_stands_in_its_clearing(self, own: Catalog) -> None:
        unit = Unit(own)
        for ms, present, lost in ((1_000, True, 2), (1_500, False, 3), (2_000, True, 1), (2_750, False, 4)):  # clears after 2 s
            detail = {"Bus": "implement", "NotSent": {"CMD": lost}}
            unit.inbox.report([Report(ms * MS, "SendFailed", "implement", present, detail, "")])
            unit.turn_at(ms + 3)
        unit.turn_at(5_000)
        raised, cleared = (event for kind, event in (entry for entry in unit.log if entry[0] == "told"))
        assert (raised.values["NotSent"], cleared.values["NotSent"]) == ({"CMD": 2}, {"CMD": 7})

    def test_dropped_frames_are_an_alarm_that_counts_them(self, own: Catalog) -> None:
        unit = Unit(own)
        unit.turn_at(1_000)
        unit.inbox.put([Frame(1_001 * MS, 0x123, b"")] * 150)
        unit.turn_at(1_002)
        for ms in range(1_100, 13_000, 100):
            unit.turn_at(ms)
        told = [event for kind, event in (entry for entry in unit.log if entry[0] == "told") if event.alarm == "FramesLost"]
        assert [event.event for event in told] == ["raised", "cleared"] and told[1].values == {"Frames": 50}

    def test_it_follows_the_address_that_the_ucs_claims(self, catalog: Catalog) -> None:
        unit = Unit(catalog, j1939={0: 0x80})
        wire = Direct()
        unit.port._adopt(wire)
        unit.turn_at(1_002)
        assert wire.filters is not None and (EXTENDED | 0x80, 0xC000_00FF) in wire.filters

    def test_orders_of_repairs_to_the_ucs_itself_are_obeyed_where_they_are_sent(self, own: Catalog) -> None:
        class Part:
            """Stands for the recorder or the receiver."""

            def __init__(self) -> None:
                self.asked = 0

            def reopen(self) -> None:
                self.asked += 1

            def record(self, frames: Sequence[Row] | Sequence[Send]) -> None:
                pass

            def take(self) -> Sequence[Reading]:
                return ()

            def utc_offset_ns(self) -> int | None:
                return None
        log = Part()
        unit, gnss = Unit(own), Part()
        unit.live._recorder, unit.live._gnss = log, gnss
        supervisor = unit.live.supervisor
        supervisor.gate = Gate(own, supervisor.sendable(), frozenset({"UCS_HEALTH"}))
        calm = {"TrafficLog": 0, "TimeSync": 1}
        unit.turn_at(1_000)
        for second in range(2, 200):
            raws = calm if second < 10 else {"TrafficLog": 1, "TimeSync": 0}
            unit.live._deliver(list(supervisor.publish(second * 1_000 * MS, "UCS_HEALTH", raws)))
            assert (log.asked, gnss.asked) == (int(second >= 12) + (second >= 30) + (second >= 48), int(second >= 130))

    def test_on_a_busy_bus_it_naps_and_on_a_quiet_one_it_does_not(self, catalog: Catalog) -> None:
        naps: list[float] = []
        unit = Unit(catalog, nap=naps.append)
        for ms in (1_000, 1_001, 1_002):
            unit.status(ms * MS)
            unit.turn_at(ms)
        unit.clock.now_ns += MS // 10
        unit.live.turn(1.0)
        assert naps == [(live.NAP_NS - MS // 10) / 1e9] and naps[0] <= 0.001
        naps.clear()
        for ms in (1_100, 1_200, 1_300):
            unit.status(ms * MS)
            unit.turn_at(ms)
        unit.inbox.wake()
        unit.live.turn(1.0)
        assert naps == []

    def test_it_stops_and_stores_the_state(self, catalog: Catalog) -> None:
        unit = Unit(catalog)
        threading.Timer(0.02, unit.live.stop).start()
        unit.live.run()
        assert unit.log[-1] == ("journal", [])


def test_the_state_of_another_version_is_an_error() -> None:
    import msgspec
    with pytest.raises(msgspec.DecodeError):
        live.decode_state(b'{"unknown":1}')


def test_the_kernel_knows_whether_the_clock_is_synchronised() -> None:
    assert clock_is_synchronised() in (True, False)
