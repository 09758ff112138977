"""The vehicle: the node VEHICLE of `vehicle.dbc`, a tractor of 50 hp with its engine, drive, hitch, PTO and implement lock.

Theory of operation. Every tick of 50 ms: requests and watches → controller state → plant. The controller:

    Ready ──Start──▶ Executing ──Pause, signs of life lost, position lost──▶ Paused ──Resume──▶ Executing
    Ready ──Pause──▶ Paused ──Resume──▶ Ready     Executing ──end of the path──▶ Ready
    any but Disabled, Stopped ──someone takes the wheel──▶ Manual ──▶ Ready
    any but Disabled ──Stop, stop switch──▶ Stopped   Executing ──10 s without movement──▶ Stopped
    Stopped ──start button; Resume, if it was stopped by a request──▶ Ready

It obeys Pause and Stop at once with its brakes. New movements of hitch, PTO and implement begin in Ready and Executing only,
whatever comes over the bus: elsewhere somebody may be near. Stopped, Manual and Disabled switch PTO and implement off and hold
the hitch, an engine that stops ends the PTO, and they come back only when Off, Unset or Hold was commanded in between. Drivers
are energised once a command: a part that did not obey tries again on Retry only.

The engine, the speeds, the hitch, the PTO and the position are told as J1939 and ISO 11783 have them, too, each from the source
address of the device that says it on a real tractor; and as NMEA 0183 to `nmea`, a serial line.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from random import Random
from typing import ClassVar

from firmware_py.actuator import Actuator
from firmware_py.codec import Codec, Value
from firmware_py.drive import KMH, TOP_KMH, Drive
from firmware_py.engine import RUNS_RPM, Engine
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.field import to_degrees
from firmware_py.linkage import Hitch, Pto
from firmware_py.nmea import sentences
from firmware_py.node import BABBLING, COMMON_FAULTS, WRONG_COUNTER, Node
from firmware_py.participant import BusFrame
from firmware_py.quantity import Setting

GUIDE_TIMEOUT_NS = 500_000_000
COMMAND_TIMEOUT_NS = 1_000_000_000
"""Five cycles of the commands of PTO, hitch and implement."""
POSITION_TIMEOUT_NS = 1_000_000_000
NOT_MOVING_NS = 10_000_000_000
STOP_NS = 500_000_000
"""A stop lasts so long at least: five messages tell of it, so that nobody goes on as if there had been none."""
MOVES_M_S = 0.03
IMPLEMENT_NS = 2_000_000_000
SLOW, DRIFT_M_S = 3, 0.05
ALTITUDE_M = 650.0
ACCURACY_M = {"RtkFixed": 0.01, "RtkFloat": 0.4}
UTC_START_NS = 1_775_030_400_000_000_000
"""1 April 2026, 8:00: when a simulation begins, if nobody says otherwise."""

ISOBUS: Mapping[str, tuple[int, int]] = {
    "EEC1": (0x00, 100), "ET1": (0x00, 1000), "EFL_P1": (0x00, 500), "LFE": (0x00, 100), "VEP1": (0x00, 1000),
    "DM1_ENGINE": (0x00, 1000), "ETC2": (0x03, 100), "CCVS": (0x47, 100), "DD": (0x47, 1000), "WHEEL_SPEED": (0x47, 100),
    "GROUND_SPEED": (0x47, 100), "REAR_HITCH": (0x47, 100), "REAR_PTO": (0x47, 100), "VP": (0x1C, 100), "VDS": (0x1C, 100)}
"""Source address of the device, and its own cycle time in ms (SAE J1939-71, ISO 11783-7; position and direction at the pace of an
RTK receiver). The times in `isobus_tractor.dbc` are what a receiver must reckon with."""
OIL_BYTE, SENSOR_ERROR = 3, 0xFE
OIL_SPN, OPEN_CIRCUIT_FMI = 100, 4
"""Engine oil pressure; voltage below normal (SAE J1939-73)."""
NO_VALUE = bytes([0xFF] * 8)

LIMIT, REQUEST = "DriveSpeedLimit", "Request"
MOVABLE = ("Ready", "Executing")
HELD = ("Stopped", "Manual", "Disabled")
HARMLESS = {"PtoWanted": "Off", "ImplementWanted": "Unset", "HitchMove": "Hold"}
"""What must be commanded once after a stop before anything else counts."""
REASONS = {"Command": "on command", "Switch": "by the stop switch", "CommandsLost": "without signs of life of the mission",
           "NotMoving": "because it does not move", "PositionLost": "without a position"}


class Vehicle(Node):
    """The node. settings: by the names of `SETTINGS`, those not given are at their defaults. random: all its chance.

    controller, reason, mission: as VEHICLE_STATUS tells them. nmea: called with each sentence that its receiver says; None: no
    line is connected. utc_start_ns: UTC at time 0, for these sentences.
    """

    TICK_NS: ClassVar[int] = 50_000_000
    DBC: ClassVar[str] = "vehicle.dbc"
    MORE_DBC: ClassVar[tuple[str, ...]] = ("isobus_tractor.dbc",)
    DBC_NODE: ClassVar[str] = "VEHICLE"
    HEARS: ClassVar[tuple[str, ...]] = ("VEHICLE_CMD", "VEHICLE_GUIDE", "VEHICLE_PTO_CMD", "VEHICLE_HITCH_CMD",
                                        "VEHICLE_IMPLEMENT_CMD")
    SENDS: ClassVar[tuple[str, ...]] = ("VEHICLE_STATUS", "VEHICLE_MOTION", "VEHICLE_POSITION", "VEHICLE_PTO", "VEHICLE_HITCH",
                                        "VEHICLE_IMPLEMENT", "VEHICLE_MISSION", *ISOBUS)
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("engine", "dies", "stops and can't be started"),
        Phrase("engine", WORKS, "someone starts it again", lasts=False),
        Phrase("wheels", "blocked", "the wheels can't turn"),
        Phrase("wheels", WORKS, "turn again", lasts=False),
        Phrase("hitch", "stuck", "stays where it is", counted=True),
        Phrase("hitch", "slow", "moves at a third of its speed"),
        Phrase("hitch", WORKS, "moves again", lasts=False),
        Phrase("pto", "refuses", "its clutch does not engage", counted=True),
        Phrase("pto", "stays on", "its clutch does not let go", counted=True),
        Phrase("pto", WORKS, "engages and lets go again", lasts=False),
        Phrase("implement", "refuses", "is not set or unset", counted=True),
        Phrase("implement", "slow", "takes three times as long"),
        Phrase("implement", WORKS, "is set and unset again", lasts=False),
        Phrase("oil_sensor", "unplugged", "oil pressure reads error, DM1 says SPN 100 FMI 4"),
        Phrase("oil_sensor", WORKS, "is plugged in again", lasts=False),
        Phrase("coolant", "leaks", "a hose has burst"),
        Phrase("coolant", WORKS, "someone changes the hose and fills up", lasts=False),
        Phrase("alternator", "dead", "does not charge"),
        Phrase("alternator", WORKS, "charges again", lasts=False),
        Phrase("gnss", "lost", "no position"),
        Phrase("gnss", "float", "RTK without fixed ambiguities: some decimetres"),
        Phrase("gnss", "drifts", f"RTK fixed, says the receiver, but {100 * DRIFT_M_S:g} cm more to the east each second"),
        Phrase("gnss", WORKS, "RTK fixed again", lasts=False),
        Phrase("stop_switch", "pressed", "somebody presses it"),
        Phrase("stop_switch", WORKS, "is released; the vehicle stays stopped", lasts=False),
        Phrase("path", "loaded", "somebody brings it back to the start of its path and loads the mission anew", lasts=False),
        Phrase("start_button", "pressed", "somebody at the machine ends a stop", lasts=False),
        Phrase("", "manual", "somebody takes the wheel"),
        BABBLING,
        WRONG_COUNTER,
        *COMMON_FAULTS,
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("speed", "km/h", 3, 0.5, TOP_KMH, "in the field"),
        Setting("turn_speed", "km/h", 2, 0.5, TOP_KMH, "in the turns, of 3 m radius"),
        Setting("passes", "passes", 7, 1, 7, "how many of the field's are driven"),
        Setting("fuel", "%", 80, 0, 100, "in the tank of 60 L"),
        Setting("hitch", "%", 100, 0, 100, "position at the start, 100 % raised"),
        Setting("enabled", "", 1, 0, 1, "whether missions are possible at all"),
        Setting("nmea_rate", "Hz", 10, 1, 20, "of the sentences on the serial line"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self._cycles_ns.update({message: cycle_ms * 1_000_000 for message, (_, cycle_ms) in ISOBUS.items()})
        self._identifiers.update({message: (can_id & ~0xFF | source, True) for message, (source, _) in ISOBUS.items()
                                  if (can_id := codec.identifier(message)[0]) & 0xFF == 0xFE})
        self._dt_s = self.TICK_NS / 1e9
        self._random = random
        self.engine = Engine(self._dt_s, chosen["fuel"])
        self.drive = Drive(self._dt_s, chosen["speed"], chosen["turn_speed"], round(chosen["passes"]))
        self.hitch = Hitch(chosen["hitch"])
        self.pto = Pto()
        self.implement: Actuator[str] = Actuator("Unset", IMPLEMENT_NS, retry_ns=None)
        self._start_controller = "Ready" if chosen["enabled"] else "Disabled"
        self.controller = self._start_controller
        self.reason = "None"
        self.mission = "Loaded"
        self.fix = "RtkFixed"
        self.nmea: Callable[[bytes], object] | None = None
        self.utc_start_ns = UTC_START_NS
        self._nmea_ns = round(1e9 / chosen["nmea_rate"])
        self._nmea_due_ns = start_ns
        self._limit_kmh = TOP_KMH
        self._guided_ns = self._placed_ns = self._moved_ns = start_ns
        self._guide_counter: Value | None = None
        self._heard_as: dict[str, tuple[int, Mapping[str, Value]]] = {}
        self._released = dict.fromkeys(HARMLESS, False)
        self._unstopped_ns = start_ns
        self._paused_from = "Ready"
        self._hitch_held = True
        self._drifts_ns: int | None = None
        self._unplugged = False
        self._codes = 0
        self._pressed = False
        self._counter = 0
        self._told = self._look()

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """A request or a command."""
        if message == "VEHICLE_GUIDE":
            if values["GuideCounter"] != self._guide_counter:
                self._guided_ns = t_ns
            self._guide_counter = values["GuideCounter"]
        elif message == "VEHICLE_CMD":
            self._limit_kmh = float(values[LIMIT])
            self._request(t_ns, str(values[REQUEST]))
        else:
            before = self._heard_as.get(message)
            self._heard_as[message] = (t_ns, values)
            for signal in self._released:
                if values.get(signal) == HARMLESS[signal]:
                    self._released[signal] = True
            if values["Retry"] == "On" and (before is None or before[1]["Retry"] != "On"):
                self._retry(t_ns, message)

    def _request(self, t_ns: int, request: str) -> None:
        """Pause and Stop are always obeyed; the others where the state allows."""
        match request, self.controller:
            case "Stop", "Ready" | "Manual" | "Executing" | "Paused" | "Stopped":
                self._stop("Command")
            case "Pause", "Ready" | "Executing":
                self._pause("Command")
            case "Resume", "Paused" if self._paused_from == "Ready":
                self._ready()
            case "Resume", "Paused" if self._may_drive(t_ns):
                self._execute(t_ns)
            case "Resume", "Stopped" if self.reason == "Command" and t_ns - self._unstopped_ns >= STOP_NS:
                self._ready()
            case "Start", "Ready" if self.mission in ("Loaded", "Running") and self._may_drive(t_ns):
                self.mission = "Running"
                self._execute(t_ns)
            case _:
                pass

    def _may_drive(self, t_ns: int) -> bool:
        return self.fix != "NoFix" and t_ns - self._guided_ns < GUIDE_TIMEOUT_NS and not self._pressed

    def _execute(self, t_ns: int) -> None:
        self.controller, self.reason = "Executing", "None"
        self._moved_ns = self._placed_ns = t_ns

    def _pause(self, reason: str) -> None:
        self._paused_from = self.controller
        self.controller, self.reason = "Paused", reason

    def _stop(self, reason: str) -> None:
        if self.controller != "Stopped" or reason == "Switch":
            self.reason = reason
        self.controller = "Stopped"
        self.mission = "Aborted" if self.mission == "Running" else self.mission

    def _ready(self) -> None:
        self.controller, self.reason = "Ready", "None"
        self.mission = "Loaded" if self.mission == "Aborted" else self.mission

    def _retry(self, t_ns: int, message: str) -> None:
        """Once more, and towards what may be: on only where nobody can be near, off always."""
        may = self.controller in MOVABLE
        if message == "VEHICLE_PTO_CMD" and (may or self._pto_wanted(t_ns) == "Off"):
            self.pto.clutch.again(t_ns)
        elif message == "VEHICLE_HITCH_CMD" and may:
            self.hitch.again()
        elif message == "VEHICLE_IMPLEMENT_CMD" and may:
            self.implement.again(t_ns)

    # --- each tick --------------------------------------------------------------------------------------------------------

    def tick(self, t_ns: int) -> None:
        """One tick of 50 ms."""
        self._watch(t_ns)
        executes = self.controller == "Executing" and self.powered
        running = self.engine.running and self.engine.rpm > RUNS_RPM
        self.drive.advance(limit_kmh=self._limit_kmh if executes else 0.0, hard=self.controller == "Stopped", pulls=running)
        if not running:
            self._released["PtoWanted"] = False
            self.pto.clutch.force("Off")
        pto = self._pto_wanted(t_ns)
        self.engine.advance(executes or pto == "On")
        self._move(t_ns, pto)
        if self.drive.arrived and executes:
            self.mission = "Finished"
            self._ready()
        if self.nmea is not None and t_ns >= self._nmea_due_ns:
            self._nmea_due_ns += self._nmea_ns
            self._say(t_ns)
        seen = self._look()
        if seen != self._told:
            self._tell_changes(t_ns, seen)

    def _watch(self, t_ns: int) -> None:
        """What makes the controller pause or stop by itself."""
        if self.fix != "NoFix":
            self._placed_ns = t_ns
        if self.drive.speed_m_s > MOVES_M_S or self._limit_kmh == 0:
            self._moved_ns = t_ns
        if self._pressed and self.controller != "Disabled":
            self._stop("Switch")
        elif self.controller == "Executing":
            if t_ns - self._moved_ns >= NOT_MOVING_NS:
                self._stop("NotMoving")
            elif t_ns - self._guided_ns >= GUIDE_TIMEOUT_NS:
                self._pause("CommandsLost")
            elif t_ns - self._placed_ns >= POSITION_TIMEOUT_NS:
                self._pause("PositionLost")
        if self.controller != "Stopped":
            self._unstopped_ns = t_ns
        if self.controller in HELD:
            self._released = dict.fromkeys(self._released, False)

    def _move(self, t_ns: int, pto: str) -> None:
        """Hitch, PTO and implement. What is on stays on in a pause; what is off stays off where somebody may be near."""
        may = self.controller in MOVABLE and self.powered
        self.pto.advance(t_ns, pto, self.engine.rpm, self._dt_s)
        wanted = self._implement_wanted(t_ns)
        if may or wanted == "Unset" or self.controller in HELD:
            self.implement.advance(t_ns, wanted)
        heard = self._fresh("VEHICLE_HITCH_CMD", t_ns)
        if heard is None or heard["HitchMove"] != "Move" or not may or not self._released["HitchMove"]:
            self.hitch.advance(None, self._dt_s)
            self._hitch_held = True
        else:
            target = float(heard["HitchWanted"])
            if self._hitch_held and target == self.hitch.target:
                self.hitch.resume(target)
            self._hitch_held = False
            self.hitch.advance(target, self._dt_s)

    def _fresh(self, message: str, t_ns: int) -> Mapping[str, Value] | None:
        heard = self._heard_as.get(message)
        return heard[1] if heard is not None and t_ns - heard[0] < COMMAND_TIMEOUT_NS else None

    def _pto_wanted(self, t_ns: int) -> str:
        """What counts as commanded: On only where it may begin, or goes on in a pause."""
        heard = self._fresh("VEHICLE_PTO_CMD", t_ns)
        on = heard is not None and heard["PtoWanted"] == "On" and self._released["PtoWanted"] and self.powered
        may = self.controller in MOVABLE or self.controller == "Paused" and self.pto.clutch.position == "On"
        return "On" if on and may else "Off"

    def _implement_wanted(self, t_ns: int) -> str:
        heard = self._heard_as.get("VEHICLE_IMPLEMENT_CMD")
        set_ = heard is not None and heard[1]["ImplementWanted"] == "Set" and self._released["ImplementWanted"]
        return "Set" if set_ and self.controller not in HELD else "Unset"

    def _say(self, t_ns: int) -> None:
        """The receiver's sentences of one moment."""
        assert self.nmea is not None
        latitude, longitude = self._place()
        for sentence in sentences(self.utc_start_ns + t_ns, latitude, longitude, self.drive.pose.heading_deg,
                                  self.drive.speed_m_s * KMH, self.fix, ALTITUDE_M):
            self.nmea(sentence)

    def _place(self) -> tuple[float, float]:
        drift_m = 0.0 if self._drifts_ns is None else DRIFT_M_S * (self._now_ns - self._drifts_ns) / 1e9
        return to_degrees(self.drive.pose.x_m + drift_m, self.drive.pose.y_m)

    # --- what it says -----------------------------------------------------------------------------------------------------

    def step(self, now_ns: int) -> list[BusFrame]:
        """Frames of J1939 carry the source address of their device, and its reserved values where it knows nothing."""
        frames = super().step(now_ns)
        return [self._as_sent(frame) for frame in frames] if self._unplugged or self.fix == "NoFix" else frames

    def _as_sent(self, frame: BusFrame) -> BusFrame:
        can_id, extended, data = frame
        if not extended:
            lost = self.fix == "NoFix" and can_id == _POSITION_ID
            return frame._replace(data=NO_VALUE) if lost else frame
        pgn = can_id >> 8 & 0xFFFF
        if pgn == _VP_PGN and self.fix == "NoFix":
            data = NO_VALUE
        elif pgn == _VDS_PGN and self.fix == "NoFix":
            data = NO_VALUE[:4] + data[4:]
        elif pgn == _EFL_PGN and self._unplugged:
            data = data[:OIL_BYTE] + bytes([SENSOR_ERROR]) + data[OIL_BYTE + 1:]
        return BusFrame(can_id, extended, data)

    def values(self, message: str) -> Mapping[str, Value]:
        """What the sensors say now."""
        match message:
            case "VEHICLE_STATUS":
                self._counter = self.count(self._counter)
                return {"Controller": self.controller, "StopReason": self.reason, "MissionState": self.mission,
                        "EngineState": "Running" if self.engine.running and self.engine.rpm > RUNS_RPM else "Off",
                        "PathPart": "Turn" if self.drive.pose.turning else "Straight",
                        "DriveSpeedLimitSet": round(self._limit_kmh, 1), "VehicleCounter": self._counter}
            case "VEHICLE_MOTION":
                return {"DriveSpeed": round(self.drive.speed_m_s * KMH, 2), "TargetSpeed": round(self.drive.target_m_s * KMH, 2),
                        "DriveHeading": round(self.drive.pose.heading_deg, 2) % 360, "PositionFix": self.fix,
                        "PositionAccuracy": ACCURACY_M.get(self.fix, 2.5)}
            case "VEHICLE_POSITION":
                latitude, longitude = self._place()
                return {"PositionLatitude": latitude, "PositionLongitude": longitude}
            case "VEHICLE_PTO":
                return {"PtoState": self.pto.state, "PtoCommanded": self._pto_wanted(self._now_ns),
                        "PtoSpeed": round(self.pto.rpm * 8) / 8}
            case "VEHICLE_HITCH":
                return {"HitchPosition": round(self.hitch.position * 2) / 2, "HitchTarget": round(self.hitch.target * 2) / 2,
                        "HitchState": self.hitch.state}
            case "VEHICLE_IMPLEMENT":
                return {"ImplementState": self._implement_state, "ImplementCommanded": self._implement_wanted(self._now_ns)}
            case "VEHICLE_MISSION":
                return {"MissionProgress": round(200 * self.drive.driven_m / self.drive.length_m) / 2,
                        "MissionDriven": round(self.drive.driven_m, 1), "MissionLength": round(self.drive.length_m, 1),
                        "MissionPass": self.drive.passage}
            case _:
                return self._isobus(message)

    def _isobus(self, message: str) -> Mapping[str, Value]:
        """The same as SAE J1939 and ISO 11783 have it."""
        engine, drive = self.engine, self.drive
        speed_m_s, driven_m = round(drive.speed_m_s, 3), round(drive.driven_m, 3)
        match message:
            case "EEC1":
                load = 20 + 40 * (drive.speed_m_s > 0) + 20 * (self.pto.state == "On") if engine.running else 0
                return {"EngineTorque": load, "EngineSpeed": round(engine.rpm * 8) / 8}
            case "ET1":
                return {"CoolantTemperature": round(engine.coolant_c), "FuelTemperature": 30,
                        "EngineOilTemperature": round(engine.coolant_c + 5)}
            case "EFL_P1":
                return {"EngineOilPressure": round(engine.oil_kpa / 4) * 4}
            case "LFE":
                return {"FuelRate": round(engine.fuel_rate_l_h * 20) / 20}
            case "VEP1":
                volts = round(engine.volts * 20) / 20
                return {"BatteryVoltage": volts, "KeySwitchVoltage": volts}
            case "DM1_ENGINE":
                return self._trouble()
            case "ETC2":
                gear = 1 if drive.target_m_s else 0
                return {"SelectedGear": gear, "GearRatio": 45.0, "CurrentGear": gear}
            case "CCVS":
                return {"VehicleSpeed": round(drive.speed_m_s * KMH * 256) / 256}
            case "DD":
                return {"FuelLevel": round(engine.fuel_percent / 0.4) * 0.4}
            case "WHEEL_SPEED":
                return {"WheelSpeed": speed_m_s, "WheelDistance": driven_m, "TractorPowerTime": 0, "WheelDirection": "Forward",
                        "KeySwitch": "KeyNotOff", "ImplementStartStop": "StartOperations", "OperatorDirection": "NotReversed"}
            case "GROUND_SPEED":
                return {"GroundSpeed": speed_m_s, "GroundDistance": driven_m, "GroundDirection": "Forward"}
            case "REAR_HITCH":
                in_work = "InWork" if self.hitch.position < 50 else "OutOfWork"
                return {"RearHitchPosition": round(self.hitch.position / 0.4) * 0.4, "RearHitchLimit": "NotLimited",
                        "RearHitchInWork": in_work, "RearLinkForce": 0, "RearDraft": 0, "RearHitchExit": "AllClear"}
            case "REAR_PTO":
                engaged = self.pto.clutch.position == "On"
                return {"RearPtoSpeed": round(self.pto.rpm * 8) / 8, "RearPtoSetPoint": 540,
                        "RearPtoEngageRequest": "Engage" if self._pto_wanted(self._now_ns) == "On" else "Disengage",
                        "RearPtoEconomy": "Off", "RearPtoMode": "Pto540", "RearPtoEngaged": "Engaged" if engaged else "Disengaged",
                        "RearPtoLimit": "NotLimited", "RearPtoEconomyRequest": "Off", "RearPtoModeRequest": "Pto540",
                        "RearPtoExit": "AllClear"}
            case "VP":
                latitude, longitude = self._place()
                return {"Latitude": latitude, "Longitude": longitude}
            case _:
                return {"Heading": drive.pose.heading_deg, "NavigationSpeed": round(drive.speed_m_s * KMH * 256) / 256,
                        "Pitch": 0.0, "Altitude": ALTITUDE_M}

    def _trouble(self) -> Mapping[str, Value]:
        """Active trouble codes of the engine: that of the oil sensor, or none."""
        active = self._unplugged
        return {"EngineProtectLamp": "Off", "EngineAmberLamp": "On" if active else "Off", "EngineRedLamp": "Off",
                "EngineMalfunctionLamp": "Off", "EngineSpnLow": OIL_SPN if active else 0,
                "EngineFmi": OPEN_CIRCUIT_FMI if active else 0, "EngineSpnHigh": 0,
                "EngineOccurrence": self._codes if active else 0}

    @property
    def _now_ns(self) -> int:
        """The tick that was computed last."""
        return self._next_tick_ns - self.TICK_NS

    @property
    def _implement_state(self) -> str:
        wanted = self._implement_wanted(self._now_ns)
        return self.implement.position if wanted == self.implement.position else "Setting" if wanted == "Set" else "Unsetting"

    def restart(self, t_ns: int) -> None:
        """The controller begins anew; engine, hitch and place are as they were, PTO and implement are off."""
        self.controller, self.reason = self._start_controller, "None"
        self.mission = "Loaded" if self.mission in ("Running", "Aborted") else self.mission
        self._heard_as.clear()
        self._released = dict.fromkeys(self._released, False)
        self._limit_kmh = TOP_KMH
        self._counter = 0

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        match statement.device, statement.action:
            case "engine", action:
                self.engine.die() if action == "dies" else self.engine.start()
            case "wheels", action:
                self.drive.blocked = action == "blocked"
            case "hitch", "slow":
                self.hitch.part = 1 / SLOW
            case "hitch", action:
                self.hitch.part = 1.0
                self.hitch.release() if action == WORKS else self.hitch.jam(statement.commands)
            case "pto", action:
                refused = {"refuses": ("On",), "stays on": ("Off",)}.get(action)
                self.pto.mend(now_ns) if refused is None else self.pto.clutch.jam(refused, statement.commands)
            case "implement", "slow":
                self.implement.response_ns = SLOW * IMPLEMENT_NS
            case "implement", action:
                self.implement.response_ns = IMPLEMENT_NS
                self.implement.release() if action == WORKS else self.implement.jam(None, statement.commands)
            case "oil_sensor", action:
                self._unplugged = action == "unplugged"
                self._codes += self._unplugged
            case "coolant", action:
                self.engine.leaks = True
                if action == WORKS:
                    self.engine.fill_coolant()
            case "alternator", action:
                self.engine.alternator = action == WORKS
            case "gnss", action:
                self._drifts_ns = now_ns if action == "drifts" else None
                self.fix = {"lost": "NoFix", "float": "RtkFloat"}.get(action, "RtkFixed")
            case "stop_switch", action:
                self._pressed = action == "pressed"
            case "path", _:
                self.drive.fetch()
                self.mission = "Loaded"
            case "start_button", "pressed":
                if self.controller == "Stopped" and not self._pressed and now_ns - self._unstopped_ns >= STOP_NS:
                    self._ready()
            case "", "manual":
                if self.controller not in ("Disabled", "Stopped"):
                    self.controller, self.reason = "Manual", "None"
            case _:
                super().fault(now_ns, statement)

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` without a device also gives the wheel back."""
        super().inject(now_ns, statement)
        if statement == Statement("", None, WORKS) and self.controller == "Manual":
            self._ready()

    # --- story ------------------------------------------------------------------------------------------------------------

    def _look(self) -> tuple[object, ...]:
        """What a bystander sees; in the order of `_tell_changes`."""
        moves = self.drive.speed_m_s > 0
        return (self.controller, self.reason, self.mission, moves, self.drive.pose.turning, self.pto.state,
                self.implement.position, self.hitch.state, self.engine.running)

    def _tell_changes(self, t_ns: int, seen: tuple[object, ...]) -> None:
        controller, reason, mission, moves, turning, pto, implement, hitch, engine = zip(self._told, seen, strict=True)
        self._told = seen
        if controller[0] != controller[1] or reason[0] != reason[1]:
            self.tell(t_ns, f"{str(controller[1]).lower()} {REASONS.get(str(reason[1]), '')}".strip())
        if mission[0] != mission[1] and mission[1] == "Finished":
            self.tell(t_ns, "mission finished")
        if moves[0] and not moves[1]:
            self.tell(t_ns, f"stands after {self.drive.driven_m:.2f} m")
        if turning[0] != turning[1]:
            self.tell(t_ns, "turns" if turning[1] else f"pass {self.drive.passage}")
        if pto[0] != pto[1]:
            self.tell(t_ns, f"PTO {_PTO_WORDS[str(pto[1])]}")
        if implement[0] != implement[1]:
            self.tell(t_ns, f"implement {str(implement[1]).lower()}")
        if hitch[0] != hitch[1]:
            self.tell(t_ns, f"hitch stands at {self.hitch.position:g} %" if hitch[1] == "Still" else f"hitch is {hitch[1]}".lower())
        if engine[0] != engine[1]:
            self.tell(t_ns, "engine runs" if engine[1] else "engine off")


_PTO_WORDS = {"RunningUp": "runs up", "On": "on", "RunningDown": "runs down", "Off": "off"}
_POSITION_ID = 514
_VP_PGN, _VDS_PGN, _EFL_PGN = 65267, 65256, 65263
