"""Sets of sequence numbers as ranges: what was acknowledged, what was received, what is missing."""
from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator

Range = tuple[int, int]
"""First and last number, both in it."""


class Ranges:
    """A set of positive integers, kept as disjoint ranges in rising order that don't touch."""

    def __init__(self, ranges: Iterable[Range] = ()):
        self._firsts: list[int] = []
        self._lasts: list[int] = []
        for first, last in ranges:
            self.add(first, last)

    def __iter__(self) -> Iterator[Range]:
        return iter(zip(self._firsts, self._lasts, strict=True))

    def __len__(self) -> int:
        """How many ranges, not how many numbers."""
        return len(self._firsts)

    def __contains__(self, number: int) -> bool:
        index = bisect_left(self._lasts, number)
        return index < len(self._firsts) and self._firsts[index] <= number

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Ranges) and list(self) == list(other)

    def add(self, first: int, last: int) -> None:
        """Put a range in; nothing when it is empty (last before first)."""
        if last < first:
            return
        begin = bisect_left(self._lasts, first - 1)
        end = bisect_left(self._firsts, last + 2)
        if begin < end:
            first, last = min(first, self._firsts[begin]), max(last, self._lasts[end - 1])
        self._firsts[begin:end] = [first]
        self._lasts[begin:end] = [last]

    def common(self, first: int, last: int) -> Iterator[Range]:
        """The parts of a range that are in the set."""
        index = bisect_left(self._lasts, first)
        while index < len(self._firsts) and self._firsts[index] <= last:
            yield max(first, self._firsts[index]), min(last, self._lasts[index])
            index += 1

    def missing(self, first: int, last: int) -> Iterator[Range]:
        """The parts of a range that are not in the set."""
        for begin, end in self.common(first, last):
            if first < begin:
                yield first, begin - 1
            first = end + 1
        if first <= last:
            yield first, last

    def count(self) -> int:
        """How many numbers."""
        return sum(self._lasts) - sum(self._firsts) + len(self._firsts)

    def around(self, number: int) -> Range:
        """The range that holds a number; the number alone when none does."""
        index = bisect_left(self._lasts, number)
        if index < len(self._firsts) and self._firsts[index] <= number:
            return self._firsts[index], self._lasts[index]
        return number, number

    @property
    def upto(self) -> int:
        """The number up to which all from 1 are in the set, 0 where 1 is missing."""
        return self._lasts[0] if self._firsts and self._firsts[0] <= 1 else 0

    @property
    def last(self) -> int:
        """The highest number, 0 in an empty set."""
        return self._lasts[-1] if self._lasts else 0
