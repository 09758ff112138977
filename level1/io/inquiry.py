"""How another process asks a running one how it is: connect to a socket beside the journal, read one answer to its end.

Nothing is written to the disk for it, so a full disk and a worn card don't matter, and whoever asks can't hold anything up:
the desk is a thread of its own, serves one at a time, and waits for nobody longer than `PATIENCE_S`. Nothing that is sent to it
is read. Whoever may enter the journal's folder may ask.
"""
from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from pathlib import Path

from level1.io import local_socket

PATIENCE_S = 1.0
RETRY_S = 1.0
PAUSE_S = 0.02
"""After each answer: nobody gets more than fifty a second out of it."""
CHUNK = 1 << 16
MOST_BYTES = 8 << 20
"""An answer longer than this is none."""


class Silence(Enum):
    """Why there is no answer."""

    ABSENT = "is not running"
    DENIED = "can't be asked by this user"
    MUTE = "runs but does not answer"
    CUT_OFF = "can't be asked if it runs: the disk of its journal is read-only"


class Desk:
    """Answers whoever asks; a context manager. who: `run` or `bridge`. A folder that can't be written is tried again.

    answer: called in the desk's thread for every question.
    """

    def __init__(self, journal: Path, who: str, answer: Callable[[], bytes]):
        self._answer = answer
        self._place, self._name = journal.absolute().parent, _name(journal, who)
        self._folder = -1
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._ended = threading.Event()
        self._open()  # now, where it can be: whoever starts us may ask at once
        self._thread = threading.Thread(target=self._serve, name=f"desk of {who}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Desk:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(2 * PATIENCE_S)
        self._socket.close()
        if self._folder >= 0:
            local_socket.unbind(self._folder, self._name)

    def _open(self) -> bool:
        """Whether there is a socket for those who ask now."""
        try:
            self._folder = local_socket.bind(self._socket, self._place, self._name)
        except OSError:
            return False
        os.chmod(local_socket.name_in(self._folder, self._name), 0o666)
        self._socket.listen(4)
        return True

    def _serve(self) -> None:
        while self._folder < 0 and not self._open():
            if self._ended.wait(RETRY_S):
                return
        while not self._ended.is_set():
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with client, suppress(OSError):
                client.settimeout(PATIENCE_S)
                client.sendall(self._answer())
            self._ended.wait(PAUSE_S)


def ask(journal: Path, who: str, patience_s: float = 3 * PATIENCE_S) -> bytes | Silence:
    """The answer of the process that serves a journal, or why there is none."""
    try:
        folder = local_socket.open_folder(journal.absolute().parent)
    except PermissionError:
        return Silence.DENIED
    except OSError:
        return Silence.ABSENT
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
            asking.settimeout(patience_s)
            asking.connect(local_socket.name_in(folder, _name(journal, who)))
            return _whole(asking)
    except PermissionError:
        return Silence.DENIED
    except (TimeoutError, BlockingIOError):
        return Silence.MUTE
    except OSError:
        return Silence.CUT_OFF if os.fstatvfs(folder).f_flag & os.ST_RDONLY else Silence.ABSENT
    finally:
        os.close(folder)


def _whole(asking: socket.socket) -> bytes | Silence:
    answer = bytearray()
    while chunk := asking.recv(CHUNK):
        answer += chunk
        if len(answer) > MOST_BYTES:
            return Silence.MUTE
    return bytes(answer) or Silence.MUTE


def _name(journal: Path, who: str) -> str:
    return f"{journal.name}.{who}.ask"
