"""Messages of all files: with their attributes, each name once, each identifier once on a bus."""
from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import msgspec

from level1.catalog import Message, Problem, Signal
from level1.decode import first_bit
from level1.definitions.attributes import Place
from level1.definitions.dbc_file import CLASSIC_BYTES, DbcFile
from level1.frame import frame_key
from level1.protection import CHECKSUMS

_TOPIC_LEVEL = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
"""A name that can be a level of an MQTT topic (DESIGN §6)."""

FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)
"""Payloads of a CAN FD frame above 8 bytes (ISO 11898-1)."""


def place_of(file: DbcFile, message: Message, problems: list[Problem], signal: Signal | None = None) -> Place:
    """The place of a message or of one of its signals."""
    return Place(file, (message.name, signal.name if signal else ""), problems)


def unique(files: Sequence[DbcFile], problems: list[Problem]) -> list[tuple[DbcFile, Message]]:
    """All messages of all files with their attributes, each name once."""
    result: dict[str, tuple[DbcFile, Message]] = {}
    for file in files:
        for message in file.messages:
            if message.name in result:
                first = result[message.name][1]
                place_of(file, message, problems).note(
                    "", f"message name is used twice, first in {first.file}:{first.line}", "names must differ over all files")
            else:
                _check_length(message, place_of(file, message, problems))
                result[message.name] = file, _with_attributes(file, message, problems)
    return list(result.values())


def _check_length(message: Message, place: Place) -> None:
    """What UCS sends goes out as one frame."""
    fd_lengths = FD_LENGTHS if not message.j1939 else ()
    if message.sent_by_ucs and message.length > CLASSIC_BYTES and message.length not in fd_lengths:
        place.note("", f"UCS can't send {message.length} bytes in one frame", f"at most {CLASSIC_BYTES}" + (
            f", or with CAN FD {', '.join(map(str, FD_LENGTHS))}" if fd_lengths else ""))


def _with_attributes(file: DbcFile, message: Message, problems: list[Problem]) -> Message:
    signals = tuple(_with_role(signal, place_of(file, message, problems, signal)) for signal in message.signals)
    for role in ("Counter", "Checksum"):
        bearers = [signal for signal in signals if signal.role == role]
        for signal in bearers[1:]:
            place_of(file, message, problems, signal).note(
                "Role", f"{message.name} has a {role.lower()} already: {bearers[0].name}", "a message has one of each at the most")
    monitor_as = place_of(file, message, problems).text("MonitorAs")
    if monitor_as and not _TOPIC_LEVEL.fullmatch(monitor_as):
        place_of(file, message, problems).note("MonitorAs", f"`{monitor_as}` can't be the name of a monitoring message",
                                               "letters, digits, - and _, beginning with a letter")
    return msgspec.structs.replace(message, signals=signals, monitor_as=monitor_as)


def _with_role(signal: Signal, place: Place) -> Signal:
    if not place.given("Role"):
        return signal
    role, checksum = place.word("Role", "None"), place.word("ChecksumType", next(iter(CHECKSUMS)))
    whole = signal.factor == 1 and signal.offset == 0 and not signal.signed and not signal.is_float
    if role != "None" and (not whole or signal.multiplexer_ids is not None):
        place.note("Role", f"a {role.lower()} is an unsigned whole number that is in every frame",
                   "factor 1, offset 0, not multiplexed")
        return signal
    if role == "Checksum" and (signal.length != 8 or first_bit(signal) % 8):
        place.note("Role", "a checksum takes one whole byte", "8 bits, beginning at a byte boundary")
        return signal
    return msgspec.structs.replace(signal, role=role, checksum=checksum)


def check_identifiers(messages: Iterable[tuple[DbcFile, Message]], bindings: Mapping[str, Sequence[int]],
                      problems: list[Problem]) -> None:
    """Notes messages that could not be told apart on a bus."""
    seen: dict[object, Message] = {}
    for file, message in messages:
        for bus in bindings.get(file.path, (0,)):
            if message.j1939:
                key: object = bus, message.pgn, message.source
                what = f"PGN {message.pgn} from " + ("any source" if message.source is None else f"source {message.source}")
            else:
                key = frame_key(message.can_id, message.extended, bus)
                what = f"identifier 0x{message.can_id:X}"
            first = seen.setdefault(key, message)
            if first is not message:
                place_of(file, message, problems).note(
                    "", f"{what} is used twice, first by {first.name} in {first.file}:{first.line}",
                    "one of them must go, or the files belong to different buses")
                break
