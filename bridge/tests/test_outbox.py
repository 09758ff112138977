"""What the outbox sends, in which order, how often, and what takes an event out of it."""
from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.delivered import Delivered, delivered_upto
from bridge.outbox import BACKLOG_PER_S, FRESH, RETRY_LONGEST_NS, RETRY_NS, WINDOW, Delivery, Outbox, Verdict
from bridge.ranges import Ranges
from level1.event import Event, seconds
from level1.io.error import OutsideError
from level1.io.journal import Journal, Reader

S = 1_000_000_000
NEVER = 10**18


def an_event(seq: int, boot: int = 1) -> Event:
    return Event("tractor-7", boot, seq, seconds(seq), None, False, "PilotFlameOut", 3101, "High", "raised", seq, 0, {}, "")


class Unit:
    """A journal with an outbox over it. The bridge can be killed: what it holds in memory is gone."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.boot()
        self.start()

    def boot(self) -> None:
        self.journal = Journal(self.folder / "journal.db", "tractor-7", patience_ns=60 * S)

    def start(self) -> None:
        self.reader = Reader(self.folder / "journal.db")
        self.delivered = Delivered(self.folder / "delivered.db")
        self.outbox = Outbox(self.reader, self.delivered, jitter=random.Random(7))

    def kill(self) -> None:
        self.reader.close()
        self.delivered.close()

    def write(self, *seqs: int) -> None:
        self.journal.append([an_event(seq, self.journal.boot) for seq in seqs], b"")

    def reboot(self) -> None:
        self.journal.close()
        self.boot()

    def close(self) -> None:
        self.kill()
        self.journal.close()


@pytest.fixture
def unit(tmp_path: Path) -> Iterator[Unit]:
    unit = Unit(tmp_path)
    yield unit
    unit.close()


def seqs(deliveries: list[Delivery]) -> list[int]:
    return [delivery.event.seq for delivery in deliveries]


def test_a_new_event_is_sent_at_once_and_only_once(unit: Unit) -> None:
    unit.outbox.connected(0)
    assert unit.outbox.due(0) == []
    unit.write(1)
    assert unit.outbox.due(S) == [Delivery(an_event(1), 0, False)]
    assert unit.outbox.due(S) == []


@pytest.mark.fault("level 2 away for long", "events are sent ever less often; when it is back, within 2 s")
def test_an_event_is_sent_again_later_and_later_until_it_is_acknowledged(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(1)
    sent_ns, now = [], 0
    for _ in range(12):
        assert seqs(unit.outbox.due(now)) == [1]
        sent_ns.append(now)
        due = unit.outbox.next_due_ns()
        assert due is not None
        assert unit.outbox.due(due - 1) == []
        now = due
    pauses = [later - earlier for earlier, later in zip(sent_ns, sent_ns[1:], strict=False)]
    assert 0.75 * RETRY_NS <= pauses[0] <= 1.25 * RETRY_NS
    assert all(0.75 * RETRY_LONGEST_NS <= pause <= 1.25 * RETRY_LONGEST_NS for pause in pauses[5:])
    assert len(set(pauses)) == len(pauses)
    assert unit.outbox.acknowledge(1, 1) is Verdict.NEW
    assert unit.outbox.due(NEVER) == []
    assert unit.outbox.next_due_ns() is None


@pytest.mark.fault("level 2 away for long")
def test_a_level_2_that_is_back_need_not_wait_for_the_longest_pause(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(1, 2)
    now = 0
    for _ in range(20):
        unit.outbox.due(now)
        now = unit.outbox.next_due_ns() or 0
    unit.outbox.due(now)
    assert unit.outbox.due(now + RETRY_NS) == []
    unit.outbox.heard(now)
    assert sorted(seqs(unit.outbox.due(now + RETRY_NS))) == [1, 2]
    for second in range(1, 60):  # one that refuses an event and takes others in is not pressed
        unit.outbox.heard(now + second * S)
    assert len(unit.outbox.due(now + 60 * S)) == 2


def test_the_window_bounds_what_is_in_flight(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(*range(1, 101))
    assert seqs(unit.outbox.due(0)) == [*range(1, WINDOW + 1)]
    assert unit.outbox.due(0) == []
    unit.outbox.acknowledge(1, 10)
    assert seqs(unit.outbox.due(0)) == [*range(WINDOW + 1, WINDOW + 11)]


def test_what_waited_for_the_connection_is_historical_and_what_is_new_goes_first(unit: Unit) -> None:
    unit.write(*range(1, 101))
    unit.outbox.connected(0)
    unit.write(101)
    first = unit.outbox.due(0)
    assert first[0] == Delivery(an_event(101), 100, False)
    assert all(delivery.historical for delivery in first[1:])
    assert seqs(first[1:]) == [1]


@pytest.mark.fault("poor link")
def test_the_backlog_leaves_at_a_bounded_rate_and_completely(unit: Unit) -> None:
    unit.write(*range(1, 501))
    unit.outbox.connected(0)
    found: list[int] = []
    now = 0
    while (due := unit.outbox.next_due_ns()) is not None:
        now = due
        sent = seqs(unit.outbox.due(now))
        found += sent
        for seq in sent:
            unit.outbox.acknowledge(1, 0, [(seq, seq)])
    assert found == [*range(1, 501)]
    assert now == pytest.approx(500 / BACKLOG_PER_S * S, rel=0.05)


@pytest.mark.fault("poor link", "the newest events first, the backlog behind at a bounded rate")
def test_many_new_events_on_a_poor_link_become_backlog_and_the_newest_goes_first(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(*range(1, FRESH + 2 * WINDOW))
    assert seqs(unit.outbox.due(0)) == [1]
    unit.write(FRESH + 2 * WINDOW)
    assert seqs(unit.outbox.due(0)) == [FRESH + 2 * WINDOW]


@pytest.mark.fault("poor link")
def test_a_backlog_that_the_link_does_not_take_holds_no_new_event_up(unit: Unit) -> None:
    unit.write(*range(1, 101))
    unit.outbox.connected(0)
    for second in range(60):
        unit.outbox.due(second * S)
    assert (unit.outbox.next_due_ns() or 0) > 59 * S  # and nothing is asked for all the time
    unit.write(101)
    assert [delivery.event.seq for delivery in unit.outbox.due(61 * S) if not delivery.historical] == [101]


def test_every_event_of_every_boot_is_sent(unit: Unit) -> None:
    unit.write(1, 2)
    unit.reboot()
    unit.outbox.connected(0)
    unit.write(1, 2, 3)
    found = [(delivery.event.boot, delivery.event.seq, delivery.prev) for delivery in unit.outbox.due(S)]
    assert found == [(2, 1, 0), (2, 2, 1), (2, 3, 2), (1, 1, 0), (1, 2, 1)]


def test_a_lost_seq_is_told_by_its_neighbour(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(1, 2, 5)
    assert unit.outbox.due(0)[-1].prev == 2


@pytest.mark.fault("bridge killed", "what was not acknowledged is sent again, nothing else")
def test_a_killed_bridge_sends_again_what_was_not_acknowledged_and_nothing_else(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(*range(1, 21))
    unit.outbox.due(0)
    unit.outbox.acknowledge(1, 5, [(8, 9)])
    unit.kill()
    unit.start()
    unit.outbox.connected(S)
    assert seqs(unit.outbox.due(10 * S)) == [6, 7, *range(10, 21)]
    assert delivered_upto(unit.folder / "delivered.db") == {1: 5}


def test_a_new_connection_sends_again_what_the_old_one_carried(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(1, 2)
    unit.outbox.due(0)
    unit.outbox.connected(S)
    assert [(delivery.event.seq, delivery.historical) for delivery in unit.outbox.due(2 * S)] == [(1, True), (2, True)]


# Acknowledgements


@pytest.mark.fault("level 2 acknowledges what it never got, or goes backwards")
def test_an_acknowledgement_of_what_was_never_sent_changes_nothing(unit: Unit) -> None:
    unit.write(1, 2, 3)
    assert unit.outbox.acknowledge(1, 3) is Verdict.NOTHING_NEW
    assert unit.outbox.acknowledge(1, 4) is Verdict.NEVER_SENT
    assert unit.outbox.acknowledge(9, 1) is Verdict.NEVER_SENT
    assert unit.outbox.acknowledge(1, 0, [(2, 2**40)]) is Verdict.NEVER_SENT
    unit.outbox.connected(0)
    assert seqs(unit.outbox.due(S)) == [1, 2, 3]


@pytest.mark.fault("level 2 acknowledges what it never got, or goes backwards")
def test_an_acknowledgement_that_goes_backwards_changes_nothing(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(*range(1, 11))
    unit.outbox.due(0)
    assert unit.outbox.acknowledge(1, 8) is Verdict.NEW
    assert unit.outbox.acknowledge(1, 3) is Verdict.BACKWARDS
    assert unit.delivered.of(1) == Ranges([(1, 8)])
    assert seqs(unit.outbox.due(5 * S)) == [9, 10]


def test_an_empty_acknowledgement_is_harmless(unit: Unit) -> None:
    assert unit.outbox.acknowledge(1, 0) is Verdict.NOTHING_NEW
    assert unit.outbox.acknowledge(1, 0, [(5, 2)]) is Verdict.NOTHING_NEW


@pytest.mark.fault("level 2 loses its disk", "it asks for the gap, the unit sends again what it still has")
def test_acknowledged_events_are_sent_again_when_level_2_lost_them(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(*range(1, 11))
    unit.outbox.due(0)
    unit.outbox.acknowledge(1, 10)
    unit.outbox.ask(1, [(3, 5), (9, 200)])
    found = unit.outbox.due(S) + unit.outbox.due(2 * S)
    assert seqs(found) == [3, 4, 5, 9, 10]
    assert all(delivery.historical for delivery in found)
    assert unit.outbox.acknowledge(1, 10) is Verdict.NOTHING_NEW
    assert unit.outbox.due(NEVER) == []
    assert unit.outbox.next_due_ns() is None


# Events that the journal can't take


def test_events_that_the_journal_cannot_take_leave_all_the_same(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(1)
    unit.outbox.unjournaled([an_event(2), an_event(3)])
    assert [(delivery.event.seq, delivery.prev) for delivery in unit.outbox.due(0)] == [(1, 0), (2, 1), (3, 2)]
    assert unit.outbox.acknowledge(1, 3) is Verdict.NEW
    unit.outbox.unjournaled([an_event(3)])
    unit.write(2, 3)
    assert unit.outbox.due(NEVER) == []


def test_an_event_beside_the_journal_that_arrives_in_it_is_not_doubled(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.outbox.unjournaled([an_event(1)])
    assert seqs(unit.outbox.due(0)) == [1]
    unit.write(1, 2)
    assert seqs(unit.outbox.due(0)) == [2]


def test_waiting_counts_what_is_not_acknowledged(unit: Unit) -> None:
    unit.outbox.connected(0)
    unit.write(*range(1, 11))
    unit.outbox.unjournaled([an_event(11)])
    unit.outbox.due(0)
    unit.outbox.acknowledge(1, 4)
    assert unit.outbox.waiting() == 7


# The file of what was delivered


@pytest.mark.fault("the bridge's file of deliveries damaged", "events are sent twice, none is lost")
@pytest.mark.parametrize("content", [b"not a database", b"SQLite format 3\0" + bytes(200)])
def test_a_damaged_file_of_deliveries_costs_a_second_delivery_only(unit: Unit, content: bytes) -> None:
    unit.outbox.connected(0)
    unit.write(1, 2)
    unit.outbox.due(0)
    unit.outbox.acknowledge(1, 2)
    unit.kill()
    for suffix in ("-wal", "-shm"):
        (unit.folder / f"delivered.db{suffix}").unlink(missing_ok=True)
    (unit.folder / "delivered.db").write_bytes(content)
    unit.start()
    assert "begun anew" in unit.delivered.fault
    unit.outbox.connected(0)
    assert seqs(unit.outbox.due(S)) == [1, 2]


def test_a_second_bridge_on_the_same_journal_is_refused(unit: Unit) -> None:
    with pytest.raises(OutsideError, match="another `ucs bridge` serves this journal"):
        Delivered(unit.folder / "delivered.db")
