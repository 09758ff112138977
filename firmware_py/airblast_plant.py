"""The physical side of the air-blast sprayer: tank, pump, main line with its return to the tank, nozzles.

- *Pump and line*: while the main valve is open and the tank is not empty, the flow follows its set point with a time constant of
  0.4 s. A blocked line lets nothing through; the pressure then rises to that of the relief valve.
- *Nozzles*: each open one takes 2 L/min at the working pressure; what they do not take returns to the tank and stirs it.
"""
from __future__ import annotations

import math
from random import Random

FLOW_TIME_CONSTANT_S = 0.4
NOZZLE_L_MIN = 2.0
WORKING_BAR, RELIEF_BAR = 10.0, 16.0
NOISE_L_MIN = 0.05
SLOSH_PERCENT = 0.4
"""The level sensor of a tank that moves."""


class AirblastPlant:
    """Tank and line. dt_s: length of a step, fixed. volume_l: the tank's; level_percent: what is in it.

    blocked: nothing gets through the main line.
    """

    def __init__(self, random: Random, volume_l: float, level_percent: float, dt_s: float):
        self.volume_l = volume_l
        self.litres = volume_l * level_percent / 100
        self.sprayed_l = 0.0
        self.flow_l_min = self.bar = 0.0
        self.blocked = False
        self._random = random
        self._dt_s = dt_s
        self._part = 1 - math.exp(-dt_s / FLOW_TIME_CONSTANT_S)

    @property
    def level_percent(self) -> float:
        """What is left in the tank."""
        return 100 * self.litres / self.volume_l

    @property
    def shown_percent(self) -> float:
        """What the level sensor says: liquid sloshes."""
        return min(100.0, max(0.0, self.level_percent + self._random.uniform(-SLOSH_PERCENT, SLOSH_PERCENT) * (self.litres > 0)))

    @property
    def shown_l_min(self) -> float:
        """What the flow meter says."""
        return max(0.0, self.flow_l_min + self._random.uniform(-NOISE_L_MIN, NOISE_L_MIN) * (self.flow_l_min > 1))

    def fill(self, level_percent: float) -> None:
        """Fill or empty the tank."""
        self.litres = self.volume_l * level_percent / 100

    def advance(self, *, pumps: bool, valve_open: bool, wanted_l_min: float, nozzles: int) -> None:
        """One step. pumps: the pump turns; nozzles: how many are open."""
        flows = pumps and valve_open and not self.blocked and self.litres > 0
        self.flow_l_min += ((wanted_l_min if flows else 0.0) - self.flow_l_min) * self._part
        target_bar = RELIEF_BAR if pumps and self.litres > 0 and not flows else WORKING_BAR if flows else 0.0
        self.bar += (target_bar - self.bar) * self._part
        out_l = min(nozzles * NOZZLE_L_MIN, self.flow_l_min) / 60 * self._dt_s if flows else 0.0
        self.litres = max(0.0, self.litres - out_l)
        self.sprayed_l += out_l
