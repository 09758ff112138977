"""`ucs monitor`: what it shows of a unit, a bus and a recording; the terminal it leaves as it was; that it can't send."""
from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from contextlib import ExitStack
from pathlib import Path

import can
import msgspec
import pytest
from rich.cells import cell_len

from level1.catalog import Catalog
from level1.decode import encode
from level1.frame import Frame
from level1.io.config import load as load_config
from level1.io.definitions import load
from ucs.main import main
from ucs.monitor import Listening, Monitor, Unit, pressed
from ucs.pages import PAGES, Sight, View, screen, whole_page
from ucs.standing import AlarmStanding, BusStanding, RepairStanding
from ucs.terminal import harmless, keys_of, painted, plain
from ucs.tests.running import WAIT_S, awaited, beside_run, flaming_unit, patient_tool
from ucs.watching import Heard, Watching, silent

MS = 1_000_000
SEEDER = """VERSION ""
BU_: UCS SEEDER
BO_ 640 SEEDER_STATUS: 2 SEEDER
 SG_ Sowing : 0|2@1+ (1,0) [0|1] "" UCS
 SG_ HopperLevel : 8|8@1+ (0.5,0) [0|100] "%" UCS
BO_ 641 SEEDER_SELDOM: 1 SEEDER
 SG_ Boxes : 0|8@1+ (1,0) [0|255] "" UCS
BO_ 1680 SEEDER_ALARMS: 1 UCS
 SG_ HopperEmpty : 0|2@1+ (1,0) [0|3] "" SEEDER
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_ "GenMsgCycleTime" BO_ 640 100;
BA_ "GenMsgCycleTime" BO_ 1680 1000;
BA_ "AlarmCode" SG_ 1680 HopperEmpty 5001;
BA_ "AlarmWhen" SG_ 1680 HopperEmpty "Sowing == On and HopperLevel < 5";
VAL_ 640 Sowing 0 "Off" 1 "On";
VAL_ 1680 HopperEmpty 0 "Normal" 1 "Active" 2 "Repairing" 3 "LockedOut";
"""


@pytest.fixture(scope="module")
def seeder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("definitions") / "seeder.dbc"
    file.write_text(SEEDER)
    return file


@pytest.fixture(scope="module")
def catalog(seeder: Path) -> Catalog:
    return load([seeder])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    file = tmp_path / "field.log"
    file.write_text("".join(f"({100 + n / 10:.6f}) can0 280#0109\n({100 + n / 10:.6f}) can0 123#AA\n" for n in range(40)))
    return file


def watching(catalog: Catalog, until_ms: int, now_ms: int, every_ms: int = 100) -> Watching:
    found = Watching(catalog, "field", 0)
    for t_ms in range(0, until_ms, every_ms):
        found.take([Frame(t_ms * MS, 0x280, b"\x01\x09"), Frame(t_ms * MS, 0x123, b"\xaa")], t_ms * MS)
    found.take([], now_ms * MS)
    return found


def status_of(found: Watching, now_ms: int) -> Heard:
    return next(message for message in found.messages(now_ms * MS) if message.name == "SEEDER_STATUS")


def test_rate_cycle_age_value_and_unit_of_a_message(catalog: Catalog) -> None:
    message = status_of(watching(catalog, 2000, 1950), 1950)
    assert (message.ident, message.cycle_s, message.age_s, message.state) == ("280", 0.1, 0.05, "ok")
    assert message.hz == pytest.approx(10.0)
    assert [(value.name, value.text, value.unit, value.quality) for value in message.values] == [
        ("Sowing", "On", "", "good"), ("HopperLevel", "4.5", "%", "good")]


def test_a_message_that_falls_silent_is_named_and_its_rate_is_0(catalog: Catalog) -> None:
    found = watching(catalog, 2000, 5000)
    message = status_of(found, 5000)
    assert (message.state, message.hz) == ("silent", 0.0) and {value.quality for value in message.values} == {"stale"}
    assert silent(found.messages(5000 * MS), {0: "can0"}) == ["SEEDER_STATUS"]
    assert silent(found.messages(5000 * MS), {0: "front", 1: "rear"}) == ["SEEDER_STATUS (front)"]


@pytest.mark.parametrize(("every_ms", "state"), [(100, "ok"), (150, "slow"), (50, "fast")])
def test_a_rate_beside_the_nominal_cycle_is_remarked(catalog: Catalog, every_ms: int, state: str) -> None:
    assert status_of(watching(catalog, 3000, 3000, every_ms), 3000).state == state


def test_what_never_came_and_what_nobody_defines(catalog: Catalog) -> None:
    found = watching(catalog, 1000, 1000)
    assert {message.state for message in found.messages(1000 * MS) if message.name == "SEEDER_SELDOM"} == {"never"}
    assert [(stranger.ident, stranger.data) for stranger in found.strangers(1000 * MS)] == [("123", b"\xaa")]


def test_alarms_as_they_look_from_here(catalog: Catalog) -> None:
    alarm, = watching(catalog, 1000, 2500).alarms(2500 * MS)
    assert (alarm.name, alarm.state, alarm.age_s) == ("HopperEmpty", "Active", 2.5)


def test_the_state_of_an_alarm_is_a_word_though_its_file_has_no_value_table_for_it(tmp_path: Path) -> None:
    file = tmp_path / "seeder.dbc"
    file.write_text("\n".join(line for line in SEEDER.splitlines() if not line.startswith("VAL_ 1680")))
    found = Watching(load([file]), "field", 0)
    found.take([Frame(0, 0x690, b"\x03")], 0)
    message = next(message for message in found.messages(0) if message.name == "SEEDER_ALARMS")
    assert [(value.name, value.text) for value in message.values] == [("HopperEmpty", "LockedOut")]


# --- attached to a run ------------------------------------------------------------------------------------------------------


def test_attached_it_shows_the_repair_of_the_run_beside_the_signals_and_sends_nothing(tmp_path: Path) -> None:
    unit = tmp_path / "unit.toml"
    unit.write_text(flaming_unit("test_monitor"))
    patient_tool(tmp_path)
    payload = encode(load(["flaming_tool.dbc"]).messages["FLAMER_STATUS"], {"Flaming": 1, "PilotFlame": 0, "Safeguard": 4}, None)
    shown: list[str] = []
    heard: list[int] = []

    def body(journal: Path) -> None:
        awaited(journal)
        settings = load_config(unit)
        with ExitStack() as stack, can.Bus("test_monitor", interface="virtual") as bus:
            listening = Listening(settings.bus, stack)
            attached = Unit(settings)
            stack.callback(attached.close)
            monitor = Monitor("tractor-7 of fleet", load((), settings.bus_files, settings.bus_names), listening, attached)
            task = bus.send_periodic(can.Message(arbitration_id=0x210, is_extended_id=False, data=payload), 0.03)
            stop = time.monotonic() + WAIT_S
            while not any("wait 30 s" in line for line in shown) and time.monotonic() < stop:
                time.sleep(0.02)
                monitor.drain()
                shown[:] = [plain(line) for line in screen(monitor.sight(), View(), 140, 45)[0]]
            shown.extend(plain(line) for line in whole_page(monitor.sight(), View(page="alarms"), 140))
            task.stop()
            heard.extend([listening.buses()[0].received, listening.buses()[0].sent])
    beside_run(unit, body)
    text = "\n".join(shown)
    assert "supervised for" in text and "armed: PilotFlameOut" in text
    assert "repair attempt 1 of 3, step 2 of 6" in text and " s left: wait 30 s" in text
    assert "FLAMER_STATUS" in text and "cycle 100 ms" in text and "repair started" in text
    assert heard[0] > 0 and heard[1] == 0


def test_what_can_send_is_not_within_its_reach() -> None:
    source = Path(sys.modules[Monitor.__module__].__file__ or "").read_text()
    assert ".send" not in source and "Player" not in source


# --- the pages --------------------------------------------------------------------------------------------------------------


def sight(catalog: Catalog) -> Sight:
    found = watching(catalog, 1000, 1000)
    alarm = AlarmStanding("PilotFlameOut", 3101, "High", "Repairing", "out \x1b[2J\n by wind", age_s=4.0,
                          repair=RepairStanding("running", 2, 2, 3, 2, 7, "wait 30 s", 12.4))
    bus = BusStanding("implement", "socketcan", "can0", "BusOff", 100, 3, quiet_s=4.0, counters={"lost": 2})
    many = [msgspec.structs.replace(alarm, name=f"Alarm{n}", priority="Low", state="Active", repair=None) for n in range(30)]
    return Sight("tractor-7 of fleet", "supervised for 1 s", [alarm, *many], list(found.messages(1000 * MS)), [bus],
                 found.strangers(1000 * MS), tuple(found.events), ["implement"], ["bus implement (can0) is off"], [], "12:00:00")


@pytest.mark.parametrize("size", [(80, 24), (140, 45), (40, 10), (20, 4), (5, 1)])
@pytest.mark.parametrize("page", PAGES)
def test_every_page_fits_every_terminal(catalog: Catalog, page: str, size: tuple[int, int]) -> None:
    for top in (0, 10, 10**9):
        lines, first = screen(sight(catalog), View(page=page, top=top), *size)
        assert len(lines) <= size[1] and first <= top
        assert all(cell_len(painted(line, size[0], False)) <= size[0] for line in lines)


def test_the_first_page_holds_alarm_repair_failed_bus_and_signals_at_80_by_24(catalog: Catalog) -> None:
    text = "\n".join(plain(line) for line in screen(sight(catalog), View(), 80, 24)[0])
    for told in ("PilotFlameOut", "High", "Repairing", "4.0 s", "attempt 2 of 3, step 2 of 7, 12.4 s left: wait 30 s",
                 "! bus implement (can0) is off", "SEEDER_STATUS", "10.0 Hz", "cycle 100 ms", "HopperLevel", "4.5 %", "q quit"):
        assert told in text, told


def test_the_filter_leaves_what_has_the_text_in_its_name(catalog: Catalog) -> None:
    text = "\n".join(plain(line) for line in screen(sight(catalog), View(page="signals", sought="hopperl"), 80, 24)[0])
    assert "HopperLevel" in text and "Sowing" not in text
    text = "\n".join(plain(line) for line in screen(sight(catalog), View(page="alarms", sought="pilot"), 80, 24)[0])
    assert "PilotFlameOut" in text and "Alarm1" not in text


def test_texts_of_files_cannot_steer_the_terminal(catalog: Catalog) -> None:
    drawn = [painted(line, 80, False) for line in screen(sight(catalog), View(), 80, 24)[0]]
    assert not any("\x1b" in line or "\n" in line for line in drawn) and harmless("a\x1b[2Jb") == "a·[2Jb"


def test_the_keys() -> None:
    assert list(keys_of("q\x1b[A\x1b[6~\t\x1b/x\x7f\x1b[1;5Cp")) == [
        "q", "up", "page down", "tab", "escape", "/", "x", "backspace", "p"]
    view = View()
    for key, change in (("tab", {"page": "alarms"}), ("4", {"page": "buses"}), ("p", {"paused": True}), ("/", {"typing": True}),
                        ("g", {"sought": "g"}), ("q", {"sought": "gq"}), ("backspace", {"sought": "g"}),
                        ("enter", {"typing": False}), ("down", {"top": 1}),
                        ("page down", {"top": 20}), ("home", {"top": 0}), ("escape", {"sought": ""})):
        changed = pressed(view, key, 24)
        assert changed is not None
        assert {name: getattr(changed, name) for name in change} == change
        view = changed
    assert pressed(view, "q", 24) is None


# --- the command ------------------------------------------------------------------------------------------------------------


def test_where_the_output_is_no_terminal_a_snapshot_is_printed(
        seeder: Path, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", str(recording), "--dbc", str(seeder), "--once", "200 ms", "--speed", "10"]) == 0
    out = capsys.readouterr().out
    assert "HopperEmpty" in out and "SEEDER_STATUS" in out and "\x1b" not in out
    assert "identifiers that no definition names: 1" in out


@pytest.mark.parametrize(("arguments", "told"), [
    ([], "what to watch?"), (["field.log"], "--dbc FILE: missing"), (["unit.toml", "--dbc", "a.dbc"], "leave it out"),
    (["unit.toml", "--bus", "can0"], "not two of them"), (["--interface", "virtual", "--dbc", "a.dbc"], "give its --channel too"),
    (["--bus", "can0", "--channel", "x", "--dbc", "a.dbc"], "not both"), (["nowhere.toml"], "no such file"),
    (["nowhere.log", "--dbc", "flaming_tool.dbc"], "nowhere.log: no such file"),
    (["--interface", "virtuell", "--channel", "x", "--dbc", "flaming_tool.dbc"], 'did you mean "virtual"?'),
])
def test_every_obstacle_is_one_line(capsys: pytest.CaptureFixture[str], arguments: list[str], told: str) -> None:
    assert main(["monitor", *arguments]) == 2
    out, err = capsys.readouterr()
    assert told in err and len(err.splitlines()) == 1 and out == ""


class Pseudo:
    """`ucs monitor` on a terminal of its own."""

    def __init__(self, *arguments: str):
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.before = termios.tcgetattr(slave)
        self.process = subprocess.Popen([sys.executable, "-m", "ucs", "monitor", *arguments], stdin=slave, stdout=slave,
                                        stderr=slave, start_new_session=True, env={**os.environ, "TERM": "xterm"})
        self.slave = slave
        self.seen = ""

    def until(self, text: str) -> None:
        stop = time.monotonic() + WAIT_S
        while text not in self.seen:
            assert time.monotonic() < stop, self.seen[-3000:]
            if select.select([self.master], [], [], 0.1)[0]:
                self.seen += os.read(self.master, 65536).decode(errors="replace")

    def press(self, keys: str) -> None:
        self.seen = ""
        os.write(self.master, keys.encode())

    def ended(self) -> int:
        self.until("\x1b[?1049l")
        code = self.process.wait(WAIT_S)
        assert termios.tcgetattr(self.slave) == self.before
        os.close(self.slave)
        os.close(self.master)
        return code


def test_in_a_terminal_pages_filter_and_pause_work_and_q_leaves_it_as_it_was(seeder: Path, recording: Path) -> None:
    shown = Pseudo(str(recording), "--dbc", str(seeder))
    shown.until("HopperLevel")
    assert "\x1b[?1049h" in shown.seen
    shown.press("4")
    shown.until("identifiers that no definition names")
    shown.press("3/sow")
    shown.until("/sow")
    shown.press("\rp")
    shown.until("PAUSED")
    shown.press("q")
    assert shown.ended() == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_and_leave_the_terminal_as_it_was(seeder: Path, recording: Path, number: int) -> None:
    shown = Pseudo(str(recording), "--dbc", str(seeder))
    shown.until("HopperLevel")
    shown.process.send_signal(number)
    assert shown.ended() == 0
