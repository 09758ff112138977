"""The live loop against python-can, cantools and hand-written rules: `python -m benchmarks.live`. What it prints: README.md."""
from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import page, workload
from benchmarks.core import machine

FULL_BUS_PER_S = 8_500
"""Frames a second of a full bus of 1 Mbit/s."""
SPARE = 2
"""Times the frames needed: the workload is a little shorter than asked for, because its messages fall silent."""
CONTENDERS = {"core": "the live loop of `ucs run`", "peer": "python-can + cantools + rules"}
JOURNALED = {"journal": "the live loop with its journal"}


HEAD = ("", "CPU, % of a core", "wakes/s", "p50 ms", "p99 ms", "worst ms", "lost", "MB", "frames/s")
"""Of the table at the rate of a full bus. frames/s: as they came."""
WIDTHS = (34, 16, 9, 8, 8, 10, 6, 7, 10)


def main() -> int:
    """Time both in turn, from a full socket and at the rate of a full bus."""
    parser = ArgumentParser(prog="python -m benchmarks.live", description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000, help="from a full socket (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=10, help="at the rate of a full bus (default %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="how often each is timed (default %(default)s)")
    parser.add_argument("--alone", action="store_true", help="run before all other programs (SCHED_FIFO); disturbs them")
    parser.add_argument("--write", action="store_true", help=f"put the results into docs/{page.PAGE.name}")
    args = parser.parse_args()
    load = workload.make(max(args.frames, round(FULL_BUS_PER_S * args.seconds)) * SPARE)
    print(machine())
    busy = Busy()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames.bin").write_bytes(b"".join(
            struct.pack("=IB3x8s", frame.key, len(frame.data), frame.data) for frame in load.frames()))
        (folder / "live.dbc").write_text(workload.dbc(load))
        (folder / "rules.pickle").write_bytes(pickle.dumps(load.rules))
        queued = full_socket(folder, args.frames, args.rounds)
        came = full_bus(folder, round(FULL_BUS_PER_S * args.seconds), args.rounds, args.alone)
        resident = f"`ucs run` with all shipped definitions: {run(folder, 'shipped')['rss_mb']:.1f} MB resident"
    print(f"\n{resident}\n{busy.text()}")
    if args.write:
        page.put("live", [f"{machine()}{', before all other programs' if args.alone else ''}; {busy.text()}.", "", *queued, "",
                          *came, "", f"{resident}."])
    return 0


def full_socket(folder: Path, frames: int, rounds: int) -> list[str]:
    """Frames that wait in the kernel's buffer, portion by portion. Gives a table for the page."""
    seconds: dict[str, list[float]] = {name: [] for name in CONTENDERS}
    for _ in range(rounds):
        for name, spent in seconds.items():
            spent.append(run(folder, name, frames)["cpu_s"])
    print(f"from a full socket to verdicts, {frames:,} frames, CPU time, median of {rounds} rounds in turn")
    each = {name: median(spent) / frames for name, spent in seconds.items()}
    rows = [(CONTENDERS[name], f"{one * 1e6:.2f}") for name, one in each.items()]
    for name, text in rows:
        print(f"  {name:<36}{text:>8} us/frame")
    ratio = f"{each['peer'] / each['core']:.1f}"
    print(f"ratio: {ratio}\n")
    return page.table(("from a full socket", "CPU, µs a frame"), [*rows, ("ratio", ratio)])


def full_bus(folder: Path, frames: int, rounds: int, alone: bool) -> list[str]:
    """Frames that come one by one, as fast as a full bus brings them. Gives a table for the page."""
    contenders = CONTENDERS | JOURNALED
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, found in results.items():
            found.append(run(folder, name, frames, FULL_BUS_PER_S, alone))
    ones = {name: {key: median(result[key] for result in found) for key in found[0]}
            | {"worst_ms": max(result["worst_ms"] for result in found), "lost": sum(result["lost"] for result in found)}
            for name, found in results.items()}
    rows = [(contenders[name], f"{one['cpu_percent']:.1f}", f"{one['wakes_per_s']:.0f}", f"{one['p50_ms']:.2f}",
             f"{one['p99_ms']:.2f}", f"{one['worst_ms']:.1f}", f"{one['lost']}", f"{one['rss_mb']:.1f}",
             f"{one['frames_per_s']:.0f}")
            for name, one in ones.items()]
    what = f"{frames:,} frames at {FULL_BUS_PER_S:,}/s"
    print(f"{what}, frame to verdict, median (worst, lost: of all) of {rounds} rounds in turn")
    for row in (HEAD, *rows):
        print(f"  {row[0]:<{WIDTHS[0]}}" + "".join(f"{cell:>{width}}" for cell, width in zip(row[1:], WIDTHS[1:], strict=True)))
    ratio = f"{ones['peer']['cpu_percent'] / ones['core']['cpu_percent']:.1f}"
    print(f"ratio of CPU at the rate of a full bus: {ratio}")
    return page.table((what, *HEAD[1:]), [*rows, ("ratio of CPU", ratio, *[""] * (len(HEAD) - 2))])


class Busy:
    """What else the machine did since this was made."""

    def __init__(self) -> None:
        self._before = self._ticks()

    def text(self) -> str:
        """A line. Stolen is what the host gave to others than this virtual machine."""
        total, stolen = (now - before for now, before in zip(self._ticks(), self._before, strict=True))
        return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, {100 * stolen / max(1, total):.1f} % of the time stolen"

    def _ticks(self) -> tuple[int, int]:
        words = Path("/proc/stat").read_text().split("\n", 1)[0].split()
        return sum(map(int, words[1:])), int(words[8])


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
