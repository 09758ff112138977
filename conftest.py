"""Tests marked `vcan` need vcan0 and vcan1; where this machine has none, they run in a guest that has.

Theory of operation. The other tests run here, natively. Then the same pytest command runs once more under
`hil_tests/vcan_run.py`, restricted to the `vcan` tests selected here; it hands each report over as it comes and they are
taken in as if the tests had run here (a guest for each file, some beside each other, as these tests mostly wait): one summary,
one exit status, and `-x`, `-k`, `--lf`, `--junitxml` do what they always do. A `vcan` test for which no report came (the guest
died, ran out of time, could not collect it) is an error. Without a way to a vcan the run ends at once with exit status 125 and
the packages to install; nothing is skipped. The workers of pytest-xdist would share the buses: with `-n`, `vcan` tests fail.
"""
from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_tests import vcan_run

SELECTED = "VCAN_RUN_SELECTED"
"""Environment of the guest's pytest: the file that lists the node ids to run."""
MARK = "\x1e"
"""Starts and ends a line of the guest's output that is one message as JSON."""
TIMEOUT_S = 840
GUESTS = 2
"""Guests at one time: their tests wait for purges and time-outs rather than compute."""


def pytest_configure(config: pytest.Config) -> None:
    """In the guest: run what was selected outside, and hand the reports over."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background by a shell: tests of Ctrl-C need it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    listed = os.environ.pop(SELECTED, "")
    if listed:
        config.pluginmanager.register(GuestSide(config, Path(listed).read_text().splitlines()))


def pytest_report_collectionfinish(items: list[pytest.Item]) -> str | None:
    """Say where the `vcan` tests run."""
    count = sum(needs_vcan(item) for item in items)
    return f"{count} of them need vcan0 and run {vcan_run.way()}" if count else None


@pytest.hookimpl(wrapper=True)
def pytest_runtestloop(session: pytest.Session) -> Generator[None, object, object]:
    """Run the tests that need no vcan here, then the others in the guest."""
    everything = list(session.items)
    elsewhere = [item for item in everything if needs_vcan(item)]
    if not elsewhere or session.config.option.collectonly or vcan_run.present() or is_worker(session.config):
        return (yield)
    if obstacle := vcan_run.obstacle():
        pytest.exit(f"{len(elsewhere)} tests need vcan0: {obstacle}", returncode=vcan_run.NO_WAY)
    session.items[:] = [item for item in everything if not needs_vcan(item)]
    try:
        result = yield
        run_guests(session, elsewhere)
    finally:
        session.items[:] = everything
    return result


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """One line of what became of the `vcan` tests; `.ci/run` reads it."""
    counts = {outcome: sum("vcan" in getattr(report, "keywords", ()) for report in reports)
              for outcome, reports in terminalreporter.stats.items() if outcome not in ("", "deselected")}
    if any(counts.values()):
        terminalreporter.write_line(
            "vcan tests: " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Two tests at a time on one bus would hear each other."""
    if needs_vcan(item) and is_worker(item.config):
        pytest.fail('tests marked "vcan" share the buses: run them without -n, or leave them out with -m "not vcan"', pytrace=False)


def is_worker(config: pytest.Config) -> bool:
    """Whether this is one of several processes that pytest-xdist has started."""
    return hasattr(config, "workerinput")


def needs_vcan(item: pytest.Item) -> bool:
    """Whether the test is marked `vcan`."""
    return item.get_closest_marker("vcan") is not None


def run_guests(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Run the `vcan` tests, those of a file in a guest of their own, `GUESTS` guests at a time."""
    waiting: dict[Path, list[pytest.Item]] = {}
    for item in items:
        waiting.setdefault(item.path, []).append(item)
    shares = sorted(waiting.values(), key=len, reverse=True)
    with contextlib.ExitStack() as stack:
        guests: list[Guest] = []
        while shares or guests:
            while shares and len(guests) < GUESTS:
                guests.append(stack.enter_context(Guest(session, shares.pop(0))))
            guests = [guest for guest in guests if not guest.take()]
            time.sleep(0.05)


class Guest:
    """A run of `vcan` tests under `vcan_run`, as seen from outside; a context manager."""

    def __init__(self, session: pytest.Session, items: list[pytest.Item]):
        self.session, self.config, self.items = session, session.config, items
        self.waiting = {item.nodeid: item for item in items}
        self.output: list[str] = []
        self.begun = ""
        self.job = tempfile.TemporaryDirectory(prefix="vcan-tests-")
        self.runner = self._start(Path(self.job.name))
        self.out = (Path(self.job.name) / "out").open(encoding="utf-8", errors="backslashreplace")

    def __enter__(self) -> Guest:
        return self

    def __exit__(self, *_: object) -> None:
        self.runner.terminate()
        self.runner.wait()
        self.out.close()
        self.job.cleanup()

    def take(self) -> bool:
        """Take in the reports that have come; gives whether that was all. Raises what ends a session early (`-x`, Ctrl-C)."""
        ended = self.runner.poll() is not None
        for line in self._lines():
            if line.startswith(MARK):
                self._report(json.loads(line.strip(MARK + "\r\n")))
            else:
                self._keep(line)
        if ended and not self.session.shouldfail and not self.session.shouldstop:
            self._blame()
        self._stop_if_asked()
        return ended

    def _start(self, job: Path) -> subprocess.Popen[bytes]:
        """The guest; what its pytest writes goes into the file `out`, so that it never waits for a reader."""
        selected = job / "selected"
        selected.write_text("\n".join(self.waiting))
        parameters = self.config.invocation_params
        command = [sys.executable, vcan_run.__file__, "-t", str(TIMEOUT_S), sys.executable, "-m", "pytest",
                   *map(str, parameters.args)]
        if self.config.pluginmanager.hasplugin("cacheprovider"):
            command += ["-o", f"cache_dir={job / 'cache'}"]
        with (job / "out").open("wb") as out:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT,
                                    cwd=parameters.dir, env={**os.environ, SELECTED: str(selected)})

    def _lines(self) -> Iterator[str]:
        """The lines that the guest's pytest has written since the last call; one that it is still writing comes next time."""
        while line := self.out.readline():
            if not line.endswith("\n"):
                self.begun += line
                return
            yield self.begun + line
            self.begun = ""

    def _report(self, message: dict[str, Any]) -> None:
        """One message of the guest: a test started, a report, a test finished."""
        hook = self.config.hook
        item = self.waiting.get(message["nodeid"])
        if item is None:
            return
        if "report" in message:
            report = hook.pytest_report_from_serializable(config=self.config, data=message["report"])
            report.location = item.location
            if isinstance(report.longrepr, list):  # of a skip: JSON knows no tuples
                report.longrepr = tuple(report.longrepr)
            hook.pytest_runtest_logreport(report=report)
        elif message["step"] == "start":
            hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        else:
            hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
            del self.waiting[item.nodeid]

    def _keep(self, line: str) -> None:
        """What the guest printed besides: shown with `-s`, else only if a test got lost."""
        if self.config.option.capture == "no":
            sys.stdout.write(line)
        self.output.append(line)

    def _blame(self) -> None:
        """Every test that did not finish is an error, with what the guest said last."""
        status = self.runner.returncode
        reason = {vcan_run.TIMED_OUT: f"ran out of time ({TIMEOUT_S} s)"}.get(status, f"ended, status {status}")
        text = f"the guest {reason} before this test had finished; its last words:\n{''.join(self.output[-200:])}"
        hook = self.config.hook
        for item in self.waiting.values():
            report = pytest.TestReport(item.nodeid, item.location, dict.fromkeys(item.keywords, 1), "failed", text, "setup")
            hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
            hook.pytest_runtest_logreport(report=report)
            hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)

    def _stop_if_asked(self) -> None:
        if self.session.shouldfail:
            raise self.session.Failed(self.session.shouldfail)
        if self.session.shouldstop:
            raise self.session.Interrupted(self.session.shouldstop)


class GuestSide:
    """In the guest: collect only what was selected outside, and write each report to standard output."""

    def __init__(self, config: pytest.Config, selected: list[str]):
        self.config, self.selected = config, set(selected)
        self.files = {config.rootpath / nodeid.partition("::")[0] for nodeid in selected}
        self.out = os.fdopen(os.dup(1), "w")

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Leave files alone that have none of the selected tests."""
        return True if collection_path.is_file() and collection_path not in self.files else None

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the selected tests."""
        items[:] = [item for item in items if item.nodeid in self.selected]

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A test starts."""
        self._send({"nodeid": nodeid, "step": "start"})

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A phase of a test ended."""
        data = self.config.hook.pytest_report_to_serializable(config=self.config, report=report)
        self._send({"nodeid": report.nodeid, "report": data})

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """A test ended."""
        self._send({"nodeid": nodeid, "step": "finish"})

    def _send(self, message: dict[str, Any]) -> None:
        self.out.write(f"\n{MARK}{json.dumps(message)}{MARK}\n")
        self.out.flush()
