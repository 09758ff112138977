"""Rows of trees that a sprayer drives past, and how far their leaves are from it.

Crowns are ellipsoids in a line on either side, with gaps where a tree is missing; each tree has its own size, drawn from the seed.
At the end of a row the sprayer turns for a while, then come the next trees.
"""
from __future__ import annotations

import math
from random import Random
from typing import NamedTuple

SPREAD = 0.2
"""Sizes differ from the mean by up to this part."""
TRUNK_M = 0.4
ROWS_KEPT = 2


class Tree(NamedTuple):
    """A crown. centre_m: height of its middle; radius_m: along and across the row; half_m: half its height."""

    centre_m: float
    radius_m: float
    half_m: float


class Canopy:
    """The trees of a plantation, seen from a vehicle that drives between the rows.

    speed_m_s: its speed. spacing_m, height_m: of the trees. row_m: length of a row. turn_s: time at its end. missing: part of the
    trees that are not there. lane_m: from the sprayer's columns to the trunks.
    """

    def __init__(self, seed: str, *, speed_m_s: float, spacing_m: float, height_m: float, row_m: float, turn_s: float,
                 missing: float, lane_m: float):
        self._seed = seed
        self._speed_m_s, self._spacing_m, self._height_m = speed_m_s, spacing_m, height_m
        self._row_m, self._turn_s, self._missing, self._lane_m = row_m, turn_s, missing, lane_m
        self._rows: dict[int, list[list[Tree | None]]] = {}

    def place(self, t_s: float) -> tuple[int, float | None]:
        """The row the vehicle is in, counted from 0, and how far; None while it turns."""
        if self._speed_m_s <= 0:
            return 0, self._spacing_m
        row_s = self._row_m / self._speed_m_s
        row, into_s = divmod(t_s, row_s + self._turn_s)
        return int(row), into_s * self._speed_m_s if into_s < row_s else None

    def distance_m(self, t_s: float, side: int, height_m: float, angle_deg: float) -> float | None:
        """From a column (side 0 left, 1 right) to the next leaves in the direction a nozzle points to, positive up; None: none."""
        row, along_m = self.place(t_s)
        if along_m is None:
            return None
        trees = self._trees(row)[side]
        number = round(along_m / self._spacing_m)
        tree = trees[number] if number < len(trees) else None
        if tree is None:
            return None
        beside_m = abs(along_m - number * self._spacing_m)
        if beside_m >= tree.radius_m:
            return None
        part = math.sqrt(1 - (beside_m / tree.radius_m) ** 2)
        return self._ray(height_m - tree.centre_m, angle_deg, tree.radius_m * part, tree.half_m * part)

    def _ray(self, up_m: float, angle_deg: float, across_m: float, half_m: float) -> float | None:
        """Where a ray from the column enters an ellipse around the line of trees; up_m: its start above the ellipse's middle."""
        slope = math.tan(math.radians(angle_deg))
        a = 1 / across_m ** 2 + (slope / half_m) ** 2
        b = -self._lane_m / across_m ** 2 + up_m * slope / half_m ** 2
        c = (self._lane_m / across_m) ** 2 + (up_m / half_m) ** 2 - 1
        inside = b * b - a * c
        if inside < 0:
            return None
        sideways_m = max((-b - math.sqrt(inside)) / a, 0.05)
        return sideways_m / math.cos(math.radians(angle_deg))

    def _trees(self, row: int) -> list[list[Tree | None]]:
        """Both sides of a row. Drawn from seed and row, so that it does not matter who asks, and when."""
        if row not in self._rows:
            if len(self._rows) >= ROWS_KEPT:
                self._rows.clear()
            random = Random(f"{self._seed}/{row}")
            count = int(self._row_m / self._spacing_m) + 1
            self._rows[row] = [[self._grow(random) for _ in range(count)] for _ in range(2)]
        return self._rows[row]

    def _grow(self, random: Random) -> Tree | None:
        gap = random.random() < self._missing
        height_m = self._height_m * random.uniform(1 - SPREAD, 1 + SPREAD)
        radius_m = min(self._spacing_m / 2, self._lane_m - 0.2) * random.uniform(1 - SPREAD, 1)
        half_m = (height_m - TRUNK_M) / 2
        return None if gap else Tree(TRUNK_M + half_m, radius_m, half_m)
