"""`ucs level2` and `ucs bridge`: what they print, how they end, what they say of mistakes."""
from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.broker import EmbeddedBroker
from bridge.link import RunLink
from bridge.session import BridgeThread, Settings
from level1.event import Monitor, Result, seconds
from level1.io.journal import Journal
from ucs.main import main
from ucs.tests.units import unit_toml

ROOT = Path(__file__).parents[2]
CONFIG = unit_toml("flaming_tool.dbc", fleet="farm", journal="")


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
    assert (*level2.communicate(timeout=60), level2.returncode) == ("", "", 0)


def test_a_site_is_made_and_how_to_use_it_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "unit.toml").write_text(CONFIG)
    site = tmp_path / "site"
    make = ["bridge", str(tmp_path / "unit.toml"), "--make-site", str(site), "--name", "tractor-8", "--host", "farm.local"]
    assert main(make) == 0
    told = capsys.readouterr().out
    assert f"mosquitto -c {tmp_path}/site/mosquitto.conf" in told
    assert "broker = \"mqtts://farm.local:8883\"" in told and f'key = "{tmp_path}/site/tractor-8-key.pem"' in told
    assert "ucs/v1/farm/%u/alarm" in (tmp_path / "site" / "acl").read_text()
    assert {"tractor-7.pem", "tractor-8.pem", "level2.pem", "broker.pem", "ca.pem"} <= {path.name for path in site.iterdir()}
    assert main(make) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["bridge"]) == 2
    assert "give the path of a unit.toml" in capsys.readouterr().err


# Commands


class Supervision:
    """Plays `ucs run`: says every tenth of a second that it is alive, obeys `pause`, refuses the rest."""

    def __init__(self, journal: Path):
        self.names: list[str] = []
        self._link = RunLink(journal)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.05):
            self._link.send_samples(Monitor("tractor-7", 1, seconds(time.monotonic_ns()), None, False, "motion", {}, {}, {}))
            for instruct in self._link.receive():
                self.names.append(instruct.order.name)
                good = instruct.order.name == "pause"
                self._link.answer(Result(instruct.order.id, "done" if good else "refused", "" if good else "not stopped"))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._link.close()


@pytest.fixture
def site(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[str]:
    """The URL of a broker with a unit on it whose keys are chief (reset) and guest (view)."""
    for name, role in (("chief", "reset"), ("guest", "view")):
        made = ["keys", "make", name, "--role", role, "--keys", str(tmp_path / "keys.toml"), "--out", str(tmp_path / f"{name}.key")]
        assert main(made) == 0
    assert main(["keys", "list", str(tmp_path / "keys.toml")]) == 0
    listed = capsys.readouterr().out.splitlines()[-2:]
    assert [line.split()[:2] for line in listed] == [["chief", "reset"], ["guest", "view"]]
    with EmbeddedBroker() as broker, Journal(tmp_path / "journal.db", "tractor-7"):
        settings = Settings(tmp_path / "journal.db", "tractor-7", "farm", broker.address, keys=tmp_path / "keys.toml")
        supervision = Supervision(settings.journal)
        with BridgeThread(settings, lambda line: None):
            yield str(broker.address)
        supervision.close()


@pytest.mark.parametrize(("words", "code", "told"), [
    (["tractor-7", "pause"], 0, "tractor-7: pause done"),
    (["tractor-7", "resume"], 1, "tractor-7: resume refused: not stopped"),
    (["tractor-7", "pause", "--sign", "guest.key"], 1, 'tractor-7: pause refused: the role "view" may not pause'),
    (["tractor-7", "pause", "--name", "nobody"], 1, "tractor-7: pause refused: unknown key"),
])
def test_a_command_is_answered(site: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int,
                               told: str) -> None:
    key = words[words.index("--sign") + 1] if "--sign" in words else "chief.key"
    words = [word for word in words if word not in ("--sign", key)]
    for _ in range(2):
        assert main(["level2", "command", *words, "--sign", str(tmp_path / key), "--fleet", "farm", "--broker", site]) == code
    assert capsys.readouterr().out.splitlines() == [told] * 2


@pytest.mark.parametrize(("words", "told"), [
    (["tractor-8", "pause"], 'unit "tractor-8" of fleet "farm": nothing heard from it'),
    (["tractor-7", "pause", "--value", "fast"], '--value "fast": write a number'),
    (["a/b", "pause"], "can't stand in an MQTT topic"),
])
def test_a_command_that_cannot_be_brought_is_told(site: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                                  words: list[str], told: str) -> None:
    assert main(["level2", "command", *words, "--sign", str(tmp_path / "chief.key"), "--fleet", "farm", "--broker", site]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_keys_are_not_made_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make = ["keys", "make", "chief", "--keys", str(tmp_path / "keys.toml"), "--out", str(tmp_path / "chief.key"), "--role"]
    assert main([*make, "boss"]) == 2
    assert 'no role is called "boss"' in capsys.readouterr().err
    assert main([*make, "stop"]) == 0
    assert main([*make, "stop"]) == 2
    assert 'has a key "chief" already' in capsys.readouterr().err
