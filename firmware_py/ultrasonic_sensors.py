"""The ultrasonic sensors of the air-blast sprayer: the node ULTRASONIC of `airblast_sprayer.dbc`, a CANopen device of its own.

Eight sensors, one a nozzle: 1 to 4 on the left column from top to bottom, 5 to 8 on the right. Each measures every 100 ms how far
the leaves before its nozzle are; the upper and lower ones turn with their nozzles (AIRBLAST_STATUS says how far). The controller
notices when a sensor does not hear its own pulse (Failed, and an emergency); it can't notice one that repeats an old measurement.
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.canopen_node import CANOPEN_FAULTS, CanopenNode
from firmware_py.canopy import Canopy
from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.quantity import Setting

SENSORS = 8
COLUMN = 4
MEASURE_NS = 100_000_000
START_NS = 500_000_000
"""From switching on to the first measurement."""
NOTICE_NS = 300_000_000
"""For so long no pulse is heard until the sensor counts as failed."""
HEIGHTS_M = (2.4, 1.8, 1.2, 0.6)
"""Of the nozzles of a column, from top to bottom."""
REACH_CM = 250
NO_ECHO = 255
NOISE_CM = 2.0
ECHO_PERCENT, SILENCE_PERCENT = (35.0, 75.0), (1.0, 6.0)
"""Strength of what comes back from leaves, and of the noise when there are none."""
SENSOR_FAILED = 0xFF00
"""Error code, plus the sensor's number."""
TURNING = {0: "AngleLeftUpper", 3: "AngleLeftLower", 4: "AngleRightUpper", 7: "AngleRightLower"}
"""Sensors that turn with their nozzle, by index."""


class Sensor:
    """One sensor. state: Starting, Working, Failed. distance_cm, echo_percent: its last measurement.

    dead, frozen: so many resets it stays so; None: for good; 0: it is not.
    """

    def __init__(self, start_ns: int):
        self.state = "Starting"
        self.distance_cm, self.echo_percent = NO_ECHO, 0.0
        self.dead: int | None = 0
        self.frozen: int | None = 0
        self._began_ns = start_ns
        self._lost_ns: int | None = None

    def measure(self, t_ns: int, distance_m: float | None, random: Random) -> None:
        """One measurement."""
        if self.dead != 0:
            self._lost_ns = t_ns if self._lost_ns is None else self._lost_ns
            if t_ns - self._lost_ns >= NOTICE_NS:
                self.state = "Failed"
                self.distance_cm, self.echo_percent = NO_ECHO, 0.0
            return
        self._lost_ns = None
        if t_ns - self._began_ns < START_NS:
            return
        self.state = "Working"
        noise, strength = random.gauss(0, NOISE_CM), random.random()
        if self.frozen != 0:
            return
        near = distance_m is not None and distance_m * 100 + noise <= REACH_CM
        self.distance_cm = max(0, round((distance_m or 0) * 100 + noise)) if near else NO_ECHO
        low, high = ECHO_PERCENT if near else SILENCE_PERCENT
        self.echo_percent = round(2 * (low + (high - low) * strength)) / 2

    def reset(self, t_ns: int) -> None:
        """The controller is switched on anew: what hung works again, unless it survives that."""
        self.dead = self.dead - 1 if self.dead else self.dead
        self.frozen = self.frozen - 1 if self.frozen else self.frozen
        self.state = "Starting"
        self.distance_cm, self.echo_percent = NO_ECHO, 0.0
        self._began_ns = t_ns
        self._lost_ns = None


class UltrasonicSensors(CanopenNode):
    """The node. settings: by the names of `SETTINGS`. Hears AIRBLAST_STATUS; sends US_LEFT, US_RIGHT, US_STATE."""

    DBC: ClassVar[str] = "airblast_sprayer.dbc"
    DBC_NODE: ClassVar[str] = "ULTRASONIC"
    EDS: ClassVar[str] = "ultrasonic_sensors.eds"
    NODE_ID: ClassVar[int] = 43
    HEARS: ClassVar[tuple[str, ...]] = ("AIRBLAST_STATUS",)
    SENDS: ClassVar[tuple[str, ...]] = ("US_LEFT", "US_RIGHT", "US_STATE")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("sensor", "dead", "hears nothing until a reset; `for 2 commands`: survives two", count=SENSORS, counted=True),
        Phrase("sensor", "broken", "hears nothing, and no reset helps", count=SENSORS),
        Phrase("sensor", "frozen", "repeats its last measurement until a reset", count=SENSORS, counted=True),
        Phrase("sensor", WORKS, "measures again", count=SENSORS, lasts=False),
        *CANOPEN_FAULTS,
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("speed", "km/h", 3, 0, 6, "of the vehicle past the trees"),
        Setting("tree_spacing", "m", 4, 1, 20, "from trunk to trunk"),
        Setting("tree_height", "m", 2.6, 1, 6, "mean height of the trees"),
        Setting("trees_missing", "%", 10, 0, 100, "of the places in a row"),
        Setting("row_length", "m", 60, 5, 2000, "until the vehicle turns"),
        Setting("turn", "s", 15, 0, 600, "how long it turns, without a tree before the sensors"),
        Setting("lane", "m", 1.6, 0.5, 5, "from the columns to the trunks"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        self._random = random
        self._sensors = tuple(Sensor(start_ns) for _ in range(SENSORS))
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self.canopy = Canopy(str(random.random()), speed_m_s=chosen["speed"] / 3.6, spacing_m=chosen["tree_spacing"],
                             height_m=chosen["tree_height"], row_m=chosen["row_length"], turn_s=chosen["turn"],
                             missing=chosen["trees_missing"] / 100, lane_m=chosen["lane"])
        self._angles: dict[str, float] = dict.fromkeys(TURNING.values(), 0.0)
        self._measure_ns = start_ns
        self._told = [sensor.state for sensor in self._sensors]

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All of them, 1 first."""
        return self._sensors

    @property
    def states(self) -> tuple[str, ...]:
        """What each sensor is doing."""
        return tuple(sensor.state for sensor in self._sensors)

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """How far the nozzles have turned."""
        for name in self._angles:
            self._angles[name] = float(values[name])

    def tick(self, t_ns: int) -> None:
        """One tick of 20 ms; a measurement every 100 ms."""
        if t_ns < self._measure_ns or not self.powered or self._frozen:
            return
        self._measure_ns = t_ns + MEASURE_NS
        for index, sensor in enumerate(self._sensors):
            angle = self._angles.get(TURNING.get(index, ""), 0.0)
            leaves_m = self.canopy.distance_m(t_ns / 1e9, index // COLUMN, HEIGHTS_M[index % COLUMN], angle)
            sensor.measure(t_ns, leaves_m, self._random)
            self._report(t_ns, index, sensor)

    def _report(self, t_ns: int, index: int, sensor: Sensor) -> None:
        if sensor.state == self._told[index]:
            return
        before, self._told[index] = self._told[index], sensor.state
        number = index + 1
        if sensor.state == "Failed":
            self.tell(t_ns, f"sensor {number} has failed")
            self.raise_error(SENSOR_FAILED + number, bytes([number]))
        elif sensor.state == "Working" and before == "Failed":
            self.tell(t_ns, f"sensor {number} works again")
            self.clear_error(SENSOR_FAILED + number, bytes([number]))

    def values(self, message: str) -> Mapping[str, Value]:
        """What the sensors say now."""
        if message == "US_STATE":
            return {f"Sensor{number}": sensor.state for number, sensor in enumerate(self._sensors, 1)}
        first = 0 if message == "US_LEFT" else COLUMN
        column = list(enumerate(self._sensors, 1))[first:first + COLUMN]
        return {f"{name}{number}": value for number, sensor in column
                for name, value in (("Distance", sensor.distance_cm), ("Echo", sensor.echo_percent))}

    def reboot(self, t_ns: int) -> None:
        """All sensors begin anew."""
        self._measure_ns = t_ns
        for sensor in self._sensors:
            sensor.reset(t_ns)
        self._told = ["Failed" if before == "Failed" else "Starting" for before in self._told]

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        if statement.device != "sensor":
            super().fault(now_ns, statement)
            return
        for sensor in self._sensors if statement.index is None else (self._sensors[statement.index - 1],):
            times = (statement.commands or 0) + 1
            match statement.action:
                case "dead":
                    sensor.dead = times
                case "broken":
                    sensor.dead = None
                case "frozen":
                    sensor.frozen = times
                case _:
                    sensor.dead = sensor.frozen = 0
