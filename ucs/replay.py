"""`ucs replay`: alarm definitions over recordings, as fast as it can; every repair only reported."""
from __future__ import annotations

import os
import sys
import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

from level1.catalog import Catalog
from level1.event import Event, encode, seconds
from level1.io import config, definitions
from level1.io.error import OutsideError
from level1.io.merged import MergedLog
from level1.io.replay import Log
from ucs import onto, parquet, plot, season
from ucs.recording import Outcome, Replay, Through
from ucs.remarks import remarks
from ucs.render import WORDS, event_line, painted, since, wants_colour
from ucs.trace import Trace

PROGRESS_S = 0.2
POOL_BYTES = 8 << 20
"""Recordings smaller than this together are not worth other processes (each takes about a second to start)."""


def add_parser(commands: Any) -> None:
    """The arguments of `ucs replay`."""
    parser: ArgumentParser = commands.add_parser(
        "replay", help="run alarm definitions over recordings",
        description="Run alarm definitions over recordings (candump, ASC, BLF, TRC, csv, MF4, pcap, NMEA 0183 text, also with "
                    ".gz) as fast as it can, in the time of the recording. Every repair counts as armed unless --unit-toml says "
                    "otherwise; its frames are only reported.",
        epilog="Example: ucs replay drive.log --dbc isobus_tractor.dbc --events drive.jsonl")
    parser.add_argument("log", nargs="+", metavar="LOG", help="recordings, folders of them, patterns; each is a run of its own")
    parser.add_argument("--dbc", nargs="+", default=[], metavar="FILE", help="definitions; shipped ones go by name alone")
    parser.add_argument("--events", metavar="OUT.jsonl", help="write each event as a line of JSON; - for standard output")
    parser.add_argument("--parquet", metavar="OUT.parquet", help="write the events as a table for DuckDB, Polars and the like")
    parser.add_argument("--plot", metavar="OUT.png", help="draw what the alarms look at, the alarms and their repairs (also .svg, "
                        ".pdf); of several recordings a picture each, OUT-NAME.png")
    parser.add_argument("--unit-toml", metavar="FILE", help="which repairs are armed, which files belong to which bus")
    parser.add_argument("--bus", action="append", default=[], metavar="NAME=INDEX|[CHANNEL=]INTERFACE", type=_bus,
                        help="take this channel of the recording (with --merge also: this file) as the bus of that index (from 0); "
                        "or, with the name of an interface, the same as --onto")
    parser.add_argument("--onto", action="append", default=[], metavar="[CHANNEL=]INTERFACE", type=onto.target,
                        help="play the recording onto this bus, such as vcan0, in real time; --dbc may be left out then")
    parser.add_argument("--speed", type=onto.speed, metavar="N", help="onto a bus: so many times faster than recorded (1)")
    parser.add_argument("--interface", metavar="NAME", help=f"onto a bus: any interface of python-can ({onto.INTERFACE})")
    parser.add_argument("--bitrate", type=int, metavar="N", help="onto a bus: bit/s, for interfaces that need it")
    parser.add_argument("--scalar", action="store_true", help="read and evaluate frame by frame; slower, with the same events")
    parser.add_argument("--merge", action="store_true", help="the recordings are of one drive: one run, in the order of time")
    season.add_arguments(parser)


def run(args: Namespace) -> int:
    """Replay every recording; 2 when one could not be used."""
    channels = {name: place for name, place in args.bus if isinstance(place, int)}
    args.onto += [(name, place) for name, place in args.bus if isinstance(place, str)]
    unit = config.load(args.unit_toml) if args.unit_toml else None
    if not args.dbc and unit is None and not args.onto:
        raise OutsideError("no definitions: give --dbc FILE …, or --unit-toml FILE")
    paths = season.recordings(args.log)
    _check_onto(args, paths)
    if args.plot:
        plot.check(args.plot)
    if args.dbc or unit is None:
        catalog = definitions.load(args.dbc) if args.dbc else Catalog((), {}, {})
    else:
        catalog = definitions.load((), unit.bus_files, unit.bus_names)
    if unit:
        config.check_armed(unit, catalog)
    task = _Task(catalog, tuple(unit.repairs.armed) if unit else None,
                 {**(_bus_names(unit) if unit and not args.dbc else {}), **channels}, tuple(channels),
                 False if args.scalar else None)
    if args.onto:
        return _run_onto(paths, task, args)
    with ExitStack() as stack:
        out = _Out(args, stack)
        if len(paths) == 1 or args.merge:
            return _run_one(paths, task, out, picture=args.plot)
        if args.plot:
            return max(_run_one([path], task, out, picture=_picture_of(args.plot, path)) for path in paths)
        return _run_season(paths, task, args, out)


class _Task(NamedTuple):
    """What to run over each recording."""

    catalog: Catalog
    armed: tuple[str, ...] | None
    buses: dict[str, int]
    asked: tuple[str, ...]
    blocks: bool | None = None

    def replay(self, paths: Sequence[str], through: Through | None = None) -> Replay:
        """Of one recording, or of several as one. Raises LogError."""
        one_bus = not self.buses
        log = Log(paths[0], self.buses, one_bus=one_bus) if len(paths) == 1 else MergedLog(paths, self.buses, one_bus=one_bus)
        return Replay(log, self.catalog, self.armed, through, self.blocks)

    def job(self, path: str, catalog: bytes) -> season.Job:
        """The same, for another process."""
        return season.Job(path, catalog, self.armed, self.buses, self.asked, self.blocks)


class _Out:
    """Where the results go: JSON lines, Parquet, and text for people."""

    def __init__(self, args: Namespace, stack: ExitStack):
        self._events = _events_file(args.events, stack)
        self._table = stack.enter_context(parquet.table(args.parquet)) if args.parquet else None
        self.text = sys.stderr if args.events == "-" else sys.stdout
        self.colour = wants_colour(self.text)
        self.failed = 0
        self._totals: Counter[tuple[str, str]] = Counter()
        self._with: Counter[str] = Counter()
        self._standing: Counter[str] = Counter()

    def begin(self, path: str) -> None:
        """A recording begins."""
        print(painted(path, "1", self.colour), file=self.text)

    def event(self, path: str, first_ns: int, event: Event, line: bytes) -> None:
        """One event, also as its line of JSON."""
        if self._events:
            self._events.write(line + b"\n")
        if self._table:
            self._table.add(path, [event])
        print(event_line(event, since(event.t, seconds(first_ns)), self.colour), file=self.text)

    def end(self, outcome: Outcome, counts: Counter[tuple[str, str]], took_s: float | None = None) -> None:
        """The summary of a recording, and what was odd."""
        print(*_summary(outcome, counts, took_s), sep="\n", file=self.text, flush=True)
        for line in outcome.remarks:
            print(f"ucs: {outcome.path}: {line}", file=sys.stderr)

    def error(self, text: str) -> None:
        """A recording that could not be used."""
        self.failed += 1
        print(f"ucs: {text}", file=sys.stderr)

    def outcome(self, outcome: Outcome) -> None:
        """A recording that another process has done."""
        if outcome.error:
            self.error(outcome.error)
            return
        self.begin(outcome.path)
        counts: Counter[tuple[str, str]] = Counter()
        for line, event in zip(outcome.events, outcome.decoded(), strict=True):
            counts[event.alarm, event.event] += 1
            self.event(outcome.path, outcome.first_ns, event, line)
        self.end(outcome, counts)
        self._totals += counts
        self._with.update({alarm for alarm, _ in counts})
        self._standing.update(outcome.standing.keys())

    def totals(self) -> Iterator[str]:
        """Each alarm's count over all recordings."""
        for alarm in sorted(self._with):
            stood = f"; still there at the end of {self._standing[alarm]}" if self._standing[alarm] else ""
            yield f"  {alarm:<28} {_counted(self._totals, alarm)} in {self._with[alarm]} of them{stood}"


def _check_onto(args: Namespace, paths: Sequence[str]) -> None:
    """Whether what belongs to `--onto` fits together. Raises OutsideError."""
    if not args.onto:
        if args.speed or args.interface or args.bitrate:
            raise OutsideError("--speed, --interface and --bitrate need the bus to play onto: --bus vcan0")
        return
    if len(paths) > 1 and not args.merge:
        raise OutsideError(f"{len(paths)} recordings can't be played at once; give one, or --merge if they are of one drive")
    if len(args.onto) > 1 and not all(name for name, _ in args.onto):
        raise OutsideError("several buses: say which channel goes where, --bus can0=vcan0 --bus can1=vcan1")


def _run_onto(paths: Sequence[str], task: _Task, args: Namespace) -> int:
    """Play onto buses; with definitions, supervised at the same time."""
    named = {name: index for index, (name, _) in enumerate(args.onto) if name}
    task = task._replace(buses={**task.buses, **named}, asked=(*task.asked, *named))
    with ExitStack() as stack:
        player = onto.Player(stack.enter_context(onto.opened(args.onto, args.interface, args.bitrate)), args.speed or 1.0)
        out = _Out(args, stack)
        try:
            if args.dbc or args.unit_toml:
                return _run_one(paths, task, out, player.play, args.plot)
            replay = task.replay(paths)
            for _ in player.play(replay.log.batches()):
                pass
            for line in remarks(replay.log, {}, (), task.catalog, task.asked):
                print(f"ucs: {replay.log.path}: {line}", file=sys.stderr)
            return 0
        finally:
            print(player.summary(), file=out.text, flush=True)


def _run_one(paths: Sequence[str], task: _Task, out: _Out, through: Through | None = None, picture: str | None = None) -> int:
    """One recording, or several as one: told as it is read, and drawn."""
    trace = Trace(task.catalog) if picture else None
    drawn: list[Event] = []
    try:
        replay = task.replay(paths, _both(through, trace.through if trace else None))
        started, name = time.perf_counter(), str(replay.log.path)
        progress = _Progress(sys.stderr, replay.log)
        out.begin(name)
        for batch in replay.batches():
            progress.clear()
            for event in batch:
                out.event(name, replay.log.first_ns, event, encode(event))
            drawn += batch if trace else ()
            progress.show(replay.log.frames_read)
        progress.clear()
        out.end(replay.outcome(task.asked), replay.counts, time.perf_counter() - started)
        if trace and picture:
            plot.draw(trace, drawn, picture, replay.log.path.name)
    except OutsideError as error:
        out.error(str(error))
    return 2 if out.failed else 0


def _both(first: Through | None, second: Through | None) -> Through | None:
    if first is None or second is None:
        return first or second
    return lambda batches: second(first(batches))


def _picture_of(picture: str, path: str) -> str:
    """The picture's name of one recording among several."""
    name = Path(picture)
    return str(name.with_name(f"{name.stem}-{Path(path).name.partition('.')[0]}{name.suffix}"))


def _run_season(paths: Sequence[str], task: _Task, args: Namespace, out: _Out) -> int:
    """Many recordings, in several processes or on a cluster; the results in the order of the arguments."""
    catalog = season.encoded(task.catalog)
    jobs = [task.job(path, catalog) for path in paths]
    started, waiting, done = time.perf_counter(), iter(paths), dict[str, Outcome]()
    told, frames, following = 0, 0, next(waiting, None)
    try:
        with season.progress(len(jobs), sys.stderr) as show:
            def take(outcome: Outcome) -> None:
                nonlocal told, frames, following
                told, frames = told + 1, frames + outcome.frames
                done[outcome.path] = outcome
                if following in done and sys.stderr.isatty():
                    print(end="\r\033[K", file=sys.stderr, flush=True)
                while following in done:
                    out.outcome(done.pop(following))
                    following = next(waiting, None)
                show(outcome)
            season.run(jobs, workers=args.jobs or _workers(paths, args.scheduler), scheduler=args.scheduler,
                       cache=season.cache_folder(), fresh=args.fresh, told=take)
    except KeyboardInterrupt:
        print(f"ucs: {told} of {len(jobs)} recordings are done and kept; the same command goes on from there", file=sys.stderr)
        raise
    took_s = time.perf_counter() - started
    print(f"{len(jobs)} recordings, {frames:,} frames in {took_s:.3f} s ({frames / took_s:,.0f} frames/s)", *out.totals(),
          sep="\n", file=out.text)
    return 2 if out.failed else 0


def _workers(paths: Sequence[str], scheduler: str | None) -> int | None:
    """1 where processes would cost more than they bring, else None."""
    size = sum(os.stat(path).st_size for path in paths if os.path.exists(path))
    return 1 if scheduler is None and size < POOL_BYTES else None


class _Progress:
    """How far a long recording is, on a terminal."""

    def __init__(self, stream: TextIO, log: Log | MergedLog):
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


def _summary(outcome: Outcome, counts: Counter[tuple[str, str]], took_s: float | None) -> Iterator[str]:
    """What was read, how fast, and each alarm's count."""
    duration_s = (outcome.last_ns - outcome.first_ns) / 1e9
    speed = "" if took_s is None else f" in {took_s:.3f} s ({outcome.frames / took_s:,.0f} frames/s)"
    yield f"  {outcome.frames:,} frames, {duration_s:,.3f} s of recording{speed}"
    alarms = sorted({alarm for alarm, _ in counts})
    for alarm in alarms:
        end = f"; at the end {outcome.standing[alarm]}" if alarm in outcome.standing else ""
        yield f"  {alarm:<28} {_counted(counts, alarm)}{end}"
    if not alarms:
        yield "  no alarm"
    if outcome.sends:
        yield f"  repairs would have sent {outcome.sends:,} frames"
    yield ""


def _counted(counts: Counter[tuple[str, str]], alarm: str) -> str:
    return ", ".join(f"{counts[alarm, word]} × {WORDS[word]}" for word in WORDS if counts[alarm, word])


def _events_file(path: str | None, stack: ExitStack) -> BinaryIO | None:
    """Where the JSON lines go."""
    if path is None:
        return None
    if path == "-":
        return sys.stdout.buffer
    return stack.enter_context(open(path, "wb"))


def _bus(text: str) -> tuple[str, int | str]:
    """`can1=0`, a channel's bus; or as `onto.target`. Raises ArgumentTypeError."""
    name, _, place = text.rpartition("=")
    if name and place.isdigit():
        return name, int(place)
    try:
        return onto.target(text)
    except ArgumentTypeError:
        raise ArgumentTypeError(f'"{text}" is neither NAME=INDEX, such as can1=0, nor an interface, such as vcan0') from None


def _bus_names(unit: config.Config) -> dict[str, int]:
    """Channels and names of a unit's buses; nothing where it has one, which then takes every channel."""
    if len(unit.bus) == 1:
        return {}
    return {name: index for index, bus in enumerate(unit.bus) for name in (bus.name, bus.channel)}
