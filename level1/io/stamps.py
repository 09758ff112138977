"""Time stamps of the wall clock turned into times of the monotonic clock, without believing its jumps."""
from __future__ import annotations

PLAUSIBLE_AGE_NS = 5_000_000_000
"""A frame waits no longer than this before it is read, unless the whole computer stood still."""
EVEN_NS = 1_000_000
"""How exactly the two clocks are compared; moving apart by twice this between two looks is a jump (NTP slews 0.5 ms/s)."""


class Stamps:
    """A frame's age by its stamp is believed while it is plausible and the wall clock runs evenly."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._even_since_ns = 0

    def offset_ns(self, before_ns: int, wall_ns: int, now_ns: int) -> int | None:
        """Wall clock minus monotonic clock; None: it has just jumped, and stamps are not to be believed. The wall clock showed
        `wall_ns` between `before_ns` and `now_ns`."""
        offset = wall_ns - now_ns
        if now_ns - before_ns <= EVEN_NS:
            if self._offset_ns is not None and abs(offset - self._offset_ns) > 2 * EVEN_NS:
                # What was stamped before a jump may still be on its way.
                self._even_since_ns = now_ns + PLAUSIBLE_AGE_NS
            self._offset_ns = offset
        elif self._offset_ns is not None:
            offset = self._offset_ns  # interrupted between its looks at the clocks, the thread has seen no better one
        return offset if now_ns >= self._even_since_ns else None

    def monotonic_ns(self, stamp_ns: int, before_ns: int, wall_ns: int, now_ns: int) -> int:
        """When a frame came, by its stamp. The clocks as for `offset_ns`."""
        offset = self.offset_ns(before_ns, wall_ns, now_ns)
        if offset is None:
            return now_ns
        t_ns = stamp_ns - offset
        return t_ns if now_ns - PLAUSIBLE_AGE_NS < t_ns <= now_ns else now_ns
