"""The state of the computer: what it has sensors for is read, what it has none for stays unknown."""
from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from level1.health import Host
from level1.io.host import (
    HostWatch,
    Places,
    clock_is_synchronised,
    load,
    measure,
    ram_used_percent,
    storage_used_percent,
    temperatures,
)

WAIT_S = 30.0


@pytest.fixture
def places(tmp_path: Path) -> Places:
    """A computer without any sensor."""
    return Places(storage=tmp_path, thermal=tmp_path / "thermal", hwmon=tmp_path / "hwmon", proc=tmp_path / "proc")


def write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text + "\n")


def zone(places: Places, number: int, kind: str, reading: str) -> None:
    write(places.thermal / f"thermal_zone{number}" / "type", kind)
    write(places.thermal / f"thermal_zone{number}" / "temp", reading)


def chip(places: Places, name: str, **sensors: str) -> None:
    """A hwmon chip; sensors: label -> millidegrees, an empty label for none."""
    folder = places.hwmon / f"hwmon{len(list(places.hwmon.glob('*')))}"
    write(folder / "name", name)
    for number, (label, reading) in enumerate(sensors.items(), 1):
        write(folder / f"temp{number}_input", reading)
        if label != "unnamed":
            write(folder / f"temp{number}_label", label)


class TestTemperatures:
    def test_a_computer_without_sensors_says_nothing(self, places: Places) -> None:
        state = measure(places)
        assert (state.cpu_celsius, state.mainboard_celsius) == (None, None)

    def test_the_hottest_of_each_kind_counts(self, places: Places) -> None:
        zone(places, 0, "acpitz", "27800")
        zone(places, 1, "x86_pkg_temp", "61000")
        chip(places, "coretemp", **{"Package id 0": "60000", "Core 0": "64500"})
        chip(places, "nct6775", SYSTIN="44000", CPUTIN="50000", AUXTIN0="99000")
        state = measure(places)
        assert (state.cpu_celsius, state.mainboard_celsius) == (64.5, 44.0)

    @pytest.mark.parametrize("kind", ["cpu-thermal", "cpu_thermal", "soc-thermal", "CPU-therm"])
    def test_the_zone_of_a_small_board_is_the_processor(self, places: Places, kind: str) -> None:
        zone(places, 0, kind, "48312")
        state = measure(places)
        assert (state.cpu_celsius, state.mainboard_celsius) == (48.312, None)

    @pytest.mark.parametrize(("name", "label"), [("nvme", "Composite"), ("iwlwifi_1", "unnamed"), ("amdgpu", "edge")])
    def test_disks_and_radios_are_neither(self, places: Places, name: str, label: str) -> None:
        chip(places, name, **{label: "80000"})
        state = measure(places)
        assert (state.cpu_celsius, state.mainboard_celsius) == (None, None)

    @pytest.mark.parametrize("reading", ["-128000", "255000", "", "n/a", "-273150"])
    def test_a_broken_sensor_says_nothing(self, places: Places, reading: str) -> None:
        zone(places, 0, "cpu-thermal", reading)
        assert measure(places).cpu_celsius is None

    def test_a_sensor_that_fails_when_it_is_read_does_not_hide_the_others(self, places: Places) -> None:
        zone(places, 0, "cpu-thermal", "48000")
        (places.thermal / "thermal_zone1" / "temp").mkdir(parents=True)
        assert list(temperatures(places)) == [("cpu-thermal", 48.0)]


class TestMemoryAndLoad:
    def test_what_programs_can_not_get_any_more_is_used(self, tmp_path: Path) -> None:
        write(tmp_path / "meminfo", "MemTotal:        2000000 kB\nMemFree:           10000 kB\nMemAvailable:     500000 kB")
        assert ram_used_percent(tmp_path) == 75.0

    @pytest.mark.parametrize("text", [
        "", "MemTotal: 0 kB\nMemAvailable: 0 kB", "MemTotal: 2000 kB", "MemTotal:\nMemAvailable: x kB"])
    def test_a_kernel_that_does_not_say_is_unknown(self, tmp_path: Path, text: str) -> None:
        write(tmp_path / "meminfo", text)
        assert ram_used_percent(tmp_path) is None

    def test_load_counts_for_each_processor(self, tmp_path: Path) -> None:
        write(tmp_path / "loadavg", "3.00 1.00 0.50 2/345 6789")
        assert load(tmp_path) == 3.0 / len(os.sched_getaffinity(0))
        write(tmp_path / "loadavg", "much")
        assert load(tmp_path) is None
        assert load(tmp_path / "nowhere") is None

    def test_this_computer_has_memory_and_a_load(self) -> None:
        state = measure(Places(storage=Path("/")))
        assert state.ram_used_percent is not None and 0 < state.ram_used_percent < 100
        assert state.load is not None and state.load >= 0
        assert state.storage_used_percent is not None and 0 <= state.storage_used_percent <= 100
        assert state.clock_synchronised == clock_is_synchronised()


class TestStorage:
    @pytest.mark.parametrize(("blocks", "free", "available", "used"), [
        (1000, 400, 400, 60.0), (1000, 100, 50, 94.7368421), (1000, 50, 0, 100.0), (0, 0, 0, None), (1000, 1000, 0, 100.0)])
    def test_what_the_system_keeps_for_itself_is_not_free(
            self, monkeypatch: pytest.MonkeyPatch, blocks: int, free: int, available: int, used: float | None) -> None:
        state = os.statvfs_result((4096, 4096, blocks, free, available, 0, 0, 0, 0, 255))
        monkeypatch.setattr(os, "statvfs", lambda _: state)
        assert storage_used_percent(Path("/")) == (None if used is None else pytest.approx(used))

    def test_a_storage_that_is_gone_is_unknown(self, tmp_path: Path) -> None:
        assert storage_used_percent(tmp_path / "nowhere") is None


class TestWatch:
    def watch(self, measure: Callable[[], Host]) -> tuple[HostWatch, threading.Event]:
        told = threading.Event()
        return HostWatch(1_000_000, measure, time.monotonic_ns, told.set), told

    def test_each_measurement_is_taken_once(self) -> None:
        hosts = iter([Host(load=1.0), Host(load=2.0)])
        blocked = threading.Event()

        def measure() -> Host:
            found = next(hosts, None)
            if found is None:
                blocked.wait(WAIT_S)
            return found or Host()
        watch, told = self.watch(measure)
        before = time.monotonic_ns()
        watch.start()
        found: list[Any] = []
        while len(found) < 1 or found[-1][1].load != 2.0:
            assert told.wait(WAIT_S)
            told.clear()
            if latest := watch.take():
                found.append(latest)
        assert before <= found[-1][0] <= time.monotonic_ns()
        assert watch.take() is None
        blocked.set()
        watch.stop()

    def test_a_sensor_that_hangs_holds_nobody_up(self) -> None:
        hang = threading.Event()

        def measure() -> Host:
            hang.wait(WAIT_S)
            return Host()
        watch, _ = self.watch(measure)
        watch.start()
        assert watch.take() is None
        hang.set()
        watch.stop()

    def test_a_sensor_that_was_there_and_is_gone_is_an_error_and_one_that_never_was_is_unknown(self) -> None:
        answers = [Host(cpu_celsius=50.0, storage_used_percent=10.0), Host(storage_used_percent=10.0), Host(cpu_celsius=51.0)]
        watch, _ = self.watch(Host)
        found = [watch._with_errors(host) for host in answers]
        assert (found[0].cpu_celsius, found[0].mainboard_celsius) == (50.0, None)
        assert math.isnan(found[1].cpu_celsius or 0) and (found[1].storage_used_percent, found[1].mainboard_celsius) == (10.0, None)
        assert found[2].cpu_celsius == 51.0 and math.isnan(found[2].storage_used_percent or 0)

    def test_a_driver_that_raises_leaves_everything_unknown_and_is_asked_again(self) -> None:
        answers: list[Any] = [RuntimeError("a driver"), OSError(5, "I/O error")]

        def measure() -> Host:
            if answers:
                raise answers.pop(0)
            return Host(load=0.5)
        watch, told = self.watch(measure)
        watch.start()
        while not (latest := watch.take()) or latest[1].load is None:
            assert told.wait(WAIT_S)
            told.clear()
        watch.stop()
