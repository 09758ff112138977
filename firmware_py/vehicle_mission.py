"""The mission controller of the vehicle: the other program of the UCS, which starts missions, commands hitch, PTO and implement.

Theory of operation. It is told what to do (`mission start`, `pto on`, `hitch by path`). VEHICLE_GUIDE is its sign of life: it
stops when the vehicle has been silent for 1 s, so that nothing drives unseen. VEHICLE_CMD is sent once for each order, with the
speed limit that was ordered last by whomever. After a stop, manual driving or that silence it withdraws hitch, PTO and
implement, after a stop of the engine the PTO: they have to be ordered anew.

The rule of the two senders: while an alarm in VEHICLE_ALARMS reads Repairing or LockedOut, it does not send the command that this
alarm's repair holds. A lock-out withdraws what was ordered there, and pauses the mission.
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.participant import BusFrame
from firmware_py.quantity import Setting
from firmware_py.vehicle import HELD, LIMIT, REQUEST

HOLDS: Mapping[str, str] = {
    "HitchNotMoving": "VEHICLE_HITCH_CMD", "PtoNotSet": "VEHICLE_PTO_CMD", "PtoNotUnset": "VEHICLE_PTO_CMD",
    "ImplementSetUnsetFailure": "VEHICLE_IMPLEMENT_CMD"}
"""Which alarm's repair holds which command."""
SILENT_NS = 1_000_000_000
HARMLESS_FRAMES = 3
"""So many frames with Off, Unset or Hold are sent before anything else, once the vehicle takes orders again."""
RAISED, LOWERED = 100.0, 0.0
LIMITS_KMH = {"slow": 1.0, "normal": 6.0}


class VehicleMission(Node):
    """The node. Takes `ORDERS` by `order`. held: commands that level 1 holds, by the alarm that does."""

    TICK_NS: ClassVar[int] = 50_000_000
    DBC: ClassVar[str] = "vehicle.dbc"
    DBC_NODE: ClassVar[str] = "MISSION"
    HEARS: ClassVar[tuple[str, ...]] = ("VEHICLE_STATUS", "VEHICLE_ALARMS", "VEHICLE_CMD")
    SENDS: ClassVar[tuple[str, ...]] = ("VEHICLE_GUIDE", "VEHICLE_PTO_CMD", "VEHICLE_HITCH_CMD", "VEHICLE_IMPLEMENT_CMD")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("", "ignores repairs", "goes on sending what level 1 holds"),
        *COMMON_FAULTS,
    )
    ORDERS: ClassVar[tuple[Phrase, ...]] = (
        *(Phrase("mission", action, meaning, lasts=False) for action, meaning in (
            ("start", "begin or continue it, from Ready"), ("pause", "brake and wait"), ("resume", "go on after a pause"),
            ("stop", "abort it"))),
        Phrase("speed", "slow", f"at most {LIMITS_KMH['slow']:g} km/h", lasts=False),
        Phrase("speed", "normal", "that of the path", lasts=False),
        Phrase("pto", "on", "switch the power take-off on", lasts=False),
        Phrase("pto", "off", "switch it off", lasts=False),
        Phrase("hitch", "raise", "to 100 %", lasts=False),
        Phrase("hitch", "lower", "to 0 %", lasts=False),
        Phrase("hitch", "by path", "lowered in the passes, raised in the turns", lasts=False),
        Phrase("implement", "set", "into work", lasts=False),
        Phrase("implement", "unset", "out of work", lasts=False),
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("start", "s", 0, 0, 86400, "when it starts the mission by itself, 0 s for when ordered"),)

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        wait_s = settings.get("start", 0.0)
        self._start_ns: int | None = start_ns + round(wait_s * 1e9) if wait_s else None
        self.held: dict[str, str] = {}
        self._obedient = True
        self._limit_kmh = LIMITS_KMH["normal"]
        self._pto = False
        self._implement = False
        self._hitch: str | None = None
        self._status: Mapping[str, Value] = {}
        self._heard_ns: int | None = None
        self._harmless_left: dict[str, int] = {}
        self._counter = 0
        self._once: list[str] = []

    def order(self, now_ns: int, statement: Statement) -> None:
        """One of `ORDERS`. Raises ValueError for another."""
        self.tell(now_ns, f"order: {statement}")
        match statement.device, statement.action:
            case "mission", action:
                self._once.append(action.capitalize())
            case "speed", name if name in LIMITS_KMH:
                self._limit_kmh = LIMITS_KMH[name]
                self._once.append("None")
            case "pto", action:
                self._pto = action == "on"
            case "hitch", action:
                self._hitch = action
            case "implement", action:
                self._implement = action == "set"
            case _:
                raise ValueError(f"{self.name} knows no order {statement}")

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """Status, alarms, or what the UCS requests of the vehicle."""
        match message:
            case "VEHICLE_STATUS":
                if self._heard_ns is None or t_ns - self._heard_ns >= SILENT_NS:
                    self._begin_harmless()
                self._heard_ns = t_ns
                self._heed(t_ns, values)
                self._status = values
            case "VEHICLE_CMD":
                self._limit_kmh = float(values[LIMIT])
            case _:
                self._alarms_changed(t_ns, values)

    def _heed(self, t_ns: int, status: Mapping[str, Value]) -> None:
        """What must not come back by itself is withdrawn."""
        held = status["Controller"] in HELD
        if held or status["EngineState"] == "Off":
            self._begin_harmless()
        if held:
            self._withdraw_all(t_ns, str(status["Controller"]).lower())
        elif self._pto and status["EngineState"] == "Off":
            self._pto = False
            self.tell(t_ns, "withdraws the PTO: the engine does not run")

    def _begin_harmless(self) -> None:
        """The vehicle takes no On, Set and Move any more before it has heard Off, Unset and Hold."""
        self._harmless_left = dict.fromkeys(HOLDS.values(), HARMLESS_FRAMES)

    def _withdraw_all(self, t_ns: int, why: str) -> None:
        if self._pto or self._implement or self._hitch is not None:
            self._pto = self._implement = False
            self._hitch = None
            self.tell(t_ns, f"withdraws hitch, PTO and implement: the vehicle is {why}")

    def _alarms_changed(self, t_ns: int, states: Mapping[str, Value]) -> None:
        held = {HOLDS[alarm]: alarm for alarm, state in states.items() if alarm in HOLDS and state in ("Repairing", "LockedOut")}
        for message in held.keys() - self.held.keys():
            what = "leaves {} to level 1 ({})" if self._obedient else "goes on sending {} although level 1 holds it ({})"
            self.tell(t_ns, what.format(message, held[message]))
        for message in self.held.keys() - held.keys():
            self.tell(t_ns, f"sends {message} again")
        self.held = held
        for message, alarm in held.items():
            if states[alarm] == "LockedOut":
                self._withdraw(t_ns, message, alarm)

    def _withdraw(self, t_ns: int, message: str, alarm: str) -> None:
        """After a lock-out somebody has to order it anew."""
        if message == "VEHICLE_PTO_CMD" and self._pto or alarm == "PtoNotUnset" and self._executes:
            self._pto = False
        elif message == "VEHICLE_HITCH_CMD" and self._hitch is not None:
            self._hitch = None
        elif message == "VEHICLE_IMPLEMENT_CMD" and self._implement:
            self._implement = False
        else:
            return
        self.tell(t_ns, f"locked out ({alarm}): pauses the mission")
        self._once.append("Pause")

    @property
    def _executes(self) -> bool:
        return self._status.get("Controller") == "Executing" and "Pause" not in self._once

    def tick(self, t_ns: int) -> None:
        """One tick of 50 ms."""
        if self._heard_ns is not None and t_ns - self._heard_ns >= SILENT_NS:
            self._withdraw_all(t_ns, "silent")
        if self._start_ns is not None and t_ns >= self._start_ns:
            self._start_ns = None
            self._once.append("Start")

    def step(self, now_ns: int) -> list[BusFrame]:
        """The cyclic commands that are due, and requests, each once."""
        frames = super().step(now_ns)
        if self._once and self._next_tick_ns > now_ns:
            requests, self._once = self._once, []
            if self.powered and not self._frozen and not self._silent:
                frames += [self._request(request) for request in requests]
        return frames

    def _request(self, request: str) -> BusFrame:
        values: Mapping[str, Value] = {REQUEST: request, LIMIT: self._limit_kmh}
        return BusFrame(*self.codec.identifier("VEHICLE_CMD"), self.codec.encode("VEHICLE_CMD", values))

    def values(self, message: str) -> Mapping[str, Value] | None:
        """The commands; None for what level 1 holds, and for the sign of life when nothing is heard of the vehicle."""
        if self._obedient and message in self.held:
            return None
        now_ns = self._next_tick_ns - self.TICK_NS
        harmless = self._heard_ns is None or self._harmless_left.get(message, 0) > 0
        if harmless and message in self._harmless_left:  # counted in frames: what a silence kept back was not heard
            self._harmless_left[message] -= 1
        match message:
            case "VEHICLE_GUIDE":
                if self._heard_ns is None or now_ns - self._heard_ns >= SILENT_NS:
                    return None
                self._counter = (self._counter + 1) % 16
                return {"GuideCounter": self._counter}
            case "VEHICLE_PTO_CMD":
                return {"PtoWanted": "On" if self._pto and not harmless else "Off", "Retry": "Off"}
            case "VEHICLE_HITCH_CMD":
                holds = harmless or self._hitch is None
                return {"HitchMove": "Hold" if holds else "Move", "Retry": "Off", "HitchWanted": self._hitch_wanted}
            case _:
                return {"ImplementWanted": "Set" if self._implement and not harmless else "Unset", "Retry": "Off"}

    @property
    def _hitch_wanted(self) -> float:
        if self._hitch == "by path":
            return RAISED if self._status.get("PathPart") == "Turn" or self._status.get("MissionState") != "Running" else LOWERED
        return LOWERED if self._hitch == "lower" else RAISED

    def restart(self, t_ns: int) -> None:
        """After a reset nothing is ordered."""
        self._pto = self._implement = False
        self._hitch = None
        self._status = {}
        self._heard_ns = None
        self.held.clear()
        self._once.clear()
        self._limit_kmh = LIMITS_KMH["normal"]

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        if statement != Statement("", None, "ignores repairs"):
            super().fault(now_ns, statement)
        self._obedient = False

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` also makes it obey again."""
        super().inject(now_ns, statement)
        if statement.action == WORKS:
            self._obedient = True
