"""What a user can put right: a file, an interface, a setting that stands in the way."""
from __future__ import annotations

from collections.abc import Iterable

from level1.similar import closest


class OutsideError(Exception):
    """Something outside the program prevents the work. Each of `problems` is one line: what is wrong, what to do."""

    def __init__(self, *problems: str):
        super().__init__("\n".join(problems))
        self.problems = problems


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`; did you mean "channel"?`, or the names there are when none is close, or nothing when there are none."""
    names = sorted(known)
    if match := closest(word, names):
        return f'; did you mean "{match}"?'
    return f"; known: {', '.join(names)}" if names else ""
