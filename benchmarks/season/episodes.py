"""Whether the events of level 1 make sense by themselves: each step of an alarm's life only after the one it needs."""
from __future__ import annotations

from dataclasses import dataclass, field

from level1.catalog import Catalog
from level1.event import Event


@dataclass
class _Life:
    """An alarm that was raised. repairs: attempt under way; attempt: number of the last one; good_s: when good ones began.
    unlocked: a reset was accepted; it is forgotten when the cause comes back before the alarm has cleared.
    """

    alarm: str
    keyed: bool
    repairs: bool = False
    locked: bool = False
    unlocked: bool = False
    seen: bool = False
    attempt: int = 0
    good_s: list[float] = field(default_factory=list)


class Episodes:
    """Follows the events. wrong: what did not fit. active: instance -> alarm, of those that stand."""

    def __init__(self, catalog: Catalog):
        self._catalog = catalog
        self._lives: dict[int, _Life] = {}
        self._begun_s: dict[str, list[float]] = {}
        self._last_seq = 0
        self.wrong: list[str] = []

    @property
    def standing(self) -> list[str]:
        """Alarms that are raised and not cleared."""
        return [life.alarm for life in self._lives.values()]

    @property
    def locked(self) -> list[str]:
        """Those that are locked out."""
        return [life.alarm for life in self._lives.values() if life.locked]

    def is_standing(self, alarm: str) -> bool:
        """Whether it is raised."""
        return any(life.alarm == alarm for life in self._lives.values())

    def take(self, event: Event) -> None:
        """The next event."""
        if event.seq != self._last_seq + 1:
            self._mark(event, f"follows number {self._last_seq}")
        self._last_seq = event.seq
        life = self._lives.get(event.instance)
        if event.event == "raised":
            keyed = event.alarm in ("TroubleCode", "DeviceEmergency", "DeviceSilent")
            if life is not None or not keyed and self.is_standing(event.alarm):
                self._mark(event, "it stands already")
            self._lives[event.instance] = _Life(event.alarm, keyed)
            return
        if life is None or life.alarm != event.alarm:
            self._mark(event, "it was not raised")
            return
        match event.event:
            case "repair_started":
                self._started(event, life)
            case "repaired" | "repair_failed":
                if not life.repairs or event.attempt != life.attempt:
                    self._mark(event, "that attempt was not under way")
                life.repairs = False
                if event.event == "repaired":
                    life.good_s.append(self._begun_s[event.alarm][-1])
            case "locked_out":
                if life.repairs or life.locked:
                    self._mark(event, "an attempt is under way, or it is locked out already")
                life.locked, life.unlocked, life.seen = True, False, False
            case "acknowledged":
                life.seen = True
                life.unlocked |= event.text.startswith("reset")
            case "cleared":
                latched = self._catalog.alarms[event.alarm].latch
                if life.repairs or life.locked and not life.unlocked or latched and not life.seen:
                    self._mark(event, "a repair, a lock-out or a latch holds it")
                self._give_back(event, life)
                del self._lives[event.instance]
            case _:
                self._mark(event, "no such step")

    def _started(self, event: Event, life: _Life) -> None:
        repair = self._catalog.alarms[event.alarm].repair
        if repair is None or life.repairs or life.locked or event.attempt != life.attempt + 1:
            self._mark(event, "an attempt is under way, or none may be")
        life.repairs, life.attempt = True, event.attempt
        if repair is not None:
            now_s = float(event.t)
            begun = [one for one in self._begun_s.get(event.alarm, []) if one > now_s - repair.window_ns / 1e9]
            self._begun_s[event.alarm] = [*begun, now_s]
            if len(begun) >= repair.attempts:
                self._mark(event, f"its budget of {repair.attempts} attempts in {repair.window_ns / 1e9:g} s is spent")

    def _give_back(self, event: Event, life: _Life) -> None:
        """What was good does not use up the budget where the definition says so."""
        repair = self._catalog.alarms[event.alarm].repair
        if repair is not None and not repair.counts_good:
            self._begun_s[event.alarm] = [one for one in self._begun_s.get(event.alarm, []) if one not in life.good_s]

    def _mark(self, event: Event, why: str) -> None:
        self.wrong.append(f"{event.t:.3f} s: {event.alarm} {event.event} ({event.seq} of {event.instance}): {why}")
