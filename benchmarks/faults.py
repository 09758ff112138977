"""What each fault does, from the tests that try it: `python -m benchmarks.faults --write` runs them and puts the table into
docs/reliability.md. Exit status 1 when one of them did not pass.

A test says so itself: `@pytest.mark.fault("disk full", "alarms go on into a reserve")`; further tests of that fault leave the
outcome out. This module is also the pytest plugin that counts them.
"""
from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path

import msgspec
import pytest

from benchmarks import page

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reliability.md"
OUT = "UCS_FAULTS_OUT"
"""Environment of the pytest run: where the plugin writes."""


class Fault(msgspec.Struct):
    """A line of the table. cases: how many tests try it; files: where they stand; passed: as far as they were run."""

    fault: str
    outcome: str
    cases: int = 0
    passed: int = 0
    files: list[str] = []


def gather(run: bool) -> tuple[list[Fault], str]:
    """The faults that tests name, in the order of files and lines, and what pytest said. run: not only collect."""
    tests = sorted(ROOT.glob("*/tests/test_*.py"))
    files = [str(path.relative_to(ROOT)) for path in tests if "@pytest.mark.fault(" in path.read_text(encoding="utf-8")]
    with tempfile.NamedTemporaryFile(prefix="faults-") as out:
        command = [sys.executable, "-m", "pytest", "-q", "-p", "benchmarks.faults", "-m", "fault", *files]
        plain = {name: value for name, value in os.environ.items() if name != "NATS_SERVER"}  # whose tests are counted apart
        done = subprocess.run([*command, *(["--collect-only"] if not run else [])], cwd=ROOT, capture_output=True, text=True,
                              env={**plain, OUT: out.name})
        found = json.load(out) if os.path.getsize(out.name) else []
    return msgspec.convert(found, list[Fault]), done.stdout + done.stderr


def table(faults: list[Fault]) -> list[str]:
    """The table in Markdown."""
    rows = (f"| {fault.fault} | {fault.outcome} | {fault.cases} in {', '.join(f'`{file}`' for file in fault.files)} |"
            for fault in faults)
    return ["| fault | what comes of it | tests |", "|---|---|---|", *rows]


def put_into_page(faults: list[Fault]) -> None:
    """Replace the table in docs/reliability.md."""
    page.put("faults", table(faults), PAGE)


# The plugin

_faults: dict[str, Fault] = {}
_named: dict[str, Fault] = {}


def pytest_collection_finish(session: pytest.Session) -> None:
    """Take the faults from the marks."""
    for item in session.items:
        for mark in item.iter_markers("fault"):
            fault = _faults.setdefault(mark.args[0], Fault(mark.args[0], ""))
            fault.outcome = fault.outcome or "".join(mark.args[1:])
            fault.cases += 1
            if (file := item.nodeid.partition("::")[0]) not in fault.files:
                fault.files.append(file)
            _named[item.nodeid] = fault


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Count those that passed."""
    if report.when == "call" and report.passed and report.nodeid in _named:
        _named[report.nodeid].passed += 1


def pytest_sessionfinish() -> None:
    """Hand them over."""
    Path(os.environ[OUT]).write_bytes(msgspec.json.encode([*_faults.values()]))


def main() -> int:
    """Run the tests and print or write the table."""
    parser = ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    args = parser.parse_args()
    faults, text = gather(run=True)
    if not faults or any(fault.passed < fault.cases for fault in faults):
        print(text, file=sys.stderr)
        return 1
    print(*table(faults), sep="\n")
    if args.write:
        put_into_page(faults)
    return 0


if __name__ == "__main__":
    sys.exit(main())
