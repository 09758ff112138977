"""The live loop against python-can, cantools and hand-written rules: `python -m benchmarks.live`. What it prints: README.md."""
from __future__ import annotations

import json
import pickle
import struct
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import workload
from benchmarks.core import machine

FULL_BUS_PER_S = 8_500
"""Frames a second of a full bus of 1 Mbit/s."""
SPARE = 2
"""Times the frames needed: the workload is a little shorter than asked for, because its messages fall silent."""
CONTENDERS = {"core": "the live loop of `ucs run`", "peer": "python-can + cantools + rules"}
JOURNALED = {"journal": "the live loop with its journal"}


def main() -> int:
    """Time both in turn, from a full socket and at the rate of a full bus."""
    parser = ArgumentParser(prog="python -m benchmarks.live", description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000, help="from a full socket (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=10, help="at the rate of a full bus (default %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="how often each is timed (default %(default)s)")
    parser.add_argument("--alone", action="store_true", help="run before all other programs (SCHED_FIFO); disturbs them")
    args = parser.parse_args()
    load = workload.make(max(args.frames, round(FULL_BUS_PER_S * args.seconds)) * SPARE)
    print(machine())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames.bin").write_bytes(b"".join(
            struct.pack("=IB3x8s", frame.key, len(frame.data), frame.data) for frame in load.frames()))
        (folder / "live.dbc").write_text(workload.dbc(load))
        (folder / "rules.pickle").write_bytes(pickle.dumps(load.rules))
        full_socket(folder, args.frames, args.rounds)
        full_bus(folder, round(FULL_BUS_PER_S * args.seconds), args.rounds, args.alone)
        print(f"\nresident, `ucs run` with all shipped definitions: {run(folder, 'shipped')['rss_mb']:.1f} MB")
    return 0


def full_socket(folder: Path, frames: int, rounds: int) -> None:
    """Frames that wait in the kernel's buffer, portion by portion."""
    seconds: dict[str, list[float]] = {name: [] for name in CONTENDERS}
    for _ in range(rounds):
        for name, spent in seconds.items():
            spent.append(run(folder, name, frames)["cpu_s"])
    print(f"from a full socket to verdicts, {frames:,} frames, CPU time, median of {rounds} rounds in turn")
    each = {name: median(spent) / frames for name, spent in seconds.items()}
    for name, one in each.items():
        print(f"  {CONTENDERS[name]:<36}{one * 1e6:>8.2f} us/frame")
    print(f"ratio: {each['peer'] / each['core']:.1f}\n")


def full_bus(folder: Path, frames: int, rounds: int, alone: bool) -> None:
    """Frames that come one by one, as fast as a full bus brings them."""
    print(f"at {FULL_BUS_PER_S:,} frames/s, {frames:,} frames, median of {rounds} rounds in turn")
    contenders = CONTENDERS | JOURNALED
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, found in results.items():
            found.append(run(folder, name, frames, FULL_BUS_PER_S, alone))
    for name, found in results.items():
        one = {key: median(result[key] for result in found) for key in found[0]}
        print(f"  {contenders[name]:<36}{one['cpu_percent']:>6.1f} % of a core   frame to verdict p50 {one['p50_ms']:.2f}, "
              f"p99 {one['p99_ms']:.2f}, worst {one['worst_ms']:.1f} ms   {one['lost']:.0f} lost   {one['rss_mb']:.1f} MB")


def run(folder: Path, contender: str, frames: int = 0, rate: int = 0, alone: bool = False) -> dict[str, Any]:
    """A contender in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.receiver", contender, str(folder), str(frames), str(rate), str(int(alone))]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


if __name__ == "__main__":
    sys.exit(main())
