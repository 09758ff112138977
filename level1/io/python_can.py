"""Any interface that python-can knows (slcan, virtual, udp_multicast, pcan, kvaser …). Imported only where one is used."""
from __future__ import annotations

import errno
import logging
from collections.abc import Callable, Sequence

import can
from can.interfaces import VALID_INTERFACES

from level1.frame import BUS_SHIFT, ERROR, EXTENDED, Frame
from level1.io.config import Bus
from level1.io.error import did_you_mean
from level1.io.message import CLASSIC_BYTES, from_message
from level1.io.socketcan import BusError, Filter
from level1.io.stamps import Stamps

POLL_S = 0.1
"""A call waits for a frame so long."""

# python-can tells the terminal what it also raises.
logging.getLogger("can").addHandler(logging.NullHandler())


class PythonCan:
    """An open interface. bus: of python-can. impossible: frames that can't be. lost: frames the driver told to have dropped."""

    def __init__(self, bus: can.BusABC, clock: Callable[[], int], wall: Callable[[], int]):
        self.impossible = self.lost = 0
        self.last_ns: int | None = None
        self._bus, self._clock, self._wall, self._stamps = bus, clock, wall, Stamps()
        self._errors: list[Frame] = []

    def fileno(self) -> int | None:
        """None: whoever reads has to wait in `receive`."""
        return None

    def receive(self, bus: int) -> list[Frame]:
        """Wait for one frame. bus: index for its key. Raises what a lost interface makes the driver raise."""
        message = self._bus.recv(POLL_S)
        if message is None:
            return []
        try:
            key, data = from_message(message)
        except ValueError:
            self.impossible += 1
            return []
        t_ns = self._stamps.monotonic_ns(int(message.timestamp * 1e9), self._clock(), self._wall(), self._clock())
        frame = Frame(t_ns, key | bus << BUS_SHIFT, data)
        if key & ERROR:
            self._errors.append(frame)
            return []
        self.last_ns = t_ns
        return [frame]

    def errors(self, bus: int) -> list[Frame]:
        """The error message frames since the last call."""
        errors, self._errors = self._errors, []
        return errors

    def listen(self, filters: Sequence[Filter] | None) -> None:
        """Everything is received."""

    def send(self, key: int, data: bytes) -> bool:
        """Send a frame; False: not now. Raises OSError."""
        message = can.Message(arbitration_id=key & 0x1FFFFFFF, is_extended_id=bool(key & EXTENDED), data=data,
                              is_fd=len(data) > CLASSIC_BYTES)
        try:
            self._bus.send(message, timeout=0)
        except (can.CanError, OSError, ValueError) as error:
            if _is_full(error):
                return False
            raise OSError(reason(error)) from None
        return True

    def traffic(self) -> None:
        """None: not counted."""

    def close(self) -> None:
        """Close it."""
        self._bus.shutdown()


def open_interface(settings: Bus, clock: Callable[[], int], wall: Callable[[], int]) -> PythonCan:
    """Open an interface. Raises BusError with what to do."""
    if settings.interface not in VALID_INTERFACES:
        raise BusError(f'bus {settings.name}: no interface is called "{settings.interface}"'
                       f"{did_you_mean(settings.interface, VALID_INTERFACES)}")
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
    return PythonCan(bus, clock, wall)


def reason(error: Exception) -> str:
    """One line."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def _is_full(error: Exception) -> bool:
    """Whether an interface can't take a frame only for the moment."""
    if isinstance(error, can.CanTimeoutError):
        return True
    number = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
    return number in (errno.ENOBUFS, errno.EAGAIN) or "buffer full" in str(error)
