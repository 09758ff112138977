"""candump text, line by line: the log form of `candump -l`/`-L` and the screen form with time stamps (can-utils, lib.c)."""
from __future__ import annotations

import re
from binascii import unhexlify
from calendar import timegm

from level1.frame import REMOTE
from level1.io.message import CLASSIC_BYTES, FD_BYTES, bounded, flagged_id

LOG = re.compile(rb"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]+)#(\S*)(?:\s+[RT])?\s*")
"""`(seconds.fraction) channel ID#DATA`, with the direction behind it or not."""
SCREEN = re.compile(rb"(?:\(([^)]*)\))?\s*(\S+)\s+(?:(?:RX|TX)\s+\S+\s+\S+\s+)?"
                    rb"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[(\d+)\]\s*(.*)")
"""`(stamp) channel ID [length] data bytes`."""
STAMP = re.compile(rb"(\d+)\.(\d{1,9})")
DATE = re.compile(rb"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{1,9})")
BYTES = re.compile(rb"((?:[0-9A-Fa-f]{2}(?:\s+|$))*)(?:'.*'|ERRORFRAME)?\s*")
LATEST_NS = (1 << 63) - 1
"""Highest time stamp: columns hold 64 bits, which end in the year 2262."""


def is_candump(line: bytes) -> bool:
    """Whether a line looks like candump text."""
    return bool(LOG.fullmatch(line) or SCREEN.fullmatch(line.strip()))


def candump_line(line: bytes) -> tuple[int, bytes, int, bytes]:
    """Time stamp in ns, channel, identifier with its flags (`Frame.key` without a bus) and data of a candump line.

    Raises ValueError with what is wrong.
    """
    if match := LOG.fullmatch(line):
        seconds, fraction, channel, name, payload = match.groups()
        return _nanoseconds(seconds, fraction), channel, *_log_frame(name, payload)
    if match := SCREEN.fullmatch(line):
        stamp, channel, name, length, rest = match.groups()
        return _stamp(stamp), channel, *_screen_frame(name, length, rest)
    raise ValueError("not candump text")


def spelled_id(name: bytes) -> int:
    """Identifier with the flags that its spelling means: 3 digits standard, 8 extended or an error frame."""
    value = int(name, 16)
    if len(name) == 8 and value >> 29 == 1:
        return value
    if len(name) not in (3, 8):
        raise ValueError(f"the identifier {name.decode()} has {len(name)} digits; candump writes 3 or 8")
    return flagged_id(value, len(name) == 8)


def _log_frame(name: bytes, payload: bytes) -> tuple[int, bytes]:
    """Flagged identifier and data of `ID#DATA`, `ID#R`, `ID##FDATA` (can-utils, lib.h)."""
    can_id = spelled_id(name)
    if payload.startswith(b"#"):
        return can_id, _data(payload[2:], FD_BYTES)
    if payload[:1] in (b"R", b"r"):
        return can_id | REMOTE, b""
    return can_id, _data(payload.split(b"_")[0], CLASSIC_BYTES)


def _screen_frame(name: bytes, length: bytes, rest: bytes) -> tuple[int, bytes]:
    """Flagged identifier and data of `ID [8] 11 22 …`; a length in two digits is CAN FD's."""
    can_id = spelled_id(name)
    if rest.startswith(b"remote request"):
        return can_id | REMOTE, b""
    match = BYTES.fullmatch(rest)
    if not match:
        raise ValueError("data bytes are not hexadecimal")
    data = _data(b"".join(match[1].split()), FD_BYTES if len(length) > 1 else CLASSIC_BYTES)
    if len(data) != int(length):
        raise ValueError(f"{len(data)} of {int(length)} data bytes")
    return can_id, data


def _data(digits: bytes, limit: int) -> bytes:
    try:
        data = unhexlify(digits)
    except ValueError:
        raise ValueError("data bytes are not pairs of hexadecimal digits") from None
    return bounded(data, limit)


def _nanoseconds(seconds: bytes, fraction: bytes) -> int:
    t_ns = int(seconds) * 10**9 + int(fraction.ljust(9, b"0"))
    if not 0 <= t_ns <= LATEST_NS:
        raise ValueError(f"time stamp {seconds.decode()} out of range")
    return t_ns


def _stamp(text: bytes | None) -> int:
    """Nanoseconds of a screen stamp: seconds, or a date and time, which is taken as UTC."""
    if text is None:
        raise ValueError("no time stamp; record with `candump -L` or `candump -ta`")
    if match := STAMP.fullmatch(text):
        return _nanoseconds(*match.groups())
    if match := DATE.fullmatch(text):
        return _nanoseconds(b"%d" % timegm((*map(int, match.groups()[:6]), 0, 0, 0)), match[7])
    raise ValueError(f'unreadable time stamp "{text.decode("ascii", "replace")}"')
