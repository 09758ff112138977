"""What `ucs monitor` shows: a sight of the unit, as lines of a given width. Nothing here waits, reads or draws."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rich.cells import cell_len, set_cell_size

from level1.event import Event
from ucs.render import WORDS, clock, detail, roughly
from ucs.standing import AlarmStanding, BusStanding, RepairStanding
from ucs.terminal import Line, harmless
from ucs.watching import Heard, Stranger, Value

PAGES = ("all", "alarms", "signals", "buses")
DIM, BOLD, RED, YELLOW, GREEN, CYAN, INVERSE = "2", "1", "31", "33", "32", "36", "7"
PRIORITY_COLOURS = {"Event": CYAN, "Low": "", "Medium": YELLOW, "High": RED, "Critical": "1;37;41"}
STATE_COLOURS = {"Active": YELLOW, "Repairing": CYAN, "LockedOut": "1;31"}
MESSAGE_COLOURS = {"ok": GREEN, "never": DIM, "slow": YELLOW, "fast": DIM, "short": YELLOW, "error": YELLOW}
BUS_WORDS = {"BusActive": ("up", GREEN), "BusWarning": ("errors", YELLOW), "BusPassive": ("passive", YELLOW),
             "BusOff": ("off", RED), "BusDown": ("gone", RED)}
COLUMN = 40
"""Columns that a signal takes: on a wide screen several stand beside each other."""


class Sight(NamedTuple):
    """The unit at a moment. source: who says which alarms there are; failing: what has failed, for every page; notes: of the
    sources of what is shown. names: of the buses by index. time: a clock for people."""

    title: str
    source: str
    alarms: Sequence[AlarmStanding] = ()
    messages: Sequence[Heard] = ()
    buses: Sequence[BusStanding] = ()
    strangers: Sequence[Stranger] = ()
    events: Sequence[Event] = ()
    names: Sequence[str] = ()
    failing: Sequence[str] = ()
    notes: Sequence[str] = ()
    time: str = ""


class View(NamedTuple):
    """What the user chose. typing: the filter is being typed. top: first line shown of a page."""

    page: str = PAGES[0]
    sought: str = ""
    typing: bool = False
    paused: bool = False
    top: int = 0


def screen(sight: Sight, view: View, columns: int, rows: int) -> tuple[list[Line], int]:
    """All lines of the screen, at most so many; and the first line shown of the page, where it has no more."""
    head, foot = list(_head(sight, view, columns)), _foot(view, columns)
    room = max(0, rows - len(head) - 1)
    body = list(whole_page(sight, view, columns, room))
    top = max(0, min(view.top, len(body) - room))
    shown = body[top:top + room]
    if top + room < len(body) and shown:
        shown[-1] = [(f"↓ {len(body) - top - room + 1} lines more", DIM)]
    blank: list[Line] = [[]] * (room - len(shown))
    return [*head, *shown, *blank, foot][:rows], top


def whole_page(sight: Sight, view: View, columns: int, rows: int = 10_000) -> Iterator[Line]:
    """A page without head and foot. rows: how much room there is, where two things share it."""
    match view.page:
        case "alarms":
            yield from _alarms(sight, view, columns)
            yield []
            yield from _events(sight, view, max(5, rows - len(sight.alarms) - 5))
        case "signals":
            yield from _signals(sight, view, columns)
        case "buses":
            yield from _buses(sight, view, columns)
        case _:
            alarms = list(_alarms(sight, view, columns))
            most = max(3, rows // 2)
            yield from alarms[:most]
            if len(alarms) > most:
                yield [(f"  {len(alarms) - most} lines more on page 2", DIM)]
            yield []
            yield from _signals(sight, view, columns)


# --- head and foot --------------------------------------------------------------------------------------------------------


def _head(sight: Sight, view: View, columns: int) -> Iterator[Line]:
    count = len(sight.alarms)
    worst = max((alarm.priority for alarm in sight.alarms), key=list(PRIORITY_COLOURS).index, default="")
    alarms = (f"{count} alarm{'s' * (count != 1)}", PRIORITY_COLOURS[worst] or BOLD) if count else ("no alarm", GREEN)
    paused = [("  PAUSED", INVERSE)] if view.paused else []
    left = [(sight.title, BOLD), ("  ", ""), alarms, *paused]
    yield [*left, *_right(left, sight.time, columns)]
    yield [(sight.source, "" if sight.source.startswith("supervised") else YELLOW)]
    for text in sight.failing:
        yield [("! " + text, RED)]
    for text in sight.notes:
        yield [(text, DIM)]
    tabs: list[tuple[str, str]] = []
    for number, page in enumerate(PAGES, 1):
        tabs += [(f"[{number} {page}]", INVERSE) if page == view.page else (f" {number} {page} ", ""), (" ", "")]
    sought = [(f" only: {view.sought}", YELLOW)] if view.sought and not view.typing else []
    yield [*tabs, *sought]


def _foot(view: View, columns: int) -> Line:
    if view.typing:
        return [(f"/{view.sought}", ""), (" ", INVERSE), ("   enter: keep   escape: all", DIM)]
    keys = "q quit   / filter   p pause   tab 1-4 page   ↑↓ PgUp PgDn scroll"
    return [(keys, DIM)]


def _right(left: Sequence[tuple[str, str]], text: str, columns: int) -> Line:
    gap = columns - sum(cell_len(harmless(part)) for part, _ in left) - cell_len(text)
    return [(" " * gap + text, "")] if gap > 1 else []


# --- alarms ---------------------------------------------------------------------------------------------------------------


def _alarms(sight: Sight, view: View, columns: int) -> Iterator[Line]:
    shown = [alarm for alarm in sight.alarms if _matches(view, alarm.name, alarm.text, alarm.priority, alarm.state, alarm.key)]
    if not shown:
        yield [("no alarm" if not sight.alarms else "no alarm like this", DIM)]
        return
    wide = min(max(cell_len(_name(alarm)) for alarm in shown), max(20, columns - 50))
    for alarm in shown:
        since = f"{roughly(alarm.age_s):>12}" if alarm.age_s is not None else f"{'an earlier boot':>12}"
        seen = " ack" if alarm.acknowledged else " to ack" if alarm.latch else ""
        yield [(_fit(_name(alarm), wide), BOLD), ("  ", ""), (f"{alarm.priority:<8}", PRIORITY_COLOURS.get(alarm.priority, "")),
               ("  ", ""), (f"{alarm.state:<9}", STATE_COLOURS.get(alarm.state, "")), (since, ""), (seen, CYAN)]
        if alarm.repair is not None:
            yield [("    ", ""), *_repair(alarm.repair)]
        if alarm.text:
            yield [("    " + alarm.text, DIM)]


def _name(alarm: AlarmStanding) -> str:
    return f"{alarm.name} [{alarm.key}]" if alarm.key else alarm.name


def _repair(repair: RepairStanding) -> Line:
    left = f", {repair.left_s:.1f} s left" if repair.left_s is not None else ""
    attempt = repair.attempt_text
    match repair.phase:
        case "running":
            doing = f": {repair.doing}" if repair.doing else ""
            return [(f"repair {attempt}, step {repair.step} of {repair.steps}", CYAN), (left, BOLD), (doing, CYAN)]
        case "pausing":
            return [(f"repair {attempt} failed, pause before the next", YELLOW), (left, BOLD)]
        case "waiting":
            return [(f"repair waits: {repair.obstacle or 'begins'}", YELLOW)]
        case "settling":
            return [(f"repair {attempt} done, the condition is back", YELLOW), (left, BOLD)]
        case "passive":
            return [("its repair is not armed: nothing is sent", DIM)]
        case _:
            return [(f"repair {attempt} done" if repair.attempt else "repair idle", "")]


def _events(sight: Sight, view: View, most: int) -> Iterator[Line]:
    yield [("events, the newest first", BOLD)]
    shown = [event for event in reversed(sight.events) if _matches(view, event.alarm, event.event, event.text)]
    for event in shown[:most]:
        colour = PRIORITY_COLOURS.get(event.priority, "") if event.event == "raised" else ""
        yield [(f"{clock(event)}  ", DIM), (f"{event.alarm:<28} ", ""), (f"{WORDS.get(event.event, event.event):<14} ", colour),
               (detail(event), DIM)]
    if not shown:
        yield [("none", DIM)]


# --- signals --------------------------------------------------------------------------------------------------------------


def _signals(sight: Sight, view: View, columns: int) -> Iterator[Line]:
    beside = max(1, columns // COLUMN)
    width = columns // beside
    for message in sorted(sight.messages, key=lambda heard: (heard.state == "never", heard.own)):
        whole = _matches(view, message.name, message.ident, message.state)
        values = [value for value in message.values if whole or _matches(view, value.name)]
        if not values and not (whole and not message.values):
            continue
        yield _message(message, sight.names)
        if message.state == "never":
            continue
        for row in range(0, len(values), beside):
            yield [span for value in values[row:row + beside] for span in _value(value, width)]


def _message(message: Heard, names: Sequence[str]) -> Line:
    bus = f" {names[message.bus]}" if len(names) > 1 and message.bus < len(names) else ""
    rate = "" if message.hz is None else f"{message.hz:.1f} Hz"
    cycle = "" if message.cycle_s is None else f"cycle {message.cycle_s * 1000:g} ms"
    age = "" if message.age_s is None else f"{message.age_s:.2f} s ago" if message.age_s < 100 else f"{roughly(message.age_s)} ago"
    colour = MESSAGE_COLOURS.get(message.state, RED)
    name = _fit(message.name, 24)
    return [(name, DIM if message.state == "never" else BOLD), (f" {message.ident:>8}{bus}", DIM), (f" {rate:>10}", ""),
            (f"  {cycle:<13}", DIM), (f"{age:>12}", ""), (f"  {message.state}", colour)]


def _value(value: Value, width: int) -> Line:
    text = f"{value.text} {value.unit}".strip() if value.text else ""
    good = value.quality == "good"
    name_wide = width - 20
    shown = text if good else f"{value.quality} ({text})" if text and value.quality != "unavailable" else value.quality
    return [("  " + _fit(value.name, name_wide), ""), (" ", ""), (_fit(shown, width - name_wide - 3), "" if good else YELLOW)]


# --- buses ----------------------------------------------------------------------------------------------------------------


def _buses(sight: Sight, view: View, columns: int) -> Iterator[Line]:
    yield [(f"{'bus':<14}{'interface':<24}{'state':<9}{'received':>11}{'sent':>9}{'last frame':>13}{'load':>7}", BOLD)]
    for bus in sight.buses:
        word, colour = BUS_WORDS.get(bus.state, (bus.state, ""))
        quiet = "never" if bus.quiet_s is None else f"{roughly(bus.quiet_s)} ago"
        load = "" if bus.load_percent is None else f"{bus.load_percent:.0f} %"
        yield [(_fit(bus.name, 13) + " ", ""), (_fit(f"{bus.interface} {bus.channel}", 23) + " ", ""), (f"{word:<9}", colour),
               (f"{bus.received:>11,}{bus.sent:>9,}{quiet:>13}{load:>7}", "")]
        counts = ", ".join(f"{count} {name}" for name, count in sorted(bus.counters.items()) if count and name != "sent")
        if counts:
            yield [("    " + counts, YELLOW)]
    yield []
    shown = [stranger for stranger in sight.strangers if _matches(view, stranger.ident)]
    yield [(f"identifiers that no definition names: {len(sight.strangers) or 'none'}", BOLD)]
    for stranger in shown:
        bus_name = f" {sight.names[stranger.bus]}" if len(sight.names) > 1 and stranger.bus < len(sight.names) else ""
        rate = "" if stranger.hz is None else f"{stranger.hz:.1f} Hz"
        yield [(f"{stranger.ident:>8}{bus_name}  {rate:>10}  {stranger.age_s:>8.2f} s ago  {stranger.data[:16].hex(' ')}", "")]


def _matches(view: View, *texts: str) -> bool:
    sought = view.sought.lower()
    return not sought or any(sought in text.lower() for text in texts)


def _fit(text: str, width: int) -> str:
    """The text in exactly so many columns."""
    text = harmless(text)
    if cell_len(text) > width > 1:
        return set_cell_size(text, width - 1) + "…"
    return set_cell_size(text, width)
