"""`ucs keys`: who may command a unit from level 2."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from level1.io.error import OutsideError

DESCRIPTION = """\
Makes and lists the keys of those who may command units from level 2. The private key (NAME.key) stays with the person; the
public one goes into a key file that units read: [bridge] keys = "keys.toml". Taking a key out of that file takes the right away,
at once.
"""
EPILOG = """\
Roles, each with the rights of those before it: view (monitor_period), acknowledge, stop, pause (and
reduce_speed), reset (and resume and every other command).
Hazard lock-outs can't be reset from level 2 at all.

  ucs keys make chief --role reset --keys keys.toml
  ucs keys list keys.toml
  ucs level2 command tractor-7 pause --sign chief.key --fleet north-farm
"""


def add_parser(subparsers: Any) -> None:
    """The arguments of `ucs keys`."""
    parser = subparsers.add_parser("keys", help="make and list the keys of those who may command", description=DESCRIPTION,
                                   epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    make = actions.add_parser("make", help="make a key pair and put the public key into a key file")
    make.add_argument("name", metavar="NAME", help="of the person or program")
    make.add_argument("--role", required=True, metavar="ROLE", help="view, acknowledge, stop, pause or reset")
    make.add_argument("--keys", metavar="FILE", type=Path, default=Path("keys.toml"), help="the units' key file (%(default)s)")
    make.add_argument("--out", metavar="FILE", type=Path, help="where the private key goes (NAME.key)")
    listing = actions.add_parser("list", help="list the keys in a key file")
    listing.add_argument("keys", metavar="FILE", type=Path, nargs="?", default=Path("keys.toml"), help="(%(default)s)")


def run(args: argparse.Namespace) -> int:
    """Make or list. Raises OutsideError for what the user can put right."""
    return _make(args) if args.action == "make" else _list(args.keys)


def _make(args: argparse.Namespace) -> int:
    from bridge.keys import ROLES, Key, add_key, load_keys, make_private, public_bytes, wire_name
    from level1.io.error import did_you_mean
    if args.role not in ROLES:
        raise OutsideError(f'no role is called "{args.role}"{did_you_mean(args.role, ROLES)}')
    name = wire_name(args.name)
    if args.keys.exists() and name in load_keys(args.keys):
        raise OutsideError(f'keys {args.keys}: has a key "{name}" already; choose another name, or take that one out')
    out = args.out or Path(f"{name}.key")
    key = Key(name, args.role, public_bytes(make_private(out)))
    add_key(args.keys, key)
    print(f"{out}: private key of {name}, for its owner alone")
    print(f"{args.keys}: {name}, role {key.role}, fingerprint {key.fingerprint}")
    return 0


def _list(path: Path) -> int:
    from bridge.keys import load_keys
    keys = load_keys(path)
    width = max((len(name) for name in keys), default=0)
    for key in keys.values():
        print(f"{key.name:{width}}  {key.role:11}  {key.fingerprint}")
    return 0
