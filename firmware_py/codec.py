"""Payloads of a DBC file's messages, from and to values by name. Nodes know their bus through this only."""
from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import cantools.database

import dbc

Value = str | int | float
"""A physical value, or the name that the value table gives it."""

CACHED = 4096
"""Payloads remembered either way: cyclic messages repeat themselves."""


class Codec:
    """Encodes and decodes the messages of one or more DBC files. Shared by the nodes of a simulation.

    text: the files' texts. Raises cantools' errors when one is no DBC file.
    """

    def __init__(self, *texts: str):
        self._database: Any = cantools.database.can.Database(strict=True)
        for text in texts:
            self._database.add_dbc_string(text)
        self._messages: dict[str, Any] = {message.name: message for message in self._database.messages}
        self._encoded: dict[tuple[object, ...], bytes] = {}
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
        key = (name, *values.values())
        payload = self._encoded.get(key)
        if payload is None:
            message = self._messages[name]
            payload = bytes(message.encode(dict(values), padding=message.is_extended_frame, strict=True))
            _remember(self._encoded, key, payload)
        return payload

    def decode(self, name: str, data: bytes) -> Mapping[str, Value] | None:
        """Values of a payload; None when it is too short. A raw value without a name in its table stays a number."""
        key = (name, data)
        values = self._decoded.get(key)
        if values is None:
            message = self._messages[name]
            if len(data) < message.length:
                return None
            decoded = message.decode(data[:message.length])
            values = MappingProxyType({signal: value if isinstance(value, int | float) else str(value)
                                       for signal, value in decoded.items()})
            _remember(self._decoded, key, values)
        return values


def _remember(cache: dict[Any, Any], key: object, value: object) -> None:
    if len(cache) >= CACHED:
        cache.clear()
    cache[key] = value
