"""What the journal promises: nothing acknowledged is lost, no identity used twice, no disk trouble stops it."""
from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from level1.event import Commanded, Event, SentFrame, encode, seconds
from level1.io import journal_file
from level1.io.bootfile import BootFile
from level1.io.journal import Journal, JournalError, Reader, read_events
from level1.io.journal_file import JournalFile

ROOT = Path(__file__).parents[2]
PATIENT_NS = 60_000_000_000
"""Where a test needs an event on the disk before it goes on: a busy machine may take longer for it than supervision waits."""


def an_event(seq: int, boot: int = 1, alarm: str = "PilotFlameOut", unit: str = "tractor-7") -> Event:
    return Event(unit, boot, seq, seconds(seq * 1_000_000_000), None, False, alarm, 3101, "High", "raised", seq, 0,
                 {"FLAMER_STATUS.PilotFlame": "Off"}, "Pilot flame out")


def events(count: int, boot: int = 1, first: int = 1) -> list[Event]:
    return [an_event(seq, boot) for seq in range(first, first + count)]


def eventually(condition: Callable[[], object]) -> None:
    """Wait for what another thread or process will do; a minute is far beyond any of it."""
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.01)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ucs" / "journal.db"


@contextmanager
def write_lock(path: Path) -> Iterator[None]:
    """Hold SQLite's write lock, as a disk that doesn't answer would."""
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    yield
    other.execute("ROLLBACK")
    other.close()


# What is written can be read, in order


def test_events_and_state_survive_a_restart(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        assert journal.restored_state() is None
        assert journal.append(events(3), b"latched")
        assert journal.fault is None
    with Journal(path, "tractor-7") as journal:
        assert journal.restored_state() == b"latched"
        assert journal.incidents == ()
    assert read_events(path) == events(3)


def test_reading_continues_after_a_position_over_boots(path: Path) -> None:
    for boot in (1, 2):
        with Journal(path, "tractor-7") as journal:
            journal.append(events(3, boot), b"")
    assert read_events(path, after=(1, 2)) == [an_event(3), *events(3, 2)]
    assert read_events(path, after=(1, 2), limit=2) == [an_event(3), an_event(1, 2)]
    assert read_events(path, after=(2, 3)) == []


def test_a_reader_sees_a_commit_of_the_open_journal_and_says_that_something_changed(path: Path) -> None:
    with Journal(path, "tractor-7") as journal, Reader(path) as reader:
        assert reader.changed()
        assert not reader.changed()
        journal.append(events(2), b"")
        assert reader.changed()
        assert reader.last() == (1, 2)
        assert reader.seq_before((1, 2)) == 1
        assert reader.events(alarm="Other") == []
        assert reader.unit == "tractor-7"


def test_a_reader_does_not_hold_up_the_writer(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        journal.append(events(10), b"")
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN")
        other.execute("SELECT * FROM event").fetchone()
        assert journal.append(events(10, first=11), b"")
        other.close()


# Identity


def test_every_opening_gets_a_higher_boot_id(path: Path) -> None:
    boots = []
    for _ in range(3):
        with Journal(path, "tractor-7") as journal:
            boots.append(journal.boot)
    assert boots == [1, 2, 3]


@pytest.mark.fault("journal, boot file or card lost", "no boot id comes back, so no identity does")
@pytest.mark.parametrize("victims", [["journal.db"], ["journal.db.boot"], ["journal.db", "journal.db-wal"]])
def test_a_lost_journal_or_boot_file_brings_no_boot_id_back(path: Path, victims: list[str]) -> None:
    for _ in range(3):
        Journal(path, "tractor-7").close()
    for victim in victims:
        path.with_name(victim).unlink(missing_ok=True)
    with Journal(path, "tractor-7") as journal:
        assert journal.boot == 4
        assert bool(journal.incidents) == ("journal.db" in victims)


@pytest.mark.fault("journal, boot file or card lost")
def test_a_new_card_in_an_old_unit_can_begin_at_another_boot_id(path: Path) -> None:
    with Journal(path, "tractor-7", least_boot=1_767_225_600) as journal:
        assert journal.boot == 1_767_225_600
    with Journal(path, "tractor-7", least_boot=5) as journal:
        assert journal.boot == 1_767_225_601


@pytest.mark.fault("journal, boot file or card lost")
def test_a_boot_file_half_written_keeps_the_other_half(tmp_path: Path) -> None:
    file = BootFile(tmp_path / "boot")
    file.write(41)
    file.write(42)
    content = file.path.read_bytes()
    for damaged, left in ((b"#" * 30 + content[30:], 42), (content[:30] + b"#" * 30, 41), (b"", 0), (content[:45], 41)):
        file.path.write_bytes(damaged)
        assert file.read() == left


@pytest.mark.fault("journal of another version, unit or program")
def test_two_writers_are_refused(path: Path) -> None:
    with Journal(path, "tractor-7"), pytest.raises(JournalError, match=f"in use by process {os.getpid()}"):
        Journal(path, "tractor-7")


@pytest.mark.fault("journal of another version, unit or program")
def test_another_units_journal_is_refused(path: Path) -> None:
    Journal(path, "tractor-7").close()
    with pytest.raises(JournalError, match='belongs to the unit "tractor-7"'):
        Journal(path, "tractor-8")


# Crashes


WRITER = """
    import sys
    from pathlib import Path
    from level1.io.journal import Journal
    from level1.tests.test_journal import an_event
    with Journal(Path(sys.argv[1]), "tractor-7") as journal:
        seq = 0
        while True:
            seq += 1
            if journal.append([an_event(seq, journal.boot)], b"%d" % seq):
                print(journal.boot, seq, flush=True)
"""


@pytest.mark.fault("writer killed", "every acknowledged commit is found, no identity given twice")
def test_a_killed_writer_loses_no_acknowledged_event_and_no_identity_returns(path: Path) -> None:
    acknowledged: list[tuple[int, int]] = []
    for kill in range(5):
        command = [sys.executable, "-c", textwrap.dedent(WRITER), str(path)]
        writer = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE)
        assert writer.stdout
        lines = [writer.stdout.readline() for _ in range(20 * kill + 1)]
        writer.send_signal(signal.SIGKILL)
        lines += writer.stdout.read().splitlines(keepends=True)
        writer.wait()
        whole = (line.split() for line in lines if line.endswith(b"\n"))
        acknowledged += [(int(boot), int(seq)) for boot, seq in whole]
    found = [(event.boot, event.seq) for event in read_events(path, limit=100_000)]
    assert set(acknowledged) <= set(found)
    assert len(set(found)) == len(found)
    assert len(set(acknowledged)) == len(acknowledged)
    assert {boot for boot, _ in acknowledged} == {1, 2, 3, 4, 5}
    with Journal(path, "tractor-7") as journal:
        assert journal.restored_state() == b"%d" % found[-1][1]


# Damage


def damage_header(path: Path) -> None:
    with open(path, "r+b") as file:
        file.write(b"not a database at all")


def damage_middle(path: Path) -> None:
    with open(path, "r+b") as file:
        file.seek(path.stat().st_size // 2)
        file.write(os.urandom(8192))


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 5000)


@pytest.mark.fault("journal corrupt at the start",
                   "kept aside; what stands on sound pages is saved into a new one; boot ids and lock-outs stay; an alarm says so")
@pytest.mark.parametrize("damage", [damage_header, damage_middle, truncate])
def test_a_corrupt_journal_is_kept_aside_and_a_new_one_begun(path: Path, damage: Callable[[Path], None]) -> None:
    with Journal(path, "tractor-7") as journal:
        journal.append(events(500), b"latched")
    damage(path)
    damaged = path.read_bytes()
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        assert journal.boot == 2
        assert "was corrupt: kept as journal.db.corrupt-2" in journal.incidents[0]
        assert journal.append(events(1, boot=2), b"new")
    assert path.with_name("journal.db.corrupt-2").read_bytes() == damaged
    assert read_events(path, after=(2, 0)) == events(1, boot=2)


@pytest.mark.fault("journal corrupt at the start")
def test_what_a_corrupt_journal_still_gives_is_saved(path: Path) -> None:
    with Journal(path, "tractor-7") as journal:
        journal.append(events(500), b"latched")
    damage_middle(path)
    with Journal(path, "tractor-7") as journal:
        saved = read_events(path, limit=1000)
        assert 450 < len(saved) < 500  # but for the two pages or three
        assert saved[0] == an_event(1)
        assert f"{len(saved)} events saved" in journal.incidents[0]


def test_a_state_older_than_the_newest_event_that_was_saved_is_none(tmp_path: Path) -> None:
    for state_boot, given in ((2, b"stopped"), (1, None)):
        kept, anew = (JournalFile(tmp_path / f"{name}-{state_boot}.db", "tractor-7") for name in ("kept", "anew"))
        kept.commit(state_boot, events(1, boot=2), b"stopped")
        kept.close()
        assert anew.salvage(kept.path) == 1 and anew.state() == given
        anew.close()


@pytest.mark.fault("journal taken away, corrupted or replaced while running",
                   "begun anew with the same boot id, told; readers follow")
def test_corruption_while_running_is_survived_with_the_same_boot_id(path: Path) -> None:
    with Journal(path, "tractor-7") as journal:
        journal.append(events(500), b"")
        sqlite3.connect(path).execute("PRAGMA wal_checkpoint(TRUNCATE)")
        size = path.stat().st_size
        with open(path, "r+b") as file:
            file.write(b"\0" * size)
        eventually(lambda: journal.append(events(1, first=501), b"after"))
        assert any("corrupt" in incident for incident in journal.incidents)
    assert an_event(501) in read_events(path, limit=1000)


@pytest.mark.fault("journal taken away, corrupted or replaced while running")
def test_a_journal_deleted_while_running_is_begun_anew(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        journal.append(events(2), b"")
        shutil.rmtree(path.parent)
        assert journal.append(events(1, first=3), b"after")
        assert "taken away while in use" in journal.incidents[0]
    assert read_events(path) == [an_event(3)]
    with Journal(path, "tractor-7") as journal:
        assert (journal.boot, journal.restored_state()) == (2, b"after")


@pytest.mark.fault("journal taken away, corrupted or replaced while running")
def test_a_reader_follows_a_journal_that_was_replaced(path: Path) -> None:
    with Journal(path, "tractor-7") as journal, Reader(path) as reader:
        journal.append(events(2), b"")
        assert reader.changed()
        path.unlink()
        journal.append(events(1, first=3), b"")
        assert reader.changed()
        assert reader.events() == [an_event(3)]


# Disks that are slow or full


@pytest.mark.fault("disk slow or not answering",
                   "supervision waits 0.25 s for it, then goes on; events follow, those in memory are bounded")
def test_a_disk_that_does_not_answer_stops_nothing_and_is_caught_up(path: Path) -> None:
    with Journal(path, "tractor-7", patience_ns=20_000_000) as journal:
        with write_lock(path):
            assert not journal.append(events(1), b"one")
            assert journal.fault and "1 events wait in memory" in journal.fault
            assert not journal.append(events(1, first=2), b"two")
            assert journal.pending == tuple(events(2))
        eventually(lambda: journal.fault is None)
        assert journal.pending == ()
    assert read_events(path) == events(2)


@pytest.mark.fault("disk slow or not answering")
def test_what_waits_is_bounded_and_the_loss_counted(path: Path) -> None:
    with Journal(path, "tractor-7", queue_events=10, patience_ns=20_000_000) as journal:
        with write_lock(path):
            journal.append(events(25), b"")
            assert (len(journal.pending), journal.lost) == (10, 15)
            assert journal.fault and "15 are lost" in journal.fault
        eventually(lambda: not journal.pending)
    assert read_events(path) == events(10, first=16)


FULL_DISK = """
    import os, sys, time
    from pathlib import Path
    from level1.io.journal import Journal, read_events
    from level1.tests.test_journal import PATIENT_NS, an_event, eventually
    folder = Path(sys.argv[1])

    def fill():
        with open(folder / "filler", "ab", buffering=0) as file:
            try:
                while file.write(bytes(4096)): pass
            except OSError:
                pass

    with Journal(folder / "journal.db", "tractor-7", patience_ns=PATIENT_NS) as journal:
        assert journal.fault is None, journal.fault
        fill()
        seq = 0
        while journal.append([an_event(seq + 1)], b"x" * 100):
            seq += 1
        assert seq > 300, f"the reserve gave room for {seq} events only"
        assert "full" in journal.fault, journal.fault
        for _ in range(50):
            seq += 1
            journal.append([an_event(seq + 1)], b"latest")
        assert len(journal.pending) == 51
        print(journal.fault)
    with Journal(folder / "journal.db", "tractor-7") as journal:
        assert journal.boot == 2, "a full disk must not stop supervision from starting"
        assert journal.fault
        journal.append([an_event(1, boot=2)], b"second boot")
        (folder / "filler").unlink()
        eventually(lambda: journal.fault is None)
        assert journal.pending == ()
        assert (folder / "journal.db.ballast").stat().st_size == 1 << 20
    assert read_events(folder / "journal.db", after=(2, 0)) == [an_event(1, boot=2)]
    assert len(read_events(folder / "journal.db", limit=10**6)) == seq - 50 + 1
"""

START_ON_FULL_DISK = """
    import sys
    from pathlib import Path
    from level1.io.journal import Journal, JournalError, Reader, read_events
    from level1.tests.test_journal import an_event, eventually
    folder = Path(sys.argv[1])

    def fill():
        with open(folder / "filler", "ab", buffering=0) as file:
            for size in (4096, 1):
                try:
                    while file.write(bytes(size)): pass
                except OSError:
                    pass

    with Journal(folder / "journal.db", "tractor-7") as journal:
        journal.append([an_event(1)], b"stopped")
    fill()
    try:
        Reader(folder / "journal.db")
    except JournalError as error:
        print(error)
    with Journal(folder / "journal.db", "tractor-7") as journal:
        assert journal.boot == 2 and journal.restored_state() == b"stopped"
        assert "the reserve for alarms, which is in use" in journal.fault, journal.fault
        assert journal.append([an_event(1, boot=2)], b"stopped")
    fill()
    with Journal(folder / "new.db", "tractor-7") as journal:
        assert journal.waits and journal.state_lost
        assert not journal.append([an_event(1)], b"running")
        print(journal.fault)
        (folder / "filler").unlink()
        eventually(lambda: journal.fault is None)
        assert not journal.waits
    assert read_events(folder / "new.db") == [an_event(1)]
"""

RECOVERY = """
    import sys
    from pathlib import Path
    from level1.io.journal import Journal, read_events
    from level1.tests.test_journal import an_event, eventually, events
    folder = Path(sys.argv[1])
    with Journal(folder / "journal.db", "tractor-7") as journal:
        with open(folder / "filler", "ab", buffering=0) as file:
            try:
                while file.write(bytes(4096)): pass
            except OSError:
                pass
        seq = 0
        while journal.append(events(10, first=seq + 1), b""):
            seq += 10
        seq += 10
        (folder / "filler").unlink()
        eventually(lambda: journal.fault is None)
    assert read_events(folder / "journal.db", limit=10**6) == events(seq)
"""


def on_small_disk(script: str, folder: Path) -> str:
    """Run a script on a file system of 8 MB of its own, in a mount namespace; gives what it printed."""
    folder.mkdir(exist_ok=True)
    mount = 'mount -t tmpfs -o size=8m none "$1" && exec "$2" -c "$3" "$1"'
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", mount, "sh", str(folder), sys.executable]
    done = subprocess.run([*command, textwrap.dedent(script)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.fault("disk full",
                   "the monitoring history goes first; alarms go on into a reserve of 1 MiB, then wait in memory and leave by "
                   "radio; all written once there is room")
def test_a_full_disk_gives_its_reserve_to_alarms_and_recovers(tmp_path: Path) -> None:
    assert "events wait in memory" in on_small_disk(FULL_DISK, tmp_path / "disk")


@pytest.mark.fault("disk full")
def test_supervision_starts_on_a_full_disk_out_of_its_reserve_and_without_one_in_memory(tmp_path: Path) -> None:
    printed = on_small_disk(START_ON_FULL_DISK, tmp_path / "disk").splitlines()
    assert [line.split(": ", 1)[1] for line in printed] == [
        "can't be read, as the disk is full; delete files on it",
        "can't be written (No space left on device); 1 events wait in memory"]


@pytest.mark.fault("disk full")
def test_nothing_is_lost_when_a_full_disk_is_cleared(tmp_path: Path) -> None:
    on_small_disk(RECOVERY, tmp_path / "disk")


READ_ONLY = """
    import subprocess, sys
    from pathlib import Path
    from level1.io.journal import Journal, read_events
    from level1.tests.test_journal import an_event, eventually, events
    folder = Path(sys.argv[1])
    with Journal(folder / "journal.db", "tractor-7") as journal:
        journal.append(events(3), b"")
        journal.append([an_event(4)], b"locked out")
    remount = lambda how: subprocess.run(["mount", "-o", f"remount,{how}", str(folder)], check=True)
    remount("ro")
    assert read_events(folder / "journal.db") == events(4)
    with Journal(folder / "journal.db", "tractor-7", least_boot=1_767_225_600) as journal:
        assert (journal.boot, journal.restored_state(), journal.state_lost) == (1_767_225_600, b"locked out", False)
        assert not journal.append([an_event(1, boot=journal.boot)], b"reset") and len(journal.pending) == 1
        print(journal.fault)
        remount("rw")
        eventually(lambda: journal.fault is None)
        assert not journal.waits and journal.pending == ()
    assert read_events(folder / "journal.db") == [*events(4), an_event(1, boot=1_767_225_600)]
    remount("ro")
    with Journal(folder / "journal.db", "tractor-7") as journal:
        assert (journal.boot, journal.restored_state()) == (1_767_225_601, b"reset"), "without the time as well"
    with Journal(folder / "new.db", "tractor-7") as journal:
        assert journal.waits and journal.state_lost, "nobody knows what another disk would have said"
"""


@pytest.mark.fault("disk read-only",
                   "can be read; supervision starts on it all the same, from the state on it, events wait in memory; all written "
                   "once it can be")
def test_supervision_starts_on_a_read_only_disk(tmp_path: Path) -> None:
    printed = on_small_disk(READ_ONLY, tmp_path / "disk")
    assert printed.endswith("can't be written (Read-only file system); 1 events wait in memory\n")


LATER_DISK = """
    import subprocess, sys, time
    from pathlib import Path
    from level1.io.journal import Journal
    from level1.tests.test_journal import an_event, eventually
    folder = Path(sys.argv[1])
    with Journal(folder / "kept.db", "tractor-7", least_boot=7):
        pass
    for part in ("", ".boot"):
        (folder / f"kept.db{part}").rename(folder / f"away{part}")
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
    with Journal(folder / "kept.db", "tractor-7", least_boot=7) as journal:
        assert not journal.append([an_event(1, boot=7)], b"")
        subprocess.run(["mount", "-o", "remount,rw", str(folder)], check=True)
        (folder / "away").rename(folder / "kept.db")
        eventually(lambda: "restart" in journal.fault or print(journal.fault))
        assert len(journal.pending) == 1
"""


@pytest.mark.fault("disk read-only")
def test_no_identity_is_given_twice_by_a_journal_that_comes_late(tmp_path: Path) -> None:
    on_small_disk(LATER_DISK, tmp_path / "disk")


def test_the_newest_state_is_not_passed_over_where_it_can_not_be_read(tmp_path: Path) -> None:
    script = """
        import shutil, subprocess, sys
        from pathlib import Path
        from level1.io.journal import Journal
        folder = Path(sys.argv[1])
        with Journal(folder / "journal.db", "tractor-7") as journal:
            journal.append((), b"running")
        with Journal(folder / "journal.db", "tractor-7") as journal:
            journal.append((), b"stopped")
            (folder / "cut").mkdir()
            for part in ("", "-wal"):  # as a power cut leaves them, the shared memory lost
                shutil.copy(folder / f"journal.db{part}", folder / "cut" / f"journal.db{part}")
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        with Journal(folder / "cut" / "journal.db", "tractor-7") as journal:
            print(journal.restored_state())
    """
    assert on_small_disk(script, tmp_path / "disk") in ("None\n", "b'stopped'\n")


BROKEN = """
    import resource, sys
    from pathlib import Path
    from level1.io.journal import Journal, read_events
    from level1.tests.test_journal import PATIENT_NS, eventually, events
    path = Path(sys.argv[1])
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        assert journal.append(events(3), b"")
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
        assert not journal.append(events(2, first=4), b"locked out")
        print(journal.fault, len(journal.pending))
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        eventually(lambda: journal.fault is None)
        assert read_events(path) == events(5)
    with Journal(path, "tractor-7") as journal:
        assert journal.restored_state() == b"locked out"
"""


@pytest.mark.fault("disk that takes nothing more while running",
                   "events wait in memory and leave by radio; tried again every second, all written once it works")
def test_a_disk_that_fails_while_running_is_tried_again(path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(BROKEN), str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "can't be written" in done.stdout and done.stdout.endswith("; 2 events wait in memory 2\n")


@pytest.mark.fault("disk read-only")
@pytest.mark.parametrize("path", ["/proc/ucs/journal.db", "/dev/null/journal.db", "/"])
def test_a_path_that_cannot_be_written_is_told_in_one_line(path: str) -> None:
    with pytest.raises(JournalError) as error:
        Journal(Path(path), "tractor-7")
    assert "can't be written" in str(error.value)
    assert "set another [journal] path" in str(error.value)
    assert "\n" not in str(error.value)


# Size, versions, other files


@pytest.mark.fault("journal over its size bound", "delivered events go first; undelivered ones last, and an alarm says so")
def test_delivered_events_are_dropped_before_undelivered_ones(path: Path) -> None:
    with Journal(path, "tractor-7", keep_bytes=1_000_000) as journal:
        for first in range(1, 6001, 1000):
            journal.append(events(1000, first=first), b"")
        journal.prune({1: 4000})
        eventually(lambda: read_events(path, limit=1)[0].seq > 1)
    left = read_events(path, limit=10**6)
    assert 1 < left[0].seq <= 4001
    assert left == events(6001 - left[0].seq, first=left[0].seq)
    assert journal.incidents == ()


@pytest.mark.fault("journal over its size bound")
def test_undelivered_events_are_dropped_last_and_told(path: Path) -> None:
    with Journal(path, "tractor-7", keep_bytes=1_000_000) as journal:
        journal.append(events(6000), b"")
        journal.prune({1: 100})
        eventually(lambda: journal.incidents)
        assert "that level 2 never got" in journal.incidents[0]
    assert read_events(path, limit=10**6)[-1] == an_event(6000)


@pytest.mark.fault("journal of another version, unit or program",
                   "an older one is migrated; a later one, another unit's or program's is refused and left alone")
def test_an_older_file_is_migrated(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Journal(path, "tractor-7") as journal:
        journal.append(events(2), b"old")

    def add_a_table(connection: sqlite3.Connection) -> None:
        connection.execute("CREATE TABLE note (text TEXT)")

    monkeypatch.setattr(journal_file, "MIGRATIONS", (*journal_file.MIGRATIONS, add_a_table))
    with Journal(path, "tractor-7") as journal:
        assert journal.restored_state() == b"old"
    assert sqlite3.connect(path).execute("SELECT count(*) FROM note").fetchone() == (0,)
    assert sqlite3.connect(path).execute("PRAGMA user_version").fetchone() == (len(journal_file.MIGRATIONS),)
    assert read_events(path) == events(2)


VERSION_1 = f"""
    PRAGMA application_id = {journal_file.APPLICATION_ID};
    CREATE TABLE unit (name TEXT NOT NULL);
    CREATE TABLE boot (boot INTEGER PRIMARY KEY);
    CREATE TABLE state (one INTEGER PRIMARY KEY CHECK (one = 1), boot INTEGER, snapshot BLOB);
    CREATE TABLE event (boot INTEGER, seq INTEGER, alarm TEXT, event TEXT, line BLOB, PRIMARY KEY (boot, seq)) WITHOUT ROWID;
    INSERT INTO unit VALUES ('tractor-7');
    INSERT INTO state VALUES (1, 4, x'6c6f636b6564');
    PRAGMA user_version = 1;
"""
"""As version 1 left it: no commands."""


@pytest.mark.fault("journal of another version, unit or program")
def test_a_file_of_version_1_is_read_as_it_is_and_migrated_by_its_writer(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with sqlite3.connect(path) as old:
        old.executescript(VERSION_1)
        for event in events(3, boot=4):
            old.execute("INSERT INTO event VALUES (?, ?, ?, ?, ?)", (4, event.seq, event.alarm, event.event, encode(event)))
    old.close()
    with Reader(path) as reader:
        assert (reader.events(), reader.commands()) == (events(3, boot=4), [])
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        assert journal.boot == 5 and journal.restored_state() == b"locked"
        assert journal.append(events(1, boot=5), b"", [a_command(1)])
        with Reader(path) as reader:
            assert reader.events() == events(3, boot=4) + events(1, boot=5)
            assert reader.commands() == [((5, 1), a_command(1))]


# Commands


def a_command(after: int, boot: int = 5) -> Commanded:
    frames = (SentFrame("VEHICLE_CMD", "100", "0100"),)
    return Commanded("tractor-7", boot, after, seconds(after), None, False, "pause", "", None, "above", "chief", f"c-{after}",
                     "done", "", frames)


@pytest.mark.fault("disk slow or not answering")
def test_commands_wait_in_memory_as_events_do_and_the_oldest_go_first(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_file, "KEEP_COMMANDS", 10)
    with Journal(path, "tractor-7", patience_ns=PATIENT_NS) as journal:
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        assert not journal.append((), b"", [a_command(1, boot=1)])
        other.execute("ROLLBACK")
        other.close()
        journal.append((), b"", [a_command(2, boot=1)])
        eventually(lambda: journal.fault is None)
        with Reader(path) as reader:
            assert [command.after for _, command in reader.commands()] == [1, 2]
            for after in range(3, 16):
                assert journal.append((), b"", [a_command(after, boot=1)])
            assert [command.after for _, command in reader.commands()] == [*range(6, 16)]
            assert [position for position, _ in reader.commands((1, 13))] == [(1, 14), (1, 15)]


@pytest.mark.fault("journal of another version, unit or program")
def test_a_later_version_is_refused_and_left_alone(path: Path) -> None:
    Journal(path, "tractor-7").close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    for refused in (lambda: Journal(path, "tractor-7"), lambda: Reader(path)):
        with pytest.raises(JournalError, match="written by a later version"):
            refused()


@pytest.mark.fault("journal of another version, unit or program")
def test_another_programs_database_is_refused_and_left_alone(path: Path) -> None:
    path.parent.mkdir()
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE precious (thing TEXT)")
    before = path.read_bytes()
    with pytest.raises(JournalError, match="another program's database"):
        Journal(path, "tractor-7")
    with pytest.raises(JournalError, match="not a journal"):
        Reader(path)
    assert path.read_bytes()[100:] == before[100:]


def test_a_file_that_is_empty_still_is_no_mistake_of_who_reads_it(path: Path) -> None:
    path.parent.mkdir()
    path.touch()
    with pytest.raises(JournalError, match="empty; `ucs run` begins it as soon as its disk lets it"):
        Reader(path)


def test_a_journal_that_this_user_may_not_read_is_not_called_corrupt(path: Path) -> None:
    Journal(path, "tractor-7").close()
    path.chmod(0)
    script = """
        import os, sys
        from pathlib import Path
        from level1.io.journal import JournalError, Reader
        os.chdir(sys.argv[1])
        if os.geteuid() == 0:
            os.setuid(65534)  # nobody: root may read everything
        try:
            Reader(Path("journal.db"))
        except JournalError as error:
            print(error)
    """
    command = [sys.executable, "-c", textwrap.dedent(script), str(path.parent)]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout
    assert printed == "journal journal.db: this user may not read it; run it as the user of `ucs run`\n"


@pytest.mark.fault("journal corrupt at the start")
def test_an_unreadable_line_is_left_out_and_counted(path: Path) -> None:
    with Journal(path, "tractor-7") as journal:
        journal.append(events(3), b"")
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE event SET line = x'00' WHERE seq = 2")
    with Reader(path) as reader:
        assert reader.events() == [an_event(1), an_event(3)]
        assert reader.unreadable == 1


def test_a_missing_journal_is_told_in_one_line(path: Path) -> None:
    with pytest.raises(JournalError, match="no such file; give the path"):
        read_events(path)
