"""The gate for commands from above: only what an authorised person signed, for this unit, now, and once (DESIGN §6).

Theory of operation. A command passes when, in this order: it is well-formed; its key is known; the signature holds for this
unit's topic; the order in it is for this unit and this boot; its counter is above every one of this key before; it is still
valid on the unit's own monotonic clock (no synchronised wall clock is needed, and a stolen one helps nobody); the key's role is
enough. Then the counter is on the disk, and only then is the order given out. An order that comes again, byte for byte, gets
the answer it got. Time is an argument; the network is elsewhere.
"""
from __future__ import annotations

import base64
import hashlib
import os
import sqlite3
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec

from bridge import wire
from bridge.keys import Key
from level1.command import Order
from level1.event import seconds
from level1.io.error import OutsideError

VALID_NS = 30_000_000_000
"""Longest time a command may be valid for."""
AHEAD_NS = 2_000_000_000
"""How far level 2's idea of the unit's clock may be ahead."""
ANSWERS = 1000
"""Answers kept for orders that come again."""
SCHEMA = 1


class Passed(msgspec.Struct, frozen=True):
    """Give the order to supervision (its id there is ours, unique); its answer goes to `Gate.remember`.

    id, seq: as level 2 chose them, for the result. key: fingerprint.
    """

    order: Order
    id: str
    seq: int
    key: str


class Refused(msgspec.Struct, frozen=True):
    """Not obeyed. known: the sender has a key of ours, so an answer is owed. key, id, seq: as far as they could be read."""

    reason: str
    known: bool = False
    key: str = ""
    id: str = ""
    seq: int = 0


class Repeated(msgspec.Struct, frozen=True):
    """An order that came again; what was answered, "" while nothing was."""

    id: str
    seq: int
    outcome: str
    reason: str


Decision = Passed | Refused | Repeated


class Gate:
    """Decides on commands for one unit. Raises OutsideError when its file can't be used.

    keys: who may command; may be set anew at any time. now_ns: on the unit's clock. renewed: the file was missing or damaged
    and begun anew; what was issued before that moment is refused, since its counter may have been used.
    """

    def __init__(self, path: Path, fleet: str, unit: str, keys: Mapping[str, Key], now_ns: int):
        self.keys = keys
        self._fleet, self._unit = fleet, unit
        self._path = path
        try:
            self._connection, self.renewed = _opened(path)
            self._not_before = seconds(self._begun_ns(now_ns))
        except (sqlite3.Error, OSError) as error:
            raise OutsideError(f"commands {path}: can't be used ({error}); make {path.parent} a folder that this user may "
                               "write to") from None

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def decide(self, payload: bytes, boot: int, now_ns: int) -> Decision:
        """What to do with a command that came in a boot at a time on the unit's clock."""
        try:
            command = wire.decode(payload, wire.Command)
        except wire.WireError as error:
            return Refused(f"malformed: {error}")
        key = self.keys.get(command.key)
        if key is None:
            return Refused("unknown key", key=command.key)
        if not self._signed(command, key):
            return Refused("wrong signature", key=command.key)
        try:
            order = wire.decode(command.body.encode(), wire.Order)
        except wire.WireError as error:
            return Refused(f"malformed order: {error}", True, key.name)
        digest = hashlib.sha256(command.body.encode()).digest()
        try:
            if (answer := self._answer(key, order, digest)) is not None:
                return Repeated(order.id, order.seq, *answer)
            if reason := self._objection(order, key, boot, now_ns):
                return Refused(reason, True, key.name, order.id, order.seq)
            self._use(key, order, digest)
        except sqlite3.Error as error:
            return Refused(f"the unit's disk does not take the counter ({error})", True, key.name, order.id, order.seq)
        passed = Order(f"{key.fingerprint}-{order.seq}", order.name, order.target, order.value, "above",
                       int(order.expires_t.scaleb(9)), key.name, order.id)
        return Passed(passed, order.id, order.seq, key.fingerprint)

    def remember(self, passed: Passed, outcome: str, reason: str) -> None:
        """Keep the answer to an order, for when it comes again; without a disk for this run of the process only."""
        with suppress(sqlite3.Error):
            self._connection.execute("UPDATE answer SET outcome = ?, reason = ? WHERE key = ? AND seq = ?",
                                     (outcome, reason, passed.key, passed.seq))

    def _begun_ns(self, now_ns: int) -> int:
        """When the file was begun, on the unit's clock; 0 once that clock began anew itself. Raises sqlite3.Error."""
        if self.renewed:
            self._connection.execute("INSERT OR REPLACE INTO begun VALUES (1, ?)", (now_ns,))
        row = self._connection.execute("SELECT t_ns FROM begun").fetchone()
        return row[0] if row and row[0] <= now_ns else 0

    def _signed(self, command: wire.Command, key: Key) -> bool:
        try:
            signature = base64.b64decode(command.signature, validate=True)
            message = wire.signed_bytes(self._fleet, self._unit, command.body)
        except (ValueError, UnicodeEncodeError):
            return False
        return key.verifies(signature, message)

    def _objection(self, order: wire.Order, key: Key, boot: int, now_ns: int) -> str:
        """Why an order by a known key can't be obeyed, "" when it can."""
        if order.unit != self._unit:
            return "for another unit"
        if order.boot != boot:
            return f"for boot {order.boot} of the unit, which is in boot {boot}"
        if order.seq <= self._last(key):
            return "its counter was used before"
        now, longest, ahead = seconds(now_ns), seconds(VALID_NS), seconds(AHEAD_NS)
        if not 0 <= order.t < order.expires_t <= order.t + longest:
            return f"valid for longer than {VALID_NS // 10**9} s"
        if now > order.expires_t:
            return "expired"
        if order.t > now + ahead:
            return "from the future"
        if order.t < self._not_before:
            return "issued before the unit lost its counters"
        return "" if key.may(order.name) else f'the role "{key.role}" may not {order.name}'

    def _last(self, key: Key) -> int:
        row = self._connection.execute("SELECT seq FROM used WHERE key = ?", (key.fingerprint,)).fetchone()
        return row[0] if row else 0

    def _answer(self, key: Key, order: wire.Order, digest: bytes) -> tuple[str, str] | None:
        row = self._connection.execute("SELECT outcome, reason, digest FROM answer WHERE key = ? AND seq = ?",
                                       (key.fingerprint, order.seq)).fetchone()
        return (row[0], row[1]) if row and row[2] == digest else None

    def _use(self, key: Key, order: wire.Order, digest: bytes) -> None:
        """The counter is used, whatever comes of the order; on the disk when this returns. Raises sqlite3.Error."""
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            self._connection.execute("INSERT OR REPLACE INTO used VALUES (?, ?)", (key.fingerprint, order.seq))
            self._connection.execute("INSERT INTO answer (key, seq, digest, outcome, reason) VALUES (?, ?, ?, '', '')",
                                     (key.fingerprint, order.seq, digest))
            self._connection.execute("DELETE FROM answer WHERE number <= (SELECT max(number) FROM answer) - ?", (ANSWERS,))
            self._connection.execute("COMMIT")
        except BaseException:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise


def commands_path(journal: Path) -> Path:
    """Where the gate of a unit keeps its counters: beside the journal."""
    return journal.with_name(journal.name + ".commands")


def _opened(path: Path) -> tuple[sqlite3.Connection, bool]:
    """The gate's file, and whether it had to be begun anew; a damaged one is kept aside. Raises sqlite3.Error, OSError."""
    try:
        missing = not path.exists() or not path.stat().st_size
        return _connect(path), missing
    except sqlite3.DatabaseError as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF not in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise
    os.replace(path, path.with_name(path.name + ".corrupt"))
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return _connect(path), True


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        if connection.execute("PRAGMA quick_check(1)").fetchone()[0] != "ok":
            raise sqlite3.DatabaseError("corrupt")
        if connection.execute("PRAGMA user_version").fetchone()[0] > SCHEMA:
            raise sqlite3.OperationalError("written by a later version")
        connection.execute("CREATE TABLE IF NOT EXISTS used (key TEXT PRIMARY KEY, seq INTEGER)")
        connection.execute("CREATE TABLE IF NOT EXISTS answer (number INTEGER PRIMARY KEY, key TEXT, seq INTEGER, digest BLOB, "
                           "outcome TEXT, reason TEXT, UNIQUE (key, seq))")
        connection.execute("CREATE TABLE IF NOT EXISTS begun (one INTEGER PRIMARY KEY CHECK (one = 1), t_ns INTEGER)")
        connection.execute(f"PRAGMA user_version = {SCHEMA}")
        return connection
    except BaseException:
        connection.close()
        raise
