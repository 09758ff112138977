"""An implement that this project has never heard of: its alarm and its verified repair come from its DBC file alone."""
from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import can
import pytest

from hil_tests.conftest import START_S
from ucs import main
from ucs.tests.units import unit_toml

SEEDER = """VERSION ""
BU_: UCS SEEDER
BO_ 640 SEEDER_STATUS: 2 SEEDER
 SG_ Sowing : 0|2@1+ (1,0) [0|1] "" UCS
 SG_ Fan : 2|2@1+ (1,0) [0|1] "" UCS
 SG_ HopperLevel : 8|8@1+ (0.5,0) [0|100] "%" UCS
BO_ 641 SEEDER_CMD: 1 UCS
 SG_ Fan : 0|2@1+ (1,0) [0|1] "" SEEDER
BO_ 1680 SEEDER_ALARMS: 1 UCS
 SG_ FanStopped : 0|2@1+ (1,0) [0|3] "" SEEDER
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmPriority" ENUM "Event","Low","Medium","High","Critical";
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_ SG_ "AlarmOnDelay" INT 0 3600000;
BA_DEF_ SG_ "AlarmAction" STRING;
BA_DEF_ SG_ "Repair" STRING;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmPriority" "Medium";
BA_DEF_DEF_ "AlarmWhen" "";
BA_DEF_DEF_ "AlarmOnDelay" 0;
BA_DEF_DEF_ "AlarmAction" "";
BA_DEF_DEF_ "Repair" "";
BA_ "GenMsgCycleTime" BO_ 640 100;
BA_ "GenMsgCycleTime" BO_ 641 100;
BA_ "GenMsgCycleTime" BO_ 1680 1000;
BA_ "AlarmCode" SG_ 1680 FanStopped 50001;
BA_ "AlarmPriority" SG_ 1680 FanStopped 3;
BA_ "AlarmWhen" SG_ 1680 FanStopped "Sowing == On and SEEDER_STATUS.Fan == Off";
BA_ "AlarmOnDelay" SG_ 1680 FanStopped 500;
BA_ "AlarmAction" SG_ 1680 FanStopped "Stop sowing; look at the fan's belt.";
BA_ "Repair" SG_ 1680 FanStopped "send SEEDER_CMD(Fan=On); expect SEEDER_STATUS.Fan == On within 3 s";
VAL_ 640 Sowing 0 "Off" 1 "On";
VAL_ 640 Fan 0 "Off" 1 "On";
VAL_ 641 Fan 0 "Off" 1 "On";
VAL_ 1680 FanStopped 0 "Normal" 1 "Active" 2 "Repairing" 3 "LockedOut";
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "seeder.dbc").write_text(SEEDER)
    (tmp_path / "unit.toml").write_text(unit_toml("seeder.dbc", armed=["FanStopped"]))
    return tmp_path


def test_it_is_checked_replayed_and_explained(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dbc, log = str(folder / "seeder.dbc"), folder / "field.log"
    log.write_text("".join(f"({1_700_000_000 + n / 10:.6f}) can0 280#{1 if 10 <= n < 30 else 5:02X}64\n" for n in range(60)))
    assert main.main(["check", "--strict", dbc]) == 0
    assert main.main(["replay", str(log), "--dbc", dbc]) == 0
    out = capsys.readouterr().out
    for word in ("raised", "repair started", "repaired", "cleared"):
        assert word in out
    assert main.main(["alarms", dbc, "--handbook", str(folder / "handbook.md")]) == 0
    handbook = (folder / "handbook.md").read_text()
    assert "1. Command fan On (SEEDER_CMD)." in handbook and "look at the fan's belt" in handbook


@pytest.mark.vcan
def test_its_fault_is_repaired_on_a_real_bus(folder: Path, process: Any) -> None:
    supervisor = process("run", "unit.toml", cwd=folder)
    supervisor.expect("supervising", START_S)
    with can.Bus("vcan0", interface="socketcan") as bus:
        fan = False
        end = time.monotonic() + 60
        while time.monotonic() < end and not any("cleared" in line for line in supervisor.out):
            bus.send(can.Message(arbitration_id=640, data=[1 | fan << 2, 100], is_extended_id=False))
            heard = bus.recv(0.1)
            if heard is not None and heard.arbitration_id == 641:
                fan = bool(heard.data[0] & 1)
    for word in ("raised", "repair started", "repaired", "cleared"):
        supervisor.expect(f"FanStopped +{word}")
