"""The flaming tool: the node FLAMER of `flaming_tool.dbc` with its burner safeguard and its plant.

Every tick of 20 ms: sensors → safeguard → work mode and valves → plant. Commands are cyclic; when they stop, the gas valve is
closed within 500 ms of the last one (time-out 400 ms, one tick, closing time 40 ms).
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.actuator import Actuator
from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.flaming_plant import LEAK, Bottle, FlamingPlant, Hazard, Wind
from firmware_py.node import BABBLING, COMMON_FAULTS, WRONG_COUNTER, Node
from firmware_py.quantity import Setting
from firmware_py.safeguard import Safeguard

BURNERS = 4
COMMAND_TIMEOUT_NS = 400_000_000
VALVE_NS = 40_000_000
"""Response time of the gas valve, either way."""
MODE_NS = 100_000_000
"""Response time of the work-mode relay."""
BURNER_RESPONSE_S = (0.2, 0.6)
SLOW = 6
DRIFT_NS = 30_000_000_000
"""Response time of a burner's valves; each burner has its own."""
SENSOR_ON_NS = 300_000_000
SENSOR_OFF_NS = 200_000_000
"""Flame to sensor signal and back."""
MODE_END_NS = 120_000_000_000
"""Gas commanded closed for so long (four purges, longer than three attempts that fail before they open it): nobody is about to
light it, the work mode ends."""
FLAME_CURRENT_UA = 8.0
TIGHT_BAR = 0.05
"""Less than this behind the closed gas valve: it is tight."""

IDLE: dict[str, Value] = {"Flaming": "Off", "GasValve": "Closed", "Igniter": "Off",
                          **{f"Burner{n}": "Off" for n in range(1, BURNERS + 1)}}
"""What counts as commanded until someone commands."""


class FlameSensor:
    """Ionisation sensor with its delays. sees: what it reports. stuck: reports this whatever there is."""

    def __init__(self, now_ns: int) -> None:
        self.sees = False
        self.stuck: bool | None = None
        self._flame = False
        self._since_ns = now_ns

    def advance(self, now_ns: int, flame: bool) -> None:
        """One tick."""
        if flame != self._flame:
            self._flame = flame
            self._since_ns = now_ns
        if now_ns - self._since_ns >= (SENSOR_ON_NS if flame else SENSOR_OFF_NS):
            self.sees = flame
        if self.stuck is not None:
            self.sees = self.stuck


class FlamingTool(Node):
    """The node. settings: by the names of `SETTINGS`, those not given are at their defaults. random: all its chance.

    Hears FLAMER_CMD; sends FLAMER_STATUS, FLAMER_BURNERS, FLAMER_BOTTLE. `hazards` is the plant's record of dangerous moments.
    """

    DBC: ClassVar[str] = "flaming_tool.dbc"
    DBC_NODE: ClassVar[str] = "FLAMER"
    HEARS: ClassVar[tuple[str, ...]] = ("FLAMER_CMD",)
    SENDS: ClassVar[tuple[str, ...]] = ("FLAMER_STATUS", "FLAMER_BURNERS", "FLAMER_BOTTLE")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("pilot", "blown out", "the pilot flame goes out", lasts=False),
        Phrase("igniter", "dead", "no spark"),
        Phrase("igniter", WORKS, "sparks again", lasts=False),
        Phrase("gas_valve", "stuck closed", "falls closed, or stays closed", counted=True),
        Phrase("gas_valve", "stuck open", "does not close, once it is open", counted=True),
        Phrase("gas_valve", "leaks", "lets gas through when closed"),
        Phrase("gas_valve", WORKS, "opens and closes again", lasts=False),
        Phrase("burner", "stuck", "stays as it is", count=BURNERS, counted=True),
        Phrase("burner", "stuck off", "does not open, once it is closed", count=BURNERS, counted=True),
        Phrase("burner", "stuck low", "stays at low pressure, once it is there", count=BURNERS, counted=True),
        Phrase("burner", "stuck high", "stays at high pressure, once it is there", count=BURNERS, counted=True),
        Phrase("burner", "slow", f"needs {SLOW} times as long", count=BURNERS),
        Phrase("burner", WORKS, "moves again", count=BURNERS, lasts=False),
        Phrase("", "refuses start", "does not start flaming", counted=True),
        Phrase("", "refuses stop", "does not stop flaming", counted=True),
        Phrase("bottle", "empty", "all gas is gone", lasts=False),
        Phrase("bottle", "changed", "someone brings a full one", lasts=False),
        Phrase("bottle_sensor", "drifts down", "reads a bottle that runs empty in 30 s, level and pressure"),
        Phrase("bottle_sensor", WORKS, "reads right", lasts=False),
        Phrase("flame_sensor", "stuck on", "always sees a flame"),
        Phrase("flame_sensor", "stuck off", "never sees a flame"),
        Phrase("flame_sensor", WORKS, "sees what there is", lasts=False),
        Phrase("wind", "gust", "one gust of the strength set", lasts=False),
        BABBLING,
        WRONG_COUNTER,
        *COMMON_FAULTS,
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("bottle_level", "%", 80, 0, 100, "gas in the bottle of 33 kg, by weight"),
        Setting("air_temperature", "degC", 15, -30, 45, "of the air around the bottle"),
        Setting("wind", "m/s", 3, 0, 40, "steady wind; above 6 m/s it may blow the pilot flame out"),
        Setting("gust", "m/s", 12, 0, 40, "wind in a gust"),
        Setting("gust_every", "s", 0, 0, 86400, "mean time between gusts, 0 s for none"),
        Setting("gust_length", "s", 3, 0.1, 60, "how long a gust lasts"),
        Setting("purged", "", 1, 0, 1, "whether the tool stood long enough before to be lit at once"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        wind = Wind(random, chosen["wind"], chosen["gust"], chosen["gust_every"], chosen["gust_length"])
        bottle = Bottle(chosen["bottle_level"], chosen["air_temperature"])
        self.plant = FlamingPlant(random, bottle, wind, self.TICK_NS / 1e9)
        self.safeguard = Safeguard(start_ns, purged=bool(chosen["purged"]))
        self._random = random
        self._sensor = FlameSensor(start_ns)
        self._valve = Actuator("Closed", VALVE_NS)
        self._mode = Actuator("Off", MODE_NS)
        self._responses_ns = tuple(round(random.uniform(*BURNER_RESPONSE_S) * 1e9) for _ in range(BURNERS))
        self._burners = tuple(Actuator("Off", response_ns) for response_ns in self._responses_ns)
        self._drifts_ns: int | None = None
        self._igniter_dead = False
        self._leaks = False
        self._command: Mapping[str, Value] = IDLE
        self._commanded_ns: int | None = None
        self._gas_wanted_ns = start_ns
        self._alive = 0
        self._told = self._look()
        self._told_hazards = 0

    @property
    def hazards(self) -> list[Hazard]:
        """Dangerous moments so far."""
        return self.plant.hazards

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """A command."""
        self._command = values
        self._commanded_ns = t_ns

    def tick(self, t_ns: int) -> None:
        """One tick of 20 ms."""
        command = self._command
        fresh = self.powered and self._commanded_ns is not None and t_ns - self._commanded_ns < COMMAND_TIMEOUT_NS
        gas = command["GasValve"] == "Open"
        self._sensor.advance(t_ns, self.plant.flame)
        flame = self._sensor.sees
        self.safeguard.advance(t_ns, gas=gas, spark=command["Igniter"] == "On", fresh=fresh, flame=flame,
                               opened=self._valve.position == "Open", closed=self._closed)
        if gas:
            self._gas_wanted_ns = t_ns
        self._follow(t_ns, fresh and t_ns - self._gas_wanted_ns < MODE_END_NS, flame)
        self.plant.advance(t_ns, opening=self._opening, spark=self._spark, burners=self.burner_positions)
        seen = self._look()
        if seen != self._told:
            self._tell_changes(t_ns, seen)

    def _follow(self, t_ns: int, fresh: bool, flame: bool) -> None:
        """Work mode, gas valve and burners, from command and safeguard."""
        running = self.safeguard.state == "Running" and flame
        if not fresh and self._mode.position == "On":
            self._mode.force("Off")
        works = fresh and self._command["Flaming"] == "On" and (running or self._mode.position == "On")
        self._mode.advance(t_ns, "On" if works else "Off")
        self._valve.advance(t_ns, self.safeguard.valve if self.powered else "Closed")
        burning = running and self._mode.position == "On"
        for number, burner in enumerate(self._burners, 1):
            wanted = self._command[f"Burner{number}"] if burning else "Off"
            burner.advance(t_ns, str(wanted) if wanted in ("Low", "High") else "Off")

    @property
    def _closed(self) -> bool:
        """Gas valve and burners, and the line between them empty: a burner that stayed open would let gas out at the next start."""
        return (self._valve.position == "Closed" and self.plant.line_bar < TIGHT_BAR
                and all(burner.position == "Off" for burner in self._burners))

    @property
    def _opening(self) -> float:
        return 1.0 if self._valve.position == "Open" else LEAK if self._leaks else 0.0

    @property
    def _spark(self) -> bool:
        return self.powered and self.safeguard.sparks and self._command["Igniter"] == "On" and not self._igniter_dead

    @property
    def works(self) -> bool:
        """Whether it is in its work mode."""
        return self._mode.position == "On"

    @property
    def valve(self) -> str:
        """Where the gas valve stands: Open or Closed."""
        return self._valve.position

    @property
    def sees_flame(self) -> bool:
        """What the flame sensor says."""
        return self._sensor.sees

    @property
    def burner_positions(self) -> tuple[str, ...]:
        """Off, Low or High, of each burner."""
        return tuple([burner.position for burner in self._burners])

    def values(self, message: str) -> Mapping[str, Value]:
        """What the sensors say now."""
        match message:
            case "FLAMER_STATUS":
                self._alive = self.count(self._alive)
                return {
                    "Flaming": self._mode.position, "PilotFlame": "On" if self._sensor.sees else "Off",
                    "GasValve": self._valve.position, "GasValveDemand": self.safeguard.valve,
                    "Igniter": "On" if self._spark else "Off", "Safeguard": self.safeguard.state,
                    "PilotCurrent": FLAME_CURRENT_UA if self._sensor.sees else 0.0,
                    "LinePressure": round(self.plant.line_bar, 2), "AliveCounter": self._alive}
            case "FLAMER_BURNERS":
                return {f"Burner{number}": burner.position for number, burner in enumerate(self._burners, 1)}
            case _:
                bottle = self.plant.bottle
                return {"BottlePressure": round(bottle.bar * self.bottle_told, 2),
                        "BottleLevel": round(2 * bottle.level_percent * self.bottle_told) / 2,
                        "BottleTemperature": round(bottle.celsius), "GasUsed": round(bottle.gas_used_kg, 3)}

    @property
    def bottle_told(self) -> float:
        """The part that the bottle's sensors tell of what there is."""
        if self._drifts_ns is None:
            return 1.0
        return max(0.0, 1 - (self._next_tick_ns - self._drifts_ns) / DRIFT_NS)

    def restart(self, t_ns: int) -> None:
        """Protocol begins anew; what was driven falls back to closed and off."""
        self.safeguard = Safeguard(t_ns)
        self._command = IDLE
        self._commanded_ns = None
        self._gas_wanted_ns = t_ns
        self._mode.force("Off")

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        match statement.device, statement.action:
            case "pilot", "blown out":
                self.plant.blow_out("blown out")
            case "igniter", action:
                self._igniter_dead = action == "dead"
            case "gas_valve", action:
                self._valve_fault(action, statement.commands)
            case "burner", action:
                chosen = self._burners if statement.index is None else (self._burners[statement.index - 1],)
                for burner in chosen:
                    if action in ("slow", WORKS):
                        burner.response_ns = self._responses_ns[self._burners.index(burner)] * (SLOW if action == "slow" else 1)
                    if action != "slow":
                        _jam_burner(burner, action, statement.commands)
            case "bottle_sensor", action:
                self._drifts_ns = None if action == WORKS else now_ns
            case "", "refuses start":
                self._mode.jam(("On",), statement.commands)
            case "", "refuses stop":
                self._mode.jam(("Off",), statement.commands)
            case "bottle", "empty":
                self.plant.bottle.empty()
            case "bottle", "changed":
                self.plant.bottle.change()
            case "flame_sensor", action:
                self._sensor.stuck = {"stuck on": True, "stuck off": False}.get(action)
            case "wind", "gust":
                self.plant.wind.gust()
            case _:
                super().fault(now_ns, statement)

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` without a device also ends a refusal to start or stop."""
        super().inject(now_ns, statement)
        if statement == Statement("", None, WORKS):
            self._mode.release()

    def _valve_fault(self, action: str, commands: int | None) -> None:
        self._leaks = action == "leaks"
        match action:
            case "stuck closed":
                self._valve.jam(("Open",), commands)
                self._valve.force("Closed")
            case "stuck open":
                self._valve.jam(("Closed",), commands)
            case _:
                self._valve.release()

    # --- story ------------------------------------------------------------------------------------------------------------

    def _look(self) -> tuple[object, ...]:
        """What a bystander sees; in the order of `_tell_changes`."""
        return (self._valve.position, self._spark, self.plant.flame, self.safeguard.state, self._mode.position,
                self.burner_positions, len(self.plant.hazards))

    def _tell_changes(self, t_ns: int, seen: tuple[object, ...]) -> None:
        valve, spark, flame, state, mode, burners, hazards = zip(self._told, seen, strict=True)
        self._told = seen
        if state[0] != state[1] and state[1] in _STATES:
            self.tell(t_ns, _STATES[str(state[1])])
        if valve[0] != valve[1]:
            self.tell(t_ns, f"gas valve {'opens' if valve[1] == 'Open' else 'closed'}")
        if spark[1] and not spark[0]:
            self.tell(t_ns, "igniter sparks")
        if flame[0] != flame[1]:
            self.tell(t_ns, "pilot flame burns" if flame[1] else f"pilot flame out: {self.plant.loss}")
        if mode[0] != mode[1]:
            self.tell(t_ns, f"flaming {str(mode[1]).lower()}")
        if burners[0] != burners[1]:
            self.tell(t_ns, f"burners {' '.join(self.burner_positions).lower()}")
        for hazard in self.plant.hazards[self._told_hazards:]:
            self.tell(t_ns, f"HAZARD: {hazard.what}")
        self._told_hazards = len(self.plant.hazards)


_STATES = {
    "Ready": "purged: unburnt gas has dispersed",
    "FlameLost": "safeguard closes the gas valve: flame lost",
    "IgnitionFailed": "safeguard closes the gas valve: no flame in the trial",
    "CommandsLost": "safeguard closes the gas valve: commands stopped",
}


def _jam_burner(burner: Actuator[str], action: str, commands: int | None) -> None:
    levels = {"stuck off": "Off", "stuck low": "Low", "stuck high": "High"}
    if action == WORKS:
        burner.release()
    elif action == "stuck":
        burner.jam(None, commands)
    else:
        burner.jam(tuple(level for level in levels.values() if level != levels[action]), commands)
