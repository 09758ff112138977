"""`ucs diff`: what another set of definitions would have changed over recordings, and what a threshold would have."""
from __future__ import annotations

import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from level1.catalog import Alarm, Catalog
from level1.condition import children
from level1.expression import And, Arithmetic, Compare, Expression, Function, Not, Number, Or
from level1.io import config, definitions
from level1.io.error import OutsideError, did_you_mean
from ucs import parquet, season
from ucs.comparison import Comparison, Recorded, Side, rate_rows, span_text
from ucs.recording import Outcome
from ucs.render import painted, wants_colour
from ucs.spans import Behaviour, Change, behaviour, changes, spans
from ucs.table import aligned

SAME, DIFFERENT = 0, 1
_DELAYS = {"AlarmOnDelay": "on_delay_ns", "AlarmOffDelay": "off_delay_ns"}
_CONDITIONS = {"AlarmWhen": "when", "AlarmUntil": "until", "AlarmEnabledWhen": "enabled"}


class Sweep(NamedTuple):
    """`ALARM.ATTRIBUTE=VALUE,VALUE,…`: one attribute of one alarm, tried with several values."""

    alarm: str
    attribute: str
    values: tuple[str, ...]


def add_parser(commands: Any) -> None:
    """The arguments of `ucs diff`."""
    parser: ArgumentParser = commands.add_parser(
        "diff", help="compare the alarms of two sets of definitions over recordings",
        description="Which alarms appear, vanish, move or change length between two sets of definitions over the same recordings; "
                    "or, with --sweep, how often each alarm would come with other delays or thresholds. "
                    "Exit code 0: no difference, 1: differences, 2: something could not be used.",
        epilog="Examples: ucs diff season/ --dbc old/sprayer.dbc --against sprayer.dbc --html report.html; "
               "ucs diff season/ --dbc sprayer.dbc --sweep TankLow.AlarmOnDelay=0.5s,1s,1.5s")
    parser.add_argument("log", nargs="+", metavar="LOG", help="recordings, folders of them, patterns")
    parser.add_argument("--dbc", nargs="+", required=True, metavar="OLD", help="definitions; shipped ones go by name alone")
    parser.add_argument("--against", nargs="+", default=[], metavar="NEW", help="the definitions to compare with")
    parser.add_argument("--sweep", type=_sweep, metavar="ALARM.ATTRIBUTE=V,V", help="try values instead: of AlarmOnDelay or "
                        "AlarmOffDelay (0.5s), or of the only number in AlarmWhen, AlarmUntil or AlarmEnabledWhen")
    parser.add_argument("--tolerance", type=_duration_s, default=0.0, metavar="TIME", help="differences up to this count as none")
    parser.add_argument("--format", choices=("text", "json"), default="text")
    parser.add_argument("--parquet", metavar="OUT.parquet", help="write the events of each side (old, new, or the value tried) as "
                        "a table for DuckDB, Polars and the like")
    parser.add_argument("--html", metavar="OUT.html", help="write a report with pictures, which opens without a network")
    season.add_arguments(parser)


def run(args: Namespace) -> int:
    """Compare, or sweep. Raises OutsideError."""
    if bool(args.against) == bool(args.sweep):
        raise OutsideError("give either --against NEW.dbc … or --sweep ALARM.ATTRIBUTE=VALUE,…")
    paths = season.recordings(args.log)
    catalog = definitions.load(args.dbc)
    if args.sweep:
        return _run_sweep(args, catalog, paths)
    compared = compare(paths, ("old", catalog), ("new", definitions.load(args.against)), args)
    if args.html:
        _write_report(compared, Path(args.html))
    if args.format == "json":
        print(msgspec.json.encode(as_object(compared)).decode())
    else:
        _print(compared)
    return DIFFERENT if any(compared.changes.values()) else SAME


def compare(paths: Sequence[str], old: tuple[str, Catalog], new: tuple[str, Catalog], args: Namespace) -> Comparison:
    """Both sets of definitions over all recordings. Raises OutsideError when no recording could be used."""
    outcomes = _outcomes(paths, [old[1], new[1]], args)
    _write_table(args.parquet, (old[0], new[0]), outcomes)
    recorded = _recorded(outcomes[0])
    sides = [Side(name, {outcome.path: spans(outcome.decoded()) for outcome in found}, tuple(files))
             for (name, _), found, files in zip((old, new), outcomes, (args.dbc, args.against), strict=True)]
    found = {each.path: changes(sides[0].found[each.path], sides[1].found[each.path], args.tolerance) for each in recorded}
    return Comparison(sides[0], sides[1], recorded, found, args.tolerance)


def _outcomes(paths: Sequence[str], catalogs: Sequence[Catalog], args: Namespace) -> list[list[Outcome]]:
    jobs = [season.Job(path, encoded) for encoded in map(season.encoded, catalogs) for path in paths]
    cache = season.cache_folder()
    with season.progress(len(jobs), sys.stderr) as told:
        done = season.run(jobs, workers=args.jobs, scheduler=args.scheduler, cache=cache, fresh=args.fresh, told=told)
    for outcome in done[:len(paths)]:
        if outcome.error:
            print(f"ucs: {outcome.error}", file=sys.stderr)
    return [done[start:start + len(paths)] for start in range(0, len(done), len(paths))]


def _write_table(out: str | None, sides: Sequence[str], outcomes: Sequence[Sequence[Outcome]]) -> None:
    if out is None:
        return
    with parquet.table(out) as table:
        for side, found in zip(sides, outcomes, strict=True):
            for outcome in found:
                table.add(outcome.path, outcome.decoded(), side)


def _recorded(outcomes: Sequence[Outcome]) -> list[Recorded]:
    used = [Recorded(outcome.path, outcome.first_ns / 1e9, outcome.last_ns / 1e9, outcome.hours) for outcome in outcomes
            if not outcome.error]
    if not used:
        raise OutsideError("none of the recordings could be used")
    return used


# --- sweep --------------------------------------------------------------------------------------------------------------------


def _run_sweep(args: Namespace, catalog: Catalog, paths: Sequence[str]) -> int:
    sweep: Sweep = args.sweep
    variants = [varied(catalog, sweep, value) for value in sweep.values]
    outcomes = _outcomes(paths, variants, args)
    _write_table(args.parquet, sweep.values, outcomes)
    recorded = _recorded(outcomes[0])
    hours = sum(each.hours for each in recorded)
    rows = []
    for value, found in zip(sweep.values, outcomes, strict=True):
        by_path = {outcome.path: [span for span in spans(outcome.decoded()) if span.alarm == sweep.alarm] for outcome in found}
        rows.append((value, behaviour([(each.path, each.last, by_path[each.path]) for each in recorded], hours)))
    if args.format == "json":
        print(msgspec.json.encode({"alarm": sweep.alarm, "attribute": sweep.attribute, "hours": hours, "values": [
            {"value": value, **_behaviour_object(found)} for value, found in rows]}).decode())
    else:
        print(f"{sweep.alarm} over {_recordings(len(recorded))}, {hours:.2f} h")
        print(*aligned([(sweep.attribute, "raised", "per hour", "standing", "chattered", "locked out"), *(
            (value, str(found.raised), f"{found.per_hour:.2f}", f"{found.standing_s:.1f} s", str(found.chatter),
             str(found.locked_out)) for value, found in rows)]), sep="\n")
    if args.html:
        from ucs.report import sweep_html
        _write(Path(args.html), sweep_html(sweep.alarm, sweep.attribute, rows, hours, len(recorded)))
    return SAME


def varied(catalog: Catalog, sweep: Sweep, value: str) -> Catalog:
    """The catalog with one attribute of one alarm set to a value. Raises OutsideError."""
    alarm = catalog.alarms.get(sweep.alarm)
    if alarm is None:
        raise OutsideError(f'no alarm is called "{sweep.alarm}"{did_you_mean(sweep.alarm, catalog.alarms)}')
    return msgspec.structs.replace(catalog, alarms={**catalog.alarms, sweep.alarm: _varied_alarm(alarm, sweep.attribute, value)})


def _varied_alarm(alarm: Alarm, attribute: str, value: str) -> Alarm:
    changed: dict[str, Any]
    if attribute in _DELAYS:
        try:
            changed = {_DELAYS[attribute]: config.duration_ns(value)}
        except ValueError as error:
            raise OutsideError(f"--sweep: {error}") from None
    elif attribute in _CONDITIONS:
        condition: Expression | None = getattr(alarm, _CONDITIONS[attribute])
        changed = {_CONDITIONS[attribute]: _with_number(alarm, attribute, condition, value)}
    else:
        raise OutsideError(f'--sweep: no values can be tried for "{attribute}"{did_you_mean(attribute, [*_DELAYS, *_CONDITIONS])}')
    return msgspec.structs.replace(alarm, **changed)


def _with_number(alarm: Alarm, attribute: str, condition: Expression | None, value: str) -> Expression:
    numbers = _numbers(condition) if condition is not None else []
    if condition is None or len(numbers) != 1:
        raise OutsideError(f"--sweep: {attribute} of {alarm.name} has {len(numbers)} numbers; a sweep needs one to try others for")
    try:
        return _replaced(condition, Number(Decimal(value)))
    except InvalidOperation:
        raise OutsideError(f'--sweep: "{value}" is no number') from None


def _numbers(node: Expression) -> list[Number]:
    if isinstance(node, Number):
        return [node]
    return [number for part in children(node) for number in _numbers(part)]


def _replaced(node: Expression, number: Number) -> Expression:
    match node:
        case Number():
            return number
        case Not(item=item):
            return Not(_replaced(item, number))
        case And(items=items) | Or(items=items):
            return msgspec.structs.replace(node, items=tuple(_replaced(item, number) for item in items))
        case Function(arguments=arguments):
            return msgspec.structs.replace(node, arguments=tuple(_replaced(argument, number) for argument in arguments))
        case Compare() | Arithmetic():
            return msgspec.structs.replace(node, left=_replaced(node.left, number), right=_replaced(node.right, number))
        case _:
            return node


# --- telling ------------------------------------------------------------------------------------------------------------------


def _print(compared: Comparison) -> None:
    colour = wants_colour(sys.stdout)
    print(f"{_recordings(len(compared.recorded))}, {compared.hours:.2f} h")
    rows = [("alarm", "old", "new", "per hour", "standing", "chattered", "first")]
    for alarm in compared.alarms():
        old, new = (compared.behaviour(side, alarm) for side in (compared.old, compared.new))
        rows.append((alarm, str(old.raised), str(new.raised), f"{old.per_hour:.2f} → {new.per_hour:.2f}",
                     f"{old.standing_s:.0f} → {new.standing_s:.0f} s", f"{old.chatter} → {new.chatter}",
                     Path((new.first or old.first or ("", 0.0))[0]).name))
    print(*aligned(rows) if len(rows) > 1 else ["no alarm on either side"], sep="\n")
    if len(rows) > 1:
        print(*aligned([("for one operator", "old", "new", "IEC 62682 asks for"), *rate_rows(compared)]), sep="\n")
    for each in compared.recorded:
        for change in compared.changes[each.path]:
            print(_change_line(each, change, colour))
    total = sum(map(len, compared.changes.values()))
    kinds = ", ".join(f"{count} {what}" for what, count in compared.kinds().items())
    print(f"{total} {'difference' if total == 1 else 'differences'}: {kinds}" if total else "no difference")


_SIGNS = {"appeared": ("+", "32"), "vanished": ("-", "31")}


def _change_line(each: Recorded, change: Change, colour: bool) -> str:
    sign, code = _SIGNS.get(change.what, ("~", "33"))
    return f"{painted(sign, code, colour)} {Path(each.path).name}  {change.alarm:<28} {change.what:<16} {span_text(each, change)}"


def _behaviour_object(found: Behaviour) -> Mapping[str, Any]:
    return {"raised": found.raised, "per_hour": found.per_hour, "standing_s": found.standing_s, "chattered": found.chatter,
            "stale": found.stale, "locked_out": found.locked_out, "first": found.first, "last": found.last}


def as_object(compared: Comparison) -> Mapping[str, Any]:
    """The comparison for programs."""
    return {
        "recordings": len(compared.recorded), "hours": compared.hours,
        "rates": {side.name: compared.rates(side)._asdict() for side in (compared.old, compared.new)},
        "alarms": {alarm: {side.name: _behaviour_object(compared.behaviour(side, alarm)) for side in (compared.old, compared.new)}
                   for alarm in compared.alarms()},
        "changes": [{"recording": path, "alarm": change.alarm, "what": change.what,
                     "old": change.old and change.old._asdict(), "new": change.new and change.new._asdict()}
                    for path, found in compared.changes.items() for change in found]}


def _write_report(compared: Comparison, out: Path) -> None:
    from ucs.report import comparison_html
    _write(out, comparison_html(compared))


def _write(out: Path, text: str) -> None:
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutsideError(f"{out}: can't be written: {error.strerror}") from error


def _sweep(text: str) -> Sweep:
    """`Alarm.Attribute=1,2`. Raises ArgumentTypeError."""
    place, _, values = text.partition("=")
    alarm, _, attribute = place.partition(".")
    tried = tuple(value.strip() for value in values.split(",") if value.strip())
    if not alarm or not attribute or not tried:
        raise ArgumentTypeError(f'"{text}" is not of the form ALARM.ATTRIBUTE=VALUE,VALUE, such as TankLow.AlarmOnDelay=1s,2s')
    return Sweep(alarm, attribute, tried)


def _duration_s(text: str) -> float:
    """`10 ms` in s. Raises ArgumentTypeError."""
    try:
        return config.duration_ns(text) / 1e9
    except ValueError as error:
        raise ArgumentTypeError(str(error)) from None


def _recordings(count: int) -> str:
    return f"{count} recording{'s' * (count != 1)}"
