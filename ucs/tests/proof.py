"""Rows of table-driven tests that say which alarms they prove, for the table in docs/coverage.md."""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pytest

from level1.event import Event, Output


def proves(lives: Mapping[str, Sequence[str]], *values: Any) -> Any:
    """A row for `pytest.mark.parametrize`. lives: what its test asserts of each alarm, event by event; values: its arguments."""
    return pytest.param(*values, marks=[pytest.mark.covers(alarm, *dict.fromkeys(life)) for alarm, life in lives.items()])


def lives(outputs: Iterable[Output]) -> dict[str, list[str]]:
    """What was reported of each alarm, event by event."""
    found: dict[str, list[str]] = {}
    for output in outputs:
        if isinstance(output, Event):
            found.setdefault(output.alarm, []).append(output.event)
    return found
