"""Participants on a real bus in real time, through any interface of python-can. One thread, one loop; the caller gives the clock.

A bus that is lost (link down, adapter unplugged) is opened again and again while the participants go on living: their commands
stop, their valves close, and they resume when it is back. Frames that nobody could hear in between are dropped, never sent late.
"""
from __future__ import annotations

import errno
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

import can

from firmware_py.participant import BusFrame, Participant, Storyteller
from firmware_py.virtual_bus import FrameListener, StoryListener

RETRY_NS = 500_000_000
"""Between two attempts to open a lost bus."""
LONGEST_WAIT_NS = 100_000_000
BATCH = 64
"""Frames read at most between two steps, so that a babbling bus does not stop the nodes."""
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_OPEN_ERRORS = (can.CanError, OSError, ValueError, ImportError, NotImplementedError)


class BusLost(Exception):
    """The bus can't be opened, or did not come back in time; the text says which and why."""


class Clock(Protocol):
    """Monotonic time of the caller."""

    def now_ns(self) -> int:
        """Nanoseconds since the nodes were started."""

    def sleep(self, duration_ns: int) -> None:
        """Wait."""


class LiveBus:
    """The participants on one bus.

    open_bus: opens it, as `can.Bus` does. name: what to call it in a message. patience_ns: a lost bus may stay away so long.
    tell(t_ns, text): what happens to the bus. frames: sent and heard; dropped: not sent because a queue was full.
    echoes: one hears one's own frames there (udp_multicast), as on no CAN controller; they are left out.
    """

    def __init__(self, open_bus: Callable[[], can.BusABC], name: str, participants: Iterable[Participant], clock: Clock,
                 tell: Callable[[int, str], None], *, patience_ns: int, on_frame: FrameListener | None = None,
                 on_happening: StoryListener | None = None, echoes: bool = False):
        self.frames = 0
        self.dropped = 0
        self._open_bus = open_bus
        self._name = name
        self._participants = list(participants)
        self._storytellers = [participant for participant in self._participants if isinstance(participant, Storyteller)]
        self._clock = clock
        self._tell = tell
        self._patience_ns = patience_ns
        self._on_frame = on_frame
        self._on_happening = on_happening
        self._own: deque[BusFrame] = deque(maxlen=BATCH if echoes else 0)
        self._bus: can.BusABC | None = None
        self._lost_ns: int | None = None
        self._retry_ns = 0

    def run(self, until_ns: int) -> None:
        """Live until then. Raises BusLost when the bus can't be opened at the start, or stays away."""
        try:
            self._bus = self._open_bus()
        except _OPEN_ERRORS as error:
            raise BusLost(f"bus {self._name} can't be opened: {error}") from error
        try:
            while (now_ns := self._clock.now_ns()) < until_ns:
                self._step(now_ns)
                self._listen(until_ns)
                self._recover()
        finally:
            self._close()

    def _step(self, now_ns: int) -> None:
        """Step who is due; what one sends, the others in this process hear as everybody on the bus does."""
        for participant in self._participants:
            deadline = participant.next_deadline()
            if deadline is not None and deadline <= now_ns:
                for frame in participant.step(now_ns):
                    if self._send(now_ns, frame):
                        self._hear(now_ns, frame, participant)
        for storyteller in self._storytellers:
            for happening in storyteller.take_happenings():
                if self._on_happening is not None:
                    self._on_happening(happening)

    def _hear(self, now_ns: int, frame: BusFrame, sender: Participant | None) -> None:
        self.frames += 1
        if self._on_frame is not None:
            self._on_frame(now_ns, frame)
        for participant in self._participants:
            if participant is not sender:
                participant.receive(now_ns, *frame)

    def _wait_ns(self, until_ns: int) -> int:
        deadlines = [deadline for participant in self._participants if (deadline := participant.next_deadline()) is not None]
        now_ns = self._clock.now_ns()
        return max(0, min(min(deadlines, default=until_ns), until_ns, now_ns + LONGEST_WAIT_NS) - now_ns)

    def _listen(self, until_ns: int) -> None:
        wait_ns = self._wait_ns(until_ns)
        if self._bus is None:
            self._clock.sleep(wait_ns)
            return
        try:
            for _ in range(BATCH):
                message = self._bus.recv(wait_ns / 1e9)
                if message is None:
                    return
                wait_ns = 0
                if not (message.is_error_frame or message.is_remote_frame or message.is_fd):
                    frame = BusFrame(message.arbitration_id, message.is_extended_id, bytes(message.data))
                    if frame in self._own:
                        self._own.remove(frame)
                        continue
                    self._hear(self._clock.now_ns(), frame, None)
        except (can.CanError, OSError) as error:
            self._lose(error)

    def _send(self, now_ns: int, frame: BusFrame) -> bool:
        if self._bus is None:
            return False
        try:
            self._bus.send(can.Message(arbitration_id=frame.can_id, is_extended_id=frame.extended, data=frame.data))
        except (can.CanError, OSError) as error:
            if _is_full(error):
                self.dropped += 1
            else:
                self._lose(error)
            return False
        self._own.append(frame)
        if self._lost_ns is not None:
            self._tell(now_ns, f"bus {self._name} is back")
            self._lost_ns = None
        return True

    def _lose(self, error: Exception) -> None:
        self._close()
        now_ns = self._clock.now_ns()
        self._retry_ns = now_ns + RETRY_NS
        if self._lost_ns is None:
            self._lost_ns = now_ns
            self._tell(now_ns, f"bus {self._name} is lost ({error}); the nodes live on and try again")

    def _recover(self) -> None:
        """Open a lost bus again when it is time; only a frame that was sent proves that it is back."""
        now_ns = self._clock.now_ns()
        if self._lost_ns is not None and now_ns - self._lost_ns >= self._patience_ns:
            raise BusLost(f"bus {self._name} has been away for {self._patience_ns / 1e9:g} s: is the interface there and up?")
        if self._bus is None and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + RETRY_NS
            try:
                self._bus = self._open_bus()
            except _OPEN_ERRORS:
                return

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except (can.CanError, OSError):
                return


def _is_full(error: Exception) -> bool:
    """The sending queue is full: the bus is there, the frame is lost (ENOBUFS comes at once, python-can's own has no number)."""
    number = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return number in _FULL or "buffer full" in str(error)
