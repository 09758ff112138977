"""`ucs order`: someone at the machine acknowledges, resets, or lets the unit work again, past any level 2."""
from __future__ import annotations

import argparse
import getpass
import os
import select
import time
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

from bridge.link import OrderEnd
from bridge.wire import is_plain
from level1.catalog import DefinitionError
from level1.command import Order
from level1.event import Result
from level1.io import config, definitions
from level1.io.error import OutsideError, did_you_mean

PATIENCE_S = 5.0
REFUSED = 1
DESCRIPTION = """\
Gives the running unit an order as someone at the machine: what level 2 may not do is done here, after looking. Exit code 0:
done; 1: refused, with the reason. Only the user that `ucs run` runs as, and root, can give orders.
"""
EPILOG = """\
  ucs order unit.toml acknowledge                   all alarms that wait for it
  ucs order unit.toml acknowledge BottleEmpty
  ucs order unit.toml reset PilotFlameOut           lift a lock-out; refused while its cause is still there
  ucs order unit.toml resume                        after a stop from above

Others are what the definitions name (pause, stop, reduce_speed --value 2 …). `ucs status unit.toml` lists what is locked out.
"""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs order`."""
    parser = subparsers.add_parser("order", help="acknowledge, reset or resume at the machine", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("unit", metavar="unit.toml", type=Path, help="the unit's configuration")
    parser.add_argument("name", metavar="ORDER", help="acknowledge, reset, resume, …")
    parser.add_argument("target", metavar="ALARM", nargs="?", default="", help="the alarm to acknowledge or reset")
    parser.add_argument("--value", metavar="N", help="of orders that take one, in the unit of its signal")


def run(args: argparse.Namespace) -> int:
    """Give the order and tell what came of it. Raises OutsideError."""
    settings = config.load(args.unit)
    if settings.journal is None:
        raise config.ConfigError(f'{settings.path}: journal: missing; add [journal] with path = "journal.db"')
    if args.name == "reset" and not args.target:
        raise OutsideError("reset: which alarm? `ucs status unit.toml` lists what is locked out")
    result = give(Path(settings.journal.path), Order(
        id=f"local-{os.getpid()}-{time.monotonic_ns()}", name=args.name, target=args.target, value=_value(args.value),
        origin="local", by=_who()))
    if result is None:
        raise OutsideError(f"`ucs run` of {settings.unit.name} does not answer: is it running, as this user? (see ucs status)")
    print(f"{args.name} {args.target}".strip() + f": {result.outcome}" + (f", {result.reason}" if result.reason else "")
          + (_known(settings, args.name, args.target, result.reason) if result.reason else ""))
    return 0 if result.outcome == "done" else REFUSED


def give(journal: Path, order: Order, patience_s: float = PATIENCE_S) -> Result | None:
    """Hand an order to the `ucs run` of a journal; its result, or None where none came."""
    try:
        end = OrderEnd(journal)
    except OSError as error:
        raise OutsideError(f"no order can be given from here: {journal.absolute().parent}: {error.strerror}") from None
    try:
        if not end.instruct(order):
            return None
        due_s = time.monotonic() + patience_s
        while (left_s := due_s - time.monotonic()) > 0 and select.select([end], [], [], left_s)[0]:
            for answer in end.receive():
                if answer.result.id == order.id:
                    return answer.result
        return None
    finally:
        end.close()


def _known(settings: config.Config, name: str, target: str, reason: str) -> str:
    """What may have been meant, where the unit knows no such alarm or order."""
    unknown_alarm, unknown_order = reason.startswith("unknown alarm"), reason.startswith("unknown command")
    if not unknown_alarm and not unknown_order:
        return ""
    try:
        catalog = definitions.load((), settings.bus_files, settings.bus_names)
    except DefinitionError:
        return ""  # changed since the unit began: its answer stands all the same
    if unknown_alarm:
        close = did_you_mean(target, catalog.alarms)
        return close if "?" in close else "; `ucs alarms` lists those of a DBC file"
    return did_you_mean(name, {"acknowledge", "reset", "pause", "resume", "stop", *catalog.commands})


def _who() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""


def _value(text: str | None) -> Decimal | None:
    try:
        value = None if text is None else Decimal(text)
    except InvalidOperation:
        raise OutsideError(f'--value "{text}" is no number') from None
    if value is not None and not is_plain(value):
        raise OutsideError(f'--value "{text}" is no number that a signal can say')
    return value
