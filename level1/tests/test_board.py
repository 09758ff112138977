"""The board: what it keeps of a signal, and how its watchdogs find silence."""
from __future__ import annotations

import struct
from itertools import zip_longest

from hypothesis import given, settings
from hypothesis import strategies as st

from level1.catalog import Message
from level1.decode import ERROR, GOOD
from level1.event import Output
from level1.expression import Silent
from level1.tests.build import MS, SECOND, alarm, compare, events, frame, message, signal, supervisor

PRESSURE = message("PRESSURE", 0x100, [signal("Bar", 0, 32, is_float=True)])
CYCLIC = message("CYCLIC", 0x101, [signal("A", 0, 8)], cycle_ns=10 * MS)
SPORADIC = message("SPORADIC", 0x102, [signal("B", 0, 8)], cycle_ns=None)


def test_a_float_that_is_no_number_is_shown_as_an_error() -> None:
    target = supervisor([PRESSURE], [alarm("High", compare("PRESSURE.Bar", ">", 5), latch=True)])
    raised = target.receive(frame(0, PRESSURE, *struct.pack("<f", 7.0)))[0]
    assert raised.values == {"PRESSURE.Bar": 7.0}  # type: ignore[union-attr]
    cell = target.board.cells["PRESSURE.Bar"]
    assert cell.quality == GOOD
    target.receive(frame(1, PRESSURE, *struct.pack("<f", float("nan"))))
    assert cell.quality == ERROR and target.board.sample(cell)[1] == ERROR


@given(st.lists(st.tuples(st.sampled_from([CYCLIC, SPORADIC]), st.integers(0, 90)), min_size=1, max_size=60),
       st.sampled_from([1, 7, 25, 30, 31, 100]))
@settings(max_examples=200, deadline=None)
def test_silence_is_told_exactly_at_its_limit_however_messages_come(steps: list[tuple[Message, int]], limit_ms: int) -> None:
    talkers = (CYCLIC, SPORADIC)
    target = supervisor(talkers, [alarm(f"{talker.name}_SILENT", Silent(talker.name, limit_ms * MS), talker.can_id)
                                  for talker in talkers])
    heard: dict[str, list[int]] = {talker.name: [] for talker in talkers}
    out: list[Output] = []
    now = 0
    for talker, gap_ms in steps:
        now += gap_ms * MS
        out += target.receive(frame(now, talker))
        heard[talker.name].append(now)
    out += target.tick(now + SECOND)
    expected = []
    for name, stamps in heard.items():
        for last, following in zip_longest(stamps, stamps[1:]):
            if following is None or following - last >= limit_ms * MS:
                expected.append(((last + limit_ms * MS) / SECOND, f"{name}_SILENT", "raised"))
                if following is not None:
                    expected.append((following / SECOND, f"{name}_SILENT", "cleared"))
    assert sorted(events(out)) == sorted(expected)
