"""The physical side of the flaming tool: bottle, gas line, pilot flame, wind, and the unburnt gas around it.

Simple, but credible where the supervision looks:

- *Bottle*: liquid propane boils at the pressure of its temperature (Antoine equation, NIST coefficients for 230.6–320.7 K);
  boiling cools it, the air warms it. When the liquid is gone, the pressure falls with the rest of the vapour.
- *Gas line*: behind the valve the regulator's pressure, or the bottle's when that is lower, with a time constant of 0.1 s.
- *Pilot flame*: needs gas and a spark to light, after a random delay; needs gas to burn on. Gusts above 6 m/s may blow it out.
- *Unburnt gas*: what flows without a flame stays around the tool and disperses in about 20 s (time constant 7 s).

The safety oracle of the tests is `hazards`: gas that was lit after it had gathered, a spark too soon after unburnt gas had
flowed, gas flowing without a flame for longer than any trial. A healthy supervisor never causes one.
"""
from __future__ import annotations

import math
from random import Random
from typing import NamedTuple

KELVIN = 273.15
AMBIENT_BAR = 1.013

# Bottle of 33 kg. Masses, heats and the heat it takes up from the air are typical figures for such a steel bottle.
BOTTLE_KG = 33.0
VAPOUR_KG = 1.2
"""Below this all of it is vapour (78 L at 15 °C)."""
HEAT_OF_VAPORISATION = 356e3
"""J/kg."""
HEAT_CAPACITY_LIQUID = 2500.0
"""J/(kg K)."""
HEAT_CAPACITY_STEEL = 20.0 * 480.0
"""J/K."""
HEAT_FROM_AIR = 40.0
"""W/K."""
ANTOINE = (3.98292, 819.296, -24.417)
BOTTLE_STEP_S = 0.5

REGULATED_BAR = 1.5
LINE_TIME_CONSTANT_S = 0.1
LEAK = 0.3
"""Part of the regulated pressure that a leaking valve lets through."""
PILOT_KG_S = 0.05e-3
BURNER_KG_S = {"Off": 0.0, "Low": 0.25e-3, "High": 0.5e-3}
"""Flow of a burner at the regulated pressure: about 12 and 23 kW."""
BURNING_BAR = 0.1
"""A flame needs this pressure to burn on."""
IGNITION_DELAY_S = (0.2, 1.2)
"""Gas and spark together for a time drawn from here, then it burns."""
BLOWS_OUT_M_S = 6.0
BLOW_OUT_RATE = 0.002
"""Per second and (m/s)² above that."""

DISPERSAL_S = 7.0
GATHERED_KG = 0.15e-3
"""More unburnt gas than one ignition trial leaves (0.15 g at most)."""
DISPERSED_S = 20.0
LONGEST_UNBURNT_S = 4.5
"""A trial of 3 s, the line running empty, and a margin."""


class Hazard(NamedTuple):
    """A dangerous moment. gas_kg: unburnt gas around the tool then."""

    t_ns: int
    what: str
    gas_kg: float


def propane_bar(celsius: float) -> float:
    """Vapour pressure of propane, gauge."""
    a, b, c = ANTOINE
    return float(10 ** (a - b / (celsius + KELVIN + c))) - AMBIENT_BAR


class Bottle:
    """The LPG bottle. level_percent by weight, air_celsius outside; gas_used_kg since the start."""

    def __init__(self, level_percent: float, air_celsius: float):
        self.kg = BOTTLE_KG * level_percent / 100
        self.air_celsius = air_celsius
        self.celsius = air_celsius
        self.gas_used_kg = 0.0
        self.bar = 0.0
        self._flown_kg = 0.0
        self._step_s = 0.0
        self._update()

    @property
    def level_percent(self) -> float:
        """Gas left, by weight."""
        return 100 * self.kg / BOTTLE_KG

    def empty(self) -> None:
        """All gas is gone, now."""
        self.kg = 0.0
        self._update()

    def change(self) -> None:
        """A full one stands in its place, as warm as the air."""
        self.kg, self.celsius = BOTTLE_KG, self.air_celsius
        self._update()

    def advance(self, dt_s: float, flow_kg_s: float) -> None:
        """Take gas for a moment; temperature and pressure follow every `BOTTLE_STEP_S`."""
        self._flown_kg += flow_kg_s * dt_s
        self._step_s += dt_s
        if self._step_s >= BOTTLE_STEP_S:
            self._update()

    def _update(self) -> None:
        taken_kg = min(self._flown_kg, self.kg)
        boiled_kg = min(taken_kg, max(self.kg - VAPOUR_KG, 0.0))
        heat = HEAT_FROM_AIR * (self.air_celsius - self.celsius) * self._step_s - boiled_kg * HEAT_OF_VAPORISATION
        self.kg -= taken_kg
        self.gas_used_kg += taken_kg
        self.celsius += heat / (self.kg * HEAT_CAPACITY_LIQUID + HEAT_CAPACITY_STEEL)
        self.bar = max(0.0, (propane_bar(self.celsius) + AMBIENT_BAR) * min(1.0, self.kg / VAPOUR_KG) - AMBIENT_BAR)
        self._flown_kg = self._step_s = 0.0


class Wind:
    """A steady wind with gusts at random times. Speeds in m/s; every_s: mean time between gusts, 0 for none."""

    def __init__(self, random: Random, steady_m_s: float, gust_m_s: float, every_s: float, length_s: float):
        self._random = random
        self._steady_m_s = steady_m_s
        self._gust_m_s = gust_m_s
        self._every_s = every_s
        self._length_s = length_s
        self._left_s = 0.0
        self._until_next_s = self._draw()
        self.m_s = steady_m_s

    def gust(self) -> None:
        """One gust, now."""
        self._left_s = self._length_s
        self.m_s = max(self._steady_m_s, self._gust_m_s)

    def advance(self, dt_s: float) -> None:
        """Let time pass."""
        if self._left_s > 0:
            self._left_s -= dt_s
            if self._left_s <= 0:
                self.m_s = self._steady_m_s
            return
        self._until_next_s -= dt_s
        if self._until_next_s <= 0:
            self._until_next_s = self._draw()
            self.gust()

    def _draw(self) -> float:
        return self._random.expovariate(1 / self._every_s) if self._every_s > 0 else math.inf


class FlamingPlant:
    """Gas, flame and wind together. dt_s: the length of a step, fixed.

    flame: the pilot burns. loss: why it last went out. line_bar: gauge pressure behind the valve. unburnt_kg: gas around it.
    """

    def __init__(self, random: Random, bottle: Bottle, wind: Wind, dt_s: float):
        self.bottle = bottle
        self.wind = wind
        self.flame = False
        self.loss = ""
        self.line_bar = 0.0
        self.unburnt_kg = 0.0
        self.hazards: list[Hazard] = []
        self._random = random
        self._dt_s = dt_s
        self._line_step = 1 - math.exp(-dt_s / LINE_TIME_CONSTANT_S)
        self._disperse_step = math.exp(-dt_s / DISPERSAL_S)
        self._sparked_s = 0.0
        self._delay_s: float | None = None
        self._without_flame_s = 0.0
        self._since_unburnt_s = math.inf

    def advance(self, t_ns: int, *, opening: float, spark: bool, burners: tuple[str, ...]) -> None:
        """One step. opening: of the gas valve, 1 open, 0 closed, `LEAK` when it leaks. burners: Off, Low or High each."""
        self.wind.advance(self._dt_s)
        supply_bar = min(REGULATED_BAR, self.bottle.bar) * opening
        self.line_bar += (supply_bar - self.line_bar) * self._line_step
        flow_kg_s = 0.0
        if self.line_bar > 0.01:
            flow_kg_s = (PILOT_KG_S + sum(map(BURNER_KG_S.__getitem__, burners))) * self.line_bar / REGULATED_BAR
        self.bottle.advance(self._dt_s, flow_kg_s)
        if self.flame:
            self._burn()
        if not self.flame:
            self._ignite(t_ns, spark, flow_kg_s)
        self._gather(t_ns, flow_kg_s)

    def blow_out(self, why: str) -> None:
        """The pilot flame goes out."""
        if self.flame:
            self.flame = False
            self.loss = why

    def _burn(self) -> None:
        excess_m_s = self.wind.m_s - BLOWS_OUT_M_S
        if self.line_bar < BURNING_BAR:
            self.blow_out("no gas")
        elif excess_m_s > 0 and self._random.random() < BLOW_OUT_RATE * excess_m_s * excess_m_s * self._dt_s:
            self.blow_out(f"a gust of {self.wind.m_s:g} m/s")

    def _ignite(self, t_ns: int, spark: bool, flow_kg_s: float) -> None:
        if not spark or self.line_bar < BURNING_BAR:
            self._delay_s = None
            return
        if self._delay_s is None:
            self._delay_s = self._random.uniform(*IGNITION_DELAY_S)
            self._sparked_s = 0.0
            if self._since_unburnt_s < DISPERSED_S:
                self._hazard(t_ns, f"spark {self._since_unburnt_s:.1f} s after unburnt gas had flowed")
        self._sparked_s += self._dt_s
        if self._sparked_s >= self._delay_s:
            self.flame = True
            self._delay_s = None
            if self.unburnt_kg > GATHERED_KG:
                self._hazard(t_ns, f"{self.unburnt_kg * 1000:.2f} g of unburnt gas lit at once")
                self.unburnt_kg = 0.0

    def _gather(self, t_ns: int, flow_kg_s: float) -> None:
        self.unburnt_kg *= self._disperse_step
        if flow_kg_s and not self.flame:
            self.unburnt_kg += flow_kg_s * self._dt_s
            before_s = self._without_flame_s
            self._without_flame_s += self._dt_s
            if before_s <= LONGEST_UNBURNT_S < self._without_flame_s:
                self._hazard(t_ns, f"gas flows without a flame for more than {LONGEST_UNBURNT_S:g} s")
        elif self._without_flame_s and not self.flame:
            self._without_flame_s = 0.0
            self._since_unburnt_s = 0.0
        elif self.flame:
            self._without_flame_s = 0.0
        if not self._without_flame_s:
            self._since_unburnt_s += self._dt_s

    def _hazard(self, t_ns: int, what: str) -> None:
        self.hazards.append(Hazard(t_ns, what, self.unburnt_kg))
