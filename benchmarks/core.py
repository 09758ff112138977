"""The core against python-can, cantools and hand-written rules: `python -m benchmarks.core`. What it prints: README.md."""
from __future__ import annotations

import gc
import platform
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from statistics import median

import can
import cantools

from benchmarks import runs, workload
from benchmarks.recordings import message_of
from level1.catalog import Catalog
from level1.definitions import Source, build
from level1.frame import Frame


def main() -> int:
    """Prove that both give the same alarms, then time them in turn; 1 when they differ."""
    parser = ArgumentParser(prog="python -m benchmarks.core", description=__doc__)
    parser.add_argument("--frames", type=int, default=300_000, help="length of the recording (default %(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="how often each is timed (default %(default)s)")
    parser.add_argument("--seed", type=int, default=workload.SEED, help="of the recording and its alarms (default %(default)s)")
    args = parser.parse_args()
    load = workload.make(args.frames, args.seed)
    print(machine())
    print(f"{len(load):,} frames of {len(load.messages)} messages in {load.seconds:.0f} s of driving, {load.repeated:.0%} repeat "
          f"the payload before them; {len(load.rules)} alarms")
    return from_memory(load, args.rounds)


def from_memory(load: workload.Workload, rounds: int) -> int:
    """The frames as objects in memory, all contenders in one process."""
    definitions, frames = catalog_of(load), list(load.frames())
    database = cantools.database.load_string(workload.dbc(load), "dbc")
    messages = messages_of(frames)
    gc.collect()
    gc.freeze()  # a million objects that stay must not be looked through in the middle of a measurement
    alarms = runs.receive_many(definitions, frames)[1]
    for name, others in (("receive", runs.receive(definitions, frames)[1]), ("peer", runs.peer(database, load.rules, messages)[1])):
        if sorted(alarms) != sorted(others):
            first = sorted(set(alarms) ^ set(others))[0]
            print(f"receive_many and {name} differ, first in {first}", file=sys.stderr)
            return 1
    print(f"same alarms: {len(alarms)} raised and cleared, at the same nanosecond by all\n")
    contenders: dict[str, Callable[[], float]] = {
        "core, receive_many": lambda: runs.receive_many(definitions, frames)[0],
        "core, receive, one call a frame": lambda: runs.receive(definitions, frames)[0],
        "peer: python-can + cantools + rules": lambda: runs.peer(database, load.rules, messages)[0],
        "cantools alone, decode_message": lambda: runs.decoding_alone(database, messages),
    }
    seconds = in_turn(contenders, rounds)
    print(f"from memory, median of {rounds} rounds in turn")
    for name, spent in seconds.items():
        print_rate(name, len(frames), spent)
    core, calls, peer, _ = seconds.values()
    print(f"ratio: {peer / core:.1f}")
    print(f"ratio per call: {peer / calls:.1f}\n")
    return 0


def in_turn(contenders: dict[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Median CPU seconds of each; they take turns, so that a busy moment of the machine hits them alike."""
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            spent[name].append(run())
    return {name: median(seconds) for name, seconds in spent.items()}


def catalog_of(load: workload.Workload) -> Catalog:
    """The workload's definitions as the core loads them."""
    catalog, problems = build([Source("workload.dbc", workload.dbc(load))])
    if catalog is None or problems:
        raise SystemExit("\n".join(map(str, problems)))
    return catalog


def messages_of(frames: Sequence[Frame]) -> list[can.Message]:
    """The same frames as python-can hands them out."""
    return [message_of(frame) for frame in frames]


def print_rate(name: str, frames: int, seconds: float) -> None:
    """One line of the table."""
    print(f"  {name:<36}{frames / seconds:>12,.0f} frames/s {seconds / frames * 1e9:>7.0f} ns/frame")


def machine() -> str:
    """Where it ran."""
    model = next((line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
                  if line.startswith("model name")), platform.processor())
    return (f"{model}, {platform.python_implementation()} {platform.python_version()}, python-can {version('python-can')}, "
            f"cantools {version('cantools')}")


if __name__ == "__main__":
    sys.exit(main())
