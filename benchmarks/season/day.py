"""One day: a machine at work in virtual time with level 1 beside it, what breaks on it, and the judgement of what level 1 said."""
from __future__ import annotations

import hashlib
import os
import time
from collections import Counter
from collections.abc import Sequence
from functools import cache
from random import Random

import msgspec

from benchmarks.season.episodes import Episodes
from benchmarks.season.oracle import LINGERS, NATURAL, TABLE
from benchmarks.season.oracle.table import Row, Symptom
from benchmarks.season.people import ROUND_NS, People
from benchmarks.season.plan import Fault, Plan, S
from benchmarks.season.world import World
from firmware_py.airblast_mission import AirblastMission
from firmware_py.codec import Codec
from firmware_py.fault import Statement
from firmware_py.mission_controller import MissionController
from firmware_py.participant import BusFrame
from firmware_py.scenario import PROGRAMS, Scenario, build
from firmware_py.sprayer_mission import SprayerMission
from firmware_py.vehicle_mission import VehicleMission
from firmware_py.virtual_bus import Simulation
from level1.catalog import Catalog
from level1.command import Order
from level1.event import Event, Output, encode
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.simulated_unit import SimulatedUnit

LOOK_NS = 50_000_000
"""The truth is looked at so often while something is broken."""
MOMENT_NS = 15 * S
"""A fault that happens in a moment may show for so long."""
OFTEN, OFTEN_S, OF = 3, 600.0, ("PilotFlameTooOften", "PilotFlameOut")
"""The alarm that counts another one."""
DANGEROUS = (("flamer", "gas_valve stuck open"), ("flamer", "gas_valve leaks"), ("flamer", "flame_sensor stuck on"),
             ("mission", "ignores repairs"))
"""Faults that are a danger of their own, whatever level 1 does: gas flows that nobody asked for or that a false flame vouches
for, or someone lights it against the rule. A sensor that sees no flame is none: the valve closes over a flame that burns."""
DANGER_NS = 25 * S
"""And so long after them: gas that has flowed is dangerous for 20 s, one flow shows as a hazard after 4.5 s (`flaming_plant`)."""
EVENING_NS = 60 * S
"""Before the end nobody fills or orders anything any more: an alarm clears some seconds after its cause is gone."""
MANY = 20


class Tally(msgspec.Struct):
    """What came of one kind of fault. unobservable: none of its symptoms lasted long enough to be reported."""

    injected: int = 0
    reported: int = 0
    unobservable: int = 0
    missed: int = 0


class DayResult(msgspec.Struct):
    """What came of a day. wrong: everything that must not be, one line each. rss_kb: memory of its process at the end, of whose
    days it was the one of number `turn`."""

    number: int
    machine: str
    hours: float
    digest: str
    frames: int = 0
    cpu_s: float = 0.0
    events: dict[str, int] = {}
    alarms: int = 0
    hazards: int = 0
    tallies: dict[str, Tally] = {}
    wrong: list[str] = []
    process: str = ""
    turn: int = 0
    rss_kb: int = 0


@cache
def _definitions(programs: tuple[str, ...]) -> tuple[Catalog, Codec]:
    """Shared by all days of one machine in a process; nothing changes them."""
    nodes = [PROGRAMS[program] for program in programs]
    files = tuple(dict.fromkeys(name for node in nodes for name in (node.DBC, *node.MORE_DBC)))
    return definitions.load(list(dict.fromkeys(("ucs.dbc", *files)))), Codec.shipped(*files)


class _Watched:
    """A fault of the day. over_ns: when it ended, None while it lasts."""

    def __init__(self, fault: Fault, row: Row):
        self.fault = fault
        self.row = row
        self.over_ns: int | None = None
        self.since: dict[int, int] = {}
        self.judged: set[int] = set()
        self.reported = False
        self.missed = False
        number = fault.statement.index or 0
        self.names = [tuple(alarm.format(n=number) for alarm in symptom.alarms) for symptom in row.symptoms]
        self.explains = {*row.may, *row.sums, *(alarm for names in self.names for alarm in names)}


class Day:
    """Runs a plan. A participant itself: it breaks and orders things, and hears the commands on the bus."""

    meddles = True

    def __init__(self, plan: Plan):
        self._plan = plan
        programs = tuple(node.program for node in plan.nodes)
        catalog, codec = _definitions(programs)
        scenario = Scenario("", 0, plan.length_ns, plan.nodes, ())
        self._nodes = build(scenario, seed=Random(plan.seed).getrandbits(48), codec=codec).nodes
        self._world = World(self._nodes, codec)
        self._people = People(plan.machine, self._world, Random(f"{plan.seed}/people"), self._carry_out)
        self._unit = SimulatedUnit(Supervisor(catalog, unit="season", start_ns=0), self._deliver)
        self._episodes = Episodes(catalog)
        self._catalog = catalog
        self._hash = hashlib.sha256()
        self._events: Counter[str] = Counter()
        self._alarms: set[str] = set()
        self._outs_s: list[float] = []
        self._raised_ns: dict[str, int] = {}
        self._wrong: list[str] = []
        self._coming = list(reversed(plan.faults))
        self._active: list[_Watched] = []
        self._recent: list[_Watched] = []
        self._past: list[_Watched] = []
        self._tallies: dict[str, Tally] = {}
        self._hazards = 0
        self._next_people_ns = 2 * S
        self._next_look_ns: int | None = None
        self._orders = 0

    def run(self) -> DayResult:
        """All of it."""
        began = time.process_time()
        simulation = Simulation([self, *self._nodes.values(), self._unit])
        simulation.run(self._plan.length_ns)
        self._end(simulation.now_ns)
        for line in self._wrong:
            self._hash.update(line.encode())
        return DayResult(
            self._plan.number, self._plan.machine, self._plan.length_ns / 3600 / S, self._hash.hexdigest(), simulation.frames,
            time.process_time() - began, dict(sorted(self._events.items())), len(self._alarms), self._hazards, self._tallies,
            self._wrong[:MANY] + ([f"and {len(self._wrong) - MANY} more"] if len(self._wrong) > MANY else []), rss_kb=_rss_kb())

    # --- participant --------------------------------------------------------------------------------------------------------

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """A command on the bus."""
        self._world.hear(t_ns, can_id, extended, data)

    def hears(self, can_id: int, extended: bool) -> bool:
        """Commands."""
        return self._world.hears(can_id, extended)

    def next_deadline(self) -> int | None:
        """The next thing that happens, or the next look at the truth."""
        times = [self._next_people_ns]
        if self._coming:
            times.append(self._coming[-1].t_ns)
        if self._next_look_ns is not None:
            times.append(self._next_look_ns)
        return min(times)

    def step(self, now_ns: int) -> list[BusFrame]:
        """Break, mend, look, order. It sends nothing."""
        self._world.now_ns = now_ns
        if self._next_look_ns is not None and self._next_look_ns <= now_ns:
            self._next_look_ns = now_ns + LOOK_NS if self._active or self._recent else None
            self._look(now_ns)
        while self._coming and self._coming[-1].t_ns <= now_ns:
            self._break(now_ns, self._coming.pop())
        if self._next_people_ns <= now_ns:
            self._next_people_ns = now_ns + ROUND_NS
            self._look_after(now_ns)
        return []

    # --- what happens -------------------------------------------------------------------------------------------------------

    def _break(self, now_ns: int, fault: Fault) -> None:
        watched = _Watched(fault, TABLE[fault.program][fault.name])
        self._tally(watched).injected += 1
        self._nodes[fault.node].inject(now_ns, fault.statement)
        if fault.until_ns is None:
            watched.fault = fault
        self._active.append(watched)
        self._next_look_ns = now_ns + LOOK_NS

    def _look(self, now_ns: int) -> None:
        for watched in [*self._active]:
            for number, symptom in enumerate(watched.row.symptoms):
                self._judge(now_ns, watched, number, symptom)
            until_ns = watched.fault.until_ns
            if now_ns >= (watched.fault.t_ns + MOMENT_NS if until_ns is None else until_ns):
                if watched.fault.ending is not None:
                    self._nodes[watched.fault.node].inject(now_ns, watched.fault.ending)
                watched.over_ns = now_ns
                self._active.remove(watched)
                self._recent.append(watched)
        for watched in [*self._recent]:
            assert watched.over_ns is not None
            if now_ns - watched.over_ns >= watched.row.tail_s * S:
                self._recent.remove(watched)
                self._past.append(watched)
                self._count(watched)

    def _judge(self, now_ns: int, watched: _Watched, number: int, symptom: Symptom) -> None:
        if number in watched.judged:
            return
        if not symptom.truth(self._world, watched.fault.statement.index or 0):
            watched.since.pop(number, None)
            return
        since_ns = watched.since.setdefault(number, now_ns)
        if now_ns - since_ns < symptom.within_s * S:
            return
        watched.judged.add(number)
        names = watched.names[number]
        if any(self._episodes.is_standing(name) or self._raised_ns.get(name, -1) >= since_ns - LOOK_NS for name in names):
            watched.reported = True
        else:
            watched.missed = True
            self._wrong.append(f"{now_ns / S:.2f} s: MISSED {' or '.join(names)}: {watched.fault.node}.{watched.fault.statement} "
                               f"since {watched.fault.t_ns / S:.2f} s, to be seen since {since_ns / S:.2f} s")

    def _count(self, watched: _Watched) -> None:
        tally = self._tally(watched)
        tally.missed += watched.missed
        tally.reported += watched.reported and not watched.missed
        tally.unobservable += not watched.reported and not watched.missed

    def _tally(self, watched: _Watched) -> Tally:
        return self._tallies.setdefault(f"{watched.fault.program}: {watched.fault.name}", Tally())

    # --- people -------------------------------------------------------------------------------------------------------------

    def _look_after(self, now_ns: int) -> None:
        for name in dict.fromkeys(self._episodes.locked):
            self._order(now_ns, "reset", name)
        if any(self._catalog.alarms[name].latch for name in self._episodes.standing):
            self._order(now_ns, "acknowledge", "")
        if now_ns < self._plan.length_ns - EVENING_NS:
            self._people.look()

    def _order(self, now_ns: int, name: str, target: str) -> None:
        self._orders += 1
        self._unit.command(now_ns, Order(str(self._orders), name, target, origin="local"))

    def _carry_out(self, node: str, device: str, action: str, index: int | None) -> None:
        one, said = self._nodes[node], Statement(device, index, action)
        if isinstance(one, (MissionController, SprayerMission, AirblastMission, VehicleMission)):
            one.order(self._world.now_ns, said)
        else:
            one.inject(self._world.now_ns, said)

    # --- judgement ----------------------------------------------------------------------------------------------------------

    def _deliver(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, Event):
                self._hash.update(encode(output))
                self._events[output.event] += 1
                self._episodes.take(output)
                if output.event == "raised":
                    self._raised(output)

    def _raised(self, event: Event) -> None:
        alarm, now_ns = event.alarm, round(event.t * S)
        self._world.now_ns = now_ns
        self._alarms.add(alarm)
        self._raised_ns[alarm] = now_ns
        if alarm == OF[1]:
            self._outs_s = [*self._outs_s[1 - OFTEN:], float(event.t)]
        explained = False
        for watched in (*self._active, *self._recent):
            if alarm in watched.explains:
                explained = True
                watched.reported |= any(alarm in names for names in watched.names)
        explained |= self._left_behind(alarm)
        if alarm == OF[0]:
            explained = len(self._outs_s) >= OFTEN and self._outs_s[-1] - self._outs_s[0] <= OFTEN_S
        if not explained and not (alarm in NATURAL and NATURAL[alarm](self._world)):
            broken = ", ".join(f"{one.fault.node}.{one.fault.statement}" for one in (*self._active, *self._recent))
            self._wrong.append(f"{event.t:.2f} s: FALSE {alarm} ({broken or 'nothing is broken'}): {event.values}")

    def _left_behind(self, alarm: str) -> bool:
        """Whether it is a symptom, to be seen now, of what was broken before, or sums one up."""
        return any((alarm in names or alarm in past.row.sums) and symptom.remains
                   and symptom.truth(self._world, past.fault.statement.index or 0)
                   for past in self._past for names, symptom in zip(past.names, past.row.symptoms, strict=True))

    def _end(self, now_ns: int) -> None:
        self._world.now_ns = now_ns
        for watched in (*self._active, *self._recent):
            self._count(watched)
        self._wrong += [f"EPISODE {line}" for line in self._episodes.wrong]
        lasting = {alarm for watched in (*self._active, *self._recent) for alarm in watched.explains}
        self._wrong += [f"STANDS {name} at the end of the day, without a reason" for name in self._episodes.standing
                        if name not in lasting and not self._left_behind(name) and name != OF[0]
                        and not any(name in reasons and reasons[name](self._world) for reasons in (NATURAL, LINGERS))]
        for node, plant in ((name, one) for name, one in self._nodes.items() if hasattr(one, "hazards")):
            for hazard in plant.hazards:
                dangers = [fault for fault in self._plan.faults if (fault.node, fault.name) in DANGEROUS
                           and fault.t_ns <= hazard.t_ns <= (fault.until_ns or fault.t_ns) + DANGER_NS]
                self._hazards += 1
                if not dangers:
                    self._wrong.append(f"{hazard.t_ns / S:.2f} s: HAZARD {node}: {hazard.what}")


def _rss_kb() -> int:
    """Memory of this process that is in use now."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024
