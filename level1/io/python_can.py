"""Any interface that python-can knows (slcan, virtual, udp_multicast, pcan, kvaser …). Imported only where one is used.

Theory of operation. A driver may do at sending what it likes: wait for a slow adapter, or, as pyserial asked not to wait, try for
ever. Therefore a thread of its own sends, one frame at a time, and `send` waits for it `SEND_S` at most: a frame that is not
through by then counts as not sent, and the caller asks again with the same frame until it is, or is past its time.
"""
from __future__ import annotations

import errno
import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence

import can
from can.interfaces import VALID_INTERFACES
from can.interfaces.slcan import slcanBus

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, REMOTE, Frame
from level1.io.config import Bus
from level1.io.error import did_you_mean
from level1.io.message import CLASSIC_BYTES, from_message
from level1.io.socketcan import BusError, Filter
from level1.io.stamps import Stamps

POLL_S = 0.1
"""A call waits for a frame so long."""
SEND_S = 0.005
"""A driver that has not sent a frame by then is not waited for: supervision goes on."""
CLOSE_S = 0.2
"""The same at closing: an adapter that hangs takes no goodbye."""

# python-can tells the terminal what it also raises.
logging.getLogger("can").addHandler(logging.NullHandler())


ECHOES = ("udp_multicast",)
"""Interfaces on which one hears oneself, which no CAN controller does."""
ECHO_NS = 500_000_000
"""An echo that has not come by then was lost."""


class PythonCan:
    """An open interface. bus: of python-can. impossible: frames that can't be. lost: frames the driver told to have dropped.

    echoes: one hears one's own frames there; they are left out, else the UCS would be taken for a second talker.
    """

    def __init__(self, bus: can.BusABC, clock: Callable[[], int], wall: Callable[[], int], *, echoes: bool = False):
        self._own: deque[tuple[int, int, bytes]] | None = deque() if echoes else None
        self._again = False
        self.impossible = self.lost = 0
        self.last_ns: int | None = None
        self._bus, self._clock, self._wall, self._stamps = bus, clock, wall, Stamps()
        self._errors: list[Frame] = []
        self._sender = _Sender(bus)

    def fileno(self) -> int | None:
        """None: whoever reads has to wait in `receive`."""
        return None

    def receive(self, bus: int) -> list[Frame]:
        """Wait for one frame. bus: index for its key. Raises what a lost interface makes the driver raise."""
        message = self._recv()
        if message is None:
            return []
        try:
            key, data = from_message(message)
        except ValueError:
            self.impossible += 1
            return []
        t_ns = self._stamps.monotonic_ns(int(message.timestamp * 1e9), self._clock(), self._wall(), self._clock())
        if self._own is not None and self._is_echo(key, data):
            return []
        frame = Frame(t_ns, key | bus << BUS_SHIFT, data)
        if key & ERROR:
            self._errors.append(frame)
            return []
        self.last_ns = t_ns
        return [frame]

    def _recv(self) -> can.Message | None:
        try:
            return self._bus.recv(POLL_S)
        except (ValueError, IndexError, can.CanOperationError) as error:
            can_not_read = error.__cause__ if isinstance(error, can.CanOperationError) else error
            if not isinstance(self._bus, slcanBus) or not isinstance(can_not_read, (ValueError, IndexError)):
                raise
        self.impossible += 1  # half a line, noise on the serial port
        self._bus.flush()  # what it can't read it would keep, and try again with all that follows
        return None

    def _is_echo(self, key: int, data: bytes) -> bool:
        """Whether it is one of the frames sent lately; an interface may drop some of them, but keeps their order."""
        assert self._own is not None
        late_ns = self._clock() - ECHO_NS
        while self._own and self._own[0][0] < late_ns:
            self._own.popleft()
        for position, (_, sent_key, sent_data) in enumerate(list(self._own)):
            if (sent_key, sent_data) == (key, data):
                for _ in range(position + 1):
                    self._own.popleft()
                return True
        return False

    def errors(self, bus: int) -> list[Frame]:
        """The error message frames since the last call."""
        errors, self._errors = self._errors, []
        return errors

    def listen(self, filters: Sequence[Filter] | None) -> None:
        """Everything is received."""

    def send(self, key: int, data: bytes) -> bool:
        """Send a frame; False: not now. Raises OSError."""
        is_remote = bool(key & REMOTE)
        message = can.Message(arbitration_id=key & 0x1FFFFFFF, is_extended_id=bool(key & EXTENDED), is_remote_frame=is_remote,
                              dlc=len(data), data=None if is_remote else data, is_fd=len(data) > CLASSIC_BYTES)
        if self._own is not None and not self._again:
            self._own.append((self._clock(), key & ~(-1 << BUS_SHIFT), b"" if is_remote else data))
        self._again = False
        try:
            sent = self._sender.send(message)
            self._again = not sent
            return sent
        except (can.CanError, OSError, ValueError) as error:
            if _is_full(error):
                return False
            raise OSError(reason(error)) from None

    def traffic(self) -> None:
        """None: not counted."""

    def close(self) -> None:
        """Close it. Raises what its driver raises, unless that takes too long."""
        self._sender.stop()
        failed: list[Exception] = []

        def shut() -> None:
            try:
                self._bus.shutdown()
            except Exception as error:  # told below, if anyone still waits
                failed.append(error)
        thread = threading.Thread(target=shut, name="can closing", daemon=True)
        thread.start()
        thread.join(CLOSE_S)
        if failed:
            raise failed[0]


class _Sender:
    """Sends in a thread of its own, one frame at a time."""

    def __init__(self, bus: can.BusABC):
        self._bus = bus
        self._message: can.Message | None = None
        self._error: Exception | None = None
        self._wanted, self._done = threading.Event(), threading.Event()
        self._stopping = False
        self._thread: threading.Thread | None = None

    def send(self, message: can.Message) -> bool:
        """Whether this frame has been sent; False: not yet, ask again. Raises what the driver raises."""
        if self._message is None:
            self._message = message
            self._done.clear()
            self._wanted.set()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="can sender", daemon=True)
                self._thread.start()
        if not self._done.wait(SEND_S):
            return False
        sent, self._message = self._message, None
        error, self._error = self._error, None
        if not sent.equals(message, timestamp_delta=None, check_direction=False):
            return self.send(message)  # that was one that has been given up meanwhile, and its fate is told
        if error is not None:
            raise error
        return True

    def stop(self) -> None:
        """Send nothing more."""
        self._stopping = True
        self._wanted.set()

    def _run(self) -> None:
        while self._wanted.wait() and not self._stopping:
            self._wanted.clear()
            message = self._message
            assert message is not None
            try:
                self._bus.send(message, timeout=None)
            except Exception as error:  # whatever a driver raises: `send` tells it
                self._error = error
            self._done.set()


def check(settings: Bus) -> None:
    """Raises BusError where there is no interface of that name."""
    if settings.interface not in VALID_INTERFACES:
        raise BusError(f'bus {settings.name}: no interface is called "{settings.interface}"'
                       f"{did_you_mean(settings.interface, VALID_INTERFACES)}")


def open_interface(settings: Bus, clock: Callable[[], int], wall: Callable[[], int]) -> PythonCan:
    """Open an interface. Raises BusError with what to do."""
    check(settings)
    options = dict(settings.options)
    if settings.bitrate is not None:
        options["bitrate"] = settings.bitrate
    if settings.fd:
        options["fd"] = True
    try:
        bus = can.Bus(channel=settings.channel, interface=settings.interface, ignore_config=True, **options)
    except (can.CanError, OSError, ImportError, NotImplementedError, TypeError, ValueError) as error:
        raise BusError(f"bus {settings.name}: {settings.interface} {settings.channel} can't be opened: {reason(error)}; "
                       "check the adapter, its driver and the [[bus]] table") from None
    return PythonCan(bus, clock, wall, echoes=settings.interface in ECHOES)


def reason(error: Exception) -> str:
    """One line."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def _is_full(error: Exception) -> bool:
    """Whether an interface can't take a frame only for the moment."""
    if isinstance(error, can.CanTimeoutError):
        return True
    number = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
    return number in (errno.ENOBUFS, errno.EAGAIN) or "buffer full" in str(error)
