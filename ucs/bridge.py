"""`ucs bridge`: the process that carries a unit's events to level 2, and acknowledgements and commands back."""
from __future__ import annotations

import argparse
import os
import signal
import socket
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from level1.io.config import Config, ConfigError, load
from level1.io.inquiry import Desk
from level1.io.systemd import Supervised
from ucs.printer import Printer
from ucs.standing import BRIDGE, BridgeStanding, encode
from ucs.version import version

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
    parser.add_argument("unit", metavar="unit.toml", type=Path, nargs="?", help="the unit's configuration")
    site = parser.add_argument_group("a test site", "mosquitto's configuration with mutual TLS, and all certificates it takes")
    site.add_argument("--make-site", metavar="DIR", type=Path, help="write one into this new folder and end")
    site.add_argument("--fleet", metavar="NAME", default="fleet", help="(%(default)s, or that of unit.toml)")
    site.add_argument("--name", metavar="UNIT", action="append", default=[], help="a unit of it; may be repeated")
    site.add_argument("--host", metavar="HOST", action="append", default=[],
                      help="a name or address of the broker; may be repeated (default: this machine's)")


def run(args: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM, or make a site. Raises OutsideError for what the user can put right."""
    if args.make_site:
        return _make_site(args)
    if args.unit is None:
        raise ConfigError("give the path of a unit.toml (see ucs bridge --help)")
    settings = settings_of(load(args.unit))
    service = Supervised()
    with Printer() as printer:
        _serve(settings, service, Witness(str(settings.broker), time.monotonic_ns, service, printer.err))
    return 0


def _serve(settings: Settings, service: Supervised, witness: Witness) -> None:
    from bridge.session import Bridge
    bridge = Bridge(settings, witness.say, turned=lambda: witness.turned(bridge.online, bridge.counters))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: bridge.stop())
    with Desk(settings.journal, BRIDGE, lambda: encode(witness.standing())):
        service.ready(f"carrying {settings.unit} to {settings.broker}")
        bridge.run()
        service.stopping()


class Witness:
    """What a bridge has said and done lately, for those who ask. Told by the bridge's thread, asked by another."""

    def __init__(self, broker: str, clock: Callable[[], int], service: Supervised, told: Callable[[str], None]):
        self._broker, self._clock, self._service, self._told = broker, clock, service, told
        self._begun_ns = self._turned_ns = self._changed_ns = clock()
        self._ack_ns: int | None = None
        self._online = False
        self._counters: Counter[str] = Counter()
        self._said = ""

    def say(self, line: str) -> None:
        """A line about what happens."""
        self._said = line
        self._told(f"ucs bridge: {line}")

    def turned(self, online: bool, counters: Counter[str]) -> None:
        """The bridge has done a turn."""
        now_ns = self._turned_ns = self._clock()
        if counters["ack"] != self._counters["ack"]:
            self._ack_ns = now_ns
        if online != self._online:
            self._online, self._changed_ns = online, now_ns
        self._counters = Counter(counters)
        self._service.alive(now_ns)

    def standing(self) -> BridgeStanding:
        """How the bridge stands."""
        now_ns = self._clock()

        def age_s(then_ns: int) -> float:
            return max(0.0, (now_ns - then_ns) / 1e9)
        return BridgeStanding(
            broker=self._broker, version=version(), pid=os.getpid(), uptime_s=age_s(self._begun_ns),
            turn_age_s=age_s(self._turned_ns), online=self._online, online_s=age_s(self._changed_ns),
            ack_age_s=None if self._ack_ns is None else age_s(self._ack_ns), said=self._said, counters=dict(self._counters))


def _make_site(args: argparse.Namespace) -> int:
    from bridge.site import make_site
    config = load(args.unit) if args.unit else None
    fleet = config.unit.fleet if config else args.fleet
    units = [*([config.unit.name] if config else []), *args.name] or ["tractor-1"]
    hosts = args.host or list(dict.fromkeys([socket.gethostname(), "localhost", "127.0.0.1"]))
    make_site(args.make_site, fleet, units, hosts)
    folder = args.make_site.absolute()
    print(f"site of {fleet} in {folder}; start its broker:\n\n  mosquitto -c {folder}/mosquitto.conf\n\n"
          f"or NATS:\n\n  nats-server -c {folder}/nats.conf\n")
    for unit in units:
        print(f"{unit}: in its unit.toml\n\n  [bridge]\n  broker = \"mqtts://{hosts[0]}:8883\"\n  ca = \"{folder}/ca.pem\"\n"
              f"  certificate = \"{folder}/{unit}.pem\"\n  key = \"{folder}/{unit}-key.pem\"\n")
    print(f"level 2:\n\n  ucs level2 --broker mqtts://{hosts[0]}:8883 --fleet {fleet} --ca {folder}/ca.pem "
          f"--certificate {folder}/level2.pem --key {folder}/level2-key.pem")
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
