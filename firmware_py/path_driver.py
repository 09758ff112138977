"""A tractor that drives its path over the field and says where it is and how fast: position, direction and ground speed as
J1939 and ISO 11783 have them. No more than that: it takes no orders but faults.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.field import Path, Pose, to_degrees
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.participant import BusFrame
from firmware_py.quantity import Setting

CYCLE_NS = 100_000_000
"""Of all three messages: the tractor's own pace. The times in the DBC are what a receiver must reckon with."""
SOURCE_ADDRESS = 0x1C
"""In place of 0xFE, which stands for any source in the DBC."""
ACCELERATION_M_S2 = 0.3
KMH = 3.6
ALTITUDE_M = 650.0


class PathDriver(Node):
    """The node. Sends VP, VDS and GROUND_SPEED. `pose` is where its antenna is, `speed_m_s` how fast it moves."""

    TICK_NS: ClassVar[int] = 50_000_000
    DBC: ClassVar[str] = "isobus_tractor.dbc"
    DBC_NODE: ClassVar[str] = "TractorEcu"
    SENDS: ClassVar[tuple[str, ...]] = ("VP", "VDS", "GROUND_SPEED")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (Phrase("", "stands", "brakes and stands"), *COMMON_FAULTS)
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("speed", "km/h", 3, 0.5, 6, "in the field"),
        Setting("turn_speed", "km/h", 2, 0.5, 6, "in the turns"),
        Setting("start", "s", 0, 0, 86400, "when it starts to move"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self._cycles_ns = dict.fromkeys(self.SENDS, CYCLE_NS)
        self._speeds_m_s = (chosen["speed"] / KMH, chosen["turn_speed"] / KMH)
        self._start_ns = start_ns + round(chosen["start"] * 1e9)
        self._path = Path()
        self._stands = False
        self.driven_m = 0.0
        self.speed_m_s = 0.0
        self.pose: Pose = self._path.at(0)

    @property
    def arrived(self) -> bool:
        """Whether it stands at the end of its path."""
        return self.driven_m >= self._path.length_m

    def step(self, now_ns: int) -> list[BusFrame]:
        """Frames carry its source address."""
        return [frame._replace(can_id=frame.can_id & ~0xFF | SOURCE_ADDRESS) for frame in super().step(now_ns)]

    def tick(self, t_ns: int) -> None:
        """One tick of 50 ms."""
        if t_ns < self._start_ns or self.arrived:
            self.speed_m_s = 0.0
            return
        dt_s = self.TICK_NS / 1e9
        change = ACCELERATION_M_S2 * dt_s
        self.speed_m_s += min(change, max(-change, self._wanted_m_s() - self.speed_m_s))
        self.driven_m += self.speed_m_s * dt_s
        before, self.pose = self.pose, self._path.at(self.driven_m)
        if before.turning != self.pose.turning:
            self.tell(t_ns, "turns" if self.pose.turning else f"pass at x = {self.pose.x_m:g} m")
        if self.arrived:
            self.tell(t_ns, "end of the path")

    def _wanted_m_s(self) -> float:
        """The speed of this part of the path, and slow enough to have that of the next turn when it comes."""
        straight_m_s, turn_m_s = self._speeds_m_s
        if self._stands or not self.powered:
            return 0.0
        if self.pose.turning:
            return turn_m_s
        braking_m_s = math.sqrt(turn_m_s**2 + 2 * ACCELERATION_M_S2 * self._path.to_turn_m(self.driven_m))
        return min(straight_m_s, max(turn_m_s, braking_m_s))

    def values(self, message: str) -> Mapping[str, Value]:
        """Where it is, or how fast."""
        match message:
            case "VP":
                latitude, longitude = to_degrees(self.pose.x_m, self.pose.y_m)
                return {"Latitude": latitude, "Longitude": longitude}
            case "VDS":
                return {"Heading": self.pose.heading_deg, "NavigationSpeed": self.speed_m_s * KMH, "Pitch": 0.0,
                        "Altitude": ALTITUDE_M}
            case _:
                return {"GroundSpeed": self.speed_m_s, "GroundDistance": self.driven_m, "GroundDirection": "Forward"}

    def restart(self, t_ns: int) -> None:
        """Nothing is remembered that could be lost."""

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        if statement != Statement("", None, "stands"):
            super().fault(now_ns, statement)
        self._stands = True

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` also lets it drive on."""
        super().inject(now_ns, statement)
        if statement.action == WORKS:
            self._stands = False
