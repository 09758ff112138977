"""What a user can put right: a file, an interface, a setting that stands in the way."""
from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class OutsideError(Exception):
    """Something outside the program prevents the work. Each of `problems` is one line: what is wrong, what to do."""

    def __init__(self, *problems: str):
        super().__init__("\n".join(problems))
        self.problems = problems


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`; did you mean "channel"?`, or the names there are when none is close, or nothing when there are none."""
    names = sorted(known)
    by_lower = {name.lower(): name for name in names}
    close = get_close_matches(word.lower(), by_lower, n=1, cutoff=0.5)
    if close:
        return f'; did you mean "{by_lower[close[0]]}"?'
    return f"; known: {', '.join(names)}" if names else ""
