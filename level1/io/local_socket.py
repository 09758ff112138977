"""Unix sockets in a folder, named by the folder's descriptor: a socket's path has 107 bytes at most, a journal's has not."""
from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path


def open_folder(folder: Path) -> int:
    """A descriptor of it. Raises OSError."""
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)


def name_in(folder: int, name: str) -> str:
    """The path to bind or to connect to."""
    return f"/proc/self/fd/{folder}/{name}"


def bind(one: socket.socket, folder: Path, name: str) -> int:
    """Bind a socket, in place of one that was left behind; gives the folder's descriptor. Raises OSError."""
    descriptor = open_folder(folder)
    try:
        _remove(descriptor, name)
        one.bind(name_in(descriptor, name))
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def unbind(folder: int, name: str) -> None:
    """Remove a socket from its folder, and close the descriptor."""
    _remove(folder, name)
    os.close(folder)


def _remove(folder: int, name: str) -> None:
    with suppress(OSError):
        os.unlink(name, dir_fd=folder)
