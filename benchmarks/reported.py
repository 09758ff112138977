"""What is reported of the shared recordings: `python -m benchmarks.reported` (`--write` puts it into docs/recordings.md).

Every recording beside this repository (`../shared/data`) goes through the whole chain with the shipped definitions; the table has
a line for each, with every alarm, when it was raised and when it cleared, in seconds of the recording. Exit status 2 where there
are no recordings.
"""
from __future__ import annotations

import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import NamedTuple

from benchmarks import page
from level1.catalog import Catalog
from level1.event import Event, seconds
from level1.io import definitions
from level1.io.replay import Log, LogError
from ucs.recording import Replay

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
PAGE = ROOT / "docs" / "recordings.md"
HEAD = ("recording", "length", "frames", "reported")


class Part(NamedTuple):
    """A table of the page. name: of its marks; folder, of `../shared/data`; definitions: shipped files."""

    name: str
    folder: str
    definitions: tuple[str, ...]


TRACTOR_BUS = ("isobus_tractor.dbc", "ucs.dbc")
PARTS = (Part("tractor", "jd5055e-tractor", TRACTOR_BUS), Part("receivers", "gpsd-nmea0183", ("ucs.dbc",)),
         Part("canedge", "css-canedge-mf4", TRACTOR_BUS), Part("boats", "canboat-nmea2000", TRACTOR_BUS),
         Part("battery", "kona-ev-battery", TRACTOR_BUS))
REPORTED = {"TroubleCode", "DeviceEmergency", "DeviceSilent"}
"""Alarms that subsystems report: their text says what; of the others their inputs do."""
NO_RECORDING = {".dbc", ".md", ".upstream"}
"""Ends of the names of files that accompany the recordings."""


def rows(part: Part) -> Iterator[tuple[str, ...]]:
    """The lines of a table, by name of the recording."""
    catalog = _catalog(part.definitions)
    for path in sorted(DATA.joinpath(part.folder).iterdir()):
        if path.suffix not in NO_RECORDING:
            yield row(path, catalog)


@cache
def _catalog(files: tuple[str, ...]) -> Catalog:
    return definitions.load(files)


def row(path: Path, catalog: Catalog) -> tuple[str, ...]:
    """The line of a recording."""
    try:
        log = Log(path, one_bus=True)
        replay = Replay(log, catalog, None)
        events = [event for batch in replay.batches() for event in batch]
    except LogError as refused:
        return f"`{path.name}`", "", "", str(refused).removeprefix(f"{path}: ").partition(";")[0]
    length = f"{(log.last_ns - log.first_ns) / 1e9:.1f} s"
    told = "; ".join(lives(events, seconds(log.first_ns)))
    return f"`{path.name}`", length, str(log.frames_read), told or "nothing"


def lives(events: list[Event], begin: Decimal) -> Iterator[str]:
    """Each alarm with what it saw, from its raising to its clearing, or to the end where it still stood."""
    ends = {event.instance: event.t - begin for event in events if event.event == "cleared"}
    for event in events:
        if event.event == "raised":
            seen = ", ".join(f"{name.rpartition('.')[2]} {value}" for name, value in event.values.items())
            what = event.text if event.alarm in REPORTED else seen
            end = f"{ends[event.instance]:.3f} s" if event.instance in ends else "end"
            yield f"**{event.alarm}** ({what}) {event.t - begin:.3f} s to {end}"


def main() -> int:
    """Print the tables, and write them."""
    parser = ArgumentParser(prog="python -m benchmarks.reported", description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    args = parser.parse_args()
    if not DATA.is_dir():
        print(f"there are no recordings at {DATA}", file=sys.stderr)
        return 2
    for part in PARTS:
        lines = page.table(HEAD, list(rows(part)))
        print(f"{part.folder}, with {' '.join(part.definitions)}", *lines, "", sep="\n", flush=True)
        if args.write:
            page.put(part.name, lines, PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
