"""DBC texts for tests: a small tool with a valve, a flame and a pressure, and the lines a test adds or replaces."""
from __future__ import annotations

from typing import Any

from level1.catalog import Alarm, Catalog, Problem
from level1.definitions import Source, build
from level1.definitions.attributes import ATTRIBUTES

ALARMS = 1616
"""Identifier of the message that holds the alarms."""

DEFINITIONS = "\n".join(
    f'BA_DEF_ {spec.kind} "{name}" ' + {"STRING": "STRING", "INT": "INT 0 2147483647", "ENUM": "ENUM "}[spec.types[0]]
    + ",".join(f'"{word}"' for word in spec.words) + " ;" for name, spec in ATTRIBUTES.items())
DEFAULTS = "\n".join(
    f'BA_DEF_DEF_ "{name}" ' + {"STRING": '""', "INT": "0", "ENUM": f'"{(*spec.words, "")[0]}"'}[spec.types[0]] + ";"
    for name, spec in ATTRIBUTES.items() if not name.startswith("Repair") and name != "AlarmPriority")

HEAD = f"""VERSION ""
NS_ :
\tCM_
\tBA_
\tSG_MUL_VAL_
BS_:
BU_: UCS TOOL DRIVER
BO_ 256 STATUS: 8 TOOL
 SG_ Flame : 0|2@1+ (1,0) [0|1] "" UCS
 SG_ Valve : 2|1@1+ (1,0) [0|1] "" UCS
 SG_ Running : 3|1@1+ (1,0) [0|0] "" UCS
 SG_ Pressure : 8|8@1+ (0.1,0) [0|25] "bar" UCS
 SG_ Flow : 16|16@1- (0.01,0) [0|0] "L/min" UCS
 SG_ Level : 32|8@1+ (0.5,-20) [-20|100] "%" UCS
 SG_ Mask : 40|12@1+ (1,0) [0|0] "" UCS
BO_ 257 SLOW: 8 TOOL
 SG_ Hours : 0|32@1+ (0.05,0) [0|0] "h" UCS
 SG_ Ratio : 32|32@1- (1,0) [0|0] "" UCS
BO_ 272 CMD: 8 UCS
 SG_ Valve : 0|1@1+ (1,0) [0|1] "" TOOL
 SG_ Igniter : 1|1@1+ (1,0) [0|1] "" TOOL
 SG_ Mode : 2|3@1+ (1,0) [0|4] "" TOOL
 SG_ SpeedLimit : 8|8@1+ (0.1,0) [0|6] "km/h" TOOL
 SG_ Trim : 16|8@1- (1,0) [-100|100] "" TOOL
 SG_ Gain : 32|32@1- (1,0) [0|0] "" TOOL
BO_ 2364540158 EEC1: 8 Vector__XXX
 SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" UCS
 SG_ Torque : 16|8@1+ (1,-125) [-125|125] "%" UCS
 SG_ Lamp : 0|2@1+ (1,0) [0|3] "" UCS
BO_ {ALARMS} ALARMS: 8 UCS
 SG_ FlameOut : 0|2@1+ (1,0) [0|3] "" DRIVER
 SG_ PressureLow : 2|2@1+ (1,0) [0|3] "" DRIVER
 SG_ Spare : 4|2@1+ (1,0) [0|3] "" DRIVER
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_ SG_ "GenSigStartValue" FLOAT -1E12 1E12;
{DEFINITIONS}
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_DEF_DEF_ "GenSigStartValue" 0;
{DEFAULTS}
BA_ "GenMsgCycleTime" BO_ 256 100;
BA_ "GenMsgCycleTime" BO_ {ALARMS} 1000;
BA_ "VFrameFormat" BO_ 2364540158 3;
"""
TAIL = """
VAL_ 256 Flame 0 "Off" 1 "On" 2 "Error" 3 "Not available" ;
VAL_ 256 Valve 0 "Closed" 1 "Open" ;
VAL_ 272 Valve 0 "Closed" 1 "Open" ;
VAL_ 272 Mode 0 "Stop" 1 "Work" 2 "Turn Left" 3 "Spare" 4 "Spare" ;
VAL_ 2364540158 Lamp 0 "Off" 1 "On" 2 "Fault" 3 "NA" ;
SIG_VALTYPE_ 257 Ratio : 1;
SIG_VALTYPE_ 272 Gain : 1;
"""


def attribute(name: str, value: str | int, signal: str = "FlameOut", message: int = ALARMS) -> str:
    """A `BA_` line of a signal, or of a message when the signal is ""."""
    target = f"SG_ {message} {signal}" if signal else f"BO_ {message}"
    return f'BA_ "{name}" {target} ' + (f'"{value}";' if isinstance(value, str) else f"{value};")


def alarm_lines(when: str = "Flame == Off", code: int = 1, signal: str = "FlameOut", **more: Any) -> str:
    """The lines of an alarm."""
    given = {"AlarmCode": code, "AlarmWhen": when, **more}
    return "\n".join(attribute(name, value, signal) for name, value in given.items())


def text(*lines: str) -> str:
    """A file with these lines added."""
    return HEAD + "\n".join(lines) + TAIL


def found(*lines: str) -> tuple[Problem, ...]:
    """Everything wrong or doubtful in a file with these lines added."""
    return build([Source("tool.dbc", text(*lines))])[1]


def catalog(*lines: str) -> Catalog:
    """The catalog of a file with these lines added, which must have no error."""
    result, problems = build([Source("tool.dbc", text(*lines))])
    assert result is not None, "\n".join(map(str, problems))
    return result


def alarm(when: str = "Flame == Off", **more: Any) -> Alarm:
    """The alarm FlameOut with this condition and these attributes."""
    return catalog(alarm_lines(when, **more)).alarms["FlameOut"]


def line_of(part: str, *lines: str) -> int:
    """Number of the first line of such a file that holds this text."""
    return next(number for number, line in enumerate(text(*lines).split("\n"), 1) if part in line)
