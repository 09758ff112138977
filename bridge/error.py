"""The error of what a user can put right, for those who know the bridge and nothing of level 1."""
from __future__ import annotations

from level1.io.error import OutsideError

__all__ = ["OutsideError"]
