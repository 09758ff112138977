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

PATIENCE_S = 1.0
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


class Desk:
    """Answers whoever asks; a context manager. who: `run` or `bridge`. Raises OSError where the folder can't be written.

    answer: called in the desk's thread for every question.
    """

    def __init__(self, journal: Path, who: str, answer: Callable[[], bytes]):
        self._answer = answer
        self._name = _name(journal, who)
        # by the folder's descriptor: a socket's path has 107 bytes at most, a journal's has not
        self._folder = os.open(journal.absolute().parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._unlink()
            path = f"/proc/self/fd/{self._folder}/{self._name}"
            self._socket.bind(path)
            os.chmod(path, 0o666)
            self._socket.listen(4)
        except BaseException:
            self._socket.close()
            os.close(self._folder)
            raise
        self._thread = threading.Thread(target=self._serve, name=f"desk of {who}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Desk:
        return self

    def __exit__(self, *_: object) -> None:
        self._unlink()
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(2 * PATIENCE_S)
        self._socket.close()
        os.close(self._folder)

    def _serve(self) -> None:
        pause = threading.Event()
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with client, suppress(OSError):
                client.settimeout(PATIENCE_S)
                client.sendall(self._answer())
            pause.wait(PAUSE_S)

    def _unlink(self) -> None:
        with suppress(OSError):
            os.unlink(self._name, dir_fd=self._folder)


def ask(journal: Path, who: str, patience_s: float = 3 * PATIENCE_S) -> bytes | Silence:
    """The answer of the process that serves a journal, or why there is none."""
    try:
        folder = os.open(journal.absolute().parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except PermissionError:
        return Silence.DENIED
    except OSError:
        return Silence.ABSENT
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
            asking.settimeout(patience_s)
            asking.connect(f"/proc/self/fd/{folder}/{_name(journal, who)}")
            return _whole(asking)
    except PermissionError:
        return Silence.DENIED
    except (TimeoutError, BlockingIOError):
        return Silence.MUTE
    except OSError:
        return Silence.ABSENT
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
