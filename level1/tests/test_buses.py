"""One definition bound to two buses watches over two machines, each by itself."""
from __future__ import annotations

from pathlib import Path

import pytest

from level1.catalog import DefinitionError
from level1.event import Event, Send
from level1.frame import Frame
from level1.io.definitions import load
from level1.supervisor import Supervisor
from level1.tests.build import MS

TEXT = """VERSION ""
NS_ :
BS_:
BU_: UCS NODE
BO_ 512 TOOL_STATUS: 8 NODE
 SG_ Level : 0|8@1+ (1,0) [0|200] "L" UCS
BO_ 513 TOOL_CMD: 8 UCS
 SG_ Fill : 0|2@1+ (1,0) [0|1] "" NODE
BO_ 1537 TOOL_ALARMS: 8 UCS
 SG_ TankLow : 0|2@1+ (1,0) [0|3] "" NODE
 SG_ TankLowOften : 2|2@1+ (1,0) [0|3] "" NODE
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 100000;
BA_DEF_ BO_ "Commands" STRING;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_ SG_ "Repair" STRING;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "Commands" "";
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_DEF_DEF_ "Repair" "";
BA_ "GenMsgCycleTime" BO_ 512 100;
BA_ "GenMsgCycleTime" BO_ 1537 1000;
BA_ "Commands" BO_ 513 "fill: Fill=1";
BA_ "AlarmCode" SG_ 1537 TankLow 40001;
BA_ "AlarmWhen" SG_ 1537 TankLow "Level < 20";
BA_ "Repair" SG_ 1537 TankLow "send TOOL_CMD(Fill=1); expect Level > 30 within 5 s";
BA_ "AlarmCode" SG_ 1537 TankLowOften 40002;
BA_ "AlarmWhen" SG_ 1537 TankLowOften "count(TankLow, 1 min) >= 2";
"""


@pytest.fixture
def supervisor(tmp_path: Path) -> Supervisor:
    path = tmp_path / "tool.dbc"
    path.write_text(TEXT)
    catalog = load((), {0: [path, "ucs.dbc"], 1: [path, "ucs.dbc"]}, ("front", "rear"))
    return Supervisor(catalog, unit="u", start_ns=0)


def status(t_ms: int, bus: int, level: int) -> Frame:
    return Frame(t_ms * MS, bus << 32 | 512, bytes([level]) + bytes(7))


def test_each_bus_has_its_own_alarms_repairs_and_counts(supervisor: Supervisor) -> None:
    outputs = supervisor.receive_many([status(0, 0, 100), status(1, 1, 10), status(2, 0, 90)])
    events = [(out.alarm, out.event) for out in outputs if isinstance(out, Event)]
    assert events == [("TankLow@rear", "raised"), ("TankLow@rear", "repair_started")]
    commands = [out.key >> 32 for out in outputs if isinstance(out, Send) and out.message.startswith("TOOL_CMD")]
    assert commands == [1]
    assert supervisor.alarm_states()["TankLow@front"] == 0
    shown = {out.key >> 32: out.data[0] for out in outputs if isinstance(out, Send) and out.message.startswith("TOOL_ALARMS")}
    assert shown == {0: 0, 1: 2}


def test_what_the_ucs_alone_sends_stays_one_and_goes_to_both(supervisor: Supervisor) -> None:
    assert "CpuTemperatureCritical" in supervisor.catalog.alarms
    outputs = supervisor.tick(0)
    assert {out.key >> 32 for out in outputs if isinstance(out, Send) and out.message == "UCS_ALARMS"} == {0, 1}


def test_an_alarm_elsewhere_that_asks_for_one_of_several_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "tool.dbc").write_text(TEXT)
    other = TEXT.replace("TOOL_STATUS", "X").replace("TankLow", "Other").replace("4000", "4100").replace(" 513 ", " 515 ")
    other = other.replace("TOOL_CMD", "Y").replace("TOOL_ALARMS", "Z").replace(" 512 ", " 514 ").replace(" 1537 ", " 1538 ")
    other = other.replace("Level < 20", "TOOL_STATUS.Level < 20").replace("SG_ Level", "SG_ Height")
    other = other.replace("expect Level", "expect Height")
    (tmp_path / "other.dbc").write_text(other.replace("fill:", "pour:"))
    with pytest.raises(DefinitionError, match="one on each of several buses"):
        load((), {0: [tmp_path / "tool.dbc", tmp_path / "other.dbc"], 1: [tmp_path / "tool.dbc"]}, ("a", "b"))
