"""Two sets of definitions over the same recordings: what each gave, and what differs."""
from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from ucs.spans import Behaviour, Change, Span, behaviour, busiest, floods

TEN_MINUTES_H = 1 / 6


class Side(NamedTuple):
    """One set of definitions and what it gave: spans of each recording, by its path. files: the definitions."""

    name: str
    found: dict[str, list[Span]]
    files: tuple[str, ...] = ()


class Recorded(NamedTuple):
    """A recording that could be used. last: its last time stamp, s."""

    path: str
    start: float
    last: float
    hours: float


class Rates(NamedTuple):
    """What an operator gets of all alarms together. average: alarms in ten minutes, None where less was recorded; busiest: most
    in any ten minutes; floods: times with more than ten in ten minutes; chattered: times an alarm came three times in a minute;
    stale: spans longer than a day."""

    average: float | None
    busiest: int
    floods: int
    chattered: int
    stale: int


RATES = (("alarms in 10 min, on average", "about 1, at most 2"), ("alarms in the busiest 10 min", "at most 10"),
         ("floods: more than 10 in 10 min", "under 1 % of the time"), ("chattered: 3 times in a minute", "never"),
         ("stale: stood longer than a day", "under 5 a day"))
"""What the rates are called, and what IEC 62682 (and ISA-18.2) ask for, for one operator."""


class Comparison(NamedTuple):
    """Two sides over the same recordings."""

    old: Side
    new: Side
    recorded: list[Recorded]
    changes: dict[str, list[Change]]
    tolerance_s: float

    @property
    def hours(self) -> float:
        """Length of all recordings."""
        return sum(each.hours for each in self.recorded)

    def alarms(self) -> list[str]:
        """Every alarm that either side raised."""
        return sorted({span.alarm for side in (self.old, self.new) for found in side.found.values() for span in found})

    def behaviour(self, side: Side, alarm: str) -> Behaviour:
        """How an alarm behaved on one side."""
        return behaviour([(each.path, each.last, [span for span in side.found[each.path] if span.alarm == alarm])
                          for each in self.recorded], self.hours)

    def floods(self, side: Side) -> int:
        """Floods of all alarms together."""
        return sum(floods(side.found[each.path]) for each in self.recorded)

    def rates(self, side: Side) -> Rates:
        """What an operator would have got."""
        each_alarm = [self.behaviour(side, alarm) for alarm in self.alarms()]
        raised = sum(found.raised for found in each_alarm)
        return Rates(raised / self.hours / 6 if self.hours >= TEN_MINUTES_H else None,
                     max((busiest(side.found[each.path]) for each in self.recorded), default=0), self.floods(side),
                     sum(found.chatter for found in each_alarm), sum(found.stale for found in each_alarm))

    def kinds(self) -> dict[str, int]:
        """How many differences there are of each kind."""
        return dict(Counter(change.what for found in self.changes.values() for change in found).most_common())


def rate_rows(compared: Comparison) -> list[tuple[str, str, str, str]]:
    """Name, old, new and what is asked for, of each rate."""
    def text(value: float | None) -> str:
        return "–" if value is None else str(value) if isinstance(value, int) else f"{value:.1f}"
    rates = zip(RATES, compared.rates(compared.old), compared.rates(compared.new), strict=True)
    return [(name, text(old), text(new), asked) for (name, asked), old, new in rates]


def span_text(each: Recorded, change: Change) -> str:
    """When it stood before and after, s from the beginning of the recording."""
    def text(span: Span | None) -> str:
        if span is None:
            return "not raised"
        end = "the end" if span.end is None else f"{span.end - each.start:.3f} s"
        return f"{span.start - each.start:.3f} s to {end}{', ' + span.outcome.replace('_', ' ') if span.outcome else ''}"
    return f"{text(change.old)} → {text(change.new)}"
