"""What can be seen on a unit's buses without taking part: the core, fed with the frames, with every signal in use and nothing
allowed to leave. Repairs are not armed and what the core would send is dropped; the view that shows it has no way to send.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import msgspec

from level1.board import Cell, Page
from level1.catalog import Catalog, Message
from level1.decode import GOOD, NEVER, OLD, QUALITY_WORDS
from level1.event import Event
from level1.frame import BUS_SHIFT, ERROR, EXTENDED, Frame, frame_key
from level1.freeze_frame import STATE_WORDS, physical
from level1.health import GNSS_MESSAGES, HOST_MESSAGES
from level1.supervisor import Supervisor
from ucs.attendant import alarm_standing, gravest
from ucs.standing import AlarmStanding

RATE_NS = 3_000_000_000
"""A rate is measured over the frames of so long."""
OVERDUE = 3
"""Without a frame for so many of its own intervals the rate is 0."""
TOLERANCE = 0.2
"""A rate further from the nominal one is remarked upon."""
EVENTS = 200


class Value(NamedTuple):
    """A signal: its value as text (empty: none), its unit, and its quality (a word of `decode.QUALITY_WORDS`)."""

    name: str
    text: str
    unit: str
    quality: str


class Heard(NamedTuple):
    """A message. ident: identifier as text. hz: measured, None before two frames; cycle_s: nominal, None: none given.

    state: ok, never, silent, corrupt, frozen, short, slow or fast. own: the UCS tells it of itself.
    """

    name: str
    bus: int
    ident: str
    hz: float | None
    cycle_s: float | None
    age_s: float | None
    state: str
    own: bool
    values: tuple[Value, ...]


class Stranger(NamedTuple):
    """An identifier that no definition names."""

    ident: str
    bus: int
    hz: float | None
    age_s: float
    data: bytes


class Pace:
    """How often an identifier is heard."""

    __slots__ = ("_marks", "count", "data", "last_ns")

    def __init__(self, t_ns: int):
        self.count = 0
        self.last_ns = t_ns
        self.data = b""
        self._marks: deque[tuple[int, int]] = deque()

    def mark(self) -> None:
        """Some frames have been counted."""
        marks = self._marks
        if not marks or marks[-1][1] != self.count:
            marks.append((self.last_ns, self.count))
        while len(marks) > 2 and marks[1][0] <= self.last_ns - RATE_NS:
            marks.popleft()

    def hz(self, now_ns: int) -> float | None:
        """Frames a second, from the stamps of the frames themselves; None: not known yet."""
        (begin_ns, before), (end_ns, after) = self._marks[0], self._marks[-1]
        if end_ns <= begin_ns:
            return None
        interval_ns = (end_ns - begin_ns) / (after - before)
        return 0.0 if now_ns - self.last_ns > OVERDUE * interval_ns + 100_000_000 else 1e9 / interval_ns


class Watching:
    """The core, watching. Fed by `take`, asked between. buses: how many there are; time in ns on one time line."""

    def __init__(self, catalog: Catalog, unit: str, start_ns: int | None, utc_offset_ns: int | None = None):
        shown = {name: msgspec.structs.replace(message, monitor_as=name) for name, message in catalog.messages.items()}
        self.catalog = catalog
        self._supervisor = Supervisor(msgspec.structs.replace(catalog, messages=shown), unit=unit, armed=(), broadcast=False,
                                      start_ns=start_ns, utc_offset_ns=utc_offset_ns)
        self._paces: dict[int, Pace] = {}
        self._names: dict[int, str | None] = {}
        self._raised_ns: dict[int, int] = {}
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.frames = 0
        self._own = {*HOST_MESSAGES, *GNSS_MESSAGES.values(), *(alarm.message for alarm in catalog.alarms.values())}
        self._alarms = {(alarm.message, alarm.signal) for alarm in catalog.alarms.values()}
        self._cells: dict[str, list[Cell]] = {}
        for cell in self._supervisor.board.cells.values():
            self._cells.setdefault(cell.message.name, []).append(cell)

    def take(self, frames: list[Frame], now_ns: int) -> None:
        """Frames have come, and it is now."""
        paces = self._paces
        touched: dict[int, Pace] = {}
        for t_ns, key, data in frames:
            pace = paces.get(key)
            if pace is None:
                pace = paces[key] = Pace(t_ns)
            pace.count += 1
            pace.last_ns = t_ns
            pace.data = data
            touched[key] = pace
        for pace in touched.values():
            pace.mark()
        self.frames += len(frames)
        outputs = [*self._supervisor.receive_many(frames), *self._supervisor.tick(max(now_ns, self._supervisor.now_ns))]
        for output in outputs:
            if isinstance(output, Event):
                self._remember(output)

    def alarms(self, now_ns: int) -> list[AlarmStanding]:
        """The alarms as they look from here, the gravest first."""
        return [alarm_standing(machine, repair, now_ns, False, self._age_s(machine.instance, now_ns))
                for machine, repair in sorted(self._supervisor.active(), key=gravest)]

    def messages(self, now_ns: int) -> Iterator[Heard]:
        """Every message that has signals, of each bus it is bound to in the order of the definitions."""
        hz: dict[str, float | None] = {}
        for key, pace in self._paces.items():
            if name := self._name(key):
                measured = pace.hz(now_ns)
                hz[name] = measured if hz.get(name) is None else (hz[name] or 0.0) + (measured or 0.0)
        for name, cells in self._cells.items():
            message = self.catalog.messages[name]
            page = self._supervisor.board.pages[name]
            yield self._heard(message, page, cells, hz.get(name), now_ns)

    def strangers(self, now_ns: int) -> list[Stranger]:
        """Identifiers that no definition names, those heard last first."""
        found = [Stranger(_ident(key), key >> BUS_SHIFT, pace.hz(now_ns), max(0, now_ns - pace.last_ns) / 1e9, pace.data)
                 for key, pace in self._paces.items() if self._name(key) is None]
        return sorted(found, key=lambda stranger: (stranger.bus, stranger.ident))

    def _remember(self, event: Event) -> None:
        self.events.append(event)
        if event.event == "raised":
            self._raised_ns[event.instance] = int(event.t.scaleb(9))
        elif event.event == "cleared":
            self._raised_ns.pop(event.instance, None)

    def _age_s(self, instance: int, now_ns: int) -> float | None:
        raised_ns = self._raised_ns.get(instance)
        return None if raised_ns is None else max(0.0, (now_ns - raised_ns) / 1e9)

    def _name(self, key: int) -> str | None:
        """The message of an identifier, None: nobody's."""
        if key not in self._names:
            board = self._supervisor.board
            page = board.fixed_page(key) or next(iter(board.open_pages(key)), None)
            self._names[key] = page.message.name if page is not None else None
        return self._names[key]

    def _heard(self, message: Message, page: Page, cells: list[Cell], hz: float | None, now_ns: int) -> Heard:
        bus = self.catalog.buses.get(message.name, (0,))[0]
        qualities = set()
        values = []
        for cell in cells:
            raw, quality = self._supervisor.board.sample(cell)
            values.append(Value(cell.signal.name, "" if raw is None else self._value(cell, raw), cell.signal.unit,
                                QUALITY_WORDS[quality]))
            qualities.add(quality)
        never, own = page.level < 0, message.name in self._own
        key = page.owner if page.owner is not None else frame_key(message.can_id, message.extended, bus)
        return Heard(message.name, bus, _ident(key), None if never else hz, message.cycle_ns / 1e9 if message.cycle_ns else None,
                     None if never else max(0, now_ns - page.t_ns) / 1e9, _state(page, qualities, hz, message, own), own,
                     tuple(values))


    def _value(self, cell: Cell, raw: int | float) -> str:
        """The value as people read it; states of alarms by name, whether their file has a value table for them or not."""
        if isinstance(raw, int) and raw < len(STATE_WORDS) and (cell.message.name, cell.signal.name) in self._alarms:
            return STATE_WORDS[raw]
        return _text(physical(cell, raw))


def _state(page: Page, qualities: set[int], hz: float | None, message: Message, own: bool) -> str:
    if page.level < 0:
        return QUALITY_WORDS[NEVER]
    if page.stale_level and page.level >= page.stale_level:
        return "silent"
    if worst := max((quality for quality in qualities if quality > OLD), default=GOOD):
        return QUALITY_WORDS[worst]
    if hz and message.cycle_ns and not own:  # its own alarms the UCS also sends when they change
        nominal = 1e9 / message.cycle_ns
        return "slow" if hz < nominal * (1 - TOLERANCE) else "fast" if hz > nominal * (1 + TOLERANCE) else "ok"
    return "ok"


def _text(value: Any) -> str:
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _ident(key: int) -> str:
    if key & ERROR:
        return "error"
    return f"{key & 0x1FFF_FFFF:08X}" if key & EXTENDED else f"{key & 0x7FF:03X}"


def silent(messages: Iterable[Heard], names: Mapping[int, str]) -> list[str]:
    """The messages that came and come no more, with their bus where there are several."""
    gone = [message for message in messages if message.state == "silent"]
    return [f"{message.name} ({names[message.bus]})" if len(names) > 1 else message.name for message in gone]
