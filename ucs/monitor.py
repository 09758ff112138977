"""`ucs monitor`: alarms and repairs beside the signals, live in the terminal. It only listens and asks; it can't send."""
from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

from level1.catalog import Catalog
from level1.event import Event
from level1.frame import Frame
from level1.io import config
from level1.io.config import Bus, Config
from level1.io.error import OutsideError
from level1.io.inquiry import Silence
from ucs import pages
from ucs.pages import PAGES, Sight, View
from ucs.render import roughly, wants_colour
from ucs.standing import BusStanding, RunStanding, ask_run
from ucs.watching import EVENTS, Watching, silent

REFRESH_S = 0.25
DRAIN_S = 0.02
"""So often what the interfaces hold is taken, that nothing runs over."""
LAG_NS = 50_000_000
"""Time passes so much later for the core than for the clock: a frame on its way from an interface still counts."""
RETRY_NS = 2_000_000_000
ASK_S = 0.25
LISTEN_S = 3.0
"""For a snapshot: long enough for rates."""
DESCRIPTION = """\
A live view of a unit in the terminal: alarms with their repairs, step by step, beside the signals with rate, age and quality,
and the buses. It only listens: it sends nothing and disturbs no supervision that runs.
"""
EPILOG = """\
  ucs monitor unit.toml                                      what the running `ucs run` knows, and its buses
  ucs monitor --bus can0 --dbc ucs.dbc flaming_tool.dbc      a bus without any unit.toml
  ucs monitor --interface udp_multicast --channel 239.74.163.2 --dbc seeder.dbc
  ucs monitor drive.log --dbc seeder.dbc --speed 10          a recording, ten times as fast

Keys: q or Ctrl-C ends; tab or 1 to 4 changes the page; / shows only what has a text in its name, escape shows all again;
p or space pauses; arrows, PgUp and PgDn scroll. Where `ucs run` does not run, alarms are shown as they look from here, and
nothing is repaired. Where the output is no terminal, one snapshot is printed (see --once).
"""


class Source(Protocol):
    """Where frames come from."""

    @property
    def names(self) -> Sequence[str]:
        """Of the buses, by index."""

    def now_ns(self) -> int:
        """Time on the line of the stamps."""

    def utc_offset_ns(self) -> int | None:
        """UTC minus that time; None: not known."""

    def take(self) -> list[Frame]:
        """The frames since the last call, in order."""

    def buses(self) -> list[BusStanding]:
        """How the buses stand, as far as it can be seen from here."""

    def notes(self) -> list[str]:
        """What to know of the source itself."""

    def pause(self, on: bool) -> None:
        """The view is paused, or goes on."""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs monitor`."""
    parser = subparsers.add_parser("monitor", help="watch alarms, repairs, signals and buses live", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="unit.toml | LOG", nargs="?", help="a unit's configuration, or a recording")
    parser.add_argument("--dbc", metavar="FILE", nargs="+", default=[], help="definitions, where there is no unit.toml")
    parser.add_argument("--bus", metavar="CHANNEL", help="a SocketCAN interface to listen on, such as can0")
    parser.add_argument("--interface", metavar="NAME", help="another interface of python-can, such as udp_multicast")
    parser.add_argument("--channel", metavar="NAME", help="its channel")
    parser.add_argument("--bitrate", metavar="N", type=int, help="bit/s, where the interface has to be told")
    parser.add_argument("--speed", metavar="N", type=_speed, default=1.0, help="of a recording: 1 is as recorded (default)")
    parser.add_argument("--page", choices=PAGES, default=PAGES[0], help="page to begin with (default: %(default)s)")
    parser.add_argument("--once", metavar="DURATION", nargs="?", type=_seconds, const=LISTEN_S,
                        help='listen for so long ("3 s"), print one snapshot and end')


def run(args: argparse.Namespace) -> int:
    """Show until the user has seen enough. Raises OutsideError, DefinitionError."""
    from ucs.terminal import out_is_terminal
    _check(args)
    with ExitStack() as stack:
        monitor = _monitor(args, stack)
        if args.once is not None or not out_is_terminal():
            _once(monitor, args.page, args.once or LISTEN_S)
        else:
            _show(monitor, args.page)
    return 0


def _check(args: argparse.Namespace) -> None:
    unit = bool(args.source) and args.source.endswith(".toml")
    live = bool(args.bus or args.interface or args.channel)
    if args.source and live:
        raise OutsideError("give a unit.toml, a recording, or a bus, not two of them")
    if not args.source and not live:
        raise OutsideError("what to watch? give a unit.toml, a recording, or --bus CHANNEL (see ucs monitor --help)")
    if args.bus and (args.interface or args.channel):
        raise OutsideError("--bus names a SocketCAN interface: give it, or --interface and --channel, not both")
    if live and not args.bus and not args.channel:
        raise OutsideError(f"--interface {args.interface}: give its --channel too")
    if unit and args.dbc:
        raise OutsideError("--dbc: unit.toml names the definitions of its buses; leave it out")
    if not unit and not args.dbc:
        raise OutsideError("--dbc FILE: missing; it says what the frames mean (shipped ones by name, such as flaming_tool.dbc)")


def _monitor(args: argparse.Namespace, stack: ExitStack) -> Monitor:
    from level1.io import definitions
    if args.source and args.source.endswith(".toml"):
        settings = config.load(args.source)
        catalog = definitions.load((), settings.bus_files, settings.bus_names)
        unit = Unit(settings) if settings.journal else None
        if unit:
            stack.callback(unit.close)
        return Monitor(f"{settings.unit.name} of {settings.unit.fleet}", catalog, Listening(settings.bus, stack), unit)
    catalog = definitions.load(args.dbc)
    if args.source:
        return Monitor(Path(args.source).name, catalog, Recording(args.source, args.speed))
    channel = args.bus or args.channel
    bus = Bus(name=channel, channel=channel, interface=args.interface or "socketcan", bitrate=args.bitrate)
    listening = Listening((bus,), stack)
    if problem := listening.problems.get(0):
        raise OutsideError(problem)
    return Monitor(channel, catalog, listening)


# --- where frames come from -------------------------------------------------------------------------------------------------


class Listening:
    """The buses, listened to. problems: why one can't be opened, by its index; it is tried again and again."""

    def __init__(self, buses: Sequence[Bus], stack: ExitStack):
        from level1.io.can import Port
        from level1.io.inbox import Inbox
        self.names: Sequence[str] = [bus.name for bus in buses]
        self.problems: dict[int, str] = {}
        self._inbox = Inbox()
        self._ports = [Port(index, bus, self._inbox, time.monotonic_ns, time.time_ns) for index, bus in enumerate(buses)]
        self._retry_ns = 0
        for port in self._ports:
            stack.callback(port.stop)
        self._open(range(len(buses)))

    def now_ns(self) -> int:
        """Of the monotonic clock."""
        return time.monotonic_ns()

    def utc_offset_ns(self) -> int | None:
        """By the wall clock."""
        return time.time_ns() - time.monotonic_ns()

    def take(self) -> list[Frame]:
        """See `Source`."""
        if self.problems and self.now_ns() >= self._retry_ns:
            self._open(list(self.problems))
        frames = [*self._inbox.take().frames, *(Frame(*row) for port in self._ports for row in port.fetch())]
        frames.sort(key=itemgetter(0))
        return frames

    def buses(self) -> list[BusStanding]:
        """See `Source`."""
        from ucs.attendant import bus_standing
        now_ns = self.now_ns()
        return [bus_standing(port, now_ns, "BusDown" if index in self.problems else port.state)
                for index, port in enumerate(self._ports)]

    def notes(self) -> list[str]:
        """See `Source`."""
        return [f"not visible from here: {problem}" for problem in self.problems.values()]

    def pause(self, on: bool) -> None:
        """A bus can't be paused."""

    def _open(self, indexes: Sequence[int] | range) -> None:
        from level1.io.can import BusError
        self._retry_ns = self.now_ns() + RETRY_NS
        for index in indexes:
            try:
                self._ports[index].start()
                self.problems.pop(index, None)
            except BusError as error:
                self.problems[index] = error.problems[0]


class Recording:
    """A recording, at its own pace or a multiple of it."""

    def __init__(self, path: str, speed: float):
        from level1.io.replay import Log
        self._log = Log(path)
        self._batches: Iterator[list[Frame]] = self._log.batches()
        self._waiting: deque[Frame] = deque()
        self._speed = speed
        self._fill()
        self._begun_ns = time.monotonic_ns()
        self._paused_ns: int | None = None
        self._received, self._last_ns = 0, self._log.first_ns

    @property
    def names(self) -> Sequence[str]:
        """The channels in it."""
        return sorted(self._log.channels, key=lambda name: self._log.channels[name])

    def now_ns(self) -> int:
        """On the recording's time line; it ends with it."""
        real_ns = self._paused_ns if self._paused_ns is not None else time.monotonic_ns()
        now_ns = self._log.first_ns + round((real_ns - self._begun_ns) * self._speed)
        return now_ns if self._waiting else min(now_ns, self._log.last_ns)

    def utc_offset_ns(self) -> int | None:
        """The stamps of most recordings are UTC."""
        return 0 if self._log.is_utc else None

    def take(self) -> list[Frame]:
        """See `Source`."""
        now_ns = self.now_ns()
        found: list[Frame] = []
        while self._waiting and self._waiting[0].t_ns <= now_ns:
            found.append(self._waiting.popleft())
            if not self._waiting:
                self._fill()
        self._received += len(found)
        self._last_ns = found[-1].t_ns if found else self._last_ns
        return found

    def buses(self) -> list[BusStanding]:
        """All channels of the recording as one."""
        quiet_s = max(0, self.now_ns() - self._last_ns) / 1e9
        return [BusStanding(self._log.path.name, "recording", "", "BusActive", self._received, 0, quiet_s)]

    def notes(self) -> list[str]:
        """See `Source`."""
        second = (self.now_ns() - self._log.first_ns) / 1e9
        end = "" if self._waiting else "; this is its end"
        return [f"{second:.1f} s of the recording, at {self._speed:g} times its speed{end}"]

    def pause(self, on: bool) -> None:
        """The recording waits too."""
        now_ns = time.monotonic_ns()
        if on and self._paused_ns is None:
            self._paused_ns = now_ns
        elif not on and self._paused_ns is not None:
            self._begun_ns += now_ns - self._paused_ns
            self._paused_ns = None

    def _fill(self) -> None:
        self._waiting.extend(next(self._batches, []))


class Unit:
    """The running unit: how its `ucs run` stands, asked in a thread of its own, and the events of its journal."""

    def __init__(self, settings: Config):
        assert settings.journal is not None
        self.path = Path(settings.journal.path)
        self.standing: RunStanding | Silence = ask_run(self.path)
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.fault = ""
        self._reader: Any = None
        self._after = (0, 0)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="asking ucs run", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ask no more."""
        self._stopping.set()
        self._thread.join(1.0)

    def _ask(self) -> None:
        while not self._stopping.wait(ASK_S):
            self.standing = ask_run(self.path)
            self._read()
        if self._reader:
            self._reader.close()

    def _read(self) -> None:
        from level1.io.journal import JournalError, Reader
        try:
            if self._reader is None:
                self._reader = Reader(self.path)
                boot, seq = self._reader.last()
                self._after = (boot, max(0, seq - EVENTS))
            if self._reader.changed():
                for event in self._reader.events(self._after):
                    self._after = (event.boot, event.seq)
                    self.events.append(event)
            self.fault = ""
        except JournalError as error:
            self.fault = error.problems[0]
            self._reader = None


# --- the monitor ----------------------------------------------------------------------------------------------------------


class Monitor:
    """What is seen of a unit, from its buses and, where there is one, its `ucs run`."""

    def __init__(self, title: str, catalog: Catalog, source: Source, unit: Unit | None = None):
        self.source = source
        self._title, self._unit = title, unit
        self._watching = Watching(catalog, title, source.now_ns(), source.utc_offset_ns())

    def drain(self) -> None:
        """Take what has come."""
        now_ns = self.source.now_ns() - LAG_NS
        self._watching.take(self.source.take(), now_ns)

    def sight(self) -> Sight:
        """The unit now."""
        now_ns, watching, unit = self.source.now_ns(), self._watching, self._unit
        run = unit.standing if unit and isinstance(unit.standing, RunStanding) else None
        messages = list(watching.messages(now_ns))
        buses = list(run.buses) if run else self.source.buses()
        names = dict(enumerate(self.source.names))
        notes = [*self.source.notes(), *([unit.fault] if unit and unit.fault and run else [])]
        gone = silent(messages, names)
        failing = [f"bus {bus.name} ({bus.channel}) is {pages.BUS_WORDS.get(bus.state, (bus.state,))[0]}" for bus in buses
                   if bus.state != "BusActive"]
        if gone:
            failing.append(f"silent: {', '.join(gone)}")
        if run and run.journal_fault:
            failing.append(run.journal_fault)
        return Sight(
            title=self._title, source=self._source(run), alarms=run.alarms if run else watching.alarms(now_ns), messages=messages,
            buses=buses, strangers=watching.strangers(now_ns), events=tuple(unit.events if run and unit else watching.events),
            names=self.source.names, failing=failing, notes=notes, time=time.strftime("%H:%M:%S"))

    def _source(self, run: RunStanding | None) -> str:
        if run is not None:
            hangs = f"; HANGS for {roughly(run.turn_age_s)}" if run.turn_age_s > 3 else ""
            mode = "" if run.mode == "running" else f", {run.mode}"
            armed = ", ".join(run.armed) or "none"
            return f"supervised for {roughly(run.uptime_s)}, boot {run.boot}{mode}; armed: {armed}{hangs}"
        if self._unit is not None:
            why = self._unit.standing.value if isinstance(self._unit.standing, Silence) else ""
            return f"`ucs run` {why}: alarms as they look from here, nothing is repaired"
        return "alarms as they look from here, nothing is repaired"


def _once(monitor: Monitor, page: str, listen_s: float) -> None:
    """One snapshot as text."""
    from ucs.terminal import plain
    end = time.monotonic() + listen_s
    while time.monotonic() < end:
        time.sleep(DRAIN_S)
        monitor.drain()
    sight = monitor.sight()
    print(f"{sight.title}  {sight.source}", *(f"! {text}" for text in sight.failing), *sight.notes, sep="\n")
    for name in ("alarms", "signals", "buses") if page == PAGES[0] else (page,):
        print(f"\n{name}")
        print(*(plain(line) for line in pages.whole_page(sight, View(page=name), 100)), sep="\n")


def _show(monitor: Monitor, page: str) -> None:
    """The view, until the user ends it."""
    from ucs.terminal import Terminal
    terminal = Terminal(sys.stdout, sys.stdin, wants_colour(sys.stdout))
    view = View(page=page)
    sight = monitor.sight()
    due_s = 0.0
    with terminal.shown():
        while not terminal.ended:
            monitor.drain()
            now_s = time.monotonic()
            if now_s >= due_s:
                due_s = now_s + REFRESH_S
                sight = sight if view.paused else monitor.sight()
                lines, top = pages.screen(sight, view, *terminal.size)
                view = view._replace(top=top)
                terminal.draw(lines)
            for key in terminal.wait(DRAIN_S):
                changed = pressed(view, key, terminal.size[1])
                if changed is None:
                    return
                if changed.paused != view.paused:
                    monitor.source.pause(changed.paused)
                view, due_s = changed, 0.0


def pressed(view: View, key: str, rows: int) -> View | None:
    """What a key makes of the view; None: the end."""
    if view.typing:
        return _typed(view, key)
    step = {"up": -1, "down": 1, "page up": 5 - rows, "page down": rows - 5, "home": -10**9, "end": 10**9}.get(key)
    if step is not None:
        return view._replace(top=max(0, view.top + step))
    if key in "q":
        return None
    if key in ("tab", "back tab"):
        return view._replace(page=PAGES[(PAGES.index(view.page) + (1 if key == "tab" else -1)) % len(PAGES)], top=0)
    if key in "1234":
        return view._replace(page=PAGES[int(key) - 1], top=0)
    if key == "/":
        return view._replace(typing=True, sought="", top=0)
    if key == "escape":
        return view._replace(sought="", top=0)
    return view._replace(paused=not view.paused) if key in ("p", " ") else view


def _typed(view: View, key: str) -> View:
    if key == "enter":
        return view._replace(typing=False)
    if key == "escape":
        return view._replace(typing=False, sought="")
    if key == "backspace":
        return view._replace(sought=view.sought[:-1])
    return view._replace(sought=view.sought + key, top=0) if len(key) == 1 else view


def _seconds(text: str) -> float:
    try:
        return config.duration_ns(text) / 1e9
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _speed(text: str) -> float:
    from ucs.onto import speed
    return speed(text)
