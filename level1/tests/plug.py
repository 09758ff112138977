"""A GNSS receiver for tests: sentences, and a plug that can be pulled."""
from __future__ import annotations

import os
import pty
import tty
from contextlib import suppress
from pathlib import Path

FIX = "GPGGA,120000.00,4807.038,N,01131.000,E,4,12,0.9,545.4,M,46.9,M,1.5,0133"
"""RTK fix near Munich."""


def sentence(body: str) -> bytes:
    """With its checksum and line end."""
    total = 0
    for byte in body.encode():
        total ^= byte
    return f"${body}*{total:02X}\r\n".encode()


class Plug:
    """A pty that stands for the receiver's end of the line; `path` is where the unit finds it, while it is plugged."""

    def __init__(self, path: Path):
        self.path = path
        self._master = self._slave = -1
        self._rest = b""
        self.plug()

    def plug(self) -> None:
        """Put it in."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._rest = b""
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Pull it out."""
        self.path.unlink(missing_ok=True)
        os.close(self._slave)
        os.close(self._master)

    def say(self, *bodies: str) -> None:
        """Send sentences."""
        self.send(b"".join(map(sentence, bodies)))

    def send(self, data: bytes) -> None:
        """Send bytes; what nobody reads is lost, but nothing of which the line has taken a part."""
        with suppress(BlockingIOError):
            self._rest = self._rest[os.write(self._master, self._rest):]
            if not self._rest:
                self._rest = data[os.write(self._master, data):]
