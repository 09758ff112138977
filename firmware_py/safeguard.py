"""The certified burner controller inside the flaming tool: the only one that drives gas valve and igniter.

Theory of operation. Commands are demands; the safeguard grants them within these limits (the
strictest figures of DESIGN §5):

    Purging, Ready, FlameLost, IgnitionFailed, CommandsLost: valve closed, no spark
        ──demand changes from Closed to Open together with Igniter On──▶ Ignition
        ──valve and burners closed, tight, no flame, for 30 s──▶ Ready    (CommandsLost: and commands are back)
    Ignition: valve open, spark as demanded
        ──flame seen──▶ Running      ──3 s, or 0.8 s without the valve being open──▶ IgnitionFailed
    Running: valve open, no spark
        ──no flame for 0.5 s──▶ FlameLost
    Ignition, Running:   ──demand Closed──▶ Purging      ──commands stop──▶ CommandsLost

After FlameLost, IgnitionFailed and CommandsLost a demand of Open that just goes on does nothing: Closed must be commanded
first. The simulated safeguard deliberately does *not* enforce the purge before an ignition, it only reports it (Ready): a
supervisor or mission controller that skips the purge is thus caught by the plant's hazard record, not hidden. A valve that falls
closed in a trial ends it: opened again it would bring new gas to a spark that burns over what has just flowed.
"""
from __future__ import annotations

TRIAL_NS = 3_000_000_000
"""Longest ignition trial."""
NOT_OPEN_NS = 800_000_000
"""The valve may stand closed for so long in a trial: longer than a supervisor needs to see that it does not open."""
FLAME_FAILURE_NS = 500_000_000
"""From the sensor's loss of the flame to closing; with sensor (0.2 s) and valve (0.04 s) the valve is closed within 1 s."""
PURGE_NS = 30_000_000_000
"""Closed and without flame for so long: unburnt gas has dispersed."""

_CLOSED_STATES = ("Purging", "Ready", "FlameLost", "IgnitionFailed", "CommandsLost")


class Safeguard:
    """State by the names of FLAMER_STATUS.Safeguard. purged: the tool has stood long enough to start as Ready."""

    def __init__(self, now_ns: int, *, purged: bool = False):
        self.state = "Ready" if purged else "Purging"
        self._armed = False
        self._trial_ns = self._open_ns = 0
        self._flame_ns = now_ns
        self._quiet_ns = now_ns - PURGE_NS if purged else now_ns

    @property
    def valve(self) -> str:
        """What the gas valve is driven to."""
        return "Closed" if self.state in _CLOSED_STATES else "Open"

    @property
    def sparks(self) -> bool:
        """Whether the igniter may spark."""
        return self.state == "Ignition"

    def advance(self, now_ns: int, *, gas: bool, spark: bool, fresh: bool, flame: bool, opened: bool, closed: bool) -> None:
        """One tick. gas, spark: what is commanded; fresh: commands come; flame: sensor; opened: the valve is not closed;
        closed: it is fully closed and tight, and so are the burners."""
        if fresh and not gas:
            self._armed = True
        if flame:
            self._flame_ns = now_ns
        if opened:
            self._open_ns = now_ns
        if flame or not closed:
            self._quiet_ns = now_ns
        if self.state in _CLOSED_STATES:
            self._while_closed(now_ns, gas and fresh, spark, fresh)
        elif not fresh:
            self.state = "CommandsLost"
        elif not gas:
            self.state = "Purging"
        elif self.state == "Ignition":
            if flame:
                self.state = "Running"
            elif now_ns - self._trial_ns >= TRIAL_NS or now_ns - self._open_ns >= NOT_OPEN_NS:
                self.state = "IgnitionFailed"
        elif now_ns - self._flame_ns >= FLAME_FAILURE_NS:
            self.state = "FlameLost"

    def _while_closed(self, now_ns: int, gas: bool, spark: bool, fresh: bool) -> None:
        if gas and spark and self._armed:
            self._armed = False
            self._trial_ns = self._open_ns = now_ns
            self.state = "Ignition"
        elif now_ns - self._quiet_ns < PURGE_NS:
            if self.state == "Ready":
                self.state = "Purging"
        elif fresh or self.state != "CommandsLost":
            self.state = "Ready"
