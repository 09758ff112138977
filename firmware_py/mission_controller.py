"""The mission controller: the other program of the UCS that commands the implement during a mission.

Theory of operation. It is told what to do (`flaming on`, `burner[2] high`) and sends FLAMER_CMD every 100 ms:

    Idle ──flaming ordered──▶ Purging ──tool Ready, no flame──▶ Lighting ──pilot flame──▶ Working
    Lighting ──the safeguard gives up, or 4 s──▶ Failed ──5 s, nobody repairs──▶ Idle (order withdrawn)
    Working ──the tool left work mode by itself──▶ Purging        any ──flaming off ordered──▶ Idle

Only Lighting and Working demand gas. It never lights without the purge, nor by the word of a tool that has said nothing for three
cycle times, nor while an alarm of the gas valve stands (`DANGERS`: someone has to look at it, and acknowledge), and never lights a
flame again that went out in work: that is a repair.

The rule of the two senders: while an alarm in FLAMER_ALARMS reads Repairing or LockedOut, it sends no FLAMER_CMD, because
level 1 does. When all read Normal or Active again it goes on: Working when the pilot flame burns, else from Purging. A lock-out
withdraws the order to flame: somebody has to order it anew. If FLAMER_ALARMS falls silent meanwhile, it stays back; the tool
then closes its gas valve by itself.
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.flaming_tool import BURNERS, IDLE
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.quantity import Setting

LIGHTING_NS = 4_000_000_000
"""The safeguard ends a trial after 3 s; this is for a tool that says nothing."""
FAILED_NS = 5_000_000_000
"""After a failed ignition level 1 has so long to start its repair."""
LEFT_NS = 1_000_000_000
"""The tool may need so long to enter its work mode before its leaving counts."""

DANGERS = ("FlameWithValveClosed", "GasValveNotClosed", "GasValveLeaks")
LEVELS = ("off", "low", "high")


class MissionController(Node):
    """The node. Takes `ORDERS` by `order`; hears the tool's status and the alarms. settings: none as yet."""

    TICK_NS: ClassVar[int] = 50_000_000
    DBC: ClassVar[str] = "flaming_tool.dbc"
    DBC_NODE: ClassVar[str] = "MISSION"
    HEARS: ClassVar[tuple[str, ...]] = ("FLAMER_STATUS", "FLAMER_ALARMS")
    SENDS: ClassVar[tuple[str, ...]] = ("FLAMER_CMD",)
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("", "ignores repairs", "goes on sending while level 1 holds the command"),
        *COMMON_FAULTS,
    )
    ORDERS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("flaming", "on", "purge if need be, light the pilot flame, work", lasts=False),
        Phrase("flaming", "off", "stop and close", lasts=False),
        *(Phrase("burner", level, f"set point {level}", count=BURNERS, lasts=False) for level in LEVELS),
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = ()

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        self.state = "Idle"
        self.held_by: str | None = None
        self._flaming = False
        self._levels = ["Off"] * BURNERS
        self._entered_ns = start_ns
        self._status: Mapping[str, Value] = {}
        self._heard_ns = start_ns
        self._stale_ns = 3 * codec.cycle_ns("FLAMER_STATUS")
        self._worked = False
        self._danger = False
        self._obedient = True

    def order(self, now_ns: int, statement: Statement) -> None:
        """One of `ORDERS`. Raises ValueError for another."""
        self.tell(now_ns, f"order: {statement}")
        match statement.device, statement.action:
            case "flaming", action:
                self._flaming = action == "on"
            case "burner", level if level in LEVELS:
                for number in range(BURNERS) if statement.index is None else (statement.index - 1,):
                    self._levels[number] = level.capitalize()
            case _:
                raise ValueError(f"{self.name} knows no order {statement}")

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """Status of the tool, or the alarms."""
        if message == "FLAMER_STATUS":
            self._status, self._heard_ns = values, t_ns
            return
        self._danger = any(values[alarm] != "Normal" for alarm in DANGERS)
        holding = next((alarm for alarm, state in values.items() if state in ("Repairing", "LockedOut")), None)
        if "LockedOut" in values.values() and self._flaming:
            self._flaming = False
            self.tell(t_ns, "locked out: flaming has to be ordered anew")
        if holding is not None and self.held_by is None:
            leaves = "leaves FLAMER_CMD to level 1" if self._obedient else "goes on sending although level 1 holds FLAMER_CMD"
            self.tell(t_ns, f"{leaves} ({holding})")
        elif holding is None and self.held_by is not None:
            burns = self._flaming and self._status.get("PilotFlame") == "On"
            self._enter(t_ns, "Working" if burns else "Purging" if self._flaming else "Idle")
            self.tell(t_ns, f"commands again: {self.state.lower()}")
        self.held_by = holding

    def tick(self, t_ns: int) -> None:
        """One tick of 50 ms."""
        if not self.powered or (self.held_by is not None and self._obedient):
            return
        status = self._status
        burns = status.get("PilotFlame") == "On"
        in_state_ns = t_ns - self._entered_ns
        if not self._flaming:
            if self.state != "Idle":
                self._enter(t_ns, "Idle")
            return
        match self.state:
            case "Idle":
                self._enter(t_ns, "Purging")
            case "Purging" if self._is_clear(t_ns) and not burns:
                self._enter(t_ns, "Lighting")
                self.tell(t_ns, "lights the pilot flame")
            case "Lighting" if burns:
                self._enter(t_ns, "Working")
            case "Lighting" if in_state_ns >= LIGHTING_NS or (in_state_ns >= LEFT_NS and
                                                             status.get("Safeguard") == "IgnitionFailed"):
                self._enter(t_ns, "Failed")
                self.tell(t_ns, "the pilot flame could not be lit")
            case "Failed" if in_state_ns >= FAILED_NS:
                self._flaming = False
                self.tell(t_ns, "nobody repairs it: flaming has to be ordered anew")
            case "Working":
                self._watch_work(t_ns, in_state_ns)
            case _:
                pass

    def _is_clear(self, t_ns: int) -> bool:
        """Whether the pilot flame may be lit, by what the tool says now."""
        return t_ns - self._heard_ns <= self._stale_ns and self._status.get("Safeguard") == "Ready" and not self._danger

    def _watch_work(self, t_ns: int, in_state_ns: int) -> None:
        flaming = self._status.get("Flaming") == "On"
        if self._worked and not flaming and in_state_ns >= LEFT_NS:
            self._enter(t_ns, "Purging")
            self.tell(t_ns, "the tool has left its work mode: starts again with a purge")
        self._worked = self._worked or flaming

    def _enter(self, t_ns: int, state: str) -> None:
        self.state = state
        self._entered_ns = t_ns
        self._worked = False

    def values(self, message: str) -> Mapping[str, Value] | None:
        """The command of the present state; None while level 1 holds it."""
        if self.held_by is not None and self._obedient:
            return None
        if self.state in ("Idle", "Purging"):
            return IDLE
        gas = self.state in ("Lighting", "Working")
        return {"Flaming": "On", "GasValve": "Open" if gas else "Closed", "Igniter": "On" if self.state == "Lighting" else "Off",
                **{f"Burner{number}": level for number, level in enumerate(self._levels, 1)}}

    def restart(self, t_ns: int) -> None:
        """After a reset nothing is ordered."""
        self._flaming = False
        self.held_by = None
        self._status = {}
        self._enter(t_ns, "Idle")

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        if statement.device or statement.action != "ignores repairs":
            super().fault(now_ns, statement)
        self._obedient = False

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` also makes it obey again."""
        super().inject(now_ns, statement)
        if statement.action == WORKS:
            self._obedient = True
