"""Alarms and their repairs: from the attributes of a signal to an `Alarm`, and what is doubtful about all of them together."""
from __future__ import annotations

from collections.abc import Iterable

from level1 import check, resolver
from level1.catalog import Alarm, Message, Repair, Signal
from level1.check import Doubt
from level1.definitions.attributes import ATTRIBUTES, Place
from level1.expression import Expression, Step
from level1.resolver import Scope

MS, S = 1_000_000, 1_000_000_000
MAX_CODE = 65_535
"""Largest identification code (DESIGN §3)."""
DEFAULT_PRIORITY = "Medium"
"""Priority of an alarm that gives none."""
ALARM_BITS = 2
"""Bits an alarm's signal needs for its four states (DESIGN §3)."""

AlarmPlace = tuple[Message, Signal, Place]
"""A signal that is an alarm, its message, and where it stands."""


def alarm_places(places: Iterable[AlarmPlace]) -> list[AlarmPlace]:
    """Those of some signals that are alarms: with a code or a condition of their own."""
    first: dict[str, Place] = {}
    result: list[AlarmPlace] = []
    for message, signal, place in places:
        if not place.given("AlarmCode") and not place.given("AlarmWhen"):
            _check_lonely(place)
            continue
        result.append((message, signal, place))
        other = first.setdefault(signal.name, place)
        if other is not place:
            place.note("", f"alarm name is used twice, first in {other.path}:{other.line}", "names of alarms must differ")
    return result


def _check_lonely(place: Place) -> None:
    lonely = [name for name, value in place.attributes.items()
              if value.explicit and name in ATTRIBUTES and name.startswith(("Alarm", "Repair"))]
    if lonely:
        place.note(lonely[0], "is set, but the signal is no alarm", "give it AlarmCode and AlarmWhen", "warning")


def _alarm(message: Message, signal: Signal, place: Place, scope: Scope) -> Alarm | None:
    _check_alarm_signal(message, signal, place)
    if not place.given("AlarmCode"):
        place.note("AlarmCode", "the alarm has no code", f"choose one from 1 to {MAX_CODE} that no other alarm has")
    if not place.text("AlarmWhen"):
        place.note("AlarmWhen", "the alarm has no condition", "say when it is raised")
    when = _condition("AlarmWhen", place, scope)
    until = _condition("AlarmUntil", place, scope)
    enabled = _condition("AlarmEnabledWhen", place, scope)
    spn = place.number("AlarmSpn", -1, 0, resolver.MAX_SPN) if place.given("AlarmSpn") else -1
    fmi = place.number("AlarmFmi", -1, 0, resolver.MAX_FMI) if place.given("AlarmFmi") else -1
    numbers = _numbers(place)
    repair = _repair(place, scope)
    if place.given("AlarmSpn") != place.given("AlarmFmi"):
        place.note("AlarmSpn" if place.given("AlarmSpn") else "AlarmFmi", "a trouble code needs both AlarmSpn and AlarmFmi",
                   "give the other one as well", "warning")
    if when is None:
        return None
    return Alarm(
        name=signal.name, message=message.name, code=numbers["AlarmCode"],
        priority=place.word("AlarmPriority", DEFAULT_PRIORITY), when=when, until=until, enabled=enabled,
        when_text=place.text("AlarmWhen"), until_text=place.text("AlarmUntil"), enabled_text=place.text("AlarmEnabledWhen"),
        on_delay_ns=numbers["AlarmOnDelay"] * MS, off_delay_ns=numbers["AlarmOffDelay"] * MS,
        latch=place.word("AlarmLatch", "No") != "No", local_latch=place.word("AlarmLatch", "No") == "Local",
        cause=place.text("AlarmCause"),
        consequence=place.text("AlarmConsequence"), action=place.text("AlarmAction"), comment=signal.comment,
        spn=spn if spn >= 0 else None, fmi=fmi if fmi >= 0 else None, repair=repair, file=place.path, line=place.line)


def _numbers(place: Place) -> dict[str, int]:
    day_ms = 86_400_000
    return {"AlarmCode": place.number("AlarmCode", 0, 1, MAX_CODE),
            "AlarmOnDelay": place.number("AlarmOnDelay", 0, 0, day_ms),
            "AlarmOffDelay": place.number("AlarmOffDelay", 0, 0, day_ms)}


def _check_alarm_signal(message: Message, signal: Signal, place: Place) -> None:
    if not message.sent_by_ucs:
        senders = " and ".join(message.senders) or "nobody"
        place.note("", f"an alarm belongs into a message that UCS sends; {message.name} is sent by {senders}",
                   f"write `BO_ … {message.name}: {message.length} UCS`")
    if signal.length < ALARM_BITS or signal.is_float or signal.factor != 1 or signal.offset != 0:
        place.note("", "an alarm's signal holds the states 0 to 3", f"{ALARM_BITS} bits, (1,0)")
    if signal.multiplexer_ids is not None:
        place.note("", "an alarm's signal can't be multiplexed", "give it bits of its own")


def _condition(attribute: str, place: Place, scope: Scope) -> Expression | None:
    text = place.text(attribute)
    if not text:
        return None
    node, findings = resolver.resolve_condition(text, scope)
    place.take(attribute, text, findings)
    return node


def _repair(place: Place, scope: Scope) -> Repair | None:
    steps = _steps("Repair", place, scope)
    give_up = _steps("RepairGiveUp", place, scope)
    day_s = 86_400
    attempts = place.number("RepairAttempts", 1, 1, 1000)
    window = place.number("RepairWindow", 3600, 1, 30 * day_s)
    pause = place.number("RepairPause", 0, 0, day_s * 1000)
    moves, reset = place.word("RepairMoves", "Yes"), place.word("RepairReset", "Local")
    if not place.text("Repair"):
        for name in ("RepairAttempts", "RepairWindow", "RepairPause", "RepairGiveUp"):
            if place.given(name):
                place.note(name, "is set, but there is no Repair", "give it steps or remove this", "warning")
        return None
    return Repair(steps=steps, give_up=give_up, attempts=attempts, window_ns=window * S, pause_ns=pause * MS,
                  moves=moves == "Yes", local_reset=reset == "Local", text=place.text("Repair"),
                  safe_between=place.word("RepairBetween", "SafeState") == "SafeState",
                  counts_good=place.word("RepairCounts", "All") == "All",
                  give_up_text=place.text("RepairGiveUp"))


def _steps(attribute: str, place: Place, scope: Scope) -> tuple[Step, ...]:
    text = place.text(attribute)
    if not text:
        return ()
    steps, findings = resolver.resolve_steps(text, scope)
    place.take(attribute, text, findings)
    return steps


def alarms_at(places: Iterable[AlarmPlace], scope: Scope) -> list[Alarm]:
    """The alarms, as far as their conditions can be resolved."""
    found = [(alarm, place) for message, signal, place in places if (alarm := _alarm(message, signal, place, scope))]
    _check_codes(places)
    for alarm, place in found:
        _take_doubts(check.doubts(alarm, scope.messages), place)
    places_by_name = {alarm.name: place for alarm, place in found}
    for alarm, doubt in check.ageless((alarm for alarm, _ in found), scope.messages):
        _take_doubts((doubt,), places_by_name[alarm.name])
    for alarm, circle in check.circles(alarm for alarm, _ in found):
        places_by_name[alarm.name].note("AlarmWhen", f"it depends on its own state: {' -> '.join(circle)}",
                                        "take one of the states out of it")
    return [alarm for alarm, _ in found]


def _check_codes(alarms: Iterable[AlarmPlace]) -> None:
    first: dict[object, Place] = {}
    for _, _, place in alarms:
        if not place.given("AlarmCode"):
            continue
        code = place.attributes["AlarmCode"].value
        other = first.setdefault(code, place)
        if other is not place:
            place.note("AlarmCode", f"code {code} is used twice, first by {other.owner[1]} in {other.path}:{other.line}",
                       "each alarm needs its own")


def _take_doubts(doubts: Iterable[Doubt], place: Place) -> None:
    """What is doubtful in an alarm as a whole; nothing of an attribute in which an error is known already."""
    for doubt in doubts:
        if not place.is_wrong(doubt.attribute):
            place.note(doubt.attribute, doubt.message, doubt.hint, doubt.severity, text=place.text(doubt.attribute))
