"""Where and when the unit is, as its GNSS receiver says, and how far that can be believed.

A plausible position moves no faster than the receiver's own speed says. What a new position lies beyond that is the *jump*.
"""
from __future__ import annotations

import math
from collections import deque

import msgspec

JUDGED_NS = 5_000_000_000
"""Two positions further apart in time than this are not compared."""
MARGIN_M_S = 1.0
"""How much faster than its own speed a position may move: noise of a fix without corrections, and acceleration between two."""
FASTEST_M_S = 14.0
"""Speed reckoned with where the receiver gives none: a tractor on the road, 50 km/h."""
CHANGE_M = 5.0
"""How far a position may move because the kind of fix has changed: from standard service to RTK and back."""
EARTH_M = 6_371_008.8
"""Mean radius of the Earth (GRS 80)."""
DAY_NS = 86_400_000_000_000
WINDOW_S = 60
"""Seconds of which the least delayed sentence sets the clock: a crystal drifts 3 ms in it."""
HOLDOVER_NS = 600_000_000_000
"""For how long the clock set by the receiver is trusted without it: 30 ms of drift."""

FIXES = ("NoFix", "Gnss", "Differential", "Precise", "RtkFixed", "RtkFloat", "Estimated", "Manual", "Simulated")
"""Fix quality by its number in GGA (IEC 61162-1)."""
MEASURED = range(1, 6)
"""Fix qualities of a position measured by satellites; the others are guesses or inventions."""
LINKS = ("Receiving", "Quiet", "Garbled", "Frozen", "Unplugged", "Unusable")
"""State of the line: right sentences come; nothing comes; bytes come but no right sentence (wrong baud rate, noise); the
receiver's clock stands still; the port is gone; right sentences come, but none that says whether there is a position."""


class Navigation(msgspec.Struct, frozen=True):
    """What is known of the unit from its GNSS receiver at one time; None: not known, or too old.

    fix: index into `FIXES`. time_of_day_ns: UTC since midnight; utc_confirmed: by satellites, not by the receiver's own clock
    only. position_age_ns: since the last position came. jump_m: by how much the last position lies beyond where the speed
    could have brought the unit. rtk_seen: whether the fix was RTK before. link: a word of `LINKS`. Angles are degrees from
    true north, clockwise.
    """

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    speed_km_h: float | None = None
    course_deg: float | None = None
    heading_deg: float | None = None
    fix: int | None = None
    satellites: int | None = None
    hdop: float | None = None
    correction_age_s: float | None = None
    position_age_ns: int | None = None
    jump_m: float | None = None
    time_of_day_ns: int | None = None
    utc_ns: int | None = None
    utc_confirmed: bool = False
    rtk_seen: bool = False
    link: str | None = None


class Place(msgspec.Struct, frozen=True):
    """A measured position, for comparison with the next."""

    t_ns: int
    latitude_deg: float
    longitude_deg: float
    fix: int
    time_of_day_ns: int | None
    speed_m_s: float | None


class ClockOffset:
    """UTC minus the time line, from sentences that all come late, some less: the largest difference is the least delayed."""

    def __init__(self) -> None:
        self._seconds: deque[tuple[int, int]] = deque(maxlen=WINDOW_S)

    def sample(self, t_ns: int, utc_ns: int) -> None:
        """A sentence that came at t_ns says that it is utc_ns."""
        offset = utc_ns - t_ns
        if self._seconds and t_ns - self._seconds[-1][0] < 1_000_000_000:
            last_ns, last = self._seconds[-1]
            self._seconds[-1] = (last_ns, max(last, offset))
        else:
            self._seconds.append((t_ns, offset))

    def at(self, t_ns: int) -> int | None:
        """UTC minus the time line, ns; None: not known, or not for too long."""
        if not self._seconds or t_ns - self._seconds[-1][0] > HOLDOVER_NS:
            return None
        since = self._seconds[-1][0] - WINDOW_S * 1_000_000_000
        return max(offset for sampled_ns, offset in self._seconds if sampled_ns >= since)


def distance_m(one: Place, other: Place) -> float:
    """Metres between two places on the sphere (haversine formula)."""
    phi, psi = math.radians(one.latitude_deg), math.radians(other.latitude_deg)
    d_lambda = math.radians(other.longitude_deg - one.longitude_deg)
    a = math.sin((psi - phi) / 2) ** 2 + math.cos(phi) * math.cos(psi) * math.sin(d_lambda / 2) ** 2
    return 2 * EARTH_M * math.asin(math.sqrt(min(a, 1.0)))


def jump_m(one: Place, other: Place, judged_ns: int = JUDGED_NS) -> float | None:
    """By how many metres the second place lies beyond the reach of the speeds; None: longer after the first than can be judged."""
    passed_ns = other.t_ns - one.t_ns
    if one.time_of_day_ns is not None and other.time_of_day_ns is not None:
        passed_ns = (other.time_of_day_ns - one.time_of_day_ns) % DAY_NS
    if not 0 <= passed_ns <= judged_ns:
        return None
    speeds = [place.speed_m_s for place in (one, other) if place.speed_m_s is not None]
    reach = (max(speeds, default=FASTEST_M_S) + MARGIN_M_S) * passed_ns / 1e9
    if one.fix != other.fix:
        reach += CHANGE_M
    return max(0.0, distance_m(one, other) - reach)
