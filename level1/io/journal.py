"""The journal: every event on the disk before anything else happens with it (DESIGN §6).

SQLite in WAL mode with `synchronous=FULL`: a commit survives the power cut right after it. One connection writes, owned
by one thread; readers have read-only connections of their own and disturb nobody.

The thread is there for slow disks: `append` waits for the commit as long as `patience_ns`, then supervision goes on and
the events wait in memory. The same holds for a full, read-only or broken disk, also one that was so before the opening: `fault`
says so, the thread tries again, and what waited is written in order as soon as it can be. Nothing here raises for disk trouble.

Beside `journal.db` stand `journal.db.boot` (the boot id, in case the journal is lost), `journal.db.ballast` (space for
alarms on a full disk), `journal.db.lock` (one writer) and `journal.db.monitor` (the monitoring history, see `journal_monitor`).
"""
from __future__ import annotations

import fcntl
import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import IO

from level1.event import Commanded, Event, Monitor
from level1.io.ballast import Ballast
from level1.io.bootfile import BootFile
from level1.io.journal_file import (
    FIRST,
    DiskError,
    JournalError,
    JournalFile,
    Position,
    beside,
    cannot_write,
    code,
    is_corrupt,
    is_full,
    set_aside,
)
from level1.io.journal_monitor import PIECES, Gatherer, History, Piece
from level1.io.journal_reader import Reader, read_events

__all__ = ["FIRST", "Journal", "JournalError", "Position", "Reader", "read_events"]

QUEUE_EVENTS = 10_000
"""Events that wait in memory at most (about 10 MB); beyond it the oldest are lost and counted."""
QUEUE_COMMANDS = 1_000
"""Commands that wait in memory at most."""
KEEP_BYTES = 256 << 20
"""Size from which `prune` drops events: a few hundred thousand."""
PATIENCE_NS = 250_000_000
"""How long `append` waits for the disk: well within the 1 s in which a gas valve has to close (DESIGN §5)."""
RETRY_S = 1.0
"""Pause before another try while something is wrong; each `append` is a try too."""
DROP_EVENTS = 500
"""Events dropped in one transaction."""


Commands = Sequence[tuple[int, Commanded]]
"""Commands, each with its number within the boot."""


class Journal:
    """The writer's side; a context manager. Opening raises JournalError when `path` can't be written, unless its disk is at fault.

    boot: id of this opening; higher than every earlier one, on the disk before it is given, never given again. A disk that takes
    nothing can't keep it; there the wall clock does (`least_boot`), and only where that has no time either may an id come twice,
    which level 2 tells.
    least_boot: the boot id is this at least, the seconds of a wall clock: with an exchanged card, or one that takes nothing, an old
    unit would begin at 1 again.
    monitor_bytes: bound of the monitoring history, 0: none is kept.
    """

    def __init__(self, path: Path, unit: str, *, least_boot: int = 1, queue_events: int = QUEUE_EVENTS,
                 keep_bytes: int = KEEP_BYTES, patience_ns: int = PATIENCE_NS, monitor_bytes: int = 0):
        self.path = Path(path).absolute()
        if os.path.isdir(self.path):
            raise cannot_write(self.path, IsADirectoryError(0, "it is a folder"))
        self.unit = unit
        self._queue_events, self._keep_bytes, self._patience_ns = queue_events, keep_bytes, patience_ns
        self._queue: deque[Event] = deque()
        self._commands: deque[tuple[int, Commanded]] = deque(maxlen=QUEUE_COMMANDS)
        self._numbers = count(1)
        self._state: bytes | None = None
        self._incidents: list[str] = []
        self._delivered: Mapping[int, int] | None = None
        self._asked = self._tried = self._done = self._lost = 0
        self._trouble = ""
        self._slow = self._closing = False
        self._changed = threading.Condition()
        self._ballast = Ballast(beside(self.path, ".ballast"))
        self._boot_file = BootFile(beside(self.path, ".boot"))
        self._gatherer = Gatherer() if monitor_bytes else None
        self._pieces: deque[Piece] = deque(maxlen=PIECES)
        self._unpacked = 0
        self._history = History(self.path, monitor_bytes, self._has_room, self._incidents)
        self._restored: bytes | None = None
        self._lock: IO[str] | None = None
        self._file: JournalFile | None = None
        try:
            self._lock = _locked(self.path)
            self._file, self.boot = self._open(least_boot)
        except DiskError as error:
            self._trouble = f"can't be written ({error.reason})"
            self.boot = self._remembered(least_boot)
        except BaseException:
            self._unlock()
            raise
        self._ballast.take()
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
        self._thread.start()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def append(self, events: Sequence[Event], state: bytes, commands: Sequence[Commanded] = ()) -> bool:
        """Write events, commands and the supervisor's state after them in one transaction.

        True: all of it, and all that waited before, is on the disk. False: it waits in memory, and `fault` says why.
        """
        with self._changed:
            self._queue.extend(events)
            self._commands.extend((next(self._numbers), command) for command in commands)
            self._state = state
            while len(self._queue) > self._queue_events:
                self._queue.popleft()
                self._lost += 1
            self._asked += 1
            ticket = self._asked
            self._changed.notify_all()
            patience_s = 0 if self._slow else self._patience_ns / 1e9
            if not self._changed.wait_for(lambda: self._tried >= ticket, patience_s):
                self._slow = True
            return self._done >= ticket

    def record(self, monitors: Sequence[Monitor]) -> None:
        """Keep monitoring messages for the history: about a minute of them in memory, then on the disk. Waits for nothing."""
        piece = self._gatherer.add(monitors) if self._gatherer is not None else None
        if piece is not None:
            with self._changed:
                if len(self._pieces) == PIECES:
                    self._unpacked += self._pieces[0].samples
                self._pieces.append(piece)
                self._changed.notify_all()

    @property
    def unrecorded(self) -> int:
        """Monitoring messages that are not in the history, for want of room or through damage."""
        return self._unpacked + self._history.lost

    @property
    def fault(self) -> str | None:
        """Why events wait in memory or may soon have to; None while the journal works. Worth an alarm."""
        with self._changed:
            trouble = self._trouble or ("the disk is slow" if self._slow else "")
            if not trouble and not self._ballast.held:
                trouble = "the disk is full but for the reserve for alarms, which is in use; delete files on that disk" \
                    if self.path.exists() else "its file is gone; put its disk back"
            if not trouble:
                return None
            waiting = f"; {len(self._queue)} events wait in memory" if self._queue else ""
            lost = f", {self._lost} are lost" if self._lost else ""
            return f"journal {self.path}: {trouble}{waiting}{lost}"

    @property
    def incidents(self) -> tuple[str, ...]:
        """What befell the file, oldest first: corrupt and set aside, gone, events dropped. Worth an alarm each."""
        return tuple(self._incidents)

    @property
    def pending(self) -> tuple[Event, ...]:
        """Events that wait in memory, oldest first: not on the disk, so the radio is all they have."""
        with self._changed:
            return tuple(self._queue)

    @property
    def lost(self) -> int:
        """Events dropped from memory because too many waited."""
        return self._lost

    def restored_state(self) -> bytes | None:
        """The state as last written before this opening, None where there is none."""
        return self._restored

    @property
    def state_lost(self) -> bool:
        """Whether there was a journal or its boot file, or may have been on a disk that gives nothing, and there is no state of it:
        what was ordered before is not known."""
        return self._restored is None and self._had_earlier

    @property
    def waits(self) -> bool:
        """Whether its disk has not let it begin yet: everything is in memory."""
        return self._file is None

    def prune(self, delivered: Mapping[int, int]) -> None:
        """Let the journal shrink to its bound, later, in its own thread: delivered events go first, oldest first.

        delivered: boot -> seq up to which level 2 acknowledged everything. An undelivered event is dropped only when no
        delivered one is left, and that is an incident.
        """
        with self._changed:
            self._delivered = dict(delivered)
            self._changed.notify_all()

    def close(self, timeout_s: float = 10.0) -> None:
        """Write what waits, if the disk lets it within the time, and close the file."""
        rest = self._gatherer.rest() if self._gatherer is not None else None
        with self._changed:
            if rest is not None:
                self._pieces.append(rest)
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()

    def _open(self, least_boot: int) -> tuple[JournalFile, int]:
        try:
            previous = self._boot_file.read()
            existed = self.path.exists() and self.path.stat().st_size > 0
            file = self._connect(previous + 1)
            boot = max(previous + 1, file.last_boot() + 1, least_boot)
            self._boot_file.write(boot)
        except (sqlite3.Error, OSError) as error:
            if is_full(self.path, error) and (self._give_up_history() or self._ballast.release()):
                return self._open(least_boot)
            raise cannot_write(self.path, error) from None
        if previous and not existed:
            self._incidents.append(f"journal {self.path} was gone: the events of boots up to {previous} are not in it")
        self._restored, self._had_earlier = file.state(), existed or previous > 0
        self._begin_boot(file, boot)
        return file, boot

    def _remembered(self, least_boot: int) -> int:
        """What can be read of a disk that takes nothing; gives the boot id. Nobody knows whether there was more."""
        boots, self._had_earlier = [least_boot - 1], True
        with suppress(OSError):
            boots.append(self._boot_file.read())
        with suppress(JournalError), Reader(self.path) as reader:
            boots += reader.boots()
            self._restored = reader.state()
        return max(boots) + 1

    def _connect(self, boot: int) -> JournalFile:
        """The file; a corrupt one is set aside first, named after the boot. Raises sqlite3.Error, OSError."""
        try:
            return JournalFile(self.path, self.unit)
        except sqlite3.DatabaseError as error:
            if is_full(self.path, error) and (self._give_up_history() or self._ballast.release()):
                return self._connect(boot)
            if not is_corrupt(error):
                raise
        kept = set_aside(self.path, boot)
        file = JournalFile(self.path, self.unit)
        saved = file.salvage(kept)
        self._incidents.append(f"journal {self.path} was corrupt: kept as {kept.name}, {saved} events saved from it")
        return file

    def _begin_boot(self, file: JournalFile, boot: int) -> None:
        """Try that the file can be written."""
        try:
            file.commit(boot, (), None)
        except sqlite3.Error as error:
            if code(error) != sqlite3.SQLITE_FULL:
                file.close()
                raise cannot_write(self.path, error) from None
            self._trouble = str(error)

    # The thread that writes

    def _write(self) -> None:
        while True:
            with self._changed:
                works = not self._trouble and not self._slow
                called = self._changed.wait_for(self._has_work, None if works and self._ballast.held else RETRY_S)
                if works and not called:
                    self._take_ballast()
                    continue
                closing, ticket, idle = self._closing, self._asked, works and not self._has_orders()
                pieces = tuple(self._pieces)
                self._pieces.clear()
                batch, state, commands = tuple(self._queue), self._state, tuple(self._commands)
                delivered, self._delivered = self._delivered, None
            if not idle:
                self._write_events(ticket, batch, state, commands, delivered)
            self._history.take(pieces, self.boot)
            if closing:
                self._history.write(self.boot)
                self._history.close()
                if self._file is not None:
                    self._file.close()
                return

    def _write_events(self, ticket: int, batch: Sequence[Event], state: bytes | None, commands: Commands,
                      delivered: Mapping[int, int] | None) -> None:
        start_ns = time.monotonic_ns()
        trouble = self._attempt(batch, state, commands)
        slow = time.monotonic_ns() - start_ns > self._patience_ns
        with self._changed:
            self._settle(ticket, batch, trouble, slow)
            if not trouble:
                self._forget(commands)
        if delivered is not None and not trouble:
            self._drop(delivered)

    def _has_room(self) -> bool:
        """Whether the monitoring history may be written: never while events can't be, nor near the reserve of a full disk."""
        return not self._trouble and self._ballast.held and self._ballast.roomy

    def _give_up_history(self) -> bool:
        """Give the room of the monitoring history to events. False when there was none."""
        given = self._history.remove()
        if given:
            self._incidents.append(f"monitoring history of {self.path} dropped: the disk is full")
        return given

    def _take_ballast(self) -> None:
        if not self._ballast.held and self._ballast.take() and self._file is not None:
            with suppress(sqlite3.Error):
                self._file.save_space(False)

    def _has_work(self) -> bool:
        return self._has_orders() or bool(self._pieces)

    def _has_orders(self) -> bool:
        return self._closing or self._asked > self._tried or self._delivered is not None

    def _settle(self, ticket: int, batch: Sequence[Event], trouble: str, slow: bool) -> None:
        self._trouble, self._slow, self._tried = trouble, slow, ticket
        if not trouble:
            self._done = ticket
            last = (batch[-1].boot, batch[-1].seq) if batch else FIRST
            while self._queue and (self._queue[0].boot, self._queue[0].seq) <= last:
                self._queue.popleft()
        self._changed.notify_all()

    def _forget(self, commands: Commands) -> None:
        """These are on the disk."""
        while self._commands and commands and self._commands[0][0] <= commands[-1][0]:
            self._commands.popleft()

    def _attempt(self, batch: Sequence[Event], state: bytes | None, commands: Commands) -> str:
        """Bring everything on the disk. Gives what stood in the way, "" for success."""
        try:
            self._commit(batch, state, commands)
            self._take_ballast()
            return ""
        except sqlite3.Error as error:
            return f"can't be written ({error})"
        except OSError as error:
            return f"can't be written ({error.strerror or error})"
        except DiskError as error:
            return f"can't be written ({error.reason})"
        except JournalError as error:
            return str(error)
        except Exception as error:  # a thread that ended would take the journal with it
            return f"can't be written ({type(error).__name__}: {error})"

    def _commit(self, batch: Sequence[Event], state: bytes | None, commands: Commands) -> None:
        """Write, with what helps against a file that vanished or is corrupt and against a full disk."""
        file = self._file
        if file is None or not file.in_place:
            file = self._replace(file)
        try:
            file.commit(self.boot, batch, state, commands)
        except sqlite3.Error as error:
            if is_corrupt(error):
                file.close()
                self._file = file = self._connect(self.boot)
                file.commit(self.boot, batch, state, commands)
            elif code(error) == sqlite3.SQLITE_FULL:
                self._commit_on_full_disk(file, batch, state, commands)
            else:
                raise

    def _commit_on_full_disk(self, file: JournalFile, batch: Sequence[Event], state: bytes | None, commands: Commands) -> None:
        file.reuse_log()
        while True:
            try:
                return file.commit(self.boot, batch, state, commands)
            except sqlite3.Error as error:
                if code(error) != sqlite3.SQLITE_FULL:
                    raise
                if not self._give_up_history():
                    if not self._ballast.release():
                        raise
                    file.save_space(True)
                file.reuse_log()

    def _replace(self, file: JournalFile | None) -> JournalFile:
        """The file anew, after it was taken away, or for the first time, where the disk took nothing until now."""
        gone = file is not None and not self.path.exists()
        if file is not None:
            file.close()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = self._lock or _locked(self.path)
        self._boot_file.write(self.boot)
        found = self._connect(self.boot)
        if file is None and found.last_boot() >= self.boot:
            found.close()
            raise JournalError("holds a boot that is no earlier than this one; restart `ucs run`")
        self._file = found
        if gone:
            self._incidents.append(f"journal {self.path} was taken away while in use: a new one is begun")
        return found

    def _drop(self, delivered: Mapping[int, int]) -> None:
        """Down to the bound: delivered events first, as the last resort the oldest of all."""
        try:
            for boot, seq in sorted(delivered.items()):
                self._drop_while_too_big(boot, seq)
            dropped = self._drop_while_too_big(self.boot, None)
        except (sqlite3.Error, OSError):
            return  # the next commit meets the same trouble and reports it
        if dropped:
            self._incidents.append(f"journal {self.path} is too big: {dropped} events dropped that level 2 never got")

    def _drop_while_too_big(self, boot: int, seq: int | None) -> int:
        file, dropped = self._file, 0
        while file is not None and file.size() > self._keep_bytes and (count := file.delete_oldest(boot, seq, DROP_EVENTS)):
            dropped += count
        return dropped


def _locked(path: Path) -> IO[str]:
    """The lock that only one writer holds; it goes with the process. Raises JournalError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(beside(path, ".lock"), "a+")
    except OSError as error:
        raise cannot_write(path, error) from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        owner = file.read().strip()
        file.close()
        raise JournalError(f"journal {path}: in use by process {owner or 'unknown'}; "
                           "stop that `ucs run`, or set another [journal] path") from None
    with suppress(OSError):  # who holds it is a word for people; a full disk has no room for it
        os.ftruncate(file.fileno(), 0)
        os.write(file.fileno(), str(os.getpid()).encode())
    return file
