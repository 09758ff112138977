"""The life of one alarm: the automaton of DESIGN §4.

It consumes changes of zone (`condition.Zone`) and deadlines, nothing else, so that live closures and replay over recordings
drive it alike.

    normal ──RAISE held for the on-delay──▶ active ──CLEAR held for the off-delay──▶ normal
                                            │  ▲      (latched: and acknowledged)
                             repair started │  │ repaired, or the condition went away by itself
                                            ▼  │
                                         repairing ──budget spent──▶ locked out ──CLEAR and reset──▶ normal

STALE and ERROR hold a running delay: it goes on with what was left of it when the inputs are back. NEITHER and CLEAR cancel an
on-delay; RAISE and NEITHER cancel an off-delay. The off-delay also runs while a repair does; the alarm only clears when its
steps are done. What the repair does is in `repair`.
"""
from __future__ import annotations

from typing import Any, Protocol

from level1 import catalog
from level1.catalog import ACTIVE, LOCKED_OUT, NORMAL, REPAIRING
from level1.condition import Zone
from level1.timer import FAR, Timers

_HOLD = (Zone.STALE, Zone.ERROR)


class Delay:
    """A delay that can be held: what is left of it then counts on when it goes on."""

    __slots__ = ("left_ns", "owner", "running", "timers")

    def __init__(self, owner: AlarmMachine, timers: Timers):
        self.owner = owner
        self.timers = timers
        self.running = False
        self.left_ns: int | None = None

    def start(self, t_ns: int, delay_ns: int) -> None:
        """Begin, or go on after `hold`; a delay that runs already is left alone."""
        if self.left_ns is not None:
            delay_ns, self.left_ns = self.left_ns, None
        elif self.running:
            return
        self.running = True
        self.timers.set(self.owner, t_ns + delay_ns)

    def hold(self, t_ns: int) -> None:
        """Stop the clock, keep the rest."""
        if self.running and self.left_ns is None:
            self.left_ns = self.owner.due - t_ns
            self.owner.due = FAR

    def cancel(self) -> None:
        """Forget it."""
        self.running = False
        self.left_ns = None
        self.owner.due = FAR


class Host(Protocol):
    """What an alarm asks of the supervisor."""

    def emit(self, alarm: AlarmMachine, t_ns: int, event: str, text: str = "", attempt: int = 0) -> int:
        """Report a step upward; gives its seq."""

    def moved(self, alarm: AlarmMachine, t_ns: int) -> None:
        """The state on the bus has changed."""

    def counted(self, alarm: AlarmMachine, t_ns: int) -> None:
        """The alarm has been raised once more."""


class Episode(Protocol):
    """What an alarm asks of its repair (`repair.RepairMachine`)."""

    def zone(self, t_ns: int) -> None:
        """The alarm is active and its zone has changed (or it has just been raised)."""

    def clear(self, t_ns: int) -> None:
        """The alarm has cleared."""


class AlarmMachine:
    """One alarm at run time. state: NORMAL, ACTIVE, REPAIRING or LOCKED_OUT (`catalog`); zone: the last one told.

    instance: seq of the `raised` event of the present activation, 0 in NORMAL. acknowledged, unlocked: by people, since then.
    key, detail, text: of one of many causes that a subsystem reports itself (a trouble code), empty for a condition's alarm.
    """

    __slots__ = ("acknowledged", "calm", "definition", "delay", "detail", "due", "episode", "host", "instance", "key", "order",
                 "state", "text", "unlocked", "zone")

    def __init__(self, definition: catalog.Alarm, host: Host, timers: Timers):
        self.definition = definition
        self.host = host
        self.order = timers.order()
        self.due = FAR
        self.delay = Delay(self, timers)
        self.state = NORMAL
        self.zone: int = Zone.CLEAR
        self.calm = False
        self.instance = 0
        self.acknowledged = False
        self.unlocked = False
        self.episode: Episode | None = None
        self.key = ""
        self.detail: dict[str, Any] = {}
        self.text = definition.cause or definition.when_text

    def zone_changed(self, t_ns: int, zone: int) -> None:
        """The conditions have moved the alarm to another zone."""
        self.zone = zone
        if self.state == NORMAL:
            self._towards_raised(t_ns)
        else:
            self._towards_cleared(t_ns)
            if self.episode is not None and self.state != NORMAL:
                self.episode.zone(t_ns)

    def _towards_raised(self, t_ns: int) -> None:
        if self.zone == Zone.RAISE:
            if not self.definition.on_delay_ns:
                self.expire(t_ns)
            else:
                self.delay.start(t_ns, self.definition.on_delay_ns)
        elif self.zone in _HOLD:
            self.delay.hold(t_ns)
        else:
            self.delay.cancel()

    def _towards_cleared(self, t_ns: int) -> None:
        if self.zone == Zone.CLEAR:
            if self.calm:
                return
            if not self.definition.off_delay_ns:
                self.expire(t_ns)
            else:
                self.delay.start(t_ns, self.definition.off_delay_ns)
        elif self.zone in _HOLD:
            self.delay.hold(t_ns)
        else:
            self.delay.cancel()
            self.calm = self.unlocked = False

    def expire(self, now_ns: int) -> None:
        """The on-delay or off-delay has been held to its end."""
        self.delay.cancel()
        if self.state == NORMAL:
            self.state = ACTIVE
            self.calm = self.acknowledged = self.unlocked = False
            self.instance = self.host.emit(self, now_ns, "raised", self.text)
            self.host.counted(self, now_ns)
            self.host.moved(self, now_ns)
            if self.episode is not None:
                self.episode.zone(now_ns)
        else:
            self.calm = True
            self.try_clear(now_ns)

    def try_clear(self, t_ns: int) -> None:
        """Return to normal if nothing is in the way: the off-delay, a repair that runs, a latch, a lock-out."""
        if not self.calm or self.state in (NORMAL, REPAIRING):
            return
        if self.definition.latch and not self.acknowledged:
            return
        if self.state == LOCKED_OUT and not self.unlocked:
            return
        self.state = NORMAL
        self.calm = False
        if self.episode is not None:
            self.episode.clear(t_ns)
        self.host.emit(self, t_ns, "cleared")
        self.instance = 0
        self.host.moved(self, t_ns)

    def enter(self, t_ns: int, state: int) -> None:
        """The repair moves the alarm to ACTIVE, REPAIRING or LOCKED_OUT."""
        if state != self.state:
            self.state = state
            self.host.moved(self, t_ns)

    def acknowledge(self, t_ns: int, who: str) -> str:
        """Someone has seen it. Gives the reason of a refusal, else an empty string."""
        if self.state == NORMAL:
            return f"{self.definition.name} is not active"
        if not self.acknowledged:
            self.acknowledged = True
            self.host.emit(self, t_ns, "acknowledged", who)
            self.try_clear(t_ns)
        return ""

    def reset(self, t_ns: int, who: str) -> str:
        """Lift a lock-out. Refused while its cause is still there: a reset is never remembered for later."""
        if self.state != LOCKED_OUT:
            return f"{self.definition.name} is not locked out"
        if self.zone not in (Zone.CLEAR, Zone.NEITHER):
            return f"the cause of {self.definition.name} is still there, or its inputs are missing"
        if not self.calm and self.zone == Zone.NEITHER:
            return f"{self.definition.name} has not come back to where it clears"
        self.unlocked = self.acknowledged = True
        self.host.emit(self, t_ns, "acknowledged", f"reset by {who}")
        self.try_clear(t_ns)
        return ""
