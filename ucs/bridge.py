"""`ucs bridge`: the process that carries a unit's events to level 2, and acknowledgements and commands back."""
from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from level1.io.config import Config, ConfigError, load

if TYPE_CHECKING:
    from bridge.session import Settings

DESCRIPTION = """\
Reads the journal that `ucs run` writes and sends every event to level 2 by MQTT, until level 2 itself has acknowledged it;
passes on the monitoring messages, and commands from level 2. Runs beside `ucs run` as its own process: either one may end
and start again at any time, and the journal keeps the events through hours without radio.
"""
EPILOG = """\
It needs [unit], [journal] and [bridge] in unit.toml, for example:

  [bridge]
  broker = "mqtts://level2.local:8883"   # mqtt:// without TLS
  period = "250 ms"                      # of the monitoring messages
  ca = "ca.pem"                          # who signed the broker's certificate
  certificate = "unit.pem"               # ours, and its key
  key = "unit-key.pem"
  keys = "keys.toml"                     # who may command, see `ucs keys`
"""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs bridge`."""
    parser = subparsers.add_parser("bridge", help="carry a unit's events to level 2 and commands back", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("unit", metavar="unit.toml", type=Path, help="the unit's configuration")


def run(args: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM. Raises OutsideError for what the user can put right."""
    from bridge.session import Bridge
    settings = settings_of(load(args.unit))
    bridge = Bridge(settings, lambda line: print(f"ucs bridge: {line}", file=sys.stderr, flush=True))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: bridge.stop())
    bridge.run()
    return 0


def settings_of(config: Config) -> Settings:
    """What a bridge needs of a configuration. Raises ConfigError for a missing table."""
    from bridge.mqtt import Tls, parse_address
    from bridge.session import Settings
    if config.journal is None:
        raise ConfigError(f'{config.path}: journal: missing; write [journal] path = "/var/lib/ucs/journal.db"')
    if config.bridge is None:
        raise ConfigError(f'{config.path}: bridge: missing; write [bridge] broker = "mqtt://host:1883"')
    bridge = config.bridge
    return Settings(Path(config.journal.path), config.unit.name, config.unit.fleet, parse_address(bridge.broker),
                    Tls(bridge.ca, bridge.certificate, bridge.key), bridge.period_ns, Path(bridge.keys) if bridge.keys else None)
