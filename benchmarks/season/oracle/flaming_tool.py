"""What faults of the flaming tool and its mission controller show as."""
from __future__ import annotations

from collections.abc import Mapping

from benchmarks.season.oracle.table import Row, State, symptom
from benchmarks.season.world import World


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


FLAME_OUT = symptom("PilotFlameOut", 0.9, lambda w, n: w.flamer.talks and w.flamer.works and _wanted(w)
                     and not w.flamer.sees_flame)
UNLIT = symptom("PilotIgnitionFailure PilotFlameOut", 5.4, _unlit)
VALVE_NOT_OPEN = symptom("GasValveNotOpened", 0.7, lambda w, n: w.flamer.talks and w.flamer.safeguard.valve == "Open"
                          and w.flamer.valve == "Closed")
VALVE_NOT_CLOSED = symptom("GasValveNotClosed", 1.5, lambda w, n: w.flamer.talks and w.flamer.safeguard.valve == "Closed"
                            and w.flamer.valve == "Open")
LEAK = symptom("GasValveLeaks", 2.7, lambda w, n: w.flamer.talks and w.flamer.valve == "Closed" and w.flamer.plant.line_bar > 0.25)
FALSE_FLAME = symptom("FlameWithValveClosed", 2.6, lambda w, n: w.flamer.talks and w.flamer.valve == "Closed"
                       and w.flamer.sees_flame)
WRONG_BURNER = symptom("ChangeBurnersFailure", 2.7, _wrong_burner)
WRONG_MODE = symptom("FlamingStartStopFailure", 3.6, _wrong_mode)
BOTTLE_EMPTY = symptom("BottleEmpty", 4.5, lambda w, n: w.flamer.talks and w.flamer.plant.bottle.bar < 0.7)
BOTTLE_LOW = symptom("BottleLow", 12.0, lambda w, n: w.flamer.talks and w.flamer.plant.bottle.level_percent < 14)
GAS_COMMANDS_LOST = symptom("FlamerCommandsLost", 0.6, lambda w, n: w.flamer.talks
                             and w.flamer.safeguard.state == "CommandsLost")
FLAMER_QUIET = symptom("FlamerSilent", 1.4, lambda w, n: not w.flamer.sends)
TOLD_EMPTY = symptom("BottleEmpty", 4.5, lambda w, n: w.flamer.talks and w.flamer.plant.bottle.bar * w.flamer.bottle_told < 0.7)
TOLD_LOW = symptom("BottleLow", 12.0, lambda w, n: w.flamer.talks
                    and w.flamer.plant.bottle.level_percent * w.flamer.bottle_told < 14)
FLAMER_MISCOUNTS = symptom("FlamerFrozen", 2.0, lambda w, n: w.flamer.talks, remains=False)
FLAMER_STANDS = symptom("FlamerFrozen", 2.0, lambda w, n: w.flamer.sends and not w.flamer.talks)

OUT = ("PilotFlameOut", "PilotFlameTooOften")
NOT_CONFIRMED = ("FlamingStartStopFailure", "ChangeBurnersFailure")
"""A program that stands does not say that it did what it was told meanwhile: whoever orders flaming off never sees it off."""
JUST_CLOSED = ("GasValveLeaks", "FlameWithValveClosed")
"""One that stands since the moment in which the valve closed goes on saying that there are pressure and flame behind it."""
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
    "frozen": Row((FLAMER_STANDS,), ("FlamerCommandsLost", "PilotIgnitionFailure", *OUT, *NOT_CONFIRMED, *JUST_CLOSED), GAS_TAIL_S),
    "reset": Row((FLAMER_QUIET,), ("FlamerCommandsLost", "PilotIgnitionFailure", *OUT), GAS_TAIL_S),
}
FLAMER_MISSION: Mapping[str, Row] = {
    "silent": Row((GAS_COMMANDS_LOST,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "frozen": Row((GAS_COMMANDS_LOST,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "reset": Row((GAS_COMMANDS_LOST,), (*OUT, "PilotIgnitionFailure"), GAS_TAIL_S),
    "ignores repairs": Row((), (), GAS_TAIL_S),
}

ROWS: Mapping[str, Mapping[str, Row]] = {"flaming_tool": FLAMER, "mission_controller": FLAMER_MISSION}
NATURAL: Mapping[str, State] = {
    "PilotFlameOut": lambda w: w.flamer.works and not w.flamer.plant.flame,
    "BottleLow": lambda w: w.flamer.plant.bottle.level_percent < 15.3,
    "BottleEmpty": lambda w: w.flamer.plant.bottle.bar < 0.85,
}
LINGERS: Mapping[str, State] = {
    "BottleLow": lambda w: w.flamer.plant.bottle.level_percent < 20.5,
    "BottleEmpty": lambda w: w.flamer.plant.bottle.bar < 1.55 or w.flamer.plant.bottle.level_percent < 5.5,
}
