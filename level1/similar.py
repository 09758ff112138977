"""Names that look alike: what a message about an unknown name suggests."""
from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

MAX_CANDIDATES = 2_000
"""Above so many names only those with the same first letter are compared, so that a large file stays quick."""


def closest(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate most like a name, None when nothing is near."""
    known = list(candidates)
    for candidate in known:
        if candidate.lower() == name.lower() and candidate != name:
            return candidate
    if len(known) > MAX_CANDIDATES:
        known = [candidate for candidate in known if candidate[:1] == name[:1]][:MAX_CANDIDATES]
    return next(iter(get_close_matches(name, known, n=1, cutoff=0.6)), None)


def hint(name: str, candidates: Iterable[str]) -> str:
    """`did you mean …?`, or "" when nothing is near."""
    match = closest(name, candidates)
    return f"did you mean `{match}`?" if match else ""
