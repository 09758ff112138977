"""A CAN bus, live: frames into the inbox, frames out within their time, found again when it was lost.

Theory of operation. Each bus has one reader thread, which alone opens and closes the interface. It waits at most `POLL_S`
for a frame; whatever goes wrong (link down, adapter pulled out, a library's exception) it reports, closes, and opens again
every `RETRY_S` until frames can come. A socket whose interface went away stays deaf for ever, therefore always anew.

Frames go out from the loop's thread, which never waits: what the interface can't take now is tried again every
`RETRY_SEND_NS`, and is dropped and counted once it is past its time.

python-can's stamps are of the wall clock, which jumps on a tractor. A frame's age by them is believed when it is plausible
and the wall clock ran evenly, and is taken off the monotonic clock; else the frame counts from when it was read.
"""
from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import socket
import struct
import threading
from collections import Counter, deque
from collections.abc import Callable

import can
from can.interfaces import VALID_INTERFACES

from level1.event import Send
from level1.frame import BUS_SHIFT, EXTENDED, Frame
from level1.io.config import Bus
from level1.io.error import OutsideError, did_you_mean
from level1.io.inbox import Inbox
from level1.io.message import CLASSIC_BYTES, from_message

POLL_S = 0.2
RETRY_S = 0.25
RETRY_SEND_NS = 1_000_000
WAITING_SENDS = 200
"""Frames that wait for an interface at most; the oldest is dropped first."""
PLAUSIBLE_AGE_NS = 1_000_000_000
"""A frame that waited longer in the kernel's buffer (278 frames by default) than this can't be."""
EVEN_NS = 1_000_000
"""How exactly the two clocks are compared; moving apart by twice this between two frames is a jump (NTP slews 0.5 ms/s)."""
_SIOCGIFFLAGS, _IFF_UP = 0x8913, 1

# python-can tells the terminal what it also raises.
logging.getLogger("can").addHandler(logging.NullHandler())


class BusError(OutsideError):
    """A bus that can't be opened; the text says what to do."""


class Stamps:
    """Turns wall-clock stamps into times of the monotonic clock."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._even_since_ns = 0

    def monotonic_ns(self, stamp_ns: int, before_ns: int, wall_ns: int, now_ns: int) -> int:
        """When a frame came, by its stamp. The wall clock showed `wall_ns` between `before_ns` and `now_ns`."""
        offset = wall_ns - now_ns
        if now_ns - before_ns <= EVEN_NS:  # else the thread was interrupted between its looks at the clocks
            if self._offset_ns is not None and abs(offset - self._offset_ns) > 2 * EVEN_NS:
                # What was stamped before a jump may still be on its way.
                self._even_since_ns = now_ns + PLAUSIBLE_AGE_NS
            self._offset_ns = offset
        age = wall_ns - stamp_ns
        return now_ns - age if 0 <= age < PLAUSIBLE_AGE_NS and now_ns >= self._even_since_ns else now_ns


class Port:
    """One bus. counters: frames sent, expired, dropped and failed; times lost; frames that can't be.

    clock, wall: monotonic and wall clock in ns. opener: opens the interface (default: `open_bus`).
    """

    def __init__(self, index: int, settings: Bus, inbox: Inbox, clock: Callable[[], int], wall: Callable[[], int],
                 opener: Callable[[Bus], can.BusABC] | None = None):
        self.index, self.settings = index, settings
        self.counters: Counter[str] = Counter()
        self._inbox, self._clock, self._wall = inbox, clock, wall
        self._opener = opener or open_bus
        self._bus: can.BusABC | None = None
        self._waiting: deque[Send] = deque()
        self._stopping = threading.Event()
        self._suspect = ""
        self._lost_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name=f"bus {settings.name}", daemon=True)

    @property
    def is_lost(self) -> bool:
        """Whether the interface is gone at the moment."""
        return self._lost_ns is not None

    def start(self) -> None:
        """Open the interface and begin to read. Raises BusError."""
        self._bus = self._opener(self.settings)
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the interface."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    # --- out: the loop's thread ---------------------------------------------------------------------------------------

    def send(self, frame: Send, now_ns: int) -> None:
        """Send a frame, at the latest until it expires."""
        if len(self._waiting) >= WAITING_SENDS:
            self._waiting.popleft()
            self.counters["dropped"] += 1
        self._waiting.append(frame)
        self.flush(now_ns)

    def flush(self, now_ns: int) -> int | None:
        """Try what waits, in order. Gives when to try again, None when nothing waits."""
        while self._waiting:
            frame = self._waiting[0]
            if now_ns > frame.expires_ns:
                self.counters["expired"] += 1
            elif not self._try(frame):
                return now_ns + RETRY_SEND_NS
            self._waiting.popleft()
        return None

    def _try(self, frame: Send) -> bool:
        """Send a frame now; False: not now."""
        bus = self._bus
        if bus is None:
            return False
        message = can.Message(arbitration_id=frame.key & 0x1FFFFFFF, is_extended_id=bool(frame.key & EXTENDED),
                              data=frame.data, is_fd=len(frame.data) > CLASSIC_BYTES)
        try:
            bus.send(message, timeout=0)
        except (can.CanError, OSError, ValueError) as error:
            if _is_full(error):
                return False
            # The error of a lost interface comes once, here or there; the reader must not miss it.
            self._suspect = f"can't send: {_reason(error)}"
            self.counters["failed"] += 1
            return True
        self.counters["sent"] += 1
        return True

    # --- in: the reader's thread --------------------------------------------------------------------------------------

    def _run(self) -> None:
        stamps = Stamps()
        while not self._stopping.is_set():
            try:
                self._poll(stamps)
            except Exception as error:  # whatever a driver raises: a reader that ended would be a silent bus
                self._lose(error)
                self._stopping.wait(RETRY_S)
        self._close()

    def _poll(self, stamps: Stamps) -> None:
        """Wait for one frame. Raises what a lost interface makes the driver raise."""
        if self._bus is None:
            self._bus = self._opener(self.settings)
            self._suspect = ""
        message = self._bus.recv(POLL_S)
        if self._suspect:
            raise BusError(self._suspect)
        if self._lost_ns is not None:
            self._find()
        if message is None:
            return
        try:
            key, data = from_message(message)
        except ValueError:
            self.counters["impossible"] += 1
            return
        t_ns = stamps.monotonic_ns(int(message.timestamp * 1e9), self._clock(), self._wall(), self._clock())
        self._inbox.put(Frame(t_ns, key | self.index << BUS_SHIFT, data))

    def _lose(self, error: Exception) -> None:
        self._close()
        if self._lost_ns is None:
            self._lost_ns = self._clock()
            self.counters["lost"] += 1
            self._inbox.notice(f"bus {self.settings.name}: lost ({_reason(error)}); trying again")

    def _find(self) -> None:
        now_ns = self._clock()
        away_s = (now_ns - (self._lost_ns or now_ns)) / 1e9
        self._lost_ns = None
        self._inbox.notice(f"bus {self.settings.name}: back after {away_s:.1f} s")

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(Exception):  # a lost adapter's driver may fail at closing too
                bus.shutdown()


def open_bus(settings: Bus) -> can.BusABC:
    """Open an interface. Raises BusError with what to do."""
    if settings.interface not in VALID_INTERFACES:
        raise BusError(f'bus {settings.name}: no interface is called "{settings.interface}"'
                       f"{did_you_mean(settings.interface, VALID_INTERFACES)}")
    if settings.interface == "socketcan":
        _check_socketcan(settings)
    options = dict(settings.options)
    if settings.bitrate is not None:
        options["bitrate"] = settings.bitrate
    if settings.fd:
        options["fd"] = True
    try:
        return can.Bus(channel=settings.channel, interface=settings.interface, ignore_config=True, **options)
    except (can.CanError, OSError, ImportError, NotImplementedError, TypeError, ValueError) as error:
        raise BusError(f"bus {settings.name}: {settings.interface} {settings.channel} can't be opened: {_reason(error)}; "
                       "check the adapter, its driver and the [[bus]] table") from None


def _check_socketcan(settings: Bus) -> None:
    """Say what to do where the interface is missing or down."""
    name, channel = settings.name, settings.channel
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            request = fcntl.ioctl(probe, _SIOCGIFFLAGS, struct.pack("16sh14x", channel.encode(), 0))
    except OSError as error:
        if error.errno != errno.ENODEV:
            raise BusError(f"bus {name}: this kernel has no SocketCAN ({error.strerror}); load it: modprobe can-raw") from None
        raise BusError(f"bus {name}: there is no interface {channel}; {_create(settings)}") from None
    if not struct.unpack("16sh14x", request)[1] & _IFF_UP:
        raise BusError(f"bus {name}: the interface {channel} is down; {_bring_up(settings)}")


def _create(settings: Bus) -> str:
    if settings.channel.startswith("vcan"):
        return f"create it: ip link add {settings.channel} type vcan && {_bring_up(settings).partition(': ')[2]}"
    return f"plug the adapter in (`ip link` lists what is there), then {_bring_up(settings)}"


def _bring_up(settings: Bus) -> str:
    rate = "" if settings.channel.startswith("vcan") else f" type can bitrate {settings.bitrate or 250000}"
    return f"bring it up: ip link set {settings.channel} up{rate}"


def _is_full(error: Exception) -> bool:
    """Whether an interface can't take a frame only for the moment."""
    if isinstance(error, can.CanTimeoutError):
        return True
    number = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
    return number in (errno.ENOBUFS, errno.EAGAIN) or "buffer full" in str(error)


def _reason(error: Exception) -> str:
    """One line."""
    return (str(error).splitlines() or [type(error).__name__])[0]
