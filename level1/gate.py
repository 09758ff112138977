"""The one gate through which the core lets a frame out to a bus (DESIGN §5): default silent.

Only messages whose sender is `UCS` and which a repair, a command or an alarm uses, or which are readings of the UCS itself;
only values within the bits and the limits of the DBC; no more frames than a burst allows. What passes gets an expiry, so that
nothing stale is sent late. Of protocols, only what makes the UCS a node of J1939 where it has an address, the questions of node
guarding, and SDO requests that read the error history of a device for which the configuration says so; none that writes.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from fractions import Fraction

from level1.canopen import is_reading
from level1.catalog import Catalog, Message, Signal
from level1.decode import RawValue, Scale, raw_range, reader, reserved
from level1.event import Send
from level1.frame import BUS_SHIFT, EXTENDED, REMOTE, j1939_pgn
from level1.j1939_node import SENT_GROUPS

DEFAULT_LIFE_NS = 100_000_000
"""A frame of a message without cycle time is worthless after this; others after one cycle."""
BURST = 20
"""Frames of one message within `BURST_NS`: well above any cycle time and the steps of a repair, well below what harms a bus
(20 frames in 100 ms are about 10 % of a 250 kbit/s bus)."""
BURST_NS = 100_000_000


_Limit = tuple[Signal, Callable[[bytes], RawValue | None], int, int, tuple[tuple[int, int, int], ...]]


class Refused(Exception):
    """A frame that may not leave; the text says why."""


class Gate:
    """The allow-list and the limits. readings: allowed too, and to say *not available* and *error*, which no command may.
    j1939: buses on which the UCS is a node. questions: keys of remote frames that may be sent. readable: keys of SDO requests to
    devices whose error history may be read."""

    def __init__(self, catalog: Catalog, allowed: Iterable[str], readings: frozenset[str] = frozenset(),
                 j1939: Collection[int] = (), questions: Collection[int] = (), readable: Collection[int] = ()):
        self.catalog = catalog
        self.readings = readings
        self.allowed = frozenset(name for name in {*allowed, *readings} if catalog.messages[name].sent_by_ucs)
        self.recent: dict[str | int, list[int]] = {}
        self._limits = {name: _limits(catalog.messages[name], name in readings) for name in self.allowed}
        self._j1939, self._questions, self._readable = frozenset(j1939), frozenset(questions), frozenset(readable)

    def check(self, t_ns: int, name: str, data: bytes, *, safe: bool = False) -> int:
        """Let a payload pass and give the time (ns) until which it may be sent. safe: into a safe state; these are counted apart,
        so that a burst of others can't hold one up. Raises Refused.
        """
        if name not in self.allowed:
            raise Refused(f"{name} is not on the list of messages the UCS may send")
        message = self.catalog.messages[name]
        if len(data) != message.length:
            raise Refused(f"{name}: {len(data)} bytes instead of {message.length}")
        if outside := self.outside(name, data):
            raise Refused(outside)
        self._count(t_ns, f"{name}, safe" if safe else name, name)
        return t_ns + (message.cycle_ns or DEFAULT_LIFE_NS)

    def outside(self, name: str, data: bytes) -> str:
        """Which value of a payload of an allowed message is not within its limits; empty when all are."""
        for signal, read, low, high, free in self._limits.get(name, ()):
            raw = read(data) or 0
            if not low <= raw <= high and not any(first <= raw <= last for first, last, _ in free):
                physical = Fraction(signal.factor) * Fraction(raw) + Fraction(signal.offset)
                return f"{name}.{signal.name}: {float(physical):g} is outside {signal.minimum} … {signal.maximum}"
        return ""

    def check_protocol(self, send: Send) -> None:
        """Let a frame of a protocol pass. Raises Refused."""
        key = send.key
        if not self._is_of_protocol(key, send.data):
            raise Refused(f"{send.message}: {key & 0x1FFF_FFFF:X} is not on the list of what the UCS may send")
        self._count(send.t_ns, key, send.message)

    def _is_of_protocol(self, key: int, data: bytes) -> bool:
        if key & REMOTE:
            return key in self._questions
        if key & EXTENDED:
            return key >> BUS_SHIFT in self._j1939 and j1939_pgn(key & 0x1FFF_FFFF) in SENT_GROUPS
        return key in self._readable and is_reading(data)

    def _count(self, t_ns: int, key: str | int, name: str) -> None:
        """Raises Refused when there were too many of these."""
        recent = [sent for sent in self.recent.get(key, ()) if sent > t_ns - BURST_NS]
        if len(recent) >= BURST:
            raise Refused(f"{name}: more than {BURST} frames in {BURST_NS // 1_000_000} ms")
        self.recent[key] = [*recent, t_ns]


def _limits(message: Message, is_reading: bool) -> list[_Limit]:
    """What the raw values of a message must be within, and the reserved ones that a reading may have all the same."""
    found: list[_Limit] = []
    for signal in message.signals:
        if signal.minimum is None and signal.maximum is None or signal.is_float or signal.multiplexer_ids:
            continue
        scale, (low, high) = Scale(signal), raw_range(signal)
        ends = [None if limit is None else scale.raw(limit) for limit in (signal.minimum, signal.maximum)]
        least, most = ends if scale.numerator > 0 else reversed(ends)
        low = low if least is None else math.ceil(least)
        high = high if most is None else math.floor(most)
        found.append((signal, reader(signal), low, high, reserved(signal) if is_reading and message.j1939 else ()))
    return found
