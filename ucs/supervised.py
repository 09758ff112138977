"""Level 1 beside simulated nodes: the supervisor that `ucs run` drives, on the same virtual bus, told and drawn."""
from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TextIO

from firmware_py.participant import BusFrame
from firmware_py.scenario import Cast
from level1.event import Event, Output
from level1.frame import Frame, frame_key
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs import plot
from ucs.render import event_line, wants_colour
from ucs.simulated_unit import SimulatedUnit
from ucs.trace import Trace

UNIT = "simulated"


class Supervised:
    """The unit of a simulation. participant: for the bus. Every repair is armed, as in a replay.

    files: definitions, those of the cast's nodes if there are none. picture: where to draw it. acts: it may send.
    out: standard output if none is given.
    """

    def __init__(self, cast: Cast, files: Sequence[str] = (), *, acts: bool = True, picture: str | None = None,
                 out: TextIO | None = None):
        if picture:
            plot.check(picture)
        spoken = list(dict.fromkeys(name for node in cast.nodes.values() for name in (node.DBC, *node.MORE_DBC)))
        catalog = definitions.load(list(files) or spoken)
        self.events: list[Event] = []
        self._supervisor = Supervisor(catalog, unit=UNIT, start_ns=0, armed=None if acts else (), broadcast=acts)
        self.participant = SimulatedUnit(self._supervisor, self._deliver)
        self._picture, self._out = picture, out or sys.stdout
        self._colour = wants_colour(self._out)
        self._trace = Trace(catalog, definitions.load(spoken)) if picture else None

    def on_frame(self, t_ns: int, frame: BusFrame) -> None:
        """A frame that the bus has carried, for the picture."""
        if self._trace:
            self._trace.take(t_ns, frame_key(frame.can_id, frame.extended), frame.data)

    def overhear(self, t_ns: int, frame: BusFrame) -> None:
        """A frame of a bus on which this unit does not send."""
        self.on_frame(t_ns, frame)
        self._deliver(self._supervisor.receive(Frame(t_ns, frame_key(frame.can_id, frame.extended), frame.data)))

    def end(self, now_ns: int, title: str) -> None:
        """Draw the picture. Raises OutsideError."""
        self._deliver(self._supervisor.tick(now_ns))
        if self._trace and self._picture:
            plot.draw(self._trace, self.events, self._picture, title)

    def _deliver(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, Event):
                if self._trace:
                    self.events.append(output)
                print(event_line(output, f"{output.t:10.3f} s", self._colour), file=self._out)
