"""Electronic data sheets: what supervision needs of them, from real files, and from files that are none."""
from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dbc
from level1.eds import MAX_SIZE, DataSheet, EdsError, parse

RECORDED = Path(__file__).parents[2].parent / "shared" / "data" / "dbc-eds-other"
MINIMAL = "[DeviceInfo]\nProductName=Level gauge\n"


def test_a_minimal_sheet_names_the_device_and_nothing_else() -> None:
    assert parse(MINIMAL) == DataSheet("Level gauge", None, False, {})


@pytest.mark.parametrize(("lines", "heartbeat_ms"), [
    ("DefaultValue=500", 500), ("DefaultValue=0x1F4", 500), ("DefaultValue=0", None), ("DefaultValue=", None), ("", None),
    ("DefaultValue=0\nParameterValue=250", 250), ("DefaultValue=soon", None), ("DefaultValue=70000", None),
    ("DefaultValue=200 ; a comment", 200)])
def test_the_heartbeat_time_is_that_of_object_1017(lines: str, heartbeat_ms: int | None) -> None:
    sheet = parse(f"{MINIMAL}[1017]\nParameterName=Producer heartbeat time\n{lines}\n")
    assert sheet.heartbeat_ns == (heartbeat_ms * 1_000_000 if heartbeat_ms else None)


def test_guard_time_and_life_time_factor_are_those_of_objects_100c_and_100d() -> None:
    sheet = parse(f"{MINIMAL}[100C]\nDefaultValue=200\n[100D]\nDefaultValue=3\nParameterValue=0x04\n")
    assert (sheet.guard_ns, sheet.life_factor) == (200_000_000, 4)
    for lines in ("DefaultValue=0", "DefaultValue=70000", "DefaultValue=soon"):
        sheet = parse(f"{MINIMAL}[100C]\n{lines}\n[100D]\n{lines}\n")
        assert (sheet.guard_ns, sheet.life_factor) == (None, None)


def test_error_codes_have_a_section_of_their_own_and_wrong_lines_of_it_are_left_out() -> None:
    sheet = parse(MINIMAL + "[1003]\n[EmergencyErrorCodes]\n0xFF01=no echo\n65282=two\nsoon=three\n0x1FFFF=four\n0xFF03=\n")
    assert sheet.errors == {0xFF01: "no echo", 0xFF02: "two"}
    assert sheet.history


@pytest.mark.parametrize("text", ["", "no sheet", "[FileInfo]\nFileName=x.eds\n", "[DeviceInfo\n", "\0\1\2", "x" * (MAX_SIZE + 1),
                                  "[DeviceInfo]\n=5\n[\n"])
def test_what_is_no_sheet_is_told_in_one_line(text: str) -> None:
    with pytest.raises(EdsError) as error:
        parse(text)
    assert str(error.value) and "\n" not in str(error.value)


@settings(deadline=None)
@given(st.text(alphabet="[]=;\n 0123456789xDeviceInfoProductName1017", max_size=200))
def test_any_text_is_a_sheet_or_an_error(text: str) -> None:
    try:
        parse(text)
    except EdsError:
        return


def test_a_long_name_and_control_characters_are_tamed() -> None:
    assert parse(f"[DeviceInfo]\nProductName={'a' * 100}\x1b[31m\n").name == "a" * 64


def test_the_shipped_sheets_say_what_the_alarms_need() -> None:
    for name in ("airblast_sprayer.eds", "ultrasonic_sensors.eds"):
        sheet = parse(dbc.path(name).read_text("utf-8"))
        assert sheet.name and sheet.history and sheet.heartbeat_ns == 500_000_000
        assert sheet.errors


@pytest.mark.skipif(not RECORDED.is_dir(), reason="the shared data is not beside this repository")
@pytest.mark.parametrize("name", ["canopen-python__sample.eds", "canopen-python__datatypes.eds"])
def test_sheets_of_another_project_are_read(name: str) -> None:
    sheet = parse((RECORDED / name).read_text("utf-8"))
    assert sheet.history == (name == "canopen-python__sample.eds")
    assert sheet.heartbeat_ns is None
