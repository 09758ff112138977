"""A recording of NMEA 0183 text, as the frames that a UCS with this receiver puts on its bus (`UCS_GNSS_…` of `ucs.dbc`).

Such a recording has no time stamps; its time line is that of the receiver's own sentences, from 0. Where they carry no time
(a receiver without reception), a position sentence that comes again begins the next epoch. Where they leap, back or by more than
`LEAP_NS`, the recorder was stopped or two recordings were joined: the time line goes on by one step. That the receiver was silent
meanwhile can't be known, and is no alarm.
"""
from __future__ import annotations

import re
import statistics
from collections.abc import Iterable, Iterator, Sequence

from level1 import health
from level1.catalog import Catalog
from level1.decode import encode
from level1.frame import BUS_SHIFT, Frame, frame_key
from level1.navigation import DAY_NS
from level1.nmea import Framer, Navigator

LEAP_NS = 5_000_000_000
DEFAULT_STEP_NS = 1_000_000_000
"""From epoch to epoch, where the recording does not say."""
LATEST_FIRST = 1 << 16
"""A sentence must be found within so many bytes, for a file to count as such a recording."""
_TIMED = re.compile(rb"\$..(?:(?:GGA|RMC|ZDA|GNS),|GLL,[^,]*,[^,]*,[^,]*,[^,]*,)(\d{2})(\d{2})(\d{2})(?:\.(\d{1,9}))?[,*]")
_PLACED = re.compile(rb"\$..(?:GGA|RMC|GLL|GNS),")


def is_nmea(head: bytes) -> bool:
    """Whether this is the beginning of such a recording: a sentence with a right checksum, of a position or time."""
    return any(_TIMED.match(sentence) or _PLACED.match(sentence) for sentence in Framer().feed(head[:LATEST_FIRST] + b"\n"))


def frames(data: bytes, catalog: Catalog, bus: int) -> Iterator[Frame]:
    """The frames of a recording. catalog: with the messages of `ucs.dbc`."""
    navigator, readings = Navigator(), health.GnssReadings()
    navigator.opened(0)
    for t_ns, line in dated(data.splitlines(keepends=True)):
        news = navigator.feed(t_ns, line)
        for reading in readings.take(t_ns, news, navigator.navigation(t_ns), None):
            message = catalog.messages[reading.message]
            key = frame_key(message.can_id, True) | bus << BUS_SHIFT
            yield Frame(t_ns, key, encode(message, health.raws(message, reading.values)))


def dated(lines: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """Each line with its time."""
    step_ns = _step_ns(lines)
    t_ns = 0
    anchor: tuple[int, int] | None = None
    placed: set[bytes] = set()
    for line in lines:
        of_day_ns = _of_day_ns(line)
        kind = match[0] if (match := _PLACED.search(line)) is not None else b""
        if of_day_ns is not None:
            if anchor is None:
                t_ns += step_ns * (kind in placed)
            else:
                said_ns = anchor[0] + (of_day_ns - anchor[1] + DAY_NS // 2) % DAY_NS - DAY_NS // 2
                if abs(said_ns - t_ns) <= LEAP_NS:
                    t_ns = max(t_ns, said_ns)
                else:
                    t_ns, anchor = t_ns + step_ns, None
            anchor = anchor or (t_ns, of_day_ns)
            placed.clear()
        elif kind:
            if kind in placed:
                t_ns += step_ns
                placed.clear()
                anchor = None
            placed.add(kind)
        yield t_ns, line


def _of_day_ns(line: bytes) -> int | None:
    """The time of day that a line says; None: none."""
    match = _TIMED.search(line)
    if match is None:
        return None
    seconds = (int(match[1]) * 60 + int(match[2])) * 60 + int(match[3])
    return seconds * 1_000_000_000 + int((match[4] or b"0").ljust(9, b"0"))


def _step_ns(lines: Iterable[bytes]) -> int:
    """The usual time from epoch to epoch."""
    times = [of_day_ns for line in lines if (of_day_ns := _of_day_ns(line)) is not None]
    steps = [later - earlier for earlier, later in zip(times, times[1:], strict=False) if 0 < later - earlier <= LEAP_NS]
    return round(statistics.median(steps)) if steps else DEFAULT_STEP_NS
