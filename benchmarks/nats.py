"""NATS through its MQTT listener: `python -m benchmarks.nats` builds the server (needs Go, takes minutes the first time) and runs
the bridge's tests against it, those over mutual TLS too. `benchmarks.soak` does the same, and kills it among the other processes.

A fleet beyond one machine is a NATS cluster; units don't know the difference.
"""
from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

MODULE = "github.com/nats-io/nats-server/v2@v2.15.2"
ROOT = Path(__file__).parents[1]
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "tractor-ucs"
TESTS = ("bridge/tests/test_session.py", "bridge/tests/test_site.py")


def server() -> str:
    """The server's program: NATS_SERVER, or built by Go from the module proxy into a cache. Ends the process where it can't be."""
    if given := os.environ.get("NATS_SERVER"):
        return given
    program = CACHE / f"nats-server-{MODULE.rpartition('@')[2]}"
    if not program.exists():
        if shutil.which("go") is None:
            sys.exit("NATS is built by Go, which is missing: apt-get install golang-go, or name a nats-server in NATS_SERVER")
        if subprocess.run(["go", "install", MODULE], env={**os.environ, "GOBIN": str(CACHE)}).returncode:
            sys.exit(f"go install {MODULE} failed: see above")
        (CACHE / "nats-server").rename(program)
    return str(program)


def run_tests(program: str) -> tuple[int, int, str]:
    """How many of the tests against NATS passed, how many did not, and what pytest said."""
    command = [sys.executable, "-m", "pytest", "-q", "-k", "nats", *TESTS]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "NATS_SERVER": program}, capture_output=True, text=True)
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (\w+)", done.stdout.splitlines()[-1])}
    passed = counts.pop("passed", 0)
    counts.pop("deselected", 0)
    return passed, sum(number for word, number in counts.items() if word in ("failed", "errors", "error", "skipped")), done.stdout


def main() -> int:
    """Build unless it is there, run; 1 when a test did not pass."""
    passed, bad, text = run_tests(server())
    print(text)
    return 0 if passed and not bad else 1


if __name__ == "__main__":
    sys.exit(main())
