"""The physical side of the sprayer boom: folding, tanks, water line with pump and regulating valve, herbicide line.

Simple, but credible where the supervision looks:

- *Boom*: unfolds and folds at a steady speed; a resistance stops it, and its drive gives up after 2 s.
- *Water*: each open section is a nozzle, flow = 0.354 L/min √bar: 0.5 L/min at 2 bar. The regulating valve sets the pressure with
  a time constant of 0.8 s, the pump gives what it can, the flow meter follows with 0.2 s.
- *Herbicide*: a dosing pump injects the share of the open sections; behind a blockage the pressure rises to the relief valve's.
- *Tanks*: what flows out is missing; water sloshes; the optical level sensor can drift.
"""
from __future__ import annotations

import math
from random import Random
from typing import NamedTuple

from firmware_py.actuator import Actuator

SECTIONS = 12

# --- boom -------------------------------------------------------------------------------------------------------------------

BOOM_DRIVE_NS = 200_000_000
STALL_S = 2.0
"""Its drive gives up after so long against a resistance."""


class Boom:
    """The folding. opening: 0 folded … 1 unfolded. time_s: from one end to the other. slow: takes three times as long.

    After it has given up (a resistance, a drive that did not obey) it moves for a new command, or while it is held to run.
    """

    def __init__(self, opening: float, time_s: float):
        self.opening = opening
        self.slow = False
        self.drive = Actuator("Stop", BOOM_DRIVE_NS, retry_ns=None)
        self._time_s = time_s
        self._wanted = "Stop"
        self._blocked = False
        self._tries: int | None = None
        self._stalled_s = 0.0
        self._held_only = False

    @property
    def state(self) -> str:
        """BoomState of the DBC."""
        if self._moves:
            return "Opening" if self.drive.position == "Open" else "Closing"
        return "Open" if self.opening >= 1 else "Closed" if self.opening <= 0 else "Stopped"

    @property
    def _moves(self) -> bool:
        """Whether it is driven, and not at that end."""
        end = {"Open": 1.0, "Close": 0.0}.get(self.drive.position, self.opening)
        return self.opening != end and self._stalled_s < STALL_S

    def block(self, tries: int | None = None) -> None:
        """A resistance where it is: it gives way at the try of this number, None: at none."""
        self._blocked = True
        self._tries = tries

    def release(self) -> None:
        """No resistance, no slowness, obeys."""
        self._blocked = self.slow = False
        self.drive.release()

    def again(self, now_ns: int) -> None:
        """Hold to run, if it has given up: drive once more, while `advance` is told `held`."""
        if self._stalled_s < STALL_S and self.drive.position == self._wanted:
            return
        self._held_only = True
        if self._stalled_s >= STALL_S:
            self._stalled_s = 0.0
            if self._blocked and self._tries is not None:
                self._tries -= 1
                self._blocked = self._tries > 0
        self.drive.again(now_ns)

    def advance(self, now_ns: int, wanted: str, dt_s: float, *, held: bool = False) -> None:
        """One tick. wanted: Stop, Open or Close. held: somebody holds it to run."""
        before, self._wanted = self.drive.position, wanted
        self.drive.advance(now_ns, wanted)
        if self.drive.position != before:
            self._stalled_s = 0.0
        if self._held_only and not held:
            self._held_only = False
            self._stalled_s = STALL_S if self._moves else self._stalled_s
        if not self._moves:
            return
        if self._blocked:
            self._stalled_s += dt_s
            return
        step = dt_s / (self._time_s * (3 if self.slow else 1))
        self.opening = min(1.0, self.opening + step) if self.drive.position == "Open" else max(0.0, self.opening - step)


# --- water ------------------------------------------------------------------------------------------------------------------

NOZZLE = 0.3536
"""L/min √bar of one section."""
PUMP_L_MIN, WEAK_PUMP_L_MIN = 20.0, 0.4
HIGHEST_BAR = 10.0
"""The regulating valve sets no more."""
REGULATOR_S = 0.8
METER_S = 0.2
LEAK_L_MIN = 20.0


class WaterLine:
    """Pump, regulating valve, sections, flow meter. bar: at the sections. flow_l_min: flow meter. weak: the pump gives little."""

    def __init__(self, dt_s: float):
        self.bar = 0.0
        self.flow_l_min = 0.0
        self.weak = False
        self.regulator = Actuator(0.0, 0, retry_ns=None)
        self._regulator_step = 1 - math.exp(-dt_s / REGULATOR_S)
        self._meter_step = 1 - math.exp(-dt_s / METER_S)

    def advance(self, now_ns: int, runs: bool, set_l_min: float, sections: int, supply: bool) -> float:
        """One tick; gives the true flow (L/min). set_l_min: for all sections. supply: there is water."""
        nozzle_l_min = set_l_min / SECTIONS
        self.regulator.advance(now_ns, min((nozzle_l_min / NOZZLE) ** 2, HIGHEST_BAR) if runs else 0.0)
        self.bar += (self.regulator.position - self.bar) * self._regulator_step
        flow_l_min = 0.0
        if runs and supply and sections:
            flow_l_min = min(sections * NOZZLE * math.sqrt(self.bar), WEAK_PUMP_L_MIN if self.weak else PUMP_L_MIN)
        self.flow_l_min += (flow_l_min - self.flow_l_min) * self._meter_step
        return flow_l_min


# --- herbicide --------------------------------------------------------------------------------------------------------------

DOSING_S = 0.3
IDLE_BAR, BAR_PER_ML_MIN = 2.0, 0.005
RELIEF_BAR = 8.0
PRESSURE_RISE_BAR_S = 4.0
"""Behind a blockage, while it is dosed."""
FLUSH_S = 1.0
"""The line is relieved for so long, then dosing goes on."""


class HerbicideLine:
    """Dosing pump and line. bar: in the line. flow_ml_min: flow meter. weak: the pump gives a third."""

    def __init__(self, dt_s: float):
        self.bar = 0.0
        self.flow_ml_min = 0.0
        self.weak = False
        self._dt_s = dt_s
        self._step = 1 - math.exp(-dt_s / DOSING_S)
        self._blocked = False
        self._flushes: int | None = None
        self._flushing_s = 0.0

    def block(self, flushes: int | None = None) -> None:
        """It gives way at the flush of this number, None: at none."""
        self._blocked = True
        self._flushes = flushes

    def release(self) -> None:
        """Free, and the pump works."""
        self._blocked = self.weak = False

    def flush(self) -> None:
        """Relieve and flush the line."""
        self._flushing_s = FLUSH_S
        if self._blocked and self._flushes is not None:
            self._flushes -= 1
            self._blocked = self._flushes > 0

    def advance(self, runs: bool, target_ml_min: float, supply: bool) -> None:
        """One tick. target_ml_min: to be dosed now. supply: there is herbicide."""
        dose_ml_min = target_ml_min * (1 / 3 if self.weak else 1) if runs and supply else 0.0
        if self._flushing_s > 0:
            self._flushing_s -= self._dt_s
            self.bar = self.flow_ml_min = 0.0
        elif self._blocked:
            self.flow_ml_min = 0.0
            if dose_ml_min:
                self.bar = min(RELIEF_BAR, self.bar + PRESSURE_RISE_BAR_S * self._dt_s)
        else:
            self.flow_ml_min += (dose_ml_min - self.flow_ml_min) * self._step
            self.bar = IDLE_BAR + BAR_PER_ML_MIN * self.flow_ml_min if runs else 0.0


# --- tanks ------------------------------------------------------------------------------------------------------------------

SLOSH_L, SLOSH_S = 1.0, 1.4
DRIFT_L_S = 20.0 / 60


class Tank:
    """The main tank. litres: in it. used_l: through the flow meter since it was filled. Slosh and drift are of the level sensor."""

    def __init__(self, random: Random, litres: float):
        self.litres = self.filled_l = litres
        self.used_l = 0.0
        self.leaks = False
        self.drift_l_s = 0.0
        self._offset_l = 0.0
        self._phase = random.uniform(0, 2 * math.pi)

    def advance(self, dt_s: float, flow_l_min: float) -> None:
        """One tick."""
        taken_l = min(self.litres, flow_l_min * dt_s / 60)
        self.used_l += taken_l
        self.litres -= taken_l
        if self.leaks:
            self.litres = max(0.0, self.litres - LEAK_L_MIN * dt_s / 60)
        self._offset_l += self.drift_l_s * dt_s

    def fill(self, litres: float) -> None:
        """Filled up to so much; its counter begins anew."""
        self.litres = self.filled_l = litres
        self.used_l = 0.0

    def level_l(self, t_ns: int) -> float:
        """What the sensor says."""
        slosh_l = SLOSH_L * math.sin(self._phase + 2 * math.pi * (t_ns / 1e9) / SLOSH_S) if self.litres > SLOSH_L else 0.0
        return min(max(self.litres + self._offset_l + slosh_l, 0.0), 220.0)


# --- all of it --------------------------------------------------------------------------------------------------------------


class Demand(NamedTuple):
    """What the protocol wants of the lines: set points for all sections open, in L/min and mL/min."""

    runs: bool
    main_l_min: float
    dis_ml_min: float


class SprayerPlant:
    """Tanks and lines together. dis_l: herbicide in its tank."""

    def __init__(self, random: Random, dt_s: float, main_l: float, dis_l: float):
        self.tank = Tank(random, main_l)
        self.water = WaterLine(dt_s)
        self.herbicide = HerbicideLine(dt_s)
        self.dis_l = dis_l
        self._dt_s = dt_s

    def advance(self, now_ns: int, demand: Demand, sections: int) -> None:
        """One tick with so many sections open."""
        flow_l_min = self.water.advance(now_ns, demand.runs, demand.main_l_min, sections, self.tank.litres > 0)
        self.tank.advance(self._dt_s, flow_l_min)
        self.herbicide.advance(demand.runs, demand.dis_ml_min * sections / SECTIONS, self.dis_l > 0)
        self.dis_l = max(0.0, self.dis_l - self.herbicide.flow_ml_min * self._dt_s / 60_000)
