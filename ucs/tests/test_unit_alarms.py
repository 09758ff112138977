"""The alarms of a unit's buses, of its receiver and of refused commands, in virtual time: each raised by its fault, and over."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import pytest

from bridge.link import Refusal
from level1 import health
from level1.bus_health import WINDOW_NS, BusHealth, Report, Traffic
from level1.catalog import Catalog
from level1.event import Output
from level1.frame import EXTENDED, Frame
from level1.io import definitions
from level1.nmea import Navigator
from level1.supervisor import Supervisor
from level1.tests.plug import FIX, sentence
from ucs.tests.proof import lives, proves
from ucs.uplink import refused

MS, S = 1_000_000, 1_000_000_000
BEGIN, END, LATEST = 20, 110, 140
"""Seconds: the fault is there from the first to the second; the last is when all must be over."""
PASSED = ["raised", "cleared"]
HEALTHY = Traffic({0x123: 2}, sent=1)
Story = Callable[[BusHealth], Iterable[Report]]


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["ucs.dbc"])


# --- buses --------------------------------------------------------------------------------------------------------------------


def windows(bus: BusHealth, begin: int, end: int, traffic: Traffic = HEALTHY) -> Iterator[Report]:
    """What is told of the traffic from one second to another."""
    for t_ns in range(begin * S, end * S, WINDOW_NS):
        yield from bus.window(t_ns, traffic)


def counted(fault: Traffic) -> Story:
    """A fault that shows in what is counted of the traffic, then traffic as it should be."""
    def story(bus: BusHealth) -> Iterator[Report]:
        yield from windows(bus, BEGIN, END, fault)
        yield from windows(bus, END, LATEST)
    return story


def pulled(bus: BusHealth) -> Iterator[Report]:
    yield from bus.down(BEGIN * S, "No such device")
    yield from bus.up(END * S)


def bus_off(bus: BusHealth) -> Iterator[Report]:
    yield from bus.error(BEGIN * S, 0x40, bytes(8))
    yield from bus.heard(END * S)


def error_passive(bus: BusHealth) -> Iterator[Report]:
    yield from bus.error(BEGIN * S, 0x04, bytes([0, 0x20, *bytes(6)]))
    yield from windows(bus, BEGIN, END)
    yield from bus.error(END * S, 0x04, bytes([0, 0x40, *bytes(6)]))
    yield from windows(bus, END, LATEST)


def commands_refused(bus: BusHealth) -> Iterable[Report]:
    return refused(Refusal("wrong signature", "chief", 3), BEGIN * S)


BUS: list[tuple[str, Story]] = [
    ("CanBusDown", pulled),
    ("CanBusOff", bus_off),
    ("CanBusErrors", error_passive),
    ("Babbling", counted(Traffic({0x123: 1000}))),
    ("FramesLost", counted(Traffic({}, lost=7))),
    ("SendFailed", counted(Traffic({}, unsent={"UCS_ALARMS": 1}))),
    ("CommandRefused", commands_refused),
]


@pytest.mark.parametrize(("alarm", "story"), [proves({alarm: PASSED}, alarm, story) for alarm, story in BUS],
                         ids=[alarm for alarm, _ in BUS])
def test_what_is_reported_of_a_bus_or_the_bridge_is_an_alarm_until_it_is_over(
        catalog: Catalog, alarm: str, story: Story) -> None:
    unit = Supervisor(catalog, unit="tractor-7", start_ns=0)
    outputs: list[Output] = []
    for report in story(BusHealth("implement", "can0", 250_000)):
        outputs += unit.tick(report.t_ns)
        unit.report(*report)
    assert lives([*outputs, *unit.tick(2 * LATEST * S)]) == {alarm: PASSED}


@pytest.mark.parametrize(("alarm", "can_id", "addresses"), [
    proves({"SecondTalker": PASSED}, "SecondTalker", 0x18FF_5180, {}),
    proves({"AddressConflict": PASSED}, "AddressConflict", 0x18FF_7780, {0: 0x80})], ids=["SecondTalker", "AddressConflict"])
def test_whoever_sends_what_only_the_unit_may_is_told_until_it_has_been_quiet(
        catalog: Catalog, alarm: str, can_id: int, addresses: dict[int, int]) -> None:
    unit = Supervisor(catalog, unit="tractor-7", start_ns=0, j1939=addresses)
    outputs = list(unit.tick(S))
    outputs += unit.receive_many(Frame(t * S, can_id | EXTENDED, bytes(8)) for t in range(BEGIN, END))
    assert lives([*outputs, *unit.tick(LATEST * S)]) == {alarm: PASSED}


# --- the receiver -------------------------------------------------------------------------------------------------------------


class Said(NamedTuple):
    """What a receiver says in a second: GGA sentence (of 12:00:00) or nothing, and how far the computer's clock is off."""

    fix: str | None = FIX
    clock_error_ns: int = 0


RECEIVER: list[tuple[Said, Mapping[str, Sequence[str]]]] = [
    (Said(None), {"GnssNoData": PASSED}),
    (Said("GPGGA,120000.00,,,,,0,,,,M,,M,,"), {"GnssNoFix": PASSED}),
    (Said(FIX.replace(",E,4,", ",E,5,")), {"GnssRtkLost": PASSED}),
    (Said(FIX.replace("4807.038", "4807.138")), {"GnssJump": [*PASSED, *PASSED]}),
    (Said(clock_error_ns=5 * S), {"GnssClockWrong": PASSED}),
]
"""What it says from `BEGIN` to `END`, and the lives of all alarms. A jump has two: there, and back."""


@pytest.mark.parametrize(("fault", "expected"), [proves(expected, fault, expected) for fault, expected in RECEIVER],
                         ids=[", ".join(expected) for _, expected in RECEIVER])
def test_each_fault_of_the_receiver_raises_its_alarm_and_no_other(
        catalog: Catalog, fault: Said, expected: Mapping[str, Sequence[str]]) -> None:
    unit = Supervisor(catalog, unit="tractor-7", start_ns=0, readings=frozenset(health.GNSS_MESSAGES.values()))
    navigator, readings = Navigator(), health.GnssReadings()
    navigator.opened(0)
    outputs: list[Output] = []
    for tenth in range(10 * LATEST):
        t_ns, second = tenth * 100 * MS, tenth // 10
        said = fault if BEGIN <= second < END else Said()
        spoken = b""
        if said.fix is not None and not tenth % 10:
            time = f"12{second // 60:02}{second % 60:02}.00"
            spoken = sentence(said.fix.replace("120000.00", time)) + sentence(f"GPZDA,{time},29,11,2025,00,00")
        news = navigator.feed(t_ns, spoken)
        for reading in readings.take(t_ns, news, navigator.navigation(t_ns), said.clock_error_ns):
            outputs += unit.publish(t_ns, reading.message, health.raws(catalog.messages[reading.message], reading.values))
    assert lives(outputs) == expected
