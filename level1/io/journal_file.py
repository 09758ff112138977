"""The journal's SQLite file: its tables, its versions, what to do when it is corrupt."""
from __future__ import annotations

import errno
import json
import mmap
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import msgspec

from level1.event import Commanded, Event, decode, encode
from level1.io.bootfile import sync_folder
from level1.io.error import OutsideError

APPLICATION_ID = 0x5543_536A
"""`UCSj`: SQLite's mark of whose file it is."""
FIRST = (0, 0)
"""The position before every event."""
INSERT = "INSERT OR IGNORE INTO event VALUES (?, ?, ?, ?, ?)"
"""OR IGNORE: a try that failed half-way may have got there; an identity is never used twice."""

LINE_BEGINS = b'{"unit":"'
LINE_BYTES = 1100
"""A longer line does not lie on one page."""
INSERT_COMMAND = "INSERT OR IGNORE INTO command VALUES (?, ?, ?)"
SHARED_BYTES = 32 << 10
"""What SQLite's shared memory beside the journal takes at least."""
KEEP_COMMANDS = 10_000
"""Commands kept at most (about 4 MB); the oldest go."""

_json = json.JSONDecoder()

Position = tuple[int, int]
"""(boot, seq): which event, in the order in which they happened."""


class JournalError(OutsideError):
    """The journal can't be opened or read. One line: what is wrong, what to do."""


class DiskError(JournalError):
    """The disk is at fault, not the path or the user's rights. reason: what the disk said."""

    def __init__(self, text: str, reason: str):
        super().__init__(text)
        self.reason = reason


class CorruptError(sqlite3.DatabaseError):
    """SQLite's own check found the file damaged."""


def _create(connection: sqlite3.Connection) -> None:
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute("CREATE TABLE unit (name TEXT NOT NULL)")
    connection.execute("CREATE TABLE boot (boot INTEGER PRIMARY KEY)")
    connection.execute("CREATE TABLE state (one INTEGER PRIMARY KEY CHECK (one = 1), boot INTEGER, snapshot BLOB)")
    connection.execute("CREATE TABLE event (boot INTEGER, seq INTEGER, alarm TEXT, event TEXT, line BLOB,"
                       " PRIMARY KEY (boot, seq)) WITHOUT ROWID")


def _add_commands(connection: sqlite3.Connection) -> None:
    """Commands and the frames sent for them; number counts them within a boot."""
    connection.execute("CREATE TABLE command (boot INTEGER, number INTEGER, line BLOB, PRIMARY KEY (boot, number)) WITHOUT ROWID")


MIGRATIONS: tuple[Callable[[sqlite3.Connection], None], ...] = (_create, _add_commands)
"""Step n makes a file of schema version n into one of version n + 1, all in the transaction that opens the file."""


class JournalFile:
    """An open journal file and the connection to it. Raises sqlite3.Error, OSError, JournalError."""

    def __init__(self, path: Path, unit: str):
        self.path = path
        self.connection = sqlite3.connect(path, timeout=0.1, isolation_level=None, check_same_thread=False)
        try:
            self._prepare(unit)
            self._identity = identity(path)
        except BaseException:
            self.connection.close()
            raise

    @property
    def in_place(self) -> bool:
        """Whether the file is still the one at its path: SQLite would write on into a deleted file without a word."""
        return self._identity is not None and identity(self.path) == self._identity

    def commit(self, boot: int, events: Iterable[Event], state: bytes | None,
               commands: Iterable[tuple[int, Commanded]] = ()) -> None:
        """Write in one transaction; on the disk when it returns. Always writes something: success means it works.

        commands: with their numbers within their boot.
        """
        connection = self.connection
        connection.execute("BEGIN IMMEDIATE")
        try:
            connection.executemany(INSERT, map(_row, events))
            for number, command in commands:
                connection.execute(INSERT_COMMAND, (command.boot, number, encode(command)))
                connection.execute("DELETE FROM command WHERE (boot, number) <= (SELECT boot, number FROM command "
                                   "ORDER BY boot DESC, number DESC LIMIT 1 OFFSET ?)", (KEEP_COMMANDS,))
            if state is None:
                connection.execute("INSERT OR REPLACE INTO boot VALUES (?)", (boot,))
            else:
                connection.execute("INSERT OR REPLACE INTO state VALUES (1, ?, ?)", (boot, state))
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise

    def reuse_log(self) -> None:
        """Move the write-ahead log into the file, if the disk lets it, so that the log's space serves again."""
        with suppress(sqlite3.OperationalError):
            self.connection.execute("PRAGMA wal_checkpoint(RESTART)")

    def save_space(self, on: bool) -> None:
        """Keep the log short, for the sake of space, or let it grow to SQLite's default, for the sake of the card."""
        self.connection.execute(f"PRAGMA wal_autocheckpoint = {16 if on else 1000}")

    def last_boot(self) -> int:
        """The highest boot id in it, 0 in a new one."""
        return max(scalar(self.connection, f"SELECT max(boot) FROM {table}") for table in ("boot", "event", "state"))

    def state(self) -> bytes | None:
        """The supervisor's state as last written."""
        row = self.connection.execute("SELECT snapshot FROM state").fetchone()
        return row[0] if row else None

    def size(self) -> int:
        """Bytes in use; the file itself doesn't shrink, its free pages are used again."""
        names = ("page_count", "freelist_count", "page_size")
        pages, free, page_bytes = (scalar(self.connection, f"PRAGMA {name}") for name in names)
        return (pages - free) * page_bytes

    def delete_oldest(self, boot: int, seq: int | None, count: int) -> int:
        """Delete the `count` oldest events of a boot up to a seq, or (seq None) of all boots up to it; how many."""
        where, values = ("boot = ? AND seq <= ?", (boot, seq)) if seq is not None else ("boot <= ?", (boot,))
        return self.connection.execute(
            "DELETE FROM event WHERE (boot, seq) IN "
            f"(SELECT boot, seq FROM event WHERE {where} ORDER BY boot, seq LIMIT {count})", values).rowcount

    def salvage(self, kept: Path) -> int:
        """Copy in what a corrupt file still gives, by its tables, then from its bytes; the number of events saved."""
        before = self.connection.total_changes
        old = sqlite3.connect(kept, isolation_level=None)
        try:
            for order in ("boot, seq", "boot DESC, seq DESC"):
                self.connection.execute("BEGIN IMMEDIATE")
                self.connection.executemany(INSERT, _valid(_readable(old, f"SELECT line FROM event ORDER BY {order}")))
                self.connection.execute("COMMIT")
            self.connection.execute("BEGIN IMMEDIATE")
            self.connection.executemany(INSERT, _valid((line,) for file in (kept, beside(kept, "-wal")) for line in _carved(file)))
            self.connection.execute("COMMIT")
            saved = self.connection.total_changes - before
            for row in _readable(old, "SELECT boot, number, line FROM command"):
                self.connection.execute(INSERT_COMMAND, row)
            newest = scalar(self.connection, "SELECT max(boot) FROM event")
            for boot, snapshot in _readable(old, "SELECT boot, snapshot FROM state"):
                # written with every event: one of an earlier boot than the newest event is out of date
                if isinstance(boot, int) and isinstance(snapshot, bytes) and boot >= newest:
                    self.connection.execute("INSERT OR REPLACE INTO state VALUES (1, ?, ?)", (boot, snapshot))
            return saved
        finally:
            old.close()

    def close(self) -> None:
        """Close the connection; its last act moves the write-ahead log into the file."""
        self._identity = None
        self.connection.close()

    def _prepare(self, unit: str) -> None:
        connection = self.connection
        version = scalar(connection, "PRAGMA user_version")
        if version > len(MIGRATIONS):
            raise too_new(self.path, version, len(MIGRATIONS))
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA cell_size_check = ON")
        verdict = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if verdict != "ok":
            raise CorruptError(verdict)
        if version < len(MIGRATIONS):
            self._migrate(unit, version)
        owner = connection.execute("SELECT name FROM unit").fetchone()
        if owner is None:
            raise CorruptError("names no unit")
        if owner[0] != unit:
            raise JournalError(f'journal {self.path}: belongs to the unit "{owner[0]}", not "{unit}"; '
                               "give each unit a [journal] path of its own")

    def _migrate(self, unit: str, version: int) -> None:
        connection = self.connection
        if version == 0 and scalar(connection, "SELECT count(*) FROM sqlite_master"):
            raise JournalError(f"journal {self.path}: is another program's database; set another [journal] path")
        connection.execute("BEGIN IMMEDIATE")
        try:
            for migration in MIGRATIONS[version:]:
                migration(connection)
            if version == 0:
                connection.execute("INSERT INTO unit VALUES (?)", (unit,))
            connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise
        sync_folder(self.path.parent)


def set_aside(path: Path, boot: int) -> Path:
    """Rename a corrupt file, with its write-ahead log, after the boot that found it; gives its path. Raises OSError."""
    number = 0
    while (kept := beside(path, f".corrupt-{boot}" + f"-{number}" * bool(number))).exists():
        number += 1
    os.rename(path, kept)
    if beside(path, "-wal").exists():
        os.rename(beside(path, "-wal"), beside(kept, "-wal"))
    beside(path, "-shm").unlink(missing_ok=True)
    sync_folder(path.parent)
    return kept


def open_for_reading(path: Path) -> sqlite3.Connection:
    """A connection that can't write. Raises JournalError, among them for a file that is no journal."""
    if not path.is_file():
        raise JournalError(f"journal {path}: no such file; give the path of one that `ucs run` wrote")
    try:
        connection = read_only(path)
        version, mark = scalar(connection, "PRAGMA user_version"), scalar(connection, "PRAGMA application_id")
    except sqlite3.Error as error:
        raise unreadable(path, error) from None
    if mark == APPLICATION_ID and 0 < version <= len(MIGRATIONS):
        return connection
    connection.close()
    if mark == APPLICATION_ID and version:
        raise too_new(path, version, len(MIGRATIONS))
    if not _bytes(path):
        raise JournalError(f"journal {path}: empty; `ucs run` begins it as soon as its disk lets it")
    raise JournalError(f"journal {path}: not a journal; give the path of one that `ucs run` wrote")


def read_only(path: Path) -> sqlite3.Connection:
    """A connection that can't write, and works on a read-only disk. Raises sqlite3.Error."""
    uri = path.absolute().as_uri() + "?mode=ro"
    connection = sqlite3.connect(uri, uri=True, timeout=1.0, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return connection
    except sqlite3.OperationalError as error:
        connection.close()
        # a reader of a WAL file needs shared memory beside it; on a read-only disk nothing can change under it either
        if code(error) not in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY) or os.access(path.parent, os.W_OK):
            raise
        if _bytes(beside(path, "-wal")):  # it would be passed over, with the newest of all
            raise
    return sqlite3.connect(uri + "&immutable=1", uri=True, isolation_level=None, check_same_thread=False)


def beside(path: Path, suffix: str) -> Path:
    """The file whose name is the journal's with a suffix."""
    return path.with_name(path.name + suffix)


def _bytes(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def identity(path: Path) -> tuple[int, int] | None:
    """Which file a path names, None when there is none."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def scalar(connection: sqlite3.Connection, query: str, values: Sequence[int] = ()) -> int:
    """The integer a query gives; NULL is 0."""
    return int(connection.execute(query, values).fetchone()[0] or 0)


def code(error: BaseException) -> int:
    """SQLite's primary result code, 0 where the error has none."""
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF


def is_corrupt(error: BaseException) -> bool:
    """Whether the file's content is at fault, so that another file would do."""
    return isinstance(error, CorruptError) or code(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def is_full(path: Path, error: BaseException) -> bool:
    """Whether the disk has no room: SQLite calls it an input/output error when it is its shared memory that finds none."""
    if code(error) != sqlite3.SQLITE_IOERR:
        return code(error) == sqlite3.SQLITE_FULL or isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    try:
        disk = os.statvfs(path.parent)
    except OSError:
        return False
    return disk.f_bavail * disk.f_frsize < SHARED_BYTES


def is_disk_fault(path: Path, error: BaseException) -> bool:
    """Whether the disk takes or gives nothing: full, read-only, broken. Another path or other rights are no help to a unit in a
    field."""
    if is_full(path, error) or code(error) == sqlite3.SQLITE_IOERR:
        return True
    if isinstance(error, OSError):
        return error.errno in (errno.EROFS, errno.EIO)
    folder = next((folder for folder in path.parents if folder.exists()), path)
    try:
        return bool(os.statvfs(folder).f_flag & os.ST_RDONLY)
    except OSError:
        return True


def cannot_write(path: Path, error: Exception) -> JournalError:
    """The error of a journal that can't be opened for writing."""
    if is_full(path, error):
        return DiskError(f"journal {path}: can't be written, the disk is full; "
                         "delete files on it, or set another [journal] path", "the disk is full")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    text = (f"journal {path}: can't be written ({reason}); "
            f"make {path.parent} a folder that this user may write to, or set another [journal] path")
    return DiskError(text, reason) if is_disk_fault(path, error) else JournalError(text)


def unreadable(path: Path, error: Exception) -> JournalError:
    """The error of a journal that can't be read."""
    if is_full(path, error):
        return JournalError(f"journal {path}: can't be read, as the disk is full; delete files on it")
    if path.exists() and not os.access(path, os.R_OK):
        return JournalError(f"journal {path}: this user may not read it; run it as the user of `ucs run`")
    return JournalError(f"journal {path}: can't be read ({error}); `ucs run` sets a corrupt one aside and begins anew")


def too_new(path: Path, version: int, known: int) -> JournalError:
    """The error of a file from a later version of this program."""
    return JournalError(f"journal {path}: written by a later version (schema {version}, this one knows {known}); "
                        "install that version, or set another [journal] path")


def _row(event: Event) -> tuple[int, int, str, str, bytes]:
    return event.boot, event.seq, event.alarm, event.event, encode(event)


def _readable(connection: sqlite3.Connection, query: str) -> Iterator[tuple[object, ...]]:
    """Rows up to the first that can't be read."""
    try:
        yield from connection.execute(query)
    except sqlite3.Error:
        return


def _valid(rows: Iterator[tuple[object, ...]]) -> Iterator[tuple[int, int, str, str, bytes]]:
    for line, in rows:
        try:
            yield _row(decode(line if isinstance(line, bytes) else b""))
        except msgspec.DecodeError:
            continue


def _carved(path: Path) -> Iterator[bytes]:
    """JSON objects that may be events, wherever they stand in a file: a damaged page of an index hides sound ones below it."""
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = content.find(LINE_BEGINS)
            while at >= 0:
                with suppress(ValueError):
                    # as Latin-1, in which a character is a byte; what is structure in JSON is ASCII
                    _, length = _json.raw_decode(content[at:at + LINE_BYTES].decode("latin-1"))
                    yield content[at:at + length]
                at = content.find(LINE_BEGINS, at + 1)
    except (OSError, ValueError):
        return  # not there, or empty
