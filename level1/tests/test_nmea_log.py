"""Recordings of NMEA 0183 text: their time line, and what `Log` makes of them."""
from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from level1.io.definitions import load
from level1.io.nmea_log import dated, frames, is_nmea
from level1.io.replay import Log, LogError
from level1.tests.plug import FIX, sentence

S = 1_000_000_000
CATALOG = load(["ucs.dbc"])
NOTHING = "GPGGA,,,,,,0,,,,M,,M,,"


def fix(of_day: str) -> bytes:
    return sentence(FIX.replace("120000.00", of_day))


def times(*lines: bytes) -> list[float]:
    return [t_ns / S for t_ns, _ in dated(lines)]


def test_the_time_line_is_that_of_the_sentences() -> None:
    rmc = sentence("GPRMC,120000.20,A,4807.038,N,01131.000,E,0.1,0.0,230394,,,A")
    assert times(b"# a remark", fix("120000.00"), rmc, fix("120000.20"), sentence("GPZDA,120000.00,23,03,1994,00,00"),
                 fix("120001")) == [0, 0, 0.2, 0.2, 0.2, 1]
    assert times(fix("235959.50"), fix("000000.50")) == [0, 1], "over midnight"


def test_without_a_time_a_position_that_comes_again_begins_the_next_epoch() -> None:
    nothing, heading = sentence(NOTHING), sentence("GPHDT,,T")
    assert times(heading, nothing, heading, nothing, heading, nothing, fix("120010.00")) == [0, 0, 0, 1, 1, 2, 3]
    assert times(nothing, nothing, fix("120010.00"), fix("120012.00"), fix("120014.00")) == [0, 2, 4, 6, 8], "the usual step"


def test_a_leap_is_a_recording_that_was_stopped() -> None:
    assert times(*(fix(of_day) for of_day in ("120000", "120001", "121500", "121501", "110000", "110001"))) == [0, 1, 2, 3, 4, 5]


def test_a_recording_is_found_by_its_content_and_becomes_frames_of_the_ucs(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    path.write_bytes(b"\xb5\x62\x01$ noise\r\n" + b"".join(fix(f"1200{second:02}") for second in range(10)))
    log = Log(path)
    names = {frame.key: frame for frame in log.frames()}
    assert {message.name for message in CATALOG.messages.values() if (message.can_id | 1 << 31) in names} == {
        "UCS_GNSS_POSITION", "UCS_GNSS_MOTION", "UCS_GNSS_STATUS", "UCS_GNSS_TIME"}
    assert (log.first_ns, log.last_ns, log.channels_seen) == (0, 9 * S, {"gnss"})


@pytest.mark.parametrize("content", [b"no sentence at all\n", FIX.encode() + b"*00\n", sentence("GPTXT,01,01,02,hello"),
                                     b"$GPGGA,12"])
def test_what_holds_no_right_sentence_of_a_position_is_none(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "notes.log"
    path.write_bytes(content)
    assert not is_nmea(content)
    with pytest.raises(LogError, match="no recording of a known format"):
        Log(path)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.one_of(st.binary(max_size=40), st.builds(fix, st.from_regex(r"[0-9]{6}(\\.[0-9]{1,9})?", fullmatch=True)),
                          st.just(sentence(NOTHING)), st.just(b"\n")), max_size=30))
def test_whatever_a_file_holds_its_time_goes_on(parts: list[bytes]) -> None:
    stamps = [frame.t_ns for frame in frames(b"".join(parts), CATALOG, 0)]
    assert stamps == sorted(stamps)
