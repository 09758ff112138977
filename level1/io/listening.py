"""What a supervisor wants to hear of a bus, as filters of the kernel: everything else never reaches the program.

Messages that conditions, repairs or monitoring ask for, by identifier or parameter group; the groups and identifiers that
protocols listen to (transport, trouble codes, address claims; CANopen); what only the UCS may send, to notice a second talker;
and all that comes from the address the UCS has claimed.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from level1.catalog import Message
from level1.frame import EXTENDED, REMOTE, frame_key, j1939_pgn
from level1.io.socketcan import Filter, merged
from level1.supervisor import Supervisor

FLAGS = EXTENDED | REMOTE
PDU1, PDU2 = 0x03FF_0000, 0x03FF_FF00
"""Bits of an identifier that are the parameter group number: with a destination beside them, and without (SAE J1939-21 §5.2)."""


class Listening(NamedTuple):
    """What is wanted of a bus. filters: of the kernel, None: everything. cycle_of: nominal cycle of an identifier with flags,
    ns, None: it has none."""

    filters: tuple[Filter, ...] | None
    cycle_of: Callable[[int], int | None]


def listening(supervisor: Supervisor, bus: int, address: int | None, everything: bool) -> Listening:
    """What a supervisor wants of a bus. address: that the UCS has claimed there. everything: no filter: traffic is recorded."""
    messages = list(_messages(supervisor, bus))
    exact = {frame_key(message.can_id, message.extended): message.cycle_ns for message in messages if not message.j1939}
    groups = {message.pgn: message.cycle_ns for message in messages if message.j1939}

    def cycle_of(can_id: int) -> int | None:
        return exact.get(can_id) or (groups.get(j1939_pgn(can_id & 0x1FFF_FFFF)) if can_id & EXTENDED else None)
    return Listening(None if everything else tuple(dict.fromkeys(_filters(supervisor, messages, address))), cycle_of)


def group(pgn: int, source: int | None = None) -> Filter:
    """The filter of a parameter group, from any source address or a given one."""
    mask = PDU2 if pgn >> 8 & 0xFF >= 240 else PDU1
    return EXTENDED | pgn << 8 & mask | (source or 0), FLAGS | mask | (0xFF if source is not None else 0)


def _messages(supervisor: Supervisor, bus: int) -> Iterator[Message]:
    """Those of a bus that are asked for, and those that only the UCS sends."""
    catalog = supervisor.catalog
    for name, message in catalog.messages.items():
        asked = name in supervisor.board.pages or message.senders == ("UCS",)
        if asked and bus in catalog.buses.get(name, (0,)):
            yield message


def _filters(supervisor: Supervisor, messages: list[Message], address: int | None) -> Iterator[Filter]:
    standard = set(supervisor.board.identifiers)
    for message in messages:
        if message.j1939 and message.pgn is not None:
            yield group(message.pgn, message.source)
        elif message.extended:
            yield EXTENDED | message.can_id, FLAGS | 0x1FFF_FFFF
        else:
            standard.add(message.can_id)
    yield from merged(standard)
    for pgn in supervisor.board.listeners:
        yield group(pgn)
    if address is not None:
        yield EXTENDED | address, FLAGS | 0xFF
