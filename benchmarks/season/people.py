"""The people of a day: who orders the work, resets what is locked out, fills tanks and presses the start button."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from random import Random

from benchmarks.season.world import World
from firmware_py.mission_controller import MissionController

ROUND_NS = 10_000_000_000
"""Somebody looks after the machine so often."""
Tell = Callable[[str, str, str, int | None], None]
"""Node, device, action, index: an order to a mission controller, or something done to a machine."""


class People:
    """tell(…) carries out what they want. Each has moods of its own: `dice`."""

    def __init__(self, machine: str, world: World, dice: Random, tell: Tell):
        self._world = world
        self._dice = dice
        self._tell = tell
        parts = {"flaming tool": (self._flame,), "sprayer boom": (self._spray,), "tractor": (self._drive,),
                 "tractor with boom": (self._drive, self._spray), "air-blast sprayer": (self._blow,)}
        self._parts: tuple[Callable[[], None], ...] = parts[machine]
        self._by_map = machine == "tractor with boom"
        self._rests: dict[str, int] = {}
        self._first = True

    def look(self) -> None:
        """One round."""
        for part in self._parts:
            part()
        self._first = False

    def _now_and_then(self, chance: float) -> bool:
        return self._dice.random() < chance

    def _rest(self, what: str, chance: float) -> bool:
        """Whether that work pauses for some rounds."""
        left = self._rests.get(what, 0)
        if not left and not self._first and self._now_and_then(chance):
            left = self._dice.randint(2, 6)
        self._rests[what] = max(0, left - 1)
        return left > 0

    def _flame(self) -> None:
        mission = self._world.nodes["mission"]
        assert isinstance(mission, MissionController)
        if self._rest("flaming", 0.04):
            self._tell("mission", "flaming", "off", None)
        elif mission.state == "Idle":
            self._tell("mission", "flaming", "on", None)
        if self._world.flamer.plant.bottle.level_percent < 12 and self._now_and_then(0.05):
            self._tell("flamer", "bottle", "changed", None)
        if self._first or self._now_and_then(0.15):
            self._tell("mission", "burner", self._dice.choice(["off", "low", "high"]), self._dice.choice([None, 1, 2, 3, 4]))

    def _spray(self) -> None:
        sprayer = self._world.sprayer
        if self._first and not self._by_map:
            self._tell("mission", "section", "on", None)
        rests, folds = self._rest("spraying", 0.03), self._rest("boom", 0.03)
        self._tell("mission", "boom", "close" if folds else "open", None)
        self._tell("mission", "spraying", "off" if rests or folds else "on", None)
        if self._now_and_then(0.3) and not self._by_map:
            self._tell("mission", "section", self._dice.choice(["on", "on", "off"]), self._dice.randint(1, 12))
        if self._now_and_then(0.05):
            self._tell("mission", "dose", self._dice.choice(["normal", "half"]), None)
        if sprayer.plant.tank.litres < 25 and self._now_and_then(0.2):
            self._tell("sprayer", "main_tank", "filled", None)
        if sprayer.plant.dis_l < 1.5 and self._now_and_then(0.2):
            self._tell("sprayer", "dis_tank", "filled", None)

    def _drive(self) -> None:
        tractor = self._world.tractor
        match tractor.controller:
            case "Stopped":
                self._tell("tractor", "start_button", "pressed", None)
            case "Paused" if self._now_and_then(0.5):
                self._tell("driver", "mission", "resume", None)
            case "Ready" if tractor.mission == "Finished":
                self._tell("tractor", "path", "loaded", None)
            case "Ready":
                self._tell("driver", "mission", "start", None)
            case "Executing" if self._now_and_then(0.03):
                self._tell("driver", "mission", self._dice.choice(["pause", "pause", "stop"]), None)
            case _:
                pass
        for device, actions in _WISHES.items():
            if self._first or self._now_and_then(0.12):
                self._tell("driver", device, self._dice.choice(actions), None)

    def _blow(self) -> None:
        self._tell("mission", "spraying", "off" if self._rest("spraying", 0.04) else "on", None)
        if self._now_and_then(0.1):
            self._tell("mission", "nozzles", self._dice.choice(["automatic", "automatic", "open", "closed"]), None)
        if self._now_and_then(0.1):
            self._tell("mission", "turning", self._dice.choice(["automatic", "automatic", "level"]), None)
        if self._world.airblast.plant.level_percent < 12 and self._now_and_then(0.15):
            self._tell("airblast", "tank", "filled", None)


_WISHES: Mapping[str, tuple[str, ...]] = {"pto": ("on", "on", "off"), "hitch": ("by path", "raise", "lower"),
                                          "implement": ("set", "set", "unset"), "speed": ("normal", "normal", "slow")}

