"""Recordings: exact stamps, every spelling of candump, and files that are damaged in every way."""
from __future__ import annotations

import gzip
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from level1.frame import ERROR, EXTENDED, REMOTE, Frame, frame_key
from level1.io.candump import candump_line
from level1.io.replay import Log, LogError

DATA = Path(__file__).parents[2].parent / "shared" / "data"
LINE = b"(1700000000.004100) can0 0CF00400#F0FFA1161CFFFFFF\n"


def log(tmp_path: Path, content: bytes, name: str = "a.log", buses: dict[str, int] | None = None) -> Log:
    file = tmp_path / name
    file.write_bytes(content)
    return Log(file, buses)


def frames(tmp_path: Path, content: bytes, name: str = "a.log") -> list[Frame]:
    return list(log(tmp_path, content, name).frames())


def recording(*path: str) -> Path:
    file = DATA.joinpath(*path)
    if not file.exists():
        pytest.skip("the shared recordings are not on this machine")
    return file


@pytest.mark.parametrize(("line", "key", "data"), [
    (b"can0 0CF00400#F0FF", 0x0CF00400 | EXTENDED, "F0FF"),
    (b"can0 123#", 0x123, ""),
    (b"can0  123#11", 0x123, "11"),
    (b"can0 123#11 R", 0x123, "11"),
    (b"can0 123#11 T", 0x123, "11"),
    (b"can0 00000123#1122334455667788", 0x123 | EXTENDED, "1122334455667788"),
    (b"can0 123#1122334455667788_F", 0x123, "1122334455667788"),
    (b"can0 123#R", 0x123 | REMOTE, ""),
    (b"can0 123#R8", 0x123 | REMOTE, ""),
    (b"can0 123##3112233445566778899AABBCC", 0x123, "112233445566778899AABBCC"),
    (b"can0 1ABCDEF0##0" + b"5A" * 64, 0x1ABCDEF0 | EXTENDED, "5A" * 64),
    (b"can0 20000080#0000000000000000", 0x80 | ERROR, "0000000000000000"),
])
def test_the_log_form_of_candump(tmp_path: Path, line: bytes, key: int, data: str) -> None:
    assert frames(tmp_path, b"(1700000000.004100) " + line + b"\n") == [
        Frame(1_700_000_000_004_100_000, key, bytes.fromhex(data))]


@pytest.mark.parametrize(("line", "key", "data"), [
    (b"  can0  0CF00400   [8]  F0 FF A1 16 1C FF FF FF", 0x0CF00400 | EXTENDED, "F0FFA1161CFFFFFF"),
    (b"  can0  123   [3]  11 22 33", 0x123, "112233"),
    (b"  can0  123   [2]  11 22   '.\"'", 0x123, "1122"),
    (b"  can0  RX - -  123   [2]  11 22", 0x123, "1122"),
    (b"  can0  TX B E  123  [12]  11 22 33 44 55 66 77 88 99 AA BB CC", 0x123, "112233445566778899AABBCC"),
    (b"  can0  123  [08]  11 22 33 44 55 66 77 88", 0x123, "1122334455667788"),
    (b"  can0  123   [0]  remote request", 0x123 | REMOTE, ""),
    (b"  can0  123   [0]", 0x123, ""),
    (b"  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME", 4 | ERROR, "0004000000000000"),
])
def test_the_screen_form_of_candump(tmp_path: Path, line: bytes, key: int, data: str) -> None:
    assert frames(tmp_path, b" (1700000000.004100)" + line + b"\n") == [
        Frame(1_700_000_000_004_100_000, key, bytes.fromhex(data))]


@pytest.mark.parametrize(("stamp", "t_ns"), [
    (b"1700000000.004100", 1_700_000_000_004_100_000),
    (b"1700000000.004100123", 1_700_000_000_004_100_123),
    (b"0000000000.352000", 352_000_000),
    (b"0.0", 0),
    (b"9223372036.854775", 9_223_372_036_854_775_000),
])
def test_stamps_are_exact(tmp_path: Path, stamp: bytes, t_ns: int) -> None:
    assert [frame.t_ns for frame in frames(tmp_path, b"(" + stamp + b") can0 123#\n" * 2)[:1]] == [t_ns]


def test_a_date_is_taken_as_utc(tmp_path: Path) -> None:
    line = b" (2023-11-14 22:13:20.004100)  can0  123   [1]  11\n"
    assert frames(tmp_path, line)[0].t_ns == 1_700_000_000_004_100_000


@given(t_us=st.integers(0, 2**33 * 10**6), extended=st.booleans(), data=st.binary(max_size=8), data_id=st.data())
def test_what_candump_writes_is_what_comes_back(t_us: int, extended: bool, data: bytes, data_id: st.DataObject) -> None:
    can_id = data_id.draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    line = f"({t_us // 10**6:010d}.{t_us % 10**6:06d}) can0 {can_id:0{8 if extended else 3}X}#{data.hex().upper()}"
    assert candump_line(line.encode()) == (t_us * 1000, b"can0", frame_key(can_id, extended), data)


@given(st.lists(st.binary(max_size=80) | st.just(LINE.strip()), max_size=30))
def test_no_content_crashes_the_reader(tmp_path_factory: pytest.TempPathFactory, lines: list[bytes]) -> None:
    for name in ("a.log", "a.asc", "a.trc", "a.csv", "a.blf", "a.log.gz"):
        try:
            opened = log(tmp_path_factory.mktemp("fuzz"), b"\n".join(lines), name)
            assert all(0 <= frame.t_ns for frame in opened.frames())
        except LogError as error:
            assert "\n" not in str(error) or "\\n" in repr(error)


@pytest.mark.parametrize(("line", "reason"), [
    (b"(1700000000.0041", "not candump text"),
    (b"nonsense", "not candump text"),
    (b"(1700000000.004100) can0 0CF00400", "not candump text"),
    (b"(1700000000.004100g can0 0CF00400#11", "not candump text"),
    (b"(1700000000.004100) can0 123#112", "data bytes are not pairs of hexadecimal digits"),
    (b"(1700000000.004100) can0 123#GG", "data bytes are not pairs of hexadecimal digits"),
    (b"(1700000000.004100) can0 0CEFFF00#FF0028FF07FFFFFF6406377DFFFFFFFF",
     "16 data bytes; a frame of this kind has at most 8"),
    (b"(1700000000.004100) can0 123##0" + b"00" * 65, "65 data bytes; a frame of this kind has at most 64"),
    (b"(1700000000.004100) can0 F0040#00", "the identifier F0040 has 5 digits; candump writes 3 or 8"),
    (b"(1700000000.004100) can0 FFF#00", "the identifier FFF has more than 11 bits"),
    (b"(1700000000.004100) can0 FFFFFFFF#00", "the identifier FFFFFFFF has more than 29 bits"),
    (b"(1700000000.004100)  can0  123   [3]  11 22", "2 of 3 data bytes"),
    (b"(1700000000.004100)  can0  123   [3]  11 22 3", "data bytes are not hexadecimal"),
    (b"  can0  123   [1]  11", "no time stamp; record with `candump -L` or `candump -ta`"),
    (b"(9223372036.854776) can0 123#00", "time stamp 9223372036 out of range"),
    (b"(yesterday)  can0  123   [1]  11", 'unreadable time stamp "yesterday"'),
])
def test_an_unreadable_line_is_skipped_counted_and_told(tmp_path: Path, line: bytes, reason: str) -> None:
    opened = log(tmp_path, LINE + line + b"\n" + LINE)
    assert len(list(opened.frames())) == 2
    assert (opened.skipped, opened.complaints) == (1, [f"unreadable line 2: {reason}"])


def test_many_unreadable_lines_are_counted_but_few_are_told(tmp_path: Path) -> None:
    opened = log(tmp_path, LINE + b"nonsense\n" * 100)
    assert len(list(opened.frames())) == 1
    assert opened.skipped == 100 and len(opened.complaints) == 3


def test_empty_lines_and_comments_are_no_errors(tmp_path: Path) -> None:
    opened = log(tmp_path, b"# recorded by hand\r\n\r\n" + LINE.replace(b"\n", b"\r\n"))
    assert len(list(opened.frames())) == 1 and not opened.skipped


def test_stamps_that_run_backwards_are_handed_on(tmp_path: Path) -> None:
    opened = log(tmp_path, b"(5.000000) can0 123#\n(4.000000) can0 123#\n(6.000000) can0 123#\n(5.500000) can0 123#\n")
    assert [frame.t_ns // 10**6 for frame in opened.frames()] == [5000, 4000, 6000, 5500]
    assert (opened.first_ns, opened.last_ns) == (5 * 10**9, 6 * 10**9)


def test_buses_count_in_order_of_appearance_unless_named(tmp_path: Path) -> None:
    content = b"(1.000000) can1 123#\n(2.000000) can0 123#\n(3.000000) can1 124#\n(4.000000) can2 123#\n"
    opened = log(tmp_path, content)
    assert [frame.bus for frame in opened.frames()] == [0, 1, 0, 2]
    assert opened.channels == {"can1": 0, "can0": 1, "can2": 2}
    named = log(tmp_path, content, buses={"can0": 0})
    assert [frame.bus for frame in named.frames()] == [1, 0, 1, 2]


def test_error_and_remote_frames_are_counted(tmp_path: Path) -> None:
    opened = log(tmp_path, LINE + b"(2.000000) can0 20000080#00\n(3.000000) can0 123#R\n")
    assert len(list(opened.frames())) == 3
    assert (opened.frames_read, opened.error_frames, opened.remote_frames) == (3, 1, 1)


def test_batches_hold_all_frames_in_order(tmp_path: Path) -> None:
    content = b"".join(b"(%d.000000) can0 123#\n" % second for second in range(10))
    batches = list(log(tmp_path, content).batches(4))
    assert [len(batch) for batch in batches] == [4, 4, 2]
    assert sum(batches, []) == frames(tmp_path, content)


def test_gzip_and_its_truncation(tmp_path: Path) -> None:
    lines = b"".join(b"(%d.%06d) can0 123#%08X\n" % (number, number * 7919 % 10**6, number * 2654435761 % 2**32)
                     for number in range(20_000))
    packed = gzip.compress(lines)
    assert len(frames(tmp_path, packed, "a.log.gz")) == 20_000
    opened = log(tmp_path, packed[:len(packed) * 2 // 3], "a.log.gz")
    assert 0 < len(list(opened.frames())) < 20_000
    assert opened.complaints == [
        "the file ends in the middle or is damaged: Compressed file ended before the end-of-stream marker was reached"]


@pytest.mark.parametrize(("name", "content", "reason"), [
    ("a.log", b"", "the file is empty"),
    ("a.log", b"\n \n", "the file is empty"),
    ("a.log", b"hello\n", "no recording of a known format; known: candump text"),
    ("a.xyz", b"\x00\x01", "no recording of a known format"),
    ("a.log.gz", b"no gzip", "can't be unpacked: Not a gzipped file"),
    ("a.blf", b"no blf", "no readable frame; the file ends in the middle or is damaged"),
    ("a.asc", b"date\nbase hex  timestamps absolute\n", "holds no frame"),
    ("a.csv", b"a,b\n1,2\n", "no readable frame; unreadable line 2"),
    ("a.log", b"(1.000000) can0 GG#\n can0  123   [1]  11\n", "no readable frame; unreadable line 1: not candump text"),
])
def test_a_file_without_frames_is_one_line(tmp_path: Path, name: str, content: bytes, reason: str) -> None:
    with pytest.raises(LogError) as caught:
        frames(tmp_path, content, name)
    assert reason in str(caught.value) and len(caught.value.problems) == 1 and "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"nowhere\.log: no such file"):
        Log(tmp_path / "nowhere.log")
    with pytest.raises(LogError, match="can't be read: Is a directory"):
        Log(tmp_path)


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc", ".csv", ".log", ".asc.gz", ".log.gz"])
def test_what_python_can_writes_is_what_comes_back(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"a{suffix}"
    sent = [can.Message(timestamp=100 + number / 1000, arbitration_id=0x123 + number, is_extended_id=number % 2 == 0,
                        data=bytes(range(number % 9)), channel=0) for number in range(1, 30)]
    with can.Logger(file) as writer:
        for message in sent:
            writer.on_message_received(message)
    read = list(Log(file).frames())
    assert [(frame.key, frame.data) for frame in read] == [
        (frame_key(message.arbitration_id, message.is_extended_id), bytes(message.data)) for message in sent]
    assert [frame.t_ns - read[0].t_ns for frame in read] == [number * 1_000_000 for number in range(29)]


def test_a_broken_asc_line_costs_only_itself(tmp_path: Path) -> None:
    content = (b"date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\nno internal events logged\n"
               b"   0.100000 1  123   Rx   d 2 11 22\n"
               b"   0.200000 1  123   Rx   d 2 XX 22\n"
               b"   0.300000 1  123   Rx   d 2 33 44\n")
    opened = log(tmp_path, content, "a.asc")
    assert [(frame.t_ns, frame.data) for frame in opened.frames()] == [
        (100_000_000, b"\x11\x22"), (300_000_000, b"\x33\x44")]
    assert opened.skipped == 1 and opened.complaints[0].startswith("unreadable line 5: ")


def test_a_broken_trc_line_costs_only_itself(tmp_path: Path) -> None:
    content = (b";$FILEVERSION=1.1\n;$STARTTIME=42176.7577227546\n;\n"
               b"     1)        48.6  Rx     09F11201  2  FF 50\n"
               b"     2)        49.2  Rx     09F1\n"
               b"     3)        49.3  Rx     09F11201  2  XX 50\n"
               b"     4)        62.2  Rx     09F11201  2  01 75\n")
    opened = log(tmp_path, content, "a.trc")
    assert [frame.data.hex() for frame in opened.frames()] == ["ff50", "0175"]
    assert opened.skipped == 2 and opened.is_utc


def test_a_truncated_blf_gives_what_it_holds(tmp_path: Path) -> None:
    file = tmp_path / "a.blf"
    with can.BLFWriter(file, max_container_size=500) as writer:
        for number in range(200):
            writer.on_message_received(can.Message(timestamp=number + 1, arbitration_id=0x123, data=[number]))
    opened = log(tmp_path, file.read_bytes()[:-700], "b.blf")
    assert 0 < len(list(opened.frames())) < 200
    assert opened.skipped == 1 and "the file ends in the middle or is damaged" in opened.complaints[0]


def test_savvycan_text(tmp_path: Path) -> None:
    content = (b"Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
               b"194411100,00000109,false,1,3,00,01,FF\n194411300,18FEF100,true,0,0\n194411400,00000109,false,1,3,00\n")
    opened = log(tmp_path, content, "a.csv")
    assert list(opened.frames()) == [Frame(194_411_100_000, frame_key(0x109, False, 0), b"\0\1\xff"),
                                     Frame(194_411_300_000, frame_key(0x18FEF100, True, 1), b"")]
    assert opened.complaints == ["unreadable line 4: 1 of 3 data bytes"]


@pytest.mark.parametrize("name", ["startUp.log", "noStartInGear1.log", "LeftSensorUnplugged-CheckEngine-1of3.log"])
def test_real_tractor_logs_equal_python_cans_reading(name: str) -> None:
    file = recording("jd5055e-tractor", name)
    expected = [(round(message.timestamp * 10**6) * 1000, message.arbitration_id | EXTENDED, bytes(message.data))
                for message in can.LogReader(file) if len(message.data) <= 8]
    opened = Log(file)
    assert [tuple(frame) for frame in opened.frames()] == expected
    assert opened.frames_read + opened.skipped == sum(1 for line in file.open() if line.strip())


@pytest.mark.parametrize(("path", "count"), [
    ("canboat-nmea2000/candumpSample3.txt", 2368), ("canboat-nmea2000/sample3_PCAN-View.trc", 12274),
    ("kona-ev-battery/230606-1-2021-epcu-control-board-only.csv", 9473),
    ("kona-ev-battery/bms_diagnostics__Precharge_relay_(On).asc", 879),
    ("python-can-formats/logfile.asc", 20), ("python-can-formats/test_CanMessage2.blf", 2),
    ("python-can-formats/test_CanFdMessage.blf", 2)])
def test_real_recordings_of_other_formats_are_read_whole(path: str, count: int) -> None:
    opened = Log(recording(*path.split("/")))
    assert (sum(1 for _ in opened.frames()), opened.skipped) == (count, 0)
