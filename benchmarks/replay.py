"""Recordings to events: `ucs replay` against python-can, cantools and hand-written rules: `python -m benchmarks.replay`.

What it measures and prints: docs/performance.md.
"""
from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import NamedTuple

from benchmarks import page, workload
from benchmarks.core import machine
from benchmarks.recordings import WRITERS, Endless

FORMATS = (*WRITERS, "MF4")
TARGETS = {"candump": 40, "BLF": 20, "MF4": 10}
"""Ratios that the project asks of itself."""
MOST_MB = 100
"""Resident memory that it allows itself, whatever the length of the recording."""
GIVEN_MF4 = "asammdf is not installed here: python -m venv FOLDER; FOLDER/bin/pip install asammdf python-can cantools; then " \
            "--mf4-python FOLDER/bin/python (in a place of its own, because it makes importing python-can slow)"
CORES = 2
SHARES = 8
"""Recordings of the folder that two cores share."""


class Run(NamedTuple):
    """What a contender's process has told."""

    seconds: float
    frames: int
    peak_mb: float
    alarms: int
    digest: str

    @property
    def rate(self) -> float:
        """Frames per second of CPU time."""
        return self.frames / self.seconds


class Row(NamedTuple):
    """A format: median rates and highest memory of both."""

    format: str
    ours: float
    peer: float
    ours_mb: float
    peer_mb: float

    @property
    def ratio(self) -> float:
        """How many times faster."""
        return self.ours / self.peer


def main() -> int:
    """Compare each format, then run a long recording, then a folder of recordings on one core and on two."""
    args = _arguments()
    print(machine())
    parts: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory(prefix="replay-", dir=args.folder) as name:
        folder = Path(name)
        if "formats" in args.only:
            rows = list(compare(folder, args))
            parts["replay: formats"] = _format_lines(rows, args)
        if "long" in args.only:
            parts["replay: long"] = run_long(folder, args)
        if "cores" in args.only:
            parts["replay: cores"] = run_cores(folder, args)
    if args.write:
        for part, lines in parts.items():
            page.put(part, lines)
    return 0


def _arguments() -> Namespace:
    parser = ArgumentParser(prog="python -m benchmarks.replay", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=("formats", "long", "cores"), default=("formats", "long", "cores"),
                        help="parts to run (default all)")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=FORMATS, metavar="FORMAT",
                        help=f"of {', '.join(FORMATS)} (default all)")
    parser.add_argument("--compared", type=int, default=2_000_000, metavar="N",
                        help="frames of the recording that both read (default %(default)s)")
    parser.add_argument("--rounds", type=int, default=2, help="how often each is timed (default %(default)s)")
    parser.add_argument("--frames", type=int, default=10_000_000, metavar="N",
                        help="of the long recording; 100000000 takes 5 GB of disk (default %(default)s)")
    parser.add_argument("--shared", type=int, default=96_000_000, metavar="N",
                        help=f"frames of the {SHARES} recordings in the folder for two cores (default %(default)s)")
    parser.add_argument("--mf4-python", default=sys.executable, metavar="PYTHON", help="a Python with asammdf, for the peer's MF4")
    parser.add_argument("--folder", metavar="FOLDER", help="where recordings are put meanwhile (default: as the system says)")
    parser.add_argument("--write", action="store_true", help=f"put the results into docs/{page.PAGE.name}")
    return parser.parse_args()


# --- formats --------------------------------------------------------------------------------------------------------------


def compare(folder: Path, args: Namespace) -> Iterator[Row]:
    """Each format: the same alarms by both, then both in turn. Raises SystemExit when they differ."""
    load = workload.make(args.compared, mixed=True)
    print(f"{len(load):,} frames of {len(load.messages)} messages in {load.seconds:.0f} s of driving, {load.repeated:.0%} repeat "
          f"the payload before them; {len(load.rules)} alarms\n")
    dbc, rules = folder / "drive.dbc", folder / "rules.pickle"
    dbc.write_text(workload.dbc(load))
    rules.write_bytes(pickle.dumps(load.rules))
    for name in args.formats:
        python = args.mf4_python if name == "MF4" else sys.executable
        log = _written(load, name, folder, python)
        if log is None:
            print(f"{name}: left out. {GIVEN_MF4}\n")
            continue
        ours, peer = [], []
        for _ in range(args.rounds):
            ours.append(_run(sys.executable, "ours", log, dbc))
            peer.append(_run(python, "peer", log, dbc, rules))
        if len({run.digest for run in (*ours, *peer)}) > 1 or {run.frames for run in (*ours, *peer)} != {len(load)}:
            raise SystemExit(f"{name}: the two differ in their alarms")
        row = Row(name, median(run.rate for run in ours), median(run.rate for run in peer), max(run.peak_mb for run in ours),
                  max(run.peak_mb for run in peer))
        print(f"{name}: same {ours[0].alarms} alarms raised and cleared, at the same times")
        print(f"  ucs replay                      {row.ours:>12,.0f} frames/s {row.ours_mb:>5.0f} MB")
        print(f"  python-can + cantools + rules   {row.peer:>12,.0f} frames/s {row.peer_mb:>5.0f} MB")
        print(f"ratio: {row.ratio:.1f}\n", flush=True)
        log.unlink()
        yield row


def _written(load: workload.Workload, name: str, folder: Path, python: str) -> Path | None:
    """The recording in a format; None for MF4 where nothing can write and read it for the peer."""
    if name != "MF4":
        suffix, write = WRITERS[name]
        log = folder / f"drive{suffix}"
        write(load, log)
        return log
    if subprocess.run([python, "-c", "import asammdf, can, cantools"], capture_output=True).returncode:
        return None
    source, log = folder / "source.blf", folder / "drive.mf4"
    WRITERS["BLF"][1](load, source)
    subprocess.run([python, "-m", "benchmarks.mf4", str(source), str(log)], check=True, capture_output=True)
    source.unlink()
    return log


def _run(python: str, contender: str, *paths: Path) -> Run:
    command = [python, "-m", "benchmarks.chain", contender, *map(str, paths)]
    seconds, frames, peak_kb, alarms, digest = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.split()
    return Run(float(seconds), int(frames), int(peak_kb) / 1000, int(alarms), digest)


def _format_lines(rows: list[Row], args: Namespace) -> list[str]:
    cells = [(row.format, f"{row.ours / 1e6:.2f} M", f"{row.peer / 1e6:.3f} M", f"**{row.ratio:.0f} ×**",
              f"≥ {TARGETS[row.format]} ×" if row.format in TARGETS else "–", f"{row.ours_mb:.0f} MB", f"{row.peer_mb:.0f} MB")
             for row in rows]
    return [f"{machine()}; {args.compared:,} frames, median of {args.rounds} rounds in turn.", "",
            *page.table(("format", "`ucs replay`, frames/s", "peer, frames/s", "ratio", "asked for", "memory", "peer's"), cells)]


# --- a long recording -----------------------------------------------------------------------------------------------------


def run_long(folder: Path, args: Namespace) -> list[str]:
    """One recording of many frames. The alarms of each further time the drive is played are the same: checked by their number."""
    drive = workload.make(1_000_000, mixed=True)
    endless = Endless(drive)
    dbc, log = folder / "drive.dbc", folder / "long.log"
    dbc.write_text(workload.dbc(drive))
    counted = []
    for rounds in (2, 3):
        endless.write(log, rounds * endless.frames)
        counted.append(_run(sys.executable, "ours", log, dbc).alarms)
    started = time.perf_counter()
    rounds = max(3, endless.write(log, args.frames))
    size = log.stat().st_size
    print(f"wrote {rounds * endless.frames:,} frames, {size / 1e9:.1f} GB, in {time.perf_counter() - started:.0f} s", flush=True)
    started = time.perf_counter()
    run = _run(sys.executable, "ours", log, dbc)
    took_s = time.perf_counter() - started
    log.unlink()
    expected = counted[0] + (rounds - 2) * (counted[1] - counted[0])
    if run.frames != rounds * endless.frames or run.alarms != expected:
        raise SystemExit(f"{run.frames:,} frames and {run.alarms} alarms; expected {rounds * endless.frames:,} and {expected}")
    billion_s = 1e9 / run.rate
    print(f"{run.frames:,} frames: {run.seconds:.1f} s of CPU time ({took_s:.1f} s by the clock), {run.rate:,.0f} frames/s, "
          f"{run.peak_mb:.0f} MB, {run.alarms:,} alarms raised and cleared, as many as expected")
    print(f"a billion frames would take {billion_s / 60:.1f} min\n", flush=True)
    return [f"{machine()}. candump text of {run.frames:,} frames, {size / 1e9:.1f} GB, "
            f"{rounds * endless.period_s / 3600:.1f} h of driving:", "",
            *page.table(("CPU time", "by the clock", "frames/s", "memory", "raised and cleared", "a billion frames"), [
                (f"{run.seconds:.1f} s", f"{took_s:.1f} s", f"{run.rate / 1e6:.2f} M", f"{run.peak_mb:.0f} MB", f"{run.alarms:,}",
                 f"{billion_s / 60:.1f} min")])]


# --- two cores ------------------------------------------------------------------------------------------------------------


def run_cores(folder: Path, args: Namespace) -> list[str]:
    """A folder of recordings by `ucs replay`, on one core and on two, each from the start of the program to its end."""
    drive = workload.make(1_000_000, mixed=True)
    endless = Endless(drive)
    dbc, logs = folder / "drive.dbc", folder / "season"
    dbc.write_text(workload.dbc(drive))
    logs.mkdir()
    endless.write(logs / "0.log", args.shared // SHARES)
    for number in range(1, SHARES):
        os.link(logs / "0.log", logs / f"{number}.log")
    taken: dict[int, list[float]] = {jobs: [] for jobs in range(1, CORES + 1)}
    for _ in range(args.rounds):
        for jobs, seconds in taken.items():
            command = [sys.executable, "-m", "ucs", "replay", str(logs), "--dbc", str(dbc), "--jobs", str(jobs), "--fresh"]
            started = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            seconds.append(time.perf_counter() - started)
    one, two = median(taken[1]), median(taken[CORES])
    frames = SHARES * -(-(args.shared // SHARES) // endless.frames) * endless.frames
    print(f"{SHARES} recordings, {frames:,} frames: {one:.1f} s with --jobs 1, {two:.1f} s with --jobs {CORES}: "
          f"{one / two:.2f} times faster, efficiency {one / two / CORES:.0%}")
    return [f"{machine()}, {os.cpu_count()} cores. {SHARES} recordings of {frames // SHARES:,} frames, median of {args.rounds} "
            "rounds, from the start of the program to its end:", "",
            *page.table(("`--jobs 1`", f"`--jobs {CORES}`", "times faster", "efficiency", "frames/s"), [
                (f"{one:.1f} s", f"{two:.1f} s", f"{one / two:.2f}", f"{one / two / CORES:.0%}", f"{frames / two / 1e6:.1f} M")])]


if __name__ == "__main__":
    sys.exit(main())
