"""How fast virtual time passes: tractor with sprayer boom over the whole field, with level 1 and without, on one core.

    python -m benchmarks.simulation [--rounds N]

Prints the median of CPU time; the same traffic in every round, so a difference is the machine's.
"""
from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from statistics import median

from firmware_py.scenario import build
from firmware_py.virtual_bus import Simulation
from level1.event import Event, Output
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.simulate import load
from ucs.simulated_unit import SimulatedUnit

SCENARIO = "vehicle_sprayer.toml"
FILES = ("ucs.dbc", "vehicle.dbc", "isobus_tractor.dbc", "sprayer_boom.dbc")
MONITOR_NS = 250_000_000


def mission(supervised: bool) -> tuple[float, float, int, int]:
    """One run: virtual seconds, CPU seconds, frames, events."""
    scenario = load(SCENARIO)
    events: list[Event] = []

    def deliver(outputs: Sequence[Output]) -> None:
        events.extend(output for output in outputs if isinstance(output, Event))
    unit = SimulatedUnit(Supervisor(definitions.load(FILES), unit="tractor-7", start_ns=0, monitor_ns=MONITOR_NS), deliver)
    simulation = Simulation([*build(scenario).participants, *([unit] if supervised else [])])
    began = time.process_time()
    simulation.run(scenario.duration_ns)
    return scenario.duration_ns / 1e9, time.process_time() - began, simulation.frames, len(events)


def main() -> None:
    """Both, several times in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    runs = [(mission(False), mission(True)) for _ in range(rounds)]
    for name, column in (("nodes and bus", 0), ("with level 1", 1)):
        virtual_s, _, frames, events = runs[0][column]
        cpu_s = median(run[column][1] for run in runs)
        print(f"{name:<14} {virtual_s:g} s in {cpu_s:.2f} s of CPU: {virtual_s / cpu_s:.0f} x real time, "
              f"{frames / cpu_s:,.0f} frames/s, {events} events")


if __name__ == "__main__":
    main()
