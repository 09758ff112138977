"""`ucs check` and `ucs alarms`: what is printed, and the exit code."""
from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

GOOD = """VERSION ""
BS_:
BU_: UCS TOOL
BO_ 256 STATUS: 8 TOOL
 SG_ Valve : 0|1@1+ (1,0) [0|1] "" UCS
 SG_ Pressure : 8|8@1+ (0.1,0) [0|25] "bar" UCS
BO_ 1616 ALARMS: 8 UCS
 SG_ PressureLow : 0|2@1+ (1,0) [0|3] "" UCS
 SG_ ValveStuck : 2|2@1+ (1,0) [0|3] "" UCS
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING ;
BA_DEF_ SG_ "AlarmOnDelay" INT 0 100000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_DEF_DEF_ "AlarmOnDelay" 0;
BA_ "GenMsgCycleTime" BO_ 256 100;
BA_ "AlarmCode" SG_ 1616 PressureLow 11;
BA_ "AlarmWhen" SG_ 1616 PressureLow "Pressure < 1.5";
BA_ "AlarmOnDelay" SG_ 1616 PressureLow 2000;
BA_ "AlarmCode" SG_ 1616 ValveStuck 7;
BA_ "AlarmWhen" SG_ 1616 ValveStuck "Valve and held(Valve) > 10 s";
VAL_ 256 Valve 0 "Closed" 1 "Open" ;
"""


def ucs(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "ucs", *map(str, words)], capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def good(tmp_path: Path) -> Path:
    file = tmp_path / "tool.dbc"
    file.write_text(GOOD)
    return file


@pytest.fixture
def bad(tmp_path: Path) -> Path:
    file = tmp_path / "bad.dbc"
    file.write_text(GOOD.replace("Pressure < 1.5", "Presure < 1.5").replace("Valve and", "Valve == Opn and"))
    return file


def test_a_clean_file_gives_the_counts_and_exit_code_0(good: Path) -> None:
    result = ucs("check", good)
    assert (result.returncode, result.stdout, result.stderr) == (0, "2 messages, 2 alarms, 0 errors, 0 warnings\n", "")


def test_every_error_is_printed_with_its_place_and_a_caret_and_the_exit_code_is_1(bad: Path) -> None:
    result = ucs("check", bad)
    assert result.returncode == 1 and not result.stderr
    lines = result.stdout.splitlines()
    assert lines == [
        f"{bad}:20: error: ALARMS.PressureLow AlarmWhen (column 1): there is no signal `Presure`; did you mean `Pressure`?",
        "    Presure < 1.5",
        "    ^",
        f"{bad}:23: error: ALARMS.ValveStuck AlarmWhen (column 10): `Opn` is no value of Valve; did you mean `Open`? "
        "its values are Closed, Open",
        "    Valve == Opn and held(Valve) > 10 s",
        "             ^",
        "2 messages, 2 alarms, 2 errors, 0 warnings",
    ]


def test_warnings_alone_give_exit_code_0_and_1_when_strict(good: Path) -> None:
    good.write_text(GOOD + 'VAL_ 256 Nothing 0 "Off" ;\n')
    result = ucs("check", good)
    assert result.returncode == 0 and result.stdout.endswith("2 messages, 2 alarms, 0 errors, 1 warning\n")
    assert ucs("check", "--strict", good).returncode == 1


def test_json_holds_the_same_for_editors(bad: Path) -> None:
    result = ucs("check", "--format", "json", bad)
    found = json.loads(result.stdout)
    assert result.returncode == 1 and found["summary"] == {"messages": 2, "alarms": 2, "errors": 2, "warnings": 0}
    problem = found["problems"][0]
    assert problem["where"] == "ALARMS.PressureLow" and problem["attribute"] == "AlarmWhen"
    assert (problem["line"], problem["column"]) == (20, 1)


def test_problems_of_all_files_are_told_at_once(good: Path, bad: Path, tmp_path: Path) -> None:
    bad.write_text(bad.read_text().replace("256", "257").replace("1616", "1617").replace("BO_ 1617 ALARMS", "BO_ 1617 OTHER"))
    result = ucs("check", good, bad, tmp_path / "missing.dbc")
    assert result.returncode == 1
    assert f"{tmp_path / 'missing.dbc'}: error: no such file" in result.stdout
    assert "message name is used twice" in result.stdout and "did you mean `Pressure`?" in result.stdout


def test_shipped_definitions_go_by_name_alone_and_are_clean(tmp_path: Path) -> None:
    result = ucs("check", "--strict", "flaming_tool.dbc")
    assert result.returncode == 0, result.stdout


def test_alarms_are_listed_by_code(good: Path) -> None:
    result = ucs("alarms", good)
    assert result.returncode == 0
    assert result.stdout.splitlines() == [
        "code  name         priority  delay   repair  condition",
        "7     ValveStuck   Medium    -       -       Valve and held(Valve) > 10 s",
        "11    PressureLow  Medium    on 2 s  -       Pressure < 1.5",
    ]


def test_alarms_as_json_carry_every_field(good: Path) -> None:
    listed = json.loads(ucs("alarms", "--format", "json", good).stdout)
    assert [(alarm["code"], alarm["name"], alarm["when"]) for alarm in listed] == [
        (7, "ValveStuck", "Valve and held(Valve) > 10 s"), (11, "PressureLow", "Pressure < 1.5")]
    assert listed[1]["on_delay_ms"] == 2000 and listed[1]["repair"] is None


def test_alarms_of_a_file_with_errors_are_not_listed(bad: Path) -> None:
    result = ucs("alarms", bad)
    assert result.returncode == 1 and not result.stdout and "did you mean" in result.stderr
