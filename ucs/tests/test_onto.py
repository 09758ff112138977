"""`ucs replay --onto`: an absolute schedule, what is left out, and clear words; on a bus of python-can within this process."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from level1.frame import ERROR, EXTENDED, REMOTE, Frame, frame_key
from level1.io.error import OutsideError
from ucs import main
from ucs.onto import EVERY, Player, target

MS = 1_000_000
Run = Callable[..., tuple[int, str, str]]


class SlowClock:
    """A clock that passes only while somebody sleeps, and then 3 ms longer than asked for."""

    def __init__(self) -> None:
        self.now_ns = 0

    def sleep(self, duration_ns: int) -> None:
        self.now_ns += duration_ns + 3 * MS


class Wire:
    """Takes the place of an interface: when was which message sent; full for the first `full` attempts."""

    channel_info = "wire"

    def __init__(self, clock: SlowClock, full: int = 0):
        self.clock, self.full = clock, full
        self.sent: list[tuple[int, can.Message]] = []

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self.full:
            self.full -= 1
            raise can.CanOperationError("No buffer space", 105)
        self.sent.append((self.clock.now_ns, message))


def player(full: int = 0, speed: float = 1.0, bus: int = EVERY) -> tuple[Player, Wire]:
    clock = SlowClock()
    wire: Any = Wire(clock, full)
    return Player({bus: wire}, speed, lambda: clock.now_ns, clock.sleep), wire


def frames(*times_ms: int, key: int = 0x100) -> Iterator[list[Frame]]:
    yield [Frame(5_000_000_000 + t_ms * MS, key, b"\1") for t_ms in times_ms]


def test_lateness_never_adds_up() -> None:
    play, wire = player()
    list(play.play(frames(*range(0, 10_000, 10))))
    assert {t_ns - number * 10 * MS for number, (t_ns, _) in enumerate(wire.sent)} == {0, 3 * MS}
    assert (play.sent, play.latest_ns) == (1000, 3 * MS)


def test_twice_as_fast_takes_half_the_time() -> None:
    play, wire = player(speed=2)
    list(play.play(frames(0, 1000)))
    assert wire.sent[-1][0] == 503 * MS


def test_stamps_that_run_backwards_are_due_at_once_and_delay_nothing() -> None:
    play, wire = player()
    list(play.play(frames(0, 100, 40, 200)))
    assert [t_ns for t_ns, _ in wire.sent] == [0, 103 * MS, 103 * MS, 203 * MS]


def test_a_full_interface_is_tried_again_for_a_while() -> None:
    play, wire = player(full=5)
    list(play.play(frames(0, 100)))
    assert [t_ns for t_ns, _ in wire.sent] == [20 * MS, 103 * MS]
    play, _ = player(full=10_000)
    with pytest.raises(OutsideError, match="frame 1 can't be sent"):
        list(play.play(frames(0)))


def test_frames_are_handed_on_before_a_wait_so_that_events_are_told_in_time() -> None:
    play, _ = player()
    assert [len(batch) for batch in play.play(frames(0, 1, 2, 500, 501))] == [3, 2]


def test_error_frames_and_other_channels_are_left_out_and_kinds_are_kept() -> None:
    play, wire = player(bus=1)
    keys = (ERROR | 4, frame_key(0x100, False), frame_key(0x18FEEE00, True, 1), frame_key(0x200, False, 1) | REMOTE)
    list(play.play(iter([[Frame(0, key, b"") for key in keys] + [Frame(0, frame_key(0x300, False, 1), bytes(12))]])))
    messages = [message for _, message in wire.sent]
    assert [message.arbitration_id for message in messages] == [0x18FEEE00, 0x200, 0x300] and play.left_out == 2
    assert [(message.is_extended_id, message.is_remote_frame, message.is_fd) for message in messages] == [
        (True, False, False), (False, True, False), (False, False, True)]
    assert keys[2] & EXTENDED


# --- the command --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs `ucs replay`: exit code, standard output, standard error."""

    def run(*words: Any) -> tuple[int, str, str]:
        code = main.main(["replay", *map(str, words)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def log(tmp_path: Path) -> Path:
    file = tmp_path / "drive.log"
    file.write_text("".join(f"(1700000000.{n:02}0000) can{n % 2} {n + 0x100:03X}#{n:02X}\n" for n in range(20))
                    + "(1700000000.200000) can0 20000004#0000000000000000\n")
    return file


def test_a_recording_arrives_on_a_bus_whole_and_in_order(replay: Run, log: Path) -> None:
    with can.Bus(interface="virtual", channel="a") as bus:
        code, out, err = replay(log, "--onto", "a", "--interface", "virtual", "--speed", 100)
        heard = [bus.recv(0) for _ in range(21)]
    assert code == 0 and out.startswith("played 20 frames in ") and "; 1 error frames" in out
    assert [message and message.arbitration_id for message in heard] == [*range(0x100, 0x114), None]
    assert err == f"ucs: {log}: 1 error frame, 0 remote frames\n"


@pytest.mark.parametrize("option", ["--onto", "--bus"])
def test_channels_go_where_they_are_sent(replay: Run, log: Path, option: str) -> None:
    with can.Bus(interface="virtual", channel="a") as bus:
        code, _, _ = replay(log, option, "can1=a", "--interface", "virtual", "--speed", 100)
        heard = [message.arbitration_id for _ in range(10) if (message := bus.recv(0))]
        assert code == 0 and heard == list(range(0x101, 0x114, 2)) and bus.recv(0) is None


def test_definitions_supervise_what_is_played(replay: Run, tmp_path: Path, log: Path) -> None:
    code, out, err = replay(log, "--onto", "b", "--interface", "virtual", "--speed", 100, "--dbc", "flaming_tool.dbc")
    assert code == 0 and "no alarm" in out and out.splitlines()[-1].startswith("played 20 frames")
    assert "20 frames, " not in err


@pytest.mark.parametrize(("words", "told"), [
    (("--speed", "1"), "ucs: --speed, --interface and --bitrate need the bus to play onto: --bus vcan0\n"),
    (("--onto", "vcan0", "--onto", "vcan1"),
     "ucs: several buses: say which channel goes where, --bus can0=vcan0 --bus can1=vcan1\n"),
    (("--onto", "a", "--interface", "virtul"), 'ucs: bus a: no interface is called "virtul"; did you mean "virtual"?\n'),
])
def test_what_does_not_fit_together_is_one_line(replay: Run, log: Path, words: tuple[str, ...], told: str) -> None:
    dbc = () if "--onto" in words else ("--dbc", "flaming_tool.dbc")
    assert replay(log, *words, *dbc) == (2, "", told)


def test_a_bus_is_a_channel_with_its_number_or_an_interface(replay: Run, log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        replay(log, "--bus", "=3")
    assert '"=3" is neither NAME=INDEX, such as can1=0, nor an interface, such as vcan0' in capsys.readouterr().err


def test_two_recordings_need_merge(replay: Run, log: Path, tmp_path: Path) -> None:
    second = tmp_path / "second.log"
    second.write_bytes(log.read_bytes())
    assert "2 recordings can't be played at once" in replay(log, second, "--onto", "a")[2]
    code, out, _ = replay(log, second, "--onto", "a", "--interface", "virtual", "--speed", 100, "--merge")
    assert code == 0 and out.startswith("played 40 frames")


@pytest.mark.parametrize("text", ["=vcan0", "can0=", ""])
def test_targets_are_checked(text: str) -> None:
    with pytest.raises(Exception, match="is not of the form"):
        target(text)
