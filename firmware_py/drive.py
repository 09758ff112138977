"""The drive of the tractor: it follows its path exactly, at the speed of each part of it, with real acceleration and braking."""
from __future__ import annotations

import math

from firmware_py.field import HEADLAND_M, LENGTH_M, TURN_RADIUS_M, Path, Pose

ACCELERATION_M_S2 = 0.3
BRAKE_M_S2, HARD_BRAKE_M_S2 = 0.8, 2.0
"""A pause, and a stop: from 3 km/h within 0.44 m and 0.17 m."""
PLANNED_M_S2 = 0.3
"""Before turns and the end of the path."""
ROLLING_M_S2, BLOCKED_M_S2 = 0.6, 4.0
"""Engine dead; wheels blocked."""
CRAWL_M_S = 0.1
KMH = 3.6
TOP_KMH = 6.0


class Drive:
    """The plant. speeds in km/h, in the field and in turns; passes: how many of the path's are driven.

    driven_m, speed_m_s, target_m_s: along the path. blocked: the wheels can't turn.
    """

    def __init__(self, dt_s: float, field_kmh: float, turn_kmh: float, passes: int):
        self._dt_s = dt_s
        self._speeds_m_s = field_kmh / KMH, turn_kmh / KMH
        self._path = Path()
        turns = max(0, passes - 1)
        self.length_m = min(self._path.length_m, passes * (LENGTH_M + 2 * HEADLAND_M) + turns * math.pi * TURN_RADIUS_M)
        self._last_m = self.length_m - 1e-6
        self._one_m = LENGTH_M + 2 * HEADLAND_M + math.pi * TURN_RADIUS_M
        self.driven_m = 0.0
        self.speed_m_s = 0.0
        self.target_m_s = 0.0
        self.blocked = False
        self.pose: Pose = self._path.at(0)

    @property
    def arrived(self) -> bool:
        """Whether it is at the end."""
        return self.driven_m >= self.length_m

    @property
    def passage(self) -> int:
        """The pass on which it is; the first is 1."""
        return int(min(self.driven_m, self.length_m - CRAWL_M_S) / self._one_m) + 1

    def fetch(self) -> None:
        """Somebody has brought it back to the start."""
        self.driven_m = self.speed_m_s = 0.0
        self.pose = self._path.at(0)

    def advance(self, *, limit_kmh: float, hard: bool, pulls: bool) -> None:
        """One tick. limit_kmh: 0 stands. hard: brake as in a stop. pulls: the engine does."""
        dt_s = self._dt_s
        self.target_m_s = min(limit_kmh / KMH, self._planned_m_s()) if limit_kmh > 0 else 0.0
        brake = HARD_BRAKE_M_S2 if hard else BRAKE_M_S2
        rise = ACCELERATION_M_S2 * dt_s
        if self.blocked:
            brake, rise = BLOCKED_M_S2, -BLOCKED_M_S2 * dt_s
        elif not pulls:
            brake, rise = max(ROLLING_M_S2, brake if not self.target_m_s else 0.0), -ROLLING_M_S2 * dt_s
        self.speed_m_s = max(0.0, self.speed_m_s + min(rise, max(-brake * dt_s, self.target_m_s - self.speed_m_s)))
        if self.speed_m_s:
            self.driven_m = min(self.length_m, self.driven_m + self.speed_m_s * dt_s)
            self.pose = self._path.at(min(self.driven_m, self._last_m))

    def _planned_m_s(self) -> float:
        """The speed of this part of the path, slow enough for the next turn and the end."""
        straight_m_s, turn_m_s = self._speeds_m_s
        left_m = self.length_m - self.driven_m
        if left_m <= 0:
            return 0.0
        planned = turn_m_s
        if not self.pose.turning:
            to_turn_m = self._path.to_turn_m(self.driven_m)
            planned = min(straight_m_s, max(turn_m_s, math.sqrt(turn_m_s**2 + 2 * PLANNED_M_S2 * to_turn_m)))
        return min(planned, max(CRAWL_M_S, math.sqrt(2 * PLANNED_M_S2 * left_m)))
