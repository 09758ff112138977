"""`ucs order`: someone at the machine lifts what level 2 may not, and nobody else passes for him."""
from __future__ import annotations

import time
from decimal import Decimal
from pathlib import Path

import pytest

from bridge.link import BridgeLink
from level1.command import Order
from level1.event import Event, Result
from level1.io.journal import Journal, read_events
from level1.io.live import encode_state
from level1.memory import AlarmMemory, State
from ucs.main import main
from ucs.order import give
from ucs.tests.running import WAIT_S, awaited, beside_run, flaming_unit


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """A unit that was stopped from above, with an alarm locked out."""
    file = tmp_path / "unit.toml"
    file.write_text(flaming_unit("test_order"))
    raised = Event("tractor-7", 1, 1, Decimal("1.000000000"), None, False, "PilotFlameOut", 3101, "High", "raised", 1, 0, {}, "out")
    memory = AlarmMemory("PilotFlameOut", 3, 1, False, 3, (), ())
    with Journal(tmp_path / "journal.db", "tractor-7") as writing:
        writing.append([raised], encode_state(State("stopped", (memory,))))
    return file


def test_what_a_restart_left_unfinished_is_told_with_the_time_of_day_and_sent_in_time(unit: Path) -> None:
    journal = unit.parent / "journal.db"
    memory = AlarmMemory("PilotFlameOut", 2, 1, False, 1, (0,), ())
    with Journal(journal, "tractor-7") as writing:
        writing.append((), encode_state(State("running", (memory,))))
    beside_run(unit, lambda path: [awaited(path, lambda run: run.buses[0].sent > 0)].clear())
    failed = read_events(journal)[1]
    assert (failed.event, failed.text) == ("repair_failed", "the supervisor was restarted during the attempt")
    assert failed.utc is not None


def test_only_someone_at_the_machine_lets_a_stopped_unit_work_again(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    codes: list[int] = []
    from_above: list[object] = []

    def body(journal: Path) -> None:
        assert awaited(journal).mode == "stopped"
        bridge = BridgeLink(journal)
        bridge.instruct(Order("1", "resume", origin="local"))
        end = time.monotonic() + WAIT_S
        while not (answers := [answer for answer in bridge.receive() if hasattr(answer, "result")]):
            assert time.monotonic() < end
            time.sleep(0.01)
        from_above.append(answers[0])
        bridge.close()
        assert awaited(journal).mode == "stopped"
        codes.append(main(["order", str(unit), "resume"]))
        awaited(journal, lambda run: run.mode == "running")
        codes.append(main(["order", str(unit), "reset", "PilotFlameOut"]))
        awaited(journal, lambda run: not run.alarms)
        codes.append(main(["order", str(unit), "reset", "PilotFlameOot"]))
    beside_run(unit, body)
    answer = from_above[0].result  # type: ignore[attr-defined]
    assert answer == Result("1", "refused", "the unit was stopped: it is started again at the machine")
    out = capsys.readouterr().out
    assert codes == [0, 0, 1]
    assert "resume: done\n" in out and "reset PilotFlameOut: done\n" in out
    assert 'reset PilotFlameOot: refused, unknown alarm PilotFlameOot; did you mean "PilotFlameOut"?' in out


def test_without_a_run_it_says_so(unit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["order", str(unit), "reset", "PilotFlameOut"]) == 2
    assert "ucs: `ucs run` of tractor-7 does not answer: is it running" in capsys.readouterr().err
    assert give(unit.parent / "journal.db", Order("2", "resume", origin="local"), 0.05) is None
    assert not list(unit.parent.glob("*.order.sock"))


@pytest.mark.parametrize(("arguments", "told"), [
    (["reset"], "reset: which alarm?"), (["reduce_speed", "--value", "slow"], '"slow" is no number'),
    (["reduce_speed", "--value", "Infinity"], "no number that a signal can say"),
])
def test_a_wrong_order_is_one_line(unit: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], told: str) -> None:
    assert main(["order", str(unit), *arguments]) == 2
    err = capsys.readouterr().err
    assert told in err and len(err.splitlines()) == 1
