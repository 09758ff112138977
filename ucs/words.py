"""Conditions and repairs in plain words, for people who drive a tractor rather than read DBC files."""
from __future__ import annotations

import re
from decimal import Decimal

from level1.catalog import Alarm, Catalog, Message, Signal
from level1.condition import MIRRORED, Operator, constant
from level1.expression import (
    AlarmState,
    And,
    Arithmetic,
    Boolean,
    Compare,
    Count,
    Elapsed,
    ExpectStep,
    Expression,
    Function,
    Not,
    Number,
    Or,
    Quality,
    Rate,
    ResendStep,
    SendStep,
    SignalValue,
    Silent,
    Step,
    TroubleCode,
    WaitStep,
)
from level1.freeze_frame import STATE_WORDS

_OPERATORS: dict[Operator, str] = {
    "==": "is", "!=": "is not", "<": "is below", "<=": "is at most", ">": "is above", ">=": "is at least"}
_OPPOSITE: dict[Operator, Operator] = {"==": "!=", "!=": "==", "<": ">=", "<=": ">", ">": "<=", ">=": "<"}
_ABBREVIATIONS = {"CAN", "CPU", "DIS", "ECU", "GNSS", "GPS", "PTO", "RAM", "RTK", "TPH", "UCS", "US"}
_UNITS_NS = (("hour", 3_600_000_000_000), ("minute", 60_000_000_000), ("second", 1_000_000_000))


def spaced(name: str) -> str:
    """`EngineOilPressure` as "engine oil pressure"; abbreviations get their capitals."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name) or [name]
    return " ".join(part.upper() if part.upper() in _ABBREVIATIONS or part.isupper() and len(part) > 1 else part.lower()
                    for part in parts)


def duration(ns: int) -> str:
    """A duration in words: "300 milliseconds", "1 minute"."""
    for unit, size in _UNITS_NS:
        if ns >= size and (ns * 10) % size == 0:
            count = f"{ns / size:g}"
            return f"{count} {unit}{'' if count == '1' else 's'}"
    count = f"{ns / 1_000_000:g}"
    return f"{count} millisecond{'' if count == '1' else 's'}"


def abbreviated(ns: int) -> str:
    """A duration in the largest unit that gives a whole number: "300 ms", "2 min"."""
    units = (("h", 3_600_000_000_000), ("min", 60_000_000_000), ("s", 1_000_000_000), ("ms", 1_000_000))
    return next((f"{ns // size} {unit}" for unit, size in units if ns % size == 0), f"{ns / 1_000_000:g} ms")


class Words:
    """Puts the conditions of one catalog into words. Names are those of the signals, spaced; the message is named where two
    signals share a name."""

    def __init__(self, catalog: Catalog):
        self.catalog = catalog
        self.shared: dict[str, int] = {}
        for message in catalog.messages.values():
            for signal in message.signals:
                self.shared[signal.name] = self.shared.get(signal.name, 0) + 1

    def signal(self, message: str, signal: str) -> str:
        """A signal's name in words."""
        where = f" (in {message})" if self.shared.get(signal, 0) > 1 else ""
        return f"the {spaced(signal)}{where}"

    def condition(self, node: Expression, negated: bool = False) -> str:
        """A condition as half a sentence."""
        match node:
            case Boolean(value=value):
                return "always" if value != negated else "reported by the device itself"
            case Not(item=item):
                return self.condition(item, not negated)
            case And(items=items) | Or(items=items):
                both = isinstance(node, And) != negated
                parts = [self.condition(item, negated) for item in items]
                inner = [f"({part})" if " or " in part and both else part for part in parts]
                return (" and " if both else " or ").join(inner)
            case Compare():
                return self._compare(node, negated)
            case Silent(message=message, limit_ns=limit):
                if negated:
                    return f"{message} is being received"
                return f"{message} has not been received for {duration(limit)}"
            case Quality():
                return self._quality(node, negated)
            case Elapsed():
                return self._elapsed(node, negated)
            case TroubleCode(spn=spn, fmi=fmi):
                failure = f" with FMI {fmi}" if fmi is not None else ""
                return f"trouble code SPN {spn}{failure} is {'not ' if negated else ''}reported"
            case _:
                return self.number(node)

    def _compare(self, node: Compare, negated: bool) -> str:
        left, op, right = node.left, node.op, node.right
        if constant(left) is not None and constant(right) is None:
            left, op, right = right, MIRRORED[op], left
        if negated:
            op = _OPPOSITE[op]
        value = constant(right)
        if isinstance(left, Count) and value is not None:
            return self._count(left, op, value)
        if isinstance(left, AlarmState) and value is not None:
            return f"the alarm {left.alarm} {_OPERATORS[op]} {STATE_WORDS[int(value)]}"
        if isinstance(left, SignalValue) and value is not None:
            return f"{self.number(left)} {_OPERATORS[op]} {self._value(left, value)}"
        word = {"==": "is the same as", "!=": "differs from"}.get(op, _OPERATORS[op])
        return f"{self.number(left)} {word} {self.number(right)}"

    def _value(self, left: SignalValue, value: Decimal) -> str:
        signal = self._definition(left)
        raw = (value - signal.offset) / signal.factor
        if raw == int(raw) and int(raw) in signal.choices:
            return signal.choices[int(raw)]
        return f"{value:f}" + (f" {signal.unit}" if signal.unit else "")

    def _definition(self, node: SignalValue) -> Signal:
        return self._message(node.message).signal(node.signal)

    def _message(self, name: str) -> Message:
        return self.catalog.messages[name]

    def _count(self, node: Count, op: Operator, value: Decimal) -> str:
        how = {">=": "at least ", ">": "more than ", "<": "fewer than ", "<=": "at most ", "==": "", "!=": "not just "}[op]
        times = "once" if value == 1 else f"{value:f} times"
        return f"the alarm {node.alarm} was raised {how}{times} within {duration(node.window_ns)}"

    def _quality(self, node: Quality, negated: bool) -> str:
        subject = self.signal(node.message, node.signal) if node.signal else node.message
        yes, no = {
            "error": ("reports an error", "reports no error"), "unavailable": ("is reported as not available", "is available"),
            "never": ("has never been received", "has been received"), "corrupt": ("is corrupt", "is not corrupt"),
            "frozen": ("stands still", "is alive")}[node.kind]
        return f"{subject} {no if negated else yes}"

    def _elapsed(self, node: Elapsed, negated: bool) -> str:
        op: Operator = _OPPOSITE[node.op] if negated else node.op
        how = "for less than" if op in ("<", "<=") else "for at least" if op == ">=" else "for more than"
        subject = self.signal(node.message, node.signal) if node.signal else node.message
        what = "has not changed" if node.kind == "held" else "has not been received"
        return f"{subject} {what} {how} {duration(node.limit_ns)}"

    def number(self, node: Expression) -> str:
        """A quantity."""
        match node:
            case Number(value=value):
                return f"{value:f}"
            case SignalValue(message=message, signal=signal):
                return self.signal(message, signal)
            case Rate(message=message, signal=signal):
                return f"the change per second of {self.signal(message, signal)}"
            case Count(alarm=alarm, window_ns=window):
                return f"the number of times that {alarm} was raised within {duration(window)}"
            case AlarmState(alarm=alarm):
                return f"the state of {alarm}"
            case Function(name="abs", arguments=(argument,)):
                return f"the size of ({self.number(argument)})"
            case Function(name="neg", arguments=(argument,)):
                return f"minus {self.number(argument)}"
            case Function(name="bits", arguments=(argument,)):
                return f"the number of bits set in {self.number(argument)}"
            case Function(name=name, arguments=arguments):
                word = "smallest" if name == "min" else "largest"
                return f"the {word} of ({', '.join(self.number(argument) for argument in arguments)})"
            case Arithmetic(op=op, left=left, right=right):
                sign = {"-": "−", "*": "×", "/": "÷"}.get(op, op)
                return f"{self.number(left)} {sign} {self.number(right)}"
            case _:
                return self.condition(node)

    def step(self, step: Step) -> str:
        """A repair step as a sentence without its full stop."""
        match step:
            case SendStep(message=message, values=values):
                definition = self._message(message)
                parts = [f"{spaced(name)} {self._choice(definition.signal(name), raw)}" for name, raw in values.items()]
                return f"Command {', '.join(parts)} ({message})"
            case ResendStep(message=message):
                return f"Send the last command again ({message})"
            case WaitStep(duration_ns=ns):
                return f"Wait {duration(ns)}"
            case ExpectStep(condition=condition, within_ns=ns):
                return f"Check that {self.condition(condition)}, within {duration(ns)}"

    @staticmethod
    def _choice(signal: Signal, raw: int) -> str:
        if raw in signal.choices:
            return signal.choices[raw]
        value = raw * signal.factor + signal.offset
        return f"{value:f}" + (f" {signal.unit}" if signal.unit else "")

    def raised(self, alarm: Alarm) -> str:
        """When it is raised, as a sentence."""
        if alarm.when == Boolean(False):
            return "It is raised when a device reports it."
        held = f", for {duration(alarm.on_delay_ns)} without a break" if alarm.on_delay_ns else ""
        return f"It is raised when {self.condition(alarm.when)}{held}."

    def cleared(self, alarm: Alarm) -> str:
        """When it clears, as a sentence."""
        if alarm.when == Boolean(False):
            text = "the device no longer reports it"
        else:
            text = self.condition(alarm.until) if alarm.until is not None else self.condition(alarm.when, negated=True)
        held = f" for {duration(alarm.off_delay_ns)}" if alarm.off_delay_ns else ""
        where = " at the machine" if alarm.local_latch else ""
        latch = f" It stays until someone{where} has acknowledged it." if alarm.latch else ""
        return f"It clears when {text}{held}.{latch}"
