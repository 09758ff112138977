"""`ucs status`: what it finds, its exit code and first line, whatever runs or is broken."""
from __future__ import annotations

import json
import re
import sqlite3
from decimal import Decimal
from pathlib import Path

import can
import msgspec
import pytest

from bridge.delivered import Delivered, delivered_path
from bridge.ranges import Ranges
from level1.decode import encode
from level1.event import Event
from level1.io.definitions import load
from level1.io.inquiry import Desk, Silence
from level1.io.journal import Journal
from level1.io.live import encode_state
from level1.memory import AlarmMemory, State
from ucs.attendant import Attendant
from ucs.main import main
from ucs.standing import AlarmStanding, BridgeStanding, BusStanding, RepairStanding, RunStanding, ask_run
from ucs.status import CRITICAL, OK, UNKNOWN, WARNING, JournalStanding, Limits, Picture, alarm_line, first_line, judge, page
from ucs.tests.running import awaited, beside_run, flaming_unit, patient_tool

UNIT = flaming_unit("test_status")
BRIDGE = '[bridge]\nbroker = "mqtt://127.0.0.1:1"\n'
BUS = BusStanding("implement", "socketcan", "can0", "BusActive", received=100, sent=3, quiet_s=0.1, load_percent=12.0)
RUN = RunStanding("t", "f", "1.0", pid=1, boot=5, seq=9, uptime_s=100.0, turn_age_s=0.1, lateness_s=0.002, mode="running",
                  utc_trusted=True, buses=(BUS,), alarms=(), defined=4)
OUT = AlarmStanding("PilotFlameOut", 3101, "High", "Active", "the flame is out", age_s=4.0)
BRIDGE_UP = BridgeStanding("mqtt://b:1883", "1.0", pid=2, uptime_s=50.0, turn_age_s=0.0, online=True, online_s=40.0, ack_age_s=0.2)
GOOD = Picture("t", "f", JournalStanding("journal.db"), run=RUN, disk_used_percent=20.0, version="1.0")


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    file = tmp_path / "unit.toml"
    file.write_text(UNIT)
    return file


def changed(picture: Picture = GOOD, **run: object) -> Picture:
    return msgspec.structs.replace(picture, run=msgspec.structs.replace(RUN, **run))


def bridged(bridge: BridgeStanding | None = BRIDGE_UP, silent: str = "", **journal: object) -> Picture:
    return msgspec.structs.replace(GOOD, has_bridge=True, bridge=bridge, bridge_silent=silent,
                                   journal=msgspec.structs.replace(GOOD.journal, **journal))


def silent(why: Silence) -> Picture:
    return msgspec.structs.replace(GOOD, run=None, run_silent=why.value)


@pytest.mark.parametrize(("picture", "level", "text"), [
    (GOOD, OK, ""),
    (changed(turn_age_s=60.0), CRITICAL, "supervision hangs for 1 min"),
    (changed(buses=(msgspec.structs.replace(BUS, state="BusDown"),)), CRITICAL, "bus implement (can0) is gone"),
    (changed(buses=(msgspec.structs.replace(BUS, state="BusPassive"),)), WARNING, "bus implement (can0) is error passive"),
    (changed(journal_fault="journal j: can't be written (disk full)"), CRITICAL, "journal j: can't be written (disk full)"),
    (changed(mode="stopped"), WARNING, "stopped: it is resumed at the machine"),
    (changed(lateness_s=0.25), WARNING, "the loop was 250 ms late"),
    (changed(recorder="/r", recorder_fault="/r: disk full"), WARNING, "traffic is not recorded: /r: disk full"),
    (changed(version="0.9"), WARNING, "version 0.9 runs, 1.0 is installed; restart it"),
    (changed(alarms=(OUT,)), WARNING, "PilotFlameOut is active"),
    (changed(alarms=(msgspec.structs.replace(OUT, state="LockedOut"),)), CRITICAL, "PilotFlameOut is locked out"),
    (changed(alarms=(msgspec.structs.replace(OUT, priority="Critical"),)), CRITICAL, "PilotFlameOut is active"),
    (changed(alarms=(msgspec.structs.replace(OUT, priority="Event"),)), OK, ""),
    (bridged(), OK, ""),
    (bridged(None, "is not running"), WARNING, "`ucs bridge` is not running"),
    (bridged(msgspec.structs.replace(BRIDGE_UP, online=False, online_s=59.0)), OK, ""),
    (bridged(msgspec.structs.replace(BRIDGE_UP, online=False, online_s=61.0)), WARNING, "level 2 is not connected for 1 min 1 s"),
    (bridged(waiting=1, oldest_s=299.0), OK, ""),
    (bridged(waiting=3, oldest_s=400.0), WARNING, "3 events wait for level 2, the oldest for 6 min 40 s"),
    (msgspec.structs.replace(GOOD, disk_used_percent=91.0), WARNING, "the disk is 91 % full"),
    (msgspec.structs.replace(GOOD, disk_used_percent=99.0), CRITICAL, "the disk is 99 % full"),
    (silent(Silence.ABSENT), CRITICAL, "`ucs run` is not running"),
    (silent(Silence.MUTE), CRITICAL, "`ucs run` runs but does not answer"),
    (silent(Silence.DENIED), UNKNOWN, "`ucs run` can't be asked by this user"),
    (silent(Silence.CUT_OFF), UNKNOWN, "`ucs run` can't be asked if it runs: the disk of its journal is read-only"),
])
def test_every_finding_has_its_level(picture: Picture, level: int, text: str) -> None:
    findings = judge(picture, Limits())
    assert [(finding.level, finding.text) for finding in findings] == ([(level, text)] if text else [])
    assert list(page(picture, findings))


def test_the_caller_says_what_is_grave() -> None:
    assert judge(changed(alarms=(OUT,)), Limits(critical="High"))[0].level == CRITICAL
    assert judge(msgspec.structs.replace(GOOD, disk_used_percent=50.0), Limits(disk_percent=40.0))[0].level == WARNING
    assert judge(bridged(waiting=1, oldest_s=2.0), Limits(waiting_s=1.0))[0].level == WARNING


def test_the_first_line_holds_no_bar_that_a_plugin_would_cut_at() -> None:
    assert first_line(GOOD, OK, []) == "UCS OK - t: supervised for 1 min 40 s, 1 bus up, no alarm"
    assert "|" not in first_line(changed(journal_fault="a | b"), CRITICAL, judge(changed(journal_fault="a | b"), Limits()))


@pytest.mark.parametrize(("repair", "text"), [
    (RepairStanding("running", 2, 2, 3, 2, 7, "wait 30 s", 12.4), ", attempt 2 of 3: wait 30 s, 12 s left"),
    (RepairStanding("pausing", 1, 1, 3, left_s=5.0), ", attempt 1 of 3: pauses, 5.0 s left"),
    (RepairStanding("pausing", 1, 2, 3, left_s=5.0), ", attempt 1 (2 of 3 of the budget used): pauses, 5.0 s left"),
    (RepairStanding("waiting", 0, 0, 3, obstacle="the unit is paused"), ", attempt 0 of 3: waits, the unit is paused"),
    (RepairStanding("passive", 0, 0, 3), ", its repair is not armed"),
    (RepairStanding("idle", 0, 0, 3), ""),
])
def test_an_alarm_tells_what_is_done_about_it(repair: RepairStanding, text: str) -> None:
    line = alarm_line(msgspec.structs.replace(OUT, repair=repair))
    assert line == f"PilotFlameOut: High Active for 4.0 s{text}; the flame is out"


# --- what runs or is broken -------------------------------------------------------------------------------------------------


def test_a_running_unit_tells_its_alarm_and_the_step_of_its_repair(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    payload = encode(load(["flaming_tool.dbc"]).messages["FLAMER_STATUS"], {"Flaming": 1, "PilotFlame": 0, "Safeguard": 4}, None)
    told: list[RunStanding] = []
    status: list[int] = []
    patient_tool(unit.parent)

    def body(journal: Path) -> None:
        awaited(journal)
        with can.Bus("test_status", interface="virtual") as bus:
            message = can.Message(arbitration_id=0x210, is_extended_id=False, data=payload)
            task = bus.send_periodic(message, 0.03)
            told.append(awaited(journal, lambda run: any(alarm.repair and alarm.repair.doing for alarm in run.alarms)))
            status.append(main(["status", str(unit), "--perfdata"]))
            task.stop()
    beside_run(unit, body)
    alarm = next(alarm for alarm in told[0].alarms if alarm.name == "PilotFlameOut")
    assert (alarm.state, alarm.priority, alarm.code) == ("Repairing", "High", 3101) and alarm.age_s is not None and alarm.age_s < 20
    assert alarm.repair and (alarm.repair.attempt, alarm.repair.attempts, alarm.repair.step) == (1, 3, 2)
    assert alarm.repair.doing == "wait 30 s" and alarm.repair.left_s is not None and 0 < alarm.repair.left_s <= 30
    assert told[0].buses[0].received > 0 and told[0].armed == ("PilotFlameOut",) and "PilotIgnitionFailure" in told[0].passive
    assert status == [WARNING]
    out = capsys.readouterr().out
    assert re.search(r"^UCS WARNING - tractor-7: .*PilotFlameOut is being repaired.* \| alarms=1 ", out, re.MULTILINE)
    assert ask_run(unit.parent / "journal.db") is Silence.ABSENT


def test_a_loop_that_hangs_is_told_by_how_old_its_answer_is(unit: Path) -> None:
    link = Dummy()
    attendant = Attendant(link, None, iter(range(0, 10**12, 10**9)).__next__)
    attendant._answer = RUN
    told = msgspec.json.decode(attendant.answer(), type=RunStanding)
    assert told.turn_age_s > 0 and told.uptime_s == RUN.uptime_s


class Dummy:
    def publish(self, events: object, outputs: object) -> None:
        """Nobody there."""


def stored(unit: Path, *, state: int = 3) -> Path:
    """A journal as a run leaves it that was killed while an alarm was locked out."""
    journal = unit.parent / "journal.db"
    event = Event("tractor-7", 1, 1, Decimal("1.000000000"), "2026-01-01T00:00:00.000000Z", True, "PilotFlameOut", 3101, "High",
                  "raised", 1, 0, {}, "the flame is out")
    memory = AlarmMemory("PilotFlameOut", state, 1, False, 3, (), ())
    with Journal(journal, "tractor-7") as writing:
        events = [event, msgspec.structs.replace(event, seq=2, event="locked_out")]
        writing.append(events, encode_state(State("running", (memory,))))
    return journal


def test_a_unit_that_does_not_run_tells_what_its_journal_holds(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unit.write_text(UNIT + BRIDGE)
    journal = stored(unit)
    assert main(["status", str(unit), "--json"]) == CRITICAL
    told = json.loads(capsys.readouterr().out)
    assert told["run"] is None and told["run_silent"] == "is not running" and told["code"] == CRITICAL
    assert (told["journal"]["waiting"], told["journal"]["alarms"][0]["state"]) == (2, "LockedOut")
    assert {"level": "CRITICAL", "text": "PilotFlameOut was locked out"} in told["findings"]
    with Delivered(delivered_path(journal)) as delivered:
        delivered.add(1, Ranges([(1, 1)]))
    assert main(["status", str(unit), "--json"]) == CRITICAL
    assert json.loads(capsys.readouterr().out)["journal"]["waiting"] == 1


@pytest.mark.parametrize("content", [b"not a database, far from it" * 100, b""])
def test_a_broken_journal_is_told_in_one_line(unit: Path, capsys: pytest.CaptureFixture[str], content: bytes) -> None:
    (unit.parent / "journal.db").write_bytes(content)
    assert main(["status", str(unit)]) == CRITICAL
    out, err = capsys.readouterr()
    assert out.startswith("UCS CRITICAL - tractor-7: `ucs run` is not running\n") and err == ""
    assert re.search(r"^  journal   .*(can't be read|empty; `ucs run` begins it)", out, re.MULTILINE)


def test_a_journal_that_somebody_locked_is_told(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = stored(unit)
    connection = sqlite3.connect(journal, isolation_level=None)
    connection.execute("PRAGMA locking_mode = EXCLUSIVE")
    connection.execute("BEGIN EXCLUSIVE")
    connection.execute("DELETE FROM boot")
    assert main(["status", str(unit)]) == CRITICAL
    connection.execute("ROLLBACK")
    connection.close()
    assert "UCS CRITICAL - tractor-7: `ucs run` is not running" in capsys.readouterr().out


def test_a_missing_journal_and_a_silent_socket(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", str(unit)]) == CRITICAL
    assert "  run       is not running\n" in capsys.readouterr().out
    with Desk(unit.parent / "journal.db", "run", lambda: b"{}"):
        assert main(["status", str(unit)]) == CRITICAL
    assert "runs but does not answer" in capsys.readouterr().out


@pytest.mark.parametrize(("text", "told"), [
    ("[unit]", "UCS UNKNOWN - "), ("no toml at all", "not TOML"),
    (UNIT.replace('[journal]\npath = "journal.db"', ""), "journal: missing"),
])
def test_a_wrong_configuration_is_unknown(unit: Path, capsys: pytest.CaptureFixture[str], text: str, told: str) -> None:
    unit.write_text(text)
    assert main(["status", str(unit)]) == UNKNOWN
    out, err = capsys.readouterr()
    assert out.startswith("UCS UNKNOWN - ") and told in out and err == ""


@pytest.mark.parametrize("arguments", [[], ["unit.toml", "--critical", "Grave"], ["unit.toml", "--waiting", "5"]])
def test_wrong_arguments_are_unknown_too(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["status", *arguments])
    assert ended.value.code == UNKNOWN
    assert "see ucs status --help" in capsys.readouterr().err
