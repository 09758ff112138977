"""`ucs level2` and `ucs bridge`: what they print, how they end, what they say of mistakes."""
from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ucs.main import main

ROOT = Path(__file__).parents[2]
CONFIG = """
[unit]
name = "tractor-7"
fleet = "farm"
[[bus]]
name = "implement"
channel = "vcan0"
dbc = ["flaming_tool.dbc"]
"""


@pytest.mark.parametrize(("args", "told"), [
    (["--listen", "0.0.0.0:1883"], "listens on 127.0.0.1 only; run mosquitto"),
    (["--listen", "1883"], "write HOST:PORT"),
    (["--broker", "farm.local"], 'no MQTT address; write "mqtt://host:1883"'),
    (["--store", "/proc/level2.db"], "can't be used"),
])
def test_mistakes_of_level2_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], args: list[str], told: str) -> None:
    store = [] if "--store" in args else ["--store", str(tmp_path / "level2.db")]
    assert main(["level2", *store, *args]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


@pytest.mark.parametrize(("more", "told"), [
    ("", "journal: missing; write [journal] path"),
    ('[journal]\npath = "journal.db"\n', "bridge: missing; write [bridge] broker"),
    ('[journal]\npath = "journal.db"\n[bridge]\nbroker = "http://x"\n', "no MQTT address"),
    ('[journal]\npath = "/proc/journal.db"\n[bridge]\nbroker = "mqtt://x"\n', "can't be written"),
])
def test_mistakes_of_the_bridge_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], more: str, told: str) -> None:
    (tmp_path / "unit.toml").write_text(CONFIG + more)
    assert main(["bridge", str(tmp_path / "unit.toml")]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_level2_says_where_it_listens_and_ends_at_a_signal(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ucs", "level2", "--listen", "127.0.0.1:0", "--store", str(tmp_path / "level2.db")]
    level2 = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert level2.stderr
    assert "embedded broker on mqtt://127.0.0.1:" in level2.stderr.readline()
    assert "receiving all fleets from mqtt://127.0.0.1:" in level2.stderr.readline()
    level2.send_signal(signal.SIGTERM)
    assert (*level2.communicate(timeout=20), level2.returncode) == ("", "", 0)
