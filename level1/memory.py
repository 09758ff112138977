"""What survives a restart of the program: stored with every batch of events, given back to the next boot."""
from __future__ import annotations

from typing import Any

import msgspec


class AlarmMemory(msgspec.Struct, frozen=True):
    """What survives a restart of one alarm, or of one reported cause of it.

    begun_ago_ns, raised_ago_ns: ages of attempts and activations when it was stored.
    """

    name: str
    state: int
    instance: int
    acknowledged: bool
    attempt: int
    begun_ago_ns: tuple[int, ...]
    raised_ago_ns: tuple[int, ...]
    key: str = ""
    detail: dict[str, Any] = {}
    text: str = ""


class State(msgspec.Struct, frozen=True):
    """What survives a restart: latches, lock-outs, budgets, activations, the mode ordered from above. No time stamps: the
    monotonic time line begins anew; time spent switched off does not count, which keeps budgets on the strict side."""

    mode: str
    alarms: tuple[AlarmMemory, ...]
