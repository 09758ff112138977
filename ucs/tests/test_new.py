"""The start file, and what other tools make of such files."""
from __future__ import annotations

from pathlib import Path

import cantools
import pytest

import dbc
from level1.catalog import Catalog
from level1.definitions import ATTRIBUTES
from level1.io.definitions import examine, load
from ucs import main

SHIPPED = sorted(dbc.path("ucs.dbc").parent.glob("*.dbc"))


def test_the_start_file_is_clean_and_defines_every_attribute(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.dbc"
    assert main.main(["new", str(path)]) == 0
    assert main.main(["check", "--strict", str(path)]) == 0
    assert "3 alarms, 0 errors, 0 warnings" in capsys.readouterr().out
    text = path.read_text()
    assert [name for name in ATTRIBUTES if f'"{name}"' not in text] == []


def test_an_existing_file_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.dbc"
    path.write_text("precious")
    assert main.main(["new", str(path)]) == 2
    assert path.read_text() == "precious" and "is there already" in capsys.readouterr().err
    assert main.main(["new", str(tmp_path / "mine.txt")]) == 2


def meaning(catalog: Catalog) -> object:
    """A catalog without the places in files where it was defined."""
    return (
        {name: (m.can_id, m.extended, m.length, sorted(m.signals, key=lambda s: s.name), set(m.senders), m.cycle_ns, m.pgn,
                m.source, m.monitor_as)
         for name, m in catalog.messages.items()},
        {name: (a.message, a.code, a.priority, a.when, a.until, a.enabled, a.on_delay_ns, a.off_delay_ns, a.latch,
                a.cause, a.consequence, a.action, a.spn, a.fmi, a.repair) for name, a in catalog.alarms.items()},
        catalog.commands)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_a_round_trip_through_another_tools_writer_keeps_everything(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / path.name
    database = cantools.database.load_file(path)
    copy.write_text(database.as_dbc_string(), encoding="cp1252", newline="")  # type: ignore[union-attr]
    assert meaning(load([copy])) == meaning(load([path]))
    assert [str(problem) for problem in examine([copy]).problems if problem.severity == "error"] == []
