"""The monitoring history: what the monitoring messages said, in compressed batches in a file of its own beside the journal.

Theory of operation. Of each monitoring message at most four samples a second are kept, as JSON lines. The live loop only gathers
them into pieces (`Gatherer`); the journal's thread compresses a piece when it comes (a millisecond or two, so that no event waits
long behind it) and writes about a minute of them as one row, in one commit (`History`): a card bears that, not a commit a sample.
What is not written yet, at most the last minute, is lost in a power cut.

It is worth less than any event. So it has a file of its own, `journal.db.monitor`: the journal stays small and is checked fast at
the start; damage of the one does not touch the other; and on a full disk all of it can go at once, where SQLite, to delete rows,
would need room itself. Whatever is wrong with that file, it is begun anew, or nothing is kept, and supervision goes on.
"""
from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import msgspec

from level1.event import Monitor, decode_monitor, encode
from level1.io.bootfile import sync_folder
from level1.io.journal_file import (
    APPLICATION_ID,
    JournalError,
    beside,
    identity,
    is_corrupt,
    read_only,
    scalar,
    too_new,
)

PERIOD_S = Decimal("0.25")
"""Samples of one message come no closer."""
BATCH_S = 60
PIECE_BYTES = 1 << 15
"""Of lines, that are handed to the journal's thread at once."""
PIECES = 32
"""Pieces that wait for the thread at most (1 MB); when it hangs, the oldest are lost."""
BATCH_BYTES = 1 << 20
"""A batch, compressed, is written when it has grown so large, though its minute is not over."""
DROP_BATCHES = 50
"""Old batches dropped with one that is written, at most: where the bound was lowered, it is reached little by little."""
SUFFIX = ".monitor"
VERSION = 1
TABLE = """CREATE TABLE batch (number INTEGER PRIMARY KEY, boot INTEGER, since TEXT, until TEXT, samples INTEGER, lines BLOB)"""
"""since, until: earliest and latest UTC label in the batch, NULL where there is none. lines: zlib, of one JSON object a line."""


class Piece(NamedTuple):
    """Some samples, as JSON lines. first, last: their times on the time line, s. since, until: earliest and latest UTC label, ""
    where there is none."""

    first: Decimal
    last: Decimal
    since: str
    until: str
    samples: int
    lines: bytes


class Gatherer:
    """Gathers samples in the live loop's thread."""

    def __init__(self) -> None:
        self._due: dict[str, Decimal] = {}
        self._ends: Decimal | None = None
        self._since = self._until = ""
        self._begin()

    def add(self, monitors: Iterable[Monitor]) -> Piece | None:
        """Take samples. Gives what has gathered when that is a piece, or when the minute is over."""
        for monitor in monitors:
            t = monitor.t
            due = self._due.get(monitor.message)
            if due is not None and t < due:
                continue
            self._due[monitor.message] = t + PERIOD_S
            self._lines += encode(monitor)
            self._lines += b"\n"
            if not self._samples:
                self._first = t
            self._samples += 1
            self._last = t
            if monitor.utc is not None:
                self._since = min(self._since, monitor.utc) if self._since else monitor.utc
                self._until = max(self._until, monitor.utc)
            if self._ends is None:
                self._ends = t + BATCH_S
        if self._ends is not None and self._samples and self._last >= self._ends:
            self._ends = None
            return self.rest()
        return self.rest() if len(self._lines) >= PIECE_BYTES else None

    def rest(self) -> Piece | None:
        """What has gathered, None when that is nothing."""
        if not self._samples:
            return None
        piece = Piece(self._first, self._last, self._since, self._until, self._samples, bytes(self._lines))
        self._begin()
        return piece

    def _begin(self) -> None:
        self._lines = bytearray()
        self._samples = 0
        self._first = self._last = Decimal(0)
        self._since = self._until = ""


class History:
    """Packs pieces into batches and keeps them; for the journal's thread. Raises nothing.

    path: of the journal. keep_bytes: its bound; 0: none is kept, and what there is goes. may_write: asked before each batch.
    lost: samples that were not kept. incidents: takes what befell the file.
    """

    def __init__(self, path: Path, keep_bytes: int, may_write: Callable[[], bool], incidents: list[str]):
        self.path = beside(path, SUFFIX)
        self.lost = 0
        self._keep_bytes, self._may_write, self._incidents = keep_bytes, may_write, incidents
        self._connection: sqlite3.Connection | None = None
        self._identity: tuple[int, int] | None = None
        self._packed = _Packed()
        self._told = ""
        if not keep_bytes:
            self.remove()

    def take(self, pieces: Iterable[Piece], boot: int) -> None:
        """Pack pieces, and write a batch when there is one."""
        for piece in pieces:
            self._packed.add(piece)
            if self._packed.last - self._packed.first >= BATCH_S or self._packed.size >= BATCH_BYTES:
                self.write(boot)

    def write(self, boot: int) -> None:
        """Write what is packed as a batch, or lose it where it may not be written."""
        packed, self._packed = self._packed, _Packed()
        if not packed.samples:
            return
        if not self._may_write():  # whose fault tells it
            self.lost += packed.samples
            return
        trouble = self._attempt(packed, boot)
        if trouble:
            self.lost += packed.samples
            self.close()
            if trouble != self._told:
                self._incidents.append(f"monitoring history {self.path}: not kept ({trouble})")
        self._told = trouble

    def remove(self) -> bool:
        """Give up all that is kept, for room or for a new beginning. False when there was nothing."""
        self.close()
        there = self.path.exists()
        with suppress(OSError):
            for file in (self.path, beside(self.path, "-wal"), beside(self.path, "-shm")):
                file.unlink(missing_ok=True)
        return there and not self.path.exists()

    def close(self) -> None:
        """Close the file; what is packed and not written stays in memory."""
        if self._connection is not None:
            with suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None

    def _attempt(self, packed: _Packed, boot: int) -> str:
        """Write a batch, into a new file where the old one is damaged. Gives what stood in the way, "" for success."""
        try:
            try:
                self._insert(packed, boot)
            except sqlite3.DatabaseError as error:
                if not is_corrupt(error) or not self.remove():
                    raise
                self._incidents.append(f"monitoring history {self.path} was corrupt: begun anew")
                self._insert(packed, boot)
            return ""
        except Exception as error:  # a thread that ended would take the journal with it
            return str(error) or type(error).__name__

    def _insert(self, packed: _Packed, boot: int) -> None:
        connection = self._open()
        connection.execute("BEGIN IMMEDIATE")
        try:
            connection.execute("INSERT INTO batch (boot, since, until, samples, lines) VALUES (?, ?, ?, ?, ?)",
                               (boot, packed.since or None, packed.until or None, packed.samples, packed.finish()))
            for _ in range(DROP_BATCHES):
                pages, free = (scalar(connection, f"PRAGMA {name}") for name in ("page_count", "freelist_count"))
                if (pages - free) * scalar(connection, "PRAGMA page_size") <= self._keep_bytes:
                    break
                connection.execute("DELETE FROM batch WHERE number = (SELECT min(number) FROM batch)")
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise

    def _open(self) -> sqlite3.Connection:
        if self._connection is not None and identity(self.path) == self._identity:
            return self._connection
        self.close()  # SQLite would write on into a deleted file without a word
        connection = self._connection = sqlite3.connect(self.path, timeout=0.1, isolation_level=None, check_same_thread=False)
        version = scalar(connection, "PRAGMA user_version")
        if version > VERSION:
            raise too_new(self.path, version, VERSION)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        if version == 0:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(TABLE)
            connection.execute(f"PRAGMA user_version = {VERSION}")
            connection.execute("COMMIT")
            sync_folder(self.path.parent)
        self._identity = identity(self.path)
        return connection


class _Packed:
    """Pieces, compressed one after the other. Fields as in `Piece`; size: bytes so far."""

    def __init__(self) -> None:
        self.first = self.last = Decimal(0)
        self.since = self.until = ""
        self.samples = self.size = 0
        self._deflate = zlib.compressobj()
        self._chunks: list[bytes] = []
        self._finished = b""

    def add(self, piece: Piece) -> None:
        """Compress a piece."""
        if not self.samples:
            self.first = piece.first
        self.last = piece.last
        if piece.since:
            self.since = min(self.since, piece.since) if self.since else piece.since
            self.until = max(self.until, piece.until)
        self.samples += piece.samples
        self._chunks.append(self._deflate.compress(piece.lines))
        self.size += len(self._chunks[-1])

    def finish(self) -> bytes:
        """All of it; nothing can be added any more."""
        if not self._finished:
            self._finished = b"".join((*self._chunks, self._deflate.flush()))
        return self._finished


class HistoryReader:
    """Reads the monitoring history of a journal; a context manager. path: of the journal. Raises JournalError.

    unreadable: batches that were damaged; they are left out.
    """

    def __init__(self, path: Path):
        self.path = beside(Path(path), SUFFIX)
        self.unreadable = 0
        if not self.path.is_file():
            raise JournalError(f"{self.path}: no such file; `ucs run` writes it a minute after it was started, "
                               "where [journal] monitor_mb is not 0")
        try:
            self._connection = read_only(self.path)
            version = scalar(self._connection, "PRAGMA user_version")
        except sqlite3.Error as error:
            raise self._damaged(error) from None
        if version > VERSION:
            self._connection.close()
            raise too_new(self.path, version, VERSION)

    def __enter__(self) -> HistoryReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def batches(self, boot: int | None = None, since: datetime | None = None, until: datetime | None = None) -> list[int]:
        """Numbers of the batches, oldest first, that may hold samples of a boot, from a time on, before a time (by UTC label)."""
        where = [("boot = ?", boot), ("until >= ?", since and _label(since)), ("since < ?", until and _label(until))]
        asked = [(text, value) for text, value in where if value is not None]
        query = "SELECT number FROM batch" + " WHERE " * bool(asked) + " AND ".join(text for text, _ in asked) + " ORDER BY number"
        try:
            return [number for number, in self._connection.execute(query, [value for _, value in asked])]
        except sqlite3.Error as error:
            raise self._damaged(error) from None

    def samples(self, number: int, message: str | None = None) -> Sequence[Monitor]:
        """The samples of a batch, in order; only of a message. Of one that was dropped meanwhile, or is damaged, there are none."""
        try:
            row = self._connection.execute("SELECT lines FROM batch WHERE number = ?", (number,)).fetchone()
            lines = zlib.decompress(row[0]).splitlines() if row is not None else []
            wanted = None if message is None else b'"message":' + msgspec.json.encode(message)
            return [decode_monitor(line) for line in lines if wanted is None or wanted in line]
        except (sqlite3.Error, zlib.error, msgspec.DecodeError, TypeError):
            self.unreadable += 1
            return []

    def _damaged(self, error: Exception) -> JournalError:
        return JournalError(f"{self.path}: can't be read ({error}); `ucs run` begins a damaged one anew")


def _label(moment: datetime) -> str:
    """A moment as UTC labels are written, which sort like the moments."""
    return moment.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
