"""A CAN bus, live: frames in, frames out within their time, found again when it was lost, its health reported.

Theory of operation. Each bus has one thread, which alone opens and closes the interface. Whatever goes wrong (link down,
adapter pulled out, a library's exception) it reports, closes, and opens again every `RETRY_S` until the interface is there.
A socket whose interface went away stays deaf for ever, therefore always anew.

Where the interface has a descriptor (SocketCAN) the loop's thread reads the frames itself (`fetch`): no frame changes threads.
Only when the loop is late, because the disk is, the bus's thread fetches them into the inbox, so that the kernel's buffer, small
where it may not be enlarged, does not run over. Other interfaces are read by the bus's thread, frame by frame.

Frames go out from the loop's thread, which never waits: what the interface can't take now is tried again every
`RETRY_SEND_NS`, and is dropped, counted and reported once it is past its time.
"""
from __future__ import annotations

import contextlib
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Protocol

from level1.bus_health import BITS_A_FRAME, WINDOW_NS, BusHealth, Report, Traffic
from level1.event import Send
from level1.frame import Frame, Row
from level1.io import socketcan
from level1.io.config import Bus
from level1.io.inbox import Inbox
from level1.io.listening import Listening
from level1.io.socketcan import BusError, Filter, SocketCan

__all__ = ["BusError", "Interface", "Port", "check_bus", "check_name", "open_bus"]

TICK_S = 0.05
"""So often a bus's thread looks after its interface. A loop that has not fetched in between is late."""
RETRY_S = 0.25
RETRY_SEND_NS = 1_000_000
WAITING_SENDS = 200
"""Frames that wait for an interface at most; the oldest is dropped first."""
MOST_FRAMES = 100_000
"""Frames that are looked at in a window."""


class Interface(Protocol):
    """An open interface: `SocketCan` or `python_can.PythonCan`. Raises OSError, or what its driver raises, when it is lost.

    impossible: frames that can't be, so far.
    """

    impossible: int

    @property
    def lost(self) -> int:
        """Frames dropped on the way to here since it was opened."""

    @property
    def last_ns(self) -> int | None:
        """When the last frame came."""

    def fileno(self) -> int | None:
        """The descriptor that becomes readable; None: `receive` waits by itself."""

    def receive(self, bus: int) -> Sequence[Row]:
        """The frames that have come."""

    def errors(self, bus: int) -> list[Frame]:
        """The error message frames that have come."""

    def listen(self, filters: Sequence[Filter] | None) -> None:
        """Receive only what passes one of the filters, None: everything."""

    def send(self, key: int, data: bytes) -> bool:
        """Send a frame; False: not now."""

    def traffic(self) -> tuple[int, int] | None:
        """Frames and bytes on the interface so far, whoever asked for them; None: not counted."""

    def close(self) -> None:
        """Close it."""


Opener = Callable[[Bus, Callable[[], int], Callable[[], int]], Interface]


class Port:
    """One bus. counters: frames sent, expired, dropped and failed; times lost; frames lost on the way in. received: frames so far.

    clock, wall: monotonic and wall clock in ns. opener: opens the interface (default: `open_bus`).
    """

    def __init__(self, index: int, settings: Bus, inbox: Inbox, clock: Callable[[], int], wall: Callable[[], int],
                 opener: Opener | None = None):
        self.index, self.settings = index, settings
        self.counters: Counter[str] = Counter()
        self.health = BusHealth(settings.name, settings.channel, settings.bitrate)
        self.load_percent: float | None = None
        self.received = 0
        self._inbox, self._clock, self._wall = inbox, clock, wall
        self._opener = opener or open_bus
        self._wire: Interface | None = None
        self._receive: Callable[[int], Sequence[Row]] | None = None
        self._lock = threading.Lock()
        self._waiting: deque[Send] = deque()
        self._unsent: Counter[str] = Counter()
        self._stopping = threading.Event()
        self._suspect = ""
        self._lost_ns: int | None = None
        self._fetches = 0
        self._listening: Listening | None = None
        self._window = _Window(clock())
        self._thread = threading.Thread(target=self._run, name=f"bus {settings.name}", daemon=True)

    @property
    def is_lost(self) -> bool:
        """Whether the interface is gone at the moment."""
        return self._lost_ns is not None

    @property
    def last_ns(self) -> int | None:
        """When the last frame came; None: none since the interface was opened."""
        wire = self._wire
        return None if wire is None else wire.last_ns

    @property
    def state(self) -> str:
        """A word of `health.BUS_STATES`."""
        return self.health.state

    def start(self) -> None:
        """Open the interface and begin to read. Raises BusError."""
        self._open()
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the interface."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def listen(self, listening: Listening) -> None:
        """From now on receive only this; as long as nobody says so, everything is received."""
        with self._lock:
            self._listening = listening
            self.health.cycle_of = listening.cycle_of
            self._apply(self._window.wide)

    # --- out: the loop's thread ---------------------------------------------------------------------------------------

    def send(self, frame: Send, now_ns: int) -> None:
        """Send a frame, at the latest until it expires."""
        if len(self._waiting) >= WAITING_SENDS:
            self._give_up(self._waiting.popleft(), "dropped")
        self._waiting.append(frame)
        self.flush(now_ns)

    def flush(self, now_ns: int) -> int | None:
        """Try what waits, in order. Gives when to try again, None when nothing waits."""
        while self._waiting:
            frame = self._waiting[0]
            if now_ns > frame.expires_ns:
                self._give_up(frame, "expired")
            elif not self._try(frame):
                return now_ns + RETRY_SEND_NS
            self._waiting.popleft()
        return None

    def _try(self, frame: Send) -> bool:
        """Send a frame now; False: not now."""
        with self._lock:
            wire = self._wire
            if wire is None:
                return False
            try:
                if not wire.send(frame.key, frame.data):
                    return False
            except OSError as error:
                # The error of a lost interface comes once, here or there; the bus's thread must not miss it.
                self._suspect = f"can't send: {reason(error)}"
                self._give_up(frame, "failed")
                return True
        self.counters["sent"] += 1
        return True

    def _give_up(self, frame: Send, word: str) -> None:
        self.counters[word] += 1
        self._unsent[frame.message] += 1

    # --- in: the loop's thread, or the bus's where the loop is late ------------------------------------------------------

    def fetch(self) -> Sequence[Row]:
        """The frames that have come, of an interface with a descriptor; those of others are in the inbox."""
        self._fetches += 1
        with self._lock:
            receive = self._receive
            if receive is None:
                return []
            try:
                frames = receive(self.index)
            except OSError as error:
                self._suspect = reason(error)
                return []
            if frames:
                self._window.count(frames)
                self.received += len(frames)
            return frames

    # --- the bus's thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._tend()
            except Exception as error:  # whatever a driver raises: a thread that ended would be a silent bus
                self._lose(error)
                self._judge()
                self._stopping.wait(RETRY_S)
        self._close()

    def _tend(self) -> None:
        """Look after the interface for a moment. Raises what a lost interface makes the driver raise."""
        if self._wire is None:
            self._open()
        wire = self._wire
        assert wire is not None
        if self._receive is None:
            frames = wire.receive(self.index)
            self._window.count(frames)
            self.received += len(frames)
        else:
            fetches = self._fetches
            self._stopping.wait(TICK_S)
            frames = self.fetch() if self._fetches == fetches else ()
        if frames:
            self._inbox.put(Frame(*row) for row in frames)
        if self._suspect:
            raise BusError(self._suspect)
        if self._lost_ns is not None:
            self._find()
        self._hear_errors(wire)
        self._judge()

    def _hear_errors(self, wire: Interface) -> None:
        errors = wire.errors(self.index)
        reports = [report for frame in errors for report in self.health.error(frame.t_ns, frame.key & 0x1FFF_FFFF, frame.data)]
        if wire.last_ns is not None:
            reports += self.health.heard(wire.last_ns)
        if errors:
            self.counters["error frames"] += len(errors)
            self._inbox.put(errors)
        self._report(reports)

    def _judge(self) -> None:
        """Once a window is over: what was counted in it."""
        now_ns = self._clock()
        if now_ns < self._window.begin_ns + WINDOW_NS:
            return
        wire = self._wire
        with self._lock:
            window, self._window = self._window, _Window(now_ns, self._window)
            lost = self._window.lost_until(wire.lost if wire is not None else None)
            unsent, self._unsent = self._unsent, Counter()
        traffic = wire.traffic() if wire is not None else None
        if lost:
            self.counters["lost on the way in"] += lost
        sent = self.counters["sent"] - window.sent
        self._window.sent = self.counters["sent"]
        if wire is not None and wire.impossible:
            self.counters["impossible"] += wire.impossible
            wire.impossible = 0
        self._report(self.health.window(now_ns, Traffic(window.ids(), window.span_ns(now_ns), lost, unsent, sent)))
        self._widen(window, traffic)

    def _widen(self, window: _Window, traffic: tuple[int, int] | None) -> None:
        """Where far more comes than was asked for, ask for everything, to find out which identifier babbles."""
        now = self._window
        now.traffic = traffic
        if traffic is None or window.traffic is None:
            return
        frames, octets = traffic[0] - window.traffic[0], traffic[1] - window.traffic[1]
        seconds = (now.begin_ns - window.begin_ns) / 1e9
        if self.settings.bitrate:
            self.load_percent = min(100.0, 100 * (frames * (BITS_A_FRAME - 64) + 8 * octets) / seconds / self.settings.bitrate)
        much = self.health.most_a_second * seconds
        now.wide = frames > much + window.seen if not window.wide else self.health.babbles or frames > much
        if now.wide != window.wide:
            with self._lock:
                self._apply(now.wide)

    def _apply(self, wide: bool) -> None:
        """Set the filters. To be called with the lock."""
        if self._wire is not None and self._listening is not None:
            self._wire.listen(None if wide else self._listening.filters)

    def _adopt(self, wire: Interface | None) -> None:
        """Use an open interface from now on, None: there is none. To be called with the lock."""
        self._wire = wire
        self._receive = None if wire is None or wire.fileno() is None else wire.receive

    def _open(self) -> None:
        wire = self._opener(self.settings, self._clock, self._wall)
        with self._lock:
            self._suspect = ""
            self._adopt(wire)
            self._window = _Window(self._clock())
            self._window.sent = self.counters["sent"]
            self._apply(False)
        descriptor = wire.fileno()
        if descriptor is not None:
            self._inbox.watch(descriptor)

    def _lose(self, error: Exception) -> None:
        if self._lost_ns is None:
            self._lost_ns = self._clock()
            self.counters["lost"] += 1
            self._report(self.health.down(self._lost_ns, reason(error)))
            self._inbox.notice(f"bus {self.settings.name}: lost ({reason(error)}); trying again")
        self._close()  # only now: a driver may take long over it

    def _find(self) -> None:
        now_ns = self._clock()
        away_s = (now_ns - (self._lost_ns or now_ns)) / 1e9
        self._lost_ns = None
        self._report(self.health.up(now_ns))
        self._inbox.notice(f"bus {self.settings.name}: back after {away_s:.1f} s")

    def _close(self) -> None:
        with self._lock:
            wire = self._wire
            self._adopt(None)
            if wire is None:
                return
            descriptor = wire.fileno()
            if descriptor is not None:
                self._inbox.forget(descriptor)
            with contextlib.suppress(Exception):  # a lost adapter's driver may fail at closing too
                wire.close()

    def _report(self, reports: list[Report]) -> None:
        if reports:
            self._inbox.report(reports)


class _Window:
    """What is counted between two judgements. before: the window before it."""

    def __init__(self, now_ns: int, before: _Window | None = None):
        self.begin_ns = now_ns
        self._batches: list[Sequence[Row]] = []
        self.seen = 0
        self.sent = 0
        self.traffic: tuple[int, int] | None = None
        self.wide: bool = before is not None and before.wide
        self._lost: int = before._lost if before is not None else 0

    def count(self, frames: Sequence[Row]) -> None:
        """Frames have come."""
        if not frames:
            return
        self.seen += len(frames)
        if self.seen < MOST_FRAMES:
            self._batches.append(frames)

    def ids(self) -> Counter[int]:
        """Frames by identifier."""
        return Counter(frame[1] & 0xFFFF_FFFF for frames in self._batches for frame in frames)

    def span_ns(self, now_ns: int) -> int:
        """Time over which its frames came: of old ones that had to wait, longer than the window."""
        came = self._batches[-1][-1][0] - self._batches[0][0][0] if self._batches else 0
        return max(now_ns - self.begin_ns, came)

    def lost_until(self, lost: int | None) -> int:
        """Frames lost in this window, by the interface's count of all."""
        if lost is None:
            return 0
        new, self._lost = lost - self._lost, lost
        return new


def open_bus(settings: Bus, clock: Callable[[], int], wall: Callable[[], int]) -> Interface:
    """Open an interface: SocketCAN directly, every other one by python-can. Raises BusError with what to do."""
    if settings.interface == "socketcan":
        return SocketCan(settings, clock, wall)
    from level1.io.python_can import open_interface  # only where one is used: it costs 15 MB
    return open_interface(settings, clock, wall)


def check_name(settings: Bus) -> None:
    """Raises BusError where there is no interface of that name. Opens nothing: the bus may be elsewhere yet."""
    if settings.interface != "socketcan":
        from level1.io.python_can import check
        check(settings)


def check_bus(settings: Bus) -> None:
    """Raises BusError with what to do where there is no interface of that name, or its SocketCAN interface is missing or down."""
    if settings.interface == "socketcan":
        socketcan.check(settings)
    else:
        check_name(settings)


def reason(error: Exception) -> str:
    """What a driver raised, in one line."""
    if isinstance(error, OSError) and error.errno is not None:
        return os.strerror(error.errno)
    return (str(error).splitlines() or [type(error).__name__])[0]
