"""What level 2 knows, on its own disk: events exactly once, what is missing, what is lost. Committed before acknowledged."""
from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from bridge.error import OutsideError
from bridge.ranges import Range, Ranges
from bridge.wire import Alarm, Event, event_line, read_event_line

SCHEMA = 1


class StoreError(OutsideError):
    """The store can't be opened or written. One line: what is wrong, what to do."""


class Sender(NamedTuple):
    """A boot of a unit: what seqs count in."""

    fleet: str
    unit: str
    boot: int


class Outcome(Enum):
    """What became of an arrived event. CONFLICT: its identity was given to another event; both are kept."""

    NEW = "new"
    DUPLICATE = "duplicate"
    CONFLICT = "conflict"


class Arrival(NamedTuple):
    """A stored event; lost: seqs before it that its unit no longer has."""

    fleet: str
    alarm: Alarm
    outcome: Outcome
    lost: tuple[Range, ...]


class Store:
    """Level 2's SQLite file; a context manager. Opening raises StoreError."""

    def __init__(self, path: Path):
        self.path = path
        self._known: dict[Sender, Ranges] = {}
        try:
            self._connection = _connect(path)
        except sqlite3.Error as error:
            raise StoreError(f"store {path}: can't be used ({error}); give the path of a file in a folder "
                             "that this user may write to, or move that file away") from None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def add(self, alarms: Iterable[tuple[str, Alarm]], received: str) -> list[Arrival]:
        """Store events of fleets in one transaction; on the disk when it returns. Raises StoreError, with nothing stored.

        received: UTC label of their arrival.
        """
        arrivals: list[Arrival] = []
        changed: dict[Sender, None] = {}
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            for fleet, alarm in alarms:
                arrivals.append(self._add(fleet, alarm, received))
                changed[Sender(fleet, alarm.unit, alarm.boot)] = None
            for sender in changed:
                self._write_known(sender)
            self._connection.execute("COMMIT")
        except sqlite3.Error as error:
            self._known.clear()
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise StoreError(f"store {self.path}: can't be written ({error}); nothing is acknowledged until it can") from None
        return arrivals

    def known(self, sender: Sender) -> Ranges:
        """The seqs that are here or can't come any more. To be changed by `add` only."""
        if sender not in self._known:
            rows = self._connection.execute("SELECT first, last FROM known WHERE fleet = ? AND unit = ? AND boot = ?", sender)
            self._known[sender] = Ranges(rows.fetchall())
        return self._known[sender]

    def gaps(self) -> dict[Sender, list[Range]]:
        """What is missing below something that is here."""
        rows = self._connection.execute("SELECT fleet, unit, boot FROM known GROUP BY fleet, unit, boot HAVING count(*) > 1 "
                                        "OR min(first) > 1").fetchall()
        senders = [Sender(*row) for row in rows]
        return {sender: list(self.known(sender).missing(1, self.known(sender).last)) for sender in senders}

    def events(self, unit: str | None = None, limit: int = -1) -> list[Event]:
        """Stored events in order of unit, boot and seq."""
        where, values = ("WHERE unit = ?", [unit]) if unit is not None else ("", [])
        query = f"SELECT line FROM event {where} ORDER BY fleet, unit, boot, seq LIMIT {int(limit)}"
        rows = self._connection.execute(query, values)
        return [read_event_line(line) for line, in rows]

    def count(self, table: str) -> int:
        """Rows of one of the tables event, lost, conflict."""
        if table not in ("event", "lost", "conflict"):
            raise ValueError(table)
        return int(self._connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])

    def _add(self, fleet: str, alarm: Alarm, received: str) -> Arrival:
        sender = Sender(fleet, alarm.unit, alarm.boot)
        line = event_line(alarm)
        key = (*sender, alarm.seq)
        inserted = self._connection.execute("INSERT OR IGNORE INTO event VALUES (?, ?, ?, ?, ?, ?, ?)",
                                            (*key, line, alarm.historical, received)).rowcount
        known = self.known(sender)
        lost = tuple(known.missing(alarm.prev + 1, alarm.seq - 1))
        for pair in lost:
            self._connection.execute("INSERT INTO lost VALUES (?, ?, ?, ?, ?)", (*sender, *pair))
            known.add(*pair)
        known.add(alarm.seq, alarm.seq)
        return Arrival(fleet, alarm, Outcome.NEW if inserted else self._again(key, line, received), lost)

    def _again(self, key: Sequence[str | int], line: bytes, received: str) -> Outcome:
        where = "WHERE fleet = ? AND unit = ? AND boot = ? AND seq = ?"
        before = self._connection.execute(f"SELECT line FROM event {where}", key).fetchone()[0]
        if before == line or self._connection.execute(f"SELECT 1 FROM conflict {where} AND line = ?", (*key, line)).fetchone():
            return Outcome.DUPLICATE
        self._connection.execute("INSERT INTO conflict VALUES (?, ?, ?, ?, ?, ?)", (*key, line, received))
        return Outcome.CONFLICT

    def _write_known(self, sender: Sender) -> None:
        self._connection.execute("DELETE FROM known WHERE fleet = ? AND unit = ? AND boot = ?", sender)
        self._connection.executemany("INSERT INTO known VALUES (?, ?, ?, ?, ?)", ((*sender, *pair) for pair in self._known[sender]))


def _connect(path: Path) -> sqlite3.Connection:
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    connection = sqlite3.connect(path, timeout=1.0, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version > SCHEMA:
            raise sqlite3.DatabaseError(f"written by a later version, schema {version}")
        if version == 0 and connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            raise sqlite3.DatabaseError("another program's database")
        if version == 0:
            _create(connection)
        return connection
    except BaseException:
        connection.close()
        raise


def _create(connection: sqlite3.Connection) -> None:
    connection.execute("BEGIN IMMEDIATE")
    sender = "fleet TEXT, unit TEXT, boot INTEGER"
    key = "PRIMARY KEY (fleet, unit, boot"
    connection.execute(f"CREATE TABLE event ({sender}, seq INTEGER, line BLOB, historical INTEGER, received TEXT, {key}, seq))"
                       " WITHOUT ROWID")
    connection.execute(f"CREATE TABLE known ({sender}, first INTEGER, last INTEGER, {key}, first)) WITHOUT ROWID")
    connection.execute(f"CREATE TABLE lost ({sender}, first INTEGER, last INTEGER)")
    connection.execute(f"CREATE TABLE conflict ({sender}, seq INTEGER, line BLOB, received TEXT)")
    connection.execute(f"PRAGMA user_version = {SCHEMA}")
    connection.execute("COMMIT")
