"""What was odd about a recording, told after it: what could not be read, and definitions that don't fit it."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from level1.catalog import Catalog, Message
from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, frame_key, j1939_pgn
from level1.io.merged import MergedLog
from level1.io.replay import Log
from ucs import inputs

ID_MASK = 0x1FFF_FFFF
MOST_SOURCES = 4
"""Messages told at most that come from another source address."""


def remarks(log: Log | MergedLog, counters: Mapping[str, int], keys: Iterable[int], catalog: Catalog,
            asked: Iterable[str]) -> Iterator[str]:
    """A line each. counters: the supervisor's; keys: of all frames; asked: channels named by the user."""
    if log.skipped:
        yield f"{log.complaints[0]}; {log.skipped:,} {'line' if log.skipped == 1 else 'lines'} skipped in all"
    if log.error_frames or log.remote_frames:
        yield f"{_count(log.error_frames, 'error frame')}, {_count(log.remote_frames, 'remote frame')}"
    if backwards := counters.get("time stamps that ran backwards", 0):
        yield f"{backwards:,} time stamps ran backwards and were taken as the highest before them"
    data = {key for key in keys if not key & (ERROR | REMOTE)}
    known = known_ids(catalog, data)
    if data and not known:
        which = f"none of the {len(data):,} ids" if len(data) > 1 else "the only id"
        yield (f"{which} in this recording ({_some_ids(data)}) is {'' if len(data) > 1 else 'not '}in these definitions"
               f"{_nearest(catalog, data)}; give the DBC files of the machine that was recorded")
    yield from _other_sources(catalog, data, known)
    for name in sorted(set(asked) - log.channels_seen):
        yield f"no frame of a channel {name}; its channels: {', '.join(sorted(log.channels_seen))}"


def known_ids(catalog: Catalog, keys: Iterable[int]) -> set[int]:
    """Those keys of frames that belong to a message of the catalog."""
    exact, groups = set(), set()
    for message in catalog.messages.values():
        for bus in catalog.buses.get(message.name, (0,)):
            if message.j1939 and message.pgn is not None:
                groups.add((bus, message.pgn, message.source))
            else:
                exact.add(frame_key(message.can_id, message.extended, bus))
    return {key for key in keys if key in exact or (key & EXTENDED and any(
        (key >> BUS_SHIFT, j1939_pgn(key & ID_MASK), source) in groups for source in (None, key & 0xFF)))}


def _nearest(catalog: Catalog, keys: Iterable[int]) -> str:
    """`; the nearest: …`, or nothing where no message has identifiers of that length."""
    received = [message for message in catalog.messages.values() if not message.sent_by_ucs]
    pairs = [(_distance(key, message), key, message) for key in sorted(keys) for message in received
             if bool(key & EXTENDED) == message.extended]
    if not pairs:
        lengths = ("29", "11") if all(message.extended for message in received) else ("11", "29")
        return f", which have ids of {lengths[0]} bits where the recording has {lengths[1]}" if received else ""
    (_, _, same_group), key, message = min(pairs, key=lambda pair: pair[0])
    if message.extended:
        pgn = j1939_pgn(key & ID_MASK)
        other = "the same" if same_group else f"{_group(message)}"
        return (f"; the nearest: {_spelled(key)}, PGN {pgn}, and {message.name} in {message.file}, {_spelled_message(message)}, "
                f"PGN {other}")
    return f"; the nearest: {_spelled(key)}, and {message.name} in {message.file}, {_spelled_message(message)}"


def _distance(key: int, message: Message) -> tuple[int, int, bool]:
    """How far an identifier is from a message's: by parameter group first where it has 29 bits; and whether that is the same."""
    if not message.extended:
        return abs((key & ID_MASK) - message.can_id), 0, False
    groups = abs(j1939_pgn(key & ID_MASK) - _group(message))
    return groups, abs((key & 0xFF) - (message.can_id & 0xFF)), not groups


def _group(message: Message) -> int:
    return message.pgn if message.pgn is not None else j1939_pgn(message.can_id)


def _other_sources(catalog: Catalog, keys: set[int], known: set[int]) -> Iterator[str]:
    """Messages that alarms look at, silent in the recording, whose parameter group another source address sends."""
    heard = {(key >> BUS_SHIFT, j1939_pgn(key & ID_MASK), key & 0xFF) for key in keys if key & EXTENDED}
    stray: dict[tuple[int, int], list[int]] = {}
    for key in sorted(keys - known):
        if key & EXTENDED:
            stray.setdefault((key >> BUS_SHIFT, j1939_pgn(key & ID_MASK)), []).append(key & 0xFF)
    told = []
    for name in sorted(inputs.messages(catalog)):
        message = catalog.messages.get(name)
        if message is None or not message.extended or (message.j1939 and message.source is None):
            continue
        source, group = message.can_id & 0xFF, _group(message)
        for bus in catalog.buses.get(name, (0,)):
            if (bus, group) in stray and (bus, group, source) not in heard:
                others = " and ".join(f"0x{other:02X}" for other in dict.fromkeys(stray[bus, group]))
                does = "does" if len(stray[bus, group]) == 1 else "do"
                told.append(f"{name} (PGN {group}) is defined for source address 0x{source:02X}, which never sends it here; "
                            f"{others} {does}: write that address, or FE for any, into its id in {message.file}")
    yield from told[:MOST_SOURCES]
    if len(told) > MOST_SOURCES:
        yield f"{len(told) - MOST_SOURCES} more messages come from another source address than their definitions say"


def _count(number: int, word: str) -> str:
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def _some_ids(keys: Iterable[int]) -> str:
    names = [_spelled(key) for key in sorted(keys)]
    return ", ".join(names[:5]) + (", …" if len(names) > 5 else "")


def _spelled(key: int) -> str:
    return f"{key & ID_MASK:0{8 if key & EXTENDED else 3}X}"


def _spelled_message(message: Message) -> str:
    return f"{message.can_id:0{8 if message.extended else 3}X}"
