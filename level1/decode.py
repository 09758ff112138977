"""From payload bits to raw values, and from raw values to classes.

Theory of operation. A condition such as `Temp > 90 and Temp < 110` cuts the raw values of a signal into a few intervals
within which it can't change its verdict. Reserved values (J1939 §5.1.4 *not available*, *error*) and the limits of the DBC
cut further. Such an interval is a *class*. The decoder of a message, generated once as Python source, extracts only the
signals in use and compares each with the bounds of its present class; a frame that moves no signal out of its class costs
no more than that. What a class means is looked up in tables made at load (`condition`), on exact decimals: 0.1 is 0.1.

A signal that takes part in arithmetic, `held` or `rate` is *exact*: its class bounds are its present raw value.
"""
from __future__ import annotations

import math
import struct
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any

from level1.catalog import Message, Signal

GOOD, UNAVAILABLE, ERROR, NEVER, OLD, SHORT, CORRUPT, FROZEN = range(8)
"""Quality of a sample: as it should be; J1939 not available; reserved error value, NaN or outside the DBC's limits;
never received; older than `catalog.STALE_CYCLES` cycles; the frame was too short for it; checksum or counter wrong;
counter stands still."""

QUALITY_WORDS = ("good", "unavailable", "error", "never", "stale", "short", "corrupt", "frozen")
"""The word an event shows for a quality."""

RawValue = int | float
_FLOAT_FORMATS = {16: "e", 32: "f", 64: "d"}


def reserved(signal: Signal) -> tuple[tuple[int, int, int], ...]:
    """Reserved raw ranges of a J1939 signal as (low, high, quality), inclusive (SAE J1939-71 table 1, ISO 11783-7 annex B).

    Width 1 and signed or float signals have none; 2–7 bits: all ones not available, one less error;
    8 bits and more: top byte 0xFF not available, 0xFE error.
    """
    n = signal.length
    if n < 2 or signal.signed or signal.is_float:
        return ()
    top = (1 << n) - 1
    if n < 8:
        return ((top - 1, top - 1, ERROR), (top, top, UNAVAILABLE))
    low = 0xFE << n - 8
    middle = 0xFF << n - 8
    return ((low, middle - 1, ERROR), (middle, top, UNAVAILABLE))


def raw_range(signal: Signal) -> tuple[int, int]:
    """Lowest and highest raw value that the bits can hold."""
    n = signal.length
    return (-(1 << n - 1), (1 << n - 1) - 1) if signal.signed else (0, (1 << n) - 1)


class Scale:
    """physical = raw * factor + offset, as an integer fraction: the nearest float of the exact decimal."""

    __slots__ = ("denominator", "numerator", "shift")

    def __init__(self, signal: Signal):
        factor, offset = Fraction(signal.factor), Fraction(signal.offset)
        self.denominator = math.lcm(factor.denominator, offset.denominator)
        self.numerator = int(factor * self.denominator)
        self.shift = int(offset * self.denominator)

    def physical(self, raw: RawValue) -> int | float:
        """Physical value; an int when factor and offset are integers and the raw value is one."""
        value = raw * self.numerator + self.shift
        if self.denominator == 1:
            return value
        return value / self.denominator

    def raw(self, physical: Decimal | Fraction) -> Fraction:
        """Exact raw value, in general not an integer."""
        return (Fraction(physical) * self.denominator - self.shift) / self.numerator


def threshold_cuts(signal: Signal, scale: Scale, physical: Decimal) -> tuple[int, int]:
    """Raw values at which a comparison with this physical constant may change: the first that is ≥ it and the first that is > it
    (in the order of the raw values)."""
    exact = scale.raw(physical)
    first = math.ceil(exact)
    return first, (first + 1 if first == exact else first)


class Classes:
    """The classes of an integer signal. cuts: sorted lowest raw values of all classes but the first.

    quality: of each class. sample: one raw value of each, for working out what the class means.
    low, high: bounds of each class, inclusive.
    """

    __slots__ = ("cuts", "high", "low", "quality", "sample")

    def __init__(self, signal: Signal, j1939: bool, thresholds: Iterable[Decimal]):
        bottom, top = raw_range(signal)
        scale = Scale(signal)
        cuts: set[int] = set()
        for constant in thresholds:
            cuts.update(threshold_cuts(signal, scale, constant))
        ranges = list(reserved(signal)) if j1939 else []
        for low, high, _ in ranges:
            cuts.update((low, high + 1))
        for limit in (signal.minimum, signal.maximum):
            if limit is not None:
                cuts.update(threshold_cuts(signal, scale, limit))
        self.cuts = sorted(cut for cut in cuts if bottom < cut <= top)
        self.low = [bottom, *self.cuts]
        self.high = [*(cut - 1 for cut in self.cuts), top]
        self.sample = self.low
        self.quality = [self._quality(signal, scale, raw, ranges) for raw in self.sample]

    @staticmethod
    def _quality(signal: Signal, scale: Scale, raw: int, ranges: list[tuple[int, int, int]]) -> int:
        for low, high, quality in ranges:
            if low <= raw <= high:
                return quality
        physical = Fraction(signal.factor) * raw + Fraction(signal.offset)
        if signal.minimum is not None and physical < Fraction(signal.minimum):
            return ERROR
        if signal.maximum is not None and physical > Fraction(signal.maximum):
            return ERROR
        return GOOD

    def of(self, raw: RawValue) -> int:
        """Index of the class of a raw value."""
        return bisect_right(self.cuts, raw)


class FloatClasses(Classes):
    """The two classes of an IEEE-754 signal: good; and NaN, infinite or outside the limits."""

    __slots__ = ("signal",)

    def __init__(self, signal: Signal):
        self.signal = signal
        self.cuts, self.low, self.high, self.sample = [], [], [], []
        self.quality = [GOOD, ERROR]

    def of(self, raw: RawValue) -> int:
        """Index of the class of a raw value."""
        if not math.isfinite(raw):
            return 1
        signal = self.signal
        physical = raw * float(signal.factor) + float(signal.offset)
        low = signal.minimum is not None and physical < signal.minimum
        return int(low or (signal.maximum is not None and physical > signal.maximum))


def quality_of(signal: Signal, j1939: bool, raw: RawValue) -> int:
    """GOOD, UNAVAILABLE or ERROR of one raw value; the slow way, for signals that no condition uses."""
    classes = FloatClasses(signal) if signal.is_float else Classes(signal, j1939, ())
    return classes.quality[classes.of(raw)]


def first_bit(signal: Signal) -> int:
    """Distance of the signal's first bit from the first bit of the payload, counted in the signal's own byte order."""
    return _motorola_position(signal) if signal.big_endian else signal.start


def last_byte(signal: Signal) -> int:
    """Index of the highest payload byte that the signal touches."""
    return (first_bit(signal) + signal.length - 1) // 8


def _motorola_position(signal: Signal) -> int:
    """Distance of the highest bit from the first bit on the wire (DBC numbers Motorola bits in a sawtooth)."""
    return signal.start // 8 * 8 + 7 - signal.start % 8


def raw_of(signal: Signal, data: bytes) -> RawValue | None:
    """Raw value of a signal in a payload; None when the payload is too short for it."""
    if len(data) <= last_byte(signal):
        return None
    if signal.big_endian:
        word = int.from_bytes(data, "big")
        shift = len(data) * 8 - _motorola_position(signal) - signal.length
    else:
        word, shift = int.from_bytes(data, "little"), signal.start
    raw = word >> shift & (1 << signal.length) - 1
    if signal.is_float:
        layout = _FLOAT_FORMATS[signal.length]
        return float(struct.unpack(">" + layout, raw.to_bytes(signal.length // 8, "big"))[0])
    if signal.signed and raw >> signal.length - 1:
        raw -= 1 << signal.length
    return raw


def reader(signal: Signal) -> Callable[[bytes], RawValue | None]:
    """`raw_of` for one signal, worked out beforehand."""
    if signal.is_float:
        return lambda data: raw_of(signal, data)
    need, mask, sign = last_byte(signal), (1 << signal.length) - 1, 1 << signal.length - 1 if signal.signed else 0
    position, from_bytes = first_bit(signal) + signal.length, int.from_bytes

    def little(data: bytes) -> int | None:
        if len(data) <= need:
            return None
        return ((from_bytes(data, "little") >> signal.start & mask) ^ sign) - sign

    def big(data: bytes) -> int | None:
        if len(data) <= need:
            return None
        return ((from_bytes(data, "big") >> 8 * len(data) - position & mask) ^ sign) - sign
    return big if signal.big_endian else little


def encode(message: Message, values: Mapping[str, int], base: bytes | None = None) -> bytes:
    """Payload of a message with these raw values; all other bits as in `base`, or of the initial values without one.

    Raises ValueError when a raw value does not fit its bits, KeyError for an unknown signal.
    """
    payload = bytearray(base if base is not None else bytes(message.length))
    if base is None:
        initial = {signal.name: signal.initial_raw for signal in message.signals if not signal.multiplexer_ids}
        values = initial | dict(values)
    for name, raw in values.items():
        _insert(payload, message.signal(name), raw)
    return bytes(payload)


def _insert(payload: bytearray, signal: Signal, raw: int) -> None:
    low, high = raw_range(signal)
    if not low <= raw <= high:
        raise ValueError(f"{signal.name}: raw value {raw} does not fit {signal.length} bits")
    if signal.big_endian:
        shift = len(payload) * 8 - _motorola_position(signal) - signal.length
        order: Any = "big"
    else:
        shift, order = signal.start, "little"
    mask = (1 << signal.length) - 1
    word = int.from_bytes(payload, order) & ~(mask << shift) | (raw & mask) << shift
    payload[:] = word.to_bytes(len(payload), order)


Handler = Callable[[int, bytes], None]
Touch = Callable[[Any, RawValue, int], None]


def compile_handler(message: Message, signals: Sequence[tuple[Signal, Any, Touch]], short: Handler, every: set[str],
                    after: Handler | None) -> Handler:
    """The decoder of one message (or of one multiplexer page of it).

    signals: each signal in use with its cell (`board.Cell`), whose present class is `lo <= raw <= hi`, and its touch:
    touch(cell, raw, t_ns) is called when it has left its class, and at every frame for those named in `every`.
    short(t_ns, data) is called instead when the payload is too short for one of them. after(t_ns, data) comes last.
    """
    lines = ["def handle(t, d):"]
    names: dict[str, Any] = {"short": short, "after": after, "from_bytes": int.from_bytes, "unpack": struct.unpack_from}
    need = max((last_byte(signal) + 1 for signal, *_ in signals), default=0)
    if need:
        lines += [f" if len(d) < {need}:", "  short(t, d)", "  return"]
    words = {signal.big_endian for signal, *_ in signals if not signal.is_float and _bytes_touched(signal) > 2}
    if False in words:
        lines.append(" x = from_bytes(d, 'little')")
    if True in words:
        lines.append(f" y = from_bytes(d if len(d) == {need} else d[:{need}], 'big')")
    for number, (signal, cell, touch) in enumerate(signals):
        names[f"c{number}"], names[f"touch{number}"] = cell, touch
        lines.append(f" r = {_extract(signal, need)}")
        if signal.name in every:
            lines.append(f" touch{number}(c{number}, r, t)")
        else:
            lines.append(f" if not c{number}.lo <= r <= c{number}.hi: touch{number}(c{number}, r, t)")
    if after is not None:
        lines.append(" after(t, d)")
    if len(lines) == 1:
        lines.append(" pass")
    scope: dict[str, Any] = {}
    exec(compile("\n".join(lines), f"<decoder of {message.name}>", "exec"), names, scope)
    handler: Handler = scope["handle"]
    return handler


def _bytes_touched(signal: Signal) -> int:
    first = first_bit(signal)
    return (first + signal.length - 1) // 8 - first // 8 + 1


def _extract(signal: Signal, need: int) -> str:
    """Source of a signal's raw value. A word of the payload is only made (x, y) for signals that touch more than two bytes."""
    n = signal.length
    mask = (1 << n) - 1
    if signal.is_float:
        if (signal.start % 8 == (7 if signal.big_endian else 0)) and n in _FLOAT_FORMATS:
            order = ">" if signal.big_endian else "<"
            return f"unpack('{order}{_FLOAT_FORMATS[n]}', d, {signal.start // 8})[0]"
        raise ValueError(f"{signal.name}: a float signal must start at a byte boundary")
    first, width = first_bit(signal), need * 8 if signal.big_endian else 0
    byte, touched = first // 8, _bytes_touched(signal)
    if touched > 2:
        source = "y" if signal.big_endian else "x"
    else:
        first, width = first % 8, 8 * touched
        source = f"d[{byte}]"
        if touched == 2:
            source = f"(d[{byte}] << 8 | d[{byte + 1}])" if signal.big_endian else f"(d[{byte}] | d[{byte + 1}] << 8)"
    shift = width - first - n if signal.big_endian else first
    expression = f"{source} >> {shift}" if shift else source
    if width != shift + n:
        expression = f"({expression}) & {mask}" if shift else f"{expression} & {mask}"
    if signal.signed:
        sign = 1 << n - 1
        expression = f"(({expression}) ^ {sign}) - {sign}"
    return expression
