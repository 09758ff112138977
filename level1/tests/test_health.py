"""What the UCS says of itself: unknown is never healthy, and what is wrong becomes an alarm like any other."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1 import health
from level1.decode import ERROR, GOOD, UNAVAILABLE, Scale, encode, quality_of, raw_of
from level1.event import Commanded, Event, Send
from level1.frame import Frame, frame_key
from level1.health import (
    GNSS_MESSAGES,
    HEALTH,
    HOST_MESSAGES,
    LOAD,
    POSITION,
    STATUS,
    TIME,
    GnssReadings,
    Host,
    Loop,
    Reading,
    Value,
)
from level1.io import housekeeping, live
from level1.io.definitions import load
from level1.io.inbox import Inbox
from level1.navigation import FIXES, LINKS, Navigation
from level1.supervisor import Supervisor

MS, S = 1_000_000, 1_000_000_000
ALL = (*HOST_MESSAGES, *GNSS_MESSAGES.values())
CATALOG = load(["ucs.dbc"], {0: ["ucs.dbc"]})
WELL = Host(50.0, 40.0, 30.0, 20.0, 0.5, True)
FINE = Loop(2 * MS, 0, "BusActive", 30.0, "JournalOk", True, True, 0)


def qualities(name: str, values: Mapping[str, Value]) -> dict[str, int]:
    """What a receiver of the message makes of its signals."""
    message = CATALOG.messages[name]
    data = encode(message, health.raws(message, values))
    return {signal.name: quality_of(signal, message.j1939, raw_of(signal, data) or 0) for signal in message.signals}


def physical(name: str, values: Mapping[str, Value]) -> dict[str, Any]:
    """The values a receiver of the message reads, words where there are any."""
    message = CATALOG.messages[name]
    raws = health.raws(message, values)
    return {signal.name: signal.choices.get(raws[signal.name], Scale(signal).physical(raws[signal.name]))
            for signal in message.signals}


class TestRawValues:
    @pytest.mark.parametrize("name", ALL)
    def test_what_is_not_known_is_not_available(self, name: str) -> None:
        assert set(qualities(name, {}).values()) == {UNAVAILABLE}

    @pytest.mark.parametrize("name", ALL)
    def test_what_can_not_be_is_an_error(self, name: str) -> None:
        message = CATALOG.messages[name]
        assert set(qualities(name, {signal.name: float("nan") for signal in message.signals}).values()) == {ERROR}
        words = {signal.name: "NoSuchWord" for signal in message.signals}
        assert set(qualities(name, words).values()) == {ERROR}

    @pytest.mark.parametrize("name", ALL)
    @given(value=st.floats(allow_nan=False))
    def test_any_number_fits_and_is_good(self, name: str, value: float) -> None:
        message = CATALOG.messages[name]
        assert set(qualities(name, {signal.name: value for signal in message.signals}).values()) == {GOOD}

    def test_every_word_is_in_the_value_tables(self) -> None:
        for fix, word in enumerate(FIXES):
            assert physical(STATUS, health.status(Navigation(fix=fix)))["GnssFix"] == word
        for word in LINKS:
            assert physical(STATUS, health.status(Navigation(link=word)))["GnssReceiver"] == word
        for word in ("JournalOk", *(word for _, word in housekeeping.JOURNAL_WORDS), "JournalFailed"):
            assert physical(HEALTH, health.health(WELL, Loop(journal=word), None, False))["JournalState"] == word
        for word in health.BUS_STATES:
            assert physical(HEALTH, health.health(WELL, Loop(bus_state=word), None, False))["BusState"] == word

    def test_a_healthy_computer(self) -> None:
        assert physical(HEALTH, health.health(WELL, FINE, 4, False)) == {
            "CpuTemperature": 50, "MainboardTemperature": 40, "RamUsed": 30.0, "StorageUsed": 20.0, "StorageWrite": "Ok",
            "TrafficLog": "Ok", "BusState": "BusActive", "TimeSync": "Synchronised", "JournalState": "JournalOk",
            "GnssQuality": "RtkFixed", "LoopLateness": 0, "BusLoad": 30.0}
        assert physical(LOAD, health.load(WELL, FINE)) == {"LoadAverage": 0.5, "FramesDropped": 0, "TrafficLogDropped": 0}

    def test_a_computer_that_measures_nothing(self) -> None:
        assert set(qualities(HEALTH, health.health(Host(), Loop(), None, False)).values()) == {UNAVAILABLE}
        assert set(qualities(LOAD, health.load(Host(), Loop())).values()) == {UNAVAILABLE}

    @pytest.mark.parametrize(("clock", "gnss", "word"), [
        (True, False, "Synchronised"), (False, True, "Synchronised"), (False, False, "NotSynchronised"),
        (None, True, "Synchronised"), (None, False, "NotAvailable")])
    def test_time_is_synchronised_by_the_kernel_or_the_satellites(self, clock: bool | None, gnss: bool, word: str) -> None:
        host = Host(clock_synchronised=clock)
        assert physical(HEALTH, health.health(host, FINE, None, gnss))["TimeSync"] == word

    @pytest.mark.parametrize(("fix", "word"), [(0, "NoFix"), (1, "Gnss"), (5, "RtkFloat"), (6, "NoFix"), (8, "NoFix"),
                                               (None, "NotAvailable")])
    def test_a_guessed_position_is_no_fix(self, fix: int | None, word: str) -> None:
        assert physical(HEALTH, health.health(WELL, FINE, fix, False))["GnssQuality"] == word

    def test_position_to_the_centimetre_and_time_to_the_millisecond(self) -> None:
        known = Navigation(latitude_deg=-45.8775672, longitude_deg=170.5001113, time_of_day_ns=86_399_999_000_000,
                           utc_ns=1_555_029_624 * S, utc_confirmed=True)
        found = physical(POSITION, health.position(known))
        assert (found["GnssLatitude"], found["GnssLongitude"]) == pytest.approx((-45.8775672, 170.5001113), abs=6e-8)
        assert physical(TIME, health.time(known, -1_500 * MS)) == {
            "GnssTimeOfDay": 86_399_999, "GnssDate": 17_998, "GnssClockError": -1500, "GnssTimeConfirmed": "Yes"}


class TestSignsOfLife:
    def test_news_at_once_and_the_rest_once_a_second(self) -> None:
        readings = GnssReadings()
        assert {reading.message for reading in readings.take(0, (), Navigation(), None)} == set(GNSS_MESSAGES.values())
        assert readings.take(500 * MS, (), Navigation(), None) == []
        assert [reading.message for reading in readings.take(600 * MS, {"position"}, Navigation(), None)] == [POSITION]
        assert {reading.message for reading in readings.take(950 * MS, (), Navigation(), None)} == {
            *GNSS_MESSAGES.values()} - {POSITION}
        readings.again()
        assert len(readings.take(951 * MS, (), Navigation(), None)) == len(GNSS_MESSAGES)


# -- through the supervisor ------------------------------------------------------------------------------------------------

def unit(**more: Any) -> Supervisor:
    return Supervisor(CATALOG, unit="a", start_ns=0, readings=ALL, **more)


def published(supervisor: Supervisor, t_ns: int, name: str, values: Mapping[str, Value], broadcast: bool = True) -> list[Any]:
    return list(supervisor.publish(t_ns, name, health.raws(CATALOG.messages[name], values), broadcast))


def alarms(outputs: Sequence[Any]) -> list[tuple[float, str, str]]:
    return [(float(output.t), output.alarm, output.event) for output in outputs if isinstance(output, Event)]


class TestPublishing:
    def test_a_reading_is_sent_on_the_bus_and_known_to_the_conditions(self) -> None:
        supervisor = unit()
        supervisor.tick(0)
        outputs = published(supervisor, S, STATUS, health.status(Navigation(fix=0, link="Receiving")))
        sends = [output for output in outputs if isinstance(output, Send)]
        assert [(send.t_ns, send.key, send.message) for send in sends if send.message == STATUS] == [
            (S, frame_key(CATALOG.messages[STATUS].can_id, True), STATUS)]
        found = alarms(outputs)
        for second in range(2, 15):
            found += alarms(published(supervisor, second * S, STATUS, health.status(Navigation(fix=0, link="Receiving"))))
        assert found == [(11.0, "GnssNoFix", "raised")]

    def test_not_available_passes_the_gate_for_readings_only(self) -> None:
        supervisor = unit()
        supervisor.tick(0)
        outputs = published(supervisor, S, HEALTH, {})
        assert HEALTH in {output.message for output in outputs if isinstance(output, Send)}
        assert supervisor.counters["readings not sent"] == 0
        silent = Supervisor(CATALOG, unit="a", start_ns=0)
        silent.tick(0)
        outputs = published(silent, S, HEALTH, {})
        assert HEALTH not in {output.message for output in outputs if isinstance(output, Send)}
        assert silent.counters["readings not sent"] == 1

    def test_one_that_is_not_to_be_sent_is_known_all_the_same(self) -> None:
        supervisor = unit()
        supervisor.tick(0)
        found = []
        for second in range(1, 4):
            outputs = published(supervisor, second * S, STATUS, health.status(Navigation(link="Unplugged")), broadcast=False)
            assert STATUS not in {output.message for output in outputs if isinstance(output, Send)}
            found += alarms(outputs)
        assert found == [(2.0, "GnssNoData", "raised")] and supervisor.counters["readings not sent"] == 0

    def test_a_reading_from_before_the_last_frame_counts_as_now(self) -> None:
        supervisor = unit()
        supervisor.receive(Frame(5 * S, 0x123, b""))
        outputs = published(supervisor, 4 * S, STATUS, {})
        assert all(output.t_ns == 5 * S for output in outputs if isinstance(output, Send))
        assert supervisor.counters["time stamps that ran backwards"] == 0

    def test_publishing_and_receiving_are_the_same_to_the_alarms(self) -> None:
        by_hand, by_frame = unit(), unit()
        found: list[list[Any]] = [[], []]
        message = CATALOG.messages[HEALTH]
        for second in range(200):
            host = Host(cpu_celsius=60.0 + second / 4, clock_synchronised=second < 20)
            values = health.health(host, FINE, None, False)
            found[0] += alarms(published(by_hand, second * S, HEALTH, values))
            frame = Frame(second * S, frame_key(message.can_id, True), encode(message, health.raws(message, values)))
            found[1] += alarms(by_frame.receive(frame))
        assert found[0] == found[1] and {alarm for _, alarm, _ in found[0]} == {"CpuTemperatureCritical", "TimeSyncLost"}


def told(supervisor: Supervisor, name: str, values: Mapping[str, Value], seconds: int,
         since_s: int = 0) -> list[tuple[float, str, str]]:
    """The events while a message says the same every second."""
    return [event for second in range(since_s, since_s + seconds)
            for event in alarms(published(supervisor, second * S, name, values))]


class TestAlarmsOfTheReceiver:
    GOOD = Navigation(fix=4, link="Receiving", jump_m=0.0, satellites=12, rtk_seen=True)

    def status(self, **changes: Any) -> dict[str, Value]:
        return {**health.status(self.GOOD), **changes}

    @pytest.mark.parametrize(("changes", "events"), [
        ({}, []),
        ({"GnssReceiver": "Quiet"}, [(1.0, "GnssNoData", "raised")]),
        ({"GnssReceiver": "Garbled"}, [(1.0, "GnssNoData", "raised")]),
        ({"GnssReceiver": "Frozen"}, [(1.0, "GnssNoData", "raised")]),
        ({"GnssReceiver": "Unusable", "GnssFix": None}, [(1.0, "GnssNoData", "raised")]),
        ({"GnssReceiver": "Unplugged", "GnssFix": None, "GnssPositionJump": None}, [(1.0, "GnssNoData", "raised")]),
        ({"GnssReceiver": None, "GnssFix": None}, []),
        ({"GnssFix": "NoFix"}, [(10.0, "GnssNoFix", "raised")]),
        ({"GnssFix": "Simulated"}, [(5.0, "GnssRtkLost", "raised"), (10.0, "GnssNoFix", "raised")]),
        ({"GnssFix": "RtkFloat"}, [(5.0, "GnssRtkLost", "raised")]),
        ({"GnssFix": "RtkFloat", "GnssRtkSeen": False}, []),
        ({"GnssPositionJump": 0.6}, [(0.0, "GnssJump", "raised")]),
        ({"GnssPositionJump": 4.9, "GnssFix": "Gnss", "GnssRtkSeen": False}, []),
        ({"GnssPositionJump": 5.1, "GnssFix": "Gnss", "GnssRtkSeen": False}, [(0.0, "GnssJump", "raised")]),
    ])
    def test_each_state_raises_its_alarm(self, changes: dict[str, Value], events: list[tuple[float, str, str]]) -> None:
        supervisor = unit()
        assert told(supervisor, STATUS, self.status(**changes), 30) == events

    def test_a_reader_that_hangs_is_no_data(self) -> None:
        supervisor = unit()
        told(supervisor, STATUS, self.status(), 3)
        assert alarms(supervisor.tick(20 * S)) == [(8.0, "GnssNoData", "raised")]

    def test_a_jump_is_told_for_a_while(self) -> None:
        supervisor = unit()
        assert told(supervisor, STATUS, self.status(GnssPositionJump=7.0), 1) == [(0.0, "GnssJump", "raised")]
        assert told(supervisor, STATUS, self.status(), 20, 1) == [(11.0, "GnssJump", "cleared")]

    def test_everything_is_well_again_when_it_is_plugged_in(self) -> None:
        supervisor = unit()
        lost = {"GnssReceiver": "Unplugged", "GnssFix": None, "GnssPositionJump": None}
        told(supervisor, STATUS, self.status(**lost), 10)
        assert told(supervisor, STATUS, self.status(), 10, 10) == [(12.0, "GnssNoData", "cleared")]

    @pytest.mark.parametrize(("error_ms", "confirmed", "events"), [
        (0, True, []), (1_900, True, []), (2_100, True, [(60.0, "GnssClockWrong", "raised")]),
        (-9_000, True, [(60.0, "GnssClockWrong", "raised")]), (-10**12, True, [(60.0, "GnssClockWrong", "raised")]),
        (-9_000, False, []), (None, True, [])])
    def test_a_clock_that_disagrees_with_the_satellites(
            self, error_ms: int | None, confirmed: bool, events: list[tuple[float, str, str]]) -> None:
        known = Navigation(time_of_day_ns=0, utc_ns=S, utc_confirmed=confirmed)
        assert told(unit(), TIME, health.time(known, None if error_ms is None else error_ms * MS), 90) == events

    def test_a_unit_without_a_receiver_has_no_alarm_of_one(self) -> None:
        assert alarms(unit().tick(3600 * S)) == []


# -- put together, and in the loop -------------------------------------------------------------------------------------------

class Fixed:
    """Stands for journal, port, recorder and receiver: attributes that a test sets."""

    def __init__(self) -> None:
        self.fault: str | None = None
        self.incidents: tuple[str, ...] = ()
        self.state = "BusActive"
        self.load_percent: float | None = None
        self.dropped = 0
        self.fix: int | None = None
        self.offset_ns: int | None = None
        self.readings: list[Reading] = []
        self.measured: list[tuple[int, Host]] = []
        self.recorded: list[Any] = []

    def utc_offset_ns(self) -> int | None:
        return self.offset_ns

    def append(self, events: Sequence[Event], state: bytes, commands: Sequence[Commanded] = ()) -> bool:
        return True

    def record(self, frames: Sequence[Any]) -> None:
        self.recorded += frames

    def reopen(self) -> None:
        pass


class Computer(Fixed):
    """A computer whose measurements the test gives."""

    def take(self) -> tuple[int, Host] | None:
        return self.measured.pop(0) if self.measured else None


class Receiver(Fixed):
    def take(self) -> list[Reading]:
        readings, self.readings = self.readings, []
        return readings

    def reopen(self) -> None:
        pass


class TestHousekeeping:
    def test_lateness_and_losses_are_those_since_the_last_reading_and_what_was_not_recorded_that_since_the_start(self) -> None:
        computer, journal, recorder = Computer(), Fixed(), Fixed()
        house = housekeeping.Housekeeping(computer, [Fixed()], journal, recorder)
        assert house.take(30 * MS, 2) == [] and house.take(10 * MS, 5) == []
        computer.measured = [(S, WELL)]
        recorder.dropped = 9
        first, load_ = house.take(0, 5)
        assert (first.t_ns, first.message, first.values["LoopLateness"]) == (S, HEALTH, 30.0)
        assert (load_.values["FramesDropped"], load_.values["TrafficLogDropped"]) == (5, 9)
        computer.measured = [(2 * S, WELL)]
        first, load_ = house.take(1 * MS, 6)
        assert first.values["LoopLateness"] == 1.0
        assert (load_.values["FramesDropped"], load_.values["TrafficLogDropped"]) == (1, 9)

    def test_everything_that_fails_shows(self) -> None:
        computer, journal, recorder, gnss = Computer(), Fixed(), Fixed(), Fixed()
        buses = [Fixed(), Fixed()]
        computer.measured = [(S, Host(clock_synchronised=False))]
        journal.fault, recorder.fault, buses[1].state, gnss.fix, gnss.offset_ns = "journal x: …full", "full", "BusPassive", 0, 5
        buses[0].load_percent, buses[1].load_percent = 30.0, 40.0
        values = housekeeping.Housekeeping(computer, buses, journal, recorder, gnss).take(0, 0)[0].values
        assert {**values} == {
            "CpuTemperature": None, "MainboardTemperature": None, "RamUsed": None, "StorageUsed": None, "StorageWrite": "Failed",
            "TrafficLog": "Failed", "BusState": "BusPassive", "TimeSync": "Synchronised", "JournalState": "JournalFull",
            "GnssQuality": "NoFix", "LoopLateness": 0.0, "BusLoad": 40.0}

    def test_a_unit_without_recorder_and_receiver_says_nothing_of_them(self) -> None:
        computer = Computer()
        computer.measured = [(S, WELL)]
        first, load_ = housekeeping.Housekeeping(computer, [], Fixed()).take(0, 0)
        assert first.values["TrafficLog"] is None and first.values["GnssQuality"] is None
        assert load_.values["TrafficLogDropped"] is None

    @pytest.mark.fault("journal corrupt at the start")
    @pytest.mark.parametrize(("incident", "word"), [
        ("journal j.db was corrupt: kept as j.db.corrupt-2, 3 events saved from it", "JournalCorrupt"),
        ("journal j.db is too big: 500 events dropped that level 2 never got", "JournalFull"),
        ("journal j.db was taken away while in use: a new one is begun", "JournalFailed")])
    def test_what_befell_a_journal_that_works_again_shows_long_enough_for_an_alarm(self, incident: str, word: str) -> None:
        computer, journal = Computer(), Fixed()
        house = housekeeping.Housekeeping(computer, [], journal)
        journal.incidents = (incident,)
        supervisor = Supervisor(CATALOG, unit="a", start_ns=0, readings=ALL)
        told: list[Event] = []
        for second in range(30):
            computer.measured = [(second * S, WELL)]
            reading = house.take(0, 0)[0]
            assert reading.values["JournalState"] == (word if second < 10 else "JournalOk")
            raws = health.raws(CATALOG.messages[HEALTH], reading.values)
            told += [out for out in supervisor.publish(second * S, HEALTH, raws) if isinstance(out, Event)]
        assert [event.event for event in told if event.alarm == "JournalFault"] == ["raised", "cleared"]
        assert next(event for event in told if event.alarm == "JournalFault").values["UCS_HEALTH.JournalState"] == word

    @pytest.mark.parametrize(("fault", "word"), [
        (None, "JournalOk"), ("journal j.db: can't be written (database or disk is full); 3 events wait in memory", "JournalFull"),
        ("journal j.db: the disk is full but for the reserve for alarms, which is in use", "JournalFull"),
        ("journal j.db: can't be written (attempt to write a readonly database)", "JournalReadOnly"),
        ("journal j.db: can't be written (Read-only file system)", "JournalReadOnly"),
        ("journal j.db: can't be written (database disk image is malformed)", "JournalCorrupt"),
        ("journal full/j.db: the disk is slow", "JournalFailed"),
        ("journal j.db: can't be written (disk I/O error)", "JournalFailed")])
    def test_the_journals_own_words_are_understood(self, fault: str | None, word: str) -> None:
        assert housekeeping.journal_word(fault) == word


class Wire:
    """A port that notes what it is given to send."""

    index = 0

    def __init__(self) -> None:
        self.sent: list[Send] = []

    def send(self, frame: Send, now_ns: int) -> None:
        self.sent.append(frame)

    def flush(self, now_ns: int) -> None:
        return None

    def fetch(self) -> list[Frame]:
        return []

    def listen(self, listening: Any) -> None:
        pass


class Bench:
    """A live loop with a receiver, a computer and a recorder that the test plays."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, quiet: Sequence[str] = (), synchronised: bool = False):
        monkeypatch.setattr(live, "clock_is_synchronised", lambda: synchronised)
        self.now_ns, self.wall_ns = S, 1_700_000_000 * S
        self.inbox, self.wire, self.computer, self.gnss, self.tap = Inbox(), Wire(), Computer(), Receiver(), Fixed()
        self.told: list[Event] = []
        self.supervisor = Supervisor(CATALOG, unit="a", start_ns=S, readings=ALL)
        house = housekeeping.Housekeeping(self.computer, [], Fixed())
        wire: Any = self.wire
        self.live = live.Live(self.supervisor, Fixed(), [wire], self.inbox, clock=lambda: self.now_ns, wall=lambda: self.wall_ns,
                              told=self.told.append, notice=lambda text: None, recorder=self.tap, gnss=self.gnss, house=house,
                              quiet=quiet)

    def turn_at(self, ms: int) -> None:
        self.now_ns = ms * MS
        self.inbox.wake()  # as those do that have readings
        self.live.turn(0)


class TestInTheLoop:
    def test_readings_fall_among_the_frames_at_their_own_times(self, monkeypatch: pytest.MonkeyPatch) -> None:
        bench = Bench(monkeypatch)
        bench.turn_at(1000)
        order: list[Any] = []

        def receive_many(frames: Sequence[Frame]) -> list[Any]:
            order.extend(frame.t_ns for frame in frames)
            return []

        def publish(t_ns: int, *_: Any) -> list[Any]:
            order.append(("reading", t_ns))
            return []
        monkeypatch.setattr(bench.supervisor, "receive_many", receive_many)
        monkeypatch.setattr(bench.supervisor, "publish", publish)
        for t_ms in (1100, 1080, 1090):
            bench.inbox.put([Frame(t_ms * MS, 1, b"")])
        bench.gnss.readings = [Reading(1095 * MS, STATUS, {}), Reading(1085 * MS, STATUS, {})]
        bench.computer.measured = [(1120 * MS, WELL)]
        bench.turn_at(1130)
        assert order == [1080 * MS, ("reading", 1085 * MS), 1090 * MS, ("reading", 1095 * MS), 1100 * MS,
                         ("reading", 1120 * MS), ("reading", 1120 * MS)]

    def test_what_is_quiet_is_not_sent_and_everything_else_is(self, monkeypatch: pytest.MonkeyPatch) -> None:
        bench = Bench(monkeypatch, quiet=[STATUS])
        bench.gnss.readings = [Reading(S, STATUS, {"GnssReceiver": "Unplugged"}), Reading(S, "NO_SUCH_MESSAGE", {})]
        bench.computer.measured = [(S, WELL)]
        bench.turn_at(1010)
        assert [send.message for send in bench.wire.sent] == ["UCS_ALARMS", HEALTH, LOAD]
        bench.gnss.readings = [Reading(S + 1500 * MS, STATUS, {"GnssReceiver": "Unplugged"})]
        bench.turn_at(2600)
        assert [(event.alarm, float(event.t)) for event in bench.told] == [("GnssNoData", 2.0)]

    def test_everything_received_and_sent_goes_to_the_recorder(self, monkeypatch: pytest.MonkeyPatch) -> None:
        bench = Bench(monkeypatch)
        frame = Frame(S, 0x123, b"\1")
        bench.inbox.put([frame])
        bench.turn_at(1010)
        assert bench.tap.recorded == [frame, *bench.wire.sent] and bench.wire.sent

    def test_a_loop_that_is_late_shows(self, monkeypatch: pytest.MonkeyPatch) -> None:
        bench = Bench(monkeypatch)
        bench.turn_at(1000)
        bench.inbox.put([Frame(1100 * MS, 0x123, b"")])
        bench.computer.measured = [(1350 * MS, WELL)]
        bench.turn_at(1350)
        message = CATALOG.messages[HEALTH]
        data = next(send.data for send in bench.wire.sent if send.message == HEALTH)
        lateness = message.signal("LoopLateness")
        assert Scale(lateness).physical(raw_of(lateness, data) or 0) == pytest.approx(250, abs=4)

    @pytest.mark.parametrize(("synchronised", "satellites", "wall_counts", "trusted"), [
        (True, True, True, True), (True, False, True, True), (False, True, False, True), (False, False, True, False)])
    def test_utc_is_that_of_whoever_knows_it(
            self, monkeypatch: pytest.MonkeyPatch, synchronised: bool, satellites: bool, wall_counts: bool, trusted: bool) -> None:
        bench = Bench(monkeypatch, synchronised=synchronised)
        bench.gnss.offset_ns = 1_800_000_000 * S if satellites else None
        bench.turn_at(1000)
        assert bench.supervisor.utc_offset_ns == (1_700_000_000 * S - S if wall_counts else 1_800_000_000 * S)
        assert bench.supervisor.utc_trusted == trusted
