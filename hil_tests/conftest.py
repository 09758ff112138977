"""For tests of the whole chain: programs as processes of their own, and the links of the test's network."""
from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import cache
from itertools import count
from pathlib import Path
from typing import IO, Literal, NamedTuple

import pytest

from hil_tests.vcan_run import INTERFACES
from level1.catalog import Message
from level1.decode import encode
from level1.event import Event
from level1.io.definitions import load
from level1.io.journal import read_events

ROOT = Path(__file__).parents[1]
UCS = (sys.executable, "-m", "ucs")
STOP_S = 10.0
"""A program must end so long after SIGTERM."""
START_S, SOON_S = 120.0, 20.0
"""So long a program may take until it works, and what follows at once until it is told, in a guest on a busy machine. Not for
what a test says the time of."""


class Line(NamedTuple):
    """A line that a program wrote. t_s: seconds since it was started."""

    t_s: float
    stream: Literal["out", "err"]
    text: str


class Process:
    """A running program whose lines are collected. Made by the fixture `process`."""

    def __init__(self, command: Sequence[str], name: str, cwd: Path):
        self.name, self.command = name, tuple(command)
        self.lines: list[Line] = []
        self._seen, self._open = 0, 2
        self._changed = threading.Condition()
        self._start_s = time.monotonic()
        env = {**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join((str(ROOT), *sys.path[1:]))}
        self._popen = subprocess.Popen(self.command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                       stderr=subprocess.PIPE, cwd=cwd, env=env, text=True, errors="backslashreplace",
                                       start_new_session=True)
        self._readers = [threading.Thread(target=self._read, args=pair, daemon=True)
                         for pair in (("out", self._popen.stdout), ("err", self._popen.stderr))]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._popen.pid

    @property
    def returncode(self) -> int | None:
        """Exit status, None while it runs, -N when signal N ended it."""
        return self._popen.poll()

    @property
    def out(self) -> list[str]:
        """The lines on standard output so far."""
        return [line.text for line in list(self.lines) if line.stream == "out"]

    @property
    def err(self) -> list[str]:
        """The lines on standard error so far."""
        return [line.text for line in list(self.lines) if line.stream == "err"]

    @property
    def transcript(self) -> str:
        """Command, lines with their times, exit status: what a failed test shows."""
        body = "".join(f"{line.t_s:8.3f} {line.stream} {line.text}\n" for line in list(self.lines))
        return f"$ {' '.join(self.command)}\n{body}exit status: {self.returncode}\n"

    def expect(self, pattern: str, within_s: float = 10.0) -> re.Match[str]:
        """The first line (of either stream) that the pattern is found in, after the one expected before: so a series of
        `expect` also tests the order. Fails the test when it does not come in time, or the program ends without it."""
        __tracebackhide__ = True
        end_s = time.monotonic() + within_s
        with self._changed:
            while True:
                while self._seen < len(self.lines):
                    line = self.lines[self._seen]
                    self._seen += 1
                    if match := re.search(pattern, line.text):
                        return match
                if not self._open:
                    pytest.fail(f"{self.name} ended (status {self.wait(STOP_S)}) without a line like {pattern!r}")
                if not self._changed.wait(end_s - time.monotonic()) and self._seen == len(self.lines):
                    pytest.fail(f"{self.name} wrote no line like {pattern!r} within {within_s:g} s")

    def send_signal(self, number: int) -> None:
        """Send the program (and what it started) a signal."""
        os.killpg(self._popen.pid, number)

    def wait(self, within_s: float = 10.0) -> int:
        """Wait until it ends by itself; its exit status. Fails the test when it doesn't in time."""
        __tracebackhide__ = True
        try:
            status = self._popen.wait(within_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.name} still runs after {within_s:g} s")
        for reader in self._readers:
            reader.join(1)
        return status

    def stop(self, number: int = signal.SIGTERM, within_s: float = STOP_S) -> int:
        """Ask it to end if it still runs; its exit status. Fails the test when it doesn't obey."""
        __tracebackhide__ = True
        if self._popen.poll() is None:
            self.send_signal(number)
        return self.wait(within_s)

    def kill(self) -> int:
        """Let it end without a chance to tidy up, as a power cut would; its exit status."""
        return self.stop(signal.SIGKILL)

    def sweep(self) -> None:
        """Kill what the program started and left behind."""
        with contextlib.suppress(ProcessLookupError):
            self.send_signal(signal.SIGKILL)

    def _read(self, stream: Literal["out", "err"], pipe: IO[str]) -> None:
        with pipe:
            for text in pipe:
                with self._changed:
                    self.lines.append(Line(time.monotonic() - self._start_s, stream, text.rstrip("\r\n")))
                    self._changed.notify_all()
        with self._changed:
            self._open -= 1
            self._changed.notify_all()


RUNNING = pytest.StashKey[list[Process]]()


@pytest.fixture
def process(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Starts programs: `process("run", "unit.toml")` is `ucs run unit.toml`; `program=("candump", "-L")` another one.

    The current folder is `tmp_path`. At the end of the test those still running are stopped, the last one first; one that
    does not end on SIGTERM fails the test. A failed test shows what each of them wrote, and when.
    """
    started: list[Process] = request.node.stash.setdefault(RUNNING, [])

    def start(*arguments: str | Path, program: Sequence[str] = UCS, name: str = "", cwd: Path = tmp_path) -> Process:
        command = [*program, *map(str, arguments)]
        started.append(Process(command, name or " ".join(command[len(program) - 1:][:2]), cwd))
        return started[-1]

    yield start
    stubborn = []
    for one in reversed(started):
        try:
            one.stop()
        except pytest.fail.Exception:
            stubborn.append(one.name)
            one.kill()
        one.sweep()
    if stubborn:
        pytest.fail(f"did not end within {STOP_S:g} s of SIGTERM: {', '.join(stubborn)}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failed test shows what its programs wrote."""
    report = yield
    if report.failed:
        report.sections += [(f"{one.name} (process {one.pid})", one.transcript) for one in item.stash.get(RUNNING, [])]
    return report


def told(folder: Path, alarm: str) -> list[Event]:
    """The events of an alarm in the journal of a run that has ended."""
    return [event for event in read_events(folder / "journal.db", limit=10**6) if event.alarm == alarm]


@cache
def flamer_status() -> Message:
    """The status of the flaming tool."""
    return load(["flaming_tool.dbc"]).messages["FLAMER_STATUS"]


def lose_the_flame(run: Process, send: Callable[[int, bytes], object]) -> None:
    """What a flaming tool says whose pilot flame is out, until the unit has told it."""
    status = flamer_status()
    end_s = time.monotonic() + SOON_S
    for times in count():
        if any(re.search("PilotFlameOut +raised", line) for line in run.out):
            break
        assert time.monotonic() < end_s, "no alarm"
        send(status.can_id, encode(status, {"Flaming": 1, "PilotFlame": 0, "AliveCounter": times % 4}, None))
        time.sleep(0.1)
    run.expect("PilotFlameOut +raised")


@pytest.fixture
def set_link() -> Iterator[Callable[[str, bool], None]]:
    """Sets a link up (True) or down (False): `set_link("vcan0", False)`. Both are up again after the test."""

    def set_(interface: str, up: bool) -> None:
        subprocess.run(["ip", "link", "set", interface, "up" if up else "down"], check=True)

    yield set_
    for interface in INTERFACES:
        set_(interface, True)
