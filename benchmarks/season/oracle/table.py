"""The form of the tables of what faults show as."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.season.world import World

Truth = Callable[[World, int], bool]
"""Whether it is so; the number is that of the device (`valve[7]`: 7), 0 for what there is only one of."""
State = Callable[[World], bool]
TAIL_S = 30.0


@dataclass(frozen=True)
class Symptom:
    """After `within_s` of this one of the alarms must be there. `{n}` stands for the device's number.

    remains: the truth is a state of the machine, which may outlast the fault. Else it only tells whether the fault can be seen
    while it lasts: one that has ended explains nothing any more, although the machine talks on.
    """

    alarms: tuple[str, ...]
    within_s: float
    truth: Truth
    remains: bool = True


@dataclass(frozen=True)
class Row:
    """What is known of a fault. sums: alarms that sum up its symptoms, as long as one of them can be seen."""

    symptoms: tuple[Symptom, ...] = ()
    may: tuple[str, ...] = ()
    tail_s: float = TAIL_S
    sums: tuple[str, ...] = ()


def symptom(alarms: str, within_s: float, truth: Truth, *, remains: bool = True) -> Symptom:
    """One whose alarms, any of which will do, are the words of a text."""
    return Symptom(tuple(alarms.split()), within_s, truth, remains)
