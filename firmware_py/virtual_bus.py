"""A CAN bus and its participants in virtual time: an event loop that jumps from deadline to deadline. No I/O, no clock, no chance.

Theory of operation. The bus carries one frame at a time, for as long as its bits take (stuff bits aside). When it is idle, the
waiting frame with the lowest identifier wins, as arbitration has it; frames of one identifier keep their order. A frame reaches
everybody but its sender at its end. At one moment first the frame that ended is heard, then all participants that are due step in
the order in which they were added, then the next frame starts: the same participants give the same run, byte for byte.
"""
from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Sequence

from firmware_py.participant import BusFrame, Happening, Meddler, Participant, Selective, Storyteller

BITRATE = 250_000
"""bit/s, as the implement bus of ISO 11783."""
STANDARD_BITS, EXTENDED_BITS = 47, 67
"""Bits of a data frame without its payload and stuff bits, with the 3 bits between frames (ISO 11898-1)."""
BUSY_STEPS = 10_000
"""A participant that is still due after so many steps at one moment never will be done."""
AUDIENCES_KEPT = 4096
"""Identifiers of which it is remembered who hears them."""

FrameListener = Callable[[int, BusFrame], None]
StoryListener = Callable[[Happening], None]
_NEVER = 1 << 80
"""Deadline of a participant that wants no step."""


class _Place:
    """A participant's place on the bus. due: its deadline as it last told it."""

    __slots__ = ("due", "hears", "meddles", "next_deadline", "participant", "receive", "step", "stories")

    def __init__(self, participant: Participant):
        self.participant = participant
        self.receive = participant.receive
        self.step = participant.step
        self.next_deadline = participant.next_deadline
        self.stories = participant.take_happenings if isinstance(participant, Storyteller) else None
        self.hears = participant.hears if isinstance(participant, Selective) else None
        self.meddles = isinstance(participant, Meddler)
        self.due = 0

    def ask(self) -> None:
        """Its deadline may have moved."""
        due = self.next_deadline()
        self.due = _NEVER if due is None else due


_Audience = tuple[tuple[_Place, ...], tuple[_Place, ...]]
"""Who hears a frame, and which of them may have a story to tell."""


class Simulation:
    """The bus with its participants. now_ns: where it has come to. frames: carried so far.

    on_frame(t_ns, frame) is called at the end of each frame, on_happening(happening) for each thing that participants tell.
    A participant is asked for its deadline after its own calls, after each step of a `Meddler`, and whenever `run` begins.
    """

    def __init__(self, participants: Iterable[Participant] = (), *, start_ns: int = 0, bitrate: int = BITRATE,
                 on_frame: FrameListener | None = None, on_happening: StoryListener | None = None):
        self.now_ns = start_ns
        self.frames = 0
        self.on_frame = on_frame
        self.on_happening = on_happening
        self._bit_ns = 1_000_000_000 // bitrate
        self._places: list[_Place] = []
        self._audiences: dict[tuple[int, bool, int], _Audience] = {}
        self._waiting: list[tuple[int, int, BusFrame, _Place]] = []
        self._carried: tuple[int, BusFrame, _Place] | None = None
        self._order = 0
        for participant in participants:
            self.attach(participant)

    def attach(self, participant: Participant) -> None:
        """Add a participant; from now on it hears and is stepped."""
        place = _Place(participant)
        place.ask()
        self._places = [*self._places, place]
        self._audiences.clear()

    def detach(self, participant: Participant) -> None:
        """Remove one, as if its plug were pulled; what it had ready to send is lost. Raises ValueError when it isn't there."""
        gone = next((place for place in self._places if place.participant is participant), None)
        if gone is None:
            raise ValueError("this participant is not attached")
        self._places = [place for place in self._places if place is not gone]
        self._audiences.clear()
        self._waiting = [waiting for waiting in self._waiting if waiting[3] is not gone]
        heapq.heapify(self._waiting)

    def run(self, until_ns: int) -> None:
        """Let time pass up to and including `until_ns`. May be called again and again."""
        same, last_ns = 0, -1
        for place in self._places:
            place.ask()
        stirred = True
        while True:
            t_ns = self._carried[0] if self._carried is not None else _NEVER
            for place in self._places:
                if place.due < t_ns:
                    t_ns = place.due
            if t_ns < self.now_ns:
                t_ns = self.now_ns
            if t_ns > until_ns:
                break
            self.now_ns = t_ns
            if t_ns != last_ns:
                same, last_ns = 0, t_ns
            else:
                same += 1
                if same > BUSY_STEPS:
                    raise RuntimeError(f"a participant asks to be stepped again and again at {t_ns / 1e9:.9f} s")
            self._moment(t_ns, stirred)
            stirred = False
        self.now_ns = max(self.now_ns, until_ns)

    def _moment(self, t_ns: int, stirred: bool) -> None:
        """stirred: something may have happened to anybody since the last moment."""
        places = self._places
        tellers: Sequence[_Place] = ()
        if self._carried is not None and self._carried[0] <= t_ns:
            tellers = self._deliver(t_ns)
        for place in places:
            if place.due > t_ns:
                continue
            for frame in place.step(t_ns):
                self._order += 1
                heapq.heappush(self._waiting, (_rank(frame), self._order, frame, place))
            if place.meddles:
                stirred = True
                for other in places:
                    other.ask()
            else:
                due = place.next_deadline()
                place.due = _NEVER if due is None else due
            if place.stories is not None:
                stirred |= bool(tellers)
                tellers = (*tellers, place)
        if self._carried is None and self._waiting:
            _, _, frame, sender = heapq.heappop(self._waiting)
            bits = (EXTENDED_BITS if frame[1] else STANDARD_BITS) + 8 * len(frame[2])
            self._carried = (t_ns + bits * self._bit_ns, frame, sender)
        if stirred or tellers:
            self._tell(places if stirred else tellers)

    def _deliver(self, t_ns: int) -> Sequence[_Place]:
        """The frame that ended is heard; gives those who may have a story to tell of it."""
        assert self._carried is not None
        _, frame, sender = self._carried
        self._carried = None
        self.frames += 1
        if self.on_frame is not None:
            self.on_frame(t_ns, frame)
        can_id, extended, data = frame
        try:
            audience, tellers = self._audiences[can_id, extended, id(sender)]
        except KeyError:
            audience, tellers = self._find_audience(can_id, extended, sender)
        for place in audience:
            place.receive(t_ns, can_id, extended, data)
            due = place.next_deadline()
            place.due = _NEVER if due is None else due
        return tellers

    def _find_audience(self, can_id: int, extended: bool, sender: _Place) -> _Audience:
        audience = tuple(place for place in self._places
                         if place is not sender and (place.hears is None or place.hears(can_id, extended)))
        if len(self._audiences) >= AUDIENCES_KEPT:
            self._audiences.clear()
        known = self._audiences[can_id, extended, id(sender)] = (audience, tuple(place for place in audience if place.stories))
        return known

    def _tell(self, tellers: Iterable[_Place]) -> None:
        for place in tellers:
            if place.stories is not None:
                for happening in place.stories():
                    if self.on_happening is not None:
                        self.on_happening(happening)


def _rank(frame: BusFrame) -> int:
    """Arbitration: the lower wins; a standard frame wins against an extended one with the same first 11 bits."""
    can_id, extended, _ = frame
    if extended:
        return can_id >> 18 << 19 | 1 << 18 | can_id & 0x3FFFF
    return can_id << 19
