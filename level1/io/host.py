"""The computer itself: temperatures, memory, storage, load, clock, measured once a period by a thread of its own.

A sensor that hangs (a chip behind a slow bus, a dead disk) must not hold supervision, so only this thread waits for it; its
readings then fail to come, and the silence of UCS_HEALTH raises an alarm. What a computer has no sensor for stays unknown; a
sensor that was there and can't be read any more is an error.
"""
from __future__ import annotations

import ctypes
import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import msgspec

from level1.health import Host

CPU_WORDS = ("cpu", "x86_pkg", "core", "soc", "package", "tctl", "tdie", "k10temp")
"""In the name of a thermal zone or of a hwmon chip or its label: this is the processor."""
BOARD_WORDS = ("acpitz", "board", "system", "systin", "pch", "ambient", "jc42", "lm75", "tmp102")
"""The same for the mainboard. Everything else (disks, radios, graphics) is neither."""
LOWEST_C, HIGHEST_C = -40.0, 125.0
"""What a working sensor can read; others give 0x00, 0xFF or -128 when they are broken or not wired."""
MEASURED = ("cpu_celsius", "mainboard_celsius", "ram_used_percent", "storage_used_percent")
"""What a sensor says: once there, it must not become unknown."""
_TIME_ERROR = 5


class Places(msgspec.Struct, frozen=True):
    """Where the kernel shows the state of the computer. storage: a folder on the storage that is watched."""

    storage: Path
    thermal: Path = Path("/sys/class/thermal")
    hwmon: Path = Path("/sys/class/hwmon")
    proc: Path = Path("/proc")


def measure(places: Places) -> Host:
    """The state of the computer now."""
    zones = list(temperatures(places))
    return Host(cpu_celsius=_hottest(zones, CPU_WORDS), mainboard_celsius=_hottest(zones, BOARD_WORDS),
                ram_used_percent=ram_used_percent(places.proc), storage_used_percent=storage_used_percent(places.storage),
                load=load(places.proc), clock_synchronised=clock_is_synchronised())


def temperatures(places: Places) -> Iterator[tuple[str, float]]:
    """What can be read: names of zone, chip and label in lower case, and °C."""
    for zone in _glob(places.thermal, "thermal_zone*"):
        yield from _temperature(_text(zone / "type"), zone / "temp")
    for chip in _glob(places.hwmon, "hwmon*"):
        for sensor in _glob(chip, "temp*_input"):
            label = _text(sensor.with_name(sensor.name.replace("_input", "_label")))
            yield from _temperature(f"{_text(chip / 'name')} {label}", sensor)


def ram_used_percent(proc: Path) -> float | None:
    """Memory that programs can't get any more (proc(5): MemTotal less MemAvailable), percent."""
    lines = (line.split() for line in _text(proc / "meminfo").splitlines())
    amounts = {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[1].isdigit()}
    total, available = amounts.get("MemTotal:"), amounts.get("MemAvailable:")
    if not total or available is None:
        return None
    return 100.0 * (total - available) / total


def storage_used_percent(folder: Path) -> float | None:
    """Share of the storage that is full for a program without special rights, percent."""
    try:
        state = os.statvfs(folder)
    except OSError:
        return None
    if not state.f_blocks:
        return None
    usable = state.f_blocks - state.f_bfree + state.f_bavail
    return 100.0 * (usable - state.f_bavail) / usable if usable else 100.0


def load(proc: Path) -> float | None:
    """Tasks that want to run, mean of a minute, for each processor (proc(5))."""
    words = _text(proc / "loadavg").split()
    try:
        return float(words[0]) / len(os.sched_getaffinity(0))
    except (IndexError, ValueError):
        return None


def clock_is_synchronised() -> bool:
    """Whether the kernel says that something (NTP, GNSS) keeps the wall clock right (adjtimex(2))."""
    buffer = ctypes.create_string_buffer(512)
    state: int = ctypes.CDLL(None).adjtimex(buffer)
    return 0 <= state < _TIME_ERROR


class HostWatch:
    """Measures once a period in a thread of its own. told: called when a measurement is there to be taken.

    clock: monotonic, ns. measure: gives the state of the computer.
    """

    def __init__(self, period_ns: int, measure: Callable[[], Host], clock: Callable[[], int], told: Callable[[], None]):
        self._period_ns, self._measure, self._clock, self._told = period_ns, measure, clock, told
        self._latest: tuple[int, Host] | None = None
        self._seen: set[str] = set()
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="host", daemon=True)

    def start(self) -> None:
        """Begin to measure."""
        self._thread.start()

    def stop(self) -> None:
        """End; a sensor that hangs is left alone."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(1.0)

    def take(self) -> tuple[int, Host] | None:
        """The measurement since the last call and its time, None when there is none."""
        with self._lock:
            latest, self._latest = self._latest, None
        return latest

    def _run(self) -> None:
        due_ns = self._clock()
        while not self._stopping.is_set():
            try:
                host = self._measure()
            except Exception:  # a sensor's driver may do anything; unknown is the answer then
                host = Host()
            host = self._with_errors(host)
            with self._lock:
                self._latest = (self._clock(), host)
            self._told()
            due_ns = max(due_ns + self._period_ns, self._clock())
            self._stopping.wait((due_ns - self._clock()) / 1e9)

    def _with_errors(self, host: Host) -> Host:
        """NaN where a sensor was there and is no more."""
        self._seen |= {name for name in MEASURED if getattr(host, name) is not None}
        return msgspec.structs.replace(host, **{name: math.nan for name in self._seen if getattr(host, name) is None})


def _hottest(zones: list[tuple[str, float]], words: tuple[str, ...]) -> float | None:
    return max((celsius for name, celsius in zones if any(word in name for word in words)), default=None)


def _temperature(name: str, file: Path) -> Iterator[tuple[str, float]]:
    with suppress(ValueError):
        celsius = int(_text(file)) / 1000
        if LOWEST_C < celsius < HIGHEST_C:
            yield name.lower(), celsius


def _glob(folder: Path, pattern: str) -> list[Path]:
    with suppress(OSError):
        return sorted(folder.glob(pattern))
    return []


def _text(file: Path) -> str:
    """What a file holds, "" when it can't be read."""
    try:
        return file.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
