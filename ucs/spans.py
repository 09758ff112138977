"""Alarms as spans of time, what two sets of spans have in common, and how an alarm behaves (IEC 62682)."""
from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from level1.event import Event

CHATTER_COUNT, CHATTER_S = 3, 60.0
"""An alarm raised so often within so long chatters (ISA-18.2, IEC 62682)."""
FLOOD_COUNT, FLOOD_S = 10, 600.0
"""More alarms than this in ten minutes are a flood for one operator (IEC 62682; EEMUA 191)."""
STALE_S = 86_400.0
"""An alarm that stands for longer than a day is stale (IEC 62682)."""
NEAR_S = 5.0
"""Spans whose beginnings are so near are taken for the same occasion even if they do not overlap."""


class Span(NamedTuple):
    """An alarm from raised to cleared, s on the recording's time line. end: None when it still stood. outcome: of its repair."""

    alarm: str
    start: float
    end: float | None
    attempts: int
    outcome: str

    def length(self, last: float) -> float:
        """s it stood, at the latest until `last`."""
        return (last if self.end is None else self.end) - self.start


def spans(events: Iterable[Event]) -> list[Span]:
    """The spans of a recording's events, in the order of their beginnings."""
    open_: dict[tuple[str, int], list[Event]] = {}
    done: list[list[Event]] = []
    for event in events:
        if event.event == "raised":
            open_[event.alarm, event.seq] = [event]
        else:
            story = open_.get((event.alarm, event.instance))
            if story is not None:
                story.append(event)
                if event.event == "cleared":
                    done.append(open_.pop((event.alarm, event.instance)))
    return sorted((_span(story) for story in (*done, *open_.values())), key=lambda span: (span.start, span.alarm))


def _span(story: list[Event]) -> Span:
    words = [event.event for event in story]
    outcome = next((word for word in ("locked_out", "repaired") if word in words), "")
    end = float(story[-1].t) if words[-1] == "cleared" else None
    return Span(story[0].alarm, float(story[0].t), end, max(event.attempt for event in story), outcome)


class Change(NamedTuple):
    """One difference of a recording. what: appeared, vanished, moved (other beginning), longer, shorter or ended otherwise."""

    alarm: str
    what: str
    old: Span | None
    new: Span | None

    def seconds(self) -> float:
        """When, on the recording's time line."""
        span = self.new or self.old
        assert span is not None
        return span.start


def changes(old: Sequence[Span], new: Sequence[Span], tolerance_s: float) -> list[Change]:
    """What became of each span; those alike within the tolerance are left out."""
    found: list[Change] = []
    for alarm in sorted({span.alarm for span in (*old, *new)}):
        found += _changes_of(alarm, [span for span in old if span.alarm == alarm], [span for span in new if span.alarm == alarm],
                             tolerance_s)
    return sorted(found, key=lambda change: (change.seconds(), change.alarm))


def _changes_of(alarm: str, old: list[Span], new: list[Span], tolerance_s: float) -> list[Change]:
    found = []
    left = list(new)
    for before in old:
        after = min((span for span in left if _same_occasion(before, span)), key=lambda span: abs(span.start - before.start),
                    default=None)
        if after is None:
            found.append(Change(alarm, "vanished", before, None))
            continue
        left.remove(after)
        what = _difference(before, after, tolerance_s)
        if what:
            found.append(Change(alarm, what, before, after))
    return found + [Change(alarm, "appeared", None, span) for span in left]


def _same_occasion(one: Span, other: Span) -> bool:
    if abs(one.start - other.start) <= NEAR_S:
        return True
    first, second = sorted((one, other), key=lambda span: span.start)
    return first.end is None or first.end >= second.start


def _difference(old: Span, new: Span, tolerance_s: float) -> str:
    if abs(old.start - new.start) > tolerance_s:
        return "moved"
    if (old.end is None) != (new.end is None):
        return "longer" if new.end is None else "shorter"
    if old.end is not None and new.end is not None and abs(old.end - new.end) > tolerance_s:
        return "longer" if new.end > old.end else "shorter"
    return "ended otherwise" if (old.outcome, old.attempts) != (new.outcome, new.attempts) else ""


class Behaviour(NamedTuple):
    """How an alarm behaved over recordings. hours: recorded in all; chatter: occasions on which it chattered; stale: spans
    longer than a day; first, last: beginnings as (recording, s), None when there is none."""

    raised: int
    hours: float
    standing_s: float
    chatter: int
    stale: int
    locked_out: int
    first: tuple[str, float] | None
    last: tuple[str, float] | None

    @property
    def per_hour(self) -> float:
        """Activations per hour of recording."""
        return self.raised / self.hours if self.hours else 0.0


def behaviour(recordings: Sequence[tuple[str, float, Sequence[Span]]], hours: float) -> Behaviour:
    """Of one alarm: for each recording its name, its last time stamp (s) and the alarm's spans."""
    every = [(name, span) for name, _, found in recordings for span in found]
    lengths = [span.length(last) for _, last, found in recordings for span in found]
    return Behaviour(
        len(every), hours, sum(lengths),
        sum(bursts([span.start for span in found], CHATTER_COUNT, CHATTER_S) for _, _, found in recordings),
        sum(length > STALE_S for length in lengths), sum(span.outcome == "locked_out" for _, span in every),
        (every[0][0], every[0][1].start) if every else None, (every[-1][0], every[-1][1].start) if every else None)


def bursts(starts: Sequence[float], count: int, window_s: float) -> int:
    """How many separate times at least `count` beginnings fall within a window."""
    found, place = 0, 0
    while place + count <= len(starts):
        if starts[place + count - 1] - starts[place] <= window_s:
            found += 1
            end = starts[place] + window_s
            while place < len(starts) and starts[place] <= end:
                place += 1
        else:
            place += 1
    return found


def busiest(found: Sequence[Span]) -> int:
    """How many alarms came within the busiest ten minutes."""
    starts = sorted(span.start for span in found)
    return max((place + 1 - bisect_left(starts, start - FLOOD_S) for place, start in enumerate(starts)), default=0)


def floods(found: Sequence[Span]) -> int:
    """How many times more than `FLOOD_COUNT` alarms came within ten minutes."""
    return bursts(sorted(span.start for span in found), FLOOD_COUNT + 1, FLOOD_S)
