"""`ucs demo`: the whole chain on this machine alone, told as it happens.

A simulated flaming tool and mission controller on a simulated bus; level 1 with its journal; the bridge; an MQTT broker; a
level-2 receiver. Only the tractor is simulated, and only its time: it runs `PURGE_SPEED` times faster than real while a
repair waits, and as fast as the computer can between the two acts. Nothing of the shipped definitions is shortened.
"""
from __future__ import annotations

import queue
import sys
import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bridge.delivered import delivered_path, delivered_upto
from firmware_py.participant import Happening
from firmware_py.scenario import build
from firmware_py.virtual_bus import Simulation
from level1.catalog import LOCKED_OUT, Catalog
from level1.event import Event, Monitor, Output, seconds
from level1.expression import WaitStep
from level1.io import definitions
from level1.io.inbox import Inbox
from level1.io.journal import Journal, read_events
from level1.io.live import encode_state
from level1.supervisor import Supervisor
from level2.store import Arrival
from ucs.forwarding import Forwarding
from ucs.render import WORDS, detail, painted, wants_colour
from ucs.simulate import load
from ucs.simulated_unit import SimulatedUnit
from ucs.uplink import Uplink

UNIT, FLEET, ALARM, MONITOR = "tractor-7", "north-farm", "PilotFlameOut", "implement"
SCENARIO, DBC = "demo.toml", "flaming_tool.dbc"
SECOND = 10**9
SLICE_S = 0.04
"""Real time between two looks at what happened."""
PURGE_SPEED = 6.0
FAST_SLICE_NS = 5 * SECOND
"""Virtual time at a stretch when it runs as fast as it can."""
SECOND_ACT_NS = 946 * SECOND
"""The budget is three attempts in 15 min: by now the first act's one counts no more."""
EPILOGUE_NS = 2 * SECOND
PERIOD_NS = 250_000_000
PATIENCE_S = 85.0
"""It ends within this, whatever happens."""

PURGE_MARGIN_NS = SECOND
"""Closing the valve before the purge, and the check after it, are shown in real time."""
_COLOURS = {"tractor": "33", "level 1": "36", "bridge": "34", "level 2": "35", "demo": "2"}


def add_parser(commands: Any) -> None:
    """The arguments of `ucs demo`."""
    parser: ArgumentParser = commands.add_parser(
        "demo", help="a simulated tractor loses its pilot flame, told as it happens",
        description="No hardware, no broker, no root: a simulated tractor with a flaming tool loses its pilot flame. Level 1 finds "
                    "it, lights it again and tells level 2; later, with a dead igniter, it gives up into the safe state. "
                    "Ends by itself after about a minute.")
    parser.add_argument("--faster", type=float, default=1.0, metavar="N", help="everything N times faster (1 to 50)")


def run(args: Namespace) -> int:
    """Play both acts; 1 when what should have happened did not."""
    faster = min(max(args.faster, 1.0), 50.0)
    story = Story(wants_colour(sys.stdout))
    with TemporaryDirectory(prefix="ucs-demo-") as folder:
        with ExitStack() as stack:
            play = Play(Path(folder), story, stack)
            story.open(faster)
            play.act(faster)
            play.deliver()
        problems = list(play.problems())
        story.tell_queued()
        print(play.summary(), flush=True)
    for problem in problems:
        print(f"ucs: demo: {problem}", file=sys.stderr)
    return 1 if problems else 0


class Story:
    """What is told: time of the tractor, who speaks, what. `queue` may be called by any thread, the rest by one."""

    def __init__(self, colour: bool):
        self._colour = colour
        self._queued: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self.now_ns = 0

    def open(self, faster: float) -> None:
        """Who takes part, and how time runs."""
        pace = f" Everything runs {faster:g} times faster." if faster != 1 else ""
        print(painted("A tractor with a flaming tool, its level 1, and level 2", "1", self._colour),
              "tractor   simulated: flaming tool and mission controller on a CAN bus; its time stands on the left",
              "level 1   supervises it: alarms and repairs as flaming_tool.dbc defines them; a journal on disk",
              "bridge    carries the journal's events to level 2 over MQTT (embedded broker, this machine only)",
              "level 2   a receiver that stores each event, and only then acknowledges it",
              f"While a repair waits, the tractor's time runs {PURGE_SPEED:g} times faster than real.{pace}", sep="\n", flush=True)

    def chapter(self, title: str) -> None:
        """A headline."""
        print(f"\n{painted(title, '1', self._colour)}", flush=True)

    def tell(self, who: str, text: str) -> None:
        """One line."""
        stamp = painted(f"{self.now_ns / 1e9:8.1f} s", "2", self._colour)
        print(f"{stamp}  {painted(f'{who:<8}', _COLOURS[who], self._colour)}  {text}", flush=True)

    def more(self, text: str) -> None:
        """A line that belongs to the one before."""
        print(f"{'':22}{text}", flush=True)

    def queue(self, who: str, text: str) -> None:
        """A line from another thread, told with the next `tell_queued`."""
        self._queued.put((who, text))

    def tell_queued(self) -> None:
        """What other threads had to say."""
        while not self._queued.empty():
            self.tell(*self._queued.get())


class Play:
    """The whole chain, composed. Its parts end with the stack."""

    def __init__(self, folder: Path, story: Story, stack: ExitStack):
        self.story = story
        self.began_s = time.monotonic()
        self.events: list[Event] = []
        self._journal_path = folder / "journal.db"
        self._fresh: list[Event] = []
        self._monitors: dict[str, Monitor] = {}
        self._published_s = 0.0
        self._purge_ns = (0, 0)
        self._steps_told = self._purge_told = False
        self._acknowledged = 0
        catalog = definitions.load([DBC])
        self._wait_ns = _wait_ns(catalog)
        self.journal = stack.enter_context(Journal(self._journal_path, UNIT))
        self.uplink = stack.enter_context(Uplink(self.journal, Inbox(), time.monotonic_ns))
        self.forwarding = stack.enter_context(Forwarding(
            self._journal_path, UNIT, FLEET, folder / "level2.db", self._received,
            say=lambda text: story.queue("level 2", text), say_bridge=lambda text: story.queue("bridge", text)))
        self.supervisor = Supervisor(catalog, unit=UNIT, boot=self.journal.boot, start_ns=0, monitor_ns=PERIOD_NS)
        unit = SimulatedUnit(self.supervisor, self._take)
        self.simulation = Simulation([*build(load(SCENARIO)).participants, unit], on_happening=self._happened)

    # --- what happens -----------------------------------------------------------------------------------------------------

    def _happened(self, happening: Happening) -> None:
        """The tractor tells; of burners only when all have the same."""
        burners = happening.text.removeprefix("burners ").split()
        if happening.text.startswith("burners ") and len(set(burners)) > 1 or self._is_between_acts:
            return
        self.story.now_ns = happening.t_ns
        name = {"flamer": "flaming tool", "mission": "mission controller"}.get(happening.who, happening.who)
        if happening.text.startswith("fault: "):
            self.story.tell("demo", f"fault injected: {name} {happening.text.removeprefix('fault: ')}")
        else:
            self.story.tell("tractor", f"{name}: {happening.text}")

    def _take(self, outputs: Sequence[Output]) -> None:
        """What the supervisor gives: into the journal before anything else happens with it."""
        events = [output for output in outputs if isinstance(output, Event)]
        if events:
            self.journal.append(events, encode_state(self.supervisor.state()))
        self._monitors.update({output.message: output for output in outputs if isinstance(output, Monitor)})
        for event in events:
            self._tell_event(event)
        self.events += events
        self._fresh += events

    def _tell_event(self, event: Event) -> None:
        self.story.now_ns = int(event.t * SECOND)
        if event.event != "repair_started":
            self.story.tell("level 1", _columns(event.alarm, event.event, detail(event)))
            return
        self.story.tell("level 1", _columns(event.alarm, event.event, f"attempt {event.attempt}{':' * (not self._steps_told)}"))
        if not self._steps_told:
            for step in event.text.split(";"):
                self.story.more(step.strip())
            self._steps_told = True
        start = self.story.now_ns
        self._purge_ns = (start + PURGE_MARGIN_NS, start + self._wait_ns - PURGE_MARGIN_NS)
        self._purge_told = False

    def _received(self, arrival: Arrival) -> None:
        """Level 2 has stored and acknowledged an event; called in its thread."""
        alarm = arrival.alarm
        self.story.queue("level 2", _columns(alarm.alarm, alarm.event, f"event {alarm.seq} of {alarm.unit}, stored"))

    # --- time -------------------------------------------------------------------------------------------------------------

    def act(self, faster: float) -> None:
        """Let the tractor's time run until the second act has ended, or patience has."""
        self.story.chapter("1  Wind blows the pilot flame out")
        last_s = time.monotonic()
        while not self._has_ended and time.monotonic() - self.began_s < PATIENCE_S:
            if self._is_between_acts:
                self._pass_between_acts()
                last_s = time.monotonic()
                continue
            time.sleep(SLICE_S)
            passed_s, last_s = min(time.monotonic() - last_s, 5 * SLICE_S), time.monotonic()
            self._run(self.simulation.now_ns + int(passed_s * faster * self._speed() * SECOND))

    def deliver(self) -> None:
        """Wait until level 2 has acknowledged everything."""
        self.forwarding.wait_delivered()
        self._tell_acknowledged()

    def _run(self, until_ns: int) -> None:
        self.simulation.run(until_ns)
        self.story.now_ns = self.simulation.now_ns
        self._hand_over()

    def _pass_between_acts(self) -> None:
        minutes = (SECOND_ACT_NS - self.simulation.now_ns) / 60 / SECOND
        self.story.tell("demo", f"{minutes:.0f} min of flaming pass, as fast as this computer can")
        while self.simulation.now_ns < SECOND_ACT_NS:
            self._run(min(self.simulation.now_ns + FAST_SLICE_NS, SECOND_ACT_NS))
        self.story.chapter("2  The wind again, and now the igniter is dead")

    @property
    def _is_between_acts(self) -> bool:
        """From a moment after the first act's last event to the second act."""
        first = [event for event in self.events if event.event == "cleared"]
        return bool(first) and first[0].t * SECOND + EPILOGUE_NS <= self.simulation.now_ns < SECOND_ACT_NS

    @property
    def _has_ended(self) -> bool:
        """A moment after the lock-out."""
        last = [event for event in self.events if event.event == "locked_out"]
        return bool(last) and self.simulation.now_ns >= last[0].t * SECOND + EPILOGUE_NS

    def _speed(self) -> float:
        """Virtual seconds a real one; told when it changes."""
        begin_ns, end_ns = self._purge_ns
        if not begin_ns <= self.simulation.now_ns < end_ns:
            return 1.0
        if not self._purge_told:
            self._purge_told = True
            self.story.tell("demo", f"the purge takes its {self._wait_ns // SECOND} s: {PURGE_SPEED:g} times faster until it ends")
        return PURGE_SPEED

    def _hand_over(self) -> None:
        """To the bridge, as `ucs run` does; and tell what came back."""
        due = time.monotonic() - self._published_s >= PERIOD_NS / SECOND
        monitors = tuple(self._monitors.values()) if due else ()
        if due:
            self._published_s = time.monotonic()
        self.uplink.publish(self._fresh, monitors)
        self._fresh = []
        self._tell_acknowledged()

    def _tell_acknowledged(self) -> None:
        """What level 2 had to say, and up to where the bridge may forget."""
        upto = delivered_upto(delivered_path(self._journal_path)).get(self.journal.boot, 0)
        self.story.tell_queued()
        if upto > self._acknowledged:
            number = upto - self._acknowledged
            self.story.tell("bridge", f"{number} event{'s' * (number != 1)} delivered: level 2 has acknowledged")
            self._acknowledged = upto

    # --- the end ----------------------------------------------------------------------------------------------------------

    def problems(self) -> Iterator[str]:
        """What should have happened and did not; after all parts have ended."""
        counts = Counter(event.event for event in self.events if event.alarm == ALARM)
        for word, number in (("repaired", 1), ("cleared", 1), ("repair_failed", 3), ("locked_out", 1)):
            if counts[word] != number:
                yield f"{ALARM} {WORDS[word]} {counts[word]} times instead of {number}"
        stored = read_events(self._journal_path)
        if [(event.boot, event.seq) for event in stored] != [(event.boot, event.seq) for event in self.events]:
            yield f"the journal holds {len(stored)} of {len(self.events)} events"
        if self._acknowledged < len(self.events):
            yield f"level 2 has acknowledged {self._acknowledged} of {len(self.events)} events"
        if not self._is_safe:
            yield "the gas valve is not closed"

    @property
    def _is_safe(self) -> bool:
        """Locked out, and the tool reports its gas valve closed."""
        monitor = self._monitors.get(MONITOR)
        return (self.supervisor.alarm_states()[ALARM] == LOCKED_OUT and monitor is not None
                and monitor.values.get("GasValve") == "Closed")

    def summary(self) -> str:
        """One line."""
        counts = Counter(event.event for event in self.events)
        valve = "closed" if self._is_safe else "not closed"
        return (f"\n{counts['raised']} alarms: {counts['repaired']} repaired, {counts['locked_out']} locked out with the gas "
                f"valve {valve}; {self._acknowledged} of {len(self.events)} events acknowledged by level 2; "
                f"{seconds(self.simulation.now_ns):.0f} s of the tractor's time in {time.monotonic() - self.began_s:.0f} s")


def _wait_ns(catalog: Catalog) -> int:
    """How long the repair waits in all."""
    repair = catalog.alarms[ALARM].repair
    return sum(step.duration_ns for step in repair.steps if isinstance(step, WaitStep)) if repair else 0


def _columns(alarm: str, event: str, text: str) -> str:
    return f"{alarm:<14} {WORDS[event]:<14} {text}".rstrip()
