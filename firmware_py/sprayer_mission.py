"""The mission controller of the sprayer boom: the other program of the UCS, which commands it during a mission.

Theory of operation. It is told what to do (`boom open`, `spraying on`) and sends the boom's commands. While it sprays, each section
follows the weed map: where will it be after `lookahead`, the time a valve needs on average, and is there weed? Position, heading
and speed come from the tractor (VP, VDS, GROUND_SPEED); without a position younger than 1 s nothing is opened. Set points follow
dose and speed. `section[7] on` opens one without any map.

Boom and spraying wait for each other: it sprays with the boom open only, and folds it when nothing is sprayed.

The rule of the two senders: while an alarm in SPRAYER_ALARMS reads Repairing or LockedOut, it does not send the message that this
alarm's repair holds; the others it sends on. A lock-out withdraws the order to spray: somebody has to order it anew, and so does
the hand panel. Sections are different: no repair holds the pattern, so that an order to stop always closes them. A section that is
locked out is left out of it, and when its alarm reads Normal or Active again, the section is told to follow.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.field import CELL_M, paper_map, to_metres
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.quantity import Setting
from firmware_py.sprayer_plant import SECTIONS

HOLDS: Mapping[str, str] = {
    "SprayingStartStopFailure": "SPRAYER_CMD", "SectionStaysOpen": "SPRAYER_CMD",
    "OpenCloseBoomFailure": "SPRAYER_BOOM_CMD", "BoomOpeningNotAdjusted": "SPRAYER_BOOM_CMD",
    "SetMainFlowFailure": "SPRAYER_MAIN_CMD", "MainFlowNotAdjusted": "SPRAYER_MAIN_CMD",
    "SetDisFlowFailure": "SPRAYER_DIS_CMD", "HerbicideLineBlocked": "SPRAYER_DIS_CMD",
}
"""Which alarm's repair holds which command."""
HOLDING = ("Repairing", "LockedOut")
ANY_SOURCE = 0xFE
"""Source address of J1939 messages in the DBC."""
POSE_TIMEOUT_NS = 1_000_000_000
FASTEST_M_S = 6 / 3.6
"""The vehicle drives 6 km/h at most: what is above is no speed (J1939: error, not available)."""
FOLLOWS_NS = 1_500_000_000
"""For so long Follow is sent: three times."""
FLOW_STEP_L_MIN, FLOW_PLAY_L_MIN = 0.5, 0.35
"""Set points come in steps, and change when the flow needed is so far away."""
HIGHEST_L_MIN, HIGHEST_ML_MIN = 30.0, 400.0
"""Limits of the set points."""
DOSES = {"normal": 1.0, "half": 0.5}
WIDTH_M = SECTIONS * CELL_M


class SprayerMission(Node):
    """The node. Takes `ORDERS` by `order`. held: commands that level 1 holds, by the alarm that does."""

    TICK_NS: ClassVar[int] = 100_000_000
    DBC: ClassVar[str] = "sprayer_boom.dbc"
    MORE_DBC: ClassVar[tuple[str, ...]] = ("isobus_tractor.dbc",)
    DBC_NODE: ClassVar[str] = "MISSION"
    HEARS: ClassVar[tuple[str, ...]] = ("SPRAYER_STATUS", "SPRAYER_ALARMS", "VP", "VDS", "GROUND_SPEED")
    SENDS: ClassVar[tuple[str, ...]] = (
        "SPRAYER_CMD", "SPRAYER_BOOM_CMD", "SPRAYER_MAIN_CMD", "SPRAYER_DIS_CMD", "SPRAYER_NOZZLES_CMD",
        *(f"SPRAYER_SECTION_{n}" for n in range(1, SECTIONS + 1)))
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("", "ignores repairs", "goes on sending what level 1 holds"),
        *COMMON_FAULTS,
    )
    ORDERS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("boom", "open", "unfold", lasts=False),
        Phrase("boom", "close", "stop spraying and fold", lasts=False),
        Phrase("spraying", "on", "spray as soon as the boom is open", lasts=False),
        Phrase("spraying", "off", "stop spraying", lasts=False),
        Phrase("section", "on", "open, map or not", count=SECTIONS, lasts=False),
        Phrase("section", "off", "closed, map or not", count=SECTIONS, lasts=False),
        Phrase("section", "by map", "as the weed map says", count=SECTIONS, lasts=False),
        *(Phrase("dose", name, f"{part:g} of the dose set", lasts=False) for name, part in DOSES.items()),
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("dose", "L/ha", 200, 10, 400, "water"),
        Setting("herbicide", "%", 2, 0.1, 5, "of the water"),
        Setting("speed", "km/h", 3, 0.5, 6, "assumed until a tractor tells its own"),
        Setting("lookahead", "s", 1, 0, 5, "time between command and effect of a section"),
        Setting("boom_behind", "m", 2, 0, 10, "from the antenna to the boom"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self._dose_l_ha, self._herbicide = chosen["dose"], chosen["herbicide"] / 100
        self._assumed_m_s = chosen["speed"] / 3.6
        self._lookahead_s, self._behind_m = chosen["lookahead"], chosen["boom_behind"]
        self._map = paper_map()
        self.held: dict[str, str] = {}
        self._obedient = True
        self._boom = "Stop"
        self._spraying = False
        self._fixed: dict[int, str] = {}
        self._dose = DOSES["normal"]
        self._main_l_min = 0.0
        self._status: Mapping[str, Value] = {}
        self._alarms: Mapping[str, Value] = {}
        self._follow_until_ns: dict[int, int] = {}
        self._place: tuple[int, float, float] | None = None
        self._heading_rad = 0.0
        self._speed_m_s: float | None = None

    def order(self, now_ns: int, statement: Statement) -> None:
        """One of `ORDERS`. Raises ValueError for another."""
        self.tell(now_ns, f"order: {statement}")
        match statement.device, statement.action:
            case "boom", action:
                self._boom = action.capitalize()
                self._spraying = self._spraying and action == "open"
            case "spraying", action:
                self._spraying = action == "on"
            case "section", action:
                for section in range(1, SECTIONS + 1) if statement.index is None else (statement.index,):
                    self._fixed[section] = action
            case "dose", name if name in DOSES:
                self._dose = DOSES[name]
            case _:
                raise ValueError(f"{self.name} knows no order {statement}")

    # --- what it hears ----------------------------------------------------------------------------------------------------

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """Hear a frame; 29-bit ones from any source."""
        super().receive(t_ns, can_id & ~0xFF | ANY_SOURCE if extended else can_id, extended, data)

    def hears(self, can_id: int, extended: bool) -> bool:
        """29-bit identifiers from any source."""
        return super().hears(can_id & ~0xFF | ANY_SOURCE if extended else can_id, extended)

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """Status, alarms, or where the tractor is."""
        match message:
            case "SPRAYER_STATUS":
                if values["Control"] == "Manual" and (self._spraying or self._boom != "Stop"):
                    self._spraying, self._boom = False, "Stop"
                    self.tell(t_ns, "someone has the hand panel: boom and spraying have to be ordered anew")
                self._status = values
            case "SPRAYER_ALARMS":
                if values != self._alarms:
                    self._alarms_changed(t_ns, self._alarms, values)
                    self._alarms = values
            case "VP":
                latitude, longitude = float(values["Latitude"]), float(values["Longitude"])
                if abs(latitude) <= 90 and abs(longitude) <= 180:
                    self._place = (t_ns, *to_metres(latitude, longitude))
            case "VDS":
                heading_deg = float(values["Heading"])
                self._heading_rad = math.radians(heading_deg) if heading_deg <= 360 else self._heading_rad
            case _:
                speed_m_s = float(values["GroundSpeed"])
                self._speed_m_s = speed_m_s if speed_m_s <= FASTEST_M_S else None

    def _alarms_changed(self, t_ns: int, before: Mapping[str, Value], now: Mapping[str, Value]) -> None:
        held = {HOLDS[alarm]: alarm for alarm, state in now.items() if alarm in HOLDS and state in HOLDING}
        for message in held.keys() - self.held.keys():
            what = "leaves {} to level 1 ({})" if self._obedient else "goes on sending {} although level 1 holds it ({})"
            self.tell(t_ns, what.format(message, held[message]))
        for message in self.held.keys() - held.keys():
            self.tell(t_ns, f"sends {message} again")
        self.held = held
        if self._spraying and any(now[alarm] == "LockedOut" for alarm in HOLDS):
            self._spraying = False
            self.tell(t_ns, "locked out: spraying has to be ordered anew")
        for section in range(1, SECTIONS + 1):
            was, state = before.get(f"Section{section}NotSet"), now[f"Section{section}NotSet"]
            if was in HOLDING and state not in HOLDING:
                self._follow_until_ns[section] = t_ns + FOLLOWS_NS

    # --- what it says -----------------------------------------------------------------------------------------------------

    def tick(self, t_ns: int) -> None:
        """One tick of 100 ms: the flow that dose and speed need."""
        speed_m_s = self._assumed_m_s if self._speed_m_s is None else self._speed_m_s
        needed_l_min = self._dose_l_ha * self._dose * WIDTH_M * speed_m_s * 60 / 10_000 if self._spraying else 0.0
        if abs(needed_l_min - self._main_l_min) > FLOW_PLAY_L_MIN or not needed_l_min:
            self._main_l_min = min(round(needed_l_min / FLOW_STEP_L_MIN) * FLOW_STEP_L_MIN, HIGHEST_L_MIN)

    def values(self, message: str) -> Mapping[str, Value] | None:
        """The commands; None for what level 1 holds, and for sections that need no order."""
        if self._obedient and message in self.held:
            return None
        match message:
            case "SPRAYER_CMD":
                works = self._spraying and self._boom == "Open" and self._status.get("BoomState") == "Open"
                return {"SprayingWanted": "On" if works else "Off", "Retry": "Off"}
            case "SPRAYER_BOOM_CMD":
                waits = self._boom == "Close" and self._status.get("Spraying") == "On"
                return {"BoomWanted": "Stop" if waits else self._boom, "Retry": "Off"}
            case "SPRAYER_MAIN_CMD":
                return {"MainFlowWanted": self._main_l_min, "Retry": "Off"}
            case "SPRAYER_DIS_CMD":
                herbicide_ml_min = min(self._main_l_min * 1000 * self._herbicide, HIGHEST_ML_MIN)
                return {"DisFlowWanted": round(herbicide_ml_min, 1), "Retry": "Off"}
            case "SPRAYER_NOZZLES_CMD":
                return self._pattern(self._next_tick_ns - self.TICK_NS)
            case _:
                return self._section(int(message.rpartition("_")[2]), self._next_tick_ns - self.TICK_NS)

    def _section(self, section: int, t_ns: int) -> Mapping[str, Value] | None:
        until_ns = self._follow_until_ns.get(section)
        if until_ns is None:
            return None
        if t_ns >= until_ns or self._alarms.get(f"Section{section}NotSet") in HOLDING:
            del self._follow_until_ns[section]
            return None
        return {"Order": "Follow"}

    def _pattern(self, t_ns: int) -> Mapping[str, Value]:
        """What each section is to do now."""
        if not self._spraying:
            return _ALL_OFF
        here = self._boom_place(t_ns)
        return {_WANTED[section - 1]: "On" if self._wanted(section, here) else "Off" for section in range(1, SECTIONS + 1)}

    def _wanted(self, section: int, here: tuple[float, float] | None) -> bool:
        fixed = self._fixed.get(section, "by map")
        if self._alarms.get(f"Section{section}NotSet") == "LockedOut" or fixed == "off":
            return False
        if fixed == "on":
            return True
        if here is None:
            return False
        right_m = (section - (SECTIONS + 1) / 2) * CELL_M
        return self._map.weed(here[0] + math.cos(self._heading_rad) * right_m, here[1] - math.sin(self._heading_rad) * right_m)

    def _boom_place(self, t_ns: int) -> tuple[float, float] | None:
        """Where the middle of the boom will be when a valve that is commanded now has moved; None without a position."""
        if self._place is None or t_ns - self._place[0] >= POSE_TIMEOUT_NS:
            return None
        age_s = (t_ns - self._place[0]) / 1e9
        ahead_m = (self._speed_m_s or 0.0) * (age_s + self._lookahead_s) - self._behind_m
        return (self._place[1] + math.sin(self._heading_rad) * ahead_m, self._place[2] + math.cos(self._heading_rad) * ahead_m)

    def restart(self, t_ns: int) -> None:
        """After a reset nothing is ordered."""
        self._boom = "Stop"
        self._spraying = False
        self._fixed.clear()
        self.held.clear()
        self._status = self._alarms = {}
        self._follow_until_ns.clear()
        self._place = None

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


_WANTED = tuple(f"Valve{n}Wanted" for n in range(1, SECTIONS + 1))
_ALL_OFF: Mapping[str, Value] = dict.fromkeys(_WANTED, "Off")
