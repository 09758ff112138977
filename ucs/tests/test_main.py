"""The command line: what it lists, how it starts, and that a mistake is one line."""
from __future__ import annotations

import os
import signal
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from level1.catalog import DefinitionError, Problem
from level1.io.error import OutsideError
from ucs import main as command


def run(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "ucs", *words], capture_output=True, text=True, timeout=60,
                          check=False, **options)


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Namespace], int]], None]:
    """Puts a command `given` in the table whose `run` is the function."""

    def install(function: Callable[[Namespace], int]) -> None:
        module = ModuleType("ucs_given")
        module.add_parser = lambda commands: commands.add_parser("given").add_argument("word", nargs="?")  # type: ignore[attr-defined]
        module.run = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "ucs_given", module)
        monkeypatch.setitem(command.COMMANDS, "given", command.Command("ucs_given", "a test"))

    return install


def test_help_lists_every_command_in_one_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main(["--help"])
    assert ended.value.code == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    for name, entry in command.COMMANDS.items():
        assert [name, *entry.help.split()] in lines


def test_help_imports_no_subcommand() -> None:
    code = "import sys; from ucs.main import build_parser; build_parser(None).format_help(); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"can", "cantools", "numpy", "msgspec"} & set(loaded)
    assert not [name for name in loaded if name.startswith("ucs.") and name != "ucs.main"]


@pytest.mark.parametrize("name", command.COMMANDS)
def test_every_command_has_its_own_help(name: str) -> None:
    result = run(name, "--help")
    assert result.returncode == 0 and result.stdout.startswith(f"usage: ucs {name}") and not result.stderr


def test_both_ways_to_start_it_and_the_version() -> None:
    assert run("--version").stdout.startswith("ucs ")
    other = subprocess.run([sys.executable, "-m", "ucs.main", "--version"], capture_output=True, text=True, check=True)
    assert other.stdout == run("--version").stdout


def test_an_unknown_command_is_one_line_with_the_nearest() -> None:
    result = run("repaly")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == 'ucs: no command is called "repaly"; did you mean "replay"?\n'


def test_no_command_shows_the_help_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([]) == 2
    assert "usage: ucs" in capsys.readouterr().err


def test_a_wrong_argument_is_one_line(given: Any, capsys: pytest.CaptureFixture[str]) -> None:
    given(lambda args: 0)
    with pytest.raises(SystemExit) as ended:
        command.main(["given", "--speed"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "ucs: unrecognized arguments: --speed (see ucs given --help)\n"


def test_the_exit_code_is_the_commands(given: Any) -> None:
    given(lambda args: 7)
    assert command.main(["given"]) == 7


def test_what_the_user_can_put_right_is_one_line_each_and_2(given: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(args: Namespace) -> int:
        raise OutsideError("unit.toml: unit.name: missing", "unit.toml: bus: missing")

    given(fail)
    assert command.main(["given"]) == 2
    assert capsys.readouterr().err == "ucs: unit.toml: unit.name: missing\nucs: unit.toml: bus: missing\n"


def test_a_file_that_cannot_be_opened_is_one_line_and_2(given: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(args: Namespace) -> int:
        with open("/nowhere/at/all"):
            return 0

    given(fail)
    assert command.main(["given"]) == 2
    assert capsys.readouterr().err == "ucs: /nowhere/at/all: there is no folder /nowhere/at\n"


def test_a_full_disk_is_one_line_and_2(given: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(args: Namespace) -> int:
        with open("/dev/full", "w") as file:
            file.write("x")
        return 0

    given(fail)
    assert command.main(["given"]) == 2
    assert capsys.readouterr().err == ("ucs: the disk is full, and what was being written is not whole; make room, then run it "
                                       "again\n")


def test_a_command_by_another_name_is_answered_with_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["handbook"]) == 2
    assert "it is `ucs alarms FILE.dbc --handbook handbook.html`" in capsys.readouterr().err


def test_wrong_definitions_print_all_problems_and_1(given: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(args: Namespace) -> int:
        raise DefinitionError((Problem("a.dbc", 3, "M.S", "AlarmWhen", 0, "error", "bad"),
                               Problem("b.dbc", 4, "M.T", "", 0, "warning", "odd")))

    given(fail)
    assert command.main(["given"]) == 1
    assert capsys.readouterr().err == "a.dbc:3: error: M.S AlarmWhen: bad\nb.dbc:4: warning: M.T: odd\n"


def test_ctrl_c_is_clean(given: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(args: Namespace) -> int:
        raise KeyboardInterrupt

    given(stop)
    assert command.main(["given"]) == 130
    assert capsys.readouterr().err == "ucs: stopped by Ctrl-C\n"


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = ("import sys, types\nfrom ucs import main\nm = types.ModuleType('m')\n"
            "m.add_parser = lambda c: c.add_parser('m')\n"
            "def run(args):\n  while True: print('x' * 1000)\n"
            "m.run = run\nsys.modules['m'] = m\nmain.COMMANDS['m'] = main.Command('m', '')\nsys.exit(main.main(['m']))")
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          env={**os.environ, "PYTHONUNBUFFERED": ""}) as process:
        assert process.stdout and process.stderr
        process.stdout.read(10)
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(30) == 128 + signal.SIGPIPE
