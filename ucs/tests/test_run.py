"""`ucs run`: starts with what it has loaded, tells each event as it happens, stops cleanly; every obstacle is one line."""
from __future__ import annotations

import os
import re
import signal
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from level1.catalog import LOCKED_OUT
from level1.command import Order
from level1.decode import encode
from level1.event import Event, seconds
from level1.io.definitions import load
from level1.io.journal import Journal, read_events
from level1.io.live import encode_state
from level1.memory import State
from level1.supervisor import Supervisor
from level1.tests.test_journal import on_small_disk
from ucs.main import main
from ucs.run import restored
from ucs.tests.running import WAIT_S, beside_run, flaming_unit, patient_tool

UNIT = flaming_unit("test_run")


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    file = tmp_path / "unit.toml"
    file.write_text(UNIT)
    return file


def test_an_alarm_is_told_repaired_stored_and_broadcast(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    heard: list[tuple[int, bytes]] = []

    def body(_: Path) -> None:
        """A flaming tool whose pilot flame is out, until it has heard the repair's command and the alarm's message."""
        status = load(["flaming_tool.dbc"]).messages["FLAMER_STATUS"]
        payload = encode(status, {"Flaming": 1, "PilotFlame": 0, "Safeguard": 4}, None)
        end = time.monotonic() + WAIT_S
        with can.Bus("test_run", interface="virtual") as bus:
            while not (any(can_id == 0x110 for can_id, _ in heard)
                       and any(can_id == 0x650 and data[0] & 3 == 2 for can_id, data in heard)):
                assert time.monotonic() < end, heard
                bus.send(can.Message(arbitration_id=0x210, is_extended_id=False, data=payload))
                if (message := bus.recv(0.05)) is not None:
                    heard.append((message.arbitration_id, bytes(message.data)))

    patient_tool(unit.parent)
    beside_run(unit, body)
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "tractor-7 of fleet"
    assert out[1] == ("  bus implement: virtual test_run (flaming_tool.dbc); only this process hears it, "
                      "udp_multicast reaches others")
    assert re.match(r"  \d+ alarms; repairs armed: PilotFlameOut; passive: FlamingStartStopFailure, ", out[2])
    told = re.fullmatch(rf"boot (\d+), journal {re.escape(str(unit.parent / 'journal.db'))}; supervising", out[3])
    assert told
    assert "Z  PilotFlameOut                raised         high: " in out[4] and "PilotFlame Off" in out[4]
    assert "attempt 1, sends FLAMER_CMD" in out[5]
    assert "stopped" in out
    stored = read_events(unit.parent / "journal.db")
    assert [(event.unit, event.boot, event.seq, event.event) for event in stored][:2] == [
        ("tractor-7", int(told[1]), 1, "raised"), ("tractor-7", int(told[1]), 2, "repair_started")]
    assert main(["journal", str(unit), "--monitor", "implement"]) == 0
    assert "  implement  Flaming=On" in capsys.readouterr().out


def test_ctrl_c_ends_it_with_0_and_the_next_start_is_a_new_boot(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGINT)

    def press() -> None:
        while signal.getsignal(signal.SIGINT) is before:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)
    boots = []
    for _ in range(2):
        threading.Thread(target=press, daemon=True).start()
        assert main(["run", str(unit)]) == 0
        told = re.search(r"boot (\d+), journal", capsys.readouterr().out)
        assert told
        boots.append(int(told[1]))
    assert boots[1] > boots[0] > 1_700_000_000, "the wall clock: a unit that lost its card does not begin at 1 again"


def test_check_only_looks(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(unit), "--check"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{unit}: good"
    assert not (unit.parent / "journal.db").exists()


@pytest.mark.parametrize(("old", "new", "code", "error"), [
    ('["PilotFlameOut"]', '["PilotFlameOot"]', 2,
     'repairs.armed[0]: no alarm is called "PilotFlameOot"; did you mean "PilotFlameOut"?'),
    ('"virtual"', '"virtuell"', 2, 'bus implement: no interface is called "virtuell"; did you mean "virtual"?'),
    ("[journal]\npath", "[journal]\npaht", 2, 'journal.paht: unknown key; did you mean "path"?'),
    ('[journal]\npath = "journal.db"', "", 2, 'journal: missing; add [journal] with path = "journal.db"'),
    ('"journal.db"', '"/proc/nowhere/journal.db"', 2, "journal /proc/nowhere/journal.db: "),
    ('"flaming_tool.dbc"', '"flaming_tol.dbc"', 1, "flaming_tol.dbc: error: no such file"),
])
def test_every_obstacle_is_one_line(
        unit: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, code: int, error: str) -> None:
    assert old in UNIT
    unit.write_text(UNIT.replace(old, new))
    if "/proc/" not in new:
        assert main(["run", str(unit), "--check"]) == code, "found before anything is opened"
        assert error in capsys.readouterr().err.splitlines()[0]
    assert main(["run", str(unit)]) == code
    captured = capsys.readouterr()
    assert error in captured.err.splitlines()[0] and "Traceback" not in captured.err and captured.out == ""


@pytest.mark.fault("journal corrupt at the start")
def test_a_lock_out_survives_a_journal_of_which_only_events_could_be_saved(tmp_path: Path) -> None:
    path = tmp_path / "journal.db"
    with Journal(path, "tractor-7") as journal:
        journal.append([Event("tractor-7", 1, seq, seconds(seq), None, False, alarm, 3101, "High", word, 1, 3, {}, "")
                        for seq, (alarm, word) in enumerate([("Igniter", "locked_out"), ("PilotFlameOut", "locked_out"),
                                                             ("Igniter", "cleared")], 1)], b"{}")
    path.write_bytes(b"not a database at all" + path.read_bytes()[21:])
    with Journal(path, "tractor-7") as journal:
        assert journal.restored_state() is None
        state = restored(journal, lambda text: None)
        supervisor = Supervisor(load(["flaming_tool.dbc"]), unit="tractor-7", boot=2, start_ns=0, restored=state)
        supervisor.tick(1)
    assert supervisor.alarm_states()["PilotFlameOut"] == LOCKED_OUT
    assert [memory.name for memory in state.alarms] == ["PilotFlameOut"] if state else False


def forget(path: Path) -> None:
    path.unlink()


def spoil(path: Path) -> None:
    path.write_bytes(b"not a database at all" + path.read_bytes()[21:])


def lose_the_state(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("DELETE FROM state")
    connection.close()


@pytest.mark.fault("journal that gives no state back",
                   "the unit begins as stopped, stays so over restarts, and is resumed at the machine only; told, and an alarm")
@pytest.mark.parametrize("harm", [forget, spoil, lose_the_state])
def test_a_unit_whose_journal_gives_no_state_back_begins_as_stopped(tmp_path: Path, harm: Callable[[Path], None]) -> None:
    path = tmp_path / "journal.db"
    notices: list[str] = []
    with Journal(path, "tractor-7") as journal:
        journal.append((), encode_state(State("stopped", ())))
    harm(path)
    for _ in range(2):
        with Journal(path, "tractor-7") as journal:
            state = restored(journal, notices.append)
            assert state is not None and state.mode == "stopped"
    assert len(notices) == 1 and "begins as stopped" in notices[0], "the second time the journal says so itself"
    unit = Supervisor(load(["flaming_tool.dbc"]), unit="tractor-7", boot=3, start_ns=0, restored=state)
    unit.tick(0)
    repair = unit.catalog.alarms["PilotFlameOut"].repair
    assert repair and unit.forbidden(repair) == "the unit is stopped"
    for order, mode in ((Order("c-1", "resume"), "stopped"), (Order("c-2", "resume", origin="local"), "running")):
        unit.command(order, 1)
        assert unit.mode == mode


def test_the_journal_tells_why_it_gives_no_state_back(tmp_path: Path) -> None:
    for harm, why in ((forget, "was gone"), (spoil, "was corrupt")):
        path = tmp_path / harm.__name__ / "journal.db"
        with Journal(path, "tractor-7") as journal:
            journal.append((), b"{}")
        harm(path)
        with Journal(path, "tractor-7") as journal:
            assert journal.state_lost and len(journal.incidents) == 1 and why in journal.incidents[0]


def test_a_new_unit_begins_as_running(tmp_path: Path) -> None:
    notices: list[str] = []
    for _ in range(2):
        with Journal(tmp_path / "journal.db", "tractor-7") as journal:
            assert not journal.state_lost
            state = restored(journal, notices.append)
            assert state is None or state.mode == "running"
    assert state is not None and notices == []


READ_ONLY = """
    import subprocess, sys
    from pathlib import Path
    import can
    from level1.io.definitions import load
    from level1.io.inquiry import Silence
    from level1.io.journal import read_events
    from ucs.standing import ask_run
    from ucs.tests.running import awaited, beside_run
    from ucs.tests.units import unit_toml
    folder = Path(sys.argv[1])
    unit = folder / "unit.toml"
    unit.write_text(unit_toml("ucs.dbc", "flaming_tool.dbc", interface="virtual", channel="read-only"))
    remount = lambda how: subprocess.run(["mount", "-o", f"remount,{how}", str(folder)], check=True)
    beside_run(unit, lambda journal: awaited(journal))
    remount("ro")

    def told(journal):
        return [(event.alarm, event.event) for event in read_events(journal)]

    def body(journal):
        alarms = load(["ucs.dbc"]).messages["UCS_ALARMS"]
        place = alarms.signal("JournalFault").start
        with can.Bus("read-only", interface="virtual") as bus:
            while not ((message := bus.recv(60)).arbitration_id == alarms.can_id
                       and int.from_bytes(message.data, "little") >> place & 3):
                pass
        assert ask_run(journal) is Silence.CUT_OFF
        remount("rw")
        awaited(journal, lambda run: ("JournalFault", "raised") in told(journal) and not run.journal_waiting)
    beside_run(unit, body)
"""


@pytest.mark.fault("disk read-only")
def test_a_unit_on_a_read_only_disk_supervises_raises_an_alarm_and_can_be_asked_once_it_is_mended(tmp_path: Path) -> None:
    printed = on_small_disk(READ_ONLY, tmp_path / "disk")
    assert "JournalFault                 raised" in printed


def test_a_unit_on_a_broken_disk_that_gives_no_state_begins_as_stopped(tmp_path: Path) -> None:
    script = """
        import subprocess, sys
        from pathlib import Path
        from level1.io.journal import Journal
        from ucs.run import restored
        folder = Path(sys.argv[1])
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        with Journal(folder / "journal.db", "tractor-7") as journal:
            print(restored(journal, lambda text: None).mode)
    """
    assert on_small_disk(script, tmp_path / "disk") == "stopped\n"
