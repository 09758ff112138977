"""The field of the paper's mission: 42.5 m × 41.5 m, weed patches in cells of 0.5 m, and the way of a tractor over it.

Local coordinates: x metres to the east, y metres to the north of the south-west corner. Headings in degrees, clockwise from north.
"""
from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

WIDTH_M, LENGTH_M = 42.5, 41.5
CELL_M = 0.5
ORIGIN_DEG = (40.314195, -3.484272)
"""Latitude and longitude of the south-west corner: the paper's test field in Madrid (§5)."""
EARTH_RADIUS_M = 6_371_008.8
TRACK_M = 6.0
"""Distance of the passes: the width of the boom."""
TURN_RADIUS_M = 3.0
"""Of the turns on the headlands; the vehicle can do 2.89 m (paper §5.1)."""
HEADLAND_M = 4.0
"""The antenna drives so far beyond the field before it turns: the boom behind it has left the field then."""


def to_degrees(x_m: float, y_m: float) -> tuple[float, float]:
    """Latitude and longitude of a place."""
    latitude, longitude = ORIGIN_DEG
    return (latitude + math.degrees(y_m / EARTH_RADIUS_M),
            longitude + math.degrees(x_m / (EARTH_RADIUS_M * math.cos(math.radians(latitude)))))


def to_metres(latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """The place at a latitude and longitude; the inverse of `to_degrees`."""
    latitude, longitude = ORIGIN_DEG
    return (math.radians(longitude_deg - longitude) * EARTH_RADIUS_M * math.cos(math.radians(latitude)),
            math.radians(latitude_deg - latitude) * EARTH_RADIUS_M)


class Patch(NamedTuple):
    """A patch of weeds: its centre, half its width and length, and its shape: diamond, ellipse or rectangle."""

    shape: str
    x_m: float
    y_m: float
    half_width_m: float
    half_length_m: float

    def covers(self, x_m: float, y_m: float) -> bool:
        """Whether a place lies in it."""
        across = abs(x_m - self.x_m) / self.half_width_m
        along = abs(y_m - self.y_m) / self.half_length_m
        match self.shape:
            case "diamond":
                return across + along <= 1
            case "ellipse":
                return across * across + along * along <= 1
            case _:
                return max(across, along) <= 1


PATCHES = (
    Patch("ellipse", 4.0, 9.0, 3.0, 4.0), Patch("rectangle", 8.5, 32.0, 2.0, 4.0), Patch("diamond", 15.0, 21.0, 3.0, 8.0),
    Patch("ellipse", 22.0, 7.5, 3.5, 3.0), Patch("diamond", 27.0, 30.0, 5.0, 6.0), Patch("rectangle", 34.5, 16.0, 2.0, 4.0),
    Patch("ellipse", 38.5, 33.0, 2.5, 5.0), Patch("rectangle", 20.0, 36.0, 0.5, 0.5), Patch("rectangle", 39.5, 5.0, 0.5, 0.5),
)
"""In the manner of the paper's Fig. 5: some large patches over one track or two, the large diamond inside the third track, and
two that are only two cells long."""


class WeedMap:
    """A matrix of cells of `CELL_M`, 1 where there is weed (paper §5)."""

    def __init__(self, patches: Iterable[Patch] = PATCHES):
        chosen = tuple(patches)
        self.columns, self.rows = round(WIDTH_M / CELL_M), round(LENGTH_M / CELL_M)
        self.cells = tuple(bytes(any(patch.covers((column + 0.5) * CELL_M, (row + 0.5) * CELL_M) for patch in chosen)
                                 for column in range(self.columns)) for row in range(self.rows))

    def weed(self, x_m: float, y_m: float) -> bool:
        """Whether there is weed at a place; none outside the field."""
        if not (0 <= x_m < WIDTH_M and 0 <= y_m < LENGTH_M):
            return False
        return bool(self.cells[int(y_m / CELL_M)][int(x_m / CELL_M)])


@cache
def paper_map() -> WeedMap:
    """The map of `PATCHES`."""
    return WeedMap()


class Pose(NamedTuple):
    """A place, a direction, and whether the way turns there."""

    x_m: float
    y_m: float
    heading_deg: float
    turning: bool


@dataclass(frozen=True)
class _Piece:
    """A straight piece (radius 0) or an arc from a pose on; radius positive to the right."""

    start: Pose
    length_m: float
    radius_m: float = 0.0

    def at(self, distance_m: float) -> Pose:
        x, y, heading, _ = self.start
        forward = math.radians(heading)
        if not self.radius_m:
            return Pose(x + math.sin(forward) * distance_m, y + math.cos(forward) * distance_m, heading, False)
        turned = distance_m / self.radius_m
        centre_x, centre_y = x + math.cos(forward) * self.radius_m, y - math.sin(forward) * self.radius_m
        return Pose(centre_x - math.cos(forward + turned) * self.radius_m, centre_y + math.sin(forward + turned) * self.radius_m,
                    math.degrees(forward + turned) % 360, True)


class Path:
    """Straight passes over the whole field with a half circle between two of them: up the first track, down the second, …"""

    def __init__(self) -> None:
        tracks = round((WIDTH_M - CELL_M) / TRACK_M)
        pass_m = LENGTH_M + 2 * HEADLAND_M
        self._pieces: list[_Piece] = []
        pose = Pose(TRACK_M / 2, -HEADLAND_M, 0.0, False)
        for track in range(tracks):
            pieces = [_Piece(pose, pass_m)]
            if track < tracks - 1:
                radius_m = TURN_RADIUS_M if track % 2 == 0 else -TURN_RADIUS_M
                pieces.append(_Piece(pieces[0].at(pass_m), math.pi * TURN_RADIUS_M, radius_m))
            self._pieces += pieces
            pose = pieces[-1].at(pieces[-1].length_m)
        self._starts_m = [0.0]
        for piece in self._pieces:
            self._starts_m.append(self._starts_m[-1] + piece.length_m)
        self.length_m = self._starts_m[-1]

    def at(self, distance_m: float) -> Pose:
        """The pose after so many metres; beyond the ends that of the end."""
        distance_m = min(max(distance_m, 0.0), self.length_m)
        number = min(bisect_right(self._starts_m, distance_m), len(self._pieces)) - 1
        return self._pieces[number].at(distance_m - self._starts_m[number])

    def to_turn_m(self, distance_m: float) -> float:
        """Metres to the next change from straight to turning; 0 within a turn, to the end on the last pass."""
        number = min(bisect_right(self._starts_m, distance_m), len(self._pieces)) - 1
        return 0.0 if self._pieces[number].radius_m else self._starts_m[number + 1] - distance_m
