"""Events for people: one line each, in columns, the same words in every command."""
from __future__ import annotations

import os
from collections.abc import Mapping
from decimal import Decimal
from itertools import groupby, pairwise
from typing import Any, TextIO

from level1.event import Event

WORDS = {
    "raised": "raised", "repair_started": "repair started", "repair_failed": "repair failed", "repaired": "repaired",
    "locked_out": "locked out", "cleared": "cleared", "acknowledged": "acknowledged",
}
_COLOURS = {"raised": "33", "repair_started": "36", "repair_failed": "33", "repaired": "32", "locked_out": "31", "cleared": "32",
            "acknowledged": "36"}
_GRAVE = {"High": "31", "Critical": "1;31"}


def wants_colour(stream: TextIO) -> bool:
    """Whether a stream is a terminal whose owner has not said NO_COLOR (no-color.org)."""
    return stream.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb"


def painted(text: str, code: str, colour: bool) -> str:
    """The text in a colour (SGR code), or as it is."""
    return f"\033[{code}m{text}\033[0m" if colour and code else text


def event_line(event: Event, when: str, colour: bool = False) -> str:
    """`when`, alarm, what happened, and what to know about it."""
    code = _GRAVE.get(event.priority, "33") if event.event == "raised" else _COLOURS.get(event.event, "")
    word = painted(f"{WORDS.get(event.event, event.event):<14}", code, colour)
    return f"{when}  {event.alarm:<28} {word} {detail(event)}".rstrip()


def since(t: Decimal, origin: Decimal) -> str:
    """Seconds since the origin, to the millisecond, right-aligned to a day's width."""
    return f"{t - origin:>10.3f} s"


def clock(event: Event) -> str:
    """UTC of day to the millisecond, or seconds on the time line where no wall clock is known."""
    return f"{event.utc[11:23]:<12}Z" if event.utc else since(event.t, Decimal(0))


def detail(event: Event) -> str:
    """What one has to know beside the alarm's name and the word."""
    if event.event == "raised":
        values = values_text(event.values)
        return f"{event.priority.lower()}{': ' if values else ''}{values}"
    if event.event == "repair_started":
        head, verb = ("not armed", "would send") if event.passive else (f"attempt {event.attempt}", "sends")
        frames = ", ".join(f"{message} {' '.join(frame.data for frame in group)}"
                           for message, group in groupby(event.frames, lambda frame: frame.message))
        return f"{head}, {verb} {frames}" if frames else head
    if event.event == "repair_failed":
        return f"attempt {event.attempt}: {event.text}" if event.text else f"attempt {event.attempt}"
    if event.event == "repaired":
        return f"by attempt {event.attempt}"
    return event.text if event.event in ("locked_out", "acknowledged") else ""


def roughly(seconds: float) -> str:
    """A length of time, two units at most: "0.4 s", "3 h 12 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    for (unit, size), (smaller, part) in pairwise((("d", 86400), ("h", 3600), ("min", 60), ("s", 1))):
        if whole >= size:
            rest = whole % size // part
            return f"{whole // size} {unit} {rest} {smaller}" if rest else f"{whole // size} {unit}"
    return f"{whole} s"


def values_text(values: Mapping[str, Any]) -> str:
    """`PilotFlame Off, Flaming On`: signal names alone where they are unambiguous."""
    names = [name.rpartition(".")[2] for name in values]
    return ", ".join(f"{short if names.count(short) == 1 else name} {_number(value)}"
                     for short, (name, value) in zip(names, values.items(), strict=True))


def _number(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float | Decimal) else str(value)
