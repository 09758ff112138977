"""`ucs level2`: the reference receiver of level 2, with or without a broker of its own."""
from __future__ import annotations

import argparse
import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from level1.io.error import OutsideError

LISTEN = "127.0.0.1:1883"
DESCRIPTION = """\
Receives what the units of a fleet send, stores every event exactly once in its own SQLite file, and only then acknowledges
it. Prints one line for each event; connections, silent units and gaps are told on the error output.
"""
EPILOG = f"""\
Without --broker it starts an embedded broker on {LISTEN}: good for a demonstration on one machine, not for a site, which
runs mosquitto with certificates.
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
    parser.add_argument("--ca", metavar="PEM", help="who signed the broker's certificate")
    parser.add_argument("--certificate", metavar="PEM", help="our certificate")
    parser.add_argument("--key", metavar="PEM", help="the certificate's private key")


def run(args: argparse.Namespace) -> int:
    """Receive until SIGINT or SIGTERM. Raises OutsideError for what the user can put right."""
    from bridge.broker import EmbeddedBroker
    from bridge.mqtt import Tls, parse_address
    from level2.receiver import EVERY_FLEET, Receiver, Settings, event_line
    from level2.store import Store
    with ExitStack() as stack:
        store = stack.enter_context(Store(args.store))
        if args.broker:
            address = parse_address(args.broker)
        else:
            address = stack.enter_context(EmbeddedBroker(*_host_and_port(args.listen or LISTEN))).address
            _say(f"embedded broker on {address}, for this machine only")
        settings = Settings(address, args.fleet or EVERY_FLEET, Tls(args.ca, args.certificate, args.key))
        receiver = Receiver(settings, store, told=lambda arrival: print(event_line(arrival), flush=True), say=_say)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: receiver.stop())
        _say(f"receiving {'all fleets' if not args.fleet else args.fleet} from {address} into {args.store}")
        receiver.run()
    return 0


def _host_and_port(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise OutsideError(f'--listen "{text}": write HOST:PORT, such as {LISTEN}')
    return host.strip("[]"), int(port)


def _say(line: str) -> None:
    print(f"ucs level2: {line}", file=sys.stderr, flush=True)
