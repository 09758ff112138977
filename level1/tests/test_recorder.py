"""The traffic recorder: what was on the buses can be read again, the size stays within its bound, nothing waits for the disk."""
from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from level1.event import Send
from level1.frame import ERROR, REMOTE, Frame, frame_key
from level1.io import recorder as module
from level1.io.recorder import Recorder
from level1.io.replay import Log

MB = 1 << 20
S, MS = 1_000_000_000, 1_000_000
WAIT_S = 30.0
START_NS, UTC_NS = 5_000 * S, 1_700_000_000 * S


class Bench:
    """A recorder, its notices, and clocks that the test moves."""

    def __init__(self, folder: Path, max_bytes: int = 8 * MB, **more: Any):
        self.folder = folder
        self.now_ns = START_NS
        self.wall_ns = UTC_NS
        self.notices: list[str] = []
        self.recorder = Recorder(folder, max_bytes, clock=lambda: self.now_ns, wall=lambda: self.wall_ns,
                                 notice=self.notices.append, **more)
        self.recorder.start()

    def until(self, condition: Callable[[], Any]) -> None:
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f"waited in vain: {self.recorder.fault} {self.notices}"
            time.sleep(0.005)

    def drained(self) -> bool:
        return not self.recorder._queue and not self.recorder._busy

    def files(self) -> list[Path]:
        return sorted(self.folder.glob("*.blf"))

    def size(self) -> int:
        return sum(path.stat().st_size for path in self.files())


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Bench]]:
    """Makes recorders that look at their queue often; stopped at the end, when their thread must end."""
    monkeypatch.setattr(module, "ROUND_S", 0.01)
    monkeypatch.setattr(module, "PORTION", 1000)
    made: list[Bench] = []

    def make(folder: Path = tmp_path / "traffic", **more: Any) -> Bench:
        made.append(Bench(folder, **more))
        return made[-1]
    yield make
    for one in made:
        one.recorder.stop()
        assert not one.recorder._thread.is_alive()


def noise(count: int, seed: int = 0) -> list[Frame]:
    """Frames that can't be compressed."""
    dice = random.Random(seed)
    return [Frame(START_NS + number * MS, frame_key(dice.randrange(1 << 29), True), dice.randbytes(8)) for number in range(count)]


def messages(path: Path) -> list[can.Message]:
    with can.BLFReader(path) as reader:
        return list(reader)


def test_what_was_received_and_sent_on_all_buses_can_be_read_again(bench: Callable[..., Bench]) -> None:
    one = bench()
    frames = [
        Frame(START_NS, frame_key(0x123, False), b"\1\2"),
        Frame(START_NS + 1_500_000, frame_key(0x18FEF100, True, 1), bytes(range(8))),
        Frame(START_NS + 2 * MS, frame_key(0x200, False) | REMOTE, b""),
        Frame(START_NS + 3 * MS, 0x4 | ERROR, bytes(8)),
        Frame(START_NS + 4 * MS, frame_key(0x7FF, False, 2), bytes(range(64))),
        Frame(START_NS + 5 * MS, frame_key(0x7FF, False), b"")]
    one.recorder.record(frames)
    one.recorder.record([Send(START_NS + 6 * MS, frame_key(0x110, False), b"\5", "FLAMER_CMD", "repair", START_NS + S),
                         Send(START_NS + 7 * MS, frame_key(0x72A, False) | REMOTE, b"\0", "guarding", "CANopen", START_NS + S)])
    one.until(one.drained)
    one.recorder.stop()
    log = Log(one.files()[0])
    read = list(log.frames())
    assert [(frame.key, frame.data) for frame in read if not frame.key & ERROR] == [
        (frame.key, frame.data) for frame in frames if not frame.key & ERROR] + [
            (frame_key(0x110, False), b"\5"), (frame_key(0x72A, False) | REMOTE, b"")]
    assert read[0].t_ns == UTC_NS and abs(read[1].t_ns - UTC_NS - 1_500_000) < 2000
    assert log.error_frames == 1 and log.remote_frames == 2
    recorded = messages(one.files()[0])
    assert [message.is_rx for message in recorded] == [True] * 6 + [False] * 2
    assert one.recorder.fault is None and one.recorder.dropped == 0 and not one.notices


def test_a_jump_of_the_wall_clock_leaves_no_gap_in_a_file(bench: Callable[..., Bench]) -> None:
    one = bench()
    one.recorder.record([Frame(START_NS, 1, b"\1")])
    one.until(lambda: one.drained() and one.files())
    one.wall_ns += 3600 * S
    one.recorder.record([Frame(START_NS + S, 1, b"\2")])
    one.recorder.stop()
    first, second = messages(one.files()[0])
    assert second.timestamp - first.timestamp == pytest.approx(1.0, abs=1e-5)


def test_a_full_file_is_followed_by_the_next_and_the_oldest_goes(bench: Callable[..., Bench]) -> None:
    one = bench(max_bytes=3 * MB)
    largest = 0
    for seed in range(20):
        one.recorder.record(noise(10_000, seed))
        one.until(one.drained)
        largest = max(largest, one.size())
    one.recorder.stop()
    assert one.recorder.dropped == 0
    assert 2 * MB < largest <= 3 * MB and one.size() <= 3 * MB
    names = [path.name for path in one.files()]
    assert len(names) >= 2 and "traffic-000001.blf" not in names
    kept = [bytes(message.data) for path in one.files() for message in messages(path)]
    written = [frame.data for seed in range(20) for frame in noise(10_000, seed)]
    assert kept == written[-len(kept):]


def test_a_new_start_goes_on_counting_and_deletes_what_is_too_old(tmp_path: Path, bench: Callable[..., Bench]) -> None:
    folder = tmp_path / "traffic"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    for number in (8, 9, 1_000_000):
        (folder / f"traffic-{number:06d}.blf").write_bytes(bytes(MB))
    one = bench(folder, max_bytes=3 * MB)
    one.recorder.record(noise(1))
    one.until(lambda: (folder / "traffic-1000001.blf").exists())
    assert not (folder / "traffic-000008.blf").exists() and (folder / "traffic-000009.blf").exists()
    assert (folder / "notes.txt").read_text() == "mine"


def test_frames_faster_than_the_disk_are_dropped_counted_and_a_fault_for_a_while(
        bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ROUND_S", 60.0)
    one = bench(queue_frames=100)
    before = time.monotonic()
    one.recorder.record(noise(250))
    one.recorder.record(noise(50))
    assert time.monotonic() - before < WAIT_S
    assert one.recorder.dropped == 200
    assert "200 frames not recorded" in str(one.recorder.fault)
    one.now_ns += module.TOLD_NS
    assert one.recorder.fault is None


def test_a_disk_that_takes_no_more_is_told_and_recording_goes_on_when_it_does(bench: Callable[..., Bench]) -> None:
    one = bench()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    one.recorder.record(noise(5_000))
    one.until(lambda: one.drained() and one.files())
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (one.size() + 10_000, hard))
        one.recorder.record(noise(10_000, 1))
        one.until(lambda: one.recorder.fault and one.drained())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    dropped = one.recorder.dropped
    assert dropped > 0 and len(one.notices) == 1 and "not recorded (File too large); trying again" in one.notices[0]
    one.recorder.record(noise(10, 2))
    one.until(lambda: one.drained() and one.recorder.dropped == dropped + 10)
    one.now_ns += module.RETRY_NS
    one.recorder.record(noise(10, 3))
    one.until(lambda: len(one.notices) == 2)
    assert one.notices[1].endswith("works again")
    assert one.recorder.fault is None, "at once: a repair waits for it"
    one.recorder.stop()
    whole = [bytes(message.data) for path in one.files() for message in messages(path)]
    assert len(whole) + one.recorder.dropped == 15_020, "each is there or counted"
    first = [frame.data for frame in noise(5_000)]
    assert whole[:4000] == first[:4000] and whole[-10:] == [frame.data for frame in noise(10, 3)]


def test_the_space_for_alarms_stays_free(bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / "traffic"
    folder.mkdir()
    for number in (1, 2, 3):
        (folder / f"traffic-{number:06d}.blf").write_bytes(bytes(MB))
    real = os.statvfs

    def nearly_full(path: Any) -> os.statvfs_result:
        """A disk that holds these three files and 1 MB more."""
        state = list(real(path))
        used = sum(file.stat().st_size for file in folder.iterdir())
        state[1], state[4] = 1, 4 * MB - used
        return os.statvfs_result(state)
    monkeypatch.setattr(os, "statvfs", nearly_full)
    one = bench(folder, reserve_bytes=2 * MB)
    one.recorder.record(noise(10))
    one.until(lambda: (folder / "traffic-000004.blf").exists())
    assert [path.name for path in one.files()] == ["traffic-000002.blf", "traffic-000003.blf", "traffic-000004.blf"]
    monkeypatch.setattr(os, "statvfs", lambda path: os.statvfs_result([1 if place == 1 else 0 if place == 4 else value
                                                                       for place, value in enumerate(real(path))]))
    one.recorder.record(noise(10))
    one.until(lambda: one.recorder.fault)
    assert "full but for the space kept for alarms" in str(one.recorder.fault)
    assert [path.name for path in one.files()] == ["traffic-000004.blf"]


@pytest.mark.parametrize("obstacle", ["file", "missing"])
def test_a_folder_that_can_not_be_written_is_a_fault_and_no_obstacle(
        tmp_path: Path, bench: Callable[..., Bench], obstacle: str) -> None:
    folder = tmp_path / "gone" / "traffic"
    if obstacle == "file":
        (tmp_path / "gone").write_text("")
    one = bench(folder)
    assert one.recorder.fault and len(one.notices) == 1
    one.recorder.record(noise(10))
    one.until(lambda: one.recorder.dropped == 10)
    (tmp_path / "gone").unlink(missing_ok=True)
    (tmp_path / "gone").mkdir()
    one.now_ns += module.RETRY_NS
    one.recorder.record(noise(10))
    one.until(lambda: len(one.notices) == 2)
    assert len(one.files()) == 1


def test_a_folder_taken_away_while_recording_is_made_anew(tmp_path: Path, bench: Callable[..., Bench]) -> None:
    one = bench(max_bytes=MB)
    one.recorder.record(noise(100))
    one.until(lambda: one.drained() and one.files())
    one.folder.rename(tmp_path / "elsewhere")
    one.recorder.record(noise(100))
    one.until(lambda: one.files())
    one.recorder.stop()
    assert len(messages(one.files()[0])) == 100 and one.recorder.fault is None
    assert [len(messages(path)) for path in (tmp_path / "elsewhere").iterdir()] == [100] and one.recorder.dropped == 0


def test_a_file_deleted_while_recording_is_lost_and_counted(bench: Callable[..., Bench]) -> None:
    one = bench()
    one.recorder.record(noise(100))
    one.until(lambda: one.drained() and one.files())
    one.files()[0].unlink()
    one.recorder.record(noise(50))
    one.until(lambda: one.drained() and one.files())
    one.recorder.stop()
    assert one.recorder.dropped == 100 and len(messages(one.files()[0])) == 50


def test_it_begins_a_new_file_when_it_is_asked_to_and_loses_nothing(bench: Callable[..., Bench]) -> None:
    one = bench()
    one.recorder.record(noise(10))
    one.until(lambda: one.drained() and one.files())
    one.recorder.reopen()
    one.until(lambda: one.notices)
    one.recorder.record(noise(10, 1))
    one.until(lambda: len(one.files()) == 2)
    one.recorder.stop()
    assert [len(messages(path)) for path in one.files()] == [10, 10]
    assert one.notices == [f"traffic recorder {one.folder}: begins a new file"] and one.recorder.dropped == 0


def test_asked_to_it_tries_again_at_once(tmp_path: Path, bench: Callable[..., Bench]) -> None:
    (tmp_path / "gone").write_text("")
    one = bench(tmp_path / "gone" / "traffic")
    assert one.recorder.fault
    (tmp_path / "gone").unlink()
    (tmp_path / "gone").mkdir()
    one.recorder.reopen()
    one.recorder.record(noise(10))
    one.until(lambda: one.recorder.fault is None)
    assert len(one.files()) == 1, "the clock stands: it did not wait"


KILLED = """
import sys, time
from pathlib import Path
from level1.frame import Frame
from level1.io.recorder import Recorder
r = Recorder(Path(sys.argv[1]), 8 << 20, clock=time.monotonic_ns, wall=time.time_ns, notice=print)
r.start()
n = 0
while True:
    r.record([Frame(time.monotonic_ns(), 1, (n + i).to_bytes(8, "big")) for i in range(100)])
    n += 100
    time.sleep(0.01)
"""


def test_after_a_kill_the_file_is_readable_with_its_time(tmp_path: Path) -> None:
    before = time.time()
    with subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "traffic")], cwd=Path(__file__).parents[2]) as process:
        end = time.monotonic() + WAIT_S
        while not any(path.stat().st_size > 20_000 for path in tmp_path.glob("traffic/*.blf")):
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    frames = list(Log(next(tmp_path.glob("traffic/*.blf"))).frames())
    assert [int.from_bytes(frame.data, "big") for frame in frames] == list(range(len(frames))) and len(frames) > 500
    assert before - 1 <= frames[0].t_ns / 1e9 <= time.time()
