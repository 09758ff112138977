"""The life of an alarm: delays, hysteresis, latches, missing and wrong data, deadlines."""
from __future__ import annotations

import json
from decimal import Decimal

import pytest

from level1.catalog import Repair
from level1.command import Order
from level1.event import Event, Monitor, Result, encode
from level1.expression import AlarmState, And, Compare, Count, Elapsed, ExpectStep, Number, Quality, Silent
from level1.frame import EXTENDED, REMOTE, Frame
from level1.supervisor import Supervisor
from level1.tests.build import MS, SECOND, alarm, catalog, compare, events, frame, message, sends, signal, supervisor

TANK = message("TANK", 0x100, [signal("Level", 0, 8, maximum=Decimal(200), minimum=Decimal(0)), signal("Pump", 8, 1),
                               signal("Flow", 16, 16)])
LOW = compare("TANK.Level", "<", 20)


def feed(target: Supervisor, *levels: tuple[float, int]) -> list[tuple[float, str, str]]:
    """Frames with a level each, at seconds; gives the events."""
    return events(target.receive_many([frame(round(t * SECOND), TANK, level) for t, level in levels]))


def test_without_delay_it_is_raised_and_cleared_by_the_frame() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    assert feed(target, (0, 50), (0.1, 19), (0.2, 20)) == [(0.1, "Low", "raised"), (0.2, "Low", "cleared")]


def test_on_delay_ends_exactly_although_no_frame_comes_then() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, on_delay_ns=300 * MS)])
    assert feed(target, (0, 10), (0.25, 10)) == []
    assert target.next_deadline() is not None and target.next_deadline() <= 300 * MS  # type: ignore[operator]
    assert events(target.tick(300 * MS - 1)) == []
    assert events(target.tick(2 * SECOND)) == [(0.3, "Low", "raised")]


def test_on_delay_starts_anew_after_the_condition_was_false() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, on_delay_ns=300 * MS)])
    assert feed(target, (0, 10), (0.2, 30), (0.25, 10), (0.5, 10)) == []
    assert feed(target, (0.6, 10)) == [(0.55, "Low", "raised")]


def test_off_delay_and_until_form_a_hysteresis() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, until=compare("TANK.Level", ">", 40), off_delay_ns=SECOND)])
    assert feed(target, (0, 10), (0.1, 30)) == [(0, "Low", "raised")]
    assert feed(target, (0.2, 50), (0.3, 40), (0.4, 50), *((0.5 + n / 10, 50) for n in range(8))) == []
    assert feed(target, (1.3, 50), (1.4, 50), (1.5, 50)) == [(1.4, "Low", "cleared")]


def test_stale_holds_the_on_delay_and_what_was_left_goes_on() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, on_delay_ns=SECOND)])
    assert feed(target, (0, 10)) == []
    assert events(target.tick(5 * SECOND)) == []
    assert feed(target, (6, 10), *((6 + n / 10, 10) for n in range(1, 9))) == [(6 + 1 - 0.300000001, "Low", "raised")]


def test_lost_frames_neither_clear_nor_reset() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    assert feed(target, (0, 10)) == [(0, "Low", "raised")]
    assert events(target.tick(60 * SECOND)) == []
    assert target.alarm_states() == {"Low": 1}


def test_error_neither_raises_nor_clears() -> None:
    target = supervisor([TANK], [alarm("High", compare("TANK.Level", ">", 100))])
    assert feed(target, (0, 201), (0.1, 255)) == []
    assert feed(target, (0.2, 150), (0.3, 201), (0.4, 50)) == [(0.2, "High", "raised"), (0.4, "High", "cleared")]


def test_a_short_frame_is_an_error_of_the_signals_it_lacks_only() -> None:
    target = supervisor([TANK], [alarm("Low", LOW), alarm("Flowing", compare("TANK.Flow", ">", 5), 2)])
    outputs = target.receive_many([frame(0, TANK, 50, 0, 9), Frame(1, 0x100, b"\x0a"), Frame(2, 0x100, b"")])
    assert [(name, what) for _, name, what in events(outputs)] == [("Flowing", "raised"), ("Low", "raised")]
    assert target.counters["short frames"] == 2
    assert target.alarm_states() == {"Low": 1, "Flowing": 1}


def test_enabled_when_suppresses_and_its_end_clears() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, enabled=compare("TANK.Pump", "==", 1), on_delay_ns=100 * MS)])
    frames = [frame(0, TANK, 10, 0), frame(SECOND, TANK, 10, 1), frame(SECOND + 150 * MS, TANK, 10, 1),
              frame(SECOND + 250 * MS, TANK, 10, 0)]
    assert events(target.receive_many(frames)) == [(1.1, "Low", "raised"), (1.25, "Low", "cleared")]


def test_a_latched_alarm_waits_for_the_acknowledgement() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, latch=True)])
    assert feed(target, (0, 10), (0.1, 50)) == [(0, "Low", "raised")]
    outputs = target.command(Order("1", "acknowledge", "Low"), 200 * MS)
    assert events(outputs) == [(0.2, "Low", "acknowledged"), (0.2, "Low", "cleared")]


def test_a_local_latch_is_lifted_at_the_machine_only() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, latch=True, local_latch=True)])
    assert feed(target, (0, 10), (0.1, 50)) == [(0, "Low", "raised")]
    named = target.command(Order("1", "acknowledge", "Low"), 200 * MS)
    assert named == [Result("1", "refused", "Low can only be acknowledged at the machine")]
    assert target.command(Order("2", "acknowledge"), 200 * MS) == [Result("2", "done")]
    outputs = target.command(Order("3", "acknowledge", origin="local"), 300 * MS)
    assert events(outputs) == [(0.3, "Low", "acknowledged"), (0.3, "Low", "cleared")]


def test_acknowledged_before_it_clears_by_itself() -> None:
    target = supervisor([TANK], [alarm("Low", LOW, latch=True)])
    feed(target, (0, 10))
    outputs = target.command(Order("1", "acknowledge"), 50 * MS)
    assert events(outputs) == [(0.05, "Low", "acknowledged")] and outputs[-1] == Result("1", "done")
    assert feed(target, (0.1, 50)) == [(0.1, "Low", "cleared")]


def test_refused_orders_say_why() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    for order, reason in ((Order("1", "acknowledge", "Low"), "not active"),
                          (Order("2", "reset", "Low", origin="local"), "not locked out"),
                          (Order("3", "acknowledge", "Lwo"), "unknown alarm"), (Order("4", "dance"), "unknown command")):
        result = target.command(order, 0)[-1]
        assert isinstance(result, Result) and result.outcome == "refused" and reason in result.reason


def test_a_time_stamp_that_runs_backwards_is_clamped_and_counted() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    assert feed(target, (5, 50), (3, 10), (2, 50)) == [(5, "Low", "raised"), (5, "Low", "cleared")]
    assert target.counters["time stamps that ran backwards"] == 2
    assert events(target.tick(4 * SECOND)) == []


def test_silence_is_a_deadline_and_unknown_before_the_first_frame() -> None:
    target = supervisor([TANK], [alarm("Gone", Silent("TANK", SECOND))], start_ns=0)
    assert events(target.tick(10 * SECOND)) == []
    assert feed(target, (11, 50)) == []
    assert events(target.tick(20 * SECOND)) == [(12, "Gone", "raised")]
    assert feed(target, (21, 50)) == [(21, "Gone", "cleared")]


def test_never_seen_is_told_apart_from_silent() -> None:
    target = supervisor([TANK], [alarm("Absent", Quality("never", "TANK", ""), on_delay_ns=5 * SECOND)], start_ns=0)
    assert events(target.tick(20 * SECOND)) == [(5, "Absent", "raised")]
    assert feed(target, (21, 50)) == [(21, "Absent", "cleared")]


def test_held_counts_from_the_last_change() -> None:
    target = supervisor([TANK], [alarm("Stuck", Elapsed("held", "TANK", "Level", ">=", SECOND))])
    assert feed(target, *((n / 10, 50) for n in range(6)), *((0.6 + n / 10, 51) for n in range(13))) == [(1.6, "Stuck", "raised")]


def test_count_and_state_ask_for_other_alarms() -> None:
    often = Compare(">=", Count("Low", 10 * SECOND), Number(Decimal(3)))
    both = And((Compare("==", AlarmState("Low"), Number(Decimal(1))), Compare("==", AlarmState("Often"), Number(Decimal(1)))))
    target = supervisor([TANK], [alarm("Low", LOW), alarm("Often", often, 2), alarm("Both", both, 3)])
    outcome = feed(target, *((n / 10, 10 if n % 20 else 50) for n in range(150)))
    assert (4.1, "Often", "raised") in outcome and (4.1, "Both", "raised") in outcome
    assert events(target.tick(30 * SECOND)) == [(20.1, "Often", "cleared"), (20.1, "Both", "cleared")]


def test_the_freeze_frame_names_the_inputs() -> None:
    target = supervisor([TANK], [alarm("Low", And((LOW, compare("TANK.Pump", "==", 0))))])
    event = next(out for out in target.receive_many([frame(0, TANK, 10)]) if isinstance(out, Event))
    assert event.values == {"TANK.Level": 10, "TANK.Pump": 0}
    assert " ".join(json.loads(encode(event))) == \
        "unit boot seq t utc utc_trusted alarm code priority event instance attempt values text"


def test_times_have_nine_places_from_the_first_nanosecond() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    lines = [encode(out) for t, level in ((0, 10), (1, 50), (1500, 10)) for out in target.receive_many([frame(t, TANK, level)])
             if isinstance(out, Event)]
    assert [line.split(b'"t":')[1].split(b",")[0] for line in lines] == [b"0.000000000", b"0.000000001", b"0.000001500"]


def test_alarm_messages_go_out_at_every_change_and_at_their_cycle() -> None:
    target = supervisor([TANK], [alarm("Low", LOW), alarm("Empty", compare("TANK.Level", "<", 5), 2)], broadcast=True)
    outputs = target.receive_many([frame(0, TANK, 50), frame(2500 * MS, TANK, 10)])
    assert [(send.t_ns / SECOND, send.data[0]) for send in sends(outputs, "ALARMS")] == [(0, 0), (1, 0), (2, 0), (2.5, 1)]


def test_messages_that_form_one_monitoring_message_are_sampled_together_at_the_period() -> None:
    one = message("ONE", 0x10, [signal("Speed", 0, 8), signal("Own", 8, 8)], monitor_as="motion")
    two = message("TWO", 0x11, [signal("Speed", 0, 8), signal("Heading", 8, 8)], monitor_as="motion")
    target = supervisor([one, two], [], monitor_ns=250 * MS, start_ns=0)
    outputs = target.receive_many([frame(0, one, 3, 4), frame(100 * MS, two, 5, 6)])
    samples = [out for out in [*outputs, *target.tick(SECOND)] if isinstance(out, Monitor)]
    assert [float(sample.t) for sample in samples] == [0, 0.25, 0.5, 0.75, 1]
    assert samples[1].message == "motion" and samples[1].values == {"ONE.Speed": 3, "Own": 4, "TWO.Speed": 5, "Heading": 6}
    assert samples[1].age_s["Heading"] == 0.15 and samples[0].quality["Heading"] == "never"
    assert samples[-1].quality["Heading"] == "stale" and samples[-1].values["Heading"] is None


ANY = message("ENGINE", 0x0CF004FE, [signal("Speed", 24, 16)], extended=True, j1939=True, pgn=0xF004)


def test_a_j1939_message_belongs_to_the_first_source_until_it_falls_silent() -> None:
    target = supervisor([ANY], [alarm("Fast", compare("ENGINE.Speed", ">", 100))])
    def engine(t_ms: int, source: int, speed: int) -> Frame:
        return Frame(t_ms * MS, 0x0CF00400 | source | EXTENDED, bytes(3) + speed.to_bytes(2, "little") + bytes(3))
    first = [engine(100 * n, 0, 50) for n in range(5)] + [engine(450, 3, 200)]
    assert events(target.receive_many(first)) == []
    assert events(target.receive_many([engine(n, 3, 200) for n in (600, 800, 900)])) == [(0.8, "Fast", "raised")]


def test_remote_frames_and_strangers_are_nobodys() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    assert target.receive_many([Frame(0, 0x100 | REMOTE, b""), Frame(1, 0x100 | EXTENDED, b"\x01" * 8), Frame(2, 0x7FF, b"")]) == []
    assert target.counters["ids nobody asks for"] == 3


def test_random_identifiers_do_not_fill_the_memory() -> None:
    target = supervisor([TANK], [alarm("Low", LOW)])
    target.receive_many([Frame(n, n | EXTENDED, b"") for n in range(200_000)])
    assert len(target.board.table) <= 65_536


def test_multiplexed_signals_are_pages_of_their_own() -> None:
    box = message("BOX", 0x10, [signal("Page", 0, 8, is_multiplexer=True),
                                signal("A", 8, 8, multiplexer_signal="Page", multiplexer_ids=(0,)),
                                signal("B", 8, 8, multiplexer_signal="Page", multiplexer_ids=(1, 2))])
    target = supervisor([box], [alarm("A", compare("BOX.A", ">", 10)), alarm("B", compare("BOX.B", ">", 10), 2)])
    outcome = events(target.receive_many([frame(0, box, 0, 5), frame(1, box, 1, 50), frame(2, box, 0, 50), frame(3, box, 2, 5),
                                          frame(4, box, 7, 99)]))
    assert [(name, what) for _, name, what in outcome] == [("B", "raised"), ("A", "raised"), ("B", "cleared")]


@pytest.mark.parametrize("size", [1, 3, 1000])
def test_one_by_one_equals_in_batches(size: int) -> None:
    def run(step: int) -> list[bytes]:
        target = Supervisor(catalog([TANK], [alarm("Low", LOW, on_delay_ns=70 * MS, off_delay_ns=130 * MS),
                                             alarm("Gone", Silent("TANK", 250 * MS), 2)]), unit="u", utc_offset_ns=0)
        frames = [frame((n * 37 + (400 if n % 17 == 0 else 0)) * MS, TANK, (n * 13) % 60) for n in range(300)]
        out: list[bytes] = []
        for start in range(0, len(frames), step):
            out += [encode(output) for output in target.receive_many(frames[start:start + step]) if isinstance(output, Event)]
        return out
    assert run(size) == run(7) and len(run(size)) > 10


def test_conditions_that_feed_each_other_come_to_an_end() -> None:
    flip = Compare("==", AlarmState("Flip"), Number(Decimal(0)))
    target = supervisor([TANK], [alarm("Flip", And((flip, LOW)))])
    feed(target, (0, 10))
    assert target.counters["conditions that feed each other"] == 1


def test_an_alarm_and_its_latch_survive_a_restart() -> None:
    definitions = [alarm("Low", LOW, latch=True), alarm("Wet", compare("TANK.Pump", "==", 1), 2)]
    before = supervisor([TANK], definitions)
    feed(before, (0, 10))
    after = supervisor([TANK], definitions, boot=2, restored=before.state(), start_ns=0)
    assert after.tick(0) == [] and after.alarm_states() == {"Low": 1, "Wet": 0}
    assert feed(after, (1, 50)) == []
    outputs = after.command(Order("1", "acknowledge", "Low"), 2 * SECOND)
    assert [what for _, _, what in events(outputs)] == ["acknowledged", "cleared"]


def test_an_event_names_the_raised_it_belongs_to_also_after_a_restart() -> None:
    before = supervisor([TANK], [alarm("Low", LOW)], seq=40)
    feed(before, (0, 10))
    after = supervisor([TANK], [alarm("Low", LOW)], boot=2, restored=before.state())
    cleared = [out for out in after.receive_many([frame(0, TANK, 50)]) if isinstance(out, Event)]
    assert [(event.event, event.instance, event.seq) for event in cleared] == [("cleared", 41, 1)]




def test_a_reset_counts_for_nothing_once_the_cause_is_back() -> None:
    """Given while the off-delay ran; it must not clear the alarm an hour later."""
    repair = Repair((ExpectStep(compare("TANK.Pump", "==", 1), SECOND, "Pump"),), attempts=1)
    target = supervisor([TANK], [alarm("Low", LOW, off_delay_ns=SECOND, repair=repair)])
    levels = [(n / 10, 10 if n < 20 or 25 <= n < 40 else 50) for n in range(80)]
    feed(target, *levels[:22])
    assert target.alarm_states()["Low"] == 3
    assert target.command(Order("r", "reset", "Low", origin="local"), target.now_ns)[-1].outcome == "done"  # type: ignore[union-attr]
    assert feed(target, *levels[22:]) == [] and target.alarm_states()["Low"] == 3
