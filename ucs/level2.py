"""`ucs level2`: the reference receiver of level 2, with or without a broker of its own; and commands to units."""
from __future__ import annotations

import argparse
import signal
import sys
from contextlib import ExitStack
from decimal import Decimal
from pathlib import Path
from typing import Any

from level1.io.error import OutsideError
from ucs.printer import Printer

LISTEN = "127.0.0.1:1883"
FLEET = "fleet"
"""As in a unit.toml that names none."""
TLS = {"--ca": "who signed the broker's certificate", "--certificate": "our certificate",
       "--key": "the certificate's private key"}
DESCRIPTION = """\
Receives what the units of a fleet send, stores every event exactly once in its own SQLite file, and only then acknowledges
it. Prints one line for each event; connections, silent units and gaps are told on the error output.
`ucs level2 command` sends a signed command to a unit instead.
"""
EPILOG = f"""\
Without --broker it starts an embedded broker on {LISTEN}: good for a demonstration on one machine, not for a site, which
runs mosquitto with certificates (`ucs bridge --make-site DIR` writes a pattern).
"""
COMMAND = """\
Sends one command to a unit and waits for its answer. Exit code 0: done; 1: refused, with the reason.
"""
COMMAND_EPILOG = """\
  ucs level2 command tractor-7 pause --sign chief.key --fleet north-farm --broker mqtt://level2.local
  ucs level2 command tractor-7 acknowledge PilotFlameOut --sign chief.key --fleet north-farm
  ucs level2 command tractor-7 reduce_speed --value 2 --sign chief.key --fleet north-farm
"""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs level2`."""
    parser = subparsers.add_parser("level2", help="receive, store and acknowledge what units send", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--listen", metavar="HOST:PORT", help=f"start the embedded broker there (default: {LISTEN})")
    where.add_argument("--broker", metavar="URL", help="use this broker: mqtt://host:1883 or mqtts://host:8883")
    parser.add_argument("--store", metavar="FILE", type=Path, default=Path("level2.db"), help="where events are kept (%(default)s)")
    parser.add_argument("--fleet", metavar="NAME", help="receive this fleet only (default: all)")
    for option, help in TLS.items():
        parser.add_argument(option, metavar="PEM", help=help)
    command = parser.add_subparsers(dest="action", metavar="command").add_parser(
        "command", help="send a signed command to a unit", description=COMMAND, epilog=COMMAND_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("unit", metavar="UNIT", help="the unit's name")
    command.add_argument("name", metavar="NAME", help="pause, resume, stop, acknowledge, reset, or one of the unit's definitions")
    command.add_argument("target", metavar="ALARM", nargs="?", default="", help="which alarm, for acknowledge and reset")
    command.add_argument("--fleet", metavar="NAME", default=argparse.SUPPRESS, help="the unit's fleet (default: fleet)")
    command.add_argument("--broker", metavar="URL", default=argparse.SUPPRESS, help=f"the broker (default: mqtt://{LISTEN})")
    for option, help in TLS.items():
        command.add_argument(option, metavar="PEM", default=argparse.SUPPRESS, help=help)
    command.add_argument("--value", metavar="NUMBER", help="for a command that takes one, such as reduce_speed")
    command.add_argument("--sign", metavar="KEY", type=Path, required=True, help="private key made by `ucs keys make`")
    command.add_argument("--name", metavar="NAME", dest="signer", help="the key's name at the unit (default: the file's)")


def run(args: argparse.Namespace) -> int:
    """Receive or command. Raises OutsideError for what the user can put right."""
    return _command(args) if args.action else _receive(args)


def _command(args: argparse.Namespace) -> int:
    """Send a command; 0 when it was obeyed, 1 when it was refused."""
    from bridge.keys import load_private
    from bridge.mqtt import Tls, parse_address
    from bridge.wire import WireError, shown
    from level2.commander import Commander, Signer, Wish, counter_beside
    signer = Signer(args.signer or args.sign.stem, load_private(args.sign), counter_beside(args.sign))
    wish = Wish(args.unit, args.name, args.target, _number(args.value))
    try:
        commander = Commander(parse_address(args.broker or f"mqtt://{LISTEN}"), args.fleet or FLEET, wish, signer,
                              Tls(args.ca, args.certificate, args.key))
    except WireError as error:
        raise OutsideError(str(error)) from None
    try:
        result = commander.run()
    finally:
        commander.close()
    print(shown(f"{args.unit}: {args.name} {result.outcome}" + (f": {result.reason}" if result.reason else "")))
    if result.reason == "unknown key":
        print(f'ucs: the unit has no key called "{signer.key}" in the file that its [bridge] keys names (see ucs keys --help)',
              file=sys.stderr)
    return 0 if result.outcome == "done" else 1


def _number(text: str | None) -> Decimal | None:
    try:
        return None if text is None else Decimal(text)
    except ArithmeticError:
        raise OutsideError(f'--value "{text}": write a number') from None


def _receive(args: argparse.Namespace) -> int:
    """Receive until SIGINT or SIGTERM."""
    from bridge.broker import EmbeddedBroker
    from bridge.mqtt import Tls, parse_address
    from bridge.wire import shown
    from level2.receiver import EVERY_FLEET, Receiver, Settings, event_line
    from level2.store import Store
    with ExitStack() as stack:
        printer = stack.enter_context(Printer())  # whoever reads our lines must not hold up acknowledgements
        store = stack.enter_context(Store(args.store))
        if args.broker:
            address = parse_address(args.broker)
        else:
            address = stack.enter_context(EmbeddedBroker(*_host_and_port(args.listen or LISTEN))).address
            printer.err(f"ucs level2: embedded broker on {address}, for this machine only")
        settings = Settings(address, args.fleet or EVERY_FLEET, Tls(args.ca, args.certificate, args.key))
        receiver = Receiver(settings, store, told=lambda arrival: printer.out(event_line(arrival)),
                            say=lambda line: printer.err(shown(f"ucs level2: {line}")))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: receiver.stop())
        printer.err(f"ucs level2: receiving {args.fleet or 'all fleets'} from {address} into {args.store}")
        receiver.run()
    return 0


def _host_and_port(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise OutsideError(f'--listen "{text}": write HOST:PORT, such as {LISTEN}')
    return host.strip("[]"), int(port)
