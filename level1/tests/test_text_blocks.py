"""ASC and TRC in blocks: the same frames, counts and complaints as python-can's readers give line by line."""
from __future__ import annotations

import random
from pathlib import Path

import can
import pytest

from level1.frame import BUS_SHIFT, EXTENDED, REMOTE, Frame
from level1.io import line_blocks, text_blocks
from level1.io.error import OutsideError
from level1.io.replay import Log

DATA = Path(__file__).parents[3] / "shared" / "data"
ASC_HEAD = "date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\nno internal events logged\n"
TRC_HEADS = {"1.0": ";##########\n", "1.1": ";$FILEVERSION=1.1\n;$STARTTIME=42176.7577227546\n",
             "1.3": ";$FILEVERSION=1.3\n;$STARTTIME=42176.7577227546\n",
             "2.0": ";$FILEVERSION=2.0\n;$STARTTIME=44548.6028595139\n;$COLUMNS=N,O,T,I,d,l,D\n",
             "2.1": ";$FILEVERSION=2.1\n;$STARTTIME=44548.6028595139\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"}
KINDS = ["asc", *TRC_HEADS]


def both(path: Path) -> Log:
    """Read a file both ways, and compare all that is told of it."""
    one_by_one, in_blocks = Log(path), Log(path)
    try:
        frames = list(one_by_one.frames())
    except OutsideError as error:
        with pytest.raises(OutsideError) as raised:
            list(in_blocks.blocks())
        assert str(raised.value) == str(error)
        return one_by_one
    found: list[Frame] = []
    for block in in_blocks.blocks(50):
        found += block.frames()
    assert found == frames
    for name in ("channels", "channels_seen", "frames_read", "error_frames", "remote_frames", "skipped", "complaints", "first_ns",
                 "last_ns"):
        assert getattr(in_blocks, name) == getattr(one_by_one, name), name
    return in_blocks


def line(kind: str, dice: random.Random, number: int, t_us: int, *, can_id: int | None = None) -> str:
    """A line of a recording, as tools write it."""
    extended = dice.random() < 0.5
    can_id = can_id if can_id is not None else dice.choice([0x18FEF100, 0xCF00400, 0x99] if extended else [0x123, 0x7, 0x7FF])
    fd = kind in ("asc", "2.1") and dice.random() < 0.2
    size = dice.choice([12, 20, 64]) if fd else dice.choice([0, 1, 3, 7, 8, 8, 8, 8])
    data = dice.randbytes(size).hex(" ").upper()
    if kind == "asc":
        name, stamp = f"{can_id:X}{'x' if extended else ''}", f"{t_us // 10**6:4}.{t_us % 10**6:06}"
        if fd:
            return (f"{stamp} CANFD   {dice.choice('12')} Rx   {name:>8}  {dice.choice(['', 'Engine1']):>10} 1 0 "
                    f"{can.util.len2dlc(size):x} {size:>2} {data}        0    0 {0x3000:>8X}        0")
        tail = f"  Length = {dice.randrange(200000)} BitCount = 99 ID = {can_id}" if dice.random() < 0.3 else ""
        return f"{stamp} {dice.choice('12')}  {name:<15} Rx   d {size} {data}{tail}"
    name = f"{can_id:08X}" if extended else f"{can_id:04X}"
    ms = f"{t_us // 1000}.{t_us // 100 % 10}" if kind != "2.1" else f"{t_us // 1000}.{t_us % 1000:03}"
    match kind:
        case "1.0":
            return f"{number:>6}) {t_us // 1000:>7} {name:>8} {size} {data}"
        case "1.1":
            return f"{number:>6}) {ms:>11}  Rx     {name:>8}  {size}  {data}"
        case "1.3":
            return f"{number:>6}) {ms:>11} {dice.choice('12')}  Rx    {name:>8} -  {size}    {data}"
        case "2.0":
            return f"{number:>7} {ms:>13} DT {name:>8} Rx {size}  {data}"
    return f"{number:>7} {ms:>13} {'FD' if fd else 'DT'}  1 {name:>8} Rx -  {can.util.len2dlc(size):<4} {data}"


OTHERS = ["", "; a comment", "// version 9.0.0", "   0.5 1  ErrorFrame", "1.0 1  123x  Rx   r", "1.0 CANFD   1 Rx   ErrorFrame",
          "nonsense", "  0.100000 1  Statistic: D 0 R 0", "   99)  1.0 Rx 0300 3 11 22", "2 1.0 ER 1 - Rx 5 00 00",
          "   9 1.0 RR  1 0300 Rx - 8"]


def text(kind: str, dice: random.Random, lines: int) -> str:
    """A recording with lines of all kinds, some of them broken."""
    rows, t_us = [], 0
    for number in range(1, lines):
        t_us += dice.choice([100, 900, 7000, 300_000])
        row = line(kind, dice, number, t_us)
        fate = dice.random()
        if fate < 0.03:
            place = dice.randrange(len(row))
            row = row[:place] + dice.choice("XxfF 1.\t-é\r") + row[place + 1:]
        elif fate < 0.05:
            row = row[:dice.randrange(len(row))]
        elif fate < 0.07:
            row = dice.choice(OTHERS)
        rows.append(row)
    return (ASC_HEAD if kind == "asc" else TRC_HEADS[kind]) + dice.choice(["\n", "\r\n"]).join(rows)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_blocks_equal_python_can_line_by_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, seed: int) -> None:
    monkeypatch.setattr(line_blocks, "CHUNK_BYTES", 8000)
    dice = random.Random(f"{kind}{seed}")
    path = tmp_path / ("a.asc" if kind == "asc" else "a.trc")
    path.write_text(text(kind, dice, 600), encoding="utf-8", newline="")
    log = both(path)
    assert log.frames_read > 500 and log.skipped


@pytest.mark.parametrize("kind", KINDS)
def test_lines_of_a_healthy_recording_are_read_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    dice = random.Random(kind)
    rows = [line(kind, dice, number, 1_000_000 + number * 1000) for number in range(1, 2000)]
    path = tmp_path / ("a.asc" if kind == "asc" else "a.trc")
    path.write_text((ASC_HEAD if kind == "asc" else TRC_HEADS[kind]) + "\n".join(rows))
    singly = 0

    def counted(self: object, sheet: object, rows: list[int]) -> None:
        nonlocal singly
        singly += len(rows)
        read(self, sheet, rows)
    read = getattr(text_blocks.TextBlocks, "_read_singly")  # noqa: B009
    monkeypatch.setattr(text_blocks.TextBlocks, "_read_singly", counted)
    both(path)
    assert singly < 200


def test_a_file_without_a_frame_is_given_up_either_way(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    path.write_text(ASC_HEAD + "   0.100000 1  123   Rx   d 2 XX 22\n" * 1500 + "   0.300000 1  123   Rx   d 2 33 44\n")
    assert not both(path).frames_read


def test_decimal_and_relative_asc_are_read_as_they_say(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    path.write_text("date Sat Sep 30 15:06:13.191 2017\nbase dec  timestamps relative\nno internal events logged\n"
                    "   0.100000 1  291             Rx   d 2 17 34\n   0.000500 1  Statistic: D 0 R 0 XD 7\n"
                    "   0.250000 1  419361536x      Rx   d 1 255\n   0.250000 2  291             Rx   r 8\n")
    both(path)
    log = Log(path)
    assert list(log.frames()) == [Frame(100_000_000, 0x123, b"\x11\x22"), Frame(350_500_000, 0x18FEF300 | EXTENDED, b"\xff"),
                                  Frame(600_500_000, 0x123 | REMOTE | 1 << BUS_SHIFT, b"")]


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared recordings are not here")
def test_recorded_files_read_the_same_in_blocks() -> None:
    paths = [path for path in sorted(DATA.rglob("*")) if path.name.lower().endswith((".asc", ".trc", ".asc.gz"))]
    assert len(paths) > 12
    for path in paths:
        both(path)
