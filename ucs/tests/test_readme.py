"""The example of the README does what the README says."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from level1.event import decode

README = (Path(__file__).parents[2] / "README.md").read_text()
BLOCKS = [block.partition("\n")[2] for block in README.split("```")[1::2]]
DBC = next(block for block in BLOCKS if block.startswith("VERSION"))
COMMANDS = next(block for block in BLOCKS if "ucs replay field.log" in block)
PRINTED = BLOCKS[BLOCKS.index(COMMANDS) + 1]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the reader has typed the example, with a `ucs` on the path."""
    (tmp_path / "seeder.dbc").write_text(DBC)
    (tmp_path / "ucs").write_text(f'#!/bin/sh\nexec {sys.executable} -m ucs "$@"\n')
    (tmp_path / "ucs").chmod(0o755)
    return tmp_path


def shell(script: str, folder: Path) -> str:
    result = subprocess.run(["bash", "-euc", f'PATH="$PWD:$PATH"\n{script}'], cwd=folder, capture_output=True, text=True,
                            env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(Path(__file__).parents[2])}, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_example_prints_what_the_readme_says(folder: Path) -> None:
    output = shell(COMMANDS, folder)
    assert "1 alarm, 0 errors, 0 warnings" in output
    assert PRINTED in output


def test_the_example_gives_the_same_event_each_time(folder: Path) -> None:
    shell(COMMANDS, folder)
    for number in (1, 2):
        shell(f"ucs replay field.log --dbc seeder.dbc --events {number}.jsonl", folder)
    first = (folder / "1.jsonl").read_bytes()
    event, = map(decode, first.splitlines())
    assert (event.alarm, event.event, str(event.t)) == ("HopperEmpty", "raised", "10.500000000")
    assert (folder / "2.jsonl").read_bytes() == first
