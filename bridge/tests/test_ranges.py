"""Ranges behave as the sets of integers they stand for."""
from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from bridge.ranges import Ranges

NUMBER = st.integers(1, 40)
RANGE = st.tuples(NUMBER, NUMBER)


def numbers(ranges: list[tuple[int, int]] | Ranges) -> set[int]:
    return {number for first, last in ranges for number in range(first, last + 1)}


@given(st.lists(RANGE), RANGE)
def test_ranges_are_sets_of_integers(ranges: list[tuple[int, int]], probe: tuple[int, int]) -> None:
    found, expected, inside = Ranges(ranges), numbers(ranges), set(range(probe[0], probe[1] + 1))
    assert numbers(found) == expected
    assert all((number in found) == (number in expected) for number in range(45))
    assert numbers(list(found.common(*probe))) == expected & inside
    assert numbers(list(found.missing(*probe))) == inside - expected
    assert found.count() == len(expected)
    assert found.last == max(expected, default=0)
    assert set(range(1, found.upto + 1)) <= expected and found.upto + 1 not in expected
    first, last = found.around(probe[0])
    assert first <= probe[0] <= last and (first - 1 not in expected and last + 1 not in expected or probe[0] not in expected)


@given(st.lists(RANGE))
def test_ranges_are_in_order_and_never_touch(ranges: list[tuple[int, int]]) -> None:
    found = list(Ranges(ranges))
    assert all(one[1] + 1 < other[0] for one, other in zip(found, found[1:], strict=False))
    assert all(first <= last for first, last in found)
    assert Ranges(found) == Ranges(reversed(ranges))
