"""Blocks of frames give the outputs that single frames give, byte for byte, and leave the board in the same state."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from random import Random
from typing import Any, Literal

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dbc
from level1.block import Block
from level1.catalog import Alarm, Catalog, Repair, Signal
from level1.condition import Operator
from level1.decode import RawValue, Scale, raw_of
from level1.event import Output, Send, encode
from level1.expression import (
    AlarmState,
    And,
    Arithmetic,
    Compare,
    Count,
    Elapsed,
    ExpectStep,
    Expression,
    Number,
    Or,
    Quality,
    Rate,
    SendStep,
    SignalValue,
    Silent,
    WaitStep,
)
from level1.frame import EXTENDED, Frame, j1939_pgn
from level1.io import definitions
from level1.io.replay import Log
from level1.sieve import Sieve
from level1.supervisor import Supervisor
from level1.tests import test_condition
from level1.tests.build import COMMAND, MS, SECOND, alarm, catalog, message, signal

NOT_CAN = "candumpSample1.txt"
"""A text of NMEA 2000 messages among the recordings."""
DATA = Path(__file__).parents[2].parent / "shared" / "data"

WIDE = message("WIDE", 0x77, [
    signal("Early", 4, 12), signal("Late", 300, 20, signed=True, factor=Decimal("0.5")), signal("Far", 455, 16, big_endian=True),
    signal("Ratio", 64, 32, is_float=True, maximum=Decimal("1000.1"))], length=64, cycle_ns=20 * MS)
MUX = message("MUX", 0x18FE0021, [
    signal("Select", 0, 3, is_multiplexer=True),
    signal("Sub", 8, 4, multiplexer_signal="Select", multiplexer_ids=(1,), is_multiplexer=True),
    signal("One", 16, 8, multiplexer_signal="Select", multiplexer_ids=(1, 2)),
    signal("Two", 24, 12, multiplexer_signal="Sub", multiplexer_ids=(3, 4, 15)), signal("Plain", 3, 5)],
    extended=True, cycle_ns=20 * MS)
SAFE = message("SAFE", 0x300, [signal("Level", 0, 8), signal("Count", 8, 4, role="Counter")])
STATUS = message("STATUS", 0x201 ^ 1, [signal("Flame", 0, 1), signal("Pressure", 8, 8)], cycle_ns=20 * MS)
MESSAGES = (*test_condition.MESSAGES, WIDE, MUX, SAFE, STATUS, COMMAND)
KEYS = (0x0CF00403 | EXTENDED, 0x0CF00427 | EXTENDED, 0x123, WIDE.can_id, MUX.can_id | EXTENDED, SAFE.can_id, STATUS.can_id,
        COMMAND.can_id, 0x5AA)
SIGNALS = [(definition.name, part.name) for definition in MESSAGES for part in definition.signals]

pairs = st.sampled_from(SIGNALS)
more_values = pairs.map(lambda pair: SignalValue(*pair))
owners = st.sampled_from(MESSAGES).map(lambda definition: definition.name)
more_atoms: st.SearchStrategy[Any] = st.one_of(
    test_condition.atoms,
    st.builds(Compare, test_condition.operators, more_values, test_condition.numbers.map(Number)),
    st.builds(Compare, test_condition.operators, st.builds(Arithmetic, st.sampled_from("+-*/"), more_values, more_values),
              test_condition.numbers.map(Number)),
    st.builds(lambda pair, limit: Compare(">", Rate(*pair), Number(limit)), pairs, test_condition.numbers),
    st.builds(lambda owner, limit: Silent(owner, limit), owners, test_condition.limits),
    st.builds(lambda kind, pair, op, limit: Elapsed(kind, pair[0], pair[1], op, limit), st.sampled_from(["age", "held"]), pairs,
              st.sampled_from(["<", ">="]), test_condition.limits),
    st.builds(lambda kind, pair: Quality(kind, *pair), st.sampled_from(["error", "unavailable", "never"]), pairs),
    st.sampled_from([Quality("corrupt", "SAFE", ""), Quality("frozen", "SAFE", "")]))
feedback: st.SearchStrategy[Any] = st.one_of(
    st.builds(lambda state: Compare("==", AlarmState("A0"), Number(Decimal(state))), st.integers(0, 3)),
    st.builds(lambda number: Compare(">=", Count("A0", 100 * MS), Number(Decimal(number))), st.integers(1, 3)))
delays = st.sampled_from([0, 0, 1, 10 * MS, 20 * MS, 61 * MS])


def conditions_of(atoms: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Conditions of one or more of these parts."""
    several = st.lists(atoms, min_size=2, max_size=3)
    return st.one_of(atoms, test_condition.conditions, several.map(lambda items: And(tuple(items))),
                     several.map(lambda items: Or(tuple(items))))


def repairs(condition: Expression) -> Repair:
    """A repair that sends, waits, expects and sends again."""
    send, undo = SendStep("FLAMER_CMD", {"GasValve": 1}), SendStep("FLAMER_CMD", {"GasValve": 0})
    return Repair((send, WaitStep(15 * MS), ExpectStep(condition, 30 * MS, "it"), send), give_up=(undo,), attempts=2,
                  window_ns=500 * MS, pause_ns=10 * MS)


def alarms(name: str, conditions: st.SearchStrategy[Any]) -> st.SearchStrategy[Alarm]:
    """Alarms of every kind with such conditions."""
    return st.builds(
        lambda when, until, enabled, on, off, latch, repair: alarm(
            name, when, until=until, enabled=enabled, on_delay_ns=on, off_delay_ns=off, latch=latch, repair=repair,
            code=1 + int(name[1:])),
        conditions, st.none() | conditions, st.none() | conditions, delays, delays, st.booleans(),
        st.none() | conditions.map(repairs))


plain, mixed = conditions_of(more_atoms), conditions_of(more_atoms | feedback)
payloads = st.one_of(st.binary(min_size=8, max_size=8), st.binary(max_size=8), st.binary(min_size=9, max_size=64),
                     st.sampled_from([b"\xff" * 8, b"\xfe" * 8, b"\0" * 8, b"\x19\x03\x40\x21" + bytes(4), bytes(64)]))
steps = st.tuples(st.sampled_from([0, 0, 1, 5 * MS, 5 * MS, 20 * MS, 59 * MS, 60 * MS, 60 * MS + 1, 300 * MS, -7 * MS]),
                  st.sampled_from(KEYS), payloads, st.booleans())
traffic = st.lists(steps, min_size=1, max_size=60)


def frames_of(steps: Sequence[tuple[int, int, bytes, bool]]) -> list[Frame]:
    """Frames with these gaps; where the last number says so, the payload of the identifier's frame before."""
    now, last, frames = 1_000 * MS, dict[int, bytes](), []
    for gap, key, data, repeat in steps:
        now += gap
        last[key] = last.get(key, data) if repeat else data
        frames.append(Frame(now, key, last[key]))
    return frames


def blocks(frames: Sequence[Frame], sizes: Sequence[int]) -> Iterator[list[Frame]]:
    """The frames in pieces of these sizes, the last of them again and again."""
    place, number = 0, 0
    while place < len(frames):
        size = sizes[min(number, len(sizes) - 1)]
        yield list(frames[place:place + size])
        place, number = place + size, number + 1


def state_of(supervisor: Supervisor) -> list[Any]:
    """Everything that decides about what comes next, but the heap of deadlines."""
    board = supervisor.board
    pages = [(page.message.name, page.seen, page.data, page.t_ns, page.level, page.owner, page.others, page.presence.k,
              page.integrity.k, page.watchdog is None) for page in [*board.pages.values(), *board.branches.values()]]
    cells = [(cell.name, cell.k, cell.lo, cell.hi, *((cell.raw, cell.bad, cell.bad or cell.value) if cell.exact else ()))
             for cell in board.cells.values()]
    watches = [(watch.outcome, watch.evaluate()) for watch in supervisor.watches]
    return [pages, cells, watches, sorted(board.table), sorted(supervisor.counters.items()), supervisor.now_ns, supervisor.state()]


def compare_both(defined: Catalog, frames: Sequence[Frame], sizes: Sequence[int], **options: Any) -> None:
    """Frames one after the other and in blocks; the last in single frames again, to see that the state is the same."""
    one = Supervisor(defined, unit="u", broadcast=False, **options)
    two = Supervisor(defined, unit="u", broadcast=False, **options)
    sieve = Sieve(two, least_rows=1)
    for part in blocks(frames, sizes):
        assert outputs(sieve.receive(Block.of(part))) == outputs(one.receive_many(part))
        assert repr(state_of(two)) == repr(state_of(one))
    end = frames[-1].t_ns + 400 * MS
    assert outputs(two.tick(end)) == outputs(one.tick(end))


def outputs(some: Sequence[Output]) -> list[bytes | Send]:
    """Events and monitoring messages as the bytes they are sent as."""
    return [output if isinstance(output, Send) else encode(output) for output in some]


def drive(random: Random, count: int) -> list[Frame]:
    """Frames as a bus sends them: cyclic with jitter, payloads that change a little or not at all, now and then a silence, a
    frame too short or too long, a stamp that runs backwards, a second source."""
    frames, payloads = [], {key: random.randbytes(random.choice([8, 8, 8, 12, 64])) for key in KEYS}
    due = {key: random.randrange(20 * MS) for key in random.sample(KEYS, random.randint(2, len(KEYS)))}
    cycles = {key: random.choice([2, 5, 10, 20, 40]) * MS for key in due}
    for _ in range(count):
        key = min(due, key=due.__getitem__)
        t_ns = due[key]
        due[key] += cycles[key] + random.choice([0, 0, 1, MS, -MS]) + (random.random() < 0.02) * random.randrange(100 * MS)
        data = bytearray(payloads[key])
        if random.random() < 0.5 and data:
            place = random.randrange(len(data))
            data[place] = random.choice([data[place] ^ 1 << random.randrange(8), 0, 0xFE, 0xFF, (data[place] + 1) % 256])
            payloads[key] = bytes(data)
        if random.random() < 0.02:
            data = data[:random.randrange(9)]
        t_ns -= (random.random() < 0.01) * random.randrange(30 * MS)
        frames.append(Frame(1_000 * MS + t_ns, key, bytes(data)))
    return frames


sizes = st.lists(st.integers(1, 200), min_size=1, max_size=4)


@given(st.tuples(alarms("A0", plain), alarms("A1", plain), alarms("A2", mixed)), st.integers(0, 2**64), st.integers(50, 400), sizes,
       st.booleans())
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_blocks_of_a_drive_equal_its_single_frames(made: tuple[Alarm, ...], seed: int, count: int, sizes: list[int],
                                                   is_monitored: bool) -> None:
    compare_both(catalog(MESSAGES, made), drive(Random(seed), count), sizes, monitor_ns=25 * MS if is_monitored else None)


@given(st.tuples(alarms("A0", plain), alarms("A1", plain), alarms("A2", mixed)), traffic,
       st.lists(st.integers(1, 40), min_size=1, max_size=4), st.booleans())
@settings(max_examples=600, deadline=None, suppress_health_check=list(HealthCheck))
def test_blocks_equal_single_frames(made: tuple[Alarm, ...], steps: list[tuple[int, int, bytes, bool]], sizes: list[int],
                                    is_monitored: bool) -> None:
    compare_both(catalog(MESSAGES, made), frames_of(steps), sizes, monitor_ns=25 * MS if is_monitored else None)


def logs() -> list[Path]:
    """All recordings of CAN buses."""
    files = [path for path in DATA.rglob("*") if path.suffix in (".log", ".txt", ".asc", ".trc", ".csv") and path.is_file()]
    return sorted(path for path in files if not {"gpsd-nmea0183", "isobus-snippets"} & set(path.parts) and path.name != NOT_CAN)


@pytest.fixture(scope="module")
def shipped() -> Catalog:
    """All definitions that are shipped."""
    return definitions.load(sorted(file.name for file in Path(dbc.__file__).parent.glob("*.dbc")))


def recorded(path: Path) -> list[Frame]:
    """The frames of a recording."""
    return list(Log(path, one_bus=True).frames())


@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not on this machine")
@pytest.mark.parametrize("path", logs(), ids=lambda path: path.name)
def test_blocks_of_a_recording_equal_its_single_frames(path: Path, shipped: Catalog) -> None:
    compare_both(shipped, recorded(path), [4000, 64, 20_000])


@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not on this machine")
@pytest.mark.parametrize("path", [path for path in logs() if "5055e" in str(path)], ids=lambda path: path.name)
def test_alarms_at_limits_that_a_recording_crosses(path: Path, shipped: Catalog) -> None:
    frames, random = recorded(path), Random(path.name)
    made = {}
    for number in range(60):
        name = f"A{number}"
        until = random.choice([None, crossed(random, shipped, frames)])
        made[name] = alarm(name, crossed(random, shipped, frames), until=until, on_delay_ns=random.choice([0, 100 * MS, SECOND]),
                           off_delay_ns=random.choice([0, 30 * MS]), code=number + 1)
    sender = message("ALARMS", 0x650, [signal(name, 0, 2) for name in made], senders=("UCS",), cycle_ns=SECOND)
    defined = msgspec.structs.replace(shipped, messages={**shipped.messages, "ALARMS": sender}, alarms=made, commands={})
    compare_both(defined, frames, [3000, 100, 5000])


def crossed(random: Random, defined: Catalog, frames: Sequence[Frame]) -> Expression:
    """A condition on signals of the tractor's bus, with limits near values that the recording holds."""
    by_group = {message.pgn: message for message in defined.messages.values() if message.j1939}
    parts: list[Expression] = []
    while len(parts) < random.choice([1, 1, 2, 3]):
        frame = random.choice(frames)
        found = by_group.get(j1939_pgn(frame.can_id))
        if found is None or not found.signals:
            cyclic = [name for name, one in defined.messages.items() if one.cycle_ns]
            parts.append(Silent(random.choice(cyclic), random.randrange(1, 1000) * MS))
            continue
        part = random.choice(found.signals)
        raw = raw_of(part, frame.data)
        if raw is not None and not part.multiplexer_ids:
            parts.append(near(random, found.name, part, raw, random.choice(found.signals).name))
    if len(parts) == 1:
        return parts[0]
    return And(tuple(parts)) if random.random() < 0.5 else Or(tuple(parts))


def near(random: Random, owner: str, part: Signal, raw: RawValue, other: str) -> Expression:
    """A condition on a signal with a limit at this raw value."""
    value, limit = SignalValue(owner, part.name), Number(Decimal(str(Scale(part).physical(raw))))
    arithmetic: list[Literal["+", "-", "*", "/"]] = ["+", "-", "*", "/"]
    operators: list[Operator] = ["<", ">=", "==", "!="]
    qualities: list[Literal["error", "unavailable"]] = ["error", "unavailable"]
    op = random.choice(operators)
    parts: list[Expression] = [
        Compare(op, value, limit), Compare(op, value, limit), Quality(random.choice(qualities), owner, part.name),
        Compare(op, Arithmetic(random.choice(arithmetic), value, SignalValue(owner, other)), limit),
        Elapsed("held", owner, part.name, ">=", random.randrange(1000) * MS)]
    return random.choice(parts)
