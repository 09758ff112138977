"""What the tractor moves besides itself: the three-point hitch and the power take-off.

As with `Actuator`, a new target is a try, and so is `again`; a jammed part ignores tries, "for n commands" so many of them.
"""
from __future__ import annotations

from firmware_py.actuator import Actuator

HITCH_PERCENT_S = 25.0
"""Full travel takes 4 s."""
HITCH_TOLERANCE_PERCENT = 0.5
CLUTCH_NS = 300_000_000
PTO_RATIO = 540 / 1800
RUN_UP_RPM_S, RUN_DOWN_RPM_S = 250.0, 150.0
PTO_ON_RPM, PTO_OFF_RPM = 250.0, 20.0
"""On: turns with the engine, be it idle (270 rpm). Off: stands, or as good as."""


class Hitch:
    """The three-point hitch. position: 0 % lowered, 100 % raised. target: where it was told to go last. part: of its speed."""

    def __init__(self, position: float):
        self.position = position
        self.target = position
        self.state = "Still"
        self.part = 1.0
        self._moves = False
        self._jammed = False
        self._refusals: int | None = None

    def advance(self, target: float | None, dt_s: float) -> None:
        """One tick towards a target; None: hold."""
        if target is None:
            self._moves = False
        elif target != self.target:
            self.target = target
            self._moves = self._try()
        self.state = "Still"
        if self._moves:
            step = HITCH_PERCENT_S * self.part * dt_s
            before = self.position
            self.position += min(step, max(-step, self.target - before))
            self.state = "Raising" if self.position > before else "Lowering" if self.position < before else "Still"
            self._moves = self.position != self.target

    def again(self) -> None:
        """One more try, if it stands elsewhere."""
        if not self._moves and abs(self.position - self.target) > HITCH_TOLERANCE_PERCENT:
            self._moves = self._try()

    def resume(self, target: float) -> None:
        """After a hold it is told anew."""
        self.target = target
        self._moves = abs(self.position - target) > HITCH_TOLERANCE_PERCENT and self._try()

    def jam(self, commands: int | None) -> None:
        """It stops, and ignores so many tries (None: all, until released)."""
        self._jammed = True
        self._refusals = commands
        self._moves = False

    def release(self) -> None:
        """It works again, from the next try on."""
        self._jammed = False

    def _try(self) -> bool:
        if not self._jammed:
            return True
        if self._refusals is not None:
            self._refusals -= 1
            self._jammed = self._refusals > 0
        return False


class Pto:
    """The power take-off: a clutch, and a shaft that runs up and down. clutch: On or Off."""

    def __init__(self) -> None:
        self.clutch: Actuator[str] = Actuator("Off", CLUTCH_NS, retry_ns=None)
        self.rpm = 0.0

    def mend(self, now_ns: int) -> None:
        """Its clutch works again. A spring opens it, so that it lets go now if it is off; to engage, it must be energised anew."""
        self.clutch.release()
        if self.clutch.target == "Off":
            self.clutch.again(now_ns)

    @property
    def state(self) -> str:
        """Off, RunningUp, On or RunningDown."""
        if self.clutch.position == "On":
            return "On" if self.rpm >= PTO_ON_RPM else "RunningUp"
        return "Off" if self.rpm <= PTO_OFF_RPM else "RunningDown"

    def advance(self, now_ns: int, wanted: str, engine_rpm: float, dt_s: float) -> None:
        """One tick."""
        self.clutch.advance(now_ns, wanted)
        goal = engine_rpm * PTO_RATIO if self.clutch.position == "On" else 0.0
        if goal > self.rpm:
            self.rpm = min(goal, self.rpm + RUN_UP_RPM_S * dt_s)
        else:
            self.rpm = max(goal, self.rpm - RUN_DOWN_RPM_S * dt_s)
