"""A GNSS receiver on a serial line: its bytes become readings; found again when it was pulled out.

Theory of operation. One thread opens the port, reads, and opens it again every `RETRY_S` when it is gone (pyserial says so by
an exception at the next read; a socket by an empty one). It never ends by itself. Sentences are put together and turned into
readings in this thread, so that the loop only takes what is ready; when the loop does not, the oldest are dropped and counted.

`reopen` (the repair of TimeSyncLost) has a port opened anew that is there, but whose adapter or driver may hang.

A port that is not there at the start is no reason not to supervise: it is an alarm.
"""
from __future__ import annotations

import logging
import select
import threading
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

import serial

from level1.health import GnssReadings, Reading
from level1.io.config import Gnss
from level1.nmea import FRESH_NS, Navigator

POLL_S = 0.2
"""How long the thread waits for a byte before it looks whether anything else is due."""
NAP_S = 0.005
"""A burst comes in portions of a few bytes; what follows the first within this is read with it."""
RETRY_S = 0.5
READINGS = 400
"""Readings that wait at most: 5 s of a receiver that speaks 20 times a second."""
CHUNK = 4096

logging.getLogger("pynmeagps").addHandler(logging.NullHandler())


class Line(Protocol):
    """What is needed of a `serial.Serial`."""

    def fileno(self) -> int:
        """For poll(2)."""

    def read(self, size: int) -> bytes:
        """What is there, at most so many bytes."""

    def close(self) -> None:
        """Give the port back."""


class GnssReceiver:
    """The receiver of a unit. counters: of its sentences (`nmea`), how often it was lost, readings dropped.

    clock, wall: monotonic and wall clock, ns. told: called when readings are there. notice: called with a line when the port
    is lost or found. opener: opens the port (default: `open_line`).
    """

    def __init__(self, settings: Gnss, *, clock: Callable[[], int], wall: Callable[[], int], told: Callable[[], None],
                 notice: Callable[[str], None], opener: Callable[[Gnss], Line] | None = None):
        self.settings = settings
        self._navigator = Navigator()
        self._readings = GnssReadings()
        self._clock, self._wall, self._told, self._notice = clock, wall, told, notice
        self._opener = opener or open_line
        self._line: Line | None = None
        self._lost = Counter[str]()
        self._is_missing = False
        self._waiting: deque[Reading] = deque()
        self._offset_ns: int | None = None
        self._fix: tuple[int, int | None] = (clock(), None)
        self._lock = threading.Lock()
        self._stopping, self._again = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"gnss {settings.port}", daemon=True)

    @property
    def counters(self) -> Counter[str]:
        """What came, what was lost."""
        return self._navigator.counters + self._lost

    @property
    def fix(self) -> int | None:
        """Quality of the fix, index into `navigation.FIXES`; None: not known, or not lately."""
        said_ns, fix = self._fix
        return fix if self._clock() - said_ns <= FRESH_NS else None

    def start(self) -> None:
        """Begin to read; never fails."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the port."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def reopen(self) -> None:
        """Have the port closed and opened again soon."""
        self._again.set()

    def take(self) -> list[Reading]:
        """The readings since the last call, in order."""
        with self._lock:
            readings = list(self._waiting)
            self._waiting.clear()
        return readings

    def utc_offset_ns(self) -> int | None:
        """UTC minus the monotonic clock as the satellites give it; None: not known."""
        return self._offset_ns

    # --- the reader's thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                news = self._poll()
            except Exception as error:  # whatever a driver raises: a reader that ended would be a receiver that is silent
                self._lose(error)
                self._report(())
                self._stopping.wait(RETRY_S)
            else:
                self._report(news)
        self._close()

    def _poll(self) -> set[str]:
        """Wait for bytes; the topics with news. Raises what a lost port makes the driver raise."""
        if self._again.is_set():
            self._again.clear()
            self._close()
            self._notice(f"gnss {self.settings.port}: opened anew, to get the time")
        if self._line is None:
            self._line = self._opener(self.settings)
            self._navigator.opened(self._clock())
            self._readings.again()
            self._find()
        poll = select.poll()
        poll.register(self._line.fileno(), select.POLLIN)
        if not poll.poll(POLL_S * 1000):
            return set()
        self._stopping.wait(NAP_S)
        return self._navigator.feed(self._clock(), self._line.read(CHUNK))

    def _report(self, news: set[str] | tuple[()]) -> None:
        """Put the readings that are due where the loop finds them."""
        now_ns = self._clock()
        navigation = self._navigator.navigation(now_ns)
        self._offset_ns = self._navigator.utc_offset_ns(now_ns)
        error_ns = None if self._offset_ns is None else self._wall() - now_ns - self._offset_ns
        readings = self._readings.take(now_ns, news, navigation, error_ns)
        self._fix = (now_ns, navigation.fix)
        if not readings:
            return
        with self._lock:
            self._waiting.extend(readings)
            while len(self._waiting) > READINGS:
                self._waiting.popleft()
                self._lost["readings dropped"] += 1
        self._told()

    def _lose(self, error: Exception) -> None:
        self._close()
        self._navigator.lost()
        if not self._is_missing:
            self._is_missing = True
            self._lost["lost"] += 1
            self._readings.again()
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            self._notice(f"gnss {self.settings.port}: lost ({reason}); trying again")

    def _find(self) -> None:
        if self._is_missing:
            self._is_missing = False
            self._notice(f"gnss {self.settings.port}: back")

    def _close(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            with suppress(Exception):  # a port that is gone may fail at closing too
                line.close()


def open_line(settings: Gnss) -> Line:
    """Open the port: a device, or an address such as `socket://192.168.1.20:2000` for a receiver on Ethernet.

    Raises serial.SerialException, ValueError, OSError.
    """
    line: Line = serial.serial_for_url(settings.port, baudrate=settings.baud, timeout=0, exclusive=True)
    return line
