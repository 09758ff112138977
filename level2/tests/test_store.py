"""Level 2's own disk: every event once, gaps and losses known, nothing half-written."""
from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from bridge import wire
from bridge.wire import Alarm, Event, alarm_message, seconds
from level2.store import Arrival, Outcome, Sender, Store, StoreError

SENDER = Sender("farm", "tractor-7", 1)


def an_alarm(seq: int, prev: int | None = None, boot: int = 1, text: str = "") -> Alarm:
    event = Event("tractor-7", boot, seq, seconds(seq), None, False, "PilotFlameOut", 3101, "High", "raised", seq, 0, {}, text)
    return alarm_message(event, seq - 1 if prev is None else prev, False)


def add(store: Store, *alarms: Alarm) -> list[Arrival]:
    return store.add([("farm", alarm) for alarm in alarms], "2025-05-01T10:00:00Z")


def outcomes(arrivals: list[Arrival]) -> list[Outcome]:
    return [arrival.outcome for arrival in arrivals]


def test_an_event_is_stored_once(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        assert outcomes(add(store, an_alarm(1), an_alarm(1))) == [Outcome.NEW, Outcome.DUPLICATE]
        assert outcomes(add(store, an_alarm(1))) == [Outcome.DUPLICATE]
        assert store.events() == [wire.event_of(an_alarm(1))]


def test_what_was_stored_is_known_after_a_restart(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        add(store, an_alarm(1), an_alarm(2), an_alarm(5))
    with Store(tmp_path / "level2.db") as store:
        assert list(store.known(SENDER)) == [(1, 2), (5, 5)]
        assert store.gaps() == {SENDER: [(3, 4)]}
        add(store, an_alarm(3), an_alarm(4))
        assert store.gaps() == {}


def test_order_does_not_matter(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        for seq in (5, 3, 4, 1, 2):
            add(store, an_alarm(seq))
        assert store.known(SENDER).upto == 5
        assert [event.seq for event in store.events()] == [1, 2, 3, 4, 5]


def test_seqs_that_the_unit_no_longer_has_are_lost_and_no_gap(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        add(store, an_alarm(1))
        assert add(store, an_alarm(5, prev=2))[0].lost == ((3, 4),)
        assert store.gaps() == {SENDER: [(2, 2)]}
        add(store, an_alarm(2))
        assert store.known(SENDER).upto == 5
        assert store.count("lost") == 1


def test_a_lost_event_that_arrives_after_all_is_stored(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        add(store, an_alarm(5, prev=0))
        assert outcomes(add(store, an_alarm(3))) == [Outcome.NEW]
        assert [event.seq for event in store.events()] == [3, 5]


@pytest.mark.fault("an identity given to two events", "both are kept and told")
def test_two_events_of_one_identity_are_both_kept(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        assert outcomes(add(store, an_alarm(1, text="one"), an_alarm(1, text="other"))) == [Outcome.NEW, Outcome.CONFLICT]
        assert outcomes(add(store, an_alarm(1, text="other"))) == [Outcome.DUPLICATE]
        assert store.count("conflict") == 1


def test_late_arrival_is_no_conflict(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        add(store, an_alarm(2))
        again = alarm_message(wire.event_of(an_alarm(2)), prev=0, historical=True)
        assert outcomes(add(store, again)) == [Outcome.DUPLICATE]


def test_units_fleets_and_boots_are_told_apart(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        store.add([("farm", an_alarm(1)), ("other", an_alarm(1)), ("farm", an_alarm(1, boot=2))], "")
        assert store.count("event") == 3


def test_a_store_that_cannot_be_written_stores_nothing_and_works_again_later(tmp_path: Path) -> None:
    with Store(tmp_path / "level2.db") as store:
        add(store, an_alarm(1))
        other = sqlite3.connect(tmp_path / "level2.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match="nothing is acknowledged until it can"):
            add(store, an_alarm(2), an_alarm(3))
        other.execute("ROLLBACK")
        other.close()
        assert store.known(SENDER).upto == 1
        assert outcomes(add(store, an_alarm(2))) == [Outcome.NEW]


@pytest.mark.parametrize("path", ["/proc/level2.db", "/"])
def test_a_path_that_cannot_be_used_is_told_in_one_line(path: str) -> None:
    with pytest.raises(StoreError, match="give the path of a file in a folder"):
        Store(Path(path))


def test_a_file_that_is_no_store_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "level2.db").write_bytes(b"precious" * 100)
    with pytest.raises(StoreError, match="can't be used"):
        Store(tmp_path / "level2.db")
    assert (tmp_path / "level2.db").read_bytes() == b"precious" * 100
