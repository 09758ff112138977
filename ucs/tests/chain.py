"""The four processes of a site (broker, level 2, bridge, unit), each of which can be killed and started again."""
from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

from bridge.tests.brokers import NATS, free_port
from level1.event import Event, seconds
from ucs.tests.units import unit_toml

ROOT = Path(__file__).parents[2]


def an_event(seq: int, boot: int = 1) -> Event:
    return Event("tractor-7", boot, seq, seconds(seq), None, False, "PilotFlameOut", 3101, "High", "raised", seq, 0, {}, "out")


BROKER = """
    import signal, sys
    from bridge.broker import EmbeddedBroker
    with EmbeddedBroker(port=int(sys.argv[1])):
        signal.pause()
"""
UNIT = """
    import sys, time
    from pathlib import Path
    from bridge.link import RunLink
    from level1.io.journal import Journal
    from ucs.tests.chain import an_event
    path, pause_s = Path(sys.argv[1]), float(sys.argv[2])
    with Journal(path, "tractor-7", patience_ns=60 * 10**9) as journal:
        link = RunLink(path)
        for seq in range(1, 10**6):
            assert journal.append([an_event(seq, journal.boot)], b"")
            link.poke()
            print(journal.boot, seq, flush=True)
            time.sleep(pause_s)
"""


class Chain:
    """The four processes of a site, each of which can be killed and started again. nats: a program to be the broker."""

    def __init__(self, folder: Path, pause_s: float = 0.02, nats: str = ""):
        self.folder = folder
        port = free_port()
        (folder / "unit.toml").write_text(
            unit_toml("flaming_tool.dbc", fleet="farm", more=f'[bridge]\nbroker = "mqtt://127.0.0.1:{port}"'))
        python, ucs = [sys.executable, "-c"], [sys.executable, "-m", "ucs"]
        self.commands = {
            "broker": self._nats(nats, port) if nats else [*python, textwrap.dedent(BROKER), str(port)],
            "level2": [*ucs, "level2", "--broker", f"mqtt://127.0.0.1:{port}", "--store", str(folder / "level2.db")],
            "bridge": [*ucs, "bridge", str(folder / "unit.toml")],
            "unit": [*python, textwrap.dedent(UNIT), str(folder / "journal.db"), str(pause_s)],
        }
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        for name in self.commands:
            self.start(name)

    def _nats(self, program: str, port: int) -> list[str]:
        """NATS instead of the embedded broker, with its store in the folder: a killed one comes back to what it had."""
        file = self.folder / "nats.conf"
        file.write_text(NATS.format(other=free_port(), folder=self.folder, port=port))
        return [program, "-c", str(file)]

    def start(self, name: str) -> None:
        with open(self.folder / f"{name}.log", "ab") as log:
            self.processes[name] = subprocess.Popen(self.commands[name], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)

    def kill(self, name: str, how: signal.Signals = signal.SIGKILL) -> int:
        self.processes[name].send_signal(how)
        return self.processes[name].wait(timeout=60)

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def close(self) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()

    def promised(self) -> set[tuple[int, int]]:
        """What the unit said is on its disk: (boot, seq)."""
        return {(int(boot), int(seq)) for boot, _, seq in (line.partition(" ") for line in self.log("unit").splitlines())
                if boot.isdigit() and seq.isdigit()}

    def stored(self) -> int:
        try:
            connection = sqlite3.connect(f"file:{self.folder / 'level2.db'}?mode=ro", uri=True)
            try:
                return int(connection.execute("SELECT count(*) FROM event").fetchone()[0])
            finally:
                connection.close()
        except sqlite3.Error:
            return 0


def eventually(condition: Callable[[], object], explain: Callable[[], str]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, explain()
        time.sleep(0.05)
