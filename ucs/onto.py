"""A recording played onto a bus, in real time or faster: for those who test other programs with it.

Theory of operation. Each frame has its own time on the schedule, the first frame's plus what lies between their stamps: one that
went out late delays none behind it, and nothing adds up over hours. Stamps that run backwards are due at once.
"""
from __future__ import annotations

import errno
import logging
import time
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from level1.frame import ERROR, EXTENDED, REMOTE, Frame
from level1.io.can import check_bus
from level1.io.config import Bus
from level1.io.error import OutsideError
from level1.io.message import CLASSIC_BYTES

if TYPE_CHECKING:
    import can

EVERY = -1
"""In place of a bus index: frames of every bus."""
FULL_NS = 2_000_000_000
"""An interface that takes no frame for so long is given up."""
RETRY_NS = 1_000_000
PROMPT_NS = 5_000_000
"""Frames are handed on before a longer wait than this, so that what comes of them is told at once."""
INTERFACE = "socketcan"


class Player:
    """Sends frames when they are due. buses: bus index -> interface, or `EVERY`; frames of other buses are left out.

    speed: how many times faster than recorded. clock, sleep: monotonic time and waiting, ns. sent, left_out, late_ns (sum),
    latest_ns: what became of the frames so far.
    """

    def __init__(self, buses: Mapping[int, can.BusABC], speed: float = 1.0, clock: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[int], None] | None = None):
        self.buses, self.speed = buses, speed
        self.sent = self.left_out = self.late_ns = self.latest_ns = 0
        self.begun_ns: int | None = None
        self._clock = clock
        self._sleep = sleep or (lambda duration_ns: time.sleep(duration_ns / 1e9))

    def play(self, batches: Iterator[list[Frame]]) -> Iterator[list[Frame]]:
        """The frames, handed on as they have gone out. Raises OutsideError when an interface fails."""
        first_ns = highest_ns = 0
        gone: list[Frame] = []
        for batch in batches:
            for frame in batch:
                if self.begun_ns is None:
                    self.begun_ns, first_ns, highest_ns = self._clock(), frame.t_ns, frame.t_ns
                highest_ns = max(highest_ns, frame.t_ns)
                due_ns = self.begun_ns + round((highest_ns - first_ns) / self.speed)
                wait_ns = due_ns - self._clock()
                if wait_ns > PROMPT_NS and gone:
                    yield gone
                    gone = []
                    wait_ns = due_ns - self._clock()
                if wait_ns > 0:
                    self._sleep(wait_ns)
                self._send(frame, due_ns)
                gone.append(frame)
        yield gone

    def summary(self) -> str:
        """One line of what was played."""
        took_s = (self._clock() - self.begun_ns) / 1e9 if self.begun_ns is not None else 0.0
        left = f"; {self.left_out:,} error frames and frames of other channels left out" if self.left_out else ""
        average_ms = self.late_ns / max(self.sent, 1) / 1e6
        return (f"played {self.sent:,} frames in {took_s:.3f} s, on average {average_ms:.2f} ms late, at most "
                f"{self.latest_ns / 1e6:.2f} ms{left}")

    def _send(self, frame: Frame, due_ns: int) -> None:
        bus = self.buses.get(frame.bus) or self.buses.get(EVERY)
        if bus is None or frame.key & ERROR:
            self.left_out += 1
            return
        import can
        message = can.Message(arbitration_id=frame.can_id, is_extended_id=bool(frame.key & EXTENDED), data=frame.data,
                              is_remote_frame=bool(frame.key & REMOTE), is_fd=len(frame.data) > CLASSIC_BYTES, check=False)
        give_up_ns = self._clock() + FULL_NS
        while True:
            try:
                bus.send(message, timeout=0)
                break
            except (can.CanError, OSError, ValueError) as error:
                if not _is_full(error) or self._clock() > give_up_ns:
                    raise OutsideError(f"frame {self.sent + 1:,} can't be sent: {_reason(error)}; is the interface up?") from None
                self._sleep(RETRY_NS)
        late_ns = max(0, self._clock() - due_ns)
        self.sent += 1
        self.late_ns += late_ns
        self.latest_ns = max(self.latest_ns, late_ns)


@contextmanager
def opened(targets: Sequence[tuple[str, str]], interface: str | None, bitrate: int | None) -> Iterator[dict[int, can.BusABC]]:
    """The interfaces of `--onto`, by the index of the bus that goes there: channels in their order, or `EVERY`.

    Raises OutsideError with what to do when one is missing, down, or can't be opened.
    """
    with ExitStack() as stack:
        buses: dict[int, can.BusABC] = {}
        for index, (name, channel) in enumerate(targets):
            buses[index if name else EVERY] = stack.enter_context(_open(channel, interface or INTERFACE, bitrate))
        yield buses


def _open(channel: str, interface: str, bitrate: int | None) -> can.BusABC:
    import can
    check_bus(Bus(name=channel, channel=channel, interface=interface, bitrate=bitrate))
    options: dict[str, Any] = {"fd": True} if interface == INTERFACE else {}
    if bitrate is not None:
        options["bitrate"] = bitrate
    logging.getLogger("can").addHandler(logging.NullHandler())  # python-can tells the terminal what it also raises
    try:
        return can.Bus(channel=channel, interface=interface, ignore_config=True, **options)
    except (can.CanError, OSError, ImportError, NotImplementedError, TypeError, ValueError) as error:
        raise OutsideError(f"{interface} {channel} can't be opened: {_reason(error)}") from None


def _is_full(error: Exception) -> bool:
    """Whether an interface can't take a frame only for the moment."""
    number = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
    return number in (errno.ENOBUFS, errno.EAGAIN) or "buffer full" in str(error)


def _reason(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def target(text: str) -> tuple[str, str]:
    """`vcan0` or `can1=vcan0`: channel of the recording ("" for all) and interface. Raises ArgumentTypeError."""
    name, _, channel = text.rpartition("=")
    if not channel or (not name and "=" in text):
        raise ArgumentTypeError(f'"{text}" is not of the form INTERFACE or CHANNEL=INTERFACE, such as can1=vcan0')
    return name, channel


def speed(text: str) -> float:
    """A factor above 0. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise ArgumentTypeError(f'"{text}" is no speed: 1 is as recorded, 2 twice as fast')
    return value
