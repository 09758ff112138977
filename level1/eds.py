"""What an electronic data sheet (EDS, CiA 306) says about a CANopen device, as far as its supervision needs it.

Pure: takes the text of the file. An EDS is an INI file; what it holds beyond this (the whole object dictionary) is not looked at.
"""
from __future__ import annotations

import configparser
import re
from collections.abc import Mapping

import msgspec

MAX_SIZE = 2_000_000
"""Characters of the longest file that is read; real ones have 10 to 500 thousand."""
MAX_NAME = 64
MAX_ERRORS = 1000
HEARTBEAT_PRODUCER, ERROR_FIELD, GUARD_TIME, LIFE_TIME_FACTOR = "1017", "1003", "100c", "100d"
ERROR_SECTION = "EmergencyErrorCodes"
"""Not of CiA 306, which has no place for the texts of error codes: `0xFF01=what it means`, ignored by other tools."""
_UNPRINTABLE = re.compile(r"[^\x20-\x7e\xa0-\uffff]+")


class EdsError(ValueError):
    """A text that is no EDS; it says why."""


class DataSheet(msgspec.Struct, frozen=True):
    """An EDS. name: product name, may be empty. heartbeat_ns: producer heartbeat time the device comes with (object 0x1017), None
    where it has none. history: whether it keeps its last errors (0x1003). errors: texts of its own error codes, by code.
    guard_ns, life_factor: guard time (0x100C) and life time factor (0x100D); None where it comes without, or is not to be guarded.
    """

    name: str = ""
    heartbeat_ns: int | None = None
    history: bool = False
    errors: dict[int, str] = {}
    guard_ns: int | None = None
    life_factor: int | None = None


def parse(text: str) -> DataSheet:
    """Read an EDS or DCF. Raises EdsError."""
    if len(text) > MAX_SIZE:
        raise EdsError(f"longer than {MAX_SIZE} characters")
    parser = configparser.RawConfigParser(strict=False, inline_comment_prefixes=(";",), delimiters=("=",))
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise EdsError(str(error).splitlines()[0]) from error
    sections = {name.lower(): parser[name] for name in parser.sections()}
    if "deviceinfo" not in sections:
        raise EdsError("no section [DeviceInfo]")
    return DataSheet(_clean(sections["deviceinfo"].get("productname", "")), _milliseconds(sections, HEARTBEAT_PRODUCER),
                     ERROR_FIELD in sections, _errors(sections.get(ERROR_SECTION.lower(), {})),
                     _milliseconds(sections, GUARD_TIME), _setting(sections, LIFE_TIME_FACTOR, 0xFF))


def _milliseconds(sections: Mapping[str, Mapping[str, str]], entry: str) -> int | None:
    """A time of 16 bits, in nanoseconds."""
    milliseconds = _setting(sections, entry, 0xFFFF)
    return milliseconds * 1_000_000 if milliseconds is not None else None


def _setting(sections: Mapping[str, Mapping[str, str]], entry: str, most: int) -> int | None:
    """The value a DCF gives, else the default; None where it is 0, which switches the service off, or none that can be."""
    found = sections.get(entry, {})
    value = _number(found.get("parametervalue") or found.get("defaultvalue") or "0")
    return value if value and 0 < value <= most else None


def _errors(section: Mapping[str, str]) -> dict[int, str]:
    codes = {code: _clean(text) for key, text in list(section.items())[:MAX_ERRORS] if (code := _number(key)) is not None}
    return {code: text for code, text in codes.items() if code <= 0xFFFF and text}


def _number(text: str) -> int | None:
    """A whole number as EDS files write it: decimal, 0x hexadecimal, or octal with a leading 0."""
    digits = text.strip().lower()
    try:
        return int(digits, 8) if re.fullmatch(r"0[0-7]+", digits) else int(digits, 0)
    except ValueError:
        return None


def _clean(text: str) -> str:
    """One printable line of bounded length."""
    return _UNPRINTABLE.sub(" ", text).strip()[:MAX_NAME]
