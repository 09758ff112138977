"""A CAN adapter on a serial line: `ucs run` by python-can's slcan over a pty; unplugged, plugged again, noisy, hanging."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest

from level1.decode import encode
from level1.event import Event
from level1.io.definitions import load
from level1.io.journal import read_events
from level1.tests.lawicel import Adapter
from ucs.tests.running import WAIT_S, beside_run, patient_tool
from ucs.tests.units import unit_toml

IN_TIME_S = 1.0
MESSAGES = load(["ucs.dbc", "flaming_tool.dbc"]).messages
STATUS, UCS_ALARMS = MESSAGES["FLAMER_STATUS"], MESSAGES["UCS_ALARMS"]
ALARMS, COMMAND = "t650", "t110"


@pytest.fixture
def adapter(tmp_path: Path) -> Iterator[Adapter]:
    one = Adapter(tmp_path / "ttyCAN")
    (tmp_path / "unit.toml").write_text(unit_toml(
        "ucs.dbc", "flaming_tool.dbc", armed=["PilotFlameOut"], interface="slcan", channel=str(one.path),
        more="bitrate = 250000\noptions = { sleep_after_open = 0.0 }"))
    patient_tool(tmp_path)
    yield one
    one.stop()


@pytest.fixture
def story(adapter: Adapter, tmp_path: Path) -> Callable[[Callable[[Path], None]], list[Event]]:
    """Runs `ucs run` in this process while the story is told by a thread, with the path of the journal; gives its events."""
    def tell(it: Callable[[Path], None]) -> list[Event]:
        def body(journal: Path) -> None:
            wait_for(lambda: any(line.startswith(ALARMS) for line in adapter.sent))
            it(journal)
        beside_run(tmp_path / "unit.toml", body)
        return list(read_events(tmp_path / "journal.db"))
    return tell


def wait_for(happened: Callable[[], object], meanwhile: Callable[[int], None] = lambda _: None, pause_s: float = 0.005) -> None:
    """Until something has happened. meanwhile: done again and again, with how often it was."""
    end = time.monotonic() + WAIT_S
    for times in count():
        if happened():
            return
        assert time.monotonic() < end, "it did not happen"
        meanwhile(times)
        time.sleep(pause_s)


def flame_out(adapter: Adapter, until: Callable[[], object]) -> None:
    """What a flaming tool says whose pilot flame is out, until something has happened."""
    wait_for(until, lambda times: adapter.hear(STATUS.can_id, encode(
        STATUS, {"Flaming": 1, "PilotFlame": 0, "AliveCounter": times % 4}, None)), pause_s=0.05)


def is_commanded(adapter: Adapter) -> bool:
    """Whether the repair's command has come."""
    return any(line.startswith(COMMAND) for line in adapter.sent)


def told(events: list[Event], alarm: str) -> list[str]:
    return [event.event for event in events if event.alarm == alarm]


def state(adapter: Adapter, alarm: str) -> int:
    """What the last alarm message of UCS_ALARMS on the adapter's bus says."""
    line = next((line for line in reversed(adapter.sent) if line.startswith(f"T{UCS_ALARMS.can_id:08X}")), "")
    place = UCS_ALARMS.signal(alarm).start
    return int.from_bytes(bytes.fromhex(line[10:]), "little") >> place & 3


def test_a_unit_is_supervised_and_commanded_through_it(
        adapter: Adapter, story: Callable[[Callable[[Path], None]], list[Event]]) -> None:
    events = story(lambda _: flame_out(adapter, lambda: is_commanded(adapter)))
    assert told(events, "PilotFlameOut")[:2] == ["raised", "repair_started"]
    assert not told(events, "CanBusDown")


def test_unplugged_it_is_an_alarm_in_time_and_plugged_again_it_works_without_a_restart(
        adapter: Adapter, story: Callable[[Callable[[Path], None]], list[Event]], capsys: pytest.CaptureFixture[str]) -> None:
    pulled: list[float] = []

    def it(journal: Path) -> None:
        for _ in range(2):
            pulled.append(time.monotonic())
            adapter.unplug()
            wait_for(lambda: told(read_events(journal), "CanBusDown").count("raised") == len(pulled), pause_s=0.05)
            adapter.sent.clear()
            adapter.plug()
            wait_for(lambda: any(line.startswith(ALARMS) for line in adapter.sent))
            wait_for(lambda: not state(adapter, "CanBusDown"))
        flame_out(adapter, lambda: is_commanded(adapter))
    events = story(it)
    down = [event for event in events if event.alarm == "CanBusDown"]
    assert [event.event for event in down] == ["raised", "cleared"] * 2
    for event, pulled_s in zip(down[::2], pulled, strict=True):
        assert float(event.t) - pulled_s < IN_TIME_S
    for raised, cleared in zip(down[::2], down[1::2], strict=True):
        assert cleared.values["AwaySeconds"] == round(float(cleared.t - raised.t), 3)
    assert told(events, "PilotFlameOut")[:2] == ["raised", "repair_started"]
    notices = capsys.readouterr().err
    assert notices.count("trying again") == notices.count("back after") == 2


def test_noise_and_half_lines_are_counted_and_what_follows_is_read(
        adapter: Adapter, story: Callable[[Callable[[Path], None]], list[Event]], capsys: pytest.CaptureFixture[str]) -> None:
    def it(_: Path) -> None:
        for noise in (b"\xff\xfe\x80\r", b"t21", b"t2108ZZ\r", b"T1F\r", b"t\r", b"\r\r\a\r", b"x\r"):
            adapter.write(noise)
            time.sleep(0.02)
        flame_out(adapter, lambda: is_commanded(adapter))
    events = story(it)
    assert told(events, "PilotFlameOut")[:2] == ["raised", "repair_started"]
    assert not told(events, "CanBusDown")
    assert " impossible" in capsys.readouterr().out


def test_one_that_hangs_does_not_hold_supervision_and_is_told(
        adapter: Adapter, story: Callable[[Callable[[Path], None]], list[Event]]) -> None:
    def it(journal: Path) -> None:
        adapter.hang()
        end = time.monotonic() + 4.0  # an alarm message comes once a second, and waits for as long
        flame_out(adapter, lambda: time.monotonic() > end and told(read_events(journal), "PilotFlameOut"))
        adapter.sent.clear()
        adapter.drains = True
        wait_for(lambda: state(adapter, "SendFailed"))
        begin.append(time.monotonic())
        wait_for(lambda: not state(adapter, "SendFailed"))
    begin: list[float] = []
    events = story(it)
    raised = {event.alarm: event for event in events if event.event == "raised"}
    assert {"PilotFlameOut", "SendFailed"} <= raised.keys() and "CanBusDown" not in raised
    assert float(raised["PilotFlameOut"].t) < begin[0], "supervision went on meanwhile"
    assert told(events, "SendFailed") == ["raised", "cleared"]
    lost = next(event for event in events if (event.alarm, event.event) == ("SendFailed", "cleared")).values["NotSent"]
    assert lost["FLAMER_CMD"] > 0 and lost["UCS_ALARMS"] > 0
