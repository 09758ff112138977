"""`ucs status`: how a unit is, asked once: for people, and for monitoring systems as a plugin of Nagios or Icinga."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from level1.event import PRIORITIES
from level1.freeze_frame import STATE_WORDS
from level1.io import config
from level1.io.config import Config, duration_ns
from level1.io.error import OutsideError
from level1.io.inquiry import Silence
from ucs.render import roughly
from ucs.standing import AlarmStanding, BridgeStanding, BusStanding, RunStanding, ask_bridge, ask_run

OK, WARNING, CRITICAL, UNKNOWN = range(4)
WORDS = ("OK", "WARNING", "CRITICAL", "UNKNOWN")
RANKS = (OK, WARNING, UNKNOWN, CRITICAL)
"""From good to bad: something known to be critical counts for more than something unknown."""
HANGS_S = 3.0
"""The loop does a turn at least once a second."""
BRIDGE_HANGS_S = 120.0
OFFLINE_S = 60.0
LATE_S = 0.2
DISK_FULL_PERCENT = 98.0
DOWN = ("BusOff", "BusDown")
BUS_WORDS = {"BusActive": "up", "BusWarning": "up with errors", "BusPassive": "error passive", "BusOff": "off", "BusDown": "gone"}
DESCRIPTION = """\
Tells how a unit is, at once and without disturbing it: whether it is supervised, its buses, alarms, repairs, journal, the way to
level 2, disk and time. Works whether `ucs run` runs or not; sends nothing on any bus.
"""
EPILOG = """\
Exit codes and the first line are those of a Nagios or Icinga plugin:

  0 OK        supervised, no alarm
  1 WARNING   an alarm is active; a bus with errors; paused or stopped; the loop is late; the bridge is not
              running or offline for a minute, or events wait too long; the disk is nearly full; nothing is recorded
  2 CRITICAL  not supervised, or supervision hangs; an alarm is locked out or as grave as --critical says; a bus is off
              or gone; the journal can't be written
  3 UNKNOWN   unit.toml can't be read, or this user may not ask

  ucs status unit.toml              a page for people
  ucs status unit.toml --perfdata   with performance data behind the first line
  ucs status unit.toml --json       everything, one JSON object
"""


class Finding(msgspec.Struct, frozen=True):
    """Something that is not as it should be. level: WARNING, CRITICAL or UNKNOWN."""

    level: int
    text: str


class JournalStanding(msgspec.Struct, frozen=True):
    """What the journal's files say. fault: why they can't be read. waiting: events that level 2 has not acknowledged (at most);
    None: not known, or no bridge is configured. oldest_s: age of the oldest of them by its UTC label. alarms: as last stored."""

    path: str
    fault: str = ""
    boot: int = 0
    mode: str = ""
    waiting: int | None = None
    oldest_s: float | None = None
    newest_utc: str | None = None
    alarms: tuple[AlarmStanding, ...] = ()


class Picture(msgspec.Struct, frozen=True):
    """All that was found out. run, bridge: how they stand; run_silent, bridge_silent: why that is not known, else empty."""

    unit: str
    fleet: str
    journal: JournalStanding
    run: RunStanding | None = None
    run_silent: str = ""
    has_bridge: bool = False
    bridge: BridgeStanding | None = None
    bridge_silent: str = ""
    disk_used_percent: float | None = None
    version: str = ""


class Limits(msgspec.Struct, frozen=True):
    """What the caller finds worth a word. critical: priority from which an active alarm is critical."""

    critical: str = "Critical"
    waiting_s: float = 300.0
    disk_percent: float = 90.0


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs status`."""
    parser = subparsers.add_parser("status", help="how a unit is, once: for people and monitoring systems", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.mistake = UNKNOWN
    parser.add_argument("unit", metavar="unit.toml", type=Path, help="the unit's configuration")
    parser.add_argument("--json", action="store_true", help="one JSON object, for other programs")
    parser.add_argument("--perfdata", action="store_true", help="performance data behind the first line")
    parser.add_argument("--critical", metavar="PRIORITY", choices=PRIORITIES[1:], default="Critical",
                        help="an active alarm of this priority or a higher one is critical (default: %(default)s)")
    parser.add_argument("--waiting", metavar="DURATION", type=_seconds, default=300.0,
                        help="warn when an event has waited for level 2 as long as this (default: 5 min)")
    parser.add_argument("--disk", metavar="PERCENT", type=float, default=90.0, help="warn when the disk is as full (default: 90)")


def run(args: argparse.Namespace) -> int:
    """Ask, judge, print. Everything that goes wrong is an UNKNOWN: no exception is left to a monitoring system."""
    try:
        picture = look(config.load(args.unit))
    except OutsideError as error:
        print(f"UCS UNKNOWN - {error.problems[0]}", *error.problems[1:], sep="\n")
        return UNKNOWN
    except OSError as error:
        print(f"UCS UNKNOWN - {error.filename}: {error.strerror}")
        return UNKNOWN
    findings = judge(picture, Limits(args.critical, args.waiting, args.disk))
    level = max((finding.level for finding in findings), key=RANKS.index, default=OK)
    if args.json:
        whole = {"status": WORDS[level], "code": level,
                 "findings": [{"level": WORDS[finding.level], "text": finding.text} for finding in findings]}
        sys.stdout.write(msgspec.json.encode(whole | msgspec.to_builtins(picture)).decode() + "\n")
        return level
    print(first_line(picture, level, findings) + (perfdata(picture) if args.perfdata else ""))
    print(*page(picture, findings), sep="\n")
    return level


def _seconds(text: str) -> float:
    try:
        return duration_ns(text) / 1e9
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


# --- looking --------------------------------------------------------------------------------------------------------------


def look(settings: Config) -> Picture:
    """Find out. Raises ConfigError for a unit without a journal."""
    from level1.io.host import storage_used_percent
    from ucs.version import version
    if settings.journal is None:
        raise config.ConfigError(f'{settings.path}: journal: missing; add [journal] with path = "journal.db"')
    path = Path(settings.journal.path)
    run_told, bridge_told = ask_run(path), ask_bridge(path) if settings.bridge else Silence.ABSENT
    run_there, run_silent = (run_told, "") if isinstance(run_told, RunStanding) else (None, run_told.value)
    bridge_there, bridge_silent = (bridge_told, "") if isinstance(bridge_told, BridgeStanding) else (None, bridge_told.value)
    return Picture(
        unit=settings.unit.name, fleet=settings.unit.fleet, journal=_journal(path, bool(settings.bridge), run_there is not None),
        run=run_there, run_silent=run_silent, has_bridge=settings.bridge is not None, bridge=bridge_there,
        bridge_silent=bridge_silent if settings.bridge else "", disk_used_percent=storage_used_percent(path.parent),
        version=version())


def _journal(path: Path, has_bridge: bool, running: bool) -> JournalStanding:
    from level1.io.journal import FIRST, JournalError, Reader
    if not path.exists():
        return JournalStanding(str(path), fault=f"journal {path}: is not there yet; `ucs run` begins it")
    try:
        with Reader(path) as reader:
            last = reader.last()
            newest = reader.events((last[0], last[1] - 1), 1) if last != FIRST else []
            waiting, oldest_s = _waiting(reader, path) if has_bridge else (None, None)
            mode, alarms = ("", ()) if running else _restored(reader)
            return JournalStanding(str(path), boot=max(reader.boots(), default=0), mode=mode, waiting=waiting, oldest_s=oldest_s,
                                   newest_utc=newest[0].utc if newest else None, alarms=alarms)
    except JournalError as error:
        return JournalStanding(str(path), fault=error.problems[0])
    except OSError as error:
        return JournalStanding(str(path), fault=f"journal {path}: can't be read ({error.strerror})")


def _waiting(reader: Any, path: Path) -> tuple[int, float | None]:
    """How many events level 2 has not acknowledged, and the age of the oldest, s."""
    import time
    from datetime import datetime

    from bridge.delivered import delivered_path, delivered_ranges
    from bridge.ranges import Ranges
    delivered = delivered_ranges(delivered_path(path))
    count, oldest = 0, None
    for boot in reader.boots():
        kept = reader.events((boot, 0), 1, before=(boot + 1, 0))
        for first, last in delivered.get(boot, Ranges()).missing(kept[0].seq, reader.last_seq(boot)) if kept else ():
            count += last - first + 1
            oldest = oldest or next(iter(reader.events((boot, first - 1), 1)), None)
    if oldest is None or oldest.utc is None:
        return count, None
    return count, max(0.0, time.time() - datetime.fromisoformat(oldest.utc).timestamp())


def _restored(reader: Any) -> tuple[str, tuple[AlarmStanding, ...]]:
    """The mode and the alarms as `ucs run` left them."""
    from level1.io.live import decode_state
    try:
        stored = reader.state()
        state = decode_state(stored) if stored else None
    except (msgspec.DecodeError, TypeError):
        return "", ()
    found = []
    for memory in state.alarms if state else ():
        raised = reader.latest(memory.name, "raised") if memory.state else None
        if memory.state:
            code, priority, text = (raised.code, raised.priority, raised.text) if raised else (0, "", "")
            found.append(AlarmStanding(memory.name, code, priority, STATE_WORDS[memory.state], memory.text or text, memory.key,
                                       memory.instance))
    return state.mode if state else "", tuple(found)


# --- judging --------------------------------------------------------------------------------------------------------------


def judge(picture: Picture, limits: Limits) -> list[Finding]:
    """What is not as it should be, the worst first."""
    found = [*_judge_run(picture), *_judge_alarms(picture, limits), *_judge_bridge(picture, limits),
             *_judge_places(picture, limits)]
    return sorted(found, key=lambda finding: -RANKS.index(finding.level))


def _judge_run(picture: Picture) -> Iterator[Finding]:
    run = picture.run
    if run is None:
        unknown = picture.run_silent in (Silence.DENIED.value, Silence.CUT_OFF.value)
        yield Finding(UNKNOWN if unknown else CRITICAL, f"`ucs run` {picture.run_silent}")
        return
    if run.turn_age_s > HANGS_S:
        yield Finding(CRITICAL, f"supervision hangs for {roughly(run.turn_age_s)}")
    for bus in run.buses:
        if bus.state != "BusActive":
            yield Finding(CRITICAL if bus.state in DOWN else WARNING, f"bus {bus.name} ({bus.channel}) is {_bus_word(bus)}")
    if run.journal_fault:
        yield Finding(CRITICAL, run.journal_fault)
    if run.mode != "running":
        yield Finding(WARNING, "stopped: it is resumed at the machine" if run.mode == "stopped" else f"{run.mode} from above")
    if run.lateness_s > LATE_S:
        yield Finding(WARNING, f"the loop was {run.lateness_s * 1000:.0f} ms late")
    if run.recorder_fault:
        yield Finding(WARNING, f"traffic is not recorded: {run.recorder_fault}")
    if run.version != picture.version:
        yield Finding(WARNING, f"version {run.version} runs, {picture.version} is installed; restart it")
    if picture.journal.fault:
        yield Finding(WARNING, picture.journal.fault)


def _judge_alarms(picture: Picture, limits: Limits) -> Iterator[Finding]:
    run = picture.run
    for alarm in run.alarms if run else picture.journal.alarms:
        if alarm.priority == PRIORITIES[0]:
            continue
        grave = alarm.priority in PRIORITIES and PRIORITIES.index(alarm.priority) >= PRIORITIES.index(limits.critical)
        level = CRITICAL if grave or alarm.state == "LockedOut" else WARNING
        word = {"LockedOut": "is locked out", "Repairing": "is being repaired"}.get(alarm.state, "is active")
        yield Finding(level, f"{alarm.name} {word if run else 'was' + word.removeprefix('is')}")
    if run and run.hidden:
        yield Finding(WARNING, f"{run.hidden} causes more")


def _judge_bridge(picture: Picture, limits: Limits) -> Iterator[Finding]:
    bridge, oldest_s = picture.bridge, picture.journal.oldest_s
    if not picture.has_bridge:
        return
    if bridge is None:
        yield Finding(WARNING, f"`ucs bridge` {picture.bridge_silent}")
    elif bridge.turn_age_s > BRIDGE_HANGS_S:
        yield Finding(WARNING, f"the bridge hangs for {roughly(bridge.turn_age_s)}")
    elif not bridge.online and bridge.online_s > OFFLINE_S:
        yield Finding(WARNING, f"level 2 is not connected for {roughly(bridge.online_s)}")
    if oldest_s is not None and oldest_s >= limits.waiting_s:
        yield Finding(WARNING, f"{_events(picture.journal.waiting or 0)} wait for level 2, the oldest for {roughly(oldest_s)}")


def _judge_places(picture: Picture, limits: Limits) -> Iterator[Finding]:
    used, run = picture.disk_used_percent, picture.run
    if used is not None and used >= limits.disk_percent:
        yield Finding(CRITICAL if used >= DISK_FULL_PERCENT else WARNING, f"the disk is {used:.0f} % full")
    if run and run.gnss and not run.gnss.fix:
        yield Finding(WARNING, f"the GNSS receiver at {run.gnss.port} says nothing")


# --- telling --------------------------------------------------------------------------------------------------------------


def first_line(picture: Picture, level: int, findings: Sequence[Finding]) -> str:
    """What a monitoring system shows. A `|` would begin its performance data, so there is none."""
    run = picture.run
    told = [finding.text for finding in findings]
    if not told and run:
        told = [f"supervised for {roughly(run.uptime_s)}", f"{len(run.buses)} bus{'es' * (len(run.buses) != 1)} up", "no alarm"]
    return f"UCS {WORDS[level]} - {picture.unit}: {', '.join(told)}".replace("|", "/")


def perfdata(picture: Picture) -> str:
    """Performance data as plugins write them."""
    run, journal = picture.run, picture.journal
    values = []
    if run:
        values += [f"alarms={len(run.alarms) + run.hidden}", f"lateness={run.lateness_s:.4f}s", f"uptime={run.uptime_s:.0f}s",
                   f"received={sum(bus.received for bus in run.buses)}c", f"dropped={run.dropped}c"]
    if journal.waiting is not None:
        values.append(f"waiting={journal.waiting}")
    if picture.disk_used_percent is not None:
        values.append(f"disk={picture.disk_used_percent:.1f}%")
    return " | " + " ".join(values) if values else ""


def page(picture: Picture, findings: Sequence[Finding]) -> Iterator[str]:
    """For people: a line or a few for each thing."""
    run, journal = picture.run, picture.journal
    if run:
        dropped = f"; {run.dropped} frames dropped" if run.dropped else ""
        yield _row("run", f"for {roughly(run.uptime_s)}, {run.mode}, boot {run.boot}, version {run.version or 'unknown'}, "
                          f"process {run.pid}; at most {run.lateness_s * 1000:.1f} ms late lately{dropped}")
        for index, bus in enumerate(run.buses):
            yield _row("bus" if index == 0 else "", _bus_line(bus))
    else:
        yield _row("run", picture.run_silent + (f"; last boot {journal.boot}" if journal.boot else ""))
    alarms = run.alarms if run else journal.alarms
    if not alarms and (run or not journal.fault):
        yield _row("alarms", f"none of {run.defined}" if run else "none as last stored")
    for index, alarm in enumerate(alarms):
        yield _row("alarms" if index == 0 else "", alarm_line(alarm) + ("" if run else " (as last stored)"))
    if run:
        yield _row("repairs", f"armed: {', '.join(run.armed) or 'none'}; passive: {', '.join(run.passive) or 'none'}")
    yield _row("journal", _journal_line(picture))
    yield _row("level 2", _level2_line(picture))
    if picture.disk_used_percent is not None:
        yield _row("disk", f"{picture.disk_used_percent:.0f} % full")
    if run:
        yield _row("time", f"UTC is {'trusted' if run.utc_trusted else 'not trusted: nothing keeps the clock right'}{_gnss(run)}")
        if run.recorder:
            lost = f", {run.recorder_dropped} frames not recorded" if run.recorder_dropped else ""
            yield _row("recorder", f"{run.recorder_fault or 'records into ' + run.recorder}{lost}")


def _row(name: str, text: str) -> str:
    return f"  {name:<9} {text}"


def alarm_line(alarm: AlarmStanding) -> str:
    """One alarm: state, priority, since when, what is done about it."""
    cause = f" [{alarm.key}]" if alarm.key else ""
    since = f" for {roughly(alarm.age_s)}" if alarm.age_s is not None else ""
    seen = ", acknowledged" if alarm.acknowledged else ", to be acknowledged" if alarm.latch else ""
    return f"{alarm.name}{cause}: {alarm.priority} {alarm.state}{since}{seen}{_doing(alarm)}; {alarm.text}".rstrip("; ")


def _doing(alarm: AlarmStanding) -> str:
    repair = alarm.repair
    if repair is None:
        return ""
    if repair.phase == "passive":
        return ", its repair is not armed"
    left = f", {roughly(repair.left_s)} left" if repair.left_s is not None else ""
    doing = {"running": f": {repair.doing}", "pausing": ": pauses", "waiting": f": waits, {repair.obstacle}"}.get(repair.phase, "")
    return f", {repair.attempt_text}{doing}{left}" if repair.attempt or repair.phase != "idle" else ""


def _bus_line(bus: BusStanding) -> str:
    quiet = "nothing heard yet" if bus.quiet_s is None else f"last frame {roughly(bus.quiet_s)} ago"
    load = f", {bus.load_percent:.0f} % load" if bus.load_percent is not None else ""
    counts = "".join(f", {count} {word}" for word, count in sorted(bus.counters.items()) if count and word != "sent")
    return f"{bus.name} ({bus.channel}) {_bus_word(bus)}: {bus.received} frames received, {quiet}, {bus.sent} sent{load}{counts}"


def _bus_word(bus: BusStanding) -> str:
    return BUS_WORDS.get(bus.state, bus.state)


def _journal_line(picture: Picture) -> str:
    run, journal = picture.run, picture.journal
    if run and run.journal_fault:
        return run.journal_fault.removeprefix("journal ")
    if journal.fault:
        return journal.fault.removeprefix("journal ")
    return f"{journal.path}: {'good' if run else 'readable'}; last event {journal.newest_utc or 'never'}"


def _level2_line(picture: Picture) -> str:
    bridge, journal = picture.bridge, picture.journal
    if not picture.has_bridge:
        return "no [bridge] in unit.toml: events stay in the journal"
    waiting = "" if journal.waiting is None else f"; {_events(journal.waiting)} wait" if journal.waiting else "; nothing waits"
    if journal.oldest_s is not None:
        waiting += f", the oldest for {roughly(journal.oldest_s)}"
    if bridge is None:
        return f"the bridge {picture.bridge_silent}{waiting}"
    state = f"connected to {bridge.broker}" if bridge.online else f"not connected to {bridge.broker}"
    ack = "" if bridge.ack_age_s is None else f", last acknowledgement {roughly(bridge.ack_age_s)} ago"
    why = f" ({bridge.said})" if not bridge.online and bridge.said else ""
    return f"{state} for {roughly(bridge.online_s)}{why}{ack}{waiting}"


def _gnss(run: RunStanding) -> str:
    if run.gnss is None:
        return ""
    return f"; GNSS {run.gnss.port}: {run.gnss.fix or 'says nothing'}{', gives the time' if run.gnss.time else ''}"


def _events(count: int) -> str:
    return f"{count} event{'s' * (count != 1)}"
