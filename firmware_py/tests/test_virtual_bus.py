"""Order, arbitration and time on the virtual bus."""
from __future__ import annotations

import pytest

from firmware_py.participant import BusFrame
from firmware_py.virtual_bus import Simulation

MS = 1_000_000


class Talker:
    """Sends its frames at given times; keeps what it hears with the time."""

    def __init__(self, *schedule: tuple[int, BusFrame]):
        self.schedule = list(schedule)
        self.heard: list[tuple[int, int, bytes]] = []

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        self.heard.append((t_ns, can_id, data))

    def step(self, now_ns: int) -> list[BusFrame]:
        due = [frame for t_ns, frame in self.schedule if t_ns <= now_ns]
        self.schedule = self.schedule[len(due):]
        return due

    def next_deadline(self) -> int | None:
        return self.schedule[0][0] if self.schedule else None


class Echo(Talker):
    """Answers each frame at once with the next identifier."""

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        super().receive(t_ns, can_id, extended, data)
        if can_id == 0x100:
            self.schedule.append((t_ns, BusFrame(can_id + 1, False, data)))


def frame(can_id: int, length: int = 8, extended: bool = False) -> BusFrame:
    return BusFrame(can_id, extended, bytes(length))


def test_a_frame_takes_its_bit_time_and_does_not_reach_its_sender() -> None:
    sender, listener = Talker((5 * MS, frame(0x100))), Talker()
    simulation = Simulation([sender, listener])
    simulation.run(10 * MS)
    assert listener.heard == [(5 * MS + (47 + 64) * 4000, 0x100, bytes(8))]
    assert sender.heard == []
    assert simulation.frames == 1


def test_the_lowest_identifier_wins_and_the_others_wait() -> None:
    listener = Talker()
    first = Talker((MS, frame(0x300)), (MS, frame(0x200)))
    second = Talker((MS, frame(0x050 << 18, extended=True)), (MS, frame(0x050)))
    Simulation([first, second, listener]).run(10 * MS)
    assert [can_id for _, can_id, _ in listener.heard] == [0x050, 0x050 << 18, 0x200, 0x300]
    times = [t_ns for t_ns, _, _ in listener.heard]
    assert times == sorted(set(times)), "one at a time"


def test_a_carried_frame_is_not_interrupted() -> None:
    listener = Talker()
    Simulation([Talker((0, frame(0x700))), Talker((1000, frame(0x001))), listener]).run(10 * MS)
    assert [can_id for _, can_id, _ in listener.heard] == [0x700, 0x001]


def test_frames_of_one_identifier_keep_their_order() -> None:
    listener = Talker()
    Simulation([Talker(*((0, BusFrame(0x10, False, bytes([n]))) for n in range(5))), listener]).run(10 * MS)
    assert [data[0] for _, _, data in listener.heard] == [0, 1, 2, 3, 4]


def test_an_answer_follows_at_once() -> None:
    talker = Talker((0, frame(0x100, 0)))
    Simulation([talker, Echo()]).run(10 * MS)
    assert talker.heard == [(2 * 47 * 4000, 0x101, b"")]


def test_it_goes_on_where_it_stopped() -> None:
    listener = Talker()
    simulation = Simulation([Talker((MS, frame(1)), (3 * MS, frame(2))), listener])
    simulation.run(2 * MS)
    assert [can_id for _, can_id, _ in listener.heard] == [1]
    simulation.run(5 * MS)
    assert [can_id for _, can_id, _ in listener.heard] == [1, 2]
    assert simulation.now_ns == 5 * MS


def test_who_is_detached_neither_sends_nor_hears() -> None:
    first, second, listener = Talker((MS, frame(1)), (3 * MS, frame(2))), Talker((MS, frame(3)), (5 * MS, frame(4))), Talker()
    simulation = Simulation([first, second, listener])
    simulation.run(2 * MS)
    simulation.detach(first)
    simulation.run(9 * MS)
    assert [can_id for _, can_id, _ in listener.heard] == [1, 3, 4]
    assert [can_id for _, can_id, _ in first.heard] == [3]
    with pytest.raises(ValueError):
        simulation.detach(first)


def test_a_participant_that_is_never_done_is_told_instead_of_hanging() -> None:
    class Restless(Talker):
        def next_deadline(self) -> int | None:
            return 0

    with pytest.raises(RuntimeError, match="again and again"):
        Simulation([Restless()]).run(MS)
