"""What the examples must give: their recordings, made by the project's own simulated nodes, and the events of each.

`python -m examples.golden` (or `make golden`) replays them and writes their events anew: run it when a change of events is
meant, look at `git diff examples`, and commit both together. `--record` also makes the recordings anew.
"""
from __future__ import annotations

import argparse
import contextlib
import difflib
import gzip
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from level1.event import decode, seconds
from level1.io.definitions import load
from level1.io.replay import Log
from ucs import season
from ucs.main import main
from ucs.render import event_line, since
from ucs.spans import spans

HERE = Path(__file__).parent
SHARED = HERE.parents[1] / "shared" / "data"
"""Recordings of real machines, on some machines beside the project's folder; never part of it."""
SUMMARY = HERE / "recorded.json"
SHARED_DBC = ("isobus_tractor.dbc", "ucs.dbc")
MOST_LINES = 30


class Recorded(NamedTuple):
    """What a recording gives: frames, SHA-256 of the lines of its events, and of each alarm how often it was raised and how often
    it stood at the end."""

    frames: int
    events: str
    alarms: dict[str, list[int]]


Summary = dict[str, Recorded]
DECLARE = "If this change is meant, declare it: run `make golden`, look at `git diff examples`, and commit them with the change."


class Example(NamedTuple):
    """A recording with level 1 at work: the scenario it is of, so long, and the definitions."""

    name: str
    scenario: str
    duration: str
    dbc: tuple[str, ...]

    @property
    def log(self) -> Path:
        """The recording."""
        return HERE / f"{self.name}.log.gz"

    @property
    def golden(self) -> Path:
        """The events that it must give, a line of JSON each."""
        return HERE / f"{self.name}.jsonl"

    def events(self) -> bytes:
        """The events that it gives now. Raises RuntimeError when `ucs replay` fails."""
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "events.jsonl"
            _ucs("replay", self.log, "--dbc", *self.dbc, "--events", out)
            return out.read_bytes()

    def record(self) -> None:
        """Make the recording anew; the same nodes give the same bytes."""
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "traffic.log"
            _ucs("simulate", self.scenario, "--supervise", *self.dbc, "--duration", self.duration, "--log", log)
            self.log.write_bytes(gzip.compress(log.read_bytes(), 9, mtime=0))


EXAMPLES = (
    Example("healthy", "healthy", "30 s", ("flaming_tool.dbc",)),
    Example("flame_lit_again", "demo", "70 s", ("flaming_tool.dbc",)),
    Example("igniter_dead", "igniter_dead", "130 s", ("flaming_tool.dbc",)),
    Example("sprayer_faults", "sprayer_faults", "4 min", ("sprayer_boom.dbc",)),
    Example("tractor_engine", "vehicle_engine", "2 min", ("isobus_tractor.dbc", "vehicle.dbc")),
)


def changed(example: Example, golden: bytes, now: bytes) -> str:
    """Which events changed, in words; empty when none did."""
    if golden == now:
        return ""
    origin = next(iter(Log(example.log).frames())).t_ns
    old, new = ([event_line(event, since(event.t, seconds(origin))) for event in map(decode, text.splitlines())]
                for text in (golden, now))
    found = [line for line in difflib.unified_diff(old, new, lineterm="", n=0) if not line.startswith(("---", "+++", "@@"))]
    if not found:
        pairs = zip(golden.splitlines(), now.splitlines(), strict=False)
        found = [text for one, other in pairs if one != other for text in (f"- {one.decode()}", f"+ {other.decode()}")]
    more = [f"… and {len(found) - MOST_LINES} more"] if len(found) > MOST_LINES else []
    return "\n".join([f"{example.log.name}: the events changed (- as declared, + now):", *found[:MOST_LINES], *more, DECLARE])


def summary(folder: Path, names: Iterable[str]) -> Summary:
    """Of each of these recordings that can be read, what it gives."""
    found: Summary = {}
    catalog = season.encoded(load(SHARED_DBC))
    for name in names:
        outcome = season.work(season.Job(str(folder / name), catalog))
        if not outcome.error:
            counts: dict[str, list[int]] = {}
            for span in spans(outcome.decoded()):
                count = counts.setdefault(span.alarm, [0, 0])
                count[0] += 1
                count[1] += span.end is None
            digest = hashlib.sha256(b"\n".join(outcome.events)).hexdigest()
            found[name] = Recorded(outcome.frames, digest, dict(sorted(counts.items())))
    return found


def real_recordings(folder: Path = SHARED) -> list[str]:
    """Those of real machines that are on this machine, by their names in the folder."""
    return [os.path.relpath(name, folder) for name in season.recordings([str(folder)])]


def declared_summary() -> Summary:
    """What is declared of recordings of real machines."""
    return {name: Recorded(*each) for name, each in json.loads(SUMMARY.read_text()).items()}


def changed_summary(golden: Summary, now: Summary, present: Collection[str]) -> str:
    """What changed, in words; empty when nothing did. present: recordings that are there; others can't be judged, nor
    those that nobody has declared."""
    found = []
    for name in sorted(golden.keys() & set(present)):
        old, new = golden[name], now.get(name)
        if new is None:
            found.append(f"{name}: can no longer be read")
            continue
        told = [f"{name}: {alarm}: {_count(old.alarms.get(alarm))} → {_count(new.alarms.get(alarm))}"
                for alarm in sorted({*old.alarms, *new.alarms}) if old.alarms.get(alarm) != new.alarms.get(alarm)]
        if old.frames != new.frames:
            told.append(f"{name}: {old.frames} frames → {new.frames}")
        if not told and old.events != new.events:
            told.append(f"{name}: the same alarms, as often, but their events are others: `ucs replay --events` shows them")
        found += told
    return "\n".join(["the events of real recordings changed (as declared → now):", *found, DECLARE]) if found else ""


def _count(count: Sequence[int] | None) -> str:
    raised, standing = count or (0, 0)
    return f"{raised} raised, {standing} standing at the end"


def _ucs(*words: str | Path) -> None:
    """Run the command, quietly. Raises RuntimeError with what it said."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        code = main([str(word) for word in words])
    if code:
        raise RuntimeError(f"ucs {' '.join(map(str, words))}: {said.getvalue().strip()}")


def _write() -> None:
    parser = argparse.ArgumentParser(prog="python -m examples.golden", description="Write what the examples must give anew.")
    parser.add_argument("--record", action="store_true", help="make the recordings anew, too")
    args = parser.parse_args()
    for example in EXAMPLES:
        if args.record:
            example.record()
        before, now = example.golden.read_bytes() if example.golden.exists() else b"", example.events()
        example.golden.write_bytes(now)
        print(f"{example.golden.name:<24} {len(now.splitlines()):4} events{'' if before == now else ', changed'}")
    if SHARED.is_dir():
        SUMMARY.write_text(json.dumps(summary(SHARED, real_recordings()), indent=1, sort_keys=True) + "\n")
        print(f"{SUMMARY.name:<24} written")
    else:
        print(f"{SUMMARY.name:<24} left as it is: the recordings of real machines are not on this machine")


if __name__ == "__main__":
    _write()
