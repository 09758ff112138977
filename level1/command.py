"""A command to the core, already authenticated: who may command what is the business of the bridge's gate."""
from __future__ import annotations

from decimal import Decimal
from typing import Literal

import msgspec


class Order(msgspec.Struct, frozen=True):
    """A command.

    id: names it in its `Result`. name: acknowledge, reset, pause, resume, stop, request_dm2, or one that `Commands` in a
    DBC names. target: alarm name (acknowledge, reset; "" means all for acknowledge), or source address (request_dm2).
    value: the `$value` of a DBC command, physical. origin: "local" (someone at the machine) or "above" (level 2).
    expires_ns: later on the time line it is refused, None: never. by: name of the key that signed it. called: level 2's own
    name for it. The last two are for the journal.
    """

    id: str
    name: str
    target: str = ""
    value: Decimal | None = None
    origin: Literal["local", "above"] = "above"
    expires_ns: int | None = None
    by: str = ""
    called: str = ""
