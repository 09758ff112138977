"""What systemd wants to hear of a service (sd_notify(3)): that it is ready, lives, ends. Without systemd, nothing happens."""
from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress


class Supervised:
    """This process as a service of systemd. environ: where systemd says how to reach it, and how often it wants to hear."""

    def __init__(self, environ: Mapping[str, str] = os.environ, pid: int | None = None):
        self._address = environ.get("NOTIFY_SOCKET", "")
        meant = environ.get("WATCHDOG_PID", "") in ("", str(os.getpid() if pid is None else pid))
        period_us = environ.get("WATCHDOG_USEC", "")
        self._period_ns = int(period_us) * 1000 // 3 if self._address and meant and period_us.isdecimal() else None
        self._due_ns = 0

    def ready(self, text: str) -> None:
        """It does its work now; text: what `systemctl status` shows."""
        self._tell(f"READY=1\nSTATUS={text}")

    def alive(self, now_ns: int) -> None:
        """It has just done a turn of its work; passed on three times as often as systemd asks for."""
        if self._period_ns is not None and now_ns >= self._due_ns:
            self._due_ns = now_ns + self._period_ns
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """It ends."""
        self._tell("STOPPING=1")

    def _tell(self, text: str) -> None:
        if not self._address:
            return
        name = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            out.setblocking(False)
            out.sendto(text.encode(), name)
