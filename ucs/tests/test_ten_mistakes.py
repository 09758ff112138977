"""Ten mistakes planted in one file are told in one go, each where it stands."""
from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from ucs import main

MISTAKES = [
    ('"TankLevel < 20"', '"TankLevel < "', "TankLow AlarmWhen (column 12)", "a value is missing"),
    ('"TankLevel > 30"', '"TankLevl > 30"', "TankLow AlarmUntil", "did you mean `TankLevel`"),
    ('"Pressure < 0.5"', '"Pressure < 0"', "NoPressure AlarmWhen", "can never hold"),
    ('"Pump == On"', '"Pump == Running"', "NoPressure AlarmEnabledWhen", "signal of 2 messages"),
    ('"silent(IMPLEMENT_STATUS, 1 s)"', '"silent(IMPLEMENT_STATUS, 50 ms)"', "ImplementSilent AlarmWhen", "between two frames"),
    ('ImplementSilent 40003', 'ImplementSilent 40001', "AlarmCode", "40001"),
]
REPAIRS = [
    ("send IMPLEMENT_STATUS(Pump=On)", "TankLow Repair", "UCS"),
    ("send IMPLEMENT_CMD(Pump=7)", "NoPressure Repair", "Pump"),
]
EXTRA = """BA_ "Repair" SG_ 1537 TankLow "send IMPLEMENT_STATUS(Pump=On)";
BA_ "Repair" SG_ 1537 NoPressure "send IMPLEMENT_CMD(Pump=7); expect Pressure > 1 / 0 within 3 s";
BA_ "AlarmOnDelay" SG_ 1537 ImplementSilent -5;
"""


def test_all_of_them_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = resources.files("ucs").joinpath("start.dbc").read_text(encoding="utf-8")
    for right, wrong, _, _ in MISTAKES:
        assert right in text
        text = text.replace(right, wrong, 1)
    command = 'BO_ 1282 IMPLEMENT_CMD: 1 UCS\n SG_ Pump : 0|2@1+ (1,0) [0|1] "" IMPLEMENT\n\nCM_ "A start'
    text = text.replace('CM_ "A start', command, 1).replace("VAL_ 1281", EXTRA + "VAL_ 1281", 1)
    path = tmp_path / "mine.dbc"
    path.write_text(text)
    assert main.main(["check", str(path)]) == 1
    out = capsys.readouterr().out
    errors = [line for line in out.splitlines() if ": error: " in line]
    for _, _, where, what in MISTAKES:
        assert any(where in line and what in line for line in errors), (where, what, out)
    for _, where, what in REPAIRS:
        assert any(where in line and what in line for line in errors), (where, what, out)
    assert any("zero" in line for line in errors) and any("ImplementSilent AlarmOnDelay" in line for line in errors), out
    assert len(errors) == 10, out
    assert all(line.split(":")[1].isdigit() for line in errors)
