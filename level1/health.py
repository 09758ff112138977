"""What the unit control system says of itself: readings of its computer and of its GNSS receiver as signals of DBC messages.

The names of messages and signals are those of `ucs.dbc`; bits, scales and value tables are whatever the loaded file gives
them. What is not known is sent as J1939 *not available* (all ones), what can't be as *error*: never as a value that looks
healthy (SAE J1939-71 table 1).
"""
from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import msgspec

from level1.catalog import Catalog, Message, Signal
from level1.decode import raw_range, reserved
from level1.navigation import DAY_NS, FIXES, MEASURED, Navigation

HEALTH, LOAD = "UCS_HEALTH", "UCS_LOAD"
LOG_ORDER, TIME_ORDER = "UCS_LOG_CMD", "UCS_TIME_CMD"
"""Messages by which repairs ask the UCS itself to begin a new traffic log, and to get the time again."""
POSITION, MOTION, STATUS, TIME = "UCS_GNSS_POSITION", "UCS_GNSS_MOTION", "UCS_GNSS_STATUS", "UCS_GNSS_TIME"
HOST_MESSAGES = (HEALTH, LOAD)
GNSS_MESSAGES = {"position": POSITION, "motion": MOTION, "status": STATUS, "time": TIME}
"""Message of each topic that a receiver speaks of (`nmea.TOPICS`)."""
READINGS = frozenset((*HOST_MESSAGES, *GNSS_MESSAGES.values()))
"""Messages in which the UCS tells what it has measured."""
HEARTBEAT_NS = 900_000_000
"""A message without news is sent again after this: before its cycle time of 1 s is over."""
BUS_STATES = ("BusActive", "BusWarning", "BusPassive", "BusOff", "BusDown")
"""State of a CAN controller, and last the interface that is gone; of several buses the worst counts."""

Value = float | str | bool | None
"""A physical value, a word of the value table, No/Yes as 0 and 1, or None: not known."""


class Reading(NamedTuple):
    """What was read at t_ns (ns on the time line), as physical values of the signals of a message."""

    t_ns: int
    message: str
    values: Mapping[str, Value]


class Host(msgspec.Struct, frozen=True):
    """State of the computer; None: it can't be measured here; NaN: its sensor can't be read any more. load: runnable tasks for each
    processor, mean of a minute. clock_synchronised: whether something keeps the wall clock right."""

    cpu_celsius: float | None = None
    mainboard_celsius: float | None = None
    ram_used_percent: float | None = None
    storage_used_percent: float | None = None
    load: float | None = None
    clock_synchronised: bool | None = None


class Loop(msgspec.Struct, frozen=True):
    """State of the supervision itself since the last reading. lateness_ns: the largest; None: not known.
    bus_state: a word of `BUS_STATES`. journal: a word of the signal JournalState. storage_writes: whether the last write to
    the storage succeeded. recorder_works: None where nothing is recorded; recorder_dropped: frames not recorded since the start."""

    lateness_ns: int | None = None
    frames_dropped: int | None = None
    bus_state: str | None = None
    bus_load_percent: float | None = None
    journal: str | None = None
    storage_writes: bool | None = None
    recorder_works: bool | None = None
    recorder_dropped: int | None = None


def raws(message: Message, values: Mapping[str, Value]) -> dict[str, int]:
    """Raw values of all signals of a message.

    A number beyond the limits of the DBC is sent as the limit. Not available: signals without a value. Error: NaN, and words
    that the value table lacks. Values without a signal are left out.
    """
    return {signal.name: _raw(signal, values.get(signal.name)) for signal in message.signals}


def readings_of(catalog: Catalog, names: Iterable[str]) -> frozenset[str]:
    """Those of the messages that the loaded definitions let the UCS send."""
    return frozenset(name for name in names if name in catalog.messages and catalog.messages[name].sent_by_ucs)


def _raw(signal: Signal, value: Value) -> int:
    if value is None:
        return _reserved(signal)[1]
    if isinstance(value, str):
        return next((raw for raw, word in signal.choices.items() if word == value), _reserved(signal)[0])
    if math.isnan(value):
        return _reserved(signal)[0]
    low, high = raw_range(signal)
    if ranges := reserved(signal):
        high = ranges[0][0] - 1
    factor, offset = float(signal.factor), float(signal.offset)
    limits = [(float(limit) - offset) / factor for limit in (signal.minimum, signal.maximum) if limit is not None]
    if len(limits) == 2:
        low, high = max(low, math.ceil(min(limits))), min(high, math.floor(max(limits)))
    exact = (value - offset) / factor
    return low if exact <= low else high if exact >= high else round(exact)


def _reserved(signal: Signal) -> tuple[int, int]:
    """Raw values that mean error and not available."""
    ranges = reserved(signal)
    top = raw_range(signal)[1]
    return (ranges[0][1], ranges[-1][1]) if ranges else (top, top)


def health(host: Host, loop: Loop, fix: int | None, gnss_time: bool) -> dict[str, Value]:
    """Signals of UCS_HEALTH. fix: index into `FIXES`; gnss_time: whether UTC comes from the receiver."""
    quality = None if fix is None else FIXES[fix] if fix in MEASURED else FIXES[0]
    return {
        "CpuTemperature": host.cpu_celsius, "MainboardTemperature": host.mainboard_celsius, "RamUsed": host.ram_used_percent,
        "StorageUsed": host.storage_used_percent, "StorageWrite": _works(loop.storage_writes),
        "TrafficLog": _works(loop.recorder_works), "BusState": loop.bus_state,
        "TimeSync": _synchronised(host.clock_synchronised, gnss_time), "JournalState": loop.journal, "GnssQuality": quality,
        "LoopLateness": None if loop.lateness_ns is None else loop.lateness_ns / 1e6, "BusLoad": loop.bus_load_percent}


def load(host: Host, loop: Loop) -> dict[str, Value]:
    """Signals of UCS_LOAD."""
    return {"LoadAverage": host.load, "FramesDropped": loop.frames_dropped, "TrafficLogDropped": loop.recorder_dropped}


def position(navigation: Navigation) -> dict[str, Value]:
    """Signals of UCS_GNSS_POSITION."""
    return {"GnssLatitude": navigation.latitude_deg, "GnssLongitude": navigation.longitude_deg}


def motion(navigation: Navigation) -> dict[str, Value]:
    """Signals of UCS_GNSS_MOTION."""
    return {"GnssSpeed": navigation.speed_km_h, "GnssCourse": navigation.course_deg, "GnssHeading": navigation.heading_deg,
            "GnssAltitude": navigation.altitude_m}


def status(navigation: Navigation) -> dict[str, Value]:
    """Signals of UCS_GNSS_STATUS."""
    age_ns = navigation.position_age_ns
    return {"GnssFix": None if navigation.fix is None else FIXES[navigation.fix], "GnssReceiver": navigation.link,
            "GnssSatellites": navigation.satellites, "GnssHdop": navigation.hdop,
            "GnssCorrectionAge": navigation.correction_age_s, "GnssPositionAge": None if age_ns is None else age_ns / 1e9,
            "GnssPositionJump": navigation.jump_m, "GnssRtkSeen": navigation.rtk_seen}


def time(navigation: Navigation, clock_error_ns: int | None) -> dict[str, Value]:
    """Signals of UCS_GNSS_TIME. clock_error_ns: the computer's wall clock minus UTC of the receiver, None: not known."""
    of_day_ns, utc_ns = navigation.time_of_day_ns, navigation.utc_ns
    return {"GnssTimeOfDay": None if of_day_ns is None else of_day_ns % DAY_NS // 1_000_000,
            "GnssDate": None if utc_ns is None else utc_ns // DAY_NS,
            "GnssTimeConfirmed": None if of_day_ns is None else navigation.utc_confirmed,
            "GnssClockError": None if clock_error_ns is None else clock_error_ns / 1e6}


class GnssReadings:
    """Turns what is known of the receiver into readings, when there is news and when it is time for a sign of life."""

    def __init__(self) -> None:
        self._sent_ns: dict[str, int] = {}

    def take(self, t_ns: int, news: Collection[str], navigation: Navigation, clock_error_ns: int | None) -> list[Reading]:
        """The readings due at t_ns. news: topics of which something has come."""
        readings = []
        for topic, message in GNSS_MESSAGES.items():
            if topic in news or t_ns - self._sent_ns.get(topic, t_ns - HEARTBEAT_NS) >= HEARTBEAT_NS:
                self._sent_ns[topic] = t_ns
                readings.append(Reading(t_ns, message, _values(topic, navigation, clock_error_ns)))
        return readings

    def again(self) -> None:
        """Everything is due at the next `take`: the line was lost or found."""
        self._sent_ns.clear()


def _values(topic: str, navigation: Navigation, clock_error_ns: int | None) -> dict[str, Value]:
    match topic:
        case "position":
            return position(navigation)
        case "motion":
            return motion(navigation)
        case "status":
            return status(navigation)
        case _:
            return time(navigation, clock_error_ns)


def _works(works: bool | None) -> str | None:
    return None if works is None else "Ok" if works else "Failed"


def _synchronised(clock: bool | None, gnss_time: bool) -> str | None:
    if clock is None and not gnss_time:
        return None
    return "Synchronised" if clock or gnss_time else "NotSynchronised"
