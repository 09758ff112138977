"""The computer of the unit control system, as UCS_HEALTH tells of it: heat, memory, storage, traffic log, clock, load.

In `ucs run` level 1 measures its own computer and sends this message itself. Here a node stands for it, so that the alarms of the
UCS and their repairs can be seen in virtual time; beside a running `ucs run` it would be a second talker.

What a repair orders comes as UCS_LOG_CMD and UCS_TIME_CMD. A recorder that `fails for 2 commands` records again at the second
order, one that `fails` never by itself; the clock the same.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.quantity import Setting

HEAT_S = 15.0
"""Time constant of heating and cooling."""
CPU_LOAD_C, BOARD_LOAD_C = 30.0, 12.0
"""Above the ambient when all is well."""
CPU_HOT_C, BOARD_HOT_C = 85.0, 72.0
"""The same without cooling."""
NOISE_C = 0.5
FILLS_PERCENT_S = 2.0
"""Of memory that leaks and storage that fills, and of both when they are freed."""
FULL_PERCENT = 99.0
RAM_PERCENT, STORAGE_PERCENT = 45.0, 60.0
CALM_MS, LATE_MS = 4, 400
CALM_LOAD, HIGH_LOAD = 30.0, 95.0
NEVER = -1
"""Orders left until something works again: none would help."""


class Computer(Node):
    """The node. settings: by the names of `SETTINGS`. Hears UCS_LOG_CMD and UCS_TIME_CMD; sends UCS_HEALTH."""

    TICK_NS: ClassVar[int] = 100_000_000
    DBC: ClassVar[str] = "ucs.dbc"
    DBC_NODE: ClassVar[str] = "UCS"
    HEARS: ClassVar[tuple[str, ...]] = ("UCS_LOG_CMD", "UCS_TIME_CMD")
    SENDS: ClassVar[tuple[str, ...]] = ("UCS_HEALTH",)
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("cpu", "overheats", "its cooling is blocked"),
        Phrase("cpu", WORKS, "is cooled again", lasts=False),
        Phrase("board", "overheats", "the housing stands in the sun, its fan does not turn"),
        Phrase("board", WORKS, "is cooled again", lasts=False),
        Phrase("memory", "leaks", "a program takes more and more"),
        Phrase("memory", WORKS, "the program is ended", lasts=False),
        Phrase("storage", "fills", "recordings fill it"),
        Phrase("storage", "fails", "takes no writes: worn out, or mounted read-only"),
        Phrase("storage", WORKS, "is freed, or replaced", lasts=False),
        Phrase("recorder", "fails", "can not write; for N commands: until the N-th order to begin a new file", counted=True),
        Phrase("recorder", WORKS, "writes again", lasts=False),
        Phrase("clock", "lost", "nothing keeps it right; for N commands: until the N-th order to get the time", counted=True),
        Phrase("clock", WORKS, "is kept right again", lasts=False),
        Phrase("loop", "late", "the supervision is held up"),
        Phrase("loop", WORKS, "is in time", lasts=False),
        Phrase("bus", "overloaded", "a device floods it"),
        Phrase("bus", WORKS, "is calm", lasts=False),
        *COMMON_FAULTS,
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (Setting("ambient", "degC", 25, -20, 45, "temperature around the housing"),)

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self._random = random
        self._ambient_c = chosen["ambient"]
        self._part = 1 - math.exp(-self.TICK_NS / 1e9 / HEAT_S)
        self._faults: dict[str, str] = {}
        self._orders = {"recorder": 0, "clock": 0}
        self.cpu_c, self.board_c = self._ambient_c + CPU_LOAD_C, self._ambient_c + BOARD_LOAD_C
        self.ram_percent, self.storage_percent = RAM_PERCENT, STORAGE_PERCENT

    def fails(self, device: str) -> bool:
        """Whether one of its parts is broken now."""
        return device in self._faults or bool(self._orders.get(device))

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """An order of a repair."""
        if values.get("TrafficLogOrder") == "Reopen":
            self.tell(t_ns, "begins a new traffic log")
            self._obey("recorder")
        elif values.get("TimeSyncOrder") == "Synchronise":
            self.tell(t_ns, "gets the time anew")
            self._obey("clock")

    def _obey(self, device: str) -> None:
        if self._orders[device] > 0:
            self._orders[device] -= 1

    def tick(self, t_ns: int) -> None:
        """One tick of 100 ms."""
        hot = self._faults
        self.cpu_c += self._part * (self._ambient_c + (CPU_HOT_C if "cpu" in hot else CPU_LOAD_C) - self.cpu_c)
        self.board_c += self._part * (self._ambient_c + (BOARD_HOT_C if "board" in hot else BOARD_LOAD_C) - self.board_c)
        step = FILLS_PERCENT_S * self.TICK_NS / 1e9
        self.ram_percent = _toward(self.ram_percent, FULL_PERCENT if "memory" in hot else RAM_PERCENT, step)
        self.storage_percent = _toward(
            self.storage_percent, FULL_PERCENT if hot.get("storage") == "fills" else STORAGE_PERCENT, step)

    def values(self, message: str) -> Mapping[str, Value]:
        """What it measures of itself."""
        fails = self._faults.get("storage") == "fails"
        late, busy = "loop" in self._faults, "bus" in self._faults
        return {
            "CpuTemperature": round(self.cpu_c + self._random.gauss(0, NOISE_C)),
            "MainboardTemperature": round(self.board_c + self._random.gauss(0, NOISE_C)),
            "RamUsed": _even(self.ram_percent), "StorageUsed": _even(self.storage_percent),
            "StorageWrite": "Failed" if fails else "Ok", "TrafficLog": "Failed" if self._orders["recorder"] else "Ok",
            "BusState": "BusActive", "TimeSync": "NotSynchronised" if self._orders["clock"] else "Synchronised",
            "JournalState": "JournalReadOnly" if fails else "JournalOk", "GnssQuality": "RtkFixed",
            "LoopLateness": LATE_MS if late else CALM_MS, "BusLoad": _even(HIGH_LOAD if busy else CALM_LOAD)}

    def restart(self, t_ns: int) -> None:
        """What was lost with the memory begins anew; heat and storage are where they were."""
        self.ram_percent = RAM_PERCENT
        self._faults.pop("memory", None)

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        device, works = statement.device, statement.action == WORKS
        if device in self._orders:
            self._orders[device] = 0 if works else statement.commands or NEVER
        elif works:
            self._faults.pop(device, None)
        else:
            self._faults[device] = statement.action


def _toward(value: float, target: float, step: float) -> float:
    return min(value + step, target) if value < target else max(value - step, target)


def _even(percent: float) -> float:
    """In steps of the signal, 0.4 %."""
    return round(percent / 0.4) * 0.4
