"""Repairs: verified, budgeted, ended in the safe state, and never a way to open the gas valve without a finished purge."""
from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from level1.catalog import Command, Repair
from level1.command import Order
from level1.event import Event, Output, Result, Send
from level1.expression import ExpectStep, ResendStep, SendStep
from level1.frame import Frame, frame_key
from level1.supervisor import Supervisor
from level1.tests.build import (
    COMMAND,
    MS,
    PURGE_NS,
    RELIGHT,
    SECOND,
    STATUS,
    alarm,
    catalog,
    compare,
    events,
    message,
    pilot_flame_out,
    sends,
    signal,
    status,
    supervisor,
)


class Flamer:
    """A flaming tool just real enough: it burns while gas flows, lights when there is a spark, and obeys FLAMER_CMD."""

    def __init__(self, target: Supervisor, dead_igniter: bool = False):
        self.target = target
        self.dead = dead_igniter
        self.flaming, self.flame, self.gas, self.igniter = 1, 1, 1, 0
        self.now = 0
        self.outputs: list[Output] = []

    def run(self, seconds: float, heard: bool = True) -> list[tuple[float, str, str]]:
        """Go on for so long, a status every 100 ms; gives the events."""
        began = len(self.outputs)
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            if self.gas and self.igniter and not self.dead:
                self.flame = 1
            if not self.gas:
                self.flame = 0
            frame = status(self.now, self.flaming, self.flame, self.gas)
            self.take(self.target.receive(frame) if heard else self.target.tick(self.now))
            self.now += 100 * MS
        return events(self.outputs[began:])

    def take(self, outputs: Iterable[Output]) -> None:
        """What the supervisor gives."""
        for output in outputs:
            self.outputs.append(output)
            if isinstance(output, Send) and output.message == "FLAMER_CMD":
                self.gas, self.igniter = output.data[0] & 1, output.data[0] >> 1 & 1

    def order(self, name: str, target: str = "", origin: Any = "above") -> Result:
        """A command; gives the answer."""
        self.take(self.target.command(Order("x", name, target, origin=origin), self.now))
        result = self.outputs[-1]
        assert isinstance(result, Result)
        return result


def flamer(dead_igniter: bool = False, **more: Any) -> Flamer:
    """A flaming tool that has burnt for a second under a new supervisor."""
    tool = Flamer(supervisor([STATUS, COMMAND], [pilot_flame_out()], **more), dead_igniter)
    assert tool.run(1) == []
    return tool


def words(outcome: list[tuple[float, str, str]]) -> list[str]:
    return [what for _, _, what in outcome]


def test_a_blown_out_flame_is_relit_after_the_purge_and_reported_as_one_episode() -> None:
    tool = flamer()
    tool.flame = 0
    assert tool.run(40) == [(1.3, "PilotFlameOut", "raised"), (1.3, "PilotFlameOut", "repair_started"),
                            (31.4, "PilotFlameOut", "repaired"), (31.4, "PilotFlameOut", "cleared")]
    instances = {output.instance for output in tool.outputs if isinstance(output, Event)}
    assert instances == {1} and (tool.gas, tool.igniter) == (1, 0)


def test_the_igniter_goes_off_although_the_alarm_clears_before() -> None:
    """Clearing without off-delay happens in the frame that shows the flame; the last step is still done."""
    tool = flamer()
    tool.flame = 0
    tool.run(40)
    assert [send.data[0] for send in sends(tool.outputs, "FLAMER_CMD")][-1] == 0b01


def test_a_dead_igniter_ends_in_lock_out_with_the_valve_closed() -> None:
    tool = flamer(dead_igniter=True)
    tool.flame = 0
    outcome = tool.run(110)
    assert words(outcome) == ["raised", "repair_started", "repair_failed", "repair_started", "repair_failed", "repair_started",
                              "repair_failed", "locked_out"]
    assert outcome[-1][0] == outcome[-2][0] and tool.gas == 0
    assert tool.target.alarm_states() == {"PilotFlameOut": 3}


def test_a_failed_ignition_closes_the_valve_before_the_pause() -> None:
    repair = Repair(RELIGHT.steps, RELIGHT.give_up, attempts=3, window_ns=900 * SECOND, pause_ns=20 * SECOND)
    tool = Flamer(supervisor([STATUS, COMMAND], [pilot_flame_out(repair=repair)]), dead_igniter=True)
    tool.run(1)
    tool.flame = 0
    tool.run(36)
    assert words(events(tool.outputs))[-1] == "repair_failed" and tool.gas == 0


def test_a_held_command_is_repeated_at_its_cycle_time_and_handed_back() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(10)
    times = [send.t_ns for send in sends(tool.outputs, "FLAMER_CMD")]
    assert {later - earlier for earlier, later in zip(times, times[1:], strict=False)} == {100 * MS}
    tool.run(30)
    last = sends(tool.outputs, "FLAMER_CMD")[-1].t_ns
    tool.run(10)
    assert sends(tool.outputs, "FLAMER_CMD")[-1].t_ns == last


def test_a_lock_out_holds_the_safe_state_until_it_is_reset_on_board() -> None:
    tool = flamer(dead_igniter=True)
    tool.flame = 0
    tool.run(110)
    count = len(sends(tool.outputs, "FLAMER_CMD"))
    assert tool.run(5) == [] and len(sends(tool.outputs, "FLAMER_CMD")) == count + 50
    assert "still there" in tool.order("reset", "PilotFlameOut", "local").reason
    tool.flaming = 0
    assert tool.run(1) == []
    assert "only be reset at the machine" in tool.order("reset", "PilotFlameOut", "above").reason
    assert tool.order("reset", "PilotFlameOut", "local").outcome == "done"
    assert words(events(tool.outputs))[-2:] == ["acknowledged", "cleared"]
    count = len(sends(tool.outputs, "FLAMER_CMD"))
    tool.run(5)
    assert len(sends(tool.outputs, "FLAMER_CMD")) == count


def test_the_budget_counts_attempts_within_the_window_over_activations() -> None:
    tool = flamer()
    for _ in range(3):
        tool.flame = 0
        assert words(tool.run(60)) == ["raised", "repair_started", "repaired", "cleared"]
    tool.flame = 0
    assert words(tool.run(60)) == ["raised", "locked_out"] and tool.gas == 0


def test_the_budget_refills_when_the_window_has_passed() -> None:
    tool = flamer()
    for _ in range(6):
        tool.flame = 0
        assert words(tool.run(301)) == ["raised", "repair_started", "repaired", "cleared"]


def test_where_only_failed_attempts_count_good_ones_are_given_back() -> None:
    """Wind blows a flame out many times a day; three trials in vain are still the end."""
    definition = msgspec.structs.replace(pilot_flame_out(), repair=msgspec.structs.replace(RELIGHT, counts_good=False))
    tool = Flamer(supervisor([STATUS, COMMAND], [definition]))
    tool.run(1)
    for _ in range(8):
        tool.flame = 0
        assert words(tool.run(60)) == ["raised", "repair_started", "repaired", "cleared"]
    tool.flame, tool.dead = 0, True
    assert words(tool.run(110)) == ["raised", *["repair_started", "repair_failed"] * 3, "locked_out"]


def test_failed_attempts_count_on_although_a_later_one_was_good() -> None:
    definition = msgspec.structs.replace(pilot_flame_out(), repair=msgspec.structs.replace(RELIGHT, counts_good=False))
    tool = Flamer(supervisor([STATUS, COMMAND], [definition]))
    tool.run(1)
    for _ in range(2):
        tool.flame, tool.dead = 0, True
        assert words(tool.run(36)) == ["raised", "repair_started", "repair_failed", "repair_started"]
        tool.dead = False
        assert words(tool.run(60)) == ["repaired", "cleared"]
    tool.flame, tool.dead = 0, True
    assert words(tool.run(36)) == ["raised", "repair_started", "repair_failed", "locked_out"]


def test_lost_feedback_fails_the_attempt_and_closes_the_valve() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(30.35)
    assert tool.run(1, heard=False)[0][2] == "repair_failed"
    assert tool.gas == 0 and tool.target.alarm_states() == {"PilotFlameOut": 2}
    assert tool.run(120, heard=False) == []
    assert words(tool.run(40))[-1] == "cleared"


def test_no_attempt_begins_while_the_feedback_is_missing() -> None:
    repair = Repair((SendStep("FLAMER_CMD", {"GasValve": 0, "Igniter": 0}), ExpectStep(compare("OTHER.X", "==", 1), SECOND, "X")))
    other = STATUS.__class__("OTHER", 0x300, False, 8, (STATUS.signals[0].__class__(
        "X", 0, 1, False, False, False, STATUS.signals[0].factor, STATUS.signals[0].offset),), cycle_ns=100 * MS)
    target = supervisor([STATUS, COMMAND, other], [pilot_flame_out(repair=repair)])
    tool = Flamer(target)
    tool.flame = 0
    assert words(tool.run(5)) == ["raised"]
    tool.take(target.receive(Frame(tool.now, frame_key(0x300, False), b"\1" + bytes(7))))
    assert words(events(tool.outputs)) == ["raised", "repair_started", "repair_failed", "locked_out"]


def test_stop_from_above_ends_the_attempt_and_holds_the_next_back() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(5)
    assert tool.order("stop").outcome == "done"
    assert words(events(tool.outputs))[-1] == "repair_failed"
    assert tool.run(120) == [] and tool.gas == 0
    assert "started again at the machine" in tool.order("resume").reason
    assert tool.order("resume", origin="local").outcome == "done"
    assert words(tool.run(60)) == ["repaired", "cleared"]


def test_pause_holds_back_a_repair_that_has_not_begun() -> None:
    tool = flamer()
    tool.order("pause")
    tool.flame = 0
    assert words(tool.run(60)) == ["raised"]
    tool.order("resume")
    assert words(tool.run(60)) == ["repaired", "cleared"]


def test_an_unarmed_repair_reports_what_it_would_send_and_sends_nothing() -> None:
    tool = flamer(armed=())
    tool.flame = 0
    assert words(tool.run(60)) == ["raised", "repair_started"]
    started = next(output for output in tool.outputs if isinstance(output, Event) and output.event == "repair_started")
    assert started.passive and [frame.data[:2] for frame in started.frames] == ["00", "03", "01"]
    assert sends(tool.outputs, "FLAMER_CMD") == []


def test_a_restart_during_an_attempt_counts_it_as_failed_and_keeps_the_budget() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(20)
    again = supervisor([STATUS, COMMAND], [pilot_flame_out()], boot=2, restored=tool.target.state(), start_ns=tool.now)
    successor = Flamer(again)
    successor.now, successor.flame, successor.gas = tool.now, 0, tool.gas
    successor.take(again.tick(successor.now))
    assert words(events(successor.outputs)) == ["repair_failed"] and successor.gas == 0
    assert words(successor.run(60)) == ["repair_started", "repaired", "cleared"]
    assert len(again.state().alarms[0].begun_ago_ns) == 2


def test_a_lock_out_survives_a_restart_and_is_held_at_once() -> None:
    tool = flamer(dead_igniter=True)
    tool.flame = 0
    tool.run(110)
    again = supervisor([STATUS, COMMAND], [pilot_flame_out()], boot=2, restored=tool.target.state(), start_ns=0)
    outputs = again.tick(0)
    assert again.alarm_states() == {"PilotFlameOut": 3} and [send.data[0] for send in sends(outputs, "FLAMER_CMD")] == [0]


def test_a_command_message_serves_one_repair_at_a_time_and_the_higher_priority_takes_it() -> None:
    closed = ExpectStep(compare("FLAMER_STATUS.GasValve", "==", 0), 5 * SECOND, "closed")
    burner = Repair((ResendStep("FLAMER_CMD"), closed), attempts=2)
    weak = alarm("Burner", compare("FLAMER_STATUS.GasValve", "==", 1), 2, "Low", on_delay_ns=2 * SECOND, repair=burner)
    target = supervisor([STATUS, COMMAND], [pilot_flame_out(priority="Critical"), weak])
    tool = Flamer(target)
    for _ in range(30):
        target.receive(Frame(tool.now, frame_key(COMMAND.can_id, False), b"\1" + bytes(7)))
        tool.run(0.1)
    assert target.alarm_states() == {"PilotFlameOut": 0, "Burner": 2}
    tool.flame = 0
    outcome = tool.run(1)
    assert ("Burner", "repair_failed") in [(name, what) for _, name, what in outcome]
    assert target.alarm_states()["PilotFlameOut"] == 2 and target.alarm_states()["Burner"] != 2


@pytest.mark.fault("a stop whose message a repair holds",
                   "no repair moves anything any more; answered that the frame could not be sent")
def test_a_stop_whose_frame_a_repair_holds_stops_every_repair_all_the_same_and_says_so() -> None:
    target = Supervisor(msgspec.structs.replace(catalog([STATUS, COMMAND], [pilot_flame_out()]), commands={
        name: Command(name, "FLAMER_CMD", {"GasValve": 0, "Igniter": 0}) for name in ("stop", "pause")}), unit="a", broadcast=False)
    tool = Flamer(target)
    tool.run(1)
    tool.flame = 0
    tool.run(1)
    assert target.alarm_states()["PilotFlameOut"] == 2
    assert "belongs to the repair of PilotFlameOut" in tool.order("pause").reason and target.mode == "running"
    outcome = target.command(Order("c", "stop"), tool.now)
    assert "belongs to the repair of PilotFlameOut" in outcome[-1].reason and target.mode == "stopped"  # type: ignore[union-attr]
    assert [name for _, _, name in events(outcome)] == ["repair_failed"] and sends(outcome, "FLAMER_CMD")[-1].data[0] == 0
    tool.run(120)
    assert not any(send.data[0] & 1 for send in sends(tool.outputs[-100:], "FLAMER_CMD"))


@pytest.mark.fault("an order that reaches supervision late", "refused: expired")
def test_an_order_that_reaches_supervision_late_is_refused() -> None:
    target = supervisor([STATUS, COMMAND], [pilot_flame_out()], start_ns=0)
    for now, outcome in ((5 * SECOND, "done"), (5 * SECOND + 1, "refused")):
        assert target.command(Order("c", "pause", expires_ns=5 * SECOND), now)[-1].outcome == outcome  # type: ignore[union-attr]


def test_an_old_command_is_not_sent_again() -> None:
    burner = Repair((ResendStep("FLAMER_CMD"),), attempts=1)
    weak = alarm("Burner", compare("FLAMER_STATUS.Flaming", "==", 1), 2, on_delay_ns=2 * SECOND, repair=burner)
    target = supervisor([STATUS, COMMAND], [weak])
    target.receive(Frame(0, frame_key(COMMAND.can_id, False), b"\1" + bytes(7)))
    tool = Flamer(target)
    assert words(tool.run(3)) == ["raised", "repair_started", "repair_failed", "locked_out"]
    assert sends(tool.outputs, "FLAMER_CMD") == []


actions = st.lists(st.tuples(
    st.sampled_from(["run", "run", "run", "silence", "stop", "pause", "resume", "reset", "acknowledge", "restart", "command",
                     "jump"]),
    st.integers(0, 1), st.integers(0, 1), st.floats(0.1, 40)), min_size=1, max_size=14)


@given(actions)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_no_sequence_of_inputs_opens_the_valve_without_a_finished_purge_and_check(steps: list[tuple[str, int, int, float]]) -> None:
    """The oracle looks at the wire only: before the UCS opens a valve that it had closed, it has commanded it closed, at
    every frame and without a gap, for the whole purge, and the last status heard showed no flame. Then a spark comes with it."""
    target = supervisor([STATUS, COMMAND], [pilot_flame_out()])
    now, closed_since, last_send, last_flame, mission_gas = 0, None, None, None, 1

    def judge(outputs: Iterable[Output]) -> None:
        nonlocal closed_since, last_send
        for output in outputs:
            if not isinstance(output, Send) or output.message != "FLAMER_CMD":
                continue
            opens = output.data[0] & 1
            gap = last_send is None or output.t_ns - last_send > 200 * MS
            if opens and (closed_since is not None or gap):
                assert closed_since is not None and not gap, "opened out of nothing"
                assert output.t_ns - closed_since >= PURGE_NS, "opened before the purge was over"
                assert last_flame == 0 and output.data[0] & 2, "opened without the check or without a spark"
            closed_since = None if opens else (output.t_ns if gap or closed_since is None else closed_since)
            last_send = output.t_ns

    for action, flaming, flame, length in steps:
        if action == "restart":
            target = supervisor([STATUS, COMMAND], [pilot_flame_out()], boot=target.boot + 1, restored=target.state(), start_ns=now)
            last_send = closed_since = None
            judge(target.tick(now))
        elif action == "command":
            judge(target.receive(Frame(now, frame_key(COMMAND.can_id, False), bytes([flaming | flame << 1]) + bytes(7))))
            mission_gas = flaming
        elif action == "jump":
            judge(target.receive(status(now - round(length * SECOND), flaming, flame, mission_gas)))
            last_flame = flame
        elif action in ("run", "silence"):
            for _ in range(round(length * 10)):
                if action == "run":
                    last_flame_before, last_flame = last_flame, flame
                    outputs = target.receive(status(now, flaming, flame, mission_gas))
                    timely = [out for out in outputs if isinstance(out, Send) and out.t_ns < now]
                    last_flame = last_flame_before
                    judge(timely)
                    last_flame = flame
                    judge(out for out in outputs if out not in timely)
                else:
                    judge(target.tick(now))
                now += 100 * MS
        else:
            judge(target.command(Order("x", action, "PilotFlameOut", origin="local" if flaming else "above"), now))


VALVES = message("VALVES", 0x401, [signal("Set", 0, 8)], senders=("UCS", "MISSION"))
ACTUAL = message("ACTUAL", 0x402, [signal("Is", 0, 8)])


def test_a_harmless_repair_is_tried_again_from_what_was_commanded_before_it() -> None:
    """Nozzles re-sent at most three times; only the lock-out closes them (RepairBetween AsCommanded)."""
    steps = (ResendStep("VALVES"), ExpectStep(compare("ACTUAL.Is", "==", 7), SECOND, "Is == 7"))
    repair = Repair(steps, (SendStep("VALVES", {"Set": 0}),), attempts=3, safe_between=False, pause_ns=500 * MS)
    wrong = alarm("Wrong", compare("ACTUAL.Is", "!=", 7), on_delay_ns=SECOND, repair=repair)
    target = supervisor([VALVES, ACTUAL], [wrong])
    outputs: list[Output] = []
    for n in range(70):
        t = n * 100 * MS
        if n < 11:
            outputs += target.receive(Frame(t, frame_key(0x401, False), b"\x07" + bytes(7)))
        outputs += target.receive(Frame(t, frame_key(0x402, False), b"\x03" + bytes(7)))
    assert words(events(outputs)) == ["raised", *["repair_started", "repair_failed"] * 3, "locked_out"]
    lock_out = next(out.t for out in outputs if isinstance(out, Event) and out.event == "locked_out")
    sent = sends(outputs, "VALVES")
    assert {send.data[0] for send in sent if send.t_ns < lock_out * SECOND} == {7}
    assert {send.data[0] for send in sent if send.t_ns > lock_out * SECOND} == {0}


def _paused_repair(safe_between: bool) -> tuple[Supervisor, list[Output]]:
    """Wrong from 0 s, raised at 1 s, an attempt that fails at 2 s, a pause until 12 s."""
    steps = (ResendStep("VALVES"), ExpectStep(compare("ACTUAL.Is", "==", 7), SECOND, "Is == 7"))
    repair = Repair(steps, (SendStep("VALVES", {"Set": 0}),), attempts=3, safe_between=safe_between, pause_ns=10 * SECOND)
    wrong = alarm("Wrong", compare("ACTUAL.Is", "!=", 7), on_delay_ns=SECOND, off_delay_ns=SECOND, repair=repair)
    target = supervisor([VALVES, ACTUAL], [wrong])
    return target, list(_actual(target, 0, 25, 3))


def _actual(target: Supervisor, begin: int, end: int, value: int) -> Iterable[Output]:
    for n in range(begin, end):
        yield from target.receive(Frame(n * 100 * MS, frame_key(0x401, False), b"\x07" + bytes(7)))
        yield from target.receive(Frame(n * 100 * MS, frame_key(0x402, False), bytes([value]) + bytes(7)))


def test_an_alarm_whose_cause_goes_away_in_a_pause_clears_and_the_pause_still_counts() -> None:
    """A clock that is right again a minute after an attempt to set it does not stand as wrong for the other four."""
    target, outputs = _paused_repair(safe_between=False)
    outputs += _actual(target, 25, 50, 7)
    outputs += _actual(target, 50, 130, 3)
    assert [(t, word) for t, _, word in events(outputs)] == [
        (1, "raised"), (1, "repair_started"), (2, "repair_failed"), (3.5, "cleared"), (6, "raised"), (12, "repair_started")]


def test_a_safe_state_is_held_through_the_pause_although_the_condition_is_gone() -> None:
    """It may be gone only because of the safe state."""
    target, outputs = _paused_repair(safe_between=True)
    outputs += _actual(target, 25, 130, 7)
    assert [(t, word) for t, _, word in events(outputs)] == [
        (1, "raised"), (1, "repair_started"), (2, "repair_failed"), (12, "cleared")]
    assert {send.data[0] for send in sends(outputs, "VALVES") if send.t_ns > 2 * SECOND} == {0}


def test_a_flame_lost_again_before_the_alarm_has_cleared_must_be_lost_for_the_on_delay_again() -> None:
    tool = Flamer(supervisor([STATUS, COMMAND], [pilot_flame_out(off_delay_ns=5 * SECOND)]))
    tool.run(1)
    tool.flame = 0
    tool.run(31)
    assert words(events(tool.outputs))[-1] == "repaired"
    tool.flame = 0
    tool.run(0.2)
    tool.flame = 1
    assert tool.run(1) == []
    tool.flame = 0
    lost = tool.now / SECOND
    assert tool.run(1) == [(round(lost + 0.3, 9), "PilotFlameOut", "repair_started")]


def test_a_stranger_on_a_held_message_does_not_get_into_the_repair() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(10)
    tool.target.receive(Frame(tool.now, frame_key(COMMAND.can_id, False), b"\x01\xaa" + bytes(6)))
    tool.run(30)
    assert {send.data[1] for send in sends(tool.outputs, "FLAMER_CMD")} == {0}


def test_a_lock_out_goes_on_holding_cyclic_commands_only_so_that_others_can_use_what_is_sent_once() -> None:
    restart = message("RESTART", 0x202, [signal("Device", 0, 8)], length=1, cycle_ns=None, senders=("UCS",))
    sensors = message("SENSORS", 0x203, [signal("First", 0, 2), signal("Second", 2, 2)])
    alarms = [alarm(name, compare(f"SENSORS.{name}", "==", 2), code, repair=Repair(
        (SendStep("RESTART", {"Device": 7}), ExpectStep(compare(f"SENSORS.{name}", "==", 1), SECOND, "it works")), attempts=1))
        for code, name in enumerate(("First", "Second"), 1)]
    target = supervisor([restart, sensors], alarms)
    outputs: list[Output] = []
    for tick in range(100):
        states = 0b1010 if 50 <= tick < 55 else 0b0110
        outputs += target.receive(Frame(tick * 100 * MS, frame_key(0x203, False), bytes([states, *bytes(7)])))
    assert [(name, word) for _, name, word in events(outputs)] == [
        ("First", "raised"), ("First", "repair_started"), ("First", "repair_failed"), ("First", "locked_out"),
        ("Second", "raised"), ("Second", "repair_started"), ("Second", "repaired"), ("Second", "cleared")]
    assert [send.t_ns for send in sends(outputs, "RESTART")] == [0, 5 * SECOND]


def test_a_stranger_that_commands_what_is_out_of_its_limits_does_not_keep_the_valve_open() -> None:
    """The safe state names some signals; the others must not come from a frame that the gate would refuse."""
    limited = msgspec.structs.replace(COMMAND, signals=(*COMMAND.signals[:2], signal("Burner", 8, 8, minimum=Decimal(0),
                                                                                     maximum=Decimal(2))))
    tool = Flamer(supervisor([STATUS, limited], [pilot_flame_out()]))
    tool.run(1)
    tool.target.receive(Frame(tool.now, frame_key(COMMAND.can_id, False), b"\x01\xaa" + bytes(6)))
    tool.flame = 0
    assert words(tool.run(0.5)) == ["raised", "repair_started"] and tool.gas == 0
    assert {send.data[:2] for send in sends(tool.outputs, "FLAMER_CMD")} == {b"\0\0"}


def test_a_burst_of_commands_does_not_hold_up_the_safe_state() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(30.4)
    assert (tool.gas, tool.igniter) == (1, 1)
    tool.target.gate.recent["FLAMER_CMD"] = [tool.now] * 20
    tool.order("stop")
    assert words(events(tool.outputs))[-1] == "repair_failed" and (tool.gas, tool.igniter) == (0, 0)


@pytest.mark.parametrize("phase", ["attempt", "pause"])
def test_a_harmless_repair_repeats_nothing_while_the_unit_is_stopped(phase: str) -> None:
    """What was commanded before the episode is an order of then: whoever commands must be able to take it back."""
    target, outputs = _paused_repair(safe_between=False)
    if phase == "attempt":
        outputs += _actual(target, 25, 125, 3)
        assert target.alarm_states()["Wrong"] == 2
    outputs += target.command(Order("x", "stop"), target.now_ns)
    stopped = target.now_ns
    outputs += _actual(target, 130, 400, 3)
    assert [send for send in sends(outputs, "VALVES") if send.t_ns > stopped] == [] and target.alarm_states()["Wrong"] == 1
    outputs += target.command(Order("y", "resume", origin="local"), target.now_ns)
    assert target.alarm_states()["Wrong"] == 2 and words(events(outputs))[-1] == "repair_started"


def test_a_harmless_repair_repeats_nothing_while_its_feedback_is_missing() -> None:
    target, outputs = _paused_repair(safe_between=False)
    outputs += target.tick(60 * SECOND)
    assert sends(outputs, "VALVES")[-1].t_ns <= 12 * SECOND and target.alarm_states()["Wrong"] == 1


def test_a_repair_that_loses_one_of_its_messages_lets_go_of_the_others() -> None:
    """Its alarm no longer reads Repairing: others send them again."""
    more = message("MORE", 0x403, [signal("Set", 0, 8)], senders=("UCS", "MISSION"))
    weak = Repair((SendStep("VALVES", {"Set": 1}), SendStep("MORE", {"Set": 1}), ExpectStep(compare("ACTUAL.Is", "==", 7),
                                                                                          5 * SECOND, "Is == 7")), attempts=3)
    strong = Repair((SendStep("VALVES", {"Set": 2}), ExpectStep(compare("ACTUAL.Is", "==", 7), 5 * SECOND, "Is == 7")))
    target = supervisor([VALVES, more, ACTUAL], [
        alarm("Weak", compare("ACTUAL.Is", "!=", 7), priority="Low", repair=weak),
        alarm("Strong", compare("ACTUAL.Is", "==", 4), 2, repair=strong)])
    outputs = list(_actual(target, 0, 10, 3))
    assert {send.message for send in sends(outputs, "MORE")} == {"MORE"}
    taken = target.now_ns
    outputs += _actual(target, 10, 30, 4)
    assert target.alarm_states() == {"Weak": 1, "Strong": 2}
    assert [send for send in sends(outputs, "MORE") if send.t_ns > taken + 100 * MS] == []


def test_a_lock_out_is_not_overruled_by_an_attempt_of_its_own_priority() -> None:
    """It takes the message from one that is under way, which then waits."""
    trial = Repair((SendStep("VALVES", {"Set": 1}), ExpectStep(compare("ACTUAL.Is", "==", 7), 5 * SECOND, "Is == 7"),
                    SendStep("VALVES", {"Set": 1})), (SendStep("VALVES", {"Set": 0}),), attempts=1)
    target = supervisor([VALVES, ACTUAL], [alarm("First", compare("ACTUAL.Is", "<", 4), repair=trial),
                                           alarm("Second", compare("ACTUAL.Is", ">", 3), 2, repair=trial)])
    outputs = list(_actual(target, 0, 60, 3))
    assert target.alarm_states()["First"] == 3
    outputs += _actual(target, 60, 70, 4)
    outputs += target.command(Order("x", "reset", "First", origin="local"), target.now_ns)
    assert target.alarm_states() == {"First": 0, "Second": 2}
    outputs += _actual(target, 70, 90, 3)
    assert target.alarm_states()["First"] == 3, "its budget of an hour is spent"
    assert {send.data[0] for send in sends(outputs, "VALVES") if send.t_ns > 7 * SECOND} == {0}
    assert ("Second", "repair_failed") in [(name, word) for _, name, word in events(outputs)]


def test_an_attempt_that_a_restart_ended_is_not_gone_on_with_where_the_repair_is_no_longer_armed() -> None:
    tool = flamer()
    tool.flame = 0
    tool.run(20)
    again = supervisor([STATUS, COMMAND], [pilot_flame_out()], boot=2, restored=tool.target.state(), start_ns=tool.now, armed=())
    successor = Flamer(again)
    successor.now, successor.flame = tool.now, 0
    assert words(successor.run(60)) == ["repair_started"] and sends(successor.outputs, "FLAMER_CMD") == []
    assert again.alarm_states()["PilotFlameOut"] == 1


def test_an_alarm_that_clears_when_its_messages_are_taken_stays_cleared() -> None:
    """The message that the other does not need is set free, which ends the episode: its other messages are taken after that."""
    names = ("VALVES", "MORE", "THIRD")
    messages = [VALVES, *(message(name, 0x403 + n, [signal("Set", 0, 8)], senders=("UCS",)) for n, name in enumerate(names[1:]))]
    never = ExpectStep(compare("ACTUAL.Is", "==", 7), 5 * SECOND, "Is == 7")
    target = supervisor([*messages, ACTUAL], [
        alarm("Weak", compare("ACTUAL.Is", "==", 3), priority="Low",
              repair=Repair((*(SendStep(name, {"Set": 1}) for name in names), never))),
        alarm("Strong", compare("ACTUAL.Is", "==", 4), 2,
              repair=Repair((*(SendStep(name, {"Set": 2}) for name in names[:2]), never)))])
    outputs = [*_actual(target, 0, 10, 3), *_actual(target, 10, 12, 4)]
    assert [word for _, name, word in events(outputs) if name == "Weak"] == ["raised", "repair_started", "repair_failed", "cleared"]
    assert target.alarm_states() == {"Weak": 0, "Strong": 2}


@pytest.mark.parametrize("value", ["Infinity", "NaN", "300", "-1"])
def test_a_value_that_no_signal_can_say_is_refused(value: str) -> None:
    target = Supervisor(msgspec.structs.replace(catalog([STATUS, COMMAND], [pilot_flame_out()]), commands={
        "turn_up": Command("turn_up", "FLAMER_CMD", {"Burner": None})}), unit="a", broadcast=False, start_ns=0)
    (result,) = target.command(Order("x", "turn_up", value=Decimal(value)), 0)
    assert isinstance(result, Result) and result.outcome == "refused"
