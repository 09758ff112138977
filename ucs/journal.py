"""`ucs journal`: what happened on a unit: list, filter, follow, export."""
from __future__ import annotations

import argparse
import csv
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from level1.event import EVENTS, Commanded, Event, Monitor, encode
from level1.io.config import ConfigError, duration_ns, load
from level1.io.error import OutsideError, did_you_mean
from level1.io.journal import FIRST, JournalError, Position, Reader
from ucs import history

POLL_S = 0.1
CHUNK = 1000
CSV_COLUMNS = ("unit", "boot", "seq", "t", "utc", "utc_trusted", "alarm", "code", "priority", "event", "instance", "attempt",
               "passive", "text", "values", "frames")
COMMAND = "command"
"""Stands for commands among the kinds of events."""
Entry = Event | Commanded
Writer = Callable[[Entry], None]
_encoder = msgspec.json.Encoder(decimal_format="number")
DESCRIPTION = """\
Lists what is in a unit's journal, oldest first: of events time, boot.seq, alarm, event, text; among them the commands that reached
supervision, and what came of each. Reads only; `ucs run` may be running. With --monitor the monitoring history instead, as it was
written: a minute at a time.
"""
EPILOG = """\
Times are UTC labels (2025-05-01, 2025-05-01T10:30, …10:30:05Z), or "15 min" and the like before now.

  ucs journal unit.toml --since "2 h" --alarm PilotFlameOut --values
  ucs journal unit.toml --event command --values
  ucs journal unit.toml --follow
  ucs journal unit.toml --monitor motion --since "10 min"
  ucs journal /media/card/journal.db --format csv > events.csv
"""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs journal`."""
    parser = subparsers.add_parser("journal", help="list and export what a unit's journal holds", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("unit", metavar="unit.toml", type=Path, help="the unit's configuration, or a journal file (.db)")
    parser.add_argument("--alarm", metavar="NAME", help="only this alarm, and commands about it")
    parser.add_argument("--event", choices=(*EVENTS, COMMAND), help="only events of this kind, or commands")
    parser.add_argument("--since", metavar="TIME", help="only events from this time on; events without UTC are left out")
    parser.add_argument("--until", metavar="TIME", help="only events before this time")
    parser.add_argument("--boot", metavar="N", type=int, help="only this boot of the unit")
    parser.add_argument("--last", metavar="N", type=int, help="only the last N of them")
    parser.add_argument("--values", action="store_true", help="show the freeze frame and the frames sent")
    parser.add_argument("--monitor", metavar="MESSAGE", nargs="?", const="",
                        help="the monitoring history instead, of all monitoring messages or of one")
    parser.add_argument("--follow", action="store_true", help="go on with new events as they come")
    parser.add_argument("--format", choices=("text", "jsonl", "csv"), default="text", help="jsonl and csv for other programs")


def run(args: argparse.Namespace) -> int:
    """Print what was asked for. Raises OutsideError for what the user can put right."""
    if args.last is not None and args.last < 1:
        raise OutsideError(f"--last {args.last}: write a number from 1")
    query = Query(args.alarm, args.event, _moment("--since", args.since), _moment("--until", args.until), args.boot)
    write = {"text": _text_writer(args.values), "jsonl": _write_json, "csv": _csv_writer()}[args.format]
    path = _journal_path(args.unit)
    if args.monitor is not None:
        return history.show(path, _of_monitoring(args), query, args.last, args.format, args.values)
    if args.follow and not _await(path):
        return 0
    with Reader(path) as reader:
        listing = Listing(reader, query)
        found = listing.new()
        count = 0
        for entry in found if args.last is None else deque(found, args.last):
            write(entry)
            count += 1
        if not count and not args.follow:
            print(f"ucs journal: {_nothing(reader, query)}", file=sys.stderr)
        if args.follow:
            _follow(reader, listing, write)
    return 0


def _nothing(reader: Reader, query: Query) -> str:
    """Why nothing was found."""
    if reader.last() == FIRST:
        return "nothing yet"
    names = {event.alarm for event in Listing(reader, Query()).new() if isinstance(event, Event)} if query.alarm else set()
    if query.alarm and query.alarm not in names:
        return f'no event of an alarm called "{query.alarm}"{did_you_mean(query.alarm, names)}'
    return "nothing of the kind"


class Query(NamedTuple):
    """Which events and commands; None: any. since and until compare with the UTC label."""

    alarm: str | None = None
    event: str | None = None
    since: datetime | None = None
    until: datetime | None = None
    boot: int | None = None

    def in_time(self, entry: Entry | Monitor) -> bool:
        """Whether it is within the times asked for; what has no UTC is not, when any is."""
        if self.since is None and self.until is None:
            return True
        if entry.utc is None:
            return False
        utc = _utc(entry.utc)
        return (self.since is None or utc >= self.since) and (self.until is None or utc < self.until)

    def has_command(self, command: Commanded) -> bool:
        """Whether a command is asked for."""
        return self.event in (None, COMMAND) and self.alarm in (None, command.target) and self.boot in (None, command.boot)


class Listing:
    """Goes through a journal once, and on from there."""

    def __init__(self, reader: Reader, query: Query):
        self._reader, self._query = reader, query
        self._after: Position = FIRST if query.boot is None else (query.boot, 0)
        self._commands_after: Position = FIRST
        self._before: Position | None = None if query.boot is None else (query.boot + 1, 0)

    def new(self) -> Iterator[Entry]:
        """What was asked for and not given yet: events, and each command behind the events before it. Raises JournalError."""
        entries: Iterator[Entry] = merge(self._events(), self._commands(), key=_place)
        yield from filter(self._query.in_time, entries)

    def _events(self) -> Iterator[Event]:
        if self._query.event == COMMAND:
            return
        end = self._reader.last()
        while True:
            events = self._reader.events(self._after, CHUNK, before=self._before, alarm=self._query.alarm, event=self._query.event)
            for event in events:
                self._after = (event.boot, event.seq)
                yield event
            if len(events) < CHUNK:
                break
        self._after = max(self._after, end)

    def _commands(self) -> Iterator[Commanded]:
        while commands := self._reader.commands(self._commands_after, CHUNK):
            for position, command in commands:
                self._commands_after = position
                if self._query.has_command(command):
                    yield command


def _place(entry: Entry) -> tuple[int, int, bool]:
    return (entry.boot, entry.seq, False) if isinstance(entry, Event) else (entry.boot, entry.after, True)


def _await(path: Path) -> bool:
    """Wait for a journal that `ucs run` has not begun yet; False after Ctrl-C."""
    try:
        if not path.exists():
            print(f"ucs journal: {path} is not there yet; waiting for `ucs run`", file=sys.stderr)
        while not (path.exists() and path.stat().st_size):
            time.sleep(POLL_S)
        return True
    except KeyboardInterrupt:
        return False


def _follow(reader: Reader, listing: Listing, write: Writer) -> None:
    """New events as they come, until Ctrl-C."""
    try:
        while True:
            sys.stdout.flush()
            time.sleep(POLL_S)
            try:
                news = list(listing.new()) if reader.changed() else []
            except JournalError:
                continue  # being replaced; the reader finds the new one
            for entry in news:
                write(entry)
    except KeyboardInterrupt:
        pass


def _journal_path(path: Path) -> Path:
    """The journal of a configuration, or the journal itself. Raises ConfigError."""
    if path.suffix != ".toml":
        return path
    config = load(path)
    if config.journal is None:
        raise ConfigError(f'{path}: journal: missing; write [journal] path = "/var/lib/ucs/journal.db"')
    return Path(config.journal.path)


def _of_monitoring(args: argparse.Namespace) -> str:
    """The message that --monitor names. Raises OutsideError for options that don't go with it."""
    if args.follow:
        raise OutsideError("--monitor --follow: the history is written a minute at a time; `ucs monitor unit.toml` shows it live")
    for option in ("alarm", "event"):
        if getattr(args, option) is not None:
            raise OutsideError(f"--monitor --{option}: leave one of the two out; monitoring messages are no events")
    return str(args.monitor)


def _moment(option: str, text: str | None) -> datetime | None:
    """A point in time as the options take it. Raises OutsideError."""
    if text is None:
        return None
    try:
        return datetime.now(UTC) - timedelta(microseconds=duration_ns(text) // 1000)
    except ValueError:
        pass
    try:
        return _utc(text)
    except ValueError:
        raise OutsideError(f'{option} "{text}": no time; write 2025-05-01, 2025-05-01T10:30 (UTC), or "15 min"') from None


def _utc(text: str) -> datetime:
    found = datetime.fromisoformat(text)
    return found if found.tzinfo else found.replace(tzinfo=UTC)


def _text_writer(values: bool) -> Writer:
    def write(entry: Entry) -> None:
        moment = entry.utc or f"{entry.t:.3f} s"
        unsure = " (clock not synchronised)" * (entry.utc is not None and not entry.utc_trusted)
        if isinstance(entry, Commanded):
            print(f"{moment}  {entry.boot}  {COMMAND}  {_told(entry)}{unsure}")
        else:
            attempt = f" {entry.attempt}" if entry.attempt else ""
            notes = " (passive)" * entry.passive + unsure
            print(f"{moment}  {entry.boot}.{entry.seq}  {entry.alarm}  {entry.event}{attempt}  {entry.text}{notes}")
        if values:
            for name, value in entry.values.items() if isinstance(entry, Event) else ():
                print(f"    {name} = {value}")
            for frame in entry.frames:
                print(f"    sent {frame.message} {frame.id}#{frame.data}")
    return write


def _told(command: Commanded) -> str:
    """`reduce_speed 2 by chief (c-17): done`."""
    value = "" if command.value is None else f" {command.value}"
    target = f" {command.target}" if command.target else ""
    reason = f": {command.reason}" if command.reason else ""
    who = command.by or ("someone at the machine" if command.origin == "local" else "level 2")
    return f"{command.command}{target}{value} by {who} ({command.id}): {command.outcome}{reason}"


def _write_json(entry: Entry) -> None:
    print(encode(entry).decode())


def _csv_writer() -> Writer:
    """Columns as the keys of an event; values and frames as JSON in one cell each. A command has the `seq` of the event before."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    started = False

    def write(entry: Entry) -> None:
        nonlocal started
        if not started:
            writer.writerow(CSV_COLUMNS)
            started = True
        cells = dict.fromkeys(CSV_COLUMNS, "") | {name: getattr(entry, name) for name in CSV_COLUMNS if hasattr(entry, name)}
        if isinstance(entry, Event):
            cells["values"] = _json(entry.values)
        else:
            cells |= {"seq": entry.after, "alarm": entry.target, "event": COMMAND, "text": _told(entry)}
        writer.writerow((cells | {"frames": _json(entry.frames)}).values())
    return write


def _json(value: object) -> str:
    return _encoder.encode(value).decode()
