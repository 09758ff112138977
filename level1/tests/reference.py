"""A slow interpreter of conditions: keeps every frame, looks everything up anew, knows nothing of classes or tables."""
from __future__ import annotations

import math
from decimal import Decimal
from fractions import Fraction

from level1.catalog import STALE_CYCLES, Catalog, Message, Signal
from level1.decode import raw_of
from level1.expression import (
    And,
    Arithmetic,
    Boolean,
    Compare,
    Elapsed,
    Expression,
    Function,
    Not,
    Number,
    Or,
    Quality,
    SignalValue,
    Silent,
)

FALSE, TRUE, STALE, ERROR = range(4)


class Unknown(Exception):
    """An input has no value; verdict is STALE or ERROR."""

    def __init__(self, verdict: int):
        super().__init__()
        self.verdict = verdict


class Reference:
    """All frames so far, and verdicts about them at a time."""

    def __init__(self, catalog: Catalog):
        self.catalog = catalog
        self.frames: dict[str, list[tuple[int, bytes]]] = {name: [] for name in catalog.messages}

    def receive(self, t_ns: int, name: str, data: bytes) -> None:
        """A frame of a message."""
        self.frames[name].append((t_ns, data))

    def quality(self, message: Message, signal: Signal, now_ns: int) -> str:
        """never, old, short, unavailable, error or good."""
        frames = self.frames[message.name]
        if not frames:
            return "never"
        t_ns, data = frames[-1]
        if message.cycle_ns and now_ns - t_ns > STALE_CYCLES * message.cycle_ns:
            return "old"
        raw = raw_of(signal, data)
        if raw is None:
            return "short"
        return self.grade(message, signal, raw)

    @staticmethod
    def grade(message: Message, signal: Signal, raw: int | float) -> str:
        """unavailable, error or good: J1939 reserved values by their leading digits, then the limits."""
        if isinstance(raw, float) and not math.isfinite(raw):
            return "error"
        if message.j1939 and not signal.signed and not signal.is_float and signal.length > 1:
            ones = (1 << signal.length) - 1
            lead = raw if signal.length < 8 else int(raw) >> signal.length - 8
            top = ones if signal.length < 8 else 0xFF
            if lead == top:
                return "unavailable"
            if lead == top - 1:
                return "error"
        value = Fraction(raw) * Fraction(signal.factor) + Fraction(signal.offset)
        if signal.minimum is not None and value < Fraction(signal.minimum):
            return "error"
        if signal.maximum is not None and value > Fraction(signal.maximum):
            return "error"
        return "good"

    def verdict(self, node: Expression, now_ns: int) -> int:
        """Kleene's logic, spelled out."""
        match node:
            case Boolean(value=value):
                return int(value)
            case Not(item=item):
                verdict = self.verdict(item, now_ns)
                return 1 - verdict if verdict in (FALSE, TRUE) else verdict
            case And(items=items):
                verdicts = [self.verdict(item, now_ns) for item in items]
                return next((v for v in (FALSE, ERROR, STALE) if v in verdicts), TRUE)
            case Or(items=items):
                verdicts = [self.verdict(item, now_ns) for item in items]
                return next((v for v in (TRUE, ERROR, STALE) if v in verdicts), FALSE)
            case Compare(op=op, left=left, right=right):
                return self._compare(op, left, right, now_ns)
            case Silent(message=name, limit_ns=limit):
                return STALE if not self.frames[name] else int(now_ns - self.frames[name][-1][0] >= limit)
            case Elapsed():
                return self._elapsed(node, now_ns)
            case Quality(kind=kind, message=name, signal=what):
                return self._quality(kind, name, what, now_ns)
            case _:
                raise AssertionError(node)

    def _compare(self, op: str, left: Expression, right: Expression, now_ns: int) -> int:
        unknown: list[int] = []
        values = [self.number(side, now_ns, unknown) for side in (left, right)]
        if unknown:
            return max(unknown)
        a, b = values
        try:
            return int({"==": a == b, "!=": a != b, "<": a < b, "<=": a <= b, ">": a > b, ">=": a >= b}[op])
        except TypeError:
            return ERROR

    def number(self, node: Expression, now_ns: int, unknown: list[int]) -> float:
        """The value of a number; notes in `unknown` why there is none."""
        match node:
            case Number(value=value):
                return int(value) if value == int(value) else float(value)
            case SignalValue(message=name, signal=what):
                message = self.catalog.messages[name]
                signal = message.signal(what)
                quality = self.quality(message, signal, now_ns)
                if quality != "good":
                    unknown.append(ERROR if quality in ("error", "short") else STALE)
                    return 0
                raw = raw_of(signal, self.frames[name][-1][1])
                assert raw is not None
                exact = Fraction(raw) * Fraction(signal.factor) + Fraction(signal.offset)
                return int(exact) if exact.denominator == 1 and _whole(signal.factor) and _whole(signal.offset) else float(exact)
            case Arithmetic(op=op, left=left, right=right):
                a, b = self.number(left, now_ns, unknown), self.number(right, now_ns, unknown)
                if op == "&":
                    return int(a) & int(b)
                if op == "|":
                    return int(a) | int(b)
                return a + b if op == "+" else a - b if op == "-" else a * b
            case Function(name=name, arguments=arguments):
                values = [self.number(argument, now_ns, unknown) for argument in arguments]
                if name == "bits":
                    return bin(int(values[0])).count("1")
                return {"abs": lambda: abs(values[0]), "neg": lambda: -values[0], "min": lambda: min(values),
                        "max": lambda: max(values)}[name]()
            case _:
                raise AssertionError(node)

    def _elapsed(self, node: Elapsed, now_ns: int) -> int:
        frames = self.frames[node.message]
        if not frames:
            return STALE
        if node.kind == "age":
            elapsed = now_ns - frames[-1][0]
        else:
            message = self.catalog.messages[node.message]
            signal = message.signal(node.signal)
            quality = self.quality(message, signal, now_ns)
            if quality != "good":
                return ERROR if quality in ("error", "short") else STALE
            elapsed = now_ns - self._since(message, signal)
        limit = node.limit_ns
        return int({">": elapsed > limit, ">=": elapsed >= limit, "<": elapsed < limit, "<=": elapsed <= limit}[node.op])

    def _since(self, message: Message, signal: Signal) -> int:
        """When the present run of equal good samples without a stale gap began."""
        frames = self.frames[message.name]
        since, last = frames[-1][0], raw_of(signal, frames[-1][1])
        for (earlier, data), (later, _) in zip(reversed(frames[:-1]), reversed(frames), strict=False):
            gap = message.cycle_ns and later - earlier > STALE_CYCLES * message.cycle_ns
            if gap or raw_of(signal, data) != last:
                break
            since = earlier
        return since

    def _quality(self, kind: str, name: str, what: str, now_ns: int) -> int:
        if not what:
            return int(not self.frames[name])
        message = self.catalog.messages[name]
        quality = self.quality(message, message.signal(what), now_ns)
        if kind == "never":
            return int(quality == "never")
        if quality in ("never", "old"):
            return STALE
        return int(quality in ("error", "short")) if kind == "error" else int(quality == "unavailable")


def _whole(value: Decimal) -> bool:
    return value == int(value)
