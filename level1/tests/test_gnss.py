"""The receiver on its line: read live, lost, found again, never waited for."""
from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from level1.health import MOTION, POSITION, STATUS, TIME, Reading
from level1.io.config import Gnss
from level1.io.gnss import READINGS, GnssReceiver, Line, open_line
from level1.tests.plug import FIX, Plug, sentence

WAIT_S = 30.0
S = 1_000_000_000


class Bench:
    """A receiver under test, its readings and notices."""

    def __init__(self, settings: Gnss, opener: Callable[[Gnss], Line] | None = None):
        self.notices: list[str] = []
        self.readings: list[Reading] = []
        self.receiver = GnssReceiver(settings, clock=time.monotonic_ns, wall=time.time_ns, told=lambda: None,
                                     notice=self.notices.append, opener=opener)
        self.receiver.start()

    def until(self, condition: Callable[[], Any], meanwhile: Callable[[], None] = lambda: None) -> None:
        """Take readings until the condition holds."""
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f"waited in vain; {self.notices} {self.readings[-3:]}"
            meanwhile()
            time.sleep(0.01)
            self.readings += self.receiver.take()

    def last(self, message: str, signal: str) -> Any:
        """The latest value of a signal."""
        return next((reading.values[signal] for reading in reversed(self.readings) if reading.message == message), "nothing")


@pytest.fixture
def plug(tmp_path: Path) -> Plug:
    return Plug(tmp_path / "gnss0")


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    """Makes benches; stopped at the end, when the thread must still have been alive."""
    made: list[Bench] = []

    def make(*args: Any) -> Bench:
        made.append(Bench(*args))
        return made[-1]
    yield make
    for one in made:
        assert one.receiver._thread.is_alive()
        one.receiver.stop()
        assert not one.receiver._thread.is_alive()


def test_a_receiver_is_read(plug: Plug, bench: Callable[..., Bench]) -> None:
    one = bench(Gnss(str(plug.path)))
    said = (FIX, "GPHDT,274.07,T", "GPVTG,74.45,T,,M,5.5,N,10.2,K,A", "GPZDA,120000.00,07,09,2018,00,00")
    one.until(lambda: one.last(TIME, "GnssTimeConfirmed") is True, lambda: plug.say(*said))
    assert one.last(POSITION, "GnssLatitude") == pytest.approx(48.1173)
    assert (one.last(MOTION, "GnssSpeed"), one.last(MOTION, "GnssHeading")) == (10.2, 274.07)
    assert (one.last(STATUS, "GnssFix"), one.last(STATUS, "GnssReceiver")) == ("RtkFixed", "Receiving")
    assert one.receiver.fix == 4
    stamps = [reading.t_ns for reading in one.readings]
    assert stamps == sorted(stamps) and stamps[-1] <= time.monotonic_ns()


def test_utc_of_the_satellites_stands_beside_the_clock_of_the_computer(plug: Plug, bench: Callable[..., Bench]) -> None:
    one = bench(Gnss(str(plug.path)))
    assert one.receiver.utc_offset_ns() is None
    said = time.gmtime(time.time() - 7)

    def say() -> None:
        plug.say(FIX, time.strftime("GPZDA,%H%M%S.00,%d,%m,%Y,00,00", said))
    one.until(lambda: one.receiver.utc_offset_ns() is not None, say)
    offset = one.receiver.utc_offset_ns()
    assert offset is not None and abs(time.time_ns() - time.monotonic_ns() - offset - 7 * S) < 5 * S
    one.until(lambda: one.last(TIME, "GnssClockError") not in ("nothing", None))
    assert one.last(TIME, "GnssClockError") > 2000


def test_a_quiet_receiver_gives_signs_of_life_that_say_so(plug: Plug, bench: Callable[..., Bench]) -> None:
    one = bench(Gnss(str(plug.path)))
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Quiet")
    assert one.last(POSITION, "GnssLatitude") is None and one.last(STATUS, "GnssFix") is None


def test_its_line_is_opened_anew_when_it_is_asked_to(plug: Plug, bench: Callable[..., Bench]) -> None:
    opened: list[Line] = []

    def opener(settings: Gnss) -> Line:
        opened.append(open_line(settings))
        return opened[-1]
    one = bench(Gnss(str(plug.path)), opener)
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", lambda: plug.say(FIX))
    one.receiver.reopen()
    one.until(lambda: len(opened) == 2)
    one.readings.clear()
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", lambda: plug.say(FIX))
    assert one.notices == [f"gnss {plug.path}: opened anew, to get the time"]
    assert not one.receiver.counters["lost"]


@pytest.mark.parametrize("half", [0, 30])
def test_unplugged_and_plugged_again_and_again(plug: Plug, bench: Callable[..., Bench], half: int) -> None:
    one = bench(Gnss(str(plug.path)))
    for round_ in range(4):
        one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", lambda: plug.say(FIX))
        plug.send(sentence(FIX)[:half])
        plug.unplug()
        one.until(lambda: one.last(STATUS, "GnssReceiver") == "Unplugged")
        assert len(one.notices) == 2 * round_ + 1 and "; trying again" in one.notices[-1]
        plug.plug()
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", lambda: plug.say(FIX))
    assert one.notices[-1].endswith(": back") and one.receiver.counters["lost"] == 4
    assert one.receiver.counters["unreadable sentences"] == 0


def test_a_port_that_is_not_there_yet_is_waited_for(tmp_path: Path, bench: Callable[..., Bench]) -> None:
    one = bench(Gnss(str(tmp_path / "gnss0")))
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Unplugged")
    assert len(one.notices) == 1 and "No such file" in one.notices[0]
    plug = Plug(tmp_path / "gnss0")
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", lambda: plug.say(FIX))


@pytest.mark.parametrize("failure", [RuntimeError("a bug of a driver"), OSError(5, "Input/output error"), ValueError()])
def test_whatever_a_driver_raises_the_thread_lives_on(plug: Plug, bench: Callable[..., Bench], failure: Exception) -> None:
    failures = [failure, failure]

    def opener(settings: Gnss) -> Line:
        if failures:
            raise failures.pop()
        return open_line(settings)
    one = bench(Gnss(str(plug.path)), opener)
    one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", lambda: plug.say(FIX))
    assert not failures and one.receiver.counters["lost"] == 1


def test_a_receiver_on_ethernet_comes_and_goes(bench: Callable[..., Bench]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        one = bench(Gnss(f"socket://127.0.0.1:{server.getsockname()[1]}"))
        for _ in range(2):
            line, _ = server.accept()
            with line:
                one.until(lambda: one.last(STATUS, "GnssReceiver") == "Receiving", partial(line.sendall, sentence(FIX) * 20))
            one.until(lambda: one.last(STATUS, "GnssReceiver") == "Unplugged")
    assert one.receiver.counters["sentences"] >= 40 and one.receiver.counters["lost"] == 2


def test_readings_that_nobody_takes_are_dropped_the_oldest_first(plug: Plug, bench: Callable[..., Bench]) -> None:
    one = bench(Gnss(str(plug.path)))
    end = time.monotonic() + 4 * WAIT_S
    second = 0
    while not one.receiver.counters["readings dropped"] and time.monotonic() < end:
        plug.say(*(FIX.replace("120000.00", f"12{second // 60 % 60:02d}{second % 60:02d}.00") for _ in range(3)))
        second += 1
        time.sleep(0.008)
    readings = one.receiver.take()
    assert len(readings) == READINGS and one.receiver.counters["readings dropped"] > 0
    assert readings[-1].t_ns > readings[0].t_ns
