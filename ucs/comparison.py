"""Two sets of definitions over the same recordings: what each gave, and what differs."""
from __future__ import annotations

from typing import NamedTuple

from ucs.spans import Behaviour, Change, Span, behaviour, floods


class Side(NamedTuple):
    """One set of definitions and what it gave: spans of each recording, by its path."""

    name: str
    found: dict[str, list[Span]]


class Recorded(NamedTuple):
    """A recording that could be used. last: its last time stamp, s."""

    path: str
    start: float
    last: float
    hours: float


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


def span_text(each: Recorded, change: Change) -> str:
    """When it stood before and after, s from the beginning of the recording."""
    def text(span: Span | None) -> str:
        if span is None:
            return "not raised"
        end = "the end" if span.end is None else f"{span.end - each.start:.3f} s"
        return f"{span.start - each.start:.3f} s to {end}{', ' + span.outcome.replace('_', ' ') if span.outcome else ''}"
    return f"{text(change.old)} → {text(change.new)}"
