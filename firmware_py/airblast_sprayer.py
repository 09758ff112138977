"""The air-blast sprayer: the node AIRBLAST of `airblast_sprayer.dbc`, a CANopen device, with its plant.

Two columns of four nozzles: 1 to 4 on the left from top to bottom, 5 to 8 on the right. A nozzle opens only before leaves: when
its ultrasonic sensor works, was heard within 700 ms, and sees something within 2 m. An upper (lower) nozzle turns down (up) while
its sensor sees nothing, and back when it does.

Every tick of 20 ms: sensors → work mode, main valve, nozzles, angles → plant. Commands are cyclic (RPDO 1); when they stop for the
time of its event timer, 400 ms, the main valve closes, and an emergency says so. Work begins or ends with one try a command; one
more is made on Retry only.
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.actuator import Actuator
from firmware_py.airblast_plant import AirblastPlant
from firmware_py.canopen_node import CANOPEN_FAULTS, CanopenNode
from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.node import WRONG_COUNTER
from firmware_py.quantity import Setting
from firmware_py.ultrasonic_sensors import COLUMN, NO_ECHO, SENSORS

NOZZLES = SENSORS
SENSOR_TIMEOUT_NS = 700_000_000
STATE_TIMEOUT_NS = 1_500_000_000
"""For so long the state of the sensors counts: it comes every second."""
RANGE_CM = 200
"""Working range of a nozzle."""
MODE_NS = 500_000_000
VALVE_NS = 300_000_000
NOZZLE_RESPONSE_S = (0.1, 0.3)
TURN_DEG_S, RETURN_DEG_S = 20.0, 5.0
STEEPEST_DEG = 30.0
EMPTY_PERCENT, FILLED_PERCENT = 1.0, 5.0
"""The pump stops at the one and may start again at the other."""
UPPER, LOWER = (0, 4), (3, 7)
"""Nozzles that turn, by index."""
ANGLES = {0: "AngleLeftUpper", 3: "AngleLeftLower", 4: "AngleRightUpper", 7: "AngleRightLower"}
DRIFT_PERCENT_S, SLOW = 3.0, 8
COMMANDS_LOST, TANK_EMPTY = 0x8250, 0xFF10
"""Error codes."""
IDLE: dict[str, Value] = {"AirblastWanted": "Off", "NozzleMode": "Automatic", "TurnMode": "Automatic", "Retry": "Off",
                          "AirblastFlowWanted": 0}
"""What counts as commanded until someone commands."""


class AirblastSprayer(CanopenNode):
    """The node. settings: by the names of `SETTINGS`, those not given are at their defaults. random: all its chance.

    Hears AIRBLAST_CMD, US_LEFT, US_RIGHT, US_STATE; sends AIRBLAST_STATUS, AIRBLAST_LINE.
    """

    DBC: ClassVar[str] = "airblast_sprayer.dbc"
    DBC_NODE: ClassVar[str] = "AIRBLAST"
    EDS: ClassVar[str] = "airblast_sprayer.eds"
    NODE_ID: ClassVar[int] = 42
    HEARS: ClassVar[tuple[str, ...]] = ("AIRBLAST_CMD", "US_LEFT", "US_RIGHT", "US_STATE")
    SENDS: ClassVar[tuple[str, ...]] = ("AIRBLAST_STATUS", "AIRBLAST_LINE")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("tank", "empty", "everything has run out", lasts=False),
        Phrase("tank", "low", "a tenth is left", lasts=False),
        Phrase("tank", "filled", "full again", lasts=False),
        Phrase("line", "blocked", "nothing flows; `for 1 command`: until the main valve has been opened once", counted=True),
        Phrase("line", WORKS, "it flows again", lasts=False),
        Phrase("", "refuses start", "does not start", counted=True),
        Phrase("", "refuses stop", "does not stop", counted=True),
        Phrase("", "slow", f"takes {SLOW} times as long to start and to stop"),
        Phrase("level_sensor", "drifts down", f"reads {DRIFT_PERCENT_S:g} % less each second"),
        Phrase("level_sensor", WORKS, "reads right", lasts=False),
        WRONG_COUNTER,
        *CANOPEN_FAULTS,
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("tank_volume", "L", 400, 50, 3000, "of the tank"),
        Setting("tank_level", "%", 80, 0, 100, "what is in it at the start"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self.plant = AirblastPlant(random, chosen["tank_volume"], chosen["tank_level"], self.TICK_NS / 1e9)
        self._command_timeout_ns = int(self.device.rpdo[1].event_timer) * 1_000_000
        self._mode = Actuator("Off", MODE_NS, retry_ns=None)
        self._valve = Actuator("Closed", VALVE_NS)
        self._nozzles = tuple(Actuator("Closed", round(random.uniform(*NOZZLE_RESPONSE_S) * 1e9)) for _ in range(NOZZLES))
        self._angles = dict.fromkeys(ANGLES, 0.0)
        self._opens_left: int | None = None
        self._drifts_ns: int | None = None
        self._counter = 0
        self._forget()
        self._told = self._look()

    def _forget(self) -> None:
        """Nothing was heard yet."""
        self._command: Mapping[str, Value] = IDLE
        self._commanded_ns: int | None = None
        self._distances: dict[int, tuple[int, float]] = {}
        self._states: Mapping[str, Value] = {}
        self._states_ns = 0
        self._state = "Idle"
        self._retries = False

    @property
    def works(self) -> bool:
        """Whether it sprays, as its status tells."""
        return self._mode.position == "On" and self._valve.position == "Open"

    @property
    def state(self) -> str:
        """Idle, Working, CommandsLost or TankEmpty."""
        return self._state

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """A command, or what the sensors say."""
        if message == "AIRBLAST_CMD":
            self._retries = values["Retry"] == "On" and self._command["Retry"] != "On"
            self._command = values
            self._commanded_ns = t_ns
        elif message == "US_STATE":
            self._states, self._states_ns = values, t_ns
        else:
            first = 0 if message == "US_LEFT" else COLUMN
            for index in range(first, first + COLUMN):
                distance = values[f"Distance{index + 1}"]
                self._distances[index] = (t_ns, float(NO_ECHO if distance == "NoEcho" else distance))

    def tick(self, t_ns: int) -> None:
        """One tick of 20 ms."""
        runs = self.powered and not self._frozen and self.nmt_state == 5
        fresh = runs and self._commanded_ns is not None and t_ns - self._commanded_ns < self._command_timeout_ns
        self._watch(fresh)
        wanted = fresh and self._command["AirblastWanted"] == "On" and self._state != "TankEmpty"
        if not self.powered or self._state in ("CommandsLost", "TankEmpty"):
            self._mode.advance(t_ns, "Off")
            self._mode.force("Off")
        elif not self._frozen:
            self._mode.advance(t_ns, "On" if wanted else "Off")
            if self._retries:
                self._retries = False
                self._mode.again(t_ns)
        was_open = self._valve.position == "Open"
        self._valve.advance(t_ns, "Open" if self._mode.position == "On" else "Closed")
        if self._valve.position == "Open" and not was_open:
            self._loosen()
        if not self._frozen:
            self._move_nozzles(t_ns)
        self.plant.advance(pumps=self._mode.position == "On", valve_open=self._valve.position == "Open",
                           wanted_l_min=float(self._command["AirblastFlowWanted"]),
                           nozzles=sum(nozzle.position == "Open" for nozzle in self._nozzles))
        if not self._frozen and self._state not in ("CommandsLost", "TankEmpty"):
            self._state = "Working" if self._mode.position == "On" else "Idle"
        self._tell_changes(t_ns)

    def _watch(self, fresh: bool) -> None:
        """Commands that stop, and a tank that runs empty."""
        if not self.powered or self._frozen:
            return
        if self._mode.position == "On" and not fresh and self._state == "Working":
            self._state = "CommandsLost"
            self.raise_error(COMMANDS_LOST)
        elif fresh:  # whatever else has come meanwhile
            self.clear_error(COMMANDS_LOST)
            if self._state == "CommandsLost":
                self._state = "Idle"
        if self.plant.level_percent < EMPTY_PERCENT and self._state != "TankEmpty":
            self._state = "TankEmpty"
            self.raise_error(TANK_EMPTY)
        elif self._state == "TankEmpty" and self.plant.level_percent >= FILLED_PERCENT:
            self._state = "Idle"
            self.clear_error(TANK_EMPTY)

    def _sees(self, t_ns: int, index: int) -> bool | None:
        """Whether there are leaves before a nozzle; None when its sensor doesn't tell."""
        if self._states.get(f"Sensor{index + 1}") != "Working" or t_ns - self._states_ns > STATE_TIMEOUT_NS:
            return None
        heard_ns, distance_cm = self._distances.get(index, (t_ns - SENSOR_TIMEOUT_NS - 1, 0.0))
        return distance_cm <= RANGE_CM if t_ns - heard_ns <= SENSOR_TIMEOUT_NS else None

    def _move_nozzles(self, t_ns: int) -> None:
        works = self.powered and self._mode.position == "On"
        for index, nozzle in enumerate(self._nozzles):
            sees = self._sees(t_ns, index)
            mode = self._command["NozzleMode"]
            wanted = works and (mode == "Open" or mode == "Automatic" and sees is True)
            nozzle.advance(t_ns, "Open" if wanted else "Closed")
            if index in self._angles:
                self._turn(index, works, sees)

    def _turn(self, index: int, works: bool, sees: bool | None) -> None:
        step = self.TICK_NS / 1e9
        angle = self._angles[index]
        if works and self._command["TurnMode"] == "Automatic" and sees is False:
            steep = -STEEPEST_DEG if index in UPPER else STEEPEST_DEG
            angle += max(-TURN_DEG_S * step, min(TURN_DEG_S * step, steep - angle))
        elif sees is True or not works or self._command["TurnMode"] == "Level":
            angle += max(-RETURN_DEG_S * step, min(RETURN_DEG_S * step, -angle))
        self._angles[index] = angle

    def _loosen(self) -> None:
        """The main valve has opened once more: that may free a blocked line."""
        if self.plant.blocked and self._opens_left is not None:
            self._opens_left -= 1
            self.plant.blocked = self._opens_left > 0

    def values(self, message: str) -> Mapping[str, Value]:
        """What the sensors say now."""
        if message == "AIRBLAST_STATUS":
            self._counter = self.count(self._counter)
            return {"Airblast": "On" if self._mode.position == "On" and self._valve.position == "Open" else "Off",
                    "MainValve": self._valve.position, "AirblastState": self._state,
                    **{f"Nozzle{number}": nozzle.position for number, nozzle in enumerate(self._nozzles, 1)},
                    **{name: round(self._angles[index]) for index, name in ANGLES.items()}, "AirblastCounter": self._counter}
        return {"AirblastFlow": round(self.plant.shown_l_min, 2), "AirblastPressure": round(self.plant.bar, 2),
                "AirblastTankLevel": round(2 * max(0.0, self.plant.shown_percent - self.drift_percent)) / 2,
                "AirblastSprayed": round(self.plant.sprayed_l, 1)}

    @property
    def drift_percent(self) -> float:
        """By how much the level sensor reads too low."""
        return 0.0 if self._drifts_ns is None else DRIFT_PERCENT_S * (self._next_tick_ns - self._drifts_ns) / 1e9

    def reboot(self, t_ns: int) -> None:
        """The program begins anew: off, and nothing heard."""
        self._forget()

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        match statement.device, statement.action:
            case "tank", level:
                self.plant.fill({"empty": 0.0, "low": 10.0}.get(level, 100.0))
            case "line", action:
                self.plant.blocked = action == "blocked"
                self._opens_left = statement.commands
            case "level_sensor", action:
                self._drifts_ns = None if action == WORKS else now_ns
            case "", "refuses start":
                self._mode.jam(("On",), statement.commands)
            case "", "refuses stop":
                self._mode.jam(("Off",), statement.commands)
            case "", "slow":
                self._mode.response_ns = SLOW * MODE_NS
            case _:
                super().fault(now_ns, statement)

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` without a device also ends what it does with starts and stops."""
        super().inject(now_ns, statement)
        if statement == Statement("", None, WORKS):
            self._mode.response_ns = MODE_NS
            self._mode.release()

    # --- story ------------------------------------------------------------------------------------------------------------

    def _look(self) -> tuple[str, str]:
        """What a bystander sees; in the order of `_tell_changes`."""
        return self._mode.position, self._state

    def _tell_changes(self, t_ns: int) -> None:
        (was_mode, was_state), (mode, state) = self._told, self._look()
        self._told = (mode, state)
        if mode != was_mode:
            self.tell(t_ns, f"spraying {mode.lower()}")
        if state != was_state and state in _STATES:
            self.tell(t_ns, _STATES[state])


_STATES = {"CommandsLost": "closes the main valve: commands stopped", "TankEmpty": "stops the pump: the tank is empty"}
