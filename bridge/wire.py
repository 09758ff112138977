"""What goes over MQTT between a unit and level 2: topics and messages (DESIGN §6). The contract for any other level 2.

A topic is `ucs/v1/<fleet>/<unit>/<kind>`, for monitoring `…/monitor/<message>`. A payload is one JSON object of the type
that `KINDS` names; `bridge/schema/` holds their JSON Schema files, written by `python -m bridge.contract`. A reader ignores
fields it doesn't know and refuses a `schema` above its own.
"""
from __future__ import annotations

import hashlib
import re
from decimal import Decimal
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from level1.event import SCHEMA as SCHEMA
from level1.event import Event as Event
from level1.event import Monitor as Monitor
from level1.event import SentFrame
from level1.event import decode as _decode_event
from level1.event import encode as _encode_event
from level1.event import seconds as seconds

PREFIX = ("ucs", "v1")
PAYLOAD_BYTES = 65_536
"""A longer payload is refused unread; an alarm with a large freeze frame has some 4 kB."""
NAME_BYTES = 64
EXPONENT = 30
"""Numbers beyond 10**30 or finer than 10**-30 are refused."""
PERIOD_S = 0.25
"""Of monitoring messages, unless level 2 has asked for another or the unit's configuration says so (SPEC §3)."""
RANGES = 64
"""Ranges an acknowledgement names at most."""

UP = ("connection", "monitor", "alarm", "result")
DOWN = ("ack", "command")

_FORBIDDEN = r"\s/+#*>\x00-\x1f\x7f-\x9f"
"""Separators and wildcards of MQTT and of NATS, and what steers a terminal."""
_NAME = re.compile(f"[^${_FORBIDDEN}][^{_FORBIDDEN}]*")

Name = Annotated[str, Meta(min_length=1, max_length=NAME_BYTES, pattern=f"^[^${_FORBIDDEN}][^{_FORBIDDEN}]*$(?!\n)")]
"""One level of a topic, and harmless on a terminal. (Python's `$` alone would let a line end follow.)"""
Version = Annotated[int, Meta(ge=1, le=SCHEMA)]
Count = Annotated[int, Meta(ge=0, le=2**53 - 1)]
Identity = Annotated[int, Meta(ge=1, le=2**53 - 1)]
Text = Annotated[str, Meta(max_length=1024)]


class WireError(ValueError):
    """A payload or topic that doesn't keep the contract. One line: what is wrong."""


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """What every message begins with.

    schema: version of the format. unit: who it is from, or for (it equals the topic's). boot: the unit's boot id.
    seq: see each message. t: seconds on the unit's monotonic clock, nine places. utc: RFC 3339 label beside it, null
    where no wall clock is known; utc_trusted: whether that clock was synchronised.
    """

    schema: Version = SCHEMA
    unit: Name
    boot: Count
    seq: Count
    t: Decimal
    utc: str | None = None
    utc_trusted: bool = False


class Connection(Header, frozen=True, kw_only=True):
    """State of the bridge, retained; the last will says CONNECTION_BROKEN (words of VDA 5050). seq counts these messages.

    supervising: whether the unit's supervision itself was heard within the last 2 s. waiting: events not acknowledged.
    """

    state: Literal["ONLINE", "OFFLINE", "CONNECTION_BROKEN"]
    supervising: bool
    waiting: Count


class MonitorMessage(Header, frozen=True, kw_only=True):
    """A monitoring message: state, never an alarm. Only the latest is ever sent; seq counts those of this `message`.

    values: number, value-table name or null; age_s: seconds since each was received; quality: of each, "ok" or why not.
    period_s: so often it is sent now; level 2 can have it sent less often.
    """

    message: Name
    values: dict[str, Any]
    age_s: dict[str, float | None] = {}
    quality: dict[str, str] = {}
    period_s: Annotated[float, Meta(ge=0, le=86_400)] = PERIOD_S


class Alarm(Header, frozen=True, kw_only=True):
    """One step in the life of an alarm. (unit, boot, seq) names it for ever; it may arrive more than once and out of order.

    prev: seq of the event before it in this boot as the unit has it, 0 for none: what lies between is lost, not late.
    historical: it waited in the unit's journal for a connection. The other fields are those of the event (DESIGN §8).
    """

    seq: Identity
    alarm: Text
    code: Count
    priority: Literal["Event", "Low", "Medium", "High", "Critical"]
    event: Literal["raised", "repair_started", "repair_failed", "repaired", "locked_out", "cleared", "acknowledged"]
    instance: Count
    attempt: Count
    values: dict[str, Any]
    text: str
    frames: tuple[SentFrame, ...] = ()
    passive: bool = False
    prev: Count = 0
    historical: bool = False


class Ack(Header, frozen=True, kw_only=True):
    """Level 2 has committed to its own disk: of this boot every event up to `seq`, and those in the ranges `also`.

    also: pairs of first and last seq, above `seq`. missing: pairs it knows of and lacks; the unit sends them again.
    t, utc: level 2's clocks.
    """

    also: Annotated[tuple[tuple[Identity, Identity], ...], Meta(max_length=RANGES)] = ()
    missing: Annotated[tuple[tuple[Identity, Identity], ...], Meta(max_length=RANGES)] = ()


class Command(msgspec.Struct, frozen=True, kw_only=True):
    """A signed command. body: JSON text of an `Order`; signature: Ed25519 (RFC 8032) over the bytes of
    `ucs/v1/<fleet>/<unit>/command`, a line feed, and the body in UTF-8; in base64. key: name of the key that signed.
    """

    schema: Version = SCHEMA
    key: Name
    body: Annotated[str, Meta(max_length=4096)]
    signature: Annotated[str, Meta(max_length=128)]


class Order(Header, frozen=True, kw_only=True):
    """What a command says. boot and t: the unit's, as level 2 last heard them; seq: the key's counter, strictly rising.

    id: comes back in the result. name: acknowledge, reset, pause, resume, stop, or a command of the unit's definitions.
    target: alarm name, for acknowledge and reset. value: for a command that takes one. expires_t: on the unit's clock, at
    most 30 s after t; later it is refused.
    """

    seq: Identity
    id: Name
    name: Name
    target: Annotated[str, Meta(max_length=256)] = ""
    value: Decimal | None = None
    expires_t: Decimal


class Result(Header, frozen=True, kw_only=True):
    """The answer to a command. seq: the order's counter, 0 where it could not be read; id: then empty.

    digest: SHA-256 of the command's payload in hexadecimal, where id is empty: tells whose refusal it is.
    """

    id: Annotated[str, Meta(max_length=NAME_BYTES)]
    outcome: Literal["done", "refused"]
    reason: Text = ""
    digest: Annotated[str, Meta(max_length=64)] = ""


Message = Connection | MonitorMessage | Alarm | Ack | Command | Result
KINDS: dict[str, type[Message]] = {"connection": Connection, "monitor": MonitorMessage, "alarm": Alarm, "ack": Ack,
                                   "command": Command, "result": Result}
SCHEMAS: dict[str, type[msgspec.Struct]] = {**KINDS, "order": Order}

M = TypeVar("M", bound=msgspec.Struct)

_encoder = msgspec.json.Encoder(decimal_format="number")
_decoders = {kind: msgspec.json.Decoder(kind) for kind in SCHEMAS.values()}


class _Versioned(msgspec.Struct):
    schema: int


class Topic(NamedTuple):
    """A topic taken apart; message: the monitoring message's name, "" for other kinds."""

    fleet: str
    unit: str
    kind: str
    message: str = ""


def encode(message: msgspec.Struct) -> bytes:
    """The payload of a message."""
    return _encoder.encode(message)


def decode(payload: bytes, kind: type[M]) -> M:
    """The message in a payload. Raises WireError."""
    if len(payload) > PAYLOAD_BYTES:
        raise WireError(f"{len(payload)} bytes, at most {PAYLOAD_BYTES} are allowed")
    try:
        message = _decoders[kind].decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ArithmeticError) as error:
        raise WireError(_too_new(payload) or str(error)) from None
    assert isinstance(message, kind)
    for name in ("t", "value", "expires_t"):
        number = getattr(message, name, None)
        if isinstance(number, Decimal) and not is_plain(number):
            raise WireError(f"{name} is no plain number")
    return message


def shown(text: str) -> str:
    """A text of someone else's as one line for a terminal: what would steer it, or feign a line of ours, is spelt out."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def check_name(name: str, what: str) -> str:
    """A name that can be one level of a topic. Raises WireError with what to write instead."""
    if not _NAME.fullmatch(name) or len(name.encode()) > NAME_BYTES:
        raise WireError(f'{what} "{name}" can\'t stand in an MQTT topic; '
                        f'use letters, digits and "-", at most {NAME_BYTES}, no space, none of /+#*>, and no "$" in front')
    return name


def topic(fleet: str, unit: str, kind: str, message: str = "") -> str:
    """The topic of a message. Raises WireError for names that can't stand in one."""
    levels = [*PREFIX, check_name(fleet, "fleet"), check_name(unit, "unit"), kind]
    return "/".join([*levels, check_name(message, "monitoring message")] if kind == "monitor" else levels)


def parse_topic(text: str) -> Topic:
    """The parts of a topic. Raises WireError for one that is none of ours."""
    levels = text.split("/")
    known = len(levels) in (5, 6) and tuple(levels[:2]) == PREFIX and levels[4] in KINDS
    if not known or (len(levels) == 6) != (levels[4] == "monitor") or not all(map(_NAME.fullmatch, levels)):
        raise WireError(f'"{text[:200]}" is no topic of ours')
    return Topic(*levels[2:])


def alarm_message(event: Event, prev: int, historical: bool) -> Alarm:
    """The message that carries an event."""
    fields = {name: getattr(event, name) for name in Event.__struct_fields__}
    return Alarm(**fields, prev=prev, historical=historical)


def event_of(message: Alarm) -> Event:
    """The event a message carries."""
    return Event(**{name: getattr(message, name) for name in Event.__struct_fields__})


def event_line(message: Alarm) -> bytes:
    """The event a message carries as one JSON object (DESIGN §8), to be read by `read_event_line`."""
    return _encode_event(event_of(message))


def read_event_line(line: bytes) -> Event:
    """The event of a line. Raises msgspec.DecodeError."""
    return _decode_event(line)


def monitor_message(sample: Monitor, seq: int, period_s: float = PERIOD_S) -> MonitorMessage:
    """The message that carries a monitoring sample."""
    return MonitorMessage(seq=seq, period_s=period_s, **{name: getattr(sample, name) for name in Monitor.__struct_fields__})


def signed_bytes(fleet: str, unit: str, body: str) -> bytes:
    """What the signature of a command covers: the topic too, so that no command serves another unit."""
    return f"{topic(fleet, unit, 'command')}\n{body}".encode()


def digest(payload: bytes) -> str:
    """See `Result`."""
    return hashlib.sha256(payload).hexdigest()


def is_plain(number: Decimal) -> bool:
    """Whether a number can be printed and reckoned with: `1E999999999` would fill the memory with its digits."""
    digits, exponent = number.as_tuple()[1:]
    return isinstance(exponent, int) and -EXPONENT <= exponent <= EXPONENT and len(digits) <= 2 * EXPONENT


def _too_new(payload: bytes) -> str:
    try:
        version = msgspec.json.decode(payload, type=_Versioned).schema
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return ""
    return f"schema {version} is newer than {SCHEMA}, which this version knows; update it" if version > SCHEMA else ""
