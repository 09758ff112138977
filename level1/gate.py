"""The one gate through which the core lets a frame out to a bus (DESIGN §5): default silent.

Only messages whose sender is `UCS` and which a repair, a command or an alarm uses; only values within the bits and the
limits of the DBC; no more frames than a burst allows. What passes gets an expiry, so that nothing stale is sent late.
"""
from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction

from level1.catalog import Catalog, Message
from level1.decode import raw_of

DEFAULT_LIFE_NS = 100_000_000
"""A frame of a message without cycle time is worthless after this; others after one cycle."""
BURST = 20
"""Frames of one message within `BURST_NS`: well above any cycle time and the steps of a repair, well below what harms a bus
(20 frames in 100 ms are about 10 % of a 250 kbit/s bus)."""
BURST_NS = 100_000_000


class Refused(Exception):
    """A frame that may not leave; the text says why."""


class Gate:
    """The allow-list and the limits."""

    def __init__(self, catalog: Catalog, allowed: Iterable[str]):
        self.catalog = catalog
        self.allowed = frozenset(name for name in allowed if catalog.messages[name].sent_by_ucs)
        self.recent: dict[str, list[int]] = {}

    def check(self, t_ns: int, name: str, data: bytes) -> int:
        """Let a payload pass and give the time (ns) until which it may be sent. Raises Refused."""
        if name not in self.allowed:
            raise Refused(f"{name} is not on the list of messages the UCS may send")
        message = self.catalog.messages[name]
        if len(data) != message.length:
            raise Refused(f"{name}: {len(data)} bytes instead of {message.length}")
        self._ranges(message, data)
        recent = [sent for sent in self.recent.get(name, ()) if sent > t_ns - BURST_NS]
        if len(recent) >= BURST:
            raise Refused(f"{name}: more than {BURST} frames in {BURST_NS // 1_000_000} ms")
        self.recent[name] = [*recent, t_ns]
        return t_ns + (message.cycle_ns or DEFAULT_LIFE_NS)

    @staticmethod
    def _ranges(message: Message, data: bytes) -> None:
        for signal in message.signals:
            if signal.minimum is None and signal.maximum is None or signal.is_float or signal.multiplexer_ids:
                continue
            raw = raw_of(signal, data)
            physical = Fraction(signal.factor) * Fraction(raw or 0) + Fraction(signal.offset)
            if signal.minimum is not None and physical < Fraction(signal.minimum) or \
                    signal.maximum is not None and physical > Fraction(signal.maximum):
                raise Refused(f"{message.name}.{signal.name}: {float(physical):g} is outside {signal.minimum} … {signal.maximum}")
