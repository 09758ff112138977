"""`ucs simulate SCENARIO.toml`: the nodes on the bus, with faults as the scenario says; told line by line as it happens.

Without a bus in virtual time: far faster than real, the same lines for the same seed. With one in real time, on any interface of
python-can, where `ucs run` or anything else meets the nodes.
"""
from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from firmware_py.fault import Phrase
from firmware_py.participant import BusFrame, Happening
from firmware_py.quantity import QuantityError, duration_ns
from firmware_py.scenario import PROGRAMS, Cast, Scenario, ScenarioError, build, parse
from firmware_py.vehicle import Vehicle
from firmware_py.virtual_bus import FrameListener, Simulation
from level1.io.error import OutsideError, did_you_mean
from ucs.nmea_line import nmea_file, nmea_line
from ucs.supervised import Supervised

SHIPPED = Path(__file__).parent / "scenarios"
EXTENDED_DIGITS, STANDARD_DIGITS = 8, 3
PATIENCE = "10 s"
PYTHON_CAN_DEFAULT = "socketcan"


DESCRIPTION = """\
Runs the nodes of a scenario and tells what happens. Without a bus in virtual time, faster than real; with --bus, or --interface
and --channel, in real time on that bus.
"""
EXAMPLE = """\
  title = "Wind, and an igniter that fails for a while"
  seed = 7                                     # the same seed gives the same run
  duration = "3 min"
  orders = ["at 1 s: flaming on", "at 5 s: burner[2] high"]
  faults = ["at 20 s: flamer.pilot blown out", "at 90 s: flamer.igniter dead for 30 s"]
  [nodes.flamer]
  program = "flaming_tool"
  wind = "5 m/s"
  [nodes.mission]
  program = "mission_controller"
"""
EPILOG = f"""\
A name that is no file is looked up among the shipped scenarios; --list shows them, and every program, setting, order and fault
that one of your own can have:

{EXAMPLE}
Examples:

  ucs simulate healthy.toml                            three minutes of work in a moment
  ucs simulate windy.toml --supervise --plot windy.png level 1 beside the nodes, and a picture of it
  ucs simulate windy.toml --bus vcan0                  in real time, for a `ucs run` on that bus
  ucs simulate windy.toml --interface udp_multicast --channel 239.74.163.2    the same without any CAN hardware
"""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs simulate`."""
    parser = subparsers.add_parser(
        "simulate", help="simulate the nodes on the bus, with faults as a scenario says",
        description=DESCRIPTION,
        epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", metavar="SCENARIO.toml", help="the scenario to run")
    parser.add_argument("--list", action="store_true", help="show the shipped scenarios, programs, settings, orders and faults")
    parser.add_argument("--bus", metavar="NAME", help="SocketCAN interface, such as vcan0")
    parser.add_argument("--interface", help="python-can interface (socketcan, udp_multicast, slcan, pcan, …; virtual ends at this "
                        "process)")
    parser.add_argument("--channel", help="channel of the interface")
    parser.add_argument("--bitrate", type=int, help="bit/s, for interfaces that need it")
    parser.add_argument("--node", action="append", default=[], metavar="NAME", help="run only this node; may be repeated")
    parser.add_argument("--duration", metavar="TIME", help='instead of the scenario\'s, such as "30 s"')
    parser.add_argument("--seed", type=int, help="instead of the scenario's")
    parser.add_argument("--patience", default=PATIENCE, metavar="TIME", help=f"how long a lost bus may stay away ({PATIENCE})")
    parser.add_argument("--log", metavar="OUT.log", help="write the traffic as a candump file")
    parser.add_argument("--supervise", nargs="*", metavar="FILE.dbc", help="level 1 supervises by these definitions (default: "
                        "all of the nodes), in virtual time with repairs; on a bus it only listens (`ucs run` repairs there)")
    parser.add_argument("--plot", metavar="OUT.png", help="draw what the alarms look at, the alarms, their repairs and the path "
                        "(also .svg, .pdf); supervises")
    parser.add_argument("--nmea", type=Path, metavar="PATH",
                        help="what the tractor's GNSS receiver says: on a bus a serial line of that name, "
                             "which `ucs run` and others can open; in virtual time a file")


def run(args: argparse.Namespace) -> int:
    """Run it; 0 at its end. Raises OutsideError where the scenario, the log or the bus stands in the way."""
    if args.list:
        print("\n".join(_listing()))
        return 0
    if args.scenario is None:
        raise OutsideError("simulate needs a scenario, such as healthy.toml; `ucs simulate --list` shows those there are")
    scenario = load(args.scenario)
    if args.duration is not None:
        scenario = replace(scenario, duration_ns=_duration("--duration", args.duration))
    names = [plan.name for plan in scenario.nodes]
    for name in args.node:
        if name not in names:
            raise OutsideError(f'no node "{name}" in {args.scenario}{did_you_mean(name, names)}')
    cast = build(scenario, seed=args.seed, only=args.node)
    live = bool(args.bus or args.interface or args.channel)
    channel = str(args.bus or args.channel or "vcan0")
    with open(args.log, "w", encoding="ascii") if args.log else nullcontext() as log, _receiver(args.nmea, cast, live):
        base_ns = time.time_ns() if live else 0
        recorder = [_recorder(log, channel, base_ns)] if log is not None else []
        unit = None
        if args.supervise is not None or args.plot:
            unit = Supervised(cast, args.supervise or (), acts=not live, picture=args.plot)
        if live:
            return _run_live(args, scenario, cast, _each([*recorder, *([unit.overhear] if unit else [])]), unit)
        return _run_virtual(scenario, cast, _each([*recorder, *([unit.on_frame] if unit else [])]), unit)


def _each(listeners: Sequence[FrameListener]) -> FrameListener | None:
    """One listener that calls all of them; None for none."""
    if len(listeners) < 2:
        return listeners[0] if listeners else None

    def call(t_ns: int, frame: BusFrame) -> None:
        for listener in listeners:
            listener(t_ns, frame)
    return call


@contextmanager
def _receiver(path: Path | None, cast: Cast, live: bool) -> Iterator[None]:
    """The tractor's GNSS receiver says its sentences there. Raises OutsideError."""
    if path is None:
        yield
        return
    tractors = [node for node in cast.nodes.values() if isinstance(node, Vehicle)]
    if not tractors:
        raise OutsideError('--nmea: no node of this scenario has a GNSS receiver; one needs program = "vehicle"')
    with (nmea_line if live else nmea_file)(path) as write:
        tractors[0].nmea = write
        if live:
            tractors[0].utc_start_ns = time.time_ns()
        yield


def load(name: str) -> Scenario:
    """The scenario in a file, or the shipped one of that name. Raises OutsideError."""
    path = Path(name)
    shipped = SHIPPED / (name if name.endswith(".toml") else f"{name}.toml")
    if not path.is_file() and path.name == name and shipped.is_file():
        path = shipped
    if not path.is_file():
        known = sorted(file.name for file in SHIPPED.glob("*.toml"))
        raise OutsideError(f"{name}: there is no such scenario{did_you_mean(path.name, known)}")
    try:
        return parse(path.read_text("utf-8"), name)
    except UnicodeDecodeError:
        raise OutsideError(f"{name}: not a text in UTF-8, so no scenario") from None
    except ScenarioError as error:
        raise OutsideError(*error.problems) from error


# --- virtual time -----------------------------------------------------------------------------------------------------------


def _run_virtual(scenario: Scenario, cast: Cast, on_frame: FrameListener | None, unit: Supervised | None) -> int:
    participants = (*cast.participants, *([unit.participant] if unit else []))
    simulation = Simulation(participants, on_frame=on_frame, on_happening=_teller(sys.stdout, flush=False))
    began_ns = time.monotonic_ns()
    try:
        simulation.run(scenario.duration_ns)
        if unit:
            unit.end(simulation.now_ns, scenario.title)
    finally:
        real_s = max((time.monotonic_ns() - began_ns) / 1e9, 1e-9)
        sys.stdout.write(_summary(cast, simulation.now_ns, simulation.frames))
        sys.stdout.flush()
        print(f"virtual time: {simulation.now_ns / 1e9:g} s in {real_s:.2f} s, {simulation.now_ns / 1e9 / real_s:.0f} × real time",
              file=sys.stderr)
    return 0


# --- real time --------------------------------------------------------------------------------------------------------------


class _Clock:
    """Monotonic time since it was made."""

    def __init__(self) -> None:
        self._start_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._start_ns

    def sleep(self, duration_ns: int) -> None:
        time.sleep(duration_ns / 1e9)


class _Terminated(Exception):
    """SIGTERM has come."""


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends the block by `_Terminated`, so that files are closed and the summary is told."""
    def end(*_: object) -> None:
        raise _Terminated
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run_live(args: argparse.Namespace, scenario: Scenario, cast: Cast, on_frame: FrameListener | None,
              unit: Supervised | None) -> int:
    import logging

    import can

    from firmware_py.live_bus import BusLost, LiveBus
    from level1.io.can import check_bus
    from level1.io.config import Bus
    if args.bus and (args.interface or args.channel):
        raise OutsideError("--bus names a SocketCAN interface: give it, or --interface and --channel, not both")
    logging.getLogger("can").addHandler(logging.NullHandler())  # python-can would print each failed attempt to open a lost bus
    options: dict[str, Any] = {"interface": args.interface or PYTHON_CAN_DEFAULT, "channel": args.bus or args.channel}
    if args.bitrate:
        options["bitrate"] = args.bitrate
    name = f"{options['interface']}:{options['channel']}" if args.interface else str(options["channel"])
    check_bus(Bus(name=name, channel=str(options["channel"]), interface=options["interface"]))
    clock = _Clock()
    tell = _teller(sys.stdout, flush=True)
    bus = LiveBus(lambda: can.Bus(**options), name, cast.participants, clock,
                  lambda t_ns, text: tell(Happening(t_ns, "bus", text)), patience_ns=_duration("--patience", args.patience),
                  on_frame=on_frame, on_happening=tell, echoes=args.interface == "udp_multicast")
    try:
        with _terminable():
            bus.run(scenario.duration_ns)
    except _Terminated:
        pass
    except BusLost as error:
        raise OutsideError(str(error)) from error
    finally:
        if bus.frames:
            now_ns = clock.now_ns()
            if unit:
                unit.end(now_ns, scenario.title)
            sys.stdout.write(_summary(cast, now_ns, bus.frames))
            sys.stdout.flush()
    return 0


# --- what it prints ---------------------------------------------------------------------------------------------------------


def _teller(out: TextIO, *, flush: bool) -> Callable[[Happening], None]:
    def tell(happening: Happening) -> None:
        print(f"{happening.t_ns / 1e9:10.3f} s  {happening.who:<10} {happening.text}", file=out, flush=flush)
    return tell


def _summary(cast: Cast, now_ns: int, frames: int) -> str:
    hazards = sum(len(getattr(node, "hazards", ())) for node in cast.nodes.values())
    count = "no hazards" if not hazards else f"{hazards} hazard{'s' * (hazards != 1)}"
    return f"{now_ns / 1e9:10.3f} s  end: {frames} frames, {count}\n"


def _recorder(log: TextIO, channel: str, base_ns: int) -> Callable[[int, BusFrame], None]:
    """Writes frames as `candump -L` does; times count from base_ns (ns, UNIX time or 0)."""
    def record(t_ns: int, frame: BusFrame) -> None:
        micros = (base_ns + t_ns) // 1000
        digits = EXTENDED_DIGITS if frame.extended else STANDARD_DIGITS
        log.write(f"({micros // 1_000_000:010d}.{micros % 1_000_000:06d}) {channel} "
                  f"{frame.can_id:0{digits}X}#{frame.data.hex().upper()}\n")
    return record


def _duration(option: str, text: str) -> int:
    try:
        return duration_ns(text)
    except QuantityError as error:
        raise OutsideError(f"{option}: {error}") from error


def _listing() -> Iterator[str]:
    yield "Shipped scenarios:"
    for file in sorted(SHIPPED.glob("*.toml")):
        yield f"  {file.name:<22} {load(file.name).title}"
    for name, program in PROGRAMS.items():
        yield f"\nprogram = \"{name}\""
        for setting in program.SETTINGS:
            default = f"{setting.default:g} {setting.unit}" if setting.unit else str(bool(setting.default)).lower()
            yield f"  setting  {setting.name + ' = ' + default:<30} {setting.meaning}"
        yield from _phrases("order", program.ORDERS)
        yield from _phrases("fault", program.FAULTS)


def _phrases(kind: str, phrases: Sequence[Phrase]) -> Iterator[str]:
    for phrase in phrases:
        limits = [text for text, given in (("TIME", phrase.lasts), ("N commands", phrase.counted)) if given]
        limit = f" [for {' | for '.join(limits)}]" if limits else ""
        subject = f"{phrase.subject} " if phrase.device else "NODE " if kind == "fault" else ""
        dot = "NODE." if kind == "fault" and phrase.device else ""
        yield f"  {kind:<8} {dot + subject + phrase.action + limit:<46} {phrase.meaning}"
