"""What the signals did that alarms look at: taken from the frames as they pass, for pictures."""
from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator

from level1.catalog import STALE_CYCLES, Catalog, Message, Signal
from level1.decode import ERROR, QUALITY_WORDS, Scale, raw_of, reserved
from level1.frame import BUS_SHIFT, EXTENDED, Frame, frame_key, j1939_pgn
from ucs import inputs
from ucs.inputs import Input


class Line:
    """One signal over time. times_ns, values: where it changed; NaN where there was none, and then in words why: "error",
    "unavailable" (reserved values of J1939), "silent" (its message).

    Values are raw where the signal has a value table, else physical.
    """

    def __init__(self, message: Message, signal: Signal):
        self.message, self.signal = message, signal
        self.times_ns, self.values = array("q"), array("d")
        self.words: list[str] = []
        self._scale = Scale(signal)
        self._reserved = reserved(signal) if message.j1939 else ()
        self._raw: int | float | None = None

    @property
    def input(self) -> Input:
        """Message and signal by name."""
        return self.message.name, self.signal.name

    def take(self, t_ns: int, data: bytes) -> None:
        """A payload of the message."""
        if self.signal.multiplexer_ids is not None and not self._is_there(data):
            return
        raw = raw_of(self.signal, data)
        if raw is not None and raw != self._raw:
            self._raw = raw
            word = self._word(raw)
            self._add(t_ns, math.nan if word else float(raw if self.signal.choices else self._scale.physical(raw)), word)

    def lose(self, t_ns: int) -> None:
        """The message has been silent for too long."""
        self._raw = None
        self._add(t_ns, math.nan, "silent")

    def _is_there(self, data: bytes) -> bool:
        signal = self.signal
        while signal.multiplexer_signal is not None:
            selector = self.message.signal(signal.multiplexer_signal)
            if raw_of(selector, data) not in (signal.multiplexer_ids or ()):
                return False
            signal = selector
        return True

    def _word(self, raw: int | float) -> str:
        """Why a raw value is none; "" for one that is."""
        if raw in self.signal.choices:
            return ""
        if not math.isfinite(raw):
            return QUALITY_WORDS[ERROR]
        return next((QUALITY_WORDS[quality] for low, high, quality in self._reserved if low <= raw <= high), "")

    def _add(self, t_ns: int, value: float, word: str) -> None:
        self.times_ns.append(t_ns)
        self.values.append(value)
        self.words.append(word)


class _Heard:
    """A message that is traced."""

    def __init__(self, message: Message, signals: Iterable[str]):
        self.message = message
        self.lines = [Line(message, message.signal(name)) for name in dict.fromkeys(signals)]
        self.patience_ns = None if message.cycle_ns is None else STALE_CYCLES * message.cycle_ns
        self.last_ns: int | None = None

    def take(self, t_ns: int, data: bytes) -> None:
        self.check(t_ns)
        self.last_ns = t_ns if self.last_ns is None else max(t_ns, self.last_ns)
        for line in self.lines:
            line.take(t_ns, data)

    def check(self, now_ns: int) -> None:
        """Break the lines where nothing was heard for too long."""
        if self.last_ns is not None and self.patience_ns is not None and now_ns > self.last_ns + self.patience_ns:
            for line in self.lines:
                line.lose(self.last_ns + self.patience_ns)
            self.last_ns = None


class Trace:
    """The signals that the alarms of a catalog look at, and where the vehicle is. first_ns, last_ns: of all frames.

    places: definitions in which to look for the message that says so, if those of the alarms have none.
    """

    def __init__(self, catalog: Catalog, places: Catalog | None = None):
        self.catalog = catalog
        self.first_ns: int | None = None
        self.last_ns = 0
        wanted: dict[str, list[str]] = {}
        for alarm in catalog.alarms.values():
            for message, signal in inputs.of_alarm(alarm):
                if signal and message in catalog.messages:
                    wanted.setdefault(message, []).append(signal)
        messages = {**places.messages, **catalog.messages} if places else catalog.messages
        self._position = next(filter(None, map(_position, messages.values())), None)
        if self._position is not None:
            message, latitude, longitude = self._position
            wanted.setdefault(message, []).extend((latitude, longitude))
        self._heard = {name: _Heard(messages[name], signals) for name, signals in wanted.items()}
        self._by_key: dict[int, list[_Heard]] = {}

    def through(self, batches: Iterator[list[Frame]]) -> Iterator[list[Frame]]:
        """Batches of frames, taken and handed on."""
        for batch in batches:
            for frame in batch:
                self.take(*frame)
            yield batch

    def take(self, t_ns: int, key: int, data: bytes) -> None:
        """A frame: `Frame.key` and its payload."""
        if self.first_ns is None:
            self.first_ns = self.last_ns = t_ns
        elif t_ns < self.last_ns:
            t_ns = self.last_ns
        self.last_ns = t_ns
        heard = self._by_key.get(key)
        if heard is None:
            heard = self._by_key[key] = [one for one in self._heard.values() if self._is(key, one.message)]
        for one in heard:
            one.take(t_ns, data)

    def lines(self) -> dict[Input, Line]:
        """Every signal that was ever heard, by message and signal; broken off where it fell silent."""
        for one in self._heard.values():
            one.check(self.last_ns)
        return {line.input: line for one in self._heard.values() for line in one.lines if line.times_ns}

    def path(self) -> tuple[list[int], list[float], list[float]]:
        """Where the vehicle was: times (ns), metres to the east and to the north of the first place. Empty without a position."""
        lines = self.lines()
        if self._position is None:
            return [], [], []
        name, latitude, longitude = self._position
        if (name, latitude) not in lines or (name, longitude) not in lines:
            return [], [], []
        return _metres(lines[name, latitude], lines[name, longitude])

    def _is(self, key: int, message: Message) -> bool:
        bus, can_id = key >> BUS_SHIFT, key & 0x1FFF_FFFF
        if bus not in self.catalog.buses.get(message.name, (0,)):
            return False
        if message.j1939 and message.pgn is not None:
            return bool(key & EXTENDED) and j1939_pgn(can_id) == message.pgn and message.source in (None, can_id & 0xFF)
        return key == frame_key(message.can_id, message.extended, bus)


EARTH_RADIUS_M = 6_371_008.8


def _position(message: Message) -> tuple[str, str, str] | None:
    """A message that says where the vehicle is: its name and those of its signals."""
    latitude = next((signal.name for signal in message.signals if signal.name.endswith("Latitude")), None)
    longitude = next((signal.name for signal in message.signals if signal.name.endswith("Longitude")), None)
    return (message.name, latitude, longitude) if latitude and longitude else None


def _metres(latitude: Line, longitude: Line) -> tuple[list[int], list[float], list[float]]:
    """Both lines at the moments when either changed."""
    changes = sorted([*((t, 0, v) for t, v in zip(latitude.times_ns, latitude.values, strict=True)),
                      *((t, 1, v) for t, v in zip(longitude.times_ns, longitude.values, strict=True))])
    times: list[int] = []
    east: list[float] = []
    north: list[float] = []
    place = [math.nan, math.nan]
    origin: tuple[float, float] | None = None
    for number, (t_ns, which, value) in enumerate(changes):
        place[which] = value
        if number + 1 < len(changes) and changes[number + 1][0] == t_ns:
            continue
        if origin is None and not math.isnan(place[0] + place[1]):
            origin = (place[0], place[1])
        if origin is not None:
            times.append(t_ns)
            north.append(math.radians(place[0] - origin[0]) * EARTH_RADIUS_M)
            east.append(math.radians(place[1] - origin[1]) * EARTH_RADIUS_M * math.cos(math.radians(origin[0])))
    return times, east, north
