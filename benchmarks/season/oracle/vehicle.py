"""What faults of the tractor and its mission controller show as."""
from __future__ import annotations

from collections.abc import Mapping

from benchmarks.season.oracle.table import Row, State, symptom
from benchmarks.season.world import World

KMH = 3.6


def _movable(w: World) -> bool:
    return w.tractor.talks and w.tractor.controller in ("Ready", "Executing")


def _does_not_move(w: World, n: int) -> bool:
    tractor = w.tractor
    stands = (tractor.controller == "Executing" and tractor.drive.target_m_s * KMH > 0.55 and tractor.drive.speed_m_s * KMH < 0.08)
    return tractor.talks and (stands or tractor.reason == "NotMoving")


def _hitch_stands(w: World, n: int) -> bool:
    command = w.command("VEHICLE_HITCH_CMD")
    return (_movable(w) and command.get("HitchMove") == "Move" and w.tractor.hitch.state == "Still"
            and abs(w.tractor.hitch.position - float(command["HitchWanted"])) > 3.6)


def _implement_wrong(w: World, n: int) -> bool:
    wanted = w.command("VEHICLE_IMPLEMENT_CMD").get("ImplementWanted")
    return _movable(w) and wanted is not None and wanted != w.tractor.implement.position


def _runs(w: World) -> bool:
    return w.tractor.talks and w.tractor.engine.rpm > 750


NOT_MOVING = symptom("UnitNotMoving", 3.7, _does_not_move)
HITCH_STANDS = symptom("HitchNotMoving", 4.2, _hitch_stands)
PTO_NOT_ON = symptom("PtoNotSet", 6.9, lambda w, n: _movable(w) and w.tractor.engine.running
                      and w.command("VEHICLE_PTO_CMD").get("PtoWanted") == "On" and w.tractor.pto.state != "On")
PTO_NOT_OFF = symptom("PtoNotUnset", 7.9, lambda w, n: w.tractor.talks and w.tractor.controller != "Manual"
                       and w.command("VEHICLE_PTO_CMD").get("PtoWanted") == "Off" and w.tractor.pto.state != "Off")
IMPLEMENT_WRONG = symptom("ImplementSetUnsetFailure", 5.9, _implement_wrong)
OIL_SENSOR = symptom("OilPressureSensorFault", 3.4, lambda w, n: w.tractor.talks, remains=False)
WARNING_LAMP = symptom("EngineWarningLamp", 3.4, lambda w, n: w.tractor.talks, remains=False)
CODE = symptom("TroubleCode", 2.4, lambda w, n: w.tractor.talks, remains=False)
HOT = symptom("CoolantHot", 13.0, lambda w, n: _runs(w) and w.tractor.engine.coolant_c > 106.5)
TOO_HOT = symptom("CoolantCritical", 8.0, lambda w, n: _runs(w) and w.tractor.engine.coolant_c > 113.5)
NO_CHARGE = symptom("ChargingVoltageLow", 33.0, lambda w, n: _runs(w) and w.tractor.engine.volts < 12.34)
FLAT = symptom("BatteryLow", 33.0, lambda w, n: w.tractor.talks and w.tractor.engine.rpm < 90 and w.tractor.engine.volts < 11.2)
NO_POSITION = symptom("PositionLost", 1.0, lambda w, n: w.tractor.talks and w.tractor.fix == "NoFix")
NOBODY_KNOWS = symptom("PositionMissing", 19.0, lambda w, n: _runs(w) and w.tractor.fix == "NoFix")
INACCURATE = symptom("PositionInaccurate", 5.6, lambda w, n: w.tractor.talks and w.tractor.fix == "RtkFloat")
STOPPED = symptom("UnitStopped", 0.9, lambda w, n: w.tractor.talks and w.tractor.controller == "Stopped"
                   and w.tractor.reason == "Switch")
VEHICLE_QUIET = symptom("VehicleSilent", 1.4, lambda w, n: not w.tractor.sends)
VEHICLE_STANDS = symptom("VehicleFrozen", 2.0, lambda w, n: w.tractor.sends and not w.tractor.talks)
VEHICLE_MISCOUNTS = symptom("VehicleFrozen", 2.0, lambda w, n: w.tractor.talks, remains=False)
VEHICLE_COMMANDS_LOST = symptom("VehicleCommandsLost", 0.9, lambda w, n: w.tractor.talks
                                 and w.tractor.reason == "CommandsLost")

DISOBEYED = ("HitchNotMoving", "PtoNotSet", "PtoNotUnset", "ImplementSetUnsetFailure", "RearPtoNotEngaging")
"""A program that stands does not do what it is told meanwhile. Nor is one obeyed that stands and goes on commanding On, Set and
Move after the vehicle was taken over: it wants to hear Off, Unset and Hold first."""

TRACTOR: Mapping[str, Row] = {
    "engine dies": Row((NOT_MOVING, FLAT), (), 60.0),
    "wheels blocked": Row((NOT_MOVING,)),
    "hitch stuck": Row((HITCH_STANDS,)),
    "hitch slow": Row(),
    "implement slow": Row((IMPLEMENT_WRONG,)),
    "gnss drifts": Row(),
    "babbling": Row(),
    "wrong counter": Row((VEHICLE_MISCOUNTS,)),
    "pto refuses": Row((PTO_NOT_ON,), ("RearPtoNotEngaging",)),
    "pto stays on": Row((PTO_NOT_OFF,)),
    "implement refuses": Row((IMPLEMENT_WRONG,)),
    "oil_sensor unplugged": Row((OIL_SENSOR, WARNING_LAMP, CODE)),
    "coolant leaks": Row((HOT, TOO_HOT), (), 60.0),
    "alternator dead": Row((NO_CHARGE, FLAT), (), 60.0),
    "gnss lost": Row((NO_POSITION, NOBODY_KNOWS)),
    "gnss float": Row((INACCURATE,)),
    "stop_switch pressed": Row((STOPPED,)),
    "manual": Row(),
    "silent": Row((VEHICLE_QUIET,), ("VehicleCommandsLost",)),
    "frozen": Row((VEHICLE_STANDS,), ("VehicleCommandsLost", *DISOBEYED)),
    "reset": Row((VEHICLE_QUIET,), ("VehicleCommandsLost",)),
}
VEHICLE_MISSION: Mapping[str, Row] = {
    "silent": Row((VEHICLE_COMMANDS_LOST,)),
    "frozen": Row((VEHICLE_COMMANDS_LOST,), DISOBEYED),
    "reset": Row((VEHICLE_COMMANDS_LOST,)),
    "ignores repairs": Row(),
}

ROWS: Mapping[str, Mapping[str, Row]] = {"vehicle": TRACTOR, "vehicle_mission": VEHICLE_MISSION}
NATURAL: Mapping[str, State] = {
    "MissionFinished": lambda w: w.tractor.mission == "Finished",
    "UnitStopped": lambda w: w.tractor.controller == "Stopped",
    "UnitNotMoving": lambda w: w.tractor.reason == "NotMoving" or not w.tractor.engine.running,
    "FuelLow": lambda w: w.tractor.engine.fuel_percent < 10.5,
}
LINGERS: Mapping[str, State] = {
    "FuelLow": lambda w: w.tractor.engine.fuel_percent < 15.5,
}
