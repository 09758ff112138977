"""Response time, retries and jams of an actuator."""
from __future__ import annotations

from firmware_py.actuator import Actuator

MS = 1_000_000


def drive(actuator: Actuator[str], target: str, start_ms: int, end_ms: int, step_ms: int = 20) -> int | None:
    """Drive it in steps; the time in ms at which it arrived."""
    for now_ms in range(start_ms, end_ms, step_ms):
        actuator.advance(now_ms * MS, target)
        if actuator.position == target:
            return now_ms
    return None


def test_it_arrives_after_its_response_time() -> None:
    assert drive(Actuator("Closed", 300 * MS), "Open", 0, 1000) == 300


def test_a_target_that_changes_on_the_way_starts_anew() -> None:
    actuator = Actuator("Closed", 300 * MS)
    assert drive(actuator, "Open", 0, 200) is None
    assert drive(actuator, "Closed", 200, 260) == 200
    assert drive(actuator, "Open", 260, 1000) == 560


def test_a_jam_for_two_commands_costs_two_tries() -> None:
    actuator = Actuator("Closed", 300 * MS)
    actuator.jam(("Open",), 2)
    assert drive(actuator, "Open", 0, 5000) == 2300


def test_a_jam_without_end_holds_until_released() -> None:
    actuator = Actuator("Closed", 300 * MS)
    actuator.jam()
    assert drive(actuator, "Open", 0, 60_000) is None
    actuator.release()
    assert drive(actuator, "Open", 60_000, 62_000) is not None


def test_a_jam_may_refuse_some_positions_only() -> None:
    actuator = Actuator("Off", 100 * MS)
    actuator.jam(("High",))
    assert drive(actuator, "Low", 0, 1000) == 100
    assert drive(actuator, "High", 1000, 9000) is None


def test_what_is_forced_away_is_tried_again() -> None:
    actuator = Actuator("Closed", 100 * MS)
    drive(actuator, "Open", 0, 200)
    actuator.force("Closed")
    assert drive(actuator, "Open", 200, 1000) == 300


def test_without_retries_of_its_own_it_tries_again_only_when_told_to() -> None:
    actuator = Actuator("Closed", 300 * MS, retry_ns=None)
    actuator.jam(("Open",), 2)
    assert drive(actuator, "Open", 0, 10_000) is None
    actuator.again(10_000 * MS)
    assert drive(actuator, "Open", 10_000, 20_000) is None, "the second command that it ignores"
    actuator.again(20_000 * MS)
    assert drive(actuator, "Open", 20_000, 30_000) == 20_300


def test_again_while_it_moves_or_at_the_moment_of_a_try_is_no_further_try() -> None:
    actuator = Actuator("Closed", 300 * MS, retry_ns=None)
    actuator.jam(("Open",), 2)
    actuator.advance(MS, "Open")
    actuator.again(MS)
    actuator.again(2 * MS)
    actuator.again(3 * MS)
    actuator.again(4 * MS)
    assert drive(actuator, "Open", 10, 1000, 1) == 303
