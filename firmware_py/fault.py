"""What can be said about a node in a scenario: its faults, and the orders that a mission controller takes."""
from __future__ import annotations

from dataclasses import dataclass

WORKS = "works"
"""The action that ends the faults of a device."""


@dataclass(frozen=True)
class Phrase:
    """Something that can happen to a device of a node.

    device: its name, "" for the node itself. count: how many of it there are, told apart as `device[1]` to `device[count]`;
    0: only one. lasts: `for 20 s` may follow, and `works` ends it. counted: `for 3 commands` may follow.
    """

    device: str
    action: str
    meaning: str
    count: int = 0
    lasts: bool = True
    counted: bool = False

    @property
    def subject(self) -> str:
        """How a scenario names the device after the node and a dot."""
        return f"{self.device}[1…{self.count}]" if self.count else self.device


@dataclass(frozen=True)
class Statement:
    """One of them said: for all devices of that name when index is None. commands: so many are affected, None: no such limit."""

    device: str
    index: int | None
    action: str
    commands: int | None = None

    def __str__(self) -> str:
        place = f"{self.device}[{self.index}]" if self.index is not None else self.device
        limit = f" for {self.commands} command{'s' * (self.commands != 1)}" if self.commands is not None else ""
        return f"{place} {self.action}{limit}".strip()
