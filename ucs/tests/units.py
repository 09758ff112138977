"""The configuration of a unit, for tests."""
from __future__ import annotations

import json
from collections.abc import Sequence


def unit_toml(*dbc: str, name: str = "tractor-7", fleet: str = "fleet", journal: str = "journal.db", armed: Sequence[str] = (),
              bus: str = "implement", interface: str = "socketcan", channel: str = "vcan0", more: str = "") -> str:
    """A unit.toml with one bus. journal: "" for none. more: what follows, further keys of the bus first."""
    kept = f'[journal]\npath = "{journal}"' if journal else ""
    return f"""
[unit]
name = "{name}"
fleet = "{fleet}"
[repairs]
armed = {json.dumps(armed)}
{kept}
[[bus]]
name = "{bus}"
interface = "{interface}"
channel = "{channel}"
dbc = {json.dumps(dbc)}
{more}
"""
