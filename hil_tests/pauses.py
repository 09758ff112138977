"""Tests on a machine that has better things to do: `python -m hil_tests.pauses -n 3 -m "not vcan" ucs level1`.

Runs pytest with these arguments, and lets its processes and theirs stand still at random, one at a time, for up to 0.7 s, as a busy
machine does. What fails so and not else waits for a time where it should wait for what it needs, or the program loses something
when it is late.
"""
from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

BETWEEN_S = (0.1, 0.6)
PAUSES_S = (0.03, 0.1, 0.3, 0.7)


def descendants(ancestor: int) -> list[int]:
    """Processes below one."""
    parents: dict[int, int] = {}
    for place in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            parents[int(place.parent.name)] = int(place.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[1])
    return [process for process in parents if process != ancestor and _is_below(process, ancestor, parents)]


def _is_below(process: int, ancestor: int, parents: dict[int, int]) -> bool:
    while process in parents and process != ancestor:
        process = parents[process]
    return process == ancestor


def pause(process: int, seconds: float) -> None:
    """Let a process stand still."""
    with suppress(ProcessLookupError):
        os.kill(process, signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            os.kill(process, signal.SIGCONT)


def main(arguments: list[str]) -> int:
    """Run pytest, paused; gives its exit code."""
    with subprocess.Popen([sys.executable, "-m", "pytest", *arguments]) as tests:
        while tests.poll() is None:
            time.sleep(random.uniform(*BETWEEN_S))
            if below := descendants(tests.pid):
                pause(random.choice(below), random.choice(PAUSES_S))
        return tests.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
