"""Journal to level 2, all of it: in one process as the demonstration has it, and in four processes that are killed at random."""
from __future__ import annotations

import random
import signal
import socket
import sqlite3
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

from level1.event import Event, seconds
from level1.io.journal import Journal, Reader, read_events
from level2.store import Arrival, Outcome, Store
from ucs.forwarding import Forwarding

ROOT = Path(__file__).parents[2]
KILLS = 12


def an_event(seq: int, boot: int = 1) -> Event:
    return Event("tractor-7", boot, seq, seconds(seq), None, False, "PilotFlameOut", 3101, "High", "raised", seq, 0, {}, "out")


def test_events_reach_level_2_over_mqtt_inside_one_process(tmp_path: Path) -> None:
    arrivals: list[Arrival] = []
    path = tmp_path / "journal.db"
    with Journal(path, "tractor-7") as journal, \
            Forwarding(path, "tractor-7", "demo", tmp_path / "level2.db", arrivals.append, lambda line: None) as way:
        assert way.wait_online()
        journal.append([an_event(1), an_event(2)], b"")
        assert way.wait_delivered()
        journal.append([an_event(3)], b"")
        assert way.wait_delivered()
    assert [arrival.alarm.seq for arrival in arrivals] == [1, 2, 3]
    assert all(arrival.outcome is Outcome.NEW and not arrival.alarm.historical for arrival in arrivals)


def test_waiting_for_a_delivery_that_does_not_come_ends(tmp_path: Path) -> None:
    path = tmp_path / "journal.db"
    with Journal(path, "tractor-7") as journal, \
            Forwarding(path, "tractor-7", "demo", tmp_path / "level2.db", lambda arrival: None, lambda line: None) as way:
        way.receiver.stop()
        journal.append([an_event(1)], b"")
        assert not way.wait_delivered(0.2)


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
    from ucs.tests.test_forwarding import an_event
    path = Path(sys.argv[1])
    with Journal(path, "tractor-7") as journal:
        link = RunLink(path)
        for seq in range(1, 10**6):
            assert journal.append([an_event(seq, journal.boot)], b"")
            link.poke()
            print(journal.boot, seq, flush=True)
            time.sleep(0.02)
"""
CONFIG = """
    [unit]
    name = "tractor-7"
    fleet = "farm"
    [[bus]]
    name = "implement"
    channel = "vcan0"
    dbc = ["flaming_tool.dbc"]
    [journal]
    path = "journal.db"
    [bridge]
    broker = "mqtt://127.0.0.1:{port}"
"""


class Chain:
    """The four processes of a site, each of which can be killed and started again."""

    def __init__(self, folder: Path):
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        (folder / "unit.toml").write_text(textwrap.dedent(CONFIG.format(port=port)))
        python, ucs = [sys.executable, "-c"], [sys.executable, "-m", "ucs"]
        self.commands = {
            "broker": [*python, textwrap.dedent(BROKER), str(port)],
            "level2": [*ucs, "level2", "--broker", f"mqtt://127.0.0.1:{port}", "--store", str(folder / "level2.db")],
            "bridge": [*ucs, "bridge", str(folder / "unit.toml")],
            "unit": [*python, textwrap.dedent(UNIT), str(folder / "journal.db")],
        }
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        for name in self.commands:
            self.start(name)

    def start(self, name: str) -> None:
        with open(self.folder / f"{name}.log", "ab") as log:
            self.processes[name] = subprocess.Popen(self.commands[name], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)

    def kill(self, name: str, how: signal.Signals = signal.SIGKILL) -> int:
        self.processes[name].send_signal(how)
        return self.processes[name].wait(timeout=20)

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

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


def test_random_kills_of_every_process_lose_nothing_and_double_nothing(tmp_path: Path) -> None:
    dice = random.Random(6)
    chain = Chain(tmp_path)

    def explain() -> str:
        return f"{chain.stored()} stored\n" + "\n".join(chain.log(name)[-2000:] for name in ("broker", "level2", "bridge"))

    try:
        eventually(lambda: chain.stored() > 5, explain)
        for _ in range(KILLS):
            name = dice.choice([*chain.commands])
            chain.kill(name)
            chain.start(name)
            time.sleep(dice.uniform(0.1, 0.8))
        chain.kill("unit")
        with Reader(tmp_path / "journal.db") as reader:
            written = reader.events(limit=10**6)
        eventually(lambda: chain.stored() >= len(written), explain)
        assert chain.kill("bridge", signal.SIGTERM) == 0
        assert chain.kill("level2", signal.SIGTERM) == 0
    finally:
        for process in chain.processes.values():
            process.kill()
            process.wait()
    promised = {tuple(map(int, line.split())) for line in chain.log("unit").splitlines() if line.count(" ") == 1}
    assert len(promised) > 50
    with Store(tmp_path / "level2.db") as store:
        found = store.events()
        assert found == written == read_events(tmp_path / "journal.db", limit=10**6)
        assert promised <= {(event.boot, event.seq) for event in found}
        assert (store.count("conflict"), store.count("lost"), store.gaps()) == (0, 0, {})
