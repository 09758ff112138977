"""The one gate through which the core lets a frame out to a bus (DESIGN §5): default silent.

Only messages whose sender is `UCS` and which a repair, a command or an alarm uses, or which are readings of the UCS itself;
only values within the bits and the limits of the DBC; no more frames than a burst allows. What passes gets an expiry, so that
nothing stale is sent late.
"""
from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction

from level1.catalog import Catalog, Message, Signal
from level1.decode import raw_of, reserved

DEFAULT_LIFE_NS = 100_000_000
"""A frame of a message without cycle time is worthless after this; others after one cycle."""
BURST = 20
"""Frames of one message within `BURST_NS`: well above any cycle time and the steps of a repair, well below what harms a bus
(20 frames in 100 ms are about 10 % of a 250 kbit/s bus)."""
BURST_NS = 100_000_000


class Refused(Exception):
    """A frame that may not leave; the text says why."""


class Gate:
    """The allow-list and the limits. readings: allowed too, and to say *not available* and *error*, which no command may."""

    def __init__(self, catalog: Catalog, allowed: Iterable[str], readings: frozenset[str] = frozenset()):
        self.catalog = catalog
        self.readings = readings
        self.allowed = frozenset(name for name in {*allowed, *readings} if catalog.messages[name].sent_by_ucs)
        self.recent: dict[str, list[int]] = {}

    def check(self, t_ns: int, name: str, data: bytes) -> int:
        """Let a payload pass and give the time (ns) until which it may be sent. Raises Refused."""
        if name not in self.allowed:
            raise Refused(f"{name} is not on the list of messages the UCS may send")
        message = self.catalog.messages[name]
        if len(data) != message.length:
            raise Refused(f"{name}: {len(data)} bytes instead of {message.length}")
        self._ranges(message, data, name in self.readings and message.j1939)
        recent = [sent for sent in self.recent.get(name, ()) if sent > t_ns - BURST_NS]
        if len(recent) >= BURST:
            raise Refused(f"{name}: more than {BURST} frames in {BURST_NS // 1_000_000} ms")
        self.recent[name] = [*recent, t_ns]
        return t_ns + (message.cycle_ns or DEFAULT_LIFE_NS)

    @staticmethod
    def _ranges(message: Message, data: bytes, may_be_reserved: bool) -> None:
        for signal in message.signals:
            if signal.minimum is None and signal.maximum is None or signal.is_float or signal.multiplexer_ids:
                continue
            raw = raw_of(signal, data)
            if may_be_reserved and _is_reserved(signal, raw or 0):
                continue
            physical = Fraction(signal.factor) * Fraction(raw or 0) + Fraction(signal.offset)
            if signal.minimum is not None and physical < Fraction(signal.minimum) or \
                    signal.maximum is not None and physical > Fraction(signal.maximum):
                raise Refused(f"{message.name}.{signal.name}: {float(physical):g} is outside {signal.minimum} … {signal.maximum}")


def _is_reserved(signal: Signal, raw: int | float) -> bool:
    return any(low <= raw <= high for low, high, _ in reserved(signal))
