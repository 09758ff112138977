"""NMEA 0183: nothing but right sentences counts, nothing old passes for new, and real receivers are read as what they say."""
from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1 import health
from level1.catalog import Catalog
from level1.decode import encode
from level1.event import Event
from level1.frame import Frame, frame_key
from level1.io.definitions import load
from level1.io.nmea_log import dated
from level1.navigation import HOLDOVER_NS, ClockOffset, Navigation, Place, jump_m
from level1.nmea import FRESH_NS, FROZEN_NS, LEAD_NS, LONGEST, QUIET_NS, UNUSABLE_NS, Framer, Navigator
from level1.supervisor import Supervisor
from level1.tests.plug import FIX, sentence

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "gpsd-nmea0183"
MS, S = 1_000_000, 1_000_000_000


def gga(second: float = 0.0, latitude: str = "4807.038", fix: int = 4) -> bytes:
    return sentence(f"GPGGA,1200{second:05.2f},{latitude},N,01131.000,E,{fix},12,0.9,545.4,M,46.9,M,1.5,0133")


def heard(*sentences: str, t_ns: int = S) -> Navigation:
    """What is known when these have come at one time."""
    navigator = Navigator()
    navigator.opened(0)
    for body in sentences:
        navigator.feed(t_ns, sentence(body))
    return navigator.navigation(t_ns)


class TestFraming:
    """Sentences out of a stream in which everything may happen."""

    def test_a_sentence_counts_as_soon_as_its_checksum_is_there(self) -> None:
        framer = Framer()
        whole = sentence(FIX)
        for byte in whole[:-3]:
            assert framer.feed(bytes([byte])) == []
        assert framer.feed(whole[-3:-2]) == [whole[:-2]]
        assert framer.feed(whole[-2:]) == []
        assert framer.counters == {"sentences": 1}

    @pytest.mark.parametrize(("spoilt", "counter"), [
        (sentence(FIX).replace(b"4807", b"4808"), "wrong checksums"),
        (sentence(FIX)[:40] + b"\r\n", "cut short or too long"),
        (sentence(FIX)[:40], "cut short or too long"),
        (sentence(FIX)[:-3] + b"\r\n", "cut short or too long"),
        (sentence(FIX)[:-4] + b"G9\r\n", "cut short or too long"),
        (b"$" + FIX.encode() + b"\r\n", "cut short or too long"),
        (b"$" + bytes(LONGEST) + b"\r\n", "cut short or too long"),
        (b"$" + b"A" * 5000, "cut short or too long"),
        (b"$", "cut short or too long"),
        (sentence(FIX)[20:], "foreign bytes"),
        (b"\xb5\x62\x01\x07\x5c\x00\xff\x13", "foreign bytes"),
    ])
    def test_what_is_no_sentence_is_counted_and_the_next_one_read(self, spoilt: bytes, counter: str) -> None:
        framer = Framer()
        after = sentence("GPHDT,274.07,T")
        assert framer.feed(spoilt) + framer.feed(after) == [after[:-2]]
        assert framer.counters[counter] >= 1

    def test_half_a_sentence_does_not_wait_for_the_line_that_is_opened_anew(self) -> None:
        framer = Framer()
        framer.feed(sentence(FIX)[:40])
        framer.reset()
        assert framer.feed(sentence(FIX)[40:]) == []
        assert framer.counters["cut short or too long"] == 1

    def test_a_line_of_nothing_but_noise_keeps_no_memory(self) -> None:
        framer = Framer()
        for _ in range(100):
            framer.feed(b"$" + b"A" * 1000)
        assert len(framer._rest) <= LONGEST

    @given(st.lists(st.one_of(st.binary(max_size=60), st.sampled_from([sentence(FIX), sentence("GPHDT,1.5,T"), b"$GP", b"*"])),
                    max_size=12), st.data())
    def test_how_the_bytes_are_cut_into_reads_changes_nothing(self, parts: list[bytes], data: st.DataObject) -> None:
        stream = b"".join(parts) + b"\r\n"
        whole, pieces = Framer(), Framer()
        expected = whole.feed(stream)
        found, place = [], 0
        while place < len(stream):
            size = data.draw(st.integers(1, 30))
            found += pieces.feed(stream[place:place + size])
            place += size
        assert found == expected
        assert {key: count for key, count in pieces.counters.items() if key != "foreign bytes"} == {
            key: count for key, count in whole.counters.items() if key != "foreign bytes"}

    @given(st.binary(max_size=300))
    def test_no_bytes_make_it_fail(self, noise: bytes) -> None:
        navigator = Navigator()
        navigator.opened(0)
        navigator.feed(1, noise)
        navigator.feed(2, b"\n" + sentence(FIX))
        assert navigator.navigation(2).fix == 4


class TestSentences:
    """What each sentence says, and what it does not."""

    def test_a_fix(self) -> None:
        known = heard(FIX)
        assert (known.latitude_deg, known.longitude_deg) == pytest.approx((48.1173, 11.516667), abs=1e-6)
        assert (known.fix, known.satellites, known.hdop, known.altitude_m, known.correction_age_s) == (4, 12, 0.9, 545.4, 1.5)
        assert known.time_of_day_ns == 43_200 * S and known.utc_ns is None and known.rtk_seen

    @pytest.mark.parametrize(("body", "latitude", "longitude"), [
        ("GNGGA,120000,4552.65403,S,17030.00668,E,1,12,0.64,14.2,M,1.8,M,,", -45.8775672, 170.500111),
        ("GNGGA,120000,4404.14063,N,12118.85478,W,1,12,0.91,1147.2,M,-21.3,M,,", 44.0690105, -121.3142463),
    ])
    def test_south_and_west_are_negative(self, body: str, latitude: float, longitude: float) -> None:
        known = heard(body)
        assert (known.latitude_deg, known.longitude_deg) == pytest.approx((latitude, longitude), abs=1e-6)

    @pytest.mark.parametrize("body", [
        "GPGGA,,,,,,0,,,,M,,M,,", "GPGGA,120000,4807.038,N,01131.000,E,0,00,,,M,,M,,", "GPGGA,,,,,,0,,,,,,,,*",
        "GPRMC,120000,V,4807.038,N,01131.000,E,0.0,,260810,,,N",
    ])
    def test_without_a_fix_there_is_no_position(self, body: str) -> None:
        known = heard(body.rstrip("*"))
        assert (known.fix, known.latitude_deg, known.longitude_deg, known.altitude_m) == (0, None, None, None)

    @pytest.mark.parametrize("body", [
        "GPGGA,120000,9907.038,N,01131.000,E,1,12,0.9,5,M,4,M,,", "GPGGA,120000,4807.038,N,nan,E,1,12,0.9,5,M,4,M,,",
        "GPGGA,120000,4807.038,N,19131.000,E,1,12,0.9,5,M,4,M,,", "GPGGA,120000,4807.038,,01131.000,E,1,12,0.9,5,M,4,M,,",
        "GPGGA,120000,,N,01131.000,E,1,12,0.9,5,M,4,M,,",
    ])
    def test_a_position_that_can_not_be_is_none(self, body: str) -> None:
        known = heard(body)
        assert known.fix == 1 and known.latitude_deg is None and known.longitude_deg is None

    @pytest.mark.parametrize("body", ["GPGGA", "GPGGA,", "GPGGA,x,y,z", "GPRMC,12", "GPVTG,a,b,c,d", "GPZDA,120000,99,99,2020,0,0",
                                      "GPGGA,120000,4807.038,N,01131.000,E,x,12,inf,nan,M,4,M,1_0,"])
    def test_a_sentence_that_makes_no_sense_says_nothing(self, body: str) -> None:
        known = heard(body)
        assert (known.latitude_deg, known.fix, known.hdop, known.speed_km_h, known.utc_ns) == (None,) * 5

    @pytest.mark.parametrize(("body", "speed", "course"), [
        ("GPRMC,120000,A,4807.038,N,01131.000,E,9.415,21.404,190214,,,D", 17.436580, 21.404),
        ("GPRMC,120000,A,4807.038,N,01131.000,E,9.415,21.404,190214,3.1,W", 17.436580, 21.404),
        ("GNVTG,74.45,T,89.09,M,0.04,N,0.07,K,A", 0.07, 74.45), ("GNVTG,74.45,T,,,5.5,N", 10.186, 74.45),
        ("GNVTG,,T,,M,0.025,N,0.045,K,A", 0.045, None), ("GPVTG,,T,,M,,N,,K,N", None, None),
        ("GPVTG,12.0,T,,M,1.0,N,1.8,K,N", None, None), ("GPRMC,120000,V,4807.038,N,01131.000,E,9.4,21.4,190214,,,D", None, None),
    ])
    def test_speed_and_course(self, body: str, speed: float | None, course: float | None) -> None:
        known = heard(body)
        assert (known.speed_km_h, known.course_deg) == (pytest.approx(speed) if speed is not None else None, course)

    @pytest.mark.parametrize(("body", "heading"), [
        ("GPHDT,274.07,T", 274.07), ("GPHDT,,T", None), ("GNTHS,23.5,A", 23.5), ("GNTHS,23.5,E", 23.5), ("GNTHS,23.5,V", None),
        ("GNTHS,23.5,S", None), ("GPHDT,400.0,T", None)])
    def test_heading_of_two_antennas(self, body: str, heading: float | None) -> None:
        assert heard(body).heading_deg == heading

    @pytest.mark.parametrize(("mode", "fix"), [
        ("A", 1), ("D", 2), ("P", 3), ("R", 4), ("F", 5), ("E", 6), ("M", 7), ("S", 8), ("N", 0)])
    def test_a_receiver_with_rmc_only_says_its_fix_by_its_mode(self, mode: str, fix: int) -> None:
        assert heard(f"GPRMC,120000,A,4807.038,N,01131.000,E,0.0,,190214,,,{mode}").fix == fix

    @pytest.mark.parametrize("body", ["PASHR,204132.000,010.51,T,+00.39,-00.79", "PUBX,00,1", "GPGSV,3,1,12,03,57,171,00",
                                      "GPTXT,01,01,02,ANTSTATUS=OK", "!AIVDM,1,1"])
    def test_what_is_not_asked_for_is_left_alone(self, body: str) -> None:
        navigator = Navigator()
        navigator.opened(0)
        assert navigator.feed(1, sentence(body)) == set() and not navigator.counters["unreadable sentences"]

    def test_the_best_sentence_leads_and_another_steps_in_when_it_is_gone(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        rmc = sentence("GPRMC,120000,A,1000.000,N,01131.000,E,0.0,,190214,,,A")
        assert {"position", "status"} <= navigator.feed(S, rmc)
        assert {"position", "status"} <= navigator.feed(S, gga())
        assert "position" not in navigator.feed(S, rmc)
        assert navigator.navigation(S).latitude_deg == pytest.approx(48.1173)
        assert "position" in navigator.feed(2 * S + LEAD_NS, rmc)
        assert navigator.navigation(2 * S + LEAD_NS).fix == 1


class TestAge:
    """Nothing old passes for new."""

    def test_a_value_is_no_value_when_it_is_too_old(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        navigator.feed(S, gga() + sentence("GPHDT,10.0,T"))
        navigator.feed(2 * S, sentence("GPVTG,1.0,T,,M,1.0,N,1.8,K,A"))
        late = navigator.navigation(S + FRESH_NS + 1)
        assert (late.fix, late.latitude_deg, late.heading_deg, late.speed_km_h) == (None, None, None, 1.8)
        assert late.position_age_ns == FRESH_NS + 1

    def test_an_empty_field_takes_back_what_was_known(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        navigator.feed(S, sentence("GPHDT,10.0,T") + gga())
        navigator.feed(S + 1, sentence("GPHDT,,T") + sentence("GPGGA,,,,,,0,,,,M,,M,,"))
        known = navigator.navigation(S + 1)
        assert (known.heading_deg, known.latitude_deg, known.fix) == (None, None, 0)

    def test_the_time_goes_on_between_two_sentences(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        navigator.feed(S, sentence("GPZDA,235959.00,31,12,2025,00,00"))
        assert health.time(navigator.navigation(3 * S), None)["GnssTimeOfDay"] == 1000
        assert health.time(navigator.navigation(3 * S), None)["GnssDate"] == 20454

    @pytest.mark.parametrize(("after", "link"), [(0, None), (QUIET_NS, None), (QUIET_NS + 1, "Quiet")])
    def test_a_receiver_that_says_nothing_is_quiet(self, after: int, link: str | None) -> None:
        navigator = Navigator()
        navigator.opened(S)
        assert navigator.link(S + after) == link

    def test_bytes_without_a_sentence_are_a_garbled_line(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        for t_ns in range(0, 5 * S, S // 10):
            navigator.feed(t_ns, bytes(range(128, 200)))
        assert navigator.link(5 * S) == "Garbled"
        navigator.feed(5 * S, gga())
        assert navigator.link(5 * S) == "Receiving"

    def test_a_receiver_whose_clock_stands_still_is_frozen(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        for second in range(8):
            navigator.feed(second * S + 1, gga(min(second, 1)))
            assert navigator.link(second * S + 1) == ("Frozen" if second * S > S + FROZEN_NS else "Receiving")

    def test_a_receiver_that_never_speaks_of_the_position_is_unusable(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        for second in range(1, 13):
            navigator.feed(second * S, sentence("GPGSV,1,1,01,03,57,171,40") + sentence("GPVTG,1.0,T,,M,1.0,N,1.8,K,A")
                           + sentence(FIX.replace(",4,12,", ",77,12,")))
            assert navigator.link(second * S) == ("Unusable" if second * S > UNUSABLE_NS else "Receiving")
        navigator.feed(13 * S, gga(13))
        assert navigator.link(13 * S) == "Receiving"

    def test_a_receiver_without_a_time_is_not_frozen(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        for second in range(30):
            navigator.feed(second * S + 1, sentence("GPGGA,,,,,,0,,,,M,,M,,"))
        assert navigator.link(29 * S + 1) == "Receiving"

    def test_a_pulled_plug_and_a_new_beginning(self) -> None:
        navigator = Navigator()
        assert navigator.link(0) == "Unplugged"
        navigator.opened(0)
        navigator.feed(S, gga()[:30])
        navigator.lost()
        assert navigator.link(S) == "Unplugged"
        navigator.opened(2 * S)
        navigator.feed(3 * S, gga()[30:] + gga(2))
        assert navigator.link(3 * S) == "Receiving" and navigator.navigation(3 * S).time_of_day_ns == 43_202 * S


class TestJump:
    """A position moves no faster than the receiver's own speed says."""

    def place(self, t_s: float, north_m: float, fix: int = 4, speed_m_s: float | None = 1.0,
              of_day_s: float | None = None) -> Place:
        of_day_ns = None if of_day_s is None else int(of_day_s * S)
        return Place(int(t_s * S), 48.0 + north_m / 111_195.08, 11.0, fix, of_day_ns, speed_m_s)

    @pytest.mark.parametrize(("one", "other", "expected"), [
        ((0, 0), (1, 2), 0.0), ((0, 0), (1, 2.6), 0.6), ((0, 0), (0.05, 1), 0.9), ((0, 0), (1, -50), 48.0),
        ((0, 0, 4, None), (1, 15, 4, None), 0.0), ((0, 0, 4, None), (1, 16, 4, None), 1.0),
        ((0, 0, 2), (1, 6.5, 4), 0.0), ((0, 0, 2), (1, 9, 4), 2.0),
        ((0, 0), (5.1, 900), None), ((0, 0, 4, 1.0, 86_399.5), (9, 3, 4, 1.0, 0.5), 1.0),
        ((0, 0, 4, 1.0, 10), (1, 3, 4, 1.0, 9), None),
    ])
    def test_what_lies_beyond_the_reach(self, one: tuple[Any, ...], other: tuple[Any, ...], expected: float | None) -> None:
        found = jump_m(self.place(*one), self.place(*other))
        assert found == (None if expected is None else pytest.approx(expected, abs=0.01))

    def test_only_measured_positions_are_compared(self) -> None:
        navigator = Navigator()
        navigator.opened(0)
        jumps = []
        fixes = [("4807.038", 4), ("4807.039", 4), ("4809.000", 6), ("4807.040", 4), ("4808.000", 4)]
        for second, (latitude, fix) in enumerate(fixes):
            navigator.feed((second + 1) * S, sentence("GPVTG,0,T,,M,2.0,N,3.7,K,A") + gga(second, latitude, fix))
            jumps.append(navigator.navigation((second + 1) * S).jump_m)
        assert jumps[:4] == [None, 0.0, None, 0.0] and jumps[4] == pytest.approx(1777, abs=2)


class TestTime:
    """UTC of the satellites as the offset of the time line."""

    def test_the_least_delayed_sentence_sets_the_clock(self) -> None:
        clock = ClockOffset()
        for second, delay_ms in enumerate([300, 80, 120, 500]):
            clock.sample(second * S + delay_ms * MS, 1_700_000_000 * S + second * S)
        assert clock.at(4 * S) == 1_700_000_000 * S - 80 * MS

    def test_it_is_trusted_for_a_while_without_the_receiver_and_then_no_longer(self) -> None:
        clock = ClockOffset()
        assert clock.at(0) is None
        clock.sample(S, 100 * S)
        assert clock.at(S + HOLDOVER_NS) == 99 * S and clock.at(S + HOLDOVER_NS + 1) is None

    def test_a_correction_of_the_receiver_is_followed_within_a_minute(self) -> None:
        clock = ClockOffset()
        for second in range(200):
            clock.sample(second * S, (1000 + second - (18 if second > 100 else 0)) * S)
        assert clock.at(200 * S) == 982 * S

    @pytest.mark.parametrize(("bodies", "known"), [
        (["GPRMC,204132.00,A,4205.733476,N,08802.041110,W,9.415,21.404,190214,,,D"], True),
        (["GPRMC,204132.00,V,,,,,,,190214,,,N"], False),
        (["GPZDA,204132.00,19,02,2014,00,00"], False),
        ([FIX, "GPZDA,204132.00,19,02,2014,00,00"], True),
        (["GPGGA,,,,,,0,,,,M,,M,,", "GPZDA,204132.00,19,02,2014,00,00"], False),
        ([FIX.replace(",E,4,", ",E,8,"), "GPZDA,204132.00,19,02,2014,00,00"], False),
        ([FIX, "GPZDA,204132.00,06,01,1980,00,00"], False),
        ([FIX, "GPZDA,204132.00,,,,00,00"], False),
        ([FIX], False),
    ])
    def test_only_satellites_confirm_it(self, bodies: list[str], known: bool) -> None:
        navigator = Navigator()
        navigator.opened(0)
        for body in bodies:
            navigator.feed(S, sentence(body))
        assert navigator.utc_offset_ns(S) == (1_392_842_492 * S - S if known else None)
        assert navigator.navigation(S).utc_confirmed == known


# -- real receivers ----------------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return load(["ucs.dbc"])


@pytest.fixture
def logs() -> Path:
    if not DATA.is_dir():
        pytest.skip(f"the shared recordings are not at {DATA}")
    return DATA


def lines_of(path: Path) -> list[tuple[int, bytes]]:
    """The lines of a recording, each with its time."""
    return list(dated(path.read_bytes().splitlines(keepends=True)))


def told(catalog: Catalog, navigator: Navigator, reads: Iterator[tuple[int, bytes]]) -> list[tuple[float, str, str]]:
    """The events that a receiver's bytes lead to, through the messages of ucs.dbc: seconds, alarm, event."""
    supervisor = Supervisor(catalog, unit="test", broadcast=False)
    readings = health.GnssReadings()
    navigator.opened(0)
    events = []
    for t_ns, data in reads:
        news = navigator.feed(t_ns, data)
        for reading in readings.take(t_ns, news, navigator.navigation(t_ns), None):
            message = catalog.messages[reading.message]
            frame = Frame(t_ns, frame_key(message.can_id, True), encode(message, health.raws(message, reading.values)))
            events += [(float(output.t), output.alarm, output.event) for output in supervisor.receive(frame)
                       if isinstance(output, Event)]
    return events


TABLE = [
    # Handheld at a window: no fix for 8 s, then EGNOS.
    ("foretrex-201.log", 136, [],
     {"fix": 2, "latitude_deg": 55.0739, "satellites": 0, "heading_deg": None}),
    # Two antennas: 194 of 215 GGA without fix, the heading comes last.
    ("hemi.log", 753, [(10.0, "GnssNoFix", "raised"), (99.0, "GnssNoFix", "cleared")],
     {"fix": 1, "latitude_deg": 42.363726, "heading_deg": 274.11, "hdop": 1.4}),
    ("navika-100-fix.log", 180, [], {"fix": 1, "longitude_deg": -122.532424, "satellites": 5}),
    ("neo-m8n.log", 293, [], {"fix": 1, "altitude_m": 1139.4, "course_deg": None}),
    # RTK: differential, then 10 minutes later fixed, 400 m further north.
    ("nmea-rtk.log", 244, [], {"fix": 4, "hdop": 0.7, "correction_age_s": 7.5, "rtk_seen": True, "satellites": 19}),
    # A telephone: its first fixes, of three satellites, lie 60 to 90 m apart.
    ("quectel-eg25-g.log", 861, [(10.0, "GnssNoFix", "raised"), (30.03, "GnssJump", "raised"), (30.05, "GnssNoFix", "cleared")],
     {"fix": 1, "satellites": 3, "hdop": 3.1}),
    # With inertial unit: 100 of 152 sentences are proprietary; heading once a second, speed by RMC only.
    ("rst39.log", 152, [], {"fix": 2, "heading_deg": 74.79, "speed_km_h": pytest.approx(17.7959, abs=1e-3)}),
    ("skytraq-dgps.log", 1024, [], {"fix": 2, "speed_km_h": 0.0, "hdop": 1.1}),
    ("ublox-neo-m9n-nmea.log", 1403, [], {"fix": 2, "satellites": 12, "altitude_m": 81.8}),
    ("ublox-zed-f9p-nmea.log", 1015, [], {"fix": 1, "latitude_deg": -45.877566, "longitude_deg": 170.500112}),
]


@pytest.mark.parametrize(("name", "sentences", "events", "last"), TABLE, ids=[row[0] for row in TABLE])
class TestRealReceivers:
    """What is reported of each recording."""

    def test_its_alarms_and_where_it_was_at_last(
            self, catalog: Catalog, logs: Path, name: str, sentences: int, events: list[tuple[float, str, str]],
            last: dict[str, object]) -> None:
        navigator = Navigator()
        reads = lines_of(logs / name)
        assert told(catalog, navigator, iter(reads)) == events
        known = navigator.navigation(reads[-1][0])
        assert {key: getattr(known, key) for key in last} == pytest.approx(last)
        assert navigator.counters["sentences"] == sentences
        assert not navigator.counters["wrong checksums"] and not navigator.counters["unreadable sentences"]
        assert known.link == "Receiving" and known.utc_confirmed

    def test_binary_between_its_sentences_changes_nothing(
            self, catalog: Catalog, logs: Path, name: str, sentences: int, events: list[tuple[float, str, str]],
            last: dict[str, object]) -> None:
        """A receiver may send its own protocol between its sentences (here UBX and RTCM 3, with `$` inside)."""
        dice = random.Random(name)

        def mixed() -> Iterator[tuple[int, bytes]]:
            for t_ns, line in lines_of(logs / name):
                yield t_ns, dice.choice([b"\xb5\x62", b"\xd3\x00"]) + dice.randbytes(dice.randrange(60)) + b"$\x00" + line
        navigator = Navigator()
        assert told(catalog, navigator, mixed()) == events
        assert navigator.counters["sentences"] == sentences and navigator.counters["foreign bytes"] > 1000

    def test_two_of_three_sentences_with_a_wrong_bit_are_only_missing(
            self, catalog: Catalog, logs: Path, name: str, sentences: int, events: list[tuple[float, str, str]],
            last: dict[str, object]) -> None:
        dice = random.Random(name)

        def spoilt() -> Iterator[tuple[int, bytes]]:
            for t_ns, line in lines_of(logs / name):
                bad = bytearray(line)
                if dice.randrange(3) and line.startswith(b"$"):
                    bad[dice.randrange(1, len(line.rstrip()) - 3)] ^= 1 << dice.randrange(7)
                yield t_ns, bytes(bad)
        navigator = Navigator()
        alarms = {alarm for _, alarm, _ in told(catalog, navigator, spoilt())}
        assert alarms <= {alarm for _, alarm, _ in events}
        assert navigator.counters["sentences"] < sentences * 0.45
        assert not navigator.counters["unreadable sentences"]
