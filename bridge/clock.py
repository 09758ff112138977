"""The machine's clocks, for labels and time-outs of what runs live."""
from __future__ import annotations

import ctypes
import time
from datetime import UTC, datetime
from decimal import Decimal

from level1.event import seconds

_TIMEX_BYTES = 208
_TIME_ERROR = 5


class Clock:
    """Monotonic time, and UTC as a label beside it."""

    def __init__(self) -> None:
        self._adjtimex = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)

    def now_ns(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC: the time line of a unit since its computer started."""
        return time.monotonic_ns()

    def t(self) -> Decimal:
        """The same in seconds with nine places, as messages carry it."""
        return seconds(self.now_ns())

    def utc(self) -> str:
        """RFC 3339 with milliseconds."""
        return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

    def trusted(self) -> bool:
        """Whether the kernel's clock is synchronised (adjtimex(2)): NTP or the GNSS receiver sets it."""
        # mode 0 only reads; the structure is zeroed, and its size is that of 64-bit Linux, larger than that of 32-bit
        return self._adjtimex is not None and self._adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)) not in (-1, _TIME_ERROR)
