"""`ucs replay`: alarm definitions over recordings, as fast as it can; every repair only reported."""
from __future__ import annotations

import sys
import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack
from typing import Any, BinaryIO, TextIO

from level1.catalog import NORMAL, Catalog
from level1.event import Event, Send, encode, seconds
from level1.frame import BUS_SHIFT, ERROR, REMOTE, frame_key, j1939_pgn
from level1.io import config, definitions
from level1.io.error import OutsideError
from level1.io.replay import Log
from level1.supervisor import STATE_WORDS, Supervisor
from ucs.render import WORDS, event_line, painted, since, wants_colour

UNIT, BOOT = "replay", 1
"""Identity of a replay's events; every recording is a run of its own, so that it gives the same bytes beside others."""
PROGRESS_S = 0.2


def add_parser(commands: Any) -> None:
    """The arguments of `ucs replay`."""
    parser: ArgumentParser = commands.add_parser(
        "replay", help="run alarm definitions over recordings",
        description="Run alarm definitions over recordings (candump, ASC, BLF, TRC, csv, also with .gz) as fast as it can, "
                    "in the time of the recording. Every repair counts as armed unless --unit-toml says otherwise; its "
                    "frames are only reported.",
        epilog="Example: ucs replay drive.log --dbc isobus_tractor.dbc --events drive.jsonl")
    parser.add_argument("log", nargs="+", metavar="LOG", help="recording; each is a run of its own")
    parser.add_argument("--dbc", nargs="+", default=[], metavar="FILE", help="definitions; shipped ones go by name alone")
    parser.add_argument("--events", metavar="OUT.jsonl", help="write each event as a line of JSON; - for standard output")
    parser.add_argument("--unit-toml", metavar="FILE", help="which repairs are armed, which files belong to which bus")
    parser.add_argument("--bus", action="append", default=[], metavar="NAME=INDEX", type=_bus,
                        help="take this channel of the recording as the bus of that index (from 0)")


def run(args: Namespace) -> int:
    """Replay every recording; 2 when one could not be used."""
    unit = config.load(args.unit_toml) if args.unit_toml else None
    if not args.dbc and unit is None:
        raise OutsideError("no definitions: give --dbc FILE …, or --unit-toml FILE")
    catalog = definitions.load(args.dbc) if args.dbc or unit is None else definitions.load((), unit.bus_files, unit.bus_names)
    if unit:
        config.check_armed(unit, catalog)
    armed = unit.repairs.armed if unit else None
    buses = {**(_bus_names(unit) if unit and not args.dbc else {}), **dict(args.bus)}
    with ExitStack() as stack:
        events = _events_file(args.events, stack)
        text = sys.stderr if args.events == "-" else sys.stdout
        failed = 0
        for path in args.log:
            try:
                replay = Replay(Log(path, buses, one_bus=not buses), catalog, armed)
                _replay(replay, events, text)
                for line in _remarks(replay, catalog, {name for name, _ in args.bus}):
                    print(f"ucs: {path}: {line}", file=sys.stderr)
            except OutsideError as error:
                failed += 1
                print(f"ucs: {error}", file=sys.stderr)
    return 2 if failed else 0


class Replay:
    """A recording run through a supervisor of its own.

    counts: (alarm, event) -> how often. sends: frames that repairs would have sent. keys: of all frames seen.
    """

    def __init__(self, log: Log, catalog: Catalog, armed: Collection[str] | None):
        self.log = log
        self.supervisor = Supervisor(catalog, unit=UNIT, boot=BOOT, armed=armed, broadcast=False)
        self.counts: Counter[tuple[str, str]] = Counter()
        self.sends = 0
        self.keys: set[int] = set()

    def batches(self) -> Iterator[list[Event]]:
        """The events, a list for each batch of frames; ends with the deadlines up to the last time stamp."""
        for batch in self.log.batches():
            if self.log.is_utc:
                self.supervisor.utc_offset_ns = 0
            self.keys.update([frame.key for frame in batch])
            yield self._events(self.supervisor.receive_many(batch))
        yield self._events(self.supervisor.tick(self.log.last_ns))

    def _events(self, outputs: Iterable[Any]) -> list[Event]:
        events = []
        for output in outputs:
            if isinstance(output, Event):
                self.counts[output.alarm, output.event] += 1
                events.append(output)
            else:
                self.sends += isinstance(output, Send)
        return events


class _Progress:
    """How far a long recording is, on a terminal."""

    def __init__(self, stream: TextIO, log: Log):
        self._stream, self._log = stream, log
        self._next = time.monotonic() + PROGRESS_S if stream.isatty() else float("inf")
        self._shown = False

    def show(self, frames: int) -> None:
        """Say it, at most every `PROGRESS_S`."""
        now = time.monotonic()
        if now >= self._next:
            self._next, self._shown = now + PROGRESS_S, True
            self._stream.write(f"\r{self._log.fraction:5.0%}  {frames:,} frames\033[K")
            self._stream.flush()

    def clear(self) -> None:
        """Take it away, before something else is printed."""
        if self._shown:
            self._stream.write("\r\033[K")
            self._stream.flush()
            self._shown = False


def known_ids(catalog: Catalog, keys: Iterable[int]) -> set[int]:
    """Those keys of frames that belong to a message of the catalog."""
    exact, groups = set(), set()
    for message in catalog.messages.values():
        for bus in catalog.buses.get(message.name, (0,)):
            if message.j1939 and message.pgn is not None:
                groups.add((bus, message.pgn, message.source))
            else:
                exact.add(frame_key(message.can_id, message.extended, bus))
    return {key for key in keys if key in exact or any(
        (key >> BUS_SHIFT, j1939_pgn(key & 0x1FFFFFFF), source) in groups for source in (None, key & 0xFF))}


def _replay(replay: Replay, events: BinaryIO | None, text: TextIO) -> None:
    """One recording: its events and its summary."""
    log = replay.log
    progress, colour, started = _Progress(sys.stderr, log), wants_colour(text), time.perf_counter()
    print(painted(str(log.path), "1", colour), file=text)
    for batch in replay.batches():
        progress.clear()
        for event in batch:
            if events:
                events.write(encode(event) + b"\n")
            print(event_line(event, since(event.t, seconds(log.first_ns)), colour), file=text)
        progress.show(log.frames_read)
    progress.clear()
    print(*_summary(replay, time.perf_counter() - started), sep="\n", file=text, flush=True)


def _summary(replay: Replay, took_s: float) -> Iterator[str]:
    """What was read, how fast, and each alarm's count."""
    log, supervisor = replay.log, replay.supervisor
    duration_s = (log.last_ns - log.first_ns) / 1e9
    yield (f"  {log.frames_read:,} frames, {duration_s:,.3f} s of recording in {took_s:.3f} s "
           f"({log.frames_read / took_s:,.0f} frames/s)")
    standing = supervisor.alarm_states()
    alarms = sorted({alarm for alarm, _ in replay.counts})
    for alarm in alarms:
        counts = ", ".join(f"{replay.counts[alarm, word]} × {WORDS[word]}" for word in WORDS if replay.counts[alarm, word])
        end = f"; at the end {STATE_WORDS[standing[alarm]]}" if standing[alarm] != NORMAL else ""
        yield f"  {alarm:<28} {counts}{end}"
    if not alarms:
        yield "  no alarm"
    if replay.sends:
        yield f"  repairs would have sent {replay.sends:,} frames"
    yield ""


def _remarks(replay: Replay, catalog: Catalog, asked: set[str]) -> Iterator[str]:
    """What was odd about the recording. asked: channels that `--bus` names."""
    log = replay.log
    if log.skipped:
        yield f"{log.complaints[0]}; {log.skipped:,} {'line' if log.skipped == 1 else 'lines'} skipped in all"
    if log.error_frames or log.remote_frames:
        yield f"{log.error_frames:,} error frames, {log.remote_frames:,} remote frames"
    if backwards := replay.supervisor.counters["time stamps that ran backwards"]:
        yield f"{backwards:,} time stamps ran backwards and were taken as the highest before them"
    data = {key for key in replay.keys if not key & (ERROR | REMOTE)}
    if data and not known_ids(catalog, data):
        yield (f"none of the {len(data)} ids in this recording ({_some_ids(data)}) is in these definitions; "
               "give the DBC files of the machine that was recorded")
    for name in sorted(asked - log.channels_seen):
        yield f"no frame of a channel {name}; its channels: {', '.join(sorted(log.channels_seen))}"


def _some_ids(keys: Iterable[int]) -> str:
    names = [f"{key & 0x1FFFFFFF:0{8 if key >> 31 & 1 else 3}X}" for key in sorted(keys)]
    return ", ".join(names[:5]) + (", …" if len(names) > 5 else "")


def _events_file(path: str | None, stack: ExitStack) -> BinaryIO | None:
    """Where the JSON lines go."""
    if path is None:
        return None
    if path == "-":
        return sys.stdout.buffer
    return stack.enter_context(open(path, "wb"))


def _bus(text: str) -> tuple[str, int]:
    """`can1=0`. Raises ArgumentTypeError."""
    name, _, index = text.rpartition("=")
    if not name or not index.isdigit():
        raise ArgumentTypeError(f'"{text}" is not of the form NAME=INDEX, such as can1=0')
    return name, int(index)


def _bus_names(unit: config.Config) -> dict[str, int]:
    """Channels and names of a unit's buses; nothing where it has one, which then takes every channel."""
    if len(unit.bus) == 1:
        return {}
    return {name: index for index, bus in enumerate(unit.bus) for name in (bus.name, bus.channel)}
