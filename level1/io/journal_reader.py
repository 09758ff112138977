"""The journal as another process reads it: the bridge, `ucs journal`, a test."""
from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from level1.event import Commanded, Event, decode, decode_commanded
from level1.io.journal_file import FIRST, Position, identity, open_for_reading, unreadable

T = TypeVar("T")
BOOTS = """
    WITH RECURSIVE found(boot) AS (
        SELECT min(boot) FROM event
        UNION ALL SELECT (SELECT min(boot) FROM event WHERE event.boot > found.boot) FROM found WHERE boot IS NOT NULL)
"""
"""From one boot to the next by the index: `DISTINCT` and `GROUP BY` would go through every event."""


class Reader:
    """Read-only and never in the writer's way; follows a journal that was replaced. Everything raises JournalError.

    unreadable: events met whose content was damaged; they are left out.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        self.unreadable = 0
        self._version = -1
        self._open()

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def changed(self) -> bool:
        """Whether anything was written since the last call; True at first. Costs about 10 µs."""
        if identity(self.path) != self._identity:
            self.close()
            self._open()
        version = self._scalar("PRAGMA data_version")
        changed, self._version = version != self._version, version
        return changed

    def events(self, after: Position = FIRST, limit: int = 1000, *, before: Position | None = None,
               alarm: str | None = None, event: str | None = None) -> list[Event]:
        """Events after a position (and before another), in order, at most `limit`; only of an alarm, only of a kind."""
        where, values = "(boot, seq) > (?, ?)", [*after]
        if before:
            where, values = f"{where} AND (boot, seq) < (?, ?)", [*values, *before]
        names = [(column, name) for column, name in (("alarm", alarm), ("event", event)) if name is not None]
        where += "".join(f" AND {column} = ?" for column, _ in names)
        rows = self._rows(f"SELECT line FROM event WHERE {where} ORDER BY boot, seq LIMIT {int(limit)}",
                          [*values, *(name for _, name in names)])
        return [found for line, in rows if (found := self._decoded(line, decode))]

    def commands(self, after: Position = FIRST, limit: int = 1000) -> list[tuple[Position, Commanded]]:
        """Commands after a (boot, number), in order, at most `limit`, each with its own (boot, number)."""
        if not self._scalar("SELECT count(*) FROM sqlite_master WHERE name = 'command'"):
            return []  # written by an earlier version, which `ucs run` has not opened since
        rows = self._rows("SELECT boot, number, line FROM command WHERE (boot, number) > (?, ?) ORDER BY boot, number "
                          f"LIMIT {int(limit)}", after)
        return [((boot, number), found) for boot, number, line in rows if (found := self._decoded(line, decode_commanded))]

    def last(self) -> Position:
        """The newest event's position, `FIRST` in a journal without events."""
        rows = self._rows("SELECT boot, seq FROM event ORDER BY boot DESC, seq DESC LIMIT 1")
        return (rows[0][0], rows[0][1]) if rows else FIRST

    def latest(self, alarm: str, event: str) -> Event | None:
        """The newest event of a kind of an alarm."""
        query = "SELECT line FROM event WHERE alarm = ? AND event = ? ORDER BY boot DESC, seq DESC LIMIT 1"
        rows = self._rows(query, (alarm, event))
        return self._decoded(rows[0][0], decode) if rows else None

    def state(self) -> bytes | None:
        """The supervisor's state as last written."""
        rows = self._rows("SELECT snapshot FROM state")
        return rows[0][0] if rows else None

    def boots(self) -> tuple[int, ...]:
        """Every boot id, in order."""
        rows = self._rows(f"{BOOTS} SELECT boot FROM found WHERE boot IS NOT NULL UNION SELECT boot FROM boot ORDER BY boot")
        return tuple(boot for boot, in rows)

    def last_seqs(self) -> dict[int, int]:
        """Boot -> seq of its newest event, for every boot that has any."""
        return dict(self._rows(f"{BOOTS} SELECT boot, (SELECT max(seq) FROM event WHERE event.boot = found.boot) "
                               "FROM found WHERE boot IS NOT NULL"))

    def last_seq(self, boot: int) -> int:
        """The seq of the newest event of a boot, 0 where it has none."""
        return self._scalar("SELECT max(seq) FROM event WHERE boot = ?", (boot,))

    def seq_before(self, position: Position) -> int:
        """The seq of the event before this one in its boot, 0 where there is none."""
        return self._scalar("SELECT max(seq) FROM event WHERE boot = ? AND seq < ?", position)

    @property
    def unit(self) -> str:
        """The unit whose journal it is."""
        return str(self._rows("SELECT name FROM unit")[0][0])

    def _open(self) -> None:
        self._identity = identity(self.path)
        self._connection = open_for_reading(self.path)
        self._version = -1

    def _decoded(self, line: bytes, decode: Callable[[bytes], T]) -> T | None:
        try:
            return decode(line)
        except (msgspec.DecodeError, TypeError):
            self.unreadable += 1
            return None

    def _rows(self, query: str, values: Sequence[int | str] = ()) -> list[Any]:
        try:
            return self._connection.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise unreadable(self.path, error) from None

    def _scalar(self, query: str, values: Sequence[int] = ()) -> int:
        return int(self._rows(query, values)[0][0] or 0)


def read_events(path: Path, after: Position = FIRST, limit: int = 1000) -> list[Event]:
    """Events of a journal after a position, in order, at most `limit`. Raises JournalError."""
    with Reader(path) as reader:
        return reader.events(after, limit)
