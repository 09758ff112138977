"""The local repair of one alarm, reported as an episode (DESIGN §4, §5).

Theory of operation. An *attempt* runs the steps of the definition to their end, also when the condition clears in between
(the igniter must go off again). It succeeds when its last step is done and the alarm's condition no longer holds. It fails
at once when an `expect` runs out, when its feedback is lost, or when the unit is stopped or paused from above. **A failed
attempt enters the safe state (the sends of RepairGiveUp) immediately**, before the pause: an ignition trial that failed
must not leave the valve open while the next one is awaited. Only where the definition says that trying again is harmless
(RepairBetween AsCommanded) do its messages return to what was commanded before the episode instead, and each attempt begins
from that. When as many attempts as the budget allows have begun within its window, the next failure, or the next
activation, locks the alarm out: safe state, held until a reset on board. Where the definition says so (RepairCounts Failed), an
attempt that was good is given back to the budget when its alarm clears: what wind does again and again is reported, not locked.

The pause (RepairPause) counts from the failure, whatever happens in it. Where a safe state is held through it, the episode lasts
as long: the condition may be gone only because of that state. Where none is (AsCommanded, or nothing to give up), an alarm whose
condition goes away meanwhile clears like any other; should it be raised again, the next attempt still waits for the pause's end.

From the first attempt to the end of the episode the repair owns its command messages: it repeats them at their cycle time,
and the alarm signal on the bus reads Repairing, upon which other programs stop sending them. One message serves one repair at a
time; an alarm of higher priority takes it from one of lower. A lock-out goes on holding those that are sent at a cycle time, also
against attempts of its own priority. While nobody knows when the next attempt may begin (the unit is stopped, the feedback is
missing), only a safe state is held; anything else ends as it was commanded before, and is handed back: whoever commands may have
other orders by now.

An attempt does not start (it waits) while its feedback is unknown, its message belongs to another, or the unit is stopped or
paused from above. A repair that is not armed runs passive: it reports once for each activation what it would have sent.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from level1.alarm import AlarmMachine
from level1.catalog import ACTIVE, LOCKED_OUT, NORMAL, REPAIRING, Repair
from level1.condition import Verdict, Zone
from level1.event import PRIORITIES, SentFrame
from level1.expression import ExpectStep, ResendStep, SendStep, WaitStep
from level1.gate import Refused
from level1.holds import Holds
from level1.timer import FAR, Timers


class Host(Protocol):
    """What a repair asks of the supervisor."""

    def emit(self, alarm: AlarmMachine, t_ns: int, event: str, text: str = "", attempt: int = 0,
             frames: tuple[SentFrame, ...] = (), passive: bool = False) -> int:
        """Report a step upward."""

    def is_armed(self, alarm: AlarmMachine) -> bool:
        """Whether the unit's configuration lets it act."""

    def forbidden(self, repair: Repair) -> str:
        """Why no repair of this kind may act now (stopped, paused from above); empty when it may."""


IDLE, RUNNING, PAUSING, WAITING, SETTLING = range(5)


class RepairMachine:
    """The repair of one alarm at run time. phase: IDLE, RUNNING (a step waits), PAUSING (between attempts), WAITING (may not act),
    SETTLING (the condition is back after a repair, before the alarm has cleared: it must hold for the on-delay again).

    begun_ns: when the attempts within the window began; good_ns: those of them in this activation that were good. attempt:
    number of the present or last attempt of this activation.
    expects: a closure with the verdict for each expect step; feedback(): worst verdict of all of them, unknown or not.
    """

    __slots__ = ("alarm", "attempt", "begun_ns", "definition", "due", "expects", "feedback", "good_ns", "holds", "host", "order",
                 "pause_end_ns", "phase", "position", "reported", "timers")

    def __init__(self, alarm: AlarmMachine, definition: Repair, host: Host, holds: Holds, timers: Timers,
                 expects: dict[int, Callable[[], int]], feedback: Callable[[], int]):
        self.alarm = alarm
        self.definition = definition
        self.host = host
        self.holds = holds
        self.timers = timers
        self.order = timers.order()
        self.due = FAR
        self.expects = expects
        self.feedback = feedback
        self.phase = IDLE
        self.position = 0
        self.attempt = 0
        self.begun_ns: list[int] = []
        self.good_ns: list[int] = []
        self.pause_end_ns = 0
        self.reported = False

    @property
    def name(self) -> str:
        """Of its alarm."""
        return self.alarm.definition.name

    @property
    def rank(self) -> int:
        """Higher takes a command message from lower; a lock-out takes it from an attempt of its own priority."""
        return 2 * PRIORITIES.index(self.alarm.definition.priority) + (self.alarm.state == LOCKED_OUT)

    @property
    def messages(self) -> list[str]:
        """The command messages it needs, each once."""
        steps = (*self.definition.steps, *self.definition.give_up)
        return list(dict.fromkeys(step.message for step in steps if isinstance(step, (SendStep, ResendStep))))

    @property
    def lasting(self) -> list[str]:
        """Those of them that a lock-out goes on holding; a command sent once leaves nothing to hold."""
        return [message for message in self.messages if self.holds.is_cyclic(message)]

    # --- what can happen to it --------------------------------------------------------------------------------------------

    def zone(self, t_ns: int) -> None:
        """The alarm has been raised, or its zone has changed while it was active."""
        if self.phase == RUNNING:
            if self.alarm.zone in (Zone.STALE, Zone.ERROR):
                self.fail(t_ns, "its inputs are missing or wrong")
        elif self.phase == SETTLING:
            if self.alarm.zone != Zone.RAISE:
                self.due = FAR
                self.phase = IDLE
        elif self.phase == PAUSING:
            self._end_if_over(t_ns)
        elif self.phase == IDLE and self.attempt and self.alarm.zone == Zone.RAISE and self.alarm.definition.on_delay_ns:
            self.phase = SETTLING
            self.timers.set(self, t_ns + self.alarm.definition.on_delay_ns)
        else:
            self.consider(t_ns)

    def feedback_changed(self, t_ns: int, verdict: int) -> None:
        """The feedback has become known (0) or unknown (STALE, ERROR)."""
        if self.phase == RUNNING:
            if verdict:
                self.fail(t_ns, "its feedback is missing or wrong")
        elif self.phase == WAITING:
            self.consider(t_ns)

    def expectation_changed(self, t_ns: int, position: int, verdict: int) -> None:
        """The condition of an expect step has another verdict."""
        if self.phase == RUNNING and self.position == position and verdict == Verdict.TRUE:
            self.due = FAR
            self.position += 1
            self.run(t_ns)

    def circumstances_changed(self, t_ns: int) -> None:
        """The unit was stopped, paused or released, or a command message has become free."""
        if self.alarm.state == LOCKED_OUT:
            if any(self.holds.owner(message) is not self for message in self.lasting):
                self._hold_safe_state(t_ns)
        elif self.phase == RUNNING and (why := self.host.forbidden(self.definition)):
            self.fail(t_ns, why)
        elif self.phase == PAUSING and self.host.forbidden(self.definition):
            self._hand_back(t_ns)
        elif self.phase == WAITING:
            self.consider(t_ns)

    def taken(self, t_ns: int, by: str) -> None:
        """A repair of higher priority needs the message. A lock-out stays one, and takes it back when it is free; an alarm that has
        cleared meanwhile, by what another loser has set free, stays cleared."""
        if self.alarm.state in (NORMAL, LOCKED_OUT):
            return
        if self.phase == RUNNING:
            self._report_failure(t_ns, f"{by} needs its command message")
        self.due = FAR
        self.phase = WAITING
        self.alarm.enter(t_ns, ACTIVE)
        self.holds.release(self, t_ns)

    def expire(self, now_ns: int) -> None:
        """A wait is over, an expect has run out, or the pause between attempts has passed."""
        if self.phase in (PAUSING, SETTLING):
            self.phase = WAITING if self.phase == PAUSING else IDLE
            self.consider(now_ns)
            return
        step = self.definition.steps[self.position]
        if isinstance(step, ExpectStep):
            self.fail(now_ns, f"expected {step.text} within {step.within_ns / 1e9:g} s")
        else:
            self.position += 1
            self.run(now_ns)

    def clear(self, t_ns: int) -> None:
        """The alarm has cleared: the episode is over."""
        self.due = FAR
        self.phase = IDLE
        self.attempt = 0
        self.reported = False
        if not self.definition.counts_good:
            self.begun_ns = [begun for begun in self.begun_ns if begun not in self.good_ns]
        self.good_ns.clear()
        self.holds.release(self, t_ns)

    def restore(self, t_ns: int, attempt: int, begun_ns: list[int]) -> None:
        """Go on after a restart of the program: an attempt that was under way has failed, a lock-out is still one."""
        self.attempt = attempt
        self.begun_ns = begun_ns
        if self.alarm.state == LOCKED_OUT:
            self._hold_safe_state(t_ns)
        elif self.alarm.state == REPAIRING and not self.host.is_armed(self.alarm):
            self.alarm.state = ACTIVE
        elif self.alarm.state == REPAIRING:
            self.holds.claim(self, t_ns, self.messages)
            self.fail(t_ns, "the supervisor was restarted during the attempt")

    def obstacle(self) -> str:
        """Why no attempt begins although one is due; empty while nothing is in the way."""
        if self.phase != WAITING:
            return ""
        if why := self.host.forbidden(self.definition):
            return why
        if self.feedback():
            return "its feedback is missing or wrong"
        owners = {owner.name for message in self.messages if (owner := self.holds.owner(message)) and owner is not self}
        return f"{', '.join(sorted(owners))} needs its command message" if owners else ""

    # --- what it does -----------------------------------------------------------------------------------------------------

    def consider(self, t_ns: int) -> None:
        """Start an attempt, wait, lock out, or end the episode, as the circumstances are."""
        alarm = self.alarm
        if alarm.state in (NORMAL, LOCKED_OUT):
            return
        if alarm.zone != Zone.RAISE:
            if self.phase == WAITING and alarm.zone in (Zone.CLEAR, Zone.NEITHER):
                self._end(t_ns)
            elif self.phase == WAITING:
                self._hand_back(t_ns)
            return
        if not self.host.is_armed(alarm):
            self._report_passive(t_ns)
            return
        if self.spent(t_ns):
            self.lock_out(t_ns, "as many attempts as the budget allows were made lately")
            return
        if t_ns < self.pause_end_ns:
            self.phase = PAUSING
            self.timers.set(self, self.pause_end_ns)
            return
        self.phase = WAITING
        if self.feedback() or self.host.forbidden(self.definition) or self.holds.claim(self, t_ns, self.messages):
            self._hand_back(t_ns)
        elif self.phase == WAITING:  # still: what the claim has set free may have led here already
            self._start(t_ns)

    def spent(self, t_ns: int) -> bool:
        """Whether the budget of attempts within the window is used up."""
        self.begun_ns = [begun for begun in self.begun_ns if begun > t_ns - self.definition.window_ns]
        return len(self.begun_ns) >= self.definition.attempts

    def _start(self, t_ns: int) -> None:
        self.phase = RUNNING
        self.position = 0
        self.attempt += 1
        self.begun_ns.append(t_ns)
        frames = self.holds.preview(self.definition.steps)
        self.host.emit(self.alarm, t_ns, "repair_started", self.definition.text, self.attempt, frames)
        self.alarm.enter(t_ns, REPAIRING)
        self.run(t_ns)

    def run(self, t_ns: int) -> None:
        """Go on from the present step until one has to wait."""
        steps = self.definition.steps
        while self.phase == RUNNING and self.position < len(steps):
            step = steps[self.position]
            if isinstance(step, WaitStep):
                self.timers.set(self, t_ns + step.duration_ns)
                return
            if isinstance(step, ExpectStep):
                if self.expects[self.position]() != Verdict.TRUE:
                    self.timers.set(self, t_ns + step.within_ns)
                    return
            elif not self._transmit(t_ns, step):
                return
            self.position += 1
        if self.phase == RUNNING:
            self._finish(t_ns)

    def _transmit(self, t_ns: int, step: SendStep | ResendStep) -> bool:
        try:
            self.holds.transmit(self, t_ns, step)
        except Refused as refusal:
            self.fail(t_ns, str(refusal))
            return False
        return True

    def _finish(self, t_ns: int) -> None:
        if self.alarm.zone == Zone.RAISE:
            self.fail(t_ns, "all steps are done, but its condition still holds")
            return
        self.host.emit(self.alarm, t_ns, "repaired", "", self.attempt)
        self.good_ns.append(self.begun_ns[-1])
        self._end(t_ns)

    def _end(self, t_ns: int) -> None:
        self.phase = IDLE
        self.due = FAR
        self.holds.release(self, t_ns)
        self.alarm.enter(t_ns, ACTIVE)
        self.alarm.try_clear(t_ns)

    def fail(self, t_ns: int, why: str) -> None:
        """The present attempt has failed: safe state at once; then a pause, or lock-out when the budget is spent."""
        self._report_failure(t_ns, why)
        if self.spent(t_ns):
            self.lock_out(t_ns, "the last attempt of the budget has failed")
            return
        if self.definition.safe_between:
            self._safe_state(t_ns)
        else:
            self.holds.restore(self, t_ns)
        self.phase = PAUSING
        if not self.definition.pause_ns:
            self.expire(t_ns)
            return
        self.pause_end_ns = t_ns + self.definition.pause_ns
        self.timers.set(self, self.pause_end_ns)
        if self.host.forbidden(self.definition):
            self._hand_back(t_ns)
        self._end_if_over(t_ns)

    @property
    def _rests_safely(self) -> bool:
        return self.definition.safe_between and bool(self.definition.give_up)

    def _end_if_over(self, t_ns: int) -> None:
        """A pause in which no safe state is held ends with the condition."""
        if not self._rests_safely and self.alarm.zone in (Zone.CLEAR, Zone.NEITHER):
            self._end(t_ns)

    def _hand_back(self, t_ns: int) -> None:
        """No attempt can begin for now: hold nothing but a safe state."""
        if not self._rests_safely and self.alarm.state == REPAIRING:
            self.alarm.enter(t_ns, ACTIVE)
            self.holds.release(self, t_ns)

    def _report_failure(self, t_ns: int, why: str) -> None:
        self.due = FAR
        self.host.emit(self.alarm, t_ns, "repair_failed", why, self.attempt)

    def lock_out(self, t_ns: int, why: str) -> None:
        """Give up: into the safe state, and hold it."""
        self.due = FAR
        self.phase = IDLE
        self.host.emit(self.alarm, t_ns, "locked_out", why, self.attempt)
        self.alarm.enter(t_ns, LOCKED_OUT)
        self._hold_safe_state(t_ns)
        self.holds.release(self, t_ns, self.lasting)

    def _hold_safe_state(self, t_ns: int) -> None:
        self.holds.claim(self, t_ns, self.lasting)
        self._safe_state(t_ns)

    def _safe_state(self, t_ns: int) -> None:
        for step in self.definition.give_up:
            if isinstance(step, (SendStep, ResendStep)):
                try:
                    self.holds.transmit(self, t_ns, step, safe=True)
                except Refused:
                    continue

    def _report_passive(self, t_ns: int) -> None:
        if not self.reported:
            self.reported = True
            frames = self.holds.preview(self.definition.steps)
            self.host.emit(self.alarm, t_ns, "repair_started", self.definition.text, 1, frames, passive=True)
