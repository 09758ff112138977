"""NMEA 0183 (IEC 61162-1): from the bytes of a serial line to sentences, from sentences to where and when the unit is.

Theory of operation. `Framer` cuts sentences out of whatever comes: binary of the receiver's own protocol, noise, halves of
sentences at a plug pulled and put back. Only what carries a right checksum counts. `Navigator` keeps the last value of each
quantity with its time; a value older than `FRESH_NS` is no value, so a receiver that falls silent looks like one that knows
nothing, never like one that stands still. A receiver says the same in several sentences: for each topic the best one that
comes is the *leader*, the others stand by.

Sentences used: GGA, RMC, VTG, ZDA, HDT, THS of any talker; all others, proprietary ones among them, are left alone.
"""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import UTC, date, datetime, time
from typing import Any

from pynmeagps import NMEAReader

from level1.navigation import FIXES, MEASURED, ClockOffset, Navigation, Place, jump_m

LONGEST = 160
"""Bytes of a sentence up to its checksum. IEC 61162-1 allows 82 with CR and LF; receivers that give long fractions of a minute
need 100."""
FRESH_NS = 3_000_000_000
"""Age at which a value is no value any more. Slow receivers speak every 2 s."""
QUIET_NS = 3_000_000_000
"""Time without a right sentence after which the receiver counts as not heard."""
FROZEN_NS = 5_000_000_000
"""Time for which the receiver's clock may stand still while it speaks."""
UNUSABLE_NS = 10_000_000_000
"""Time without a word about the position after which the other sentences are worth nothing."""
LEAD_NS = 5_000_000_000
"""Silence of a leading sentence after which another one leads."""
KNOT_KM_H = 1.852
TOO_EARLY_NS = int(datetime(2000, 1, 1, tzinfo=UTC).timestamp()) * 1_000_000_000
"""UTC before which a receiver does not know the date yet."""
TOPICS = ("position", "motion", "status", "time")
_GOES_ON = ("time_of_day_ns", "utc_ns")
_MODES = {"N": 0, "A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
_BODY = re.compile(rb"\$[\x20-\x23\x25-\x29\x2b-\x7e]*")
_NEW_LINE = re.compile(rb"[\r\n]+")
_HEX = re.compile(rb"\*([0-9A-Fa-f]{2})")


class Framer:
    """Cuts sentences out of a stream of bytes. counters: sentences, and what was none and why."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The sentences completed by these bytes, each from `$` to its checksum."""
        data = self._rest + data
        found: list[bytes] = []
        place = 0
        while (start := data.find(b"$", place)) >= 0:
            self._between(data[place:start])
            body = _BODY.match(data, start)
            assert body is not None
            end = body.end()
            if end - start > LONGEST:
                self.counters["cut short or too long"] += 1
                place = end
            elif len(data) < end + 3 and data[end:end + 1] in (b"", b"*"):
                self._rest = data[start:]
                return found
            else:
                place = self._sentence(data, start, end, found)
        self._between(data[place:])
        self._rest = b""
        return found

    def reset(self) -> None:
        """What follows does not continue what came: the line was open."""
        if self._rest:
            self.counters["cut short or too long"] += 1
        self._rest = b""

    def _sentence(self, data: bytes, start: int, end: int, found: list[bytes]) -> int:
        """Judge what stands from `$` to the end of its printable characters; gives where to go on."""
        mark = _HEX.match(data, end)
        if mark is None:
            self.counters["cut short or too long"] += 1
            return end
        total = 0
        for byte in data[start + 1:end]:
            total ^= byte
        if total == int(mark[1], 16):
            self.counters["sentences"] += 1
            found.append(data[start:mark.end()])
        else:
            self.counters["wrong checksums"] += 1
        return mark.end()

    def _between(self, data: bytes) -> None:
        if foreign := len(_NEW_LINE.sub(b"", data)):
            self.counters["foreign bytes"] += foreign


class Leaders:
    """Which sentence speaks for a topic: of those that come, the first in the topic's list."""

    def __init__(self, ranks: Mapping[str, tuple[str, ...]]):
        self._ranks = ranks
        self._present: dict[str, tuple[str, int]] = {}

    def leads(self, topic: str, kind: str, t_ns: int) -> bool:
        """Whether a sentence of this kind, come at t_ns, speaks for the topic."""
        ranks = self._ranks[topic]
        if kind not in ranks:
            return False
        leader, heard_ns = self._present.get(topic, (kind, t_ns))
        if t_ns - heard_ns <= LEAD_NS and ranks.index(leader) < ranks.index(kind):
            return False
        self._present[topic] = (kind, t_ns)
        return True

    def has(self, topic: str, t_ns: int) -> bool:
        """Whether any sentence speaks for the topic at present."""
        return topic in self._present and t_ns - self._present[topic][1] <= LEAD_NS


RANKS = {"position": ("GGA", "RMC"), "motion": ("VTG", "RMC"), "heading": ("THS", "HDT"), "time": ("ZDA", "RMC")}


class Navigator:
    """What the receiver says, put together. counters: those of the framer, and sentences that can't be read."""

    def __init__(self) -> None:
        self._framer = Framer()
        self.counters = self._framer.counters
        self._leaders = Leaders(RANKS)
        self._items: dict[str, tuple[int, Any]] = {}
        self._place: Place | None = None
        self._clock = ClockOffset()
        self._rtk_seen = False
        self._open_ns: int | None = None
        self._byte_ns = self._sentence_ns = self._moved_ns = self._said_ns = 0
        self._stands: int | None = None

    # --- the line ---------------------------------------------------------------------------------------------------------

    def opened(self, t_ns: int) -> None:
        """The port is open, for the first time or again."""
        self._framer.reset()
        self._open_ns = self._byte_ns = self._sentence_ns = self._moved_ns = self._said_ns = t_ns

    def lost(self) -> None:
        """The port is gone."""
        self._open_ns = None

    def feed(self, t_ns: int, data: bytes) -> set[str]:
        """Take bytes that came at t_ns (ns on the time line); gives the topics (of `TOPICS`) with news."""
        if data:
            self._byte_ns = t_ns
        news: set[str] = set()
        for sentence in self._framer.feed(data):
            self._sentence_ns = t_ns
            news |= self._take(t_ns, sentence)
        return news

    def link(self, t_ns: int) -> str | None:
        """State of the line, a word of `LINKS`; None: opened just now, nothing is known yet."""
        if self._open_ns is None:
            return "Unplugged"
        if t_ns - self._sentence_ns > QUIET_NS:
            return "Quiet" if t_ns - self._byte_ns > QUIET_NS else "Garbled"
        if self._stands is not None and self._said_ns - self._moved_ns > FROZEN_NS:
            return "Frozen"
        if t_ns - self._said_ns > UNUSABLE_NS:
            return "Unusable"
        return "Receiving" if self._sentence_ns > self._open_ns else None

    # --- what is known ----------------------------------------------------------------------------------------------------

    def navigation(self, t_ns: int) -> Navigation:
        """What is known at t_ns; the time of the day has gone on since it was said."""
        fresh = {name: value + t_ns - since_ns if name in _GOES_ON else value
                 for name, (since_ns, value) in self._items.items() if t_ns - since_ns <= FRESH_NS}
        age = None if self._place is None else t_ns - self._place.t_ns
        return Navigation(**fresh, position_age_ns=age, rtk_seen=self._rtk_seen, link=self.link(t_ns))

    def utc_offset_ns(self, t_ns: int) -> int | None:
        """UTC minus the time line as the satellites gave it; None: never, or too long ago."""
        return self._clock.at(t_ns)

    # --- sentences --------------------------------------------------------------------------------------------------------

    def _take(self, t_ns: int, sentence: bytes) -> set[str]:
        kind = sentence[3:6].decode()
        read = _READERS.get(kind)
        if read is None or sentence[1:2] == b"P" or sentence[6:7] != b",":
            return set()
        try:
            said = read(NMEAReader.parse(sentence, validate=0))
        except Exception:  # whatever the library makes of a sentence that is none: the line goes on
            self.counters["unreadable sentences"] += 1
            return set()
        news: set[str] = set()
        if "fix" in said and self._leaders.leads("position", kind, t_ns):
            self._locate(t_ns, said)
            news |= {"position", "status"}
        if "speed_km_h" in said and self._leaders.leads("motion", kind, t_ns):
            self._keep(t_ns, said, "speed_km_h", "course_deg")
            news.add("motion")
        if "heading_deg" in said and self._leaders.leads("heading", kind, t_ns):
            self._keep(t_ns, said, "heading_deg")
            if not self._leaders.has("motion", t_ns):
                news.add("motion")
        if "utc_ns" in said and self._leaders.leads("time", kind, t_ns):
            self._tell_time(t_ns, said)
            news.add("time")
        return news

    def _keep(self, t_ns: int, said: Mapping[str, Any], *names: str) -> None:
        for name in names:
            if said.get(name) is None:
                self._items.pop(name, None)
            else:
                self._items[name] = (t_ns, said[name])

    def _value(self, name: str, t_ns: int) -> Any:
        since_ns, value = self._items.get(name, (0, None))
        return value if t_ns - since_ns <= FRESH_NS else None

    def _locate(self, t_ns: int, said: Mapping[str, Any]) -> None:
        """A position, or that there is none."""
        self._keep(t_ns, said, "latitude_deg", "longitude_deg", "altitude_m", "fix", "satellites", "hdop", "correction_age_s")
        stands = said.get("time_of_day_ns")
        if not self._leaders.has("time", t_ns):
            self._keep(t_ns, said, "time_of_day_ns")
        if stands is None or stands != self._stands:
            self._moved_ns = t_ns
        self._stands = stands
        if said["fix"] is not None:
            self._said_ns = t_ns
        self._rtk_seen = self._rtk_seen or said["fix"] == FIXES.index("RtkFixed")
        jump = None
        if said.get("latitude_deg") is not None and said.get("longitude_deg") is not None and said["fix"] in MEASURED:
            speed_km_h = said.get("speed_km_h", self._value("speed_km_h", t_ns))
            place = Place(t_ns, said["latitude_deg"], said["longitude_deg"], said["fix"], stands,
                          None if speed_km_h is None else speed_km_h / 3.6)
            jump = None if self._place is None else jump_m(self._place, place)
            self._place = place
        self._keep(t_ns, {"jump_m": jump}, "jump_m")

    def _tell_time(self, t_ns: int, said: Mapping[str, Any]) -> None:
        """The time, confirmed or not."""
        utc_ns = said["utc_ns"]
        confirmed = utc_ns is not None and said.get("fix", self._value("fix", t_ns)) in MEASURED
        self._keep(t_ns, {**said, "utc_confirmed": confirmed or None}, "utc_ns", "time_of_day_ns", "utc_confirmed")
        if confirmed:
            self._clock.sample(t_ns, utc_ns)


def _number(value: Any, low: float, high: float) -> float | None:
    """A number within limits, else None."""
    return float(value) if isinstance(value, (int, float)) and low <= value <= high else None


def _whole(value: Any, low: int, high: int) -> int | None:
    number = _number(value, low, high)
    return None if number is None else int(number)


def _of_day(value: Any) -> int | None:
    """Nanoseconds since midnight of a time."""
    if not isinstance(value, time):
        return None
    return ((value.hour * 60 + value.minute) * 60 + value.second) * 1_000_000_000 + value.microsecond * 1000


def _utc(day: int, month: int, year: int, of_day_ns: int | None) -> int | None:
    """Nanoseconds since 1970, None when it can't be or the receiver does not know the date yet."""
    if of_day_ns is None:
        return None
    utc_ns = int(datetime(year, month, day, tzinfo=UTC).timestamp()) * 1_000_000_000 + of_day_ns
    return utc_ns if utc_ns >= TOO_EARLY_NS else None


def _place_of(sentence: Any, fix: int | None) -> dict[str, Any]:
    """Latitude and longitude, both or none."""
    latitude, longitude = _number(sentence.lat, -90, 90), _number(sentence.lon, -180, 180)
    if not fix or latitude is None or longitude is None or sentence.NS not in ("N", "S") or sentence.EW not in ("E", "W"):
        return {"latitude_deg": None, "longitude_deg": None}
    return {"latitude_deg": latitude, "longitude_deg": longitude}


def _gga(sentence: Any) -> dict[str, Any]:
    """Fix: time, position, quality, satellites, dilution of precision, altitude above the geoid, age of corrections."""
    fix = 2 if sentence.quality == 9 else _whole(sentence.quality, 0, len(FIXES) - 1)  # NovAtel's 9: corrected by satellites
    altitude = _number(getattr(sentence, "alt", None), -2500, 20_000)
    return {**_place_of(sentence, fix), "fix": fix, "satellites": _whole(getattr(sentence, "numSV", None), 0, 99),
            "hdop": _number(getattr(sentence, "HDOP", None), 0, 99.99), "altitude_m": altitude if fix else None,
            "correction_age_s": _number(getattr(sentence, "diffAge", None), 0, 9999),
            "time_of_day_ns": _of_day(sentence.time)}


def _rmc(sentence: Any) -> dict[str, Any]:
    """Recommended minimum: time and date, status, position, speed, course. Without mode (before version 2.3) A means a fix."""
    mode = getattr(sentence, "posMode", "") or "A"
    fix = _MODES.get(mode) if sentence.status == "A" else 0
    of_day, day = _of_day(sentence.time), getattr(sentence, "date", None)
    utc_ns = _utc(day.day, day.month, day.year, of_day) if isinstance(day, date) else None
    speed = _number(sentence.spd, 0, 1000)
    return {**_place_of(sentence, fix), "fix": fix, "speed_km_h": speed * KNOT_KM_H if fix and speed is not None else None,
            "course_deg": _number(sentence.cog, 0, 360) if fix else None, "time_of_day_ns": of_day, "utc_ns": utc_ns}


def _vtg(sentence: Any) -> dict[str, Any]:
    """Course and speed over ground; mode N or an empty one of an older version says by empty fields that there are none."""
    invalid = getattr(sentence, "posMode", "") == "N"
    knots, km_h = _number(sentence.sogn, 0, 1000), _number(getattr(sentence, "sogk", None), 0, 2000)
    speed = km_h if km_h is not None else knots * KNOT_KM_H if knots is not None else None
    return {"speed_km_h": None if invalid else speed, "course_deg": None if invalid else _number(sentence.cogt, 0, 360)}


def _zda(sentence: Any) -> dict[str, Any]:
    """Time and date."""
    of_day = _of_day(sentence.time)
    parts = (sentence.day, sentence.month, sentence.year)
    utc_ns = _utc(*parts, of_day) if all(isinstance(part, int) for part in parts) else None
    return {"time_of_day_ns": of_day, "utc_ns": utc_ns}


def _hdt(sentence: Any) -> dict[str, Any]:
    """True heading."""
    return {"heading_deg": _number(sentence.headingT, 0, 360)}


def _ths(sentence: Any) -> dict[str, Any]:
    """True heading and its mode: A measured, E estimated; M, S and V are no heading of this unit."""
    return {"heading_deg": _number(sentence.headt, 0, 360) if sentence.mi in ("A", "E") else None}


_READERS: dict[str, Callable[[Any], dict[str, Any]]] = {
    "GGA": _gga, "RMC": _rmc, "VTG": _vtg, "ZDA": _zda, "HDT": _hdt, "THS": _ths}
