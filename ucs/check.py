"""`ucs check` and `ucs alarms`: what DBC files define, and every mistake in them."""
from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from level1.catalog import Alarm, Catalog, DefinitionError, Problem
from level1.io import definitions
from level1.io.definitions import Examination
from level1.io.error import OutsideError
from ucs.render import painted, wants_colour
from ucs.table import aligned
from ucs.words import abbreviated

_SEVERITY_COLOURS = {"error": "1;31", "warning": "33"}


def add_parser(commands: Any) -> None:
    """The arguments of both."""
    check: ArgumentParser = commands.add_parser(
        "check", help="check alarm definitions in DBC files",
        description="Check alarm definitions: every error and warning of all files at once, each with its place and what to "
                    "do. Exit code 0 when there is no error, 1 when there is (with --strict also for a warning).",
        epilog="Example: ucs check my_sprayer.dbc ucs.dbc")
    check.add_argument("file", nargs="+", metavar="FILE.dbc", help="definitions; shipped ones go by name alone")
    check.add_argument("--strict", action="store_true", help="warnings count as errors")
    check.add_argument("--format", choices=("text", "json"), default="text", help="json: one object, for editors and CI")
    alarms: ArgumentParser = commands.add_parser(
        "alarms", help="list the alarms that DBC files define", description="List the alarms that DBC files define, by code.",
        epilog="Example: ucs alarms flaming_tool.dbc")
    alarms.add_argument("file", nargs="+", metavar="FILE.dbc", help="definitions; shipped ones go by name alone")
    alarms.add_argument("--format", choices=("text", "json"), default="text", help="json: one list of objects")
    alarms.add_argument("--handbook", metavar="OUT", help="write the alarm handbook instead, a page an alarm: OUT.html to print "
                                                          "and hand to a driver, or OUT.md")


def run(args: Namespace) -> int:
    """Check or list. Raises DefinitionError when files whose alarms are to be listed have errors."""
    return _check(args) if args.command == "check" else _alarms(args)


# -- check --------------------------------------------------------------------------------------------------------------


class Summary(msgspec.Struct, frozen=True):
    """How much there is: alarms and messages include those with errors."""

    messages: int
    alarms: int
    errors: int
    warnings: int

    def __str__(self) -> str:
        counts = zip(self.__struct_fields__, msgspec.structs.astuple(self), strict=True)
        return ", ".join(f"{count} {name.removesuffix('s') if count == 1 else name}" for name, count in counts)


def _check(args: Namespace) -> int:
    found = definitions.examine(args.file)
    summary = _summary(found)
    if args.format == "json":
        print(msgspec.json.encode({"problems": found.problems, "summary": summary}).decode())
    else:
        colour = wants_colour(sys.stdout)
        for problem in found.problems:
            print(_painted(problem, colour))
        print(summary)
    return 1 if summary.errors or (args.strict and summary.warnings) else 0


def _summary(found: Examination) -> Summary:
    severities = [problem.severity for problem in found.problems]
    return Summary(found.messages, found.alarms, severities.count("error"), severities.count("warning"))


def _painted(problem: Problem, colour: bool) -> str:
    word = f"{problem.severity}: "
    return str(problem).replace(word, painted(word, _SEVERITY_COLOURS.get(problem.severity, ""), colour), 1)


# -- alarms -------------------------------------------------------------------------------------------------------------

_COLUMNS = ("code", "name", "priority", "delay", "repair", "condition")


def _alarms(args: Namespace) -> int:
    found = definitions.examine(args.file)
    if found.catalog is None:
        raise DefinitionError(found.problems)
    if args.handbook:
        return _handbook(found.catalog, Path(args.handbook))
    alarms = sorted(found.catalog.alarms.values(), key=lambda alarm: alarm.code)
    if args.format == "json":
        print(msgspec.json.encode([_as_object(alarm) for alarm in alarms]).decode())
    elif sys.stdout.isatty():
        _print_table(alarms)
    else:
        print(*aligned([_COLUMNS, *(_row(alarm) for alarm in alarms)]), sep="\n")
    return 0


def _handbook(catalog: Catalog, out: Path) -> int:
    from ucs import handbook
    makers = {".html": handbook.html, ".md": handbook.markdown}
    if out.suffix not in makers:
        raise OutsideError(f"{out}: the handbook is written as .html or .md")
    try:
        out.write_text(makers[out.suffix](catalog), encoding="utf-8")
    except OSError as error:
        raise OutsideError(f"{out}: can't be written: {error.strerror}") from error
    count = len(catalog.alarms)
    print(f"{out}: handbook of {count} alarm{'s' * (count != 1)}")
    return 0


def _row(alarm: Alarm) -> tuple[str, ...]:
    return str(alarm.code), alarm.name, alarm.priority, _delays(alarm), _repair(alarm), _condition(alarm)


def _condition(alarm: Alarm) -> str:
    until = f"; until {alarm.until_text}" if alarm.until_text else ""
    enabled = f"; only while {alarm.enabled_text}" if alarm.enabled_text else ""
    latched = "; latched, acknowledged at the machine" if alarm.local_latch else "; latched" if alarm.latch else ""
    return f"{alarm.when_text}{until}{enabled}{latched}"


def _delays(alarm: Alarm) -> str:
    delays = (("on", alarm.on_delay_ns), ("off", alarm.off_delay_ns))
    return ", ".join(f"{name} {abbreviated(delay_ns)}" for name, delay_ns in delays if delay_ns) or "-"


def _repair(alarm: Alarm) -> str:
    if alarm.repair is None:
        return "-"
    attempts = alarm.repair.attempts
    return f"{attempts} attempt{'s' if attempts > 1 else ''} in {abbreviated(alarm.repair.window_ns)}"


def _as_object(alarm: Alarm) -> dict[str, Any]:
    repair = alarm.repair and {
        "steps": alarm.repair.text, "attempts": alarm.repair.attempts, "window_s": alarm.repair.window_ns / 1_000_000_000,
        "pause_ms": alarm.repair.pause_ns / 1_000_000, "give_up": alarm.repair.give_up_text, "moves": alarm.repair.moves,
        "reset": "Local" if alarm.repair.local_reset else "FromAbove"}
    return {
        "code": alarm.code, "name": alarm.name, "priority": alarm.priority, "message": alarm.message, "when": alarm.when_text,
        "until": alarm.until_text, "enabled_when": alarm.enabled_text, "on_delay_ms": alarm.on_delay_ns / 1_000_000,
        "off_delay_ms": alarm.off_delay_ns / 1_000_000, "latch": alarm.latch,
        "local_latch": alarm.local_latch, "cause": alarm.cause,
        "consequence": alarm.consequence, "action": alarm.action, "comment": alarm.comment, "spn": alarm.spn, "fmi": alarm.fmi,
        "repair": repair, "file": alarm.file, "line": alarm.line}


def _print_table(alarms: Sequence[Alarm]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text
    table = Table("code", "name", "priority", "condition, delays, repair", header_style="bold", show_lines=True)
    for alarm in alarms:
        about = [f"delay {_delays(alarm)}"] * (_delays(alarm) != "-") + [f"repair {_repair(alarm)}"] * (alarm.repair is not None)
        text = Text(_condition(alarm))
        table.add_row(str(alarm.code), alarm.name, alarm.priority, text.append("\n" + "; ".join(about), "dim") if about else text)
    Console().print(table)
