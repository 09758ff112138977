"""A GNSS receiver on a serial line of a running `ucs run`: its alarms, its frames on the bus, its plug pulled again and again."""
from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest

from hil_tests.conftest import SOON_S, START_S, Process, told
from level1.decode import Scale, raw_of
from level1.io.definitions import load
from level1.io.journal import read_events
from level1.tests.plug import FIX, Plug, sentence
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

NO_FIX = "GPGGA,,,,,,0,,,,M,,M,,"


class Talker:
    """Says the same sentences ten times a second, at the present time, until it is told to stop."""

    def __init__(self, plug: Plug):
        self.plug = plug
        self.bodies: tuple[str, ...] = (FIX,)
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.1):
            now = time.time()
            stamp = time.strftime("%H%M%S", time.gmtime(now)) + f".{int(now * 100) % 100:02d}"
            with self._lock:
                self.plug.say(*(body.replace("120000.00", stamp) for body in self.bodies),
                              time.strftime(f"GPZDA,{stamp},%d,%m,%Y,00,00", time.gmtime(now)))

    @contextmanager
    def interrupted(self) -> Iterator[None]:
        """Within it nothing is said."""
        with self._lock:
            yield

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()


@pytest.fixture
def talker(tmp_path: Path) -> Iterator[Talker]:
    one = Talker(Plug(tmp_path / "gnss0"))
    yield one
    one.stop()


@pytest.fixture
def run(tmp_path: Path, talker: Talker, process: Callable[..., Process]) -> Process:
    """`ucs run`, supervising."""
    file = tmp_path / "unit.toml"
    file.write_text(unit_toml("ucs.dbc", more=f'[gnss]\nport = "{talker.plug.path}"\nbroadcast = true'))
    started = process("run", file)
    started.expect("; supervising$", START_S)
    return started


@pytest.mark.covers("GnssNoFix", "raised", "cleared")
@pytest.mark.covers("GnssRtkLost", "raised")
def test_no_fix_is_told_with_the_time_of_the_satellites_and_over(run: Process, talker: Talker, tmp_path: Path) -> None:
    talker.bodies = (NO_FIX,)
    run.expect("GnssNoFix +raised", SOON_S)
    talker.bodies = (FIX,)
    run.expect("GnssNoFix +cleared", SOON_S)
    talker.bodies = (FIX.replace(",4,12,", ",1,12,"),)
    run.expect("GnssRtkLost +raised", SOON_S)
    assert run.stop() == 0
    events = list(read_events(tmp_path / "journal.db"))
    assert [(event.alarm, event.event) for event in events if event.alarm.startswith("Gnss")] == [
        ("GnssNoFix", "raised"), ("GnssNoFix", "cleared"), ("GnssRtkLost", "raised")]
    last = events[-1]
    assert last.utc_trusted and last.utc and last.utc.startswith(time.strftime("%Y-%m-%dT", time.gmtime()))
    assert last.values["UCS_GNSS_STATUS.GnssFix"] == "Gnss"


def test_where_the_unit_is_stands_on_the_bus(run: Process, talker: Talker) -> None:
    message = load(["ucs.dbc"]).messages["UCS_GNSS_POSITION"]
    end = time.monotonic() + SOON_S
    with can.Bus(channel="vcan0", interface="socketcan",
                 can_filters=[{"can_id": message.can_id, "can_mask": 0x1FFFFFFF, "extended": True}]) as bus:
        found = None
        while found is None or found[0] > 90:
            assert time.monotonic() < end
            heard = bus.recv(SOON_S)
            assert heard is not None
            found = [float(Scale(signal).physical(raw_of(signal, bytes(heard.data)) or 0)) for signal in message.signals]
    assert found == pytest.approx([48.1173, 11.516667], abs=1e-6)
    assert run.returncode is None


@pytest.mark.covers("GnssNoData", "raised", "cleared")
def test_the_plug_is_pulled_and_put_in_again(run: Process, talker: Talker, tmp_path: Path) -> None:
    for _ in range(3):
        with talker.interrupted():
            talker.plug.send(sentence(FIX)[:37])
            talker.plug.unplug()
            run.expect("gnss .*: lost .*trying again", SOON_S)
            run.expect("GnssNoData +raised +high: .*Unplugged", SOON_S)
            talker.plug.plug()
        run.expect("gnss .*: back", SOON_S)
        run.expect("GnssNoData +cleared", SOON_S)
    assert run.stop() == 0
    events = [event.event for event in told(tmp_path, "GnssNoData")]
    assert events == ["raised", "cleared"] * 3


def test_a_receiver_that_speaks_at_the_wrong_rate_is_garbled(run: Process, talker: Talker) -> None:
    dice = random.Random(1)
    with talker.interrupted():
        end = time.monotonic() + 6
        while time.monotonic() < end:
            talker.plug.send(dice.randbytes(50))
            time.sleep(0.05)
        run.expect("GnssNoData +raised +high: .*Garbled", SOON_S)
    run.expect("GnssNoData +cleared", SOON_S)


def test_a_hundred_pulls_in_any_rhythm_end_in_a_receiver_that_is_read(run: Process, talker: Talker, tmp_path: Path) -> None:
    dice = random.Random(7)
    with talker.interrupted():
        for _ in range(100):
            talker.plug.send(dice.choice([sentence(FIX), sentence(FIX)[:dice.randrange(80)], dice.randbytes(40), b""]))
            time.sleep(dice.choice([0, 0.01, 0.1]))
            talker.plug.unplug()
            time.sleep(dice.choice([0, 0.01, 0.1]))
            talker.plug.plug()
    talker.bodies = (NO_FIX,)
    run.expect("GnssNoFix +raised", SOON_S)
    talker.bodies = (FIX,)
    run.expect("GnssNoFix +cleared", SOON_S)
    assert run.stop() == 0
    last = {event.alarm: event.event for event in read_events(tmp_path / "journal.db") if event.alarm.startswith("Gnss")}
    assert set(last.values()) == {"cleared"}


class BusReceiver:
    """A GNSS receiver on the bus (PGN 65267, five times a second). latitude: None while it has no fix; silent: says nothing."""

    def __init__(self) -> None:
        self.latitude: float | None = 48.1173
        self.silent = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with can.Bus(channel="vcan0", interface="socketcan") as bus:
            while not self._ended.wait(0.2):
                place = self.latitude
                raws = [0xFFFF_FFFF] * 2 if place is None else [round((angle + 210) * 1e7) for angle in (place, 11.5167)]
                if not self.silent:
                    bus.send(can.Message(arbitration_id=0x18FEF31C, data=b"".join(raw.to_bytes(4, "little") for raw in raws)))

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()


def test_a_receiver_on_the_bus_has_the_same_alarms(tmp_path: Path, process: Callable[..., Process]) -> None:
    file = tmp_path / "unit.toml"
    file.write_text(unit_toml("ucs.dbc", "isobus_tractor.dbc", more='[gnss]\nbus = "implement"'))
    receiver = BusReceiver()
    try:
        run = process("run", file)
        run.expect("; supervising$", START_S)
        time.sleep(1)
        receiver.latitude = 48.1273  # 1.1 km further
        run.expect("GnssJump +raised", SOON_S)
        receiver.latitude = None
        run.expect("GnssNoFix +raised", 10 + SOON_S)  # its delay
        receiver.latitude = 48.1273
        run.expect("GnssNoFix +cleared", SOON_S)
        receiver.silent = True
        run.expect("GnssNoData +raised", 16.5 + SOON_S)  # silent for 15.5 s, and its delay
        receiver.silent = False
        run.expect("GnssNoData +cleared", SOON_S)
        assert run.stop() == 0
    finally:
        receiver.stop()
