"""What level 2 has acknowledged, on disk: the bridge's own file, since each file has one writer.

Losing it, or its last entries, costs a second delivery, never an event: level 2 removes duplicates. So it is written
without waiting for the disk, a damaged file is begun anew, and a disk that takes nothing is no reason to stop.
"""
from __future__ import annotations

import fcntl
import os
import sqlite3
from contextlib import suppress
from pathlib import Path

from bridge.ranges import Ranges
from level1.io.error import OutsideError

SCHEMA = 1


class Delivered:
    """Boot -> acknowledged seqs; a context manager. Opening raises OutsideError when another bridge has the file.

    fault: why the disk doesn't take it, "" when it does.
    """

    def __init__(self, path: Path):
        self.path = path
        self.fault = ""
        self._lock = _lock(path)
        self._connection = self._open()
        self._ranges = self._load()

    def __enter__(self) -> Delivered:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._connection.close()
        os.close(self._lock)

    def of(self, boot: int) -> Ranges:
        """The acknowledged seqs of a boot; to be changed by `add` only."""
        return self._ranges.get(boot) or Ranges()

    def add(self, boot: int, ranges: Ranges) -> None:
        """Put acknowledged seqs of a boot in."""
        known = self._ranges.setdefault(boot, Ranges())
        for first, last in ranges:
            known.add(first, last)
        try:
            self._connection.execute("BEGIN")
            self._connection.execute("DELETE FROM delivered WHERE boot = ?", (boot,))
            self._connection.executemany("INSERT INTO delivered VALUES (?, ?, ?)", ((boot, *pair) for pair in known))
            self._connection.execute("COMMIT")
            self.fault = ""
        except sqlite3.Error as error:
            self.fault = f"{self.path}: {error}; after a restart some events will be sent twice"
            with suppress(sqlite3.Error):
                self._connection.execute("ROLLBACK")

    @property
    def upto(self) -> dict[int, int]:
        """Boot -> seq up to which everything was acknowledged, as `Journal.prune` takes it."""
        return {boot: ranges.upto for boot, ranges in self._ranges.items()}

    def _open(self) -> sqlite3.Connection:
        try:
            return _connect(self.path)
        except sqlite3.Error as error:
            self.fault = f"{self.path}: {error}; begun anew, events will be sent twice"
        for suffix in ("", "-wal", "-shm"):
            with suppress(OSError):
                self.path.with_name(self.path.name + suffix).unlink()
        try:
            return _connect(self.path)
        except sqlite3.Error:
            return _prepared(sqlite3.connect(":memory:", isolation_level=None))

    def _load(self) -> dict[int, Ranges]:
        return _ranges(self._connection)


def delivered_path(journal: Path) -> Path:
    """Where the bridge of a journal notes what level 2 acknowledged."""
    return journal.with_name(journal.name + ".delivered")


def delivered_upto(path: Path) -> dict[int, int]:
    """What `Delivered.upto` gives, for another process; empty where there is no bridge yet."""
    return {boot: upto for boot, ranges in delivered_ranges(path).items() if (upto := ranges.upto)}


def delivered_ranges(path: Path) -> dict[int, Ranges]:
    """Boot -> acknowledged seqs, for another process; empty where there is no bridge yet."""
    try:
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
    except sqlite3.Error:
        return {}
    try:
        return _ranges(connection)
    except (sqlite3.Error, TypeError, ValueError):
        return {}
    finally:
        connection.close()


def _ranges(connection: sqlite3.Connection) -> dict[int, Ranges]:
    """All that it holds. Raises sqlite3.Error; TypeError and ValueError for what is no number."""
    ranges: dict[int, Ranges] = {}
    for boot, first, last in connection.execute("SELECT boot, first, last FROM delivered ORDER BY boot, first"):
        ranges.setdefault(int(boot), Ranges()).add(int(first), int(last))
    return ranges


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    try:
        if connection.execute("PRAGMA quick_check(1)").fetchone()[0] != "ok":
            raise sqlite3.DatabaseError("corrupt")
        return _prepared(connection)
    except BaseException:
        connection.close()
        raise


def _prepared(connection: sqlite3.Connection) -> sqlite3.Connection:
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    if connection.execute("PRAGMA user_version").fetchone()[0] not in (0, SCHEMA):
        raise sqlite3.DatabaseError("written by another version")
    connection.execute(f"PRAGMA user_version = {SCHEMA}")
    connection.execute("CREATE TABLE IF NOT EXISTS delivered (boot INTEGER, first INTEGER, last INTEGER)")
    return connection


def _lock(path: Path) -> int:
    try:
        lock = os.open(path.with_name(path.name + ".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise OutsideError(f"bridge {path}: can't be written ({error.strerror}); "
                           f"make {path.parent} a folder that this user may write to") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise OutsideError(f"bridge {path}: another `ucs bridge` serves this journal; stop that one") from None
    return lock
