"""What a fault must be reported as, what it may bring about, and what needs no fault at all: a table, from the physics alone.

Theory of operation. A *symptom* is a state of the machine that an alarm stands for, as the plants and programs of the nodes know it
(`World`), not as the bus tells it. When a fault is active and one of its symptoms has lasted for the alarm's delay and the time its
message takes, the alarm must be there. A symptom that never lasts so long makes the fault unobservable: a valve that is stuck
closed while nobody wants it open. *May* names what the fault can bring about besides, at once or up to `tail_s` after its end: a
vehicle without signs of life pauses, a repair that a second fault disturbs fails. An alarm that no active or recent fault explains
so, and that is not true without one (`NATURAL`), is a false one; what an earlier fault has left behind still explains it as long as
its symptom can be seen: a valve that did not obey stands wrong until it is told once more.

Times are on-delays of the definitions plus what the messages need: a cycle, and one of level 1's looks at silence.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from benchmarks.season.world import World

Truth = Callable[[World, int], bool]
"""Whether it is so; the number is that of the device (`valve[7]`: 7), 0 for what there is only one of."""
TAIL_S = 30.0


@dataclass(frozen=True)
class Symptom:
    """After `within_s` of this one of the alarms must be there. `{n}` stands for the device's number.

    remains: the truth is a state of the machine, which may outlast the fault. Else it only tells whether the fault can be seen
    while it lasts: one that has ended explains nothing any more, although the machine talks on.
    """

    alarms: tuple[str, ...]
    within_s: float
    truth: Truth
    remains: bool = True


@dataclass(frozen=True)
class Row:
    """What is known of a fault. sums: alarms that sum up its symptoms, as long as one of them can be seen."""

    symptoms: tuple[Symptom, ...] = ()
    may: tuple[str, ...] = ()
    tail_s: float = TAIL_S
    sums: tuple[str, ...] = ()


def _symptom(alarms: str, within_s: float, truth: Truth, *, remains: bool = True) -> Symptom:
    return Symptom(tuple(alarms.split()), within_s, truth, remains)


# --- flaming tool -----------------------------------------------------------------------------------------------------------


def _wanted(w: World) -> bool:
    return w.command("FLAMER_CMD").get("Flaming") == "On"


def _unlit(w: World, n: int) -> bool:
    tool = w.flamer
    return (tool.talks and _wanted(w) and not tool.works and not tool.sees_flame
            and tool.safeguard.state in ("Ignition", "IgnitionFailed"))


def _wrong_burner(w: World, n: int) -> bool:
    tool, command = w.flamer, w.command("FLAMER_CMD")
    wanted = tuple(command.get(f"Burner{number}") for number in range(1, 5))
    if tool.works and tool.safeguard.state == "Running":
        return tool.talks and tool.sees_flame and bool(command) and wanted != tool.burner_positions
    return tool.talks and any(position != "Off" for position in tool.burner_positions)


def _wrong_mode(w: World, n: int) -> bool:
    tool, command = w.flamer, w.command("FLAMER_CMD")
    wanted = command.get("Flaming")
    return tool.talks and bool(command) and (wanted == "On") != tool.works and (tool.sees_flame or wanted == "Off")


FLAME_OUT = _symptom("PilotFlameOut", 0.9, lambda w, n: w.flamer.talks and w.flamer.works and _wanted(w)
                     and not w.flamer.sees_flame)
UNLIT = _symptom("PilotIgnitionFailure PilotFlameOut", 5.4, _unlit)
VALVE_NOT_OPEN = _symptom("GasValveNotOpened", 1.0, lambda w, n: w.flamer.talks and w.flamer.safeguard.valve == "Open"
                          and w.flamer.valve == "Closed")
VALVE_NOT_CLOSED = _symptom("GasValveNotClosed", 1.5, lambda w, n: w.flamer.talks and w.flamer.safeguard.valve == "Closed"
                            and w.flamer.valve == "Open")
LEAK = _symptom("GasValveLeaks", 2.7, lambda w, n: w.flamer.talks and w.flamer.valve == "Closed" and w.flamer.plant.line_bar > 0.25)
FALSE_FLAME = _symptom("FlameWithValveClosed", 2.6, lambda w, n: w.flamer.talks and w.flamer.valve == "Closed"
                       and w.flamer.sees_flame)
WRONG_BURNER = _symptom("ChangeBurnersFailure", 2.7, _wrong_burner)
WRONG_MODE = _symptom("FlamingStartStopFailure", 3.6, _wrong_mode)
BOTTLE_EMPTY = _symptom("BottleEmpty", 4.5, lambda w, n: w.flamer.talks and w.flamer.plant.bottle.bar < 0.7)
BOTTLE_LOW = _symptom("BottleLow", 12.0, lambda w, n: w.flamer.talks and w.flamer.plant.bottle.level_percent < 14)
GAS_COMMANDS_LOST = _symptom("FlamerCommandsLost", 0.6, lambda w, n: w.flamer.talks
                             and w.flamer.safeguard.state == "CommandsLost")
FLAMER_QUIET = _symptom("FlamerSilent", 1.4, lambda w, n: not w.flamer.sends)
TOLD_EMPTY = _symptom("BottleEmpty", 4.5, lambda w, n: w.flamer.talks and w.flamer.plant.bottle.bar * w.flamer.bottle_told < 0.7)
TOLD_LOW = _symptom("BottleLow", 12.0, lambda w, n: w.flamer.talks
                    and w.flamer.plant.bottle.level_percent * w.flamer.bottle_told < 14)
FLAMER_MISCOUNTS = _symptom("FlamerFrozen", 2.0, lambda w, n: w.flamer.talks, remains=False)
FLAMER_STANDS = _symptom("FlamerFrozen", 2.0, lambda w, n: w.flamer.sends and not w.flamer.talks)

OUT = ("PilotFlameOut", "PilotFlameTooOften")
NOT_CONFIRMED = ("FlamingStartStopFailure", "ChangeBurnersFailure")
"""A program that stands does not say that it did what it was told meanwhile: whoever orders flaming off never sees it off."""
GAS_TAIL_S = 60.0
"""A repair purges for 30 s before it tries; what it finds then is a consequence, too."""

FLAMER: Mapping[str, Row] = {
    "pilot blown out": Row((FLAME_OUT,), OUT),
    "wind gust": Row((FLAME_OUT,), OUT),
    "igniter dead": Row((UNLIT,), OUT, GAS_TAIL_S),
    "gas_valve stuck closed": Row((VALVE_NOT_OPEN,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "gas_valve stuck open": Row((VALVE_NOT_CLOSED,), (), GAS_TAIL_S),
    "gas_valve leaks": Row((LEAK, FALSE_FLAME), (), GAS_TAIL_S),
    "burner stuck": Row((WRONG_BURNER,)),
    "burner stuck off": Row((WRONG_BURNER,)),
    "burner stuck low": Row((WRONG_BURNER,)),
    "burner stuck high": Row((WRONG_BURNER,)),
    "burner slow": Row((WRONG_BURNER,)),
    "bottle_sensor drifts down": Row((TOLD_EMPTY, TOLD_LOW)),
    "babbling": Row(),
    "wrong counter": Row((FLAMER_MISCOUNTS,)),
    "refuses start": Row((WRONG_MODE,)),
    "refuses stop": Row((WRONG_MODE,)),
    "bottle empty": Row((BOTTLE_EMPTY, BOTTLE_LOW), (*OUT, "PilotIgnitionFailure"), 2 * GAS_TAIL_S),
    "flame_sensor stuck on": Row((FALSE_FLAME,), ("FlamingStartStopFailure", *OUT), GAS_TAIL_S),
    "flame_sensor stuck off": Row((FLAME_OUT, UNLIT), OUT, GAS_TAIL_S),
    "silent": Row((FLAMER_QUIET,), OUT),
    "frozen": Row((FLAMER_STANDS,), ("FlamerCommandsLost", "PilotIgnitionFailure", *OUT, *NOT_CONFIRMED), GAS_TAIL_S),
    "reset": Row((FLAMER_QUIET,), ("FlamerCommandsLost", *OUT), GAS_TAIL_S),
}
FLAMER_MISSION: Mapping[str, Row] = {
    "silent": Row((GAS_COMMANDS_LOST,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "frozen": Row((GAS_COMMANDS_LOST,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "reset": Row((GAS_COMMANDS_LOST,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "ignores repairs": Row((), (), GAS_TAIL_S),
}

# --- sprayer boom -----------------------------------------------------------------------------------------------------------


def _obeys(w: World) -> bool:
    """What a status with a wrong counter or checksum says counts for nothing: SprayerDataCorrupt tells that."""
    return w.sprayer.is_believed and w.sprayer.control == "Remote"


def _share(w: World) -> float:
    return sum(w.sprayer.sections_open) / 12 if w.sprayer.spraying else 0.0


def _wrong_section(w: World, n: int) -> bool:
    wanted = w.command("SPRAYER_NOZZLES_CMD").get(f"Valve{n}Wanted")
    sprays = w.sprayer.spraying and w.command("SPRAYER_CMD").get("SprayingWanted") == "On"
    return _obeys(w) and sprays and wanted is not None and (wanted == "On") != w.sprayer.sections_open[n - 1]


def _wrong_spraying(w: World, n: int) -> bool:
    wanted = w.command("SPRAYER_CMD").get("SprayingWanted")
    return (_obeys(w) and wanted is not None and (wanted == "On") != w.sprayer.spraying
            and (w.sprayer.boom.state == "Open" or wanted == "Off"))


def _wrong_main_flow(w: World, n: int) -> bool:
    target = w.sprayer.set_points[0] * _share(w)
    return (w.sprayer.is_believed and w.sprayer.spraying and w.sprayer.plant.tank.level_l(w.now_ns) >= 12
            and abs(w.sprayer.plant.water.flow_l_min - target) > 0.4 + 0.2 * target)


def _wrong_dis_flow(w: World, n: int) -> bool:
    line, target = w.sprayer.plant.herbicide, w.sprayer.set_points[1] * _share(w)
    return (_obeys(w) and w.sprayer.plant.dis_l >= 0.55 and line.bar < 4.8
            and abs(line.flow_ml_min - target) > 7 + 0.2 * target)


def _not_taken(message: str, signal: str, place: int) -> Truth:
    def truth(w: World, n: int) -> bool:
        wanted = w.command(message).get(signal)
        return _obeys(w) and wanted is not None and wanted != w.sprayer.set_points[place] and w.sprayer.plant.dis_l >= 0.55
    return truth


def _boom(*wrong: tuple[str, str]) -> Truth:
    def truth(w: World, n: int) -> bool:
        wanted = w.command("SPRAYER_BOOM_CMD").get("BoomWanted")
        return _obeys(w) and not w.sprayer.spraying and (wanted, w.sprayer.boom.state) in wrong
    return truth


def tank_differs_l(w: World) -> float:
    """Between what level sensor and flow meter say."""
    tank = w.sprayer.plant.tank
    return abs(tank.filled_l - tank.used_l - tank.level_l(w.now_ns))


WRONG_SECTION = _symptom("Section{n}NotSet", 3.6, _wrong_section)
STAYS_OPEN = _symptom("SectionStaysOpen", 3.6, lambda w, n: w.sprayer.is_believed and n in w.sprayer.locked
                      and w.sprayer.sections_open[n - 1])
WRONG_SPRAYING = _symptom("SprayingStartStopFailure", 3.6, _wrong_spraying)
MAIN_NOT_TAKEN = _symptom("SetMainFlowFailure", 2.7, _not_taken("SPRAYER_MAIN_CMD", "MainFlowWanted", 0))
DIS_NOT_TAKEN = _symptom("SetDisFlowFailure", 4.7, _not_taken("SPRAYER_DIS_CMD", "DisFlowWanted", 1))
WRONG_MAIN_FLOW = _symptom("MainFlowNotAdjusted", 7.7, _wrong_main_flow)
WRONG_DIS_FLOW = _symptom("SetDisFlowFailure", 4.8, _wrong_dis_flow)
LINE_BLOCKED = _symptom("HerbicideLineBlocked", 2.8, lambda w, n: w.sprayer.is_believed and w.sprayer.spraying
                        and w.sprayer.plant.herbicide.bar > 6.2)
BOOM_BETWEEN = _symptom("BoomOpeningNotAdjusted", 18.7, _boom(("Open", "Opening"), ("Open", "Stopped"), ("Close", "Closing"),
                                                              ("Close", "Stopped")))
BOOM_STANDS = _symptom("OpenCloseBoomFailure", 3.7, _boom(("Open", "Closed"), ("Open", "Closing"), ("Close", "Open"),
                                                          ("Close", "Opening")))
TANK_DIFFERS = _symptom("MainTankMismatch", 12.0, lambda w, n: w.sprayer.talks and tank_differs_l(w) > 13.1)
TANK_CRITICAL = _symptom("MainTankCritical", 7.0, lambda w, n: w.sprayer.talks and w.sprayer.plant.tank.level_l(w.now_ns) < 9.5)
DIS_CRITICAL = _symptom("DisTankCritical", 7.0, lambda w, n: w.sprayer.talks and w.sprayer.plant.dis_l < 0.45)
SPRAYER_QUIET = _symptom("SprayerSilent", 1.4, lambda w, n: not w.sprayer.sends)
SPRAYER_STANDS = _symptom("SprayerFrozen", 2.0, lambda w, n: w.sprayer.sends and not w.sprayer.talks)
SPRAYER_GARBLED = _symptom("SprayerDataCorrupt", 1.0, lambda w, n: w.sprayer.talks, remains=False)
SPRAYER_COMMANDS_LOST = _symptom("SprayerCommandsLost", 0.9, lambda w, n: w.sprayer.is_believed
                                 and w.sprayer.control == "CommandsLost")
SECTIONS = ("ChangeNozzlesFailure",)
LINES = ("MainFlowNotAdjusted", "SetDisFlowFailure")

SPRAYER: Mapping[str, Row] = {
    "valve stuck closed": Row((WRONG_SECTION,), sums=SECTIONS),
    "valve stuck open": Row((WRONG_SECTION, STAYS_OPEN), ("SprayingStartStopFailure",), sums=SECTIONS),
    "valve slow": Row((WRONG_SECTION,), ("SectionStaysOpen",), sums=SECTIONS),
    "refuses start": Row((WRONG_SPRAYING,)),
    "refuses stop": Row((WRONG_SPRAYING,), ("OpenCloseBoomFailure", "BoomOpeningNotAdjusted")),
    "main_flow refuses": Row((MAIN_NOT_TAKEN,), LINES),
    "dis_flow refuses": Row((DIS_NOT_TAKEN,), LINES),
    "regulator stuck": Row((WRONG_MAIN_FLOW,), LINES),
    "pump weak": Row((WRONG_MAIN_FLOW,), LINES),
    "dis_pump weak": Row((WRONG_DIS_FLOW,)),
    "line blocked": Row((LINE_BLOCKED,), ("SetDisFlowFailure",)),
    "boom blocked": Row((BOOM_BETWEEN, BOOM_STANDS), ("BoomMoving",)),
    "boom refuses": Row((BOOM_BETWEEN, BOOM_STANDS), ("BoomMoving",)),
    "boom slow": Row((BOOM_BETWEEN,), ("BoomMoving",), 60.0),
    "main_tank leaks": Row((TANK_DIFFERS, TANK_CRITICAL), LINES, 120.0),
    "main_tank empty": Row((TANK_DIFFERS, TANK_CRITICAL), LINES, 120.0),
    "dis_tank empty": Row((DIS_CRITICAL,), ("SetDisFlowFailure",), 120.0),
    "level_sensor drifts up": Row((TANK_DIFFERS,), LINES, 120.0),
    "level_sensor drifts down": Row((TANK_DIFFERS, TANK_CRITICAL), LINES, 120.0),
    "manual": Row((), ("SprayerCommandsLost",)),
    "wrong counter": Row((SPRAYER_GARBLED,), ("SprayerFrozen",)),
    "wrong checksum": Row((SPRAYER_GARBLED,)),
    "babbling": Row((SPRAYER_STANDS,), ("SprayerCommandsLost", "SprayerDataCorrupt", "SprayingStartStopFailure")),
    "silent": Row((SPRAYER_QUIET,), ("SprayerFrozen", "SprayerDataCorrupt")),
    "frozen": Row((SPRAYER_STANDS,), ("SprayerCommandsLost", "SprayerDataCorrupt", "SprayingStartStopFailure")),
    "reset": Row((SPRAYER_QUIET,), ("SprayerCommandsLost", "SprayerDataCorrupt", "SprayingStartStopFailure", "SprayerFrozen")),
}
SPRAYER_MISSION: Mapping[str, Row] = {
    "silent": Row((SPRAYER_COMMANDS_LOST,)),
    "frozen": Row((SPRAYER_COMMANDS_LOST,)),
    "reset": Row((SPRAYER_COMMANDS_LOST,)),
    "ignores repairs": Row(),
}

# --- vehicle ----------------------------------------------------------------------------------------------------------------

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


NOT_MOVING = _symptom("UnitNotMoving", 3.7, _does_not_move)
HITCH_STANDS = _symptom("HitchNotMoving", 4.2, _hitch_stands)
PTO_NOT_ON = _symptom("PtoNotSet", 6.9, lambda w, n: _movable(w) and w.tractor.engine.running
                      and w.command("VEHICLE_PTO_CMD").get("PtoWanted") == "On" and w.tractor.pto.state != "On")
PTO_NOT_OFF = _symptom("PtoNotUnset", 7.9, lambda w, n: w.tractor.talks and w.tractor.controller != "Manual"
                       and w.command("VEHICLE_PTO_CMD").get("PtoWanted") == "Off" and w.tractor.pto.state != "Off")
IMPLEMENT_WRONG = _symptom("ImplementSetUnsetFailure", 5.9, _implement_wrong)
OIL_SENSOR = _symptom("OilPressureSensorFault", 3.4, lambda w, n: w.tractor.talks, remains=False)
WARNING_LAMP = _symptom("EngineWarningLamp", 3.4, lambda w, n: w.tractor.talks, remains=False)
CODE = _symptom("TroubleCode", 2.4, lambda w, n: w.tractor.talks, remains=False)
HOT = _symptom("CoolantHot", 13.0, lambda w, n: _runs(w) and w.tractor.engine.coolant_c > 106.5)
TOO_HOT = _symptom("CoolantCritical", 8.0, lambda w, n: _runs(w) and w.tractor.engine.coolant_c > 113.5)
NO_CHARGE = _symptom("ChargingVoltageLow", 33.0, lambda w, n: _runs(w) and w.tractor.engine.volts < 12.34)
FLAT = _symptom("BatteryLow", 33.0, lambda w, n: w.tractor.talks and w.tractor.engine.rpm < 90 and w.tractor.engine.volts < 11.2)
NO_POSITION = _symptom("PositionLost", 1.0, lambda w, n: w.tractor.talks and w.tractor.fix == "NoFix")
NOBODY_KNOWS = _symptom("PositionMissing", 19.0, lambda w, n: _runs(w) and w.tractor.fix == "NoFix")
INACCURATE = _symptom("PositionInaccurate", 5.6, lambda w, n: w.tractor.talks and w.tractor.fix == "RtkFloat")
STOPPED = _symptom("UnitStopped", 0.9, lambda w, n: w.tractor.talks and w.tractor.controller == "Stopped"
                   and w.tractor.reason == "Switch")
VEHICLE_QUIET = _symptom("VehicleSilent", 1.4, lambda w, n: not w.tractor.sends)
VEHICLE_STANDS = _symptom("VehicleFrozen", 2.0, lambda w, n: w.tractor.sends and not w.tractor.talks)
VEHICLE_MISCOUNTS = _symptom("VehicleFrozen", 2.0, lambda w, n: w.tractor.talks, remains=False)
VEHICLE_COMMANDS_LOST = _symptom("VehicleCommandsLost", 0.9, lambda w, n: w.tractor.talks
                                 and w.tractor.reason == "CommandsLost")

DISOBEYED = ("HitchNotMoving", "PtoNotSet", "PtoNotUnset", "ImplementSetUnsetFailure", "RearPtoNotEngaging")
"""A program that stands does not do what it is told meanwhile."""

TRACTOR: Mapping[str, Row] = {
    "engine dies": Row((NOT_MOVING, FLAT), (), 60.0),
    "wheels blocked": Row((NOT_MOVING,)),
    "hitch stuck": Row((HITCH_STANDS,)),
    "hitch slow": Row(),
    "implement slow": Row((IMPLEMENT_WRONG,)),
    "gnss drifts": Row(),
    "babbling": Row(),
    "wrong counter": Row((VEHICLE_MISCOUNTS,), DISOBEYED),
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
    "frozen": Row((VEHICLE_COMMANDS_LOST,)),
    "reset": Row((VEHICLE_COMMANDS_LOST,)),
    "ignores repairs": Row(),
}

# --- air-blast sprayer ------------------------------------------------------------------------------------------------------

OPERATIONAL, STOPPED_STATE = 5, 4


def _tells(w: World) -> bool:
    return w.airblast.talks and w.airblast.nmt_state == OPERATIONAL


def _vouches(w: World) -> bool:
    """What a status with a wrong counter says counts for nothing: AirblastFrozen tells that."""
    return _tells(w) and w.airblast.is_believed


def _wrong_airblast(w: World, n: int) -> bool:
    wanted = w.command("AIRBLAST_CMD").get("AirblastWanted")
    return (_vouches(w) and wanted is not None and (wanted == "On") != w.airblast.works
            and w.airblast.state not in ("TankEmpty", "CommandsLost"))


def _airblast_told_percent(w: World) -> float:
    return w.airblast.plant.level_percent - w.airblast.drift_percent


AIRBLAST_EMPTY = _symptom("AirblastTankCritical", 5.0, lambda w, n: _tells(w) and w.airblast.plant.level_percent < 4)
AIRBLAST_LOW = _symptom("AirblastTankLow", 12.0, lambda w, n: _tells(w) and w.airblast.plant.level_percent < 14)
AIRBLAST_TOLD_EMPTY = _symptom("AirblastTankCritical", 5.0, lambda w, n: _tells(w) and _airblast_told_percent(w) < 4)
AIRBLAST_TOLD_LOW = _symptom("AirblastTankLow", 12.0, lambda w, n: _tells(w) and _airblast_told_percent(w) < 14)
AIRBLAST_MISCOUNTS = _symptom("AirblastFrozen", 2.2, lambda w, n: _tells(w), remains=False)
NO_FLOW = _symptom("NoMainFlow", 3.6, lambda w, n: _vouches(w) and w.airblast.works and _airblast_told_percent(w) >= 6
                   and w.airblast.plant.flow_l_min < 1.8)
"""A tank that is told to be empty, which AirblastTankCritical says, is reason enough for no flow."""
WRONG_AIRBLAST = _symptom("AirblastStartStopFailure", 3.7, _wrong_airblast)
AIRBLAST_EMERGENCY = _symptom("DeviceEmergency", 0.5, lambda w, n: w.airblast.talks and w.airblast.nmt_state != STOPPED_STATE
                              and any(w.airblast.errors.values()))
AIRBLAST_BABBLES = _symptom("DeviceEmergency", 0.5, lambda w, n: w.airblast.talks and w.airblast.nmt_state != STOPPED_STATE,
                            remains=False)
AIRBLAST_NO_HEARTBEAT = _symptom("AirblastHeartbeatLost", 3.0, lambda w, n: _tells(w) and not w.airblast.beats)
AIRBLAST_STOPPED = _symptom("AirblastNotOperational", 3.0, lambda w, n: w.airblast.talks
                            and w.airblast.nmt_state == STOPPED_STATE)
AIRBLAST_QUIET = _symptom("AirblastSilent", 1.4, lambda w, n: not w.airblast.sends or w.airblast.nmt_state != OPERATIONAL)
AIRBLAST_STANDS = _symptom("AirblastFrozen", 2.2, lambda w, n: w.airblast.sends and not w.airblast.talks
                           and w.airblast.nmt_state == OPERATIONAL)
AIRBLAST_COMMANDS_LOST = _symptom("AirblastCommandsLost", 0.5, lambda w, n: _vouches(w) and w.airblast.state == "CommandsLost")
DEVICE = ("DeviceSilent", "DeviceEmergency")
AIRBLAST_ALL = (*DEVICE, "AirblastSilent", "AirblastRestarted", "AirblastNotOperational", "AirblastHeartbeatLost",
                "AirblastCommandsLost", "AirblastStartStopFailure")

AIRBLAST: Mapping[str, Row] = {
    "tank empty": Row((AIRBLAST_EMPTY, AIRBLAST_LOW), ("DeviceEmergency",)),
    "tank low": Row((AIRBLAST_LOW,)),
    "line blocked": Row((NO_FLOW,)),
    "refuses start": Row((WRONG_AIRBLAST,)),
    "refuses stop": Row((WRONG_AIRBLAST,)),
    "slow": Row((WRONG_AIRBLAST,)),
    "level_sensor drifts down": Row((AIRBLAST_TOLD_EMPTY, AIRBLAST_TOLD_LOW)),
    "wrong counter": Row((AIRBLAST_MISCOUNTS,)),
    "emergency": Row((AIRBLAST_EMERGENCY,)),
    "babbling": Row((AIRBLAST_BABBLES,), ("AirblastFrozen",)),
    "heartbeat off": Row((AIRBLAST_NO_HEARTBEAT,), ("DeviceSilent",)),
    "stopped": Row((AIRBLAST_STOPPED, AIRBLAST_QUIET), AIRBLAST_ALL),
    "silent": Row((AIRBLAST_QUIET,), AIRBLAST_ALL),
    "frozen": Row((AIRBLAST_STANDS,), AIRBLAST_ALL),
    "reset": Row((AIRBLAST_QUIET,), AIRBLAST_ALL),
}


def _senses(w: World) -> bool:
    return w.ultrasonic.talks and w.ultrasonic.nmt_state == OPERATIONAL


SENSOR_DEAD = _symptom("Ultrasonic{n}NotWorking", 3.2, lambda w, n: _senses(w) and w.ultrasonic.states[n - 1] == "Failed")
SENSOR_FROZEN = _symptom("UltrasonicFrozen", 8.0, lambda w, n: _senses(w) and w.ultrasonic.states[n - 1] == "Working"
                         and w.ultrasonic.sensors[n - 1].frozen != 0)
ULTRASONIC_EMERGENCY = _symptom("DeviceEmergency", 0.5, lambda w, n: w.ultrasonic.talks and w.ultrasonic.nmt_state != STOPPED_STATE
                                and any(w.ultrasonic.errors.values()))
"""An emergency is sent once: one that came up while the device was silent, or stopped, nobody has heard."""
ULTRASONIC_BABBLES = _symptom("DeviceEmergency", 0.5, lambda w, n: w.ultrasonic.talks
                              and w.ultrasonic.nmt_state != STOPPED_STATE, remains=False)
ULTRASONIC_NO_HEARTBEAT = _symptom("UltrasonicHeartbeatLost", 4.5, lambda w, n: _senses(w) and not w.ultrasonic.beats)
ULTRASONIC_STOPPED = _symptom("UltrasonicNotOperational", 4.0, lambda w, n: w.ultrasonic.talks
                              and w.ultrasonic.nmt_state == STOPPED_STATE)
ULTRASONIC_QUIET = _symptom("UltrasonicSilent", 5.3, lambda w, n: not w.ultrasonic.sends)
ULTRASONIC_STANDS = _symptom("UltrasonicFrozen", 8.0, lambda w, n: w.ultrasonic.sends and not w.ultrasonic.talks
                             and w.ultrasonic.nmt_state == OPERATIONAL)
ULTRASONIC_ALL = (*DEVICE, "UltrasonicSilent", "UltrasonicNotOperational", "UltrasonicHeartbeatLost", "UltrasonicFrozen")

ULTRASONIC: Mapping[str, Row] = {
    "sensor dead": Row((SENSOR_DEAD, ULTRASONIC_EMERGENCY)),
    "sensor broken": Row((SENSOR_DEAD, ULTRASONIC_EMERGENCY)),
    "sensor frozen": Row((SENSOR_FROZEN,)),
    "emergency": Row((ULTRASONIC_EMERGENCY,)),
    "babbling": Row((ULTRASONIC_BABBLES,)),
    "heartbeat off": Row((ULTRASONIC_NO_HEARTBEAT,), ("DeviceSilent",)),
    "stopped": Row((ULTRASONIC_STOPPED,), ULTRASONIC_ALL),
    "silent": Row((ULTRASONIC_QUIET,), ULTRASONIC_ALL),
    "frozen": Row((ULTRASONIC_STANDS,), ULTRASONIC_ALL),
    "reset": Row((), ULTRASONIC_ALL),
}
AIRBLAST_MISSION: Mapping[str, Row] = {
    "silent": Row((AIRBLAST_COMMANDS_LOST,), ("DeviceEmergency",)),
    "frozen": Row((AIRBLAST_COMMANDS_LOST,), ("DeviceEmergency",)),
    "reset": Row((AIRBLAST_COMMANDS_LOST,), ("DeviceEmergency",)),
    "ignores repairs": Row(),
}

# --- the UCS's own computer -------------------------------------------------------------------------------------------------


def _part(alarm: str, within_s: float, device: str) -> Symptom:
    return _symptom(alarm, within_s, lambda w, n: w.computer.talks and w.computer.fails(device))


CPU_HOT = _symptom("CpuTemperatureCritical", 13.0, lambda w, n: w.computer.talks and w.computer.cpu_c > 95)
BOARD_HOT = _symptom("MainboardTemperatureCritical", 13.0, lambda w, n: w.computer.talks and w.computer.board_c > 83)
RAM_FULL = _symptom("RamCritical", 33.0, lambda w, n: w.computer.talks and w.computer.ram_percent > 93)
STORAGE_FULL = _symptom("StorageCritical", 33.0, lambda w, n: w.computer.talks and w.computer.storage_percent > 96)
NOT_MEASURED = _symptom("HealthNotMeasured", 5.5, lambda w, n: not w.computer.sends)

COMPUTER: Mapping[str, Row] = {
    "cpu overheats": Row((CPU_HOT,)),
    "board overheats": Row((BOARD_HOT,)),
    "memory leaks": Row((RAM_FULL,)),
    "storage fills": Row((STORAGE_FULL,)),
    "storage fails": Row((_part("StorageWriteFailed", 4.0, "storage"), _part("JournalFault", 4.0, "storage"))),
    "recorder fails": Row((_part("TrafficLogFailed", 4.0, "recorder"),)),
    "clock lost": Row((_part("TimeSyncLost", 122.5, "clock"),)),
    "loop late": Row((_part("LoopLate", 7.0, "loop"),)),
    "bus overloaded": Row((_part("BusOverloaded", 12.0, "bus"),)),
    "silent": Row((NOT_MEASURED,)),
    "frozen": Row(),
    "reset": Row(),
}

TABLE: Mapping[str, Mapping[str, Row]] = {
    "flaming_tool": FLAMER, "mission_controller": FLAMER_MISSION, "sprayer_boom": SPRAYER, "sprayer_mission": SPRAYER_MISSION,
    "vehicle": TRACTOR, "vehicle_mission": VEHICLE_MISSION, "airblast_sprayer": AIRBLAST, "ultrasonic_sensors": ULTRASONIC,
    "airblast_mission": AIRBLAST_MISSION, "computer": COMPUTER,
}
"""Program -> fault, as `device action` -> what is known of it."""

NATURAL: Mapping[str, Callable[[World], bool]] = {
    "PilotFlameOut": lambda w: w.flamer.works and not w.flamer.plant.flame,
    "BottleLow": lambda w: w.flamer.plant.bottle.level_percent < 15.3,
    "BottleEmpty": lambda w: w.flamer.plant.bottle.bar < 0.85,
    "BoomMoving": lambda w: w.sprayer.boom.state in ("Opening", "Closing"),
    "MainTankCritical": lambda w: w.sprayer.plant.tank.level_l(w.now_ns) < 12.2,
    "DisTankCritical": lambda w: w.sprayer.plant.dis_l < 0.6,
    "MainTankMismatch": lambda w: tank_differs_l(w) > 10,
    "MissionFinished": lambda w: w.tractor.mission == "Finished",
    "UnitStopped": lambda w: w.tractor.controller == "Stopped",
    "UnitNotMoving": lambda w: w.tractor.reason == "NotMoving" or not w.tractor.engine.running,
    "FuelLow": lambda w: w.tractor.engine.fuel_percent < 10.5,
    "AirblastTankLow": lambda w: w.airblast.plant.level_percent < 15.6,
    "AirblastTankCritical": lambda w: w.airblast.plant.level_percent < 5.6,
}
"""Alarm -> whether it is true now without any fault: wind, what was used up, what was ordered. Limits are those at which it is
raised, and what sloshes (1 L either way and half a second old, or 0.4 %) or is rounded. A difference between
meter and level is what an earlier leak has left."""

LINGERS: Mapping[str, Callable[[World], bool]] = {
    "BottleLow": lambda w: w.flamer.plant.bottle.level_percent < 20.5,
    "BottleEmpty": lambda w: w.flamer.plant.bottle.bar < 1.55 or w.flamer.plant.bottle.level_percent < 5.5,
    "MainTankCritical": lambda w: w.sprayer.plant.tank.level_l(w.now_ns) < 17,
    "DisTankCritical": lambda w: w.sprayer.plant.dis_l < 1.05,
    "MainTankMismatch": lambda w: tank_differs_l(w) > 6,
    "FuelLow": lambda w: w.tractor.engine.fuel_percent < 15.5,
    "AirblastTankLow": lambda w: w.airblast.plant.level_percent < 20.8,
    "AirblastTankCritical": lambda w: w.airblast.plant.level_percent < 10.8,
}
"""Alarm -> whether, once raised, it may stand at the end of the day: it clears at another limit (AlarmUntil) than it is raised
at, and only when its sensor has been beyond that for a while, although the tank sloshes (1 L, or 0.4 %, either way)."""
