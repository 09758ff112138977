"""Definitions from disk: found, read in a child with bounds, field files and hostile files alike."""
from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import dbc
from level1.catalog import DefinitionError
from level1.definitions import Source, build, decode
from level1.io import definitions
from level1.io.definitions import examine, load
from level1.tests.dbc_lines import alarm_lines, text
from level1.tests.mutations import mutated

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
FIELD = [SHARED / folder for folder in ("dbc-cantools", "dbc-eds-other", "canboat-nmea2000", "css-canedge-mf4")]
REFUSED = {"issue_199_extended.dbc": "Extended frame id 0x7fffffff is more than 29 bits in message DriverDoorStatus"}
"""What cantools ships in order to be refused; everything else of the field loads."""
HEAD = 'VERSION ""\nBS_:\nBU_: UCS\n'
ONE = HEAD + 'BO_ 1 A: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X\n'


@pytest.fixture
def tool(tmp_path: Path) -> Path:
    file = tmp_path / "tool.dbc"
    file.write_text(text(alarm_lines()))
    return file


def test_the_process_that_supervises_never_loads_the_parsers(tool: Path) -> None:
    code = (f"import sys; from level1.io.definitions import load; load([{str(tool)!r}]); "
            "print(*{'cantools', 'lark', 'textparser', 'level1.language', 'level1.definitions'} & set(sys.modules))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_files_are_loaded_by_path(tool: Path) -> None:
    catalog = load([tool])
    assert set(catalog.alarms) == {"FlameOut"} and catalog.files == (str(tool),) and catalog.buses == {}


def test_a_bare_name_means_a_shipped_file_unless_there_is_one_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "PilotFlameOut" in load(["flaming_tool.dbc"]).alarms
    (tmp_path / "flaming_tool.dbc").write_text(text(alarm_lines()))
    assert set(load(["flaming_tool.dbc"]).alarms) == {"FlameOut"}


def test_all_shipped_files_fit_together() -> None:
    found = examine(dbc.shipped())
    assert found.catalog is not None, "\n".join(map(str, found.problems))
    assert not found.problems


def test_files_are_bound_to_buses(tool: Path) -> None:
    catalog = examine((), {0: [tool], 1: ["ucs.dbc", tool]}).catalog
    assert catalog and catalog.buses["STATUS"] == (0, 1) and len(catalog.files) == 2
    assert set(catalog.buses.values()) == {(0, 1), (1,)}


def test_the_same_file_named_twice_is_read_once(tool: Path) -> None:
    assert load([tool, tool.parent / "." / tool.name]).files == (str(tool),)


def test_errors_are_raised_all_at_once(tmp_path: Path, tool: Path) -> None:
    tool.write_text(text(alarm_lines("Flam == Off"), alarm_lines("Presure < 1", 2, "PressureLow")))
    with pytest.raises(DefinitionError) as caught:
        load([tool, tmp_path / "none.dbc", tmp_path])
    messages = [problem.message for problem in caught.value.problems]
    assert messages == ["no such file", "is a folder, not a DBC file", "there is no signal `Flam`", "there is no signal `Presure`"]


def test_a_name_that_is_no_file_is_answered_with_one_that_is(tool: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tool.parent)
    hints = [examine([name]).problems[0].hint for name in
             ("tol.dbc", str(tool.parent / "tol.dbc"), "flaming_tol.dbc", "x/none.dbc")]
    assert [hint.partition("?")[0] for hint in hints] == ["did you mean `tool.dbc`"] * 2 + ["did you mean `flaming_tool.dbc`",
                                                                                           "check the path"]


def test_warnings_do_not_prevent_loading(tool: Path) -> None:
    tool.write_text(text(alarm_lines(AlarmOnDelay=50)))
    found = examine([tool])
    assert found.catalog and [problem.severity for problem in found.problems] == ["warning"]
    assert (found.messages, found.alarms) == (5, 1)


# -- hostile files ------------------------------------------------------------------------------------------------------


def multiplexed(signals: int, high: int) -> str:
    lines = [f' SG_ S{n} m0M : {8 * n + 8}|8@1+ (1,0) [0|0] "" X' for n in range(signals)]
    ranges = [f"SG_MUL_VAL_ 1 S{n} {f'S{n - 1}' if n else 'M'} 0-{high};" for n in range(signals)]
    return "\n".join([HEAD + "BO_ 1 A: 64 X", ' SG_ M M : 0|8@1+ (1,0) [0|0] "" X', *lines, *ranges, ""])


HOSTILE: dict[str, tuple[Callable[[], str | bytes], str]] = {
    "million bits": (lambda: 'BO_ 1 A: 8 X\n SG_ S : 0|1000000@1+ (1,0) [0|0] "" X\n', "1000000 bits from bit 0"),
    "more digits than any number": (lambda: f'BO_ 1 A: 8 X\n SG_ S : 0|{"9" * 30}@1+ (1,0) [0|0] "" X\n', "can't be read"),
    "comment of 20 MB": (lambda: ONE + 'CM_ "' + "x" * 20_000_000 + '";\n', "too large for a DBC file"),
    "comment of 9 MB": (lambda: ONE + 'CM_ "' + "x" * 9_000_000 + '";\n', "a text of 9000000 characters is too long"),
    "string without end": (lambda: ONE + 'CM_ "' + '\\"' * 1_000_000, "is too long"),
    "forty million multiplexer values": (lambda: multiplexed(1, 40_000_000), "layouts, too many"),
    "multiplexers in multiplexers": (lambda: multiplexed(7, 255), "layouts, too many"),
    "multiplexers in a circle": (lambda: multiplexed(2, 3).replace("S0 M ", "S0 S1 ").replace(" M M ", " M "), "in a circle"),
    "factor 0": (lambda: ONE.replace("(1,0)", "(0,0)"), "factor 0"),
    "identifier twice": (lambda: ONE + "BO_ 1 B: 8 X\n", "identifier 0x1 is used twice, first by A in line 4"),
    "binary junk": (lambda: bytes(range(256)) * 400, "is not a text file"),
    "nothing": (lambda: "", "holds no DBC statement"),
    "XML": (lambda: '<?xml version="1.0"?><NetworkDefinition/>', "is XML, not a DBC file"),
    "attribute of a billion digits": (lambda: ONE + 'BA_DEF_ "X" INT 0 1;\nBA_DEF_DEF_ "X" 1e999999999;\n', "out of any range"),
    "message of a gigabyte": (lambda: ONE.replace("A: 8 X", "A: 999999999 X"), "a message of 999999999 bytes is too long"),
    "a hundred thousand senders": (lambda: ONE + "BO_TX_BU_ 1 : " + ",".join(f"N{n}" for n in range(100_000)) + ";\n",
                                   "senders of one message are too many"),
    "a hundred thousand signals": (lambda: ONE + "".join(f' SG_ T{n} : 0|8@1+ (1,0) [0|0] "" X\n' for n in range(100_000)),
                                   "signals are too many"),
    "a hundred thousand heads": (lambda: HEAD + "SG_ A " * 100_000, "not a valid DBC file"),
    "ends inside a statement": (lambda: ONE + 'BA_DEF_ SG_ "X" INT', "the file ends inside a statement"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_ends_in_a_clear_line(name: str, tmp_path: Path) -> None:
    make, message = HOSTILE[name]
    content = make()
    file = tmp_path / "hostile.dbc"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = examine([file])
    assert found.catalog is None
    assert any(message in problem.message for problem in found.problems), "\n".join(map(str, found.problems))
    assert all(problem.file == str(file) and "\n" not in problem.message for problem in found.problems)


def test_a_hostile_file_does_not_hide_the_mistakes_of_another(tmp_path: Path, tool: Path) -> None:
    hostile = tmp_path / "wide.dbc"
    hostile.write_text('BO_ 1 A: 8 X\n SG_ S : 0|1000000@1+ (1,0) [0|0] "" X\n')
    tool.write_text(text(alarm_lines("Flam == Off")))
    assert [problem.file for problem in examine([hostile, tool]).problems] == [str(hostile), str(tool)]


def test_a_cp1252_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "degrees.dbc"
    file.write_bytes(ONE.replace('""', '"°C"').replace('VERSION "°C"', 'VERSION ""').encode("cp1252"))
    assert load([file]).messages["A"].signal("S").unit == "°C"


@pytest.mark.parametrize(("bound", "value", "message"), [
    ("MEMORY_LIMIT", 150_000_000, "takes more than 150 MB of memory"), ("CPU_BASE_S", 1, "takes more than 1 s of computing time"),
])
def test_a_reader_that_exceeds_its_bounds_is_ended_and_the_file_named(bound: str, value: int, message: str, tmp_path: Path,
                                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    """An honest file does it when the bounds are small enough."""
    monkeypatch.setattr(definitions, bound, value)
    monkeypatch.setattr(definitions, "CPU_BYTES_PER_S", 1_000_000_000)
    monkeypatch.setattr(definitions, "WALL_FACTOR", 600)
    signals = "\n".join(f' SG_ S{n} : {n % 8}|8@1+ (1,0) [0|0] "" X' for n in range(8))
    file = tmp_path / "large.dbc"
    file.write_text(HEAD + "".join(f"BO_ {1 << 31 | n} A{n}: 8 X\n{signals}\n" for n in range(8_000)))
    found = examine([file])
    assert [(problem.file, message in problem.message) for problem in found.problems] == [(str(file), True)]


# -- files of the field -------------------------------------------------------------------------------------------------


def field_files() -> list[Path]:
    return sorted(file for folder in FIELD if folder.is_dir() for file in folder.iterdir() if file.suffix.lower() == ".dbc")


@pytest.mark.skipif(not field_files(), reason="the recordings beside the repository are absent")
def test_files_of_the_field_load_or_are_refused_with_the_reason() -> None:
    found = {file.name: build([Source(file.name, decode(file.read_bytes()))]) for file in field_files()}
    refused = {name: [problem.message for problem in problems] for name, (catalog, problems) in found.items() if catalog is None}
    assert refused == {name: [message] for name, message in REFUSED.items()}


@pytest.mark.skipif(not field_files(), reason="the recordings beside the repository are absent")
def test_files_of_the_field_of_many_makers_load_through_the_child() -> None:
    files = [file for file in field_files() if file.name in ("canboat.dbc", "j1939.dbc", "opendbc__tesla_can.dbc")]
    found = examine(files)
    assert found.catalog and found.messages > 380 and len(found.catalog.files) == 3


# -- broken files -------------------------------------------------------------------------------------------------------

SMALL = (text(alarm_lines(AlarmUntil="Flame == On", RepairGiveUp="resend CMD", RepairAttempts=2, Repair=(
    "send CMD(Valve=Closed); wait 1 s; expect Flame == Off within 1 s"))), multiplexed(2, 3))
SEEDS = (*3 * SMALL, *(dbc.path(name).read_text(encoding="utf-8") for name in ("flaming_tool.dbc", "ucs.dbc")))
"""Whole files of hundreds of lines are one in four: a mutation hits much the same in a small one, in a twentieth of the time."""
BROKEN = int(os.environ.get("UCS_FUZZ", "400"))
"""How many broken files are tried; CI may want 10,000."""


def test_no_broken_file_escapes_as_an_exception() -> None:
    for number in range(BROKEN):
        source = Source("broken.dbc", mutated(SEEDS[number % len(SEEDS)], number))
        catalog, problems = build([source])
        assert (catalog is None) == any(problem.severity == "error" for problem in problems), number
        assert all(str(problem) for problem in problems)
