"""Disk space held in reserve, so that alarms can still be written when everything else has filled the disk."""
from __future__ import annotations

import os
from pathlib import Path

BALLAST_BYTES = 1 << 20
"""About 1,500 events."""
MARGIN = 4
"""The reserve is taken only where the disk has so many times its size free: it must not fill the disk itself."""


class Ballast:
    """A file that does nothing but hold space."""

    def __init__(self, path: Path, size: int = BALLAST_BYTES):
        self.path = path
        self.size = size

    @property
    def held(self) -> bool:
        """Whether the space is reserved now."""
        try:
            return self.path.stat().st_size >= self.size
        except OSError:
            return False

    @property
    def roomy(self) -> bool:
        """Whether the disk has `MARGIN` times the space free."""
        try:
            disk = os.statvfs(self.path.parent)
        except OSError:
            return False
        return disk.f_bavail * disk.f_frsize >= MARGIN * self.size

    def take(self) -> bool:
        """Reserve the space, where the disk has enough left; gives `held`."""
        if self.held:
            return True
        if not self.roomy:
            return False
        try:
            with open(self.path, "wb") as file:
                os.posix_fallocate(file.fileno(), 0, self.size)
            return True
        except OSError:
            self.release()
            return False

    def release(self) -> bool:
        """Give the space to whoever writes next. False when there was none."""
        held = self.held
        try:
            self.path.unlink(missing_ok=True)
        except OSError:
            return False
        return held
