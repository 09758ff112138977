"""A GNSS receiver that speaks on a CAN bus: its messages become what the UCS says of a receiver of its own (`UCS_GNSS_…`).

PGN 65267, 65256 and 65254 (SAE J1939-71: vehicle position, direction and speed, time and date), 129025 and 129026 (NMEA 2000: the
same faster). So the alarms of `ucs.dbc` about position hold for it as for one on a serial line: no data, no fix, implausible
jumps, a wall clock that disagrees. What these messages do not say (kind of fix, satellites, corrections) stays unknown.

Pure. The first source that speaks of a position is the receiver, until it has been silent for `QUIET_NS`. What it says is not sent
on the bus again: it comes from there.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from level1.frame import BUS_SHIFT
from level1.health import HEARTBEAT_NS, GnssReadings, Reading
from level1.navigation import FIXES, Navigation, Place, jump_m
from level1.timer import FAR, Timers

POSITION, MOTION, TIME = 65267, 65256, 65254
RAPID_POSITION, RAPID_MOTION = 129025, 129026
QUIET_NS = 15_500_000_000
"""Silence that ends a receiver: three of the 5 s that J1939-71 allows between two positions, and half a second."""
FRESH_NS = 3_000_000_000
"""Age at which speed and time are no value any more."""
NO_FIX, FIX = FIXES.index("NoFix"), FIXES.index("Gnss")

_VALID_16, _VALID_32 = 0xFAFF, 0xFAFF_FFFF
"""Highest raw values that are none of error or not available (SAE J1939-71 table 1)."""


class CanReceiver:
    """Listens on one bus. told: takes a reading. utc_offset_ns: wall clock minus time line, None where it is not known."""

    def __init__(self, bus: int, timers: Timers, told: Callable[[Reading], None], utc_offset_ns: Callable[[], int | None]):
        self._bus, self._timers, self._told, self._utc_offset_ns = bus, timers, told, utc_offset_ns
        self._readings = GnssReadings()
        self._source: int | None = None
        self._heard_ns = 0
        self._begun_ns = 0
        self._place: Place | None = None
        self._placed = False
        self._jump_m: float | None = None
        self._motion: dict[str, float | None] = {}
        self._moved_ns = -FAR
        self._utc: tuple[int, int] | None = None
        self.order = timers.order()
        self.due = FAR

    def listeners(self) -> dict[int, Callable[[int, int, bytes], None]]:
        """Who wants to hear which parameter group."""
        return {POSITION: self._j1939_position, MOTION: self._j1939_motion, TIME: self._j1939_time,
                RAPID_POSITION: self._rapid_position, RAPID_MOTION: self._rapid_motion}

    def start(self, t_ns: int) -> None:
        """The time line begins: from now on a receiver is waited for."""
        self._begun_ns = t_ns
        self._timers.set(self, t_ns + HEARTBEAT_NS)

    def expire(self, now_ns: int) -> None:
        """Time for a sign of life, also of a receiver that has none."""
        self._tell(now_ns, set())
        self._timers.set(self, now_ns + HEARTBEAT_NS)

    # --- what is heard ----------------------------------------------------------------------------------------------------

    def _j1939_position(self, t_ns: int, key: int, data: bytes) -> None:
        if len(data) == 8:
            self._position(t_ns, key, [raw * 1e-7 - 210 if raw <= _VALID_32 else None
                                       for raw in (_little(data, 0, 4), _little(data, 4, 8))])

    def _rapid_position(self, t_ns: int, key: int, data: bytes) -> None:
        if len(data) == 8:
            self._position(t_ns, key, [raw * 1e-7 if raw < 0x7FFF_FFFE else None
                                       for raw in (int.from_bytes(data[at:at + 4], "little", signed=True) for at in (0, 4))])

    def _j1939_motion(self, t_ns: int, key: int, data: bytes) -> None:
        if len(data) == 8:
            course, speed, _, altitude = (_little(data, at, at + 2) for at in (0, 2, 4, 6))
            self._motion_is(t_ns, key, course_deg=course / 128 if course <= _VALID_16 else None,
                            speed_km_h=speed / 256 if speed <= _VALID_16 else None,
                            altitude_m=altitude / 8 - 2500 if altitude <= _VALID_16 else None)

    def _rapid_motion(self, t_ns: int, key: int, data: bytes) -> None:
        if len(data) == 8:
            course, speed = _little(data, 2, 4), _little(data, 4, 6)
            self._motion_is(t_ns, key, course_deg=math.degrees(course / 10_000) if course < 0xFFFE else None,
                            speed_km_h=speed * 0.036 if speed < 0xFFFE else None)

    def _j1939_time(self, t_ns: int, key: int, data: bytes) -> None:
        if len(data) < 6 or not self._is_its(t_ns, key):
            return
        quarters, minute, hour, month, day, year = data[:6]
        try:
            moment = datetime(1985 + year, month, (day + 3) // 4, hour, minute, quarters // 4, quarters % 4 * 250_000, UTC)
        except ValueError:  # not available, an error, or no time at all
            self._utc = None
        else:
            self._utc = t_ns, round(moment.timestamp() * 1000) * 1_000_000
        self._tell(t_ns, {"time"})

    # --- what comes of it -------------------------------------------------------------------------------------------------

    def _is_its(self, t_ns: int, key: int) -> bool:
        """Whether a frame is from the receiver; the first that speaks of a position becomes it."""
        return key >> BUS_SHIFT == self._bus and self._source == key & 0xFF and t_ns - self._heard_ns <= QUIET_NS

    def _position(self, t_ns: int, key: int, degrees: list[float | None]) -> None:
        if key >> BUS_SHIFT != self._bus:
            return
        if not self._is_its(t_ns, key):
            if self._source is not None and t_ns - self._heard_ns <= QUIET_NS:
                return
            self._source, self._place = key & 0xFF, None
        self._heard_ns = t_ns
        latitude, longitude = degrees
        self._placed = latitude is not None and longitude is not None and abs(latitude) <= 90 and abs(longitude) <= 180
        self._jump_m = None
        if self._placed:
            assert latitude is not None and longitude is not None
            speed = self._motion.get("speed_km_h") if t_ns - self._moved_ns <= FRESH_NS else None
            place = Place(t_ns, latitude, longitude, FIX, None, None if speed is None else speed / 3.6)
            self._jump_m = None if self._place is None else jump_m(self._place, place, QUIET_NS)
            self._place = place
        self._tell(t_ns, {"position", "status"})

    def _motion_is(self, t_ns: int, key: int, **values: float | None) -> None:
        if self._is_its(t_ns, key):
            self._motion, self._moved_ns = self._motion | values, t_ns
            self._tell(t_ns, {"motion"})

    def _navigation(self, t_ns: int) -> Navigation:
        """What is known at t_ns."""
        is_heard = self._source is not None and t_ns - self._heard_ns <= QUIET_NS
        known: dict[str, Any] = {}
        if is_heard and self._placed and self._place is not None:
            known |= {"latitude_deg": self._place.latitude_deg, "longitude_deg": self._place.longitude_deg, "jump_m": self._jump_m}
        if is_heard and t_ns - self._moved_ns <= FRESH_NS:
            known |= self._motion
        if is_heard and self._utc is not None and t_ns - self._utc[0] <= FRESH_NS:
            utc_ns = self._utc[1] + t_ns - self._utc[0]
            known |= {"utc_ns": utc_ns, "time_of_day_ns": utc_ns % 86_400_000_000_000, "utc_confirmed": self._placed}
        link = "Receiving" if is_heard else None if t_ns - self._begun_ns <= QUIET_NS else "Quiet"
        return Navigation(**known, fix=(FIX if self._placed else NO_FIX) if is_heard else None, link=link,
                          position_age_ns=None if self._place is None else t_ns - self._place.t_ns)

    def _tell(self, t_ns: int, news: set[str]) -> None:
        navigation = self._navigation(t_ns)
        offset_ns = self._utc_offset_ns()
        error_ns = None if offset_ns is None or navigation.utc_ns is None else t_ns + offset_ns - navigation.utc_ns
        for reading in self._readings.take(t_ns, news, navigation, error_ns):
            self._told(reading)


def _little(data: bytes, begin: int, end: int) -> int:
    return int.from_bytes(data[begin:end], "little")
