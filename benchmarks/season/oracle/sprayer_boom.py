"""What faults of the sprayer boom and its mission controller show as."""
from __future__ import annotations

from collections.abc import Mapping

from benchmarks.season.oracle.table import Row, State, Truth, symptom
from benchmarks.season.world import World


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


WRONG_SECTION = symptom("Section{n}NotSet", 3.6, _wrong_section)
STAYS_OPEN = symptom("SectionStaysOpen", 3.6, lambda w, n: w.sprayer.is_believed and n in w.sprayer.locked
                      and w.sprayer.sections_open[n - 1])
WRONG_SPRAYING = symptom("SprayingStartStopFailure", 3.6, _wrong_spraying)
MAIN_NOT_TAKEN = symptom("SetMainFlowFailure", 2.7, _not_taken("SPRAYER_MAIN_CMD", "MainFlowWanted", 0))
DIS_NOT_TAKEN = symptom("SetDisFlowFailure", 4.7, _not_taken("SPRAYER_DIS_CMD", "DisFlowWanted", 1))
WRONG_MAIN_FLOW = symptom("MainFlowNotAdjusted", 7.7, _wrong_main_flow)
WRONG_DIS_FLOW = symptom("SetDisFlowFailure", 4.8, _wrong_dis_flow)
LINE_BLOCKED = symptom("HerbicideLineBlocked", 2.8, lambda w, n: w.sprayer.is_believed and w.sprayer.spraying
                        and w.sprayer.plant.herbicide.bar > 6.2)
BOOM_BETWEEN = symptom("BoomOpeningNotAdjusted", 18.7, _boom(("Open", "Opening"), ("Open", "Stopped"), ("Close", "Closing"),
                                                              ("Close", "Stopped")))
BOOM_STANDS = symptom("OpenCloseBoomFailure", 3.7, _boom(("Open", "Closed"), ("Open", "Closing"), ("Close", "Open"),
                                                          ("Close", "Opening")))
TANK_DIFFERS = symptom("MainTankMismatch", 12.0, lambda w, n: w.sprayer.talks and tank_differs_l(w) > 13.1)
TANK_CRITICAL = symptom("MainTankCritical", 7.0, lambda w, n: w.sprayer.talks and w.sprayer.plant.tank.level_l(w.now_ns) < 9.5)
DIS_CRITICAL = symptom("DisTankCritical", 7.0, lambda w, n: w.sprayer.talks and w.sprayer.plant.dis_l < 0.45)
SPRAYER_QUIET = symptom("SprayerSilent", 1.4, lambda w, n: not w.sprayer.sends)
SPRAYER_STANDS = symptom("SprayerFrozen", 2.0, lambda w, n: w.sprayer.sends and not w.sprayer.talks)
SPRAYER_GARBLED = symptom("SprayerDataCorrupt", 1.0, lambda w, n: w.sprayer.talks, remains=False)
SPRAYER_COMMANDS_LOST = symptom("SprayerCommandsLost", 0.9, lambda w, n: w.sprayer.is_believed
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
    "silent": Row((SPRAYER_QUIET,)),
    "frozen": Row((SPRAYER_STANDS,), ("SprayerCommandsLost", "SprayerDataCorrupt", "SprayingStartStopFailure")),
    "reset": Row((SPRAYER_QUIET,), ("SprayerCommandsLost", "SprayingStartStopFailure")),
}
SPRAYER_MISSION: Mapping[str, Row] = {
    "silent": Row((SPRAYER_COMMANDS_LOST,)),
    "frozen": Row((SPRAYER_COMMANDS_LOST,)),
    "reset": Row((SPRAYER_COMMANDS_LOST,)),
    "ignores repairs": Row(),
}

ROWS: Mapping[str, Mapping[str, Row]] = {"sprayer_boom": SPRAYER, "sprayer_mission": SPRAYER_MISSION}
NATURAL: Mapping[str, State] = {
    "BoomMoving": lambda w: w.sprayer.boom.state in ("Opening", "Closing"),
    "MainTankCritical": lambda w: w.sprayer.plant.tank.level_l(w.now_ns) < 12.2,
    "DisTankCritical": lambda w: w.sprayer.plant.dis_l < 0.6,
    "MainTankMismatch": lambda w: tank_differs_l(w) > 10,
}
LINGERS: Mapping[str, State] = {
    "MainTankCritical": lambda w: w.sprayer.plant.tank.level_l(w.now_ns) < 17,
    "DisTankCritical": lambda w: w.sprayer.plant.dis_l < 1.05,
    "MainTankMismatch": lambda w: tank_differs_l(w) > 6,
}
