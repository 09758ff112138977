"""Payloads of a DBC file's messages, from and to values by name. Nodes know their bus through this only.

Theory of operation. cantools reads the files and says what is right; but it needs some 50 µs for a message, and a simulation makes
hundreds a second. So each message gets a function of its own, made from its signals at the first use, that does the same arithmetic
with one integer. Whatever such a function does not know (multiplexers, floats, a value out of range, a wrong name) it leaves to
cantools, which does it or says what is wrong.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import cantools.database
from cantools.database.conversion import BaseConversion

import dbc

Value = str | int | float
"""A physical value, or the name that the value table gives it."""

Encoder = Callable[[Mapping[str, Value]], bytes | None]
Decoder = Callable[[bytes], dict[str, Value]]

CACHED = 4096
"""Payloads whose values are remembered: cyclic messages repeat themselves."""


class Codec:
    """Encodes and decodes the messages of one or more DBC files. Shared by the nodes of a simulation.

    text: the files' texts. Raises cantools' errors when one is no DBC file.
    """

    def __init__(self, *texts: str):
        self._database: Any = cantools.database.can.Database(strict=True)
        for text in texts:
            self._database.add_dbc_string(text)
        self._messages: dict[str, Any] = {message.name: message for message in self._database.messages}
        self._encoders: dict[str, Encoder] = {}
        self._decoders: dict[str, Decoder] = {}
        self._decoded: dict[tuple[str, bytes], Mapping[str, Value]] = {}

    @classmethod
    def shipped(cls, *names: str) -> Codec:
        """Of the definitions in the package `dbc`. Raises FileNotFoundError."""
        return cls(*(dbc.path(name).read_text("cp1252") for name in names))

    @property
    def names(self) -> tuple[str, ...]:
        """Every message, in the order of the files."""
        return tuple(self._messages)

    def identifier(self, name: str) -> tuple[int, bool]:
        """Identifier of a message and whether it has 29 bits. Raises KeyError."""
        message = self._messages[name]
        return int(message.frame_id), bool(message.is_extended_frame)

    def senders(self, name: str) -> tuple[str, ...]:
        """The nodes that may send a message. Raises KeyError."""
        return tuple(self._messages[name].senders)

    def cycle_ns(self, name: str) -> int:
        """Cycle time of a message (GenMsgCycleTime), 0 when it has none. Raises KeyError."""
        return round((self._messages[name].cycle_time or 0) * 1_000_000)

    def encode(self, name: str, values: Mapping[str, Value]) -> bytes:
        """Payload of a message; every signal is given, by name and in range, else cantools' EncodeError is raised.

        Bits that no signal has are 0, in messages of 29-bit identifiers 1, as J1939 has it (SAE J1939-71).
        """
        encoder = self._encoders.get(name)
        if encoder is None:
            encoder = self._encoders[name] = _encoder(self._messages[name])
        payload = encoder(values)
        if payload is None:
            message = self._messages[name]
            payload = bytes(message.encode(dict(values), padding=message.is_extended_frame, strict=True))
        return payload

    def decode(self, name: str, data: bytes) -> Mapping[str, Value] | None:
        """Values of a payload; None when it is too short. A raw value without a name in its table stays a number."""
        key = (name, data)
        values = self._decoded.get(key)
        if values is None:
            message = self._messages[name]
            if len(data) < message.length:
                return None
            decoder = self._decoders.get(name)
            if decoder is None:
                decoder = self._decoders[name] = _decoder(message)
            values = MappingProxyType(decoder(data))
            if len(self._decoded) >= CACHED:
                self._decoded.clear()
            self._decoded[key] = values
        return values


def _is_plain(message: Any) -> bool:
    """Whether a message is one word of integers."""
    return not message.is_multiplexed() and not message.is_container and not any(signal.is_float for signal in message.signals)


def _place(signal: Any, length: int) -> int:
    """How far a signal's lowest bit is from that of the payload, taken as one integer in the signal's byte order."""
    if signal.byte_order == "little_endian":
        return int(signal.start)
    highest = signal.start // 8 * 8 + 7 - signal.start % 8
    return int(8 * length - highest - signal.length)


def _encoder(message: Any) -> Encoder:
    """The function that packs a message; it gives None for what it leaves to cantools."""
    if not _is_plain(message):
        return lambda values: None
    length = message.length
    words = {"little_endian": "x", "big_endian": "y"}
    used = dict.fromkeys(words[signal.byte_order] for signal in message.signals)
    scope: dict[str, Any] = {"int_from": int.from_bytes}
    padding = (1 << 8 * length) - 1 if message.is_extended_frame else 0
    lines = []
    for number, signal in enumerate(message.signals):
        choices, most = {str(name): raw for raw, name in (signal.choices or {}).items()}, (1 << signal.length) - 1
        low, high = (-(most + 1 >> 1), most >> 1) if signal.is_signed else (0, most)
        margin = abs(signal.scale) * 1e-6
        place, word = _place(signal, length), words[signal.byte_order]
        covered = (most << place).to_bytes(length, "little" if word == "x" else "big")
        padding &= ~int.from_bytes(covered, "little")
        scope |= {f"c{number}": choices, f"raw{number}": BaseConversion.factory(signal.scale, signal.offset, None, False)
                  .numeric_scaled_to_raw}
        limits = [f"v {sign} {limit!r}" for sign, limit in (
            ("<", None if signal.minimum is None else signal.minimum - margin),
            (">", None if signal.maximum is None else signal.maximum + margin)) if limit is not None]
        raw = f"raw{number}(v)"
        if (signal.scale, signal.offset) == (1, 0):
            raw = "round(v)"
        elif not float(signal.scale).is_integer() or not float(signal.offset).is_integer():
            raw = f"round((v - {signal.offset!r}) / {signal.scale!r})"
        lines += [f"  v = values[{signal.name!r}]",
                  "  if v.__class__ is str:", f"   r = c{number}[v]",
                  "  else:", *([f"   if {' or '.join(limits)}: return None"] if limits else []), f"   r = {raw}",
                  f"  if not {low} <= r <= {high}: return None",
                  f"  {word} |= r << {place}" if not signal.is_signed else f"  {word} |= (r & {most}) << {place}"]
    if used == {"y": None}:
        start, end = int.from_bytes(padding.to_bytes(length, "little"), "big"), f"  return y.to_bytes({length}, 'big')"
        first = f"  y = {start}"
    else:
        first = f"  x = {padding}" + ("; y = 0" if "y" in used else "")
        swapped = f" | int_from(y.to_bytes({length}, 'big'), 'little')" if "y" in used else ""
        end = f"  return (x{swapped}).to_bytes({length}, 'little')"
    source = ["def encode(values):", f" if len(values) != {len(message.signals)}: return None", " try:", first, *lines, end,
              " except (KeyError, TypeError, AttributeError, ValueError, OverflowError):", "  return None"]
    exec(compile("\n".join(source), f"<encoder of {message.name}>", "exec"), scope)
    encoder: Encoder = scope["encode"]
    return encoder


def _decoder(message: Any) -> Decoder:
    """The function that unpacks a message long enough."""
    length = message.length
    if not _is_plain(message):
        return lambda data: {signal: value if isinstance(value, int | float) else str(value)
                             for signal, value in message.decode(data[:length]).items()}
    scope: dict[str, Any] = {"int_from": int.from_bytes}
    parts = []
    for number, signal in enumerate(message.signals):
        word, most = ("x" if signal.byte_order == "little_endian" else "y"), (1 << signal.length) - 1
        raw = f"{word} >> {_place(signal, length)} & {most}"
        if signal.is_signed:
            raw = f"(({raw}) ^ {most + 1 >> 1}) - {most + 1 >> 1}"
        scaled = "r" if (signal.scale, signal.offset) == (1, 0) else f"r * {signal.scale!r} + {signal.offset!r}"
        if signal.choices:
            scope[f"c{number}"] = {raw: str(name) for raw, name in signal.choices.items()}
            parts.append(f"{signal.name!r}: c{number}[r] if (r := {raw}) in c{number} else {scaled}")
        elif scaled == "r":
            parts.append(f"{signal.name!r}: {raw}")
        else:
            parts.append(f"{signal.name!r}: ({raw}) * {signal.scale!r} + {signal.offset!r}")
    source = ["def decode(data):", f" data = data[:{length}]", " x = int_from(data, 'little')"]
    source += [" y = int_from(data, 'big')"] if any(signal.byte_order == "big_endian" for signal in message.signals) else []
    source += [f" return {{{', '.join(parts)}}}"]
    exec(compile("\n".join(source), f"<decoder of {message.name}>", "exec"), scope)
    decoder: Decoder = scope["decode"]
    return decoder
