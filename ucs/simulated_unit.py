"""Level 1 as a participant of a simulated bus: the supervisor that `ucs run` drives, in virtual time."""
from __future__ import annotations

from collections.abc import Callable, Sequence

from firmware_py.participant import BusFrame
from level1.command import Order
from level1.event import Output, Send
from level1.frame import EXTENDED, Frame
from level1.supervisor import Supervisor


class SimulatedUnit:
    """Hears every frame, sends what the supervisor sends. deliver: called with what came out, before its frames leave."""

    def __init__(self, supervisor: Supervisor, deliver: Callable[[Sequence[Output]], None]):
        self.supervisor = supervisor
        self._deliver = deliver
        self._frames: list[BusFrame] = []

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """A frame for the supervisor."""
        outputs = self.supervisor.receive(Frame(t_ns, can_id | EXTENDED if extended else can_id, data))
        if outputs:
            self._take(outputs)

    def command(self, t_ns: int, order: Order) -> None:
        """An order of somebody at the machine, or from above."""
        self._take(self.supervisor.command(order, t_ns))

    def step(self, now_ns: int) -> list[BusFrame]:
        """Time for the supervisor; gives its frames."""
        deadline = self.supervisor.next_deadline()
        if deadline is not None and deadline <= now_ns:
            self._take(self.supervisor.tick(now_ns))
        frames, self._frames = self._frames, []
        return frames

    def next_deadline(self) -> int | None:
        """At once while frames wait to be sent."""
        return 0 if self._frames else self.supervisor.next_deadline()

    def _take(self, outputs: Sequence[Output]) -> None:
        if outputs:
            self._deliver(outputs)
            self._frames.extend(BusFrame(output.key & 0x1FFFFFFF, bool(output.key & EXTENDED), output.data)
                                for output in outputs if isinstance(output, Send))
