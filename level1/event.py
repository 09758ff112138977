"""What the core gives back: events (alarms and repairs), frames to send, answers to commands."""
from __future__ import annotations

from decimal import Decimal
from typing import Any

import msgspec

SCHEMA = 1
"""Version of the event and wire format; a reader refuses a higher one."""

EVENTS = ("raised", "repair_started", "repair_failed", "repaired", "locked_out", "cleared", "acknowledged")
PRIORITIES = ("Event", "Low", "Medium", "High", "Critical")

_NANO = Decimal(1).scaleb(-9)


def seconds(t_ns: int) -> Decimal:
    """Nanoseconds as decimal seconds with nine places, exactly."""
    return (Decimal(t_ns) * _NANO).quantize(_NANO)


class SentFrame(msgspec.Struct, frozen=True):
    """A frame a repair sends, as an event reports it: message name, identifier and payload in hexadecimal."""

    message: str
    id: str
    data: str


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """One step in the life of an alarm; always sent upward. Identity: (unit, boot, seq), never reused.

    t: seconds on the monotonic (or the recording's) time line, nine places.
    utc: RFC 3339 label beside it, or None where no wall clock is known; utc_trusted: whether it came from a synchronised clock.
    event: one of `EVENTS`. instance: seq of the `raised` it belongs to. attempt: number of the repair attempt, 0 outside one.
    values: freeze frame, inputs of the condition by `Message.Signal`: a number, a value-table name, or one of
            "never", "stale", "error", "unavailable".
    frames: what a `repair_started` sends; passive: it only would have (repair not armed).
    """

    unit: str
    boot: int
    seq: int
    t: Decimal
    utc: str | None
    utc_trusted: bool
    alarm: str
    code: int
    priority: str
    event: str
    instance: int
    attempt: int
    values: dict[str, Any]
    text: str
    frames: tuple[SentFrame, ...] = ()
    passive: bool = False


class Send(msgspec.Struct, frozen=True):
    """A frame for the bus, already through the core's gate. Valid until `expires_ns`: nothing stale is ever sent late."""

    t_ns: int
    key: int
    data: bytes
    message: str
    reason: str
    expires_ns: int


class Result(msgspec.Struct, frozen=True):
    """The answer to a command: `done` or `refused`, with the reason."""

    id: str
    outcome: str
    reason: str = ""


class Commanded(msgspec.Struct, frozen=True, omit_defaults=True):
    """A command that reached supervision and what came of it, as the journal keeps it; level 2 gets the `Result`.

    after: seq of the last event before it in this boot. command, target, value, origin, by: see `Order`; id: level 2's name for
    it, or supervision's where there is none. frames: what was sent for it.
    """

    unit: str
    boot: int
    after: int
    t: Decimal
    utc: str | None
    utc_trusted: bool
    command: str
    target: str
    value: Decimal | None
    origin: str
    by: str
    id: str
    outcome: str
    reason: str = ""
    frames: tuple[SentFrame, ...] = ()


class Monitor(msgspec.Struct, frozen=True):
    """A monitoring message: state, never an alarm (SPEC §3).

    values: number, value-table name, or None where the sample is not good; age_s: seconds since it was received, None before
    that; quality: a word of `decode.QUALITY_WORDS`.
    """

    unit: str
    boot: int
    t: Decimal
    utc: str | None
    utc_trusted: bool
    message: str
    values: dict[str, Any]
    age_s: dict[str, float | None]
    quality: dict[str, str]


Output = Event | Send | Result | Monitor

_SPELT_OUT = Decimal("1e-6")
"""Below this a decimal is written as 1E-9."""
_encoder = msgspec.json.Encoder(decimal_format="number")
_decoder = msgspec.json.Decoder(Event, strict=False)
_decode_commanded = msgspec.json.Decoder(Commanded, strict=False).decode
_decode_monitor = msgspec.json.Decoder(Monitor, strict=False).decode


def encode(event: Event | Commanded | Monitor | Result) -> bytes:
    """One JSON object, keys in the order of the fields, no line end; times with nine places, the smallest too."""
    line = _encoder.encode(event)
    if not isinstance(event, Result) and abs(event.t) < _SPELT_OUT:
        line = line.replace(b'"t":%s' % str(event.t).encode(), b'"t":%s' % f"{event.t:f}".encode(), 1)
    return line


def decode(line: bytes | str) -> Event:
    """The event of one JSON line. Raises msgspec.DecodeError (or its child ValidationError) on anything else."""
    return _decoder.decode(line)


def decode_commanded(line: bytes | str) -> Commanded:
    """The command of one JSON line. Raises as `decode`."""
    return _decode_commanded(line)


def decode_monitor(line: bytes | str) -> Monitor:
    """The monitoring message of one JSON line. Raises as `decode`."""
    return _decode_monitor(line)
