"""What befalls a bus becomes causes of alarms: each there while it is, once, with what was lost."""
from __future__ import annotations

from collections.abc import Iterable

import pytest

from level1.bus_health import ALARMS, ERROR_BURST, QUIET_WINDOWS, WINDOW_NS, BusHealth, Report, Tolls, Traffic
from level1.event import Event
from level1.frame import EXTENDED
from level1.io.definitions import load
from level1.supervisor import Supervisor

S = 1_000_000_000
QUIET = Traffic({})
BUS_OFF, CONTROLLER, RESTARTED, NO_ACK = 0x40, 0x4, 0x100, 0x20


def controller(state: int) -> bytes:
    return bytes([0, state, 0, 0, 0, 0, 0, 0])


def brief(reports: Iterable[Report]) -> list[tuple[str, str, bool]]:
    return [(report.alarm, report.key, report.present) for report in reports]


@pytest.fixture
def bus() -> BusHealth:
    """A bus of 250 kbit/s."""
    return BusHealth("implement", "can0", 250_000)


def quiet_windows(bus: BusHealth, number: int = QUIET_WINDOWS + 1) -> list[Report]:
    return [report for window in range(number) for report in bus.window(window * WINDOW_NS, QUIET)]


class TestInterface:
    def test_a_lost_interface_is_there_until_it_is_back(self, bus: BusHealth) -> None:
        assert brief(bus.down(S, "No such device")) == [("CanBusDown", "implement", True)]
        assert bus.state == "BusDown" and bus.down(2 * S, "still") == []
        over, = bus.up(3 * S + S // 2)
        assert (over.t_ns, over.present, over.detail["Reason"]) == (3 * S + S // 2, False, "No such device")
        assert bus.state == "BusActive" and bus.up(4 * S) == []

    def test_bus_off_says_what_could_not_be_sent_too(self, bus: BusHealth) -> None:
        bus.error(S, BUS_OFF, bytes(8))
        assert brief(bus.window(2 * S, Traffic({}, unsent={"CMD": 3}))) == [("CanBusOff", "implement", True)]
        over, = bus.heard(3 * S)
        assert over.detail == {"Bus": "implement", "Channel": "can0", "NotSent": {"CMD": 3}}

    def test_what_could_not_be_sent_meanwhile_stands_in_its_values_and_is_no_second_alarm(self, bus: BusHealth) -> None:
        bus.down(S, "No such device")
        told = [*bus.window(2 * S, Traffic({}, unsent={"CMD": 3})), *bus.window(3 * S, Traffic({}, unsent={"CMD": 1, "ALARMS": 2}))]
        assert {alarm for alarm, _, _ in brief(told)} == {"CanBusDown"}
        assert bus.up(4 * S)[-1].detail["NotSent"] == {"CMD": 4, "ALARMS": 2}

    def test_a_controller_begins_anew_with_its_interface(self, bus: BusHealth) -> None:
        bus.error(S, BUS_OFF, bytes(8))
        bus.down(2 * S, "Network is down")
        assert brief(bus.up(3 * S)) == [("CanBusOff", "implement", False), ("CanBusDown", "implement", False)]


class TestTolls:
    def down(self, t_ns: int, present: bool, bus: str = "implement") -> Report:
        return Report(t_ns, "CanBusDown", bus, present, {"Bus": bus}, "")

    def unsent(self, present: bool, not_sent: dict[str, int]) -> Report:
        return Report(S, "SendFailed", "implement", present, {"Bus": "implement", "NotSent": not_sent}, "")

    def test_a_bus_was_away_from_when_it_was_first_told_lost_until_it_was_told_back(self) -> None:
        tolls = Tolls()
        for t_ns, stands in ((1_000 * S, False), (1_001 * S, True)):
            assert tolls.summed(self.down(t_ns, True), stands=stands) == self.down(t_ns, True)
        tolls.summed(self.down(1_002 * S, True, "tractor"), stands=False)
        back = tolls.summed(self.down(1_002 * S + 345_678_901, False), stands=True)
        assert back.detail == {"Bus": "implement", "AwaySeconds": 2.346}
        assert tolls.summed(self.down(1_003 * S, False, "tractor"), stands=True).detail["AwaySeconds"] == 1
        tolls.summed(self.down(1_010 * S, True), stands=False)
        assert tolls.summed(self.down(1_011 * S, False), stands=True).detail["AwaySeconds"] == 1, "each alarm for itself"

    def test_of_one_that_was_lost_in_another_boot_nobody_knows(self) -> None:
        assert Tolls().summed(self.down(S, False), stands=True) == self.down(S, False)

    def test_a_cause_that_comes_back_before_its_alarm_has_cleared_adds_to_what_was_lost_before(self) -> None:
        tolls = Tolls()
        tolls.summed(self.unsent(True, {"CMD": 2, "ALARMS": 1}), stands=False)
        assert tolls.summed(self.unsent(False, {"CMD": 3, "ALARMS": 1}), stands=True).detail["NotSent"] == {"CMD": 3, "ALARMS": 1}
        for not_sent, total in (({"CMD": 1}, 4), ({"CMD": 5}, 8)):
            summed = tolls.summed(self.unsent(True, not_sent), stands=True)
            assert summed.detail == {"Bus": "implement", "NotSent": {"CMD": total, "ALARMS": 1}}
        assert tolls.summed(self.unsent(False, {"CMD": 5}), stands=True).detail["NotSent"] == {"CMD": 8, "ALARMS": 1}
        assert tolls.summed(self.unsent(True, {"CMD": 5}), stands=False).detail["NotSent"] == {"CMD": 5}, "each alarm for itself"

    def test_two_outages_of_one_alarm_are_summed_and_what_could_not_be_sent_in_one_of_them_is_kept(self) -> None:
        tolls = Tolls()
        tolls.summed(self.down(S, True), stands=False)
        tolls.summed(self.down(2 * S, False)._replace(detail={"Bus": "implement", "NotSent": {"CMD": 1}}), stands=True)
        tolls.summed(self.down(4 * S, True), stands=True)
        assert tolls.summed(self.down(7 * S, False), stands=True).detail == {
            "Bus": "implement", "AwaySeconds": 4, "NotSent": {"CMD": 1}}

    def test_other_causes_are_left_alone(self, bus: BusHealth) -> None:
        tolls = Tolls()
        reports = [*bus.error(S, BUS_OFF, bytes(8)), *bus.heard(2 * S)]
        assert [tolls.summed(report, stands=False) for report in reports] == reports


class TestController:
    @pytest.mark.parametrize(("can_id", "data"), [(RESTARTED, bytes(8)), (CONTROLLER, controller(0x40))])
    def test_bus_off_is_over_when_the_driver_says_so(self, bus: BusHealth, can_id: int, data: bytes) -> None:
        assert brief(bus.error(S, BUS_OFF, bytes(8))) == [("CanBusOff", "implement", True)] and bus.state == "BusOff"
        assert brief(bus.error(2 * S, can_id, data)) == [("CanBusOff", "implement", False)] and bus.state == "BusActive"

    def test_a_frame_that_comes_after_proves_that_it_is_over_one_from_before_does_not(self, bus: BusHealth) -> None:
        bus.error(S, BUS_OFF, bytes(8))
        assert bus.heard(S) == []
        assert brief(bus.heard(S + 1)) == [("CanBusOff", "implement", False)]

    @pytest.mark.parametrize("state", [0x10, 0x20, 0x30])
    def test_error_passive_lasts_until_the_controller_is_well(self, bus: BusHealth, state: int) -> None:
        assert brief(bus.error(S, CONTROLLER, controller(state))) == [("CanBusErrors", "implement", True)]
        assert quiet_windows(bus, 20) == [] and bus.state == "BusPassive"
        bus.error(S, CONTROLLER, controller(0x40))
        assert brief(quiet_windows(bus)) == [("CanBusErrors", "implement", False)]

    def test_an_error_frame_heard_after_the_window_it_came_in_is_told_after_it(self, bus: BusHealth) -> None:
        for _ in range(ERROR_BURST):
            bus.error(S, 0x8, bytes(8))
        at_the_end, = bus.window(2 * S, QUIET)
        late, = bus.error(2 * S - 1, BUS_OFF, bytes(8))
        assert (at_the_end.t_ns, late.t_ns) == (2 * S, 2 * S)

    def test_a_warning_is_no_alarm(self, bus: BusHealth) -> None:
        assert bus.error(S, CONTROLLER, controller(0x08)) == [] and bus.state == "BusWarning"

    def test_many_errors_are_one_until_they_cease(self, bus: BusHealth) -> None:
        for _ in range(ERROR_BURST):
            bus.error(S, 0x8, bytes(8))
        assert brief(bus.window(S, QUIET)) == [("CanBusErrors", "implement", True)]
        assert brief(quiet_windows(bus)) == [("CanBusErrors", "implement", False)]

    def test_that_nobody_acknowledges_is_told(self, bus: BusHealth) -> None:
        told = [report for _ in range(ERROR_BURST) for report in bus.error(S, NO_ACK, bytes(8))]
        assert [report.detail["State"] for report in told] == ["nobody acknowledges"]


class TestBabbling:
    def window(self, bus: BusHealth, can_id: int, per_second: int, span_ns: int = WINDOW_NS) -> list[tuple[str, str, bool]]:
        return brief(bus.window(S, Traffic({can_id: per_second * span_ns // S}, span_ns)))

    def test_an_identifier_without_cycle_may_take_about_half_of_the_bus(self, bus: BusHealth) -> None:
        assert self.window(bus, 0x123, bus.most_a_second - 8) == []
        assert self.window(bus, 0x123, bus.most_a_second + 8) == [("Babbling", "implement/123", True)] and bus.babbles
        assert brief(quiet_windows(bus)) == [("Babbling", "implement/123", False)] and not bus.babbles

    def test_one_with_a_cycle_ten_times_as_often_as_it_should(self, bus: BusHealth) -> None:
        bus.cycle_of = {0x123: S // 40, 0x124: S}.get
        assert self.window(bus, 0x123, 396) == []
        assert self.window(bus, 0x123, 404) == [("Babbling", "implement/123", True)]
        assert self.window(bus, 0x124, 196) == [], "at every change, as it may"
        assert ("Babbling", "implement/124", True) in self.window(bus, 0x124, 204)

    def test_frames_that_waited_count_over_the_time_in_which_they_came(self, bus: BusHealth) -> None:
        assert self.window(bus, 0x123, 900, 4 * S) == []

    @pytest.mark.parametrize("can_id", [0x18EB80F9, 0x18C780F9])
    def test_packets_of_a_transport_protocol_may_come_as_fast_as_they_can(self, bus: BusHealth, can_id: int) -> None:
        assert self.window(bus, EXTENDED | can_id, 1_900) == []


class TestLosses:
    def test_lost_frames_add_up_while_they_are_being_lost(self, bus: BusHealth) -> None:
        bus.window(S, Traffic({}, lost=5))
        later, = bus.window(2 * S, Traffic({}, lost=7))
        assert (later.alarm, later.detail["Frames"]) == ("FramesLost", 12)
        over, = quiet_windows(bus)
        assert (over.present, over.detail["Frames"]) == (False, 12)

    def test_an_interface_that_takes_no_frames_is_an_alarm_until_it_takes_some(self, bus: BusHealth) -> None:
        assert brief(bus.window(S, Traffic({}, unsent={"CMD": 1}))) == [("SendFailed", "implement", True)]
        assert quiet_windows(bus, 9) == [], "nothing was tried"
        told = [report for _ in range(QUIET_WINDOWS + 1) for report in bus.window(S, Traffic({}, sent=1))]
        assert brief(told) == [("SendFailed", "implement", False)]


@pytest.mark.parametrize("alarm", ALARMS)
def test_each_cause_raises_and_clears_the_alarm_that_ships(alarm: str) -> None:
    supervisor = Supervisor(load(["ucs.dbc"]), unit="a", start_ns=0, broadcast=False)
    supervisor.tick(0)
    supervisor.report(S, alarm, "implement", True, {"Bus": "implement"}, "text")
    supervisor.report(2 * S, alarm, "implement", False, {}, "")
    events = [output for output in supervisor.tick(20 * S) if isinstance(output, Event) and output.alarm == alarm]
    assert [event.event for event in events] == ["raised", "cleared"]
    assert events[0].values == {"Bus": "implement"} and float(events[0].t) == 1
