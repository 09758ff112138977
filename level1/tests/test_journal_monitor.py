"""What the monitoring history promises: batches instead of samples, a bound, and that it never stands in an event's way."""
from __future__ import annotations

import random
import sqlite3
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from level1.event import Monitor, seconds
from level1.io import journal_monitor
from level1.io.journal import Journal, JournalError, read_events
from level1.io.journal_monitor import PIECES, HistoryReader
from level1.tests.test_journal import PATIENT_NS, VERSION_1, an_event, events, eventually, on_small_disk, write_lock

MB = 1_000_000
BEGIN = datetime(2025, 5, 1, 10, tzinfo=UTC)
NOISE = random.Random(1).randbytes(1 << 20).hex()


def a_sample(t_ns: int, message: str = "motion", text: str = "", boot: int = 1) -> Monitor:
    utc = (BEGIN + timedelta(microseconds=t_ns // 1000)).isoformat(timespec="microseconds").replace("+00:00", "Z")
    return Monitor("tractor-7", boot, seconds(t_ns), utc, True, message, {"Speed": 1.25, "Gear": "N", "Heading": text or None},
                   {"Speed": 0.05, "Gear": 0.05, "Heading": None}, {"Speed": "good", "Gear": "good", "Heading": "never"})


def samples(begin_s: float, end_s: float, period_ms: int = 250, noise: int = 0) -> list[Monitor]:
    """Of one message. noise: bytes in each that can't be compressed."""
    return [a_sample(ms * MB, text=NOISE[at:at + 2 * noise]) for ms in range(round(begin_s * 1000), round(end_s * 1000), period_ms)
            for at in [ms * 7 % 500_000]]


def kept(path: Path) -> list[Monitor]:
    with HistoryReader(path) as reader:
        return [sample for number in reader.batches() for sample in reader.samples(number)]


def rows(path: Path) -> int:
    try:
        with HistoryReader(path) as reader:
            return len(reader.batches())
    except JournalError:
        return 0


def record(journal: Journal, monitors: Iterable[Monitor]) -> None:
    """One by one, as the loop does."""
    for monitor in monitors:
        journal.record([monitor])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ucs" / "journal.db"


@pytest.mark.fault("power cut", "of the monitoring history, written a minute at a time, the last minute is lost")
def test_a_minute_is_one_batch_and_until_it_is_over_nothing_is_written(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS, monitor_bytes=MB) as journal:
        record(journal, samples(0, 60))
        assert journal.append(events(1), b""), "the thread has come by"
        assert rows(path) == 0
        record(journal, samples(60, 130))
        eventually(lambda: rows(path) == 2)
        assert kept(path) == samples(0, 120.5), "the sample that ends a minute belongs to it"
    assert kept(path) == samples(0, 130), "closing writes what there is"
    assert journal.unrecorded == 0


def test_samples_survive_a_restart_and_are_found_by_boot_time_and_message(path: Path) -> None:
    for boot in (1, 2):
        with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
            journal.record([a_sample(boot * 1000 * MB, name, boot=boot) for name in ("motion", "nozzles")])
    with HistoryReader(path) as reader:
        assert (reader.batches(), reader.batches(boot=2), reader.batches(boot=3)) == ([1, 2], [2], [])
        assert reader.batches(since=BEGIN + timedelta(seconds=1.5)) == [2]
        assert reader.batches(until=BEGIN + timedelta(seconds=2)) == [1]
        assert reader.samples(2, "nozzles") == [a_sample(2000 * MB, "nozzles", boot=2)]


def test_at_most_four_samples_a_second_of_a_message_are_kept(path: Path) -> None:
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        record(journal, samples(0, 10, period_ms=10))
    assert kept(path) == samples(0, 10)


def test_the_oldest_go_when_the_bound_is_reached_and_no_event_does(path: Path) -> None:
    bound = 300_000
    with Journal(path, "tractor-7", monitor_bytes=bound) as journal:
        journal.append(events(10), b"")
        for minute in range(30):
            record(journal, samples(60.25 * minute, 60.25 * (minute + 1), noise=100))
            eventually(lambda: not journal._pieces)
        journal.append(events(1, first=11), b"")
        with HistoryReader(path) as reader:
            numbers = reader.batches()
            assert numbers[0] > 1 and numbers == [*range(numbers[0], numbers[-1] + 1)]
            assert reader.samples(numbers[-1])
    assert path.with_name("journal.db.monitor").stat().st_size < bound + 100_000
    assert read_events(path) == events(11) and journal.unrecorded == 0


def test_nothing_is_kept_with_a_bound_of_0_and_what_there_was_goes(path: Path) -> None:
    for bound in (MB, 0):
        with Journal(path, "tractor-7", monitor_bytes=bound) as journal:
            record(journal, samples(0, 61))
    assert not list(path.parent.glob("*.monitor*"))


@pytest.mark.fault("monitoring history damaged", "begun anew, told; no event and no start depends on it")
@pytest.mark.parametrize("damage", [b"not a database at all", bytes(8192)])
def test_a_damaged_history_is_begun_anew_and_the_journal_does_not_care(path: Path, damage: bytes) -> None:
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        journal.append(events(3), b"latched")
        record(journal, samples(0, 61, noise=100))
    with open(path.with_name("journal.db.monitor"), "r+b") as file:
        file.write(damage)
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        assert (journal.restored_state(), journal.incidents) == (b"latched", ())
        record(journal, samples(0, 10))
    assert len(journal.incidents) <= 1 and journal.fault is None and read_events(path) == events(3)
    assert kept(path) == samples(0, 10) and journal.unrecorded == 0


def test_a_damaged_batch_is_left_out_and_counted(path: Path) -> None:
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        record(journal, samples(0, 125))
    with sqlite3.connect(path.with_name("journal.db.monitor")) as connection:
        connection.execute("UPDATE batch SET lines = x'00' WHERE number = 1")
    with HistoryReader(path) as reader:
        assert [len(reader.samples(number)) for number in reader.batches()] == [0, 241, 18]
        assert reader.unreadable == 1


def test_a_history_of_a_later_version_is_left_alone_and_told(path: Path) -> None:
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        record(journal, samples(0, 10))
    with sqlite3.connect(path.with_name("journal.db.monitor")) as connection:
        connection.execute("PRAGMA user_version = 99")
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        record(journal, samples(0, 70))
    assert journal.unrecorded == 280 and len(journal.incidents) == 1 and "written by a later version" in journal.incidents[0]
    with pytest.raises(JournalError, match="written by a later version"):
        HistoryReader(path)


def test_a_journal_of_version_1_gets_a_history_beside_it(path: Path) -> None:
    path.parent.mkdir(parents=True)
    with sqlite3.connect(path) as old:
        old.executescript(VERSION_1)
    old.close()
    with pytest.raises(JournalError, match=r"no such file; `ucs run` writes it a minute after"):
        HistoryReader(path)
    with Journal(path, "tractor-7", monitor_bytes=MB) as journal:
        assert journal.restored_state() == b"locked"
        record(journal, samples(0, 10))
    assert kept(path) == samples(0, 10)


@pytest.mark.fault("disk slow or not answering")
def test_the_memory_of_a_history_that_waits_is_bounded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_monitor, "PIECE_BYTES", 300)
    with Journal(path, "tractor-7", patience_ns=20_000_000, monitor_bytes=MB) as journal:
        with write_lock(path):
            assert not journal.append(events(1), b"")
            record(journal, samples(0, 100))
            assert len(journal._pieces) <= PIECES
        eventually(lambda: journal.fault is None)
        journal.append(events(1, first=2), b"")
    assert read_events(path) == events(2)


def test_an_event_does_not_wait_for_a_history_that_can_not_be_written(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS, monitor_bytes=MB) as journal:
        path.with_name("journal.db.monitor").mkdir()
        record(journal, samples(0, 61))
        eventually(lambda: journal.unrecorded)
        assert journal.append(events(1), b"") and journal.fault is None
        assert "not kept (unable to open database file)" in journal.incidents[0]


FULL_DISK = """
    import sys
    from pathlib import Path
    from level1.io.journal import Journal, read_events
    from level1.tests.test_journal import PATIENT_NS, an_event, eventually
    from level1.tests.test_journal_monitor import MB, record, rows, samples
    folder = Path(sys.argv[1])
    with Journal(folder / "journal.db", "tractor-7", patience_ns=PATIENT_NS, monitor_bytes=2 * MB) as journal:
        for minute in range(5):
            record(journal, samples(60.25 * minute, 60.25 * (minute + 1), noise=100))
            eventually(lambda: rows(folder / "journal.db") > minute)
        with open(folder / "filler", "ab", buffering=0) as file:
            try:
                while file.write(bytes(4096)): pass
            except OSError:
                pass
        seq = 0
        while (folder / "journal.db.monitor").exists():
            seq += 1
            assert journal.append([an_event(seq)], b"x" * 100)
        assert (folder / "journal.db.ballast").exists(), "the history goes before the reserve is touched"
        assert "dropped: the disk is full" in journal.incidents[0]
        before = journal.unrecorded
        record(journal, samples(2000, 2061))
        eventually(lambda: journal.unrecorded > before)
        while (folder / "journal.db.ballast").exists():
            seq += 1
            assert journal.append([an_event(seq)], b"x" * 100)
        record(journal, samples(3000, 3061))
        eventually(lambda: journal.unrecorded > before + 244)
        assert not (folder / "journal.db.monitor").exists()
        (folder / "filler").unlink()
        eventually(lambda: journal.fault is None)
        record(journal, samples(4000, 4061))
        eventually(lambda: rows(folder / "journal.db") >= 1)
    assert len(read_events(folder / "journal.db", limit=10**6)) == seq
"""


@pytest.mark.fault("disk full")
def test_on_a_full_disk_the_history_goes_first_and_is_never_written_from_the_reserve(tmp_path: Path) -> None:
    on_small_disk(FULL_DISK, tmp_path / "disk")


def test_events_and_samples_that_come_together_are_all_kept(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS, monitor_bytes=10 * MB) as journal:
        for minute in range(10):
            record(journal, samples(60.25 * minute, 60.25 * (minute + 1)))
            assert journal.append([an_event(minute + 1)], b"")
    assert read_events(path) == events(10) and len(kept(path)) == 2410
