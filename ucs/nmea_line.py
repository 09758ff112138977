"""A serial line for a simulated GNSS receiver: a pseudo terminal with a name, which any program opens as it would open a port."""
from __future__ import annotations

import os
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from level1.io.error import OutsideError


@contextmanager
def nmea_line(path: Path) -> Iterator[Callable[[bytes], object]]:
    """Makes `path` a link to the new line and gives the function that writes to it. The link is removed in the end.

    When nobody reads, what waits is thrown away: a receiver does not say old positions. Raises OutsideError.
    """
    if path.exists() or path.is_symlink():
        raise OutsideError(f"{path}: there is something of that name already; remove it, or choose another name")
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        _link(path, os.ttyname(slave))
        try:
            yield lambda data: _write(master, slave, data)
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(master)
        os.close(slave)


@contextmanager
def nmea_file(path: Path) -> Iterator[Callable[[bytes], object]]:
    """The same as a file, for virtual time. Raises OutsideError."""
    try:
        file = path.open("wb")
    except OSError as error:
        raise OutsideError(f"{path}: {error.strerror}") from error
    with file:
        yield file.write


def _link(path: Path, device: str) -> None:
    try:
        path.symlink_to(device)
    except OSError as error:
        raise OutsideError(f"{path}: {error.strerror}") from error


def _write(master: int, slave: int, data: bytes) -> None:
    try:
        written = os.write(master, data)
    except BlockingIOError:
        written = 0
    if written < len(data):
        termios.tcflush(slave, termios.TCIFLUSH)
