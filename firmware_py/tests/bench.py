"""A test bench: the flaming tool with a commander that sends FLAMER_CMD every 100 ms, in virtual time."""
from __future__ import annotations

from random import Random

from firmware_py.codec import Codec, Value
from firmware_py.fault import Statement
from firmware_py.flaming_tool import IDLE, FlamingTool
from firmware_py.participant import BusFrame
from firmware_py.virtual_bus import Simulation

SECOND = 1_000_000_000
CODEC = Codec.shipped("flaming_tool.dbc")
LIT = {"Flaming": "On", "GasValve": "Open", "Igniter": "On"}
WORK = {"Flaming": "On", "GasValve": "Open", "Igniter": "Off"}


class Commander:
    """Sends the command it holds every 100 ms, as long as `sends`; keeps what it hears, decoded."""

    def __init__(self) -> None:
        self.command: dict[str, Value] = dict(IDLE)
        self.sends = True
        self.heard: dict[str, dict[str, Value]] = {}
        self.history: list[tuple[int, str, dict[str, Value]]] = []
        self._names = {CODEC.identifier(name): name for name in CODEC.names}
        self._next_ns = 0

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        name = self._names[can_id, extended]
        values = CODEC.decode(name, data)
        assert values is not None
        self.heard[name] = dict(values)
        self.history.append((t_ns, name, dict(values)))

    def step(self, now_ns: int) -> list[BusFrame]:
        self._next_ns = now_ns + SECOND // 10
        if not self.sends:
            return []
        return [BusFrame(*CODEC.identifier("FLAMER_CMD"), CODEC.encode("FLAMER_CMD", self.command))]

    def next_deadline(self) -> int | None:
        return self._next_ns


class Bench:
    """The tool and its commander on a bus. settings as in a scenario."""

    def __init__(self, seed: int = 1, **settings: float):
        self.tool = FlamingTool("flamer", CODEC, settings, Random(seed))
        self.commander = Commander()
        self.told: list[str] = []
        self.simulation = Simulation([self.commander, self.tool], on_happening=lambda happening: self.told.append(happening.text))

    @property
    def now_ns(self) -> int:
        return self.simulation.now_ns

    def run(self, seconds: float) -> Bench:
        """Let time pass."""
        self.simulation.run(self.now_ns + round(seconds * SECOND))
        return self

    def order(self, **values: Value) -> Bench:
        """Change the command that is sent."""
        self.commander.command.update(values)
        return self

    def break_(self, device: str, action: str, index: int | None = None, commands: int | None = None) -> Bench:
        """Inject a fault."""
        self.tool.inject(self.now_ns, Statement(device, index, action, commands))
        return self

    def light(self) -> Bench:
        """Closed first, then the pilot flame lit, then work."""
        return self.run(0.3).order(**LIT).run(2.5).order(**WORK).run(1)

    def status(self, signal: str) -> Value:
        """What the tool last said."""
        return self.commander.heard["FLAMER_STATUS"][signal]

    def burners(self) -> tuple[Value, ...]:
        """What the tool last said of its burners."""
        return tuple(self.commander.heard["FLAMER_BURNERS"].values())
