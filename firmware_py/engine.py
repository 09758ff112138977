"""The engine of a 50 hp tractor: speed, oil pressure, coolant, electrics, fuel. Enough physics for its alarms to be earned."""
from __future__ import annotations

import math

IDLE_RPM, WORK_RPM = 900.0, 1800.0
"""The PTO turns at 540 rpm at 1800 rpm of the engine."""
SPEED_TAU_S = 0.8
STOP_RPM_S = 1500.0
"""How fast a dead engine stops."""
RUNS_RPM = 600.0
TANK_L = 60.0
IDLE_L_H, WORK_L_H = 1.8, 6.5
COOLANT_L, COOLANT_LOW_L = 10.0, 5.0
LEAK_L_S = 0.2
"""A burst hose; below the limit the pump draws air."""
AMBIENT_C, WORKING_C, DRY_C = 15.0, 85.0, 130.0
WARM_TAU_S, DRY_TAU_S = 120.0, 40.0
CHARGING_V, LOADED_V, REST_V = 14.1, 12.3, 12.6
"""Alternator running; battery alone with the engine's consumers; battery alone, engine off."""
DRAIN_V_S = 0.001


class Engine:
    """The plant. dt_s: length of a tick. fuel_percent: in the tank.

    running: whether it burns. dead: can't run. leaks: coolant runs out. alternator: charges.
    """

    def __init__(self, dt_s: float, fuel_percent: float):
        self._dt_s = dt_s
        self.running = True
        self.rpm = IDLE_RPM
        self.coolant_c = WORKING_C
        self.fuel_l = TANK_L * fuel_percent / 100
        self.fuel_rate_l_h = IDLE_L_H
        self.alternator = True
        self.leaks = False
        self._dead = False
        self._coolant_l = COOLANT_L
        self._drained_v = 0.0

    @property
    def oil_kpa(self) -> float:
        """Oil pressure, gauge."""
        return 0.0 if self.rpm < 100 else min(400.0, 140.0 + 0.1 * self.rpm)

    @property
    def volts(self) -> float:
        """At the key switch."""
        if self.running and self.alternator:
            return CHARGING_V
        return max(9.0, (LOADED_V if self.running else REST_V) - self._drained_v)

    @property
    def fuel_percent(self) -> float:
        """Of a full tank."""
        return 100 * self.fuel_l / TANK_L

    def die(self) -> None:
        """It stops and does not start again before `repair`."""
        self._dead = True

    def start(self) -> None:
        """Someone puts it right and starts it."""
        self._dead = False

    def fill_coolant(self) -> None:
        """Someone changes the hose and fills up."""
        self.leaks = False
        self._coolant_l = COOLANT_L

    def advance(self, works: bool) -> None:
        """One tick. works: at working speed rather than idle."""
        dt_s = self._dt_s
        self.running = not self._dead and self.fuel_l > 0
        if self.running:
            wanted = WORK_RPM if works else IDLE_RPM
            self.rpm += (wanted - self.rpm) * (1 - math.exp(-dt_s / SPEED_TAU_S))
            if abs(self.rpm - wanted) < 0.1:
                self.rpm = wanted
        else:
            self.rpm = max(0.0, self.rpm - STOP_RPM_S * dt_s)
        load = max(0.0, (self.rpm - IDLE_RPM) / (WORK_RPM - IDLE_RPM))
        self.fuel_rate_l_h = IDLE_L_H + (WORK_L_H - IDLE_L_H) * load if self.running else 0.0
        self.fuel_l = max(0.0, self.fuel_l - self.fuel_rate_l_h * dt_s / 3600)
        charges = self.running and self.alternator
        self._drained_v = max(0.0, self._drained_v - DRAIN_V_S * dt_s * 5) if charges else self._drained_v + DRAIN_V_S * dt_s
        if self.leaks:
            self._coolant_l = max(0.0, self._coolant_l - LEAK_L_S * dt_s)
        dry = self._coolant_l < COOLANT_LOW_L
        target_c, tau_s = (DRY_C if dry else WORKING_C, DRY_TAU_S) if self.running else (AMBIENT_C, 10 * WARM_TAU_S)
        self.coolant_c += (target_c - self.coolant_c) * dt_s / tau_s
        if abs(self.coolant_c - target_c) < 0.01:
            self.coolant_c = target_c
