"""A tractor's bus for the benchmarks, made from a seed: definitions with alarms, and the frames of a drive.

60 messages (40 with 29-bit, 20 with 11-bit identifiers; every fourth Motorola) with 6 to 8 signals each, 10 ms to 1 s cycles,
1570 frames/s in all, which is what a 250 kbit/s ISOBUS carries when it is busy. Half of all frames repeat the payload before
them. Every message falls silent now and then. 160 alarms: thresholds with hysteresis and delays (one on every message),
deviations between two messages, equality with a named value, time-outs.

A *mixed* recording has 12 messages more, an eighth of its frames: of odd lengths from 1 to 7 bytes, CAN FD of 12, 24 and 64
bytes, and multiplexed ones whose four branches come in turn, with alarms on each branch.

Every limit lies between two raw values, so that no rounding, the core's or another program's, decides about an alarm.
"""
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from benchmarks.rules import Deviation, Equality, Rule, Silence, Threshold
from level1.frame import Frame, frame_key

SEED = 20_260_922
EPOCH_NS = 1_700_000_000 * 10**9
"""Time stamp of the recording's start (UTC), as in a file that candump wrote."""
CYCLES_MS = (10,) * 6 + (20,) * 10 + (50,) * 14 + (100,) * 16 + (250,) * 4 + (500,) * 4 + (1000,) * 6
LAYOUTS = ((16, 16, 8, 8, 8, 4, 4), (16, 12, 12, 8, 8, 4, 2, 2), (16, 16, 16, 8, 4, 4), (32, 16, 8, 4, 2, 2),
           (10, 14, 8, 8, 8, 8, 4, 4), (8,) * 8, (16, 16, 12, 8, 8, 2, 2), (20, 12, 12, 8, 4, 4, 4))
"""Signal widths in bits: 64 in each message."""
FACTORS = tuple(map(Decimal, ("1", "0.5", "0.125", "0.1", "0.01", "0.03125", "0.25", "0.4")))
OFFSETS = tuple(map(Decimal, ("0", "0", "0", "-40", "-125", "-200", "32")))
CHANGE_SHARES = (1.0, 0.7, 0.5, 0.2, 0.05)
"""Share of the frames of a message that carry anything new, dealt out in turn among messages of like cycle."""
STAMP_JITTER_US = 200
DEVIATIONS, EQUALITIES = 15, 25
ALARM_ID = 0x700
"""Identifier of the first message that carries alarms, 32 in each."""
WORD_BYTES = 8
BRANCHES = 4
"""Of a multiplexed message; its selector counts through them."""
SELECTOR_BITS = 4
BRANCH_LAYOUT = (12, 16, 16, 8, 4, 4)
"""What stands behind the selector in each branch."""
OTHERS = ((1, 50, (8,)), (3, 20, (16, 8)), (5, 50, (16, 12, 8, 4)), (6, 100, (32, 16)), (7, 50, (16, 16, 12, 8, 4)),
          (8, 50, ()), (8, 50, ()), (8, 100, ()), (12, 100, (16, 16, 16, 16, 16, 16)),
          (24, 20, LAYOUTS[0] + LAYOUTS[2] + LAYOUTS[5]), (64, 50, sum(LAYOUTS, ())), (64, 100, sum(LAYOUTS, ())))
"""Messages of a mixed recording besides the others: bytes, cycle in ms, signal widths (none: multiplexed)."""

Raw = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Signal:
    """A signal. position: bits before it, counted in the message's own byte order. named: has a value table instead of a scale.
    branch: value of the selector with which it comes, None for every frame; is_selector: it is the selector."""

    name: str
    position: int
    length: int
    signed: bool
    named: bool
    factor: Decimal
    offset: Decimal
    branch: int | None = None
    is_selector: bool = False

    @property
    def rows(self) -> slice:
        """Which frames of its message carry it."""
        return slice(None) if self.branch is None else slice(self.branch, None, BRANCHES)

    @property
    def raw_range(self) -> tuple[int, int]:
        """Lowest and highest raw value."""
        low = -(1 << self.length - 1) if self.signed else 0
        return low, low + (1 << self.length) - 1


@dataclass(frozen=True)
class Message:
    """A message of `size` bytes: CAN FD when they are more than 8."""

    name: str
    can_id: int
    extended: bool
    motorola: bool
    cycle_ms: int
    change_share: float
    signals: tuple[Signal, ...]
    size: int = WORD_BYTES

    @property
    def slowest_ms(self) -> int:
        """Time from one frame to the next that carries the same signals."""
        return self.cycle_ms * (BRANCHES if any(signal.is_selector for signal in self.signals) else 1)

    @property
    def is_fd(self) -> bool:
        """Whether only CAN FD can carry it."""
        return self.size > WORD_BYTES

    @property
    def dbc_id(self) -> int:
        """Identifier as a DBC file writes it."""
        return frame_key(self.can_id, self.extended)


@dataclass(frozen=True)
class Workload:
    """Definitions and recording. t_us: time stamps from the start, sender: index of the message, payload: all bytes in a row."""

    messages: tuple[Message, ...]
    rules: tuple[Rule, ...]
    t_us: Raw
    sender: Raw
    payload: bytes

    def __len__(self) -> int:
        return len(self.t_us)

    def frames(self) -> Iterator[Frame]:
        """The recording as the core reads it."""
        keys = [frame_key(message.can_id, message.extended) for message in self.messages]
        sizes = [message.size for message in self.messages]
        begin = 0
        for t_us, sender in zip(self.t_us.tolist(), self.sender.tolist(), strict=True):
            end = begin + sizes[sender]
            yield Frame(EPOCH_NS + t_us * 1000, keys[sender], self.payload[begin:end])
            begin = end

    def candump(self) -> Iterator[str]:
        """The recording as `candump -L` writes it, line by line."""
        names = [f"{message.can_id:0{8 if message.extended else 3}X}#{'#1' if message.is_fd else ''}" for message in self.messages]
        for frame, sender in zip(self.frames(), self.sender.tolist(), strict=True):
            seconds, rest = divmod(frame.t_ns, 10**9)
            yield f"({seconds}.{rest // 1000:06d}) can0 {names[sender]}{frame.data.hex().upper()}\n"

    @property
    def seconds(self) -> float:
        """Length of the recording."""
        return float(self.t_us[-1]) / 1e6

    @property
    def repeated(self) -> float:
        """Share of the frames whose payload is the same as that of the frame of this message before."""
        last: dict[int, bytes] = {}
        same = 0
        for frame in self.frames():
            same += last.get(frame.key) == frame.data
            last[frame.key] = frame.data
        return same / len(self)


def make(frames: int, seed: int = SEED, *, mixed: bool = False) -> Workload:
    """The workload of about so many frames: a few less, because messages fall silent."""
    random = np.random.default_rng(seed)
    messages = _messages(random)
    if mixed:
        messages += tuple(_others(random, messages))
    seconds = frames / sum(1000 / message.cycle_ms for message in messages)
    raws: dict[str, Raw] = {}
    stamps, payloads = [], []
    for message in messages:
        t_us = _stamps(random, message, seconds)
        raws |= _values(random, message, len(t_us))
        heard = _heard(random, message, t_us, seconds)
        stamps.append(t_us[heard])
        payloads.append(_pack(message, raws, len(t_us))[heard])
    order = np.argsort(np.concatenate(stamps), kind="stable")
    sender = np.repeat(np.arange(len(messages)), [len(t_us) for t_us in stamps])[order]
    return Workload(messages, tuple(_rules(random, messages, raws)), np.concatenate(stamps)[order], sender,
                    _in_a_row(payloads, order, sender))


def dbc(workload: Workload) -> str:
    """The definitions as a DBC file, with the rules as alarms in the alarm language."""
    return "\n".join([*_HEAD, *_dbc_messages(workload), *_ATTRIBUTES, *_dbc_cycles(workload), *_dbc_alarms(workload.rules),
                      *_dbc_words(workload), ""])


# --- messages and frames --------------------------------------------------------------------------------------------------


def _messages(random: np.random.Generator) -> tuple[Message, ...]:
    standard = iter(random.choice(np.arange(0x100, 0x6F0), 20, replace=False).tolist())
    groups = iter(random.choice(np.arange(0xF000, 0xFFFF), 40, replace=False).tolist())
    places = random.permutation(len(CYCLES_MS)).tolist()
    messages = []
    for i in range(len(CYCLES_MS)):
        extended = i % 3 != 0
        can_id = 0x1800_0000 | next(groups) << 8 | int(random.integers(250)) if extended else next(standard)
        signals = tuple(_laid_out(random, f"M{i:02d}S", LAYOUTS[i % len(LAYOUTS)], 0, None))
        messages.append(Message(f"MSG{i:02d}", can_id, extended, i % 4 == 3, CYCLES_MS[places[i]],
                                CHANGE_SHARES[places[i] % len(CHANGE_SHARES)], signals))
    return tuple(messages)


def _others(random: np.random.Generator, messages: Sequence[Message]) -> Iterator[Message]:
    """The messages that only a mixed recording has; `OTHERS`."""
    taken = {message.can_id for message in messages}
    free = iter([can_id for can_id in range(0x100, 0x6F0) if can_id not in taken])
    for i, (size, cycle_ms, layout) in enumerate(OTHERS, len(messages)):
        extended = i % 2 == 1
        can_id = 0x1CFF_0000 | i << 8 | 0x21 if extended else next(free)
        if layout:
            signals = tuple(_laid_out(random, f"M{i:02d}S", layout, 0, None))
        else:
            selector = Signal(f"M{i:02d}Turn", 0, SELECTOR_BITS, False, False, Decimal(1), Decimal(0), is_selector=True)
            signals = (selector, *(signal for branch in range(BRANCHES) for signal in _laid_out(
                random, f"M{i:02d}B{branch}S", BRANCH_LAYOUT, SELECTOR_BITS, branch)))
        yield Message(f"MSG{i:02d}", can_id, extended, False, cycle_ms, CHANGE_SHARES[i % len(CHANGE_SHARES)], signals, size)


def _laid_out(random: np.random.Generator, name: str, layout: Sequence[int], position: int, branch: int | None) -> Iterator[Signal]:
    for k, length in enumerate(layout):
        named = length <= 4
        factor, offset = (Decimal(1), Decimal(0)) if named else (FACTORS[random.integers(len(FACTORS))],
                                                                 OFFSETS[random.integers(len(OFFSETS))])
        yield Signal(f"{name}{k}", position, length, length >= 8 and random.random() < 0.25, named, factor, offset, branch)
        position += length


def _stamps(random: np.random.Generator, message: Message, seconds: float) -> Raw:
    """When it is sent: cyclic with some jitter, never backwards, whole microseconds."""
    cycle_us = message.cycle_ms * 1000
    nominal = (random.random() + np.arange(int(seconds * 1e6 / cycle_us))) * cycle_us
    jitter = random.normal(0, STAMP_JITTER_US, len(nominal))
    return np.maximum.accumulate(np.maximum(nominal + jitter, 0)).astype(np.int64)


def _heard(random: np.random.Generator, message: Message, t_us: Raw, seconds: float) -> npt.NDArray[np.bool_]:
    """Which frames arrive: up to three times the message is missing for 2 to 20 cycles."""
    heard = np.ones(len(t_us), bool)
    for _ in range(random.integers(4)):
        start = random.random() * seconds * 1e6
        heard &= (t_us <= start) | (t_us >= start + random.uniform(2, 20) * message.cycle_ms * 1000)
    return heard


def _values(random: np.random.Generator, message: Message, count: int) -> dict[str, Raw]:
    """Raw values of each signal: named ones jump seldom, the others walk at random between their ends, a selector counts."""
    changes = random.random(count) < message.change_share
    raws = {}
    for signal in message.signals:
        span = 1 << signal.length
        if signal.is_selector:
            raws[signal.name] = np.arange(count) % BRANCHES
            continue
        own = changes[signal.rows]
        if signal.named:
            jumps = random.integers(1, span, len(own)) * (own & (random.random(len(own)) < 0.01))
            raws[signal.name] = (random.integers(span) + jumps.cumsum()) % span
            continue
        step = max(1, span // 400)
        steps = random.integers(-step, step + 1, len(own)) * (own & (random.random(len(own)) < 0.6))
        walk = random.integers(span) + steps.cumsum()
        folded = np.abs((walk + span) % (2 * span) - span)
        raws[signal.name] = np.minimum(folded, span - 1) - (span // 2 if signal.signed else 0)
    return raws


def _pack(message: Message, raws: dict[str, Raw], count: int) -> npt.NDArray[np.uint8]:
    """Payloads, one row for each of so many frames. No signal reaches from one eight bytes into the next."""
    words = np.zeros((count, -(-message.size // WORD_BYTES)), np.uint64)
    for signal in message.signals:
        word, position = divmod(signal.position, 64)
        shift = 64 - position - signal.length if message.motorola else position
        words[signal.rows, word] |= (raws[signal.name] & (1 << signal.length) - 1).astype(np.uint64) << np.uint64(shift)
    return words.astype(">u8" if message.motorola else "<u8").view(np.uint8)[:, :message.size]


def _in_a_row(payloads: Sequence[npt.NDArray[np.uint8]], order: Raw, sender: Raw) -> bytes:
    """The payloads of all messages in the order of the recording, one directly behind the other."""
    sizes = np.array([each.shape[1] for each in payloads])[sender]
    ends = np.cumsum(sizes)
    begins = np.empty_like(ends)
    begins[order] = ends - sizes
    out = np.empty(int(ends[-1]), np.uint8)
    first = 0
    for each in payloads:
        out[begins[first:first + len(each), None] + np.arange(each.shape[1])] = each
        first += len(each)
    return out.tobytes()


# --- rules ----------------------------------------------------------------------------------------------------------------


def _rules(random: np.random.Generator, messages: Sequence[Message], raws: dict[str, Raw]) -> Iterator[Rule]:
    """Limits are quantiles of what the recording holds, so that alarms come now and then and go again."""
    scaled = [(message, signal) for message in messages for signal in message.signals if not (signal.named or signal.is_selector)]
    for i, message in enumerate(messages):
        for branch in sorted({signal.branch for owner, signal in scaled if owner is message}, key=str):
            own = [signal for owner, signal in scaled if owner is message and signal.branch == branch]
            signal = own[random.integers(len(own))]
            name = f"High{i:02d}" if branch is None else f"High{i:02d}B{branch}"
            yield _threshold(name, message, signal, raws[signal.name], random.choice((0, 0, 100, 500, 2000), 2).tolist())
    for i in range(DEVIATIONS):
        one = scaled[random.integers(len(scaled))]
        other = one
        while other[0] is one[0]:
            other = scaled[random.integers(len(scaled))]
        yield _deviation(f"Deviation{i:02d}", one, other, raws)
    named = [(message, signal) for message in messages for signal in message.signals if signal.named]
    for i, k in enumerate(random.permutation(len(named))[:EQUALITIES].tolist()):
        message, signal = named[k]
        value = (1 << signal.length) - 1
        on_ms, off_ms = (_delay(ms, message) for ms in random.choice((0, 200), 2).tolist())
        yield Equality(f"State{i:02d}", message.name, signal.name, value, f"State_{value}", on_ms, off_ms)
    for i, message in enumerate(messages):
        yield Silence(f"Silent{i:02d}", message.name, max(50, 5 * message.cycle_ms))


def _threshold(name: str, message: Message, signal: Signal, raws: Raw, delays_ms: Sequence[int]) -> Threshold:
    top = signal.raw_range[1]
    low, high = (int(raw) for raw in np.quantile(raws, (0.90, 0.97)))
    low = min(low, top - 2)
    high = min(max(high, low + 1), top - 1)
    on_ms, off_ms = (_delay(ms, message) for ms in delays_ms)
    return Threshold(name, message.name, signal.name, _between(signal, high), _between(signal, low), on_ms, off_ms)


def _delay(wanted_ms: int, *messages: Message) -> int:
    """A delay that more than one frame decides about: at least two cycles."""
    return max(wanted_ms, *(2 * message.slowest_ms for message in messages)) if wanted_ms else 0


def _between(signal: Signal, raw: int) -> Decimal:
    """The physical value half a step above a raw value."""
    return (raw + Decimal("0.5")) * signal.factor + signal.offset


def _deviation(name: str, one: tuple[Message, Signal], other: tuple[Message, Signal], raws: dict[str, Raw]) -> Deviation:
    signals = one[1], other[1]
    values = [raws[signal.name] * float(signal.factor) + float(signal.offset) for signal in signals]
    size = min(map(len, values))
    sampled = [value[np.arange(size) * len(value) // size] for value in values]
    spread = np.abs(sampled[0] - sampled[1])
    grid = _common_step([number for signal in signals for number in (signal.factor, signal.offset)])
    low, high = (int(limit / float(grid)) for limit in np.quantile(spread, (0.90, 0.96)))
    half = Decimal("0.5")
    delay_ms = _delay(300, one[0], other[0])
    return Deviation(name, (one[0].name, other[0].name), (signals[0].name, signals[1].name),
                     (max(high, low + 1) + half) * grid, (low + half) * grid, delay_ms, delay_ms)


def _common_step(numbers: Sequence[Decimal]) -> Decimal:
    """The largest step of which all these numbers are multiples."""
    fractions = [Fraction(number) for number in numbers]
    denominator = math.lcm(*(fraction.denominator for fraction in fractions))
    return Decimal(math.gcd(*(int(fraction * denominator) for fraction in fractions))) / denominator


# --- DBC text -------------------------------------------------------------------------------------------------------------

_HEAD = ('VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: ECU UCS", "")
_ATTRIBUTES = (
    'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 3600000;',
    'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG","reserved","reserved","reserved","reserved",'
    '"reserved","reserved","reserved","reserved","reserved","reserved","StandardCAN_FD","ExtendedCAN_FD";',
    'BA_DEF_ SG_ "AlarmCode" INT 0 65535;',
    'BA_DEF_ SG_ "AlarmPriority" ENUM "Event","Low","Medium","High","Critical";',
    'BA_DEF_ SG_ "AlarmWhen" STRING;',
    'BA_DEF_ SG_ "AlarmUntil" STRING;',
    'BA_DEF_ SG_ "AlarmOnDelay" INT 0 86400000;',
    'BA_DEF_ SG_ "AlarmOffDelay" INT 0 86400000;',
    'BA_DEF_DEF_ "GenMsgCycleTime" 0;',
    'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";',
    'BA_DEF_DEF_ "AlarmCode" 0;',
    'BA_DEF_DEF_ "AlarmPriority" "Medium";',
    'BA_DEF_DEF_ "AlarmWhen" "";',
    'BA_DEF_DEF_ "AlarmUntil" "";',
    'BA_DEF_DEF_ "AlarmOnDelay" 0;',
    'BA_DEF_DEF_ "AlarmOffDelay" 0;',
)


def _dbc_messages(workload: Workload) -> Iterator[str]:
    for message in workload.messages:
        yield f"BO_ {message.dbc_id} {message.name}: {message.size} ECU"
        for signal in message.signals:
            position = signal.position
            start = position // 8 * 8 + 7 - position % 8 if message.motorola else position
            limits = "|".join(f"{raw * signal.factor + signal.offset:f}" for raw in signal.raw_range)
            role = " M" if signal.is_selector else "" if signal.branch is None else f" m{signal.branch}"
            order = 0 if message.motorola else 1
            yield (f" SG_ {signal.name}{role} : {start}|{signal.length}@{order}{'-' if signal.signed else '+'} "
                   f'({signal.factor:f},{signal.offset:f}) [{limits}] "" UCS')
        yield ""
    for number, names in enumerate(_alarm_messages(workload.rules)):
        yield f"BO_ {ALARM_ID + number} ALARMS{number}: 8 UCS"
        for i, name in enumerate(names):
            yield f' SG_ {name} : {2 * i}|2@1+ (1,0) [0|3] "" ECU'
        yield ""


def _alarm_messages(rules: Sequence[Rule]) -> list[list[str]]:
    names = [rule.name for rule in rules]
    return [names[i:i + 32] for i in range(0, len(names), 32)]


def _dbc_cycles(workload: Workload) -> Iterator[str]:
    for message in workload.messages:
        yield f'BA_ "GenMsgCycleTime" BO_ {message.dbc_id} {message.cycle_ms};'
        if message.is_fd:
            yield f'BA_ "VFrameFormat" BO_ {message.dbc_id} {15 if message.extended else 14};'
    for number in range(len(_alarm_messages(workload.rules))):
        yield f'BA_ "GenMsgCycleTime" BO_ {ALARM_ID + number} 1000;'


def _dbc_alarms(rules: Sequence[Rule]) -> Iterator[str]:
    for number, rule in enumerate(rules):
        for attribute, value in ({"AlarmCode": number + 1, "AlarmPriority": 2} | _alarm(rule)).items():
            text = f'"{value}"' if isinstance(value, str) else value
            yield f'BA_ "{attribute}" SG_ {ALARM_ID + number // 32} {rule.name} {text};'


def _alarm(rule: Rule) -> dict[str, int | str]:
    """The rule in the alarm language."""
    match rule:
        case Threshold():
            conditions = {"AlarmWhen": f"{rule.signal} > {rule.high:f}", "AlarmUntil": f"{rule.signal} < {rule.low:f}"}
        case Deviation():
            distance = f"abs({rule.signals[0]} - {rule.signals[1]})"
            conditions = {"AlarmWhen": f"{distance} > {rule.high:f}", "AlarmUntil": f"{distance} < {rule.low:f}"}
        case Equality():
            conditions = {"AlarmWhen": f"{rule.signal} == {rule.word}"}
        case Silence():
            return {"AlarmWhen": f"silent({rule.message}, {rule.limit_ms} ms)"}
    return {**conditions, "AlarmOnDelay": rule.on_ms, "AlarmOffDelay": rule.off_ms}


def _dbc_words(workload: Workload) -> Iterator[str]:
    for message in workload.messages:
        for signal in message.signals:
            if signal.named:
                words = " ".join(f'{raw} "State_{raw}"' for raw in range(1 << signal.length))
                yield f"VAL_ {message.dbc_id} {signal.name} {words} ;"
