"""`ucs replay`: exact times, the same bytes each time, and clear words about what a recording lacks."""
from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from level1.decode import encode
from level1.event import decode
from level1.io import replay as recordings
from level1.io.definitions import load
from ucs.main import main

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "jd5055e-tractor"
START_S = 1_700_000_000

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def replay(capsysbinary: pytest.CaptureFixture[bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs `ucs replay`: exit code, standard output, standard error."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def run(*words: Any) -> tuple[int, str, str]:
        code = main(["replay", *map(str, words)])
        captured = capsysbinary.readouterr()
        return code, captured.out.decode(), captured.err.decode()

    return run


@pytest.fixture(scope="module")
def flame_lost(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flaming tool whose pilot flame goes out at 2 s and that is Ready from 5 s on, but never lights again. 424 frames."""
    messages = load(["flaming_tool.dbc"]).messages
    command = encode(messages["FLAMER_CMD"], {"Flaming": 1, "GasValve": 1}, None).hex().upper()
    lines = []
    for step in range(400):
        burning, ready = step < 20, step >= 50
        raws = {"Flaming": 1, "PilotFlame": burning, "GasValve": burning, "GasValveDemand": burning, "AliveCounter": step % 16,
                "Safeguard": 3 if burning else 1 if ready else 4, "PilotCurrent": 50 if burning else 0}
        payload = encode(messages["FLAMER_STATUS"], {name: int(value) for name, value in raws.items()}, None)
        stamp = f"({START_S + step // 10}.{step % 10}00000)"
        lines.append(f"{stamp} can0 210#{payload.hex().upper()}\n")
        if step < 24:  # the mission controller leaves the command to the repair
            lines.append(f"{stamp} can0 110#{command}\n")
    file = tmp_path_factory.mktemp("logs") / "flame_lost.log"
    file.write_text("".join(lines))
    return file


def events(text: str) -> list[tuple[float, str, str]]:
    """Time since the start, alarm and event of each line of JSON."""
    return [(float(event.t - START_S), event.alarm, event.event) for event in map(decode, text.splitlines())]


def test_delays_and_repairs_run_in_the_time_of_the_log(replay: Run, flame_lost: Path) -> None:
    code, out, err = replay(flame_lost, "--dbc", "flaming_tool.dbc", "--events", "-")
    assert code == 0
    assert [event for event in events(out) if event[1] == "PilotFlameOut"] == [
        (2.3, "PilotFlameOut", "raised"), (2.3, "PilotFlameOut", "repair_started"),
        (35.3, "PilotFlameOut", "repair_failed"), (35.3, "PilotFlameOut", "repair_started")]
    assert "PilotFlameOut                1 × raised, 2 × repair started, 1 × repair failed; at the end Repairing" in err


def test_an_event_is_one_object_with_the_keys_in_order(replay: Run, flame_lost: Path) -> None:
    _, out, _ = replay(flame_lost, "--dbc", "flaming_tool.dbc", "--events", "-")
    raised, started, *_ = out.splitlines()
    assert list(json.loads(raised)) == ("unit boot seq t utc utc_trusted alarm code priority event instance attempt values "
                                        "text").split()
    assert '"t":1700000002.300000000,"utc":"2023-11-14T22:13:22.300000Z","utc_trusted":false' in raised
    assert {"FLAMER_STATUS.Flaming": "On", "FLAMER_STATUS.PilotFlame": "Off"}.items() <= json.loads(raised)["values"].items()
    assert [frame["message"] for frame in json.loads(started)["frames"]] == ["FLAMER_CMD"] * 3


def test_two_replays_give_the_same_bytes(replay: Run, flame_lost: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.log"
    again.write_bytes(flame_lost.read_bytes())
    for name in ("a", "b"):
        assert replay(flame_lost, again, "--dbc", "flaming_tool.dbc", "--events", tmp_path / name)[0] == 0
    content = (tmp_path / "a").read_bytes()
    assert content == (tmp_path / "b").read_bytes()
    half = content[:len(content) // 2]
    assert content == half * 2, "each recording is a run of its own"


def test_people_read_times_since_the_start(replay: Run, flame_lost: Path) -> None:
    code, out, _ = replay(flame_lost, "--dbc", "flaming_tool.dbc")
    lines = out.splitlines()
    assert lines[0] == str(flame_lost)
    assert lines[1].startswith("     2.300 s  PilotFlameOut                raised         high: ")
    assert "PilotFlame Off" in lines[1]
    assert "attempt 1, sends FLAMER_CMD" in lines[2]
    assert any(line.startswith("  424 frames, 39.900 s of recording in ") for line in lines)


def test_a_unit_toml_says_what_is_armed_and_which_files(replay: Run, flame_lost: Path, tmp_path: Path) -> None:
    unit = tmp_path / "unit.toml"
    unit.write_text('[unit]\nname = "a"\n[[bus]]\nname = "implement"\nchannel = "can7"\ndbc = ["flaming_tool.dbc"]\n')
    code, out, err = replay(flame_lost, "--unit-toml", unit, "--events", "-")
    assert code == 0
    passive = [json.loads(line) for line in out.splitlines() if '"repair_started"' in line]
    assert [event.get("passive") for event in passive] == [True] and "not armed, would send FLAMER_CMD" in err
    unit.write_text(unit.read_text() + '[repairs]\narmed = ["PilotFlameOot"]\n')
    assert replay(flame_lost, "--unit-toml", unit) == (
        2, "", f'ucs: {unit}: repairs.armed[0]: no alarm is called "PilotFlameOot"; did you mean "PilotFlameOut"?\n')


def test_a_channel_can_be_chosen(replay: Run, flame_lost: Path, tmp_path: Path) -> None:
    two = tmp_path / "two.log"
    healthy = flame_lost.read_text().splitlines()[:2] * 212
    two.write_text("".join(f"{line}\n{other.replace('can0', 'can1')}\n" for line, other in
                           zip(flame_lost.read_text().splitlines(), healthy, strict=True)))
    dbc = ("--dbc", "flaming_tool.dbc", "--events", "-")
    assert (2.3, "PilotFlameOut", "raised") in events(replay(two, *dbc, "--bus", "can0=0")[1])
    assert (2.3, "PilotFlameOut", "raised") not in events(replay(two, *dbc, "--bus", "can1=0")[1])
    assert "no frame of a channel can5; its channels: can0, can1" in replay(two, *dbc, "--bus", "can5=0")[2]


def test_unreadable_lines_are_told_and_the_rest_counts(replay: Run, flame_lost: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.log"
    lines = flame_lost.read_text().splitlines()
    broken.write_text("\n".join([*lines[:16], "(1700000001.7", "junk", *lines[16:]]))
    code, out, err = replay(broken, "--dbc", "flaming_tool.dbc")
    assert code == 0 and "424 frames" in out
    assert err == f"ucs: {broken}: unreadable line 17: not candump text; 2 lines skipped in all\n"


def test_a_recording_of_another_machine_says_so(replay: Run, flame_lost: Path) -> None:
    code, out, err = replay(flame_lost, "--dbc", "isobus_tractor.dbc")
    assert code == 0 and "no alarm" in out
    assert err == (f"ucs: {flame_lost}: none of the 2 ids in this recording (110, 210) is in these definitions, "
                   "which have ids of 29 bits where the recording has 11; give the DBC files of the machine that was recorded\n")


def test_stamps_that_ran_backwards_are_told(replay: Run, tmp_path: Path) -> None:
    file = tmp_path / "backwards.log"
    file.write_text("(5.000000) can0 210#00\n(4.000000) can0 210#00\n")
    assert "1 time stamps ran backwards" in replay(file, "--dbc", "flaming_tool.dbc")[2]


def test_one_recording_that_fails_does_not_stop_the_others(replay: Run, flame_lost: Path) -> None:
    code, out, err = replay("/nowhere.log", flame_lost, "--dbc", "flaming_tool.dbc")
    assert code == 2 and err == "ucs: /nowhere.log: no such file\n" and "PilotFlameOut" in out


@pytest.mark.parametrize(("words", "code", "error"), [
    (("a.log",), 2, "ucs: no definitions: give --dbc FILE …, or --unit-toml FILE\n"),
    (("a.log", "--dbc", "flaming_tool.dbc", "--events", "/nowhere/x"), 2, "ucs: /nowhere/x: there is no folder /nowhere\n"),
    (("a.log", "--unit-toml", "/nowhere.toml"), 2, "ucs: /nowhere.toml: no such file; give the path of a unit.toml\n"),
])
def test_what_is_missing_is_one_line(replay: Run, words: tuple[str, ...], code: int, error: str) -> None:
    assert replay(*words) == (code, "", error)


def test_definitions_that_do_not_load_are_told_and_1(replay: Run) -> None:
    code, _, err = replay("a.log", "--dbc", "nowhere.dbc")
    assert code == 1 and err.startswith("nowhere.dbc: error: no such file")


@pytest.mark.parametrize(("name", "alarms"), [
    ("LeftSensorUnplugged-CheckEngine-1of3.log", {"OilPressureSensorFault"}), ("noStartInGear1.log", {"TransmissionFault"}),
    ("startUp.log", set()), ("idling.log", set()), ("acc_light_toggle.log", set())])
def test_real_tractor_recordings_raise_what_was_wrong_and_nothing_else(replay: Run, name: str, alarms: set[str]) -> None:
    if not (DATA / name).exists():
        pytest.skip("the shared recordings are not on this machine")
    code, out, _ = replay(DATA / name, "--dbc", "isobus_tractor.dbc", "--events", "-")
    assert code == 0
    raised = {event.alarm for event in map(decode, out.splitlines()) if event.event == "raised"}
    assert raised >= alarms and bool(raised) == bool(alarms)


def test_every_line_is_an_event(replay: Run, flame_lost: Path) -> None:
    _, out, _ = replay(flame_lost, "--dbc", "flaming_tool.dbc", "--events", "-")
    assert all(decode(line).unit == "replay" and msgspec.json.decode(line)["boot"] == 1 for line in out.splitlines())


def season_of(path: Path, times: int) -> str:
    """a recording so many times in a row, a minute apart, with every fifth line damaged in the last of them."""
    lines = []
    for number in range(times):
        for place, line in enumerate(path.read_text().splitlines()):
            seconds, rest = line[1:].split(".", 1)
            lines.append(f"({int(seconds) + 60 * number}.{rest if place % 5 or number < times - 1 else rest[:-3]}\n")
    return "".join(lines)


def test_blocks_and_single_frames_give_the_same_bytes(replay: Run, flame_lost: Path, tmp_path: Path,
                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    """In one file, in several merged, and in many: what `--scalar` gives."""
    log, other = tmp_path / "long.log", tmp_path / "other.log"
    log.write_text(season_of(flame_lost, 4))
    other.write_text("".join(f"({START_S + n / 10:.6f}) can0 18FEF1{n % 3:02X}#{n:016X}\n" for n in range(2000)))
    monkeypatch.setattr(recordings, "LONG_BYTES", 1000)
    told = {}
    for way in ("blocks", "--scalar"):
        for kind, files in (("one", [log]), ("merged", [other, log, "--merge"]), ("season", [log, other])):
            monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / way))
            out = tmp_path / f"{way}{kind}"
            code, _, remarks = replay(*files, "--dbc", "flaming_tool.dbc", "ucs.dbc", "--events", out, "--jobs", 1,
                                      *([way] if way.startswith("--") else []))
            told[way, kind] = code, out.read_bytes(), remarks
    for kind in ("one", "merged", "season"):
        assert told["blocks", kind] == told["--scalar", kind]
        assert told["blocks", kind][1].count(b'"raised"') >= 4 and "lines skipped" in told["blocks", kind][2]
