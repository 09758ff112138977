"""A week without radio in virtual time, then the backlog over a slow link that breaks: no flood, nothing lost, nothing stalled.

The real journal, bridge, receiver and store; only the clock and what lies between the two MQTT connections are simulated.
"""
from __future__ import annotations

import gc
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from bridge.clock import Clock
from bridge.link import RunLink
from bridge.mqtt import Address, MqttError, Received
from bridge.outbox import BACKLOG_PER_S, WINDOW
from bridge.session import CONNECT_LONGEST_NS, Bridge, Settings
from level1.event import Event, Monitor, seconds
from level1.io.journal import Journal
from level2.receiver import Receiver
from level2.receiver import Settings as ReceiverSettings
from level2.store import Arrival, Store

S = 1_000_000_000
WATCH_NS = 6 * 3600 * S
"""The unit is started anew so often, and raises `A_WATCH` alarms in it."""
WATCHES, A_WATCH = 28, 80
SLOT_NS = S // 10
"""The radio carries something so often: what is sent arrives after one slot or two."""
PERIOD_NS = S // 4
FRESH_NS = 2 * S
"""While the backlog drains the unit goes on raising an alarm so often."""
CUTS_NS = (4 * S, 15 * S)
"""So long after the return of the link it breaks again, and takes along what it carries."""
UNIT = "tractor-7"


class StandingClock(Clock):
    """Goes on only when the bridge waits."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns = S

    def now_ns(self) -> int:
        return self.t_ns

    def select(self, readers: Sequence[int], _: object, __: object, timeout_s: float) -> tuple[list[int], list[int], list[int]]:
        self.t_ns += max(1, int(timeout_s * 1e9))
        return [], [], []


class Radio:
    """The way between unit and level 2. carries: whether it does. attempts: of the unit to connect."""

    def __init__(self, clock: StandingClock):
        self.clock = clock
        self.carries = False
        self.attempts = 0
        self.on_the_way: list[tuple[int, str, Received]] = []
        self.sent: list[tuple[int, str]] = []

    def connect(self, address: Address, client: str, **_: Any) -> End:
        if client.startswith("ucs-level2"):
            return End(self, "down")
        self.attempts += 1
        if not self.carries:
            raise MqttError("broker: can't be reached")
        return End(self, "up")

    def arrived(self, way: str) -> list[Received]:
        now = self.clock.t_ns
        found = [message for due, other, message in self.on_the_way if other == way and due <= now]
        self.on_the_way = [entry for entry in self.on_the_way if entry[1] != way or entry[0] > now]
        return found

    def cut(self, end: Any) -> None:
        self.on_the_way.clear()
        end.lost = "the connection broke"


class End:
    """What `MqttConnection` is to bridge and receiver. way: of what it sends."""

    def __init__(self, radio: Radio, way: str):
        self.radio, self.way = radio, way
        self.address = Address("level2", 1883, False)
        self.ready, self.lost, self.congested = True, "", False

    def publish(self, topic: str, payload: bytes, qos: int = 0, retain: bool = False) -> None:
        if not self.lost:
            now_ns = self.radio.clock.t_ns
            slot_ns = (now_ns // SLOT_NS + 2) * SLOT_NS
            self.radio.sent.append((now_ns, topic.split("/")[4]))
            self.radio.on_the_way.append((slot_ns, self.way, Received(topic, payload, False)))

    def take(self) -> list[Received]:
        return self.radio.arrived("down" if self.way == "up" else "up")

    def wait(self, timeout_s: float, readers: Sequence[int] = ()) -> list[int]:
        if self.way == "up":
            self.radio.clock.t_ns += max(5_000_000, min(int(timeout_s * 1e9), 25_000_000))
        return []

    def close(self) -> None:
        self.lost = "closed"

    abandon = close


class Heard(NamedTuple):
    """An event at level 2, on its disk."""

    t_ns: int
    boot: int
    seq: int
    late: bool


class Site:
    """A unit whose events come when they are told to, and level 2. raised: boot and seq of each event, and when it came."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch):
        self.clock = StandingClock()
        self.radio = Radio(self.clock)
        monkeypatch.setattr("bridge.session.MqttConnection", self.radio.connect)
        monkeypatch.setattr("level2.receiver.MqttConnection", self.radio.connect)
        monkeypatch.setattr("bridge.session.select", SimpleNamespace(select=self.clock.select))
        self.path = folder / "journal.db"
        self.store = Store(folder / "level2.db")
        self.heard: list[Heard] = []
        self.journal = Journal(self.path, UNIT, patience_ns=60 * S)
        self.raised: dict[tuple[int, int], int] = {}
        self.seq = 0
        self.link = RunLink(self.path)
        broker = Address("level2", 1883, False)
        self.bridge = Bridge(Settings(self.path, UNIT, "farm", broker), lambda line: None, self.clock)
        self.receiver = Receiver(ReceiverSettings(broker), self.store, clock=self.clock, told=self.hear, say=lambda line: None)
        self.receiver._connect()

    def hear(self, arrival: Arrival) -> None:
        self.heard.append(Heard(self.clock.t_ns, arrival.alarm.boot, arrival.alarm.seq, arrival.alarm.historical))

    def raise_alarms(self, count: int) -> None:
        events = []
        for _ in range(count):
            self.seq += 1
            self.raised[self.journal.boot, self.seq] = self.clock.t_ns
            events.append(Event(UNIT, self.journal.boot, self.seq, seconds(self.clock.t_ns), None, False, "NozzlesNotSet", 2109,
                                "Medium", "raised", self.seq, 0, {"SPRAYER_STATUS.Valves": 4095}, "Nozzles not set"))
        assert self.journal.append(events, b"")

    def reboot(self) -> None:
        self.journal.close()
        self.journal = Journal(self.path, UNIT, patience_ns=60 * S)
        self.seq = 0

    def turn(self) -> None:
        now = seconds(self.clock.t_ns)
        self.link.send_samples(Monitor(UNIT, self.journal.boot, now, None, False, "motion", {"v": 2.0}, {}, {}))
        self.bridge._turn()
        assert self.receiver._connection
        self.receiver._turn(self.receiver._connection)
        assert self.bridge._outbox and self.bridge._outbox.in_flight <= WINDOW

    def waiting(self) -> int:
        assert self.bridge._outbox
        return self.bridge._outbox.waiting()

    def close(self) -> None:
        self.bridge._close()
        self.link.close()
        self.journal.close()
        self.store.close()
        self.receiver._waker.close()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    site = Site(tmp_path, monkeypatch)
    yield site
    site.close()


def most_within(times_ns: list[int], span_ns: int) -> int:
    """The most of these times, in order, that fall into a span."""
    return max(bisect_left(times_ns, t_ns + span_ns) - place for place, t_ns in enumerate(times_ns))


@pytest.mark.fault("a week without radio",
                   "complete, newest first, at most 100 a second of the backlog, monitoring at its period, no memory gathered")
def test_a_week_offline_drains_without_a_flood_and_newest_first(site: Site) -> None:
    begin_ns = site.clock.t_ns
    for watch in range(WATCHES):
        if watch:
            site.reboot()
        site.raise_alarms(A_WATCH)
        while site.clock.t_ns < begin_ns + (watch + 1) * WATCH_NS:
            site.turn()
    old = len(site.raised)
    assert site.heard == [] and site.waiting() == old
    assert site.radio.attempts < 1.2 * WATCHES * WATCH_NS / CONNECT_LONGEST_NS  # a broker that is not there is not pressed

    site.radio.carries = True
    while not site.bridge.online:
        site.turn()
    back_ns = fresh_ns = site.clock.t_ns
    cuts = [back_ns + cut_ns for cut_ns in CUTS_NS]
    site.radio.sent.clear()
    objects: list[int] = []
    while len(site.heard) < len(site.raised) or site.waiting():
        if site.clock.t_ns >= fresh_ns and len(site.heard) < old * 9 // 10:
            fresh_ns = site.clock.t_ns + FRESH_NS
            site.raise_alarms(1)
        if cuts and site.clock.t_ns >= cuts[0]:
            cuts.pop(0)
            site.radio.cut(site.bridge._connection)
        site.turn()
        assert site.clock.t_ns < back_ns + 3 * old * S // BACKLOG_PER_S
        if len(site.heard) >= (len(objects) + 1) * old // 4:
            gc.collect()
            objects.append(len(gc.get_objects()) - len(site.heard))

    assert [(heard.boot, heard.seq) for heard in sorted(site.heard, key=lambda heard: heard[1:3])] == list(site.raised)
    assert [(event.boot, event.seq) for event in site.store.events()] == list(site.raised)
    assert site.store.count("lost") == site.store.count("conflict") == 0 and site.receiver.counters["refused"] == 0
    assert max(objects) < objects[0] + old // 2  # nothing is kept of each event

    alarms = [t_ns for t_ns, kind in site.radio.sent if kind == "alarm"]
    assert most_within(alarms, S) <= BACKLOG_PER_S + 2 * WINDOW  # at most what was saved up, and a window sent again
    fresh = [heard for heard in site.heard if not heard.late]
    assert len(fresh) >= 5
    assert all(heard.t_ns - site.raised[heard.boot, heard.seq] < S for heard in fresh)
    late = [heard for heard in site.heard if heard.late]
    assert len(late) >= old and all(site.raised[heard.boot, heard.seq] < heard.t_ns for heard in late)
    samples = [t_ns for t_ns, kind in site.radio.sent if kind == "monitor"]
    pauses = [after - before for before, after in pairwise(samples)]
    assert sorted(pauses)[-len(CUTS_NS) - 1] <= 2 * PERIOD_NS  # but for the cuts themselves
