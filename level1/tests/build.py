"""Small catalogs for the tests of the core, built by hand: these tests must not depend on the reading of DBC files."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import Any

from level1.catalog import Alarm, Catalog, Message, Repair, Signal
from level1.condition import Operator
from level1.event import Event, Output, Send
from level1.expression import And, Compare, ExpectStep, Expression, Number, SendStep, SignalValue, WaitStep
from level1.frame import Frame, frame_key
from level1.supervisor import Supervisor

MS = 1_000_000
SECOND = 1_000_000_000
ON_OFF = {0: "Off", 1: "On"}
CLOSED_OPEN = {0: "Closed", 1: "Open"}


def signal(name: str, start: int, length: int, **more: Any) -> Signal:
    """An unsigned Intel signal of factor 1, unless told otherwise."""
    defaults: dict[str, Any] = {"big_endian": False, "signed": False, "is_float": False, "factor": Decimal(1), "offset": Decimal(0)}
    return Signal(name, start, length, **(defaults | more))


def message(name: str, can_id: int, signals: Iterable[Signal], **more: Any) -> Message:
    """An 8-byte message with a cycle of 100 ms, unless told otherwise."""
    defaults: dict[str, Any] = {"extended": False, "length": 8, "cycle_ns": 100 * MS, "senders": ("NODE",)}
    return Message(name, can_id, signals=tuple(signals), **(defaults | more))


def compare(name: str, op: Operator, value: float | str | Decimal) -> Expression:
    """`Message.Signal op value`."""
    owner, _, what = name.partition(".")
    return Compare(op, SignalValue(owner, what), Number(Decimal(str(value))))


def catalog(messages: Sequence[Message], alarms: Sequence[Alarm]) -> Catalog:
    """A catalog on one bus; the alarm message is added."""
    sender = message("ALARMS", 0x650, [signal(alarm.name, 2 * n, 2) for n, alarm in enumerate(alarms)], senders=("UCS",),
                     cycle_ns=SECOND, length=8)
    return Catalog(("test.dbc",), {m.name: m for m in (*messages, sender)}, {alarm.name: alarm for alarm in alarms})


def alarm(name: str, when: Expression, code: int = 1, priority: str = "High", **more: Any) -> Alarm:
    """An alarm without delays, unless told otherwise."""
    return Alarm(name, "ALARMS", code, priority, when, **more)


STATUS = message("FLAMER_STATUS", 0x200, [signal("Flaming", 0, 1, choices=ON_OFF), signal("PilotFlame", 1, 1, choices=ON_OFF),
                                          signal("GasValve", 2, 1, choices=CLOSED_OPEN)])
COMMAND = message("FLAMER_CMD", 0x201, [signal("GasValve", 0, 1, choices=CLOSED_OPEN), signal("Igniter", 1, 1, choices=ON_OFF),
                                        signal("Burner", 8, 8)], senders=("UCS", "MISSION"))
PURGE_NS = 30 * SECOND
CLOSE = SendStep("FLAMER_CMD", {"GasValve": 0, "Igniter": 0})
RELIGHT = Repair(
    (CLOSE, WaitStep(PURGE_NS), ExpectStep(compare("FLAMER_STATUS.PilotFlame", "==", 0), SECOND, "PilotFlame == Off"),
     SendStep("FLAMER_CMD", {"GasValve": 1, "Igniter": 1}),
     ExpectStep(compare("FLAMER_STATUS.PilotFlame", "==", 1), 3 * SECOND, "PilotFlame == On"),
     SendStep("FLAMER_CMD", {"GasValve": 1, "Igniter": 0})),
    give_up=(CLOSE,), attempts=3, window_ns=900 * SECOND)


def pilot_flame_out(**more: Any) -> Alarm:
    """The re-ignition of DESIGN §3 and §5."""
    when = And((compare("FLAMER_STATUS.Flaming", "==", 1), compare("FLAMER_STATUS.PilotFlame", "==", 0)))
    defaults: dict[str, Any] = {"on_delay_ns": 300 * MS, "repair": RELIGHT}
    return alarm("PilotFlameOut", when, 3101, **(defaults | more))


def status(t_ns: int, flaming: int = 1, flame: int = 1, gas: int = 1) -> Frame:
    """A status frame of the flaming tool."""
    return Frame(t_ns, frame_key(STATUS.can_id, False), bytes([flaming | flame << 1 | gas << 2, 0, 0, 0, 0, 0, 0, 0]))


def frame(t_ns: int, definition: Message, *payload: int) -> Frame:
    """A frame of a message, padded with zeros to its length."""
    return Frame(t_ns, frame_key(definition.can_id, definition.extended), bytes(payload).ljust(definition.length, b"\0"))


def events(outputs: Iterable[Output]) -> list[tuple[float, str, str]]:
    """The events among outputs as (seconds, alarm, event)."""
    return [(float(output.t), output.alarm, output.event) for output in outputs if isinstance(output, Event)]


def sends(outputs: Iterable[Output], name: str) -> list[Send]:
    """The frames of one message among outputs."""
    return [output for output in outputs if isinstance(output, Send) and output.message == name]


def supervisor(messages: Sequence[Message], alarms: Sequence[Alarm], **more: Any) -> Supervisor:
    """A supervisor that sends no alarm messages, unless told otherwise."""
    defaults: dict[str, Any] = {"unit": "test", "broadcast": False}
    return Supervisor(catalog(messages, alarms), **(defaults | more))
