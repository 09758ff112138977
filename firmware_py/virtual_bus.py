"""A CAN bus and its participants in virtual time: an event loop that jumps from deadline to deadline. No I/O, no clock, no chance.

Theory of operation. The bus carries one frame at a time, for as long as its bits take (stuff bits aside). When it is idle, the
waiting frame with the lowest identifier wins, as arbitration has it; frames of one identifier keep their order. A frame reaches
everybody but its sender at its end. At one moment first the frame that ended is heard, then all participants that are due step in
the order in which they were added, then the next frame starts: the same participants give the same run, byte for byte.
"""
from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable

from firmware_py.participant import BusFrame, Happening, Participant, Storyteller

BITRATE = 250_000
"""bit/s, as the implement bus of ISO 11783."""
STANDARD_BITS, EXTENDED_BITS = 47, 67
"""Bits of a data frame without its payload and stuff bits, with the 3 bits between frames (ISO 11898-1)."""
BUSY_STEPS = 10_000
"""A participant that is still due after so many steps at one moment never will be done."""

FrameListener = Callable[[int, BusFrame], None]
StoryListener = Callable[[Happening], None]


class Simulation:
    """The bus with its participants. now_ns: where it has come to. frames: carried so far.

    on_frame(t_ns, frame) is called at the end of each frame, on_happening(happening) for each thing that participants tell.
    """

    def __init__(self, participants: Iterable[Participant] = (), *, start_ns: int = 0, bitrate: int = BITRATE,
                 on_frame: FrameListener | None = None, on_happening: StoryListener | None = None):
        self.now_ns = start_ns
        self.frames = 0
        self.on_frame = on_frame
        self.on_happening = on_happening
        self._bit_ns = 1_000_000_000 // bitrate
        self._participants: list[Participant] = []
        self._storytellers: list[Storyteller] = []
        self._waiting: list[tuple[int, int, BusFrame, Participant]] = []
        self._carried: tuple[int, BusFrame, Participant] | None = None
        self._order = 0
        for participant in participants:
            self.attach(participant)

    def attach(self, participant: Participant) -> None:
        """Add a participant; from now on it hears and is stepped."""
        self._participants.append(participant)
        if isinstance(participant, Storyteller):
            self._storytellers.append(participant)

    def detach(self, participant: Participant) -> None:
        """Remove one, as if its plug were pulled; what it had ready to send is lost. Raises ValueError when it isn't there."""
        self._participants.remove(participant)
        if isinstance(participant, Storyteller):
            self._storytellers.remove(participant)
        self._waiting = [waiting for waiting in self._waiting if waiting[3] is not participant]
        heapq.heapify(self._waiting)

    def run(self, until_ns: int) -> None:
        """Let time pass up to and including `until_ns`. May be called again and again."""
        same, last_ns = 0, -1
        while (t_ns := self._next_ns()) is not None and t_ns <= until_ns:
            self.now_ns = t_ns
            same = same + 1 if t_ns == last_ns else 0
            last_ns = t_ns
            if same > BUSY_STEPS:
                raise RuntimeError(f"a participant asks to be stepped again and again at {t_ns / 1e9:.9f} s")
            self._moment(t_ns)
        self.now_ns = max(self.now_ns, until_ns)

    def _next_ns(self) -> int | None:
        earliest = self._carried[0] if self._carried is not None else None
        for participant in self._participants:
            deadline = participant.next_deadline()
            if deadline is not None and (earliest is None or deadline < earliest):
                earliest = deadline
        return earliest if earliest is None or earliest > self.now_ns else self.now_ns

    def _moment(self, t_ns: int) -> None:
        if self._carried is not None and self._carried[0] <= t_ns:
            self._deliver(t_ns)
        for participant in self._participants:
            deadline = participant.next_deadline()
            if deadline is not None and deadline <= t_ns:
                for frame in participant.step(t_ns):
                    self._order += 1
                    heapq.heappush(self._waiting, (_rank(frame), self._order, frame, participant))
        if self._carried is None and self._waiting:
            _, _, frame, sender = heapq.heappop(self._waiting)
            self._carried = (t_ns + self._duration_ns(frame), frame, sender)
        for storyteller in self._storytellers:
            for happening in storyteller.take_happenings():
                if self.on_happening is not None:
                    self.on_happening(happening)

    def _deliver(self, t_ns: int) -> None:
        assert self._carried is not None
        _, frame, sender = self._carried
        self._carried = None
        self.frames += 1
        if self.on_frame is not None:
            self.on_frame(t_ns, frame)
        for participant in self._participants:
            if participant is not sender:
                participant.receive(t_ns, *frame)

    def _duration_ns(self, frame: BusFrame) -> int:
        return ((EXTENDED_BITS if frame.extended else STANDARD_BITS) + 8 * len(frame.data)) * self._bit_ns


def _rank(frame: BusFrame) -> int:
    """Arbitration: the lower wins; a standard frame wins against an extended one with the same first 11 bits."""
    if frame.extended:
        return frame.can_id >> 18 << 19 | 1 << 18 | frame.can_id & 0x3FFFF
    return frame.can_id << 19
