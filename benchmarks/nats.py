"""The tests of the bridge against NATS through its MQTT listener: `python -m benchmarks.nats` builds the server (needs Go,
takes minutes the first time) and runs them. A fleet beyond one machine is a NATS cluster; units don't know the difference.
"""
from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

MODULE = "github.com/nats-io/nats-server/v2@v2.15.2"
ROOT = Path(__file__).parents[1]


def main() -> int:
    """Build unless it is there, run, give pytest's exit status."""
    server = os.environ.get("NATS_SERVER") or build(Path.home() / ".cache" / "tractor-ucs")
    tests = [sys.executable, "-m", "pytest", "-q", "-k", "nats", "bridge/tests/test_session.py"]
    return subprocess.run(tests, cwd=ROOT, env={**os.environ, "NATS_SERVER": server}).returncode


def build(folder: Path) -> str:
    """The server's program, built by Go from the module proxy."""
    program = folder / f"nats-server-{MODULE.rpartition('@')[2]}"
    if not program.exists():
        if shutil.which("go") is None:
            sys.exit("needs Go: apt-get install golang-go, or name a nats-server in NATS_SERVER")
        subprocess.run(["go", "install", MODULE], env={**os.environ, "GOBIN": str(folder)}, check=True)
        (folder / "nats-server").rename(program)
    return str(program)


if __name__ == "__main__":
    sys.exit(main())
