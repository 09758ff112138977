"""The traffic recorder: everything on all buses into BLF files, of bounded size, never in the way of supervision.

Theory of operation. The loop only puts batches into a bounded queue. A thread of its own empties it twice a second, a few
frames at a time with a nap between, so that the interpreter is never busy with it for long. Files are numbered; a full one
is followed by the next, and the oldest goes when all together would exceed the bound, or when the disk has no more than
`RESERVE_BYTES` left: alarms need that space, recordings don't. Whatever goes wrong is told (`fault`), the damaged end of
the file is cut off, and a new file is tried every `RETRY_NS`, or at once when the
repair of TrafficLogFailed asks for it (`reopen`).

A power cut loses what the last container holds, a few seconds; the file is readable up to there.
"""
from __future__ import annotations

import errno
import os
import re
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

import can

from level1.event import Send
from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Row
from level1.io.message import CLASSIC_BYTES

QUEUE_FRAMES = 20_000
"""Frames that wait at most: two seconds of a full 1 Mbit/s bus."""
RESERVE_BYTES = 64 << 20
"""Space that stays free on the disk."""
CONTAINER_BYTES = 32 << 10
"""Frames are compressed in portions of this size: about 700 frames."""
SMALLEST_FILE, LARGEST_FILE = 1 << 20, 64 << 20
FILES = 8
"""Files among which the bound is shared out."""
ROUND_S = 0.5
PORTION = 50
"""Frames written between two naps: half a millisecond of computing."""
NAP_S = 0.001
RETRY_NS = 5_000_000_000
TOLD_NS = 5_000_000_000
"""For how long dropped frames count as a fault: longer than the on-delay of its alarm."""
STOP_S = 5.0
_NAME = re.compile(r"traffic-(\d{6,})\.blf")


class Recorder:
    """Records the traffic of all buses in a folder.

    max_bytes: of all its files together. clock, wall: monotonic and wall clock, ns. notice: called with a line when recording
    fails or works again. dropped: frames not recorded so far. reserve_bytes, queue_frames: see above.
    """

    def __init__(self, folder: Path, max_bytes: int, *, clock: Callable[[], int], wall: Callable[[], int],
                 notice: Callable[[str], None], reserve_bytes: int = RESERVE_BYTES, queue_frames: int = QUEUE_FRAMES):
        self.folder = folder
        self.dropped = 0
        self._max_bytes, self._reserve_bytes, self._queue_frames = max_bytes, reserve_bytes, queue_frames
        self._file_bytes = min(max(max_bytes // FILES, SMALLEST_FILE), LARGEST_FILE)
        self._clock, self._wall, self._notice = clock, wall, notice
        self._queue: deque[Row | Send] = deque()
        self._fault: str | None = None
        self._dropped_ns: int | None = None
        self._retry_ns = clock()
        self._file: _File | None = None
        self._busy = False
        self._lock = threading.Lock()
        self._filled, self._stopping, self._renewed = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="traffic recorder", daemon=True)

    @property
    def fault(self) -> str | None:
        """Why traffic is not recorded, or was not a moment ago; None while it is."""
        if self._fault is None and self._dropped_ns is not None and self._clock() - self._dropped_ns < TOLD_NS:
            return f"{self.folder}: {self.dropped} frames not recorded: they come faster than they can be written"
        return self._fault

    def start(self) -> None:
        """Begin; a folder that can't be written is a fault, no reason not to supervise."""
        try:
            self._prepare()
        except OSError as error:
            self._fail(error)
        self._thread.start()

    def stop(self) -> None:
        """Write what waits and close the file, unless the disk hangs."""
        self._stopping.set()
        self._filled.set()
        if self._thread.ident is not None:
            self._thread.join(STOP_S)

    def reopen(self) -> None:
        """Close the file and begin a new one with the next frame, without waiting for the time of the next try."""
        self._renewed.set()
        self._filled.set()

    def record(self, frames: Sequence[Row] | Sequence[Send]) -> None:
        """Record frames received (rows) or sent (`Send`). Never waits for the disk."""
        with self._lock:
            room = self._queue_frames - len(self._queue)
            self._queue.extend(frames if len(frames) <= room else islice(frames, room))
            if len(frames) > room:
                self.dropped += len(frames) - room
                self._dropped_ns = self._clock()
        if frames and not self._filled.is_set():
            self._filled.set()

    # --- the recorder's thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._filled.wait()
            self._stopping.wait(ROUND_S)
            self._filled.clear()
            self._round()
        self._round()
        if self._file is not None:
            with suppress(OSError):
                self._file.close()

    def _round(self) -> None:
        """Write what waits, if the disk lets it; else drop it and say so."""
        now_ns = self._clock()
        renewed = self._renewed.is_set()
        if self._fault is not None and now_ns < self._retry_ns and not renewed:
            self._forget(self._waiting())
            return
        portion: deque[Row | Send] = deque()
        self._busy = True
        try:
            if renewed:
                self._renewed.clear()
                self._begin_anew()
            self._leave_what_is_not_in_place()
            self._make_room()
            while portion := self._portion():
                self._write(portion)
                if not self._stopping.is_set():
                    self._stopping.wait(NAP_S)
            if self._file is not None:
                self._file.flush()
        except Exception as error:  # a thread that ended would record nothing for ever
            self._fail(error)
            self._forget(len(portion) + self._waiting())
            return
        finally:
            self._busy = False
        if self._fault is not None and self._file is not None:
            self._fault = None
            self._dropped_ns = None  # what was dropped meanwhile was told as this fault
            self._notice(f"traffic recorder {self.folder}: works again")

    def _begin_anew(self) -> None:
        """Close the file; the next frame begins another. Raises OSError when the disk does not take the end of this one."""
        if self._file is not None:
            self._file.close()
            self._file = None
        self._notice(f"traffic recorder {self.folder}: begins a new file")

    def _portion(self) -> deque[Row | Send]:
        with self._lock:
            return deque(self._queue.popleft() for _ in range(min(PORTION, len(self._queue))))

    def _waiting(self) -> int:
        with self._lock:
            count = len(self._queue)
            self._queue.clear()
        return count

    def _forget(self, count: int) -> None:
        if count:
            with self._lock:
                self.dropped += count
            self._dropped_ns = self._clock()

    def _write(self, portion: deque[Row | Send]) -> None:
        """Write and take out one after the other: what is left then was not written."""
        while portion:
            item = portion[0]
            if self._file is not None and self._file.size > self._file_bytes - 2 * CONTAINER_BYTES:
                self._file.close()
                self._file = None
            if self._file is None:
                self._prepare()
                self._make_room()
                self._file = _File(self._next_path(), self._wall() - self._clock(), item)
            else:
                self._file.add(item)
            portion.popleft()

    def _leave_what_is_not_in_place(self) -> None:
        """Finish the file if someone has moved it; what was deleted, or is on a card that was pulled, is lost."""
        file = self._file
        if file is not None and not file.in_place:
            self._file = None
            self._forget(file.leave())

    def _fail(self, error: Exception) -> None:
        text = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or type(error).__name__
        if self._file is not None:
            self._forget(self._file.abandon())
            self._file = None
        if self._fault is None:
            self._notice(f"traffic recorder {self.folder}: not recorded ({text}); trying again")
        self._fault = f"{self.folder}: {text}"
        self._retry_ns = self._clock() + RETRY_NS

    # --- files --------------------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Make the folder. Raises OSError when it can't be written."""
        self.folder.mkdir(exist_ok=True)
        if not os.access(self.folder, os.W_OK):
            raise PermissionError(errno.EACCES, "the folder can't be written")

    def _files(self) -> list[Path]:
        """Its files, the oldest first."""
        numbered = [(int(match[1]), path) for path in self.folder.iterdir() if (match := _NAME.fullmatch(path.name))]
        return [path for _, path in sorted(numbered)]

    def _next_path(self) -> Path:
        files = self._files()
        number = int(files[-1].stem.removeprefix("traffic-")) + 1 if files else 1
        return self.folder / f"traffic-{number:06d}.blf"

    def _make_room(self) -> None:
        """Delete the oldest files beyond the bound. Raises OSError when the disk is full of something else."""
        if not self.folder.is_dir():
            return
        current = self._file.path if self._file is not None else None
        old = [path for path in self._files() if path != current]
        total = self._file_bytes + sum(path.stat().st_size for path in old)
        while old and (total > self._max_bytes or self._free_bytes() < self._reserve_bytes):
            total -= old[0].stat().st_size
            old.pop(0).unlink()
        if self._free_bytes() < self._reserve_bytes:
            raise OSError(errno.ENOSPC, "the disk is full but for the space kept for alarms")

    def _free_bytes(self) -> int:
        state = os.statvfs(self.folder)
        return state.f_bavail * state.f_frsize


class _File:
    """One file. offset_ns: UTC minus the time line; it holds for the whole file, so that a jump of the clock leaves no gap.

    The file is closed once after its first frame, so that its head tells the time even after a power cut.
    """

    def __init__(self, path: Path, offset_ns: int, first: Row | Send):
        self.path = path
        self._offset_ns = offset_ns
        try:
            with can.BLFWriter(path) as writer:
                writer.on_message_received(self._message(first))
            self._writer = can.BLFWriter(path, append=True, max_container_size=CONTAINER_BYTES)
            self._good = self._end = path.stat().st_size
            self._added = self._kept = 1
            self._pending = 0
        except BaseException:
            with suppress(OSError):
                path.unlink()
            raise

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._writer.file_size()

    @property
    def in_place(self) -> bool:
        """Whether the file still stands where it was made: someone may have moved the folder or pulled the card."""
        try:
            return os.path.samestat(os.fstat(self._writer.file.fileno()), os.stat(self.path))
        except OSError:
            return False

    def add(self, item: Row | Send) -> None:
        """Write a frame."""
        self._writer.on_message_received(self._message(item))
        self._added += 1
        self._pending += 1
        if self._writer.file.tell() != self._end:  # a container is full; a frame that it cuts is not whole in it
            self._end = self._writer.file.tell()
            self._pending = int(self._writer.file_size() > self._end)

    def flush(self) -> None:
        """Hand finished containers to the system. Raises OSError when the disk does not take them."""
        self._writer.file.flush()
        self._good = self._writer.file.tell()
        self._kept = self._added - self._pending

    def close(self) -> None:
        """Finish the file."""
        self._writer.stop()

    def leave(self) -> int:
        """Finish the file wherever it is now; gives the frames that are lost."""
        try:
            is_deleted = os.fstat(self._writer.file.fileno()).st_nlink == 0
            self._writer.stop()
        except (OSError, ValueError):
            return self.abandon()
        return self._added if is_deleted else 0

    def abandon(self) -> int:
        """Give up, and cut off what may be half written; gives the frames that are lost."""
        with suppress(Exception):
            self._writer.file.close()
        with suppress(OSError):
            os.truncate(self.path, self._good)
        return self._added - self._kept

    def _message(self, item: Row | Send) -> can.Message:
        t_ns, key, data = (item.t_ns, item.key, item.data) if isinstance(item, Send) else item
        can_id = key & (0x1FFF_FFFF if key & EXTENDED else 0x1FFF_FFFF if key & ERROR else 0x7FF)
        is_remote = bool(key & REMOTE)
        return can.Message(timestamp=(t_ns + self._offset_ns) / 1e9, arbitration_id=can_id,
                           is_extended_id=bool(key & EXTENDED), is_remote_frame=is_remote,
                           is_error_frame=bool(key & ERROR), channel=(key >> BUS_SHIFT) & 0xFF, dlc=len(data),
                           data=None if is_remote else data,
                           is_fd=len(data) > CLASSIC_BYTES, is_rx=not isinstance(item, Send))
