"""`ucs run`: supervises a unit live, until SIGTERM or Ctrl-C."""
from __future__ import annotations

import signal
import sys
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec

from level1.canopen import Device
from level1.catalog import LOCKED_OUT, Catalog
from level1.event import Event
from level1.io import config, definitions
from level1.io.can import Port, check_name
from level1.io.canopen import HistoryReader, devices
from level1.io.config import Config
from level1.io.error import OutsideError
from level1.io.inbox import Inbox
from level1.io.journal import FIRST, Journal, JournalError, Reader
from level1.io.live import Live, decode_state, encode_state
from level1.io.systemd import Supervised
from level1.memory import AlarmMemory, State
from level1.supervisor import Supervisor
from ucs import readings
from ucs.attendant import Attendant
from ucs.printer import Printer
from ucs.render import clock, event_line, painted, wants_colour
from ucs.uplink import Uplink

MONITOR_NS = 250_000_000
"""Period of the monitoring messages where no bridge says otherwise."""
PLAUSIBLE_S = 1_700_000_000
"""A wall clock before this (November 2023) has never been set."""


DESCRIPTION = """\
Supervise a unit live: read its buses, raise alarms, repair what is armed, write the journal. A line for each event as it
happens. Ends by SIGTERM or Ctrl-C with exit code 0.
"""
EPILOG = """\
A unit.toml, to begin with:

  [unit]
  name = "tractor-7"
  [[bus]]
  name = "implement"
  channel = "can0"                        # SocketCAN; another interface of python-can: interface = "udp_multicast"
  dbc = ["ucs.dbc", "flaming_tool.dbc"]   # shipped files by name, your own by path
  [repairs]
  armed = []                              # alarms whose repair may act; the others only tell what they would send
  [journal]
  path = "journal.db"
  monitor_mb = 500                        # history of the monitoring messages (ucs journal --monitor); 0: none is kept

Beside it: `ucs monitor unit.toml` shows it live, `ucs status unit.toml` tells whether all is well, `ucs journal unit.toml`
what happened, `ucs bridge unit.toml` carries it to level 2. docs/operation.md tells how to run it as a service.
"""


def add_parser(commands: Any) -> None:
    """The arguments of `ucs run`."""
    parser: ArgumentParser = commands.add_parser(
        "run", help="supervise a unit live",
        description=DESCRIPTION,
        epilog=EPILOG, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("unit", metavar="unit.toml", help="the unit's configuration")
    parser.add_argument("--check", action="store_true", help="only check the configuration and its definitions")


def run(args: Namespace) -> int:
    """Supervise, or only check."""
    settings = config.load(args.unit)
    catalog = definitions.load((), settings.bus_files, settings.bus_names)
    config.check_armed(settings, catalog)
    own = readings.messages(settings, catalog)
    known = devices(settings)
    for bus in settings.bus:
        check_name(bus)
    if settings.journal is None:
        raise config.ConfigError(f'{settings.path}: journal: missing; add [journal] with path = "journal.db"')
    if args.check:
        print(*_start_lines(settings, catalog), f"{settings.path}: good", sep="\n")
        return 0
    with ExitStack() as stack:
        printer = stack.enter_context(Printer())
        inbox = Inbox()
        ports = [Port(index, bus, inbox, time.monotonic_ns, time.time_ns) for index, bus in enumerate(settings.bus)]
        for port in ports:
            port.start()
            stack.callback(port.stop)
        journal = stack.enter_context(Journal(Path(settings.journal.path), settings.unit.name, least_boot=_least_boot(),
                                              monitor_bytes=settings.journal.monitor_mb * 1_000_000))
        if journal.waits:
            inbox.notice(f"{journal.fault}: supervising, with the events in memory until it can")
        uplink = stack.enter_context(Uplink(journal, inbox, time.monotonic_ns))
        sources = readings.start(settings, catalog, ports, journal, inbox, stack)
        service = Supervised()
        attendant = Attendant(uplink, sources.house, time.monotonic_ns, service)
        histories = HistoryReader(settings.bus, inbox.notice, inbox.ask)
        stack.callback(histories.stop)
        supervisor = _supervisor(settings, catalog, own, known, journal, restored(journal, inbox.notice))
        live = Live(supervisor, journal, ports, inbox, clock=time.monotonic_ns, wall=time.time_ns,
                    told=_teller(printer, histories), notice=lambda text: printer.err(f"ucs: {text}"), link=attendant,
                    house=attendant, gnss=sources.gnss, recorder=sources.recorder, quiet=readings.quiet(settings))
        stack.enter_context(attendant.attend(live, journal, sources, settings.unit.fleet))
        stack.callback(lambda: printer.out("\n".join(_end_lines(live, ports, sources, journal))))
        with _ended_by_signals(live):
            printer.out("\n".join(_start_lines(settings, catalog)))
            printer.out(f"boot {journal.boot}, journal {settings.journal.path}; supervising")
            service.ready(f"supervising {settings.unit.name}, boot {journal.boot}")
            live.run()
            service.stopping()
    return 0


def _least_boot() -> int:
    """Boot ids below this are past: with an exchanged card, or one that can't be read, a unit must not begin at 1 again."""
    now_s = int(time.time())
    return now_s if now_s > PLAUSIBLE_S else 1


def _supervisor(settings: Config, catalog: Catalog, own: frozenset[str], known: Sequence[Device], journal: Journal,
                state: State | None) -> Supervisor:
    """The supervisor of this boot, with the latches and budgets of the last one."""
    return Supervisor(catalog, unit=settings.unit.name, boot=journal.boot, armed=settings.repairs.armed,
                      j1939=settings.j1939, restored=state,
                      monitor_ns=_monitor_ns(settings), readings=own, devices=known,
                      gnss_bus=settings.gnss_bus)


def _monitor_ns(settings: Config) -> int | None:
    """Period of the monitoring messages; None where they neither go up nor are kept."""
    kept = settings.journal is not None and settings.journal.monitor_mb > 0
    return settings.bridge.period_ns if settings.bridge else MONITOR_NS if kept else None


def restored(journal: Journal, notice: Callable[[str], None]) -> State | None:
    """The state to begin with: what the journal gives back; None for a new unit. Raises OutsideError.

    Where a journal was and gives none back, nobody knows whether the unit was stopped: it begins as stopped, which the journal
    keeps at once, and stays so until it is resumed at the machine.
    """
    stored = journal.restored_state()
    if journal.state_lost:
        state = State("stopped", _lock_outs_of(journal))
        notice("the journal gave back no state: nobody knows whether the unit was stopped, so it begins as stopped; "
               "after a look at the machine: ucs order unit.toml resume")
        journal.append((), encode_state(state))
        return state
    if stored is None:
        journal.append((), encode_state(State("running", ())))  # from now on a journal without state has lost it
        return None
    try:
        return decode_state(stored)
    except msgspec.DecodeError as error:
        raise OutsideError(f"journal {journal.path}: its latches and lock-outs can't be read ({error}); see to what was locked "
                           "out, then set another [journal] path") from None


def _lock_outs_of(journal: Journal) -> tuple[AlarmMemory, ...]:
    """None where it can't be read."""
    try:
        with Reader(journal.path) as reader:
            return lock_outs(reader)
    except JournalError:
        return ()


def lock_outs(reader: Reader) -> tuple[AlarmMemory, ...]:
    """What is locked out by the events alone: where a damaged journal gave back events and no state, no valve may open for that."""
    last: dict[str, Event] = {}
    after = FIRST
    while events := reader.events(after):
        after = (events[-1].boot, events[-1].seq)
        last |= {event.alarm: event for event in events if event.event in ("locked_out", "cleared")}
    return tuple(AlarmMemory(event.alarm, LOCKED_OUT, event.instance, False, event.attempt, (), ())
                 for event in last.values() if event.event == "locked_out")


def _teller(printer: Printer, histories: HistoryReader) -> Callable[[Event], None]:
    """Prints a line for each event, and has error histories read."""
    colour = wants_colour(sys.stdout)

    def tell(event: Event) -> None:
        printer.out(event_line(event, clock(event), colour))
        histories.told(event)
    return tell


@contextmanager
def _ended_by_signals(live: Live) -> Iterator[None]:
    """Within it SIGTERM and Ctrl-C stop the loop instead of the process."""
    before = {number: signal.signal(number, lambda *_: live.stop()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _start_lines(settings: Config, catalog: Catalog) -> Iterator[str]:
    """What is loaded, which repairs may act, on which buses."""
    yield painted(f"{settings.unit.name} of {settings.unit.fleet}", "1", wants_colour(sys.stdout))
    for bus in settings.bus:
        files = ", ".join(Path(name).name for name in bus.dbc) or "no definitions"
        nodes = ", ".join(f"{device.node}" for device in bus.canopen)
        alone = "; only this process hears it, udp_multicast reaches others" if bus.interface == "virtual" else ""
        yield f"  bus {bus.name}: {bus.interface} {bus.channel} ({files}){f'; CANopen nodes {nodes}' if nodes else ''}{alone}"
    repairable = [name for name, alarm in catalog.alarms.items() if alarm.repair]
    armed = [name for name in repairable if name in settings.repairs.armed]
    passive = [name for name in repairable if name not in settings.repairs.armed]
    yield f"  {len(catalog.alarms)} alarms; repairs armed: {', '.join(armed) or 'none'}; passive: {', '.join(passive) or 'none'}"
    if settings.gnss:
        gnss = settings.gnss
        yield f"  gnss on bus {gnss.bus}" if gnss.bus else f"  gnss {gnss.port}, {gnss.baud} bit/s"
    if settings.recorder:
        yield f"  traffic recorded in {settings.recorder.path}, at most {settings.recorder.max_mb} MB"


def _end_lines(live: Live, ports: list[Port], sources: readings.Sources, journal: Journal) -> Iterator[str]:
    """What became of the frames."""
    yield "stopped"
    for port in ports:
        counts = ", ".join(f"{count} {word}" for word, count in sorted(port.counters.items()))
        yield f"  bus {port.settings.name}: {counts or 'no frame sent'}"
    for word, count in sorted(live.supervisor.counters.items()):
        yield f"  {count} {word}"
    if journal.unrecorded:
        yield f"  {journal.unrecorded} monitoring messages not kept"
    if live.dropped:
        yield f"  {live.dropped} frames dropped"
    if sources.gnss is not None:
        counts = ", ".join(f"{count} {word}" for word, count in sorted(sources.gnss.counters.items()))
        yield f"  gnss: {counts or 'nothing heard'}"
    if sources.recorder is not None and sources.recorder.dropped:
        yield f"  {sources.recorder.dropped} frames not recorded"
