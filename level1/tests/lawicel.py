"""A CAN adapter on a serial line for tests: speaks the Lawicel protocol (slcan) over a pty, and has a plug that can be pulled."""
from __future__ import annotations

import os
import pty
import select
import threading
import tty
from contextlib import suppress
from pathlib import Path


class Adapter:
    """Answers commands, hands out the frames that are put on its bus, and keeps those that are sent.

    path: where the unit finds it while it is plugged. sent: lines of frames, as they came. is_open: the channel is.
    drains: takes what is written to it; an adapter that hangs does not.
    """

    def __init__(self, path: Path):
        self.path = path
        self.sent: list[str] = []
        self.is_open = False
        self.drains = True
        self._master = self._slave = -1
        self._rest = b""
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self.plug()
        self._thread = threading.Thread(target=self._run, name="adapter")
        self._thread.start()

    def plug(self) -> None:
        """Put it in; its channel is closed."""
        with self._lock:
            self._master, self._slave = pty.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self._rest, self.is_open = b"", False
            self.path.unlink(missing_ok=True)
            self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Pull it out."""
        with self._lock:
            self.path.unlink(missing_ok=True)
            os.close(self._slave)
            os.close(self._master)
            self._master = self._slave = -1

    @property
    def is_plugged(self) -> bool:
        """Whether it is in."""
        return self._master >= 0

    def stop(self) -> None:
        """End it."""
        self._ended.set()
        self._thread.join()
        if self.is_plugged:
            self.unplug()

    def hear(self, can_id: int, data: bytes, extended: bool = False) -> None:
        """A frame comes on its bus."""
        self.write((f"T{can_id:08X}" if extended else f"t{can_id:03X}").encode() + f"{len(data)}{data.hex().upper()}\r".encode())

    def hang(self) -> None:
        """From now on it takes nothing more, and the line to it is full; `drains = True` ends it."""
        with self._lock:
            self.drains = False
            os.set_blocking(self._slave, False)
            self._fill()

    def _fill(self) -> None:
        """Again and again while it hangs: the kernel passes what was written on to another buffer when it finds the time."""
        with suppress(BlockingIOError):
            while True:
                os.write(self._slave, b"\r" * 512)

    def write(self, line: bytes) -> None:
        """Bytes to the unit; nothing while it is unplugged or its channel is closed."""
        with self._lock:
            if self.is_open:
                self._write(line)

    def _write(self, line: bytes) -> None:
        if self._master >= 0:
            with suppress(OSError):  # nobody reads
                os.write(self._master, line)

    def _run(self) -> None:
        while not self._ended.wait(0.002):
            with self._lock:
                if self._master >= 0 and not self.drains:
                    self._fill()
                if self._master >= 0 and self.drains and select.select([self._master], [], [], 0)[0]:
                    with suppress(OSError):
                        self._rest += os.read(self._master, 4096)
                *lines, self._rest = self._rest.split(b"\r")
                for line in lines:
                    self._obey(line.decode())

    def _obey(self, line: str) -> None:
        command = line[:1]
        if command in ("O", "L", "C"):
            self.is_open = command != "C"
        elif command and command in "tTrR":
            if not self.is_open:
                self._write(b"\a")
                return
            self.sent.append(line)
        self._write({"V": b"V1013\r", "N": b"NA123\r", "t": b"z\r", "T": b"Z\r", "r": b"z\r", "R": b"Z\r"}.get(command, b"\r"))
