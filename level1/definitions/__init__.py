"""From the texts of DBC files to a `Catalog`: alarms, repairs, commands, monitoring messages, and everything wrong with them.

Pure: `level1.io.definitions` reads the files and runs this in a child of its own. The steps, each a module: index and measure
the text (`level1.dbc_text`), parse (`dbc_file`), language (`level1.language`), names and types (`level1.resolver`), and this
one, which reads the attributes of DESIGN §3 and puts the catalog together.
"""
from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from level1 import check, resolver, similar
from level1.catalog import Alarm, Catalog, Command, Message, Problem, Repair, Signal
from level1.decode import first_bit
from level1.definitions import dbc_file
from level1.definitions.dbc_file import Attribute, DbcFile
from level1.event import PRIORITIES
from level1.expression import Expression, Step
from level1.frame import frame_key
from level1.protection import CHECKSUMS
from level1.resolver import Finding, Scope

MS, S = 1_000_000, 1_000_000_000
MAX_CODE = 65_535
"""Largest identification code (DESIGN §3)."""
DEFAULT_PRIORITY = "Medium"
"""Priority of an alarm that gives none."""
ALARM_BITS = 2
"""Bits an alarm's signal needs for its four states (DESIGN §3)."""
OWN_COMMANDS = ("acknowledge", "reset")
"""Commands the core itself answers; a DBC can't define them."""
_TOPIC_LEVEL = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
"""A name that can be a level of an MQTT topic (DESIGN §6)."""
MAX_FINDINGS = 10
"""Mistakes told of one text."""


@dataclass(frozen=True, slots=True)
class Source:
    """A DBC file: the path that problems name, and its text."""

    path: str
    text: str


@dataclass(frozen=True, slots=True)
class AttributeSpec:
    """An attribute of the alarm language: object it belongs to, types a definition may give it, words of an enumeration."""

    kind: str
    types: tuple[str, ...]
    words: tuple[str, ...] = ()


_TEXT = AttributeSpec("SG_", ("STRING",))
_COUNT = AttributeSpec("SG_", ("INT", "HEX", "FLOAT"))

ATTRIBUTES: Mapping[str, AttributeSpec] = {
    "AlarmCode": _COUNT,
    "AlarmPriority": AttributeSpec("SG_", ("ENUM",), PRIORITIES),
    "AlarmWhen": _TEXT,
    "AlarmUntil": _TEXT,
    "AlarmEnabledWhen": _TEXT,
    "AlarmOnDelay": _COUNT,
    "AlarmOffDelay": _COUNT,
    "AlarmLatch": AttributeSpec("SG_", ("ENUM",), ("No", "Yes")),
    "AlarmCause": _TEXT,
    "AlarmConsequence": _TEXT,
    "AlarmAction": _TEXT,
    "AlarmSpn": _COUNT,
    "AlarmFmi": _COUNT,
    "Repair": _TEXT,
    "RepairAttempts": _COUNT,
    "RepairWindow": _COUNT,
    "RepairPause": _COUNT,
    "RepairGiveUp": _TEXT,
    "RepairMoves": AttributeSpec("SG_", ("ENUM",), ("No", "Yes")),
    "RepairReset": AttributeSpec("SG_", ("ENUM",), ("Local", "FromAbove")),
    "RepairBetween": AttributeSpec("SG_", ("ENUM",), ("SafeState", "AsCommanded")),
    "Role": AttributeSpec("SG_", ("ENUM",), ("None", "Counter", "Checksum")),
    "ChecksumType": AttributeSpec("SG_", ("ENUM",), tuple(CHECKSUMS)),
    "MonitorAs": AttributeSpec("BO_", ("STRING",)),
    "Commands": AttributeSpec("BO_", ("STRING",)),
}
"""Every attribute of the alarm language (DESIGN §3), besides Vector's own."""
_KINDS = {"SG_": "signals", "BO_": "messages"}


class Assembly(NamedTuple):
    """What files give together. messages, alarms: how many there are, those with errors included."""

    catalog: Catalog | None
    problems: tuple[Problem, ...]
    messages: int
    alarms: int


def build(sources: Sequence[Source],
          bindings: Mapping[str, Sequence[int]] | None = None) -> tuple[Catalog | None, tuple[Problem, ...]]:
    """The catalog of some DBC files, None when anything in them is an error; and every error and warning of all of them.

    bindings: path of a source -> indexes of the buses it is bound to; messages of other sources are bound to none in
    particular and don't appear in `Catalog.buses`.
    """
    assembly = assemble([read(source) for source in sources], bindings)
    return assembly.catalog, assembly.problems


def decode(data: bytes) -> str:
    """The text of a file: UTF-8, else cp1252, which Vector's tools write, or UTF-16 where it says so; no byte makes it fail."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def read(source: Source) -> DbcFile:
    """One file, parsed; `assemble` takes it."""
    return dbc_file.read(source.path, source.text)


def assemble(files: Sequence[DbcFile], bindings: Mapping[str, Sequence[int]] | None = None) -> Assembly:
    """What `build` gives, of files already read."""
    builder = _Builder(files, bindings or {})
    catalog = builder.catalog()
    order = {file.path: index for index, file in enumerate(files)}
    problems = tuple(sorted(builder.problems, key=lambda p: (order[p.file], p.line, p.where, p.attribute, p.column)))
    usable = not any(problem.severity == "error" for problem in problems)
    return Assembly(catalog if usable else None, problems, len(catalog.messages), builder.alarm_count)


class _Place:
    """Where an attribute stands: makes its problems."""

    def __init__(self, file: DbcFile, owner: dbc_file.Owner, problems: list[Problem]):
        self._file = file
        self.owner = owner
        self._problems = problems

    @property
    def attributes(self) -> Mapping[str, Attribute]:
        """The attributes of this message or signal."""
        return self._file.attributes.get(self.owner, {})

    @property
    def line(self) -> int:
        """Where the message or signal stands."""
        return self._file.lines.get(self.owner, 0)

    @property
    def path(self) -> str:
        """The file it stands in."""
        return self._file.path

    def note(self, attribute: str, message: str, hint: str = "", severity: str = "error", column: int = 0,
             text: str = "") -> None:
        """Adds a problem."""
        given = self.attributes.get(attribute)
        line = given.line if given and given.line else self.line
        where = ".".join(part for part in self.owner if part)
        self._problems.append(Problem(self._file.path, line, where, attribute, column, severity, message, hint, text))

    def take(self, attribute: str, text: str, findings: Sequence[Finding]) -> None:
        """Adds what was found in an attribute's text, errors first where there is too much."""
        found = list(findings)
        for finding in sorted(found, key=lambda f: f.severity)[:MAX_FINDINGS]:
            self.note(attribute, finding.message, finding.hint, finding.severity, finding.column, text)
        if len(found) > MAX_FINDINGS:
            self.note(attribute, f"and {len(found) - MAX_FINDINGS} more", "put these right first", found[-1].severity)

    def text(self, name: str) -> str:
        """A STRING attribute on one line, "" when it isn't set."""
        value = self.attributes.get(name)
        return "".join(" " if character in "\r\n\t" else character for character in str(value.value)) if value else ""

    def word(self, name: str, default: str) -> str:
        """An ENUM attribute."""
        value = self.attributes.get(name)
        words = ATTRIBUTES[name].words
        if value is None or value.value in words:
            return str(value.value) if value else default
        if value.value != "":
            self.note(name, f"`{value.value}` is none of {', '.join(words)}", similar.hint(str(value.value), words))
        return default

    def number(self, name: str, default: int, low: int, high: int) -> int:
        """An INT attribute, within its limits."""
        value = self.attributes.get(name)
        if value is None:
            return default
        if not isinstance(value.value, int | float) or not low <= value.value <= high or value.value != int(value.value):
            if value.explicit:
                self.note(name, f"{value.value} is not possible", f"whole numbers from {low} to {high}")
            return default
        return int(value.value)

    def given(self, name: str) -> bool:
        """Whether it is set here and differs from the file's default."""
        value = self.attributes.get(name)
        return value is not None and value.explicit


class _Builder:
    """Puts the files together."""

    def __init__(self, files: Sequence[DbcFile], bindings: Mapping[str, Sequence[int]]):
        self._files = files
        self._bindings = bindings
        self.problems: list[Problem] = [problem for file in files for problem in file.problems]
        self.alarm_count = 0

    def catalog(self) -> Catalog:
        """The catalog, as far as it could be built."""
        for file in self._files:
            self._check_definitions(file)
            self._check_objects(file)
        messages = self._messages()
        self._check_ids(messages)
        places = [(message, signal, self._place(file, message, signal)) for file, message in messages
                  for signal in message.signals]
        alarm_places = self._alarm_places(places)
        self.alarm_count = len(alarm_places)
        scope = Scope((message for _, message in messages), {signal.name: message.name for message, signal, _ in alarm_places})
        alarms = [alarm for message, signal, place in alarm_places if (alarm := self._alarm(message, signal, place, scope))]
        self._check_codes(alarm_places)
        for alarm in alarms:
            self._take_doubts(alarm, scope.messages)
        for alarm, circle in check.circles(alarms):
            self._place_of(alarm).note("AlarmWhen", f"it depends on its own state: {' -> '.join(circle)}",
                                       "take one of the states out of it")
        return Catalog(
            files=tuple(file.path for file in self._files),
            messages={message.name: message for _, message in messages},
            alarms={alarm.name: alarm for alarm in alarms},
            commands=self._commands(messages, scope),
            buses={message.name: tuple(self._bindings[file.path]) for file, message in messages
                   if file.path in self._bindings})

    def _place(self, file: DbcFile, message: Message, signal: Signal | None = None) -> _Place:
        return _Place(file, (message.name, signal.name if signal else ""), self.problems)

    # -- definitions and messages -------------------------------------------------------------------------------------

    def _check_definitions(self, file: DbcFile) -> None:
        used = {attribute.name for attribute in file.text.attributes}
        for name, definition in file.text.definitions.items():
            spec = ATTRIBUTES.get(name)
            if spec and name in used and (definition.kind != spec.kind or definition.type not in spec.types):
                self._definition_problem(file, definition.line, name, spec)
            elif not spec and name.startswith(("Alarm", "Repair")) and (near := similar.closest(name, ATTRIBUTES)):
                self.problems.append(Problem(file.path, definition.line, "", "", 0, "warning",
                                             f'attribute "{name}" means nothing here', f"did you mean `{near}`?"))

    def _check_objects(self, file: DbcFile) -> None:
        """Attributes of the alarm language that cantools would pass over in silence: on nothing, on a wrong object, twice."""
        signals = {str(message.id): (message.name, {signal.name for signal in message.signals}) for message in file.text.messages}
        lines: dict[tuple[str, str, str], int] = {}
        for given in file.text.attributes:
            spec = ATTRIBUTES.get(given.name)
            if spec is None:
                continue
            message, names = signals.get(given.object, (given.object, set()))
            where = ".".join(part for part in (message, given.signal) if part)
            first = lines.setdefault((given.name, given.object, given.signal), given.line)
            if given.kind != spec.kind:
                problem = "error", f"belongs to {_KINDS[spec.kind]}", f"write {spec.kind}, an identifier" + " and a signal" * (
                    spec.kind == "SG_")
            elif given.object not in signals:
                problem = "error", f"there is no message with the identifier {given.object}", similar.hint(given.object, signals)
            elif given.kind == "SG_" and given.signal not in names:
                problem = "error", f"message {message} has no signal `{given.signal}`", similar.hint(given.signal, names)
            elif first != given.line:
                problem = "warning", f"is set twice, first in line {first}: the last one counts", "remove one of them"
            else:
                continue
            severity, text, hint = problem
            self.problems.append(Problem(file.path, given.line, where, given.name, 0, severity, text, hint))

    def _definition_problem(self, file: DbcFile, line: int, name: str, spec: AttributeSpec) -> None:
        words = " " + ",".join(f'"{word}"' for word in spec.words) if spec.words else ""
        text = f"{name} belongs to {_KINDS[spec.kind]} and is {spec.types[0]}"
        self.problems.append(Problem(file.path, line, "", "", 0, "error", text,
                                     f'write `BA_DEF_ {spec.kind} "{name}" {spec.types[0]}{words} ;`'))

    def _messages(self) -> list[tuple[DbcFile, Message]]:
        """All messages with their attributes, each name once."""
        result: dict[str, tuple[DbcFile, Message]] = {}
        for file in self._files:
            for message in file.messages:
                if message.name in result:
                    first = result[message.name][1]
                    self._place(file, message).note("", f"message name is used twice, first in {first.file}:{first.line}",
                                                    "names must differ over all files")
                else:
                    result[message.name] = file, self._with_attributes(file, message)
        return list(result.values())

    def _with_attributes(self, file: DbcFile, message: Message) -> Message:
        signals = tuple(self._with_role(signal, self._place(file, message, signal)) for signal in message.signals)
        for role in ("Counter", "Checksum"):
            bearers = [signal for signal in signals if signal.role == role]
            for signal in bearers[1:]:
                self._place(file, message, signal).note("Role", f"{message.name} has a {role.lower()} already: {bearers[0].name}",
                                                        "a message has one of each at the most")
        monitor_as = self._place(file, message).text("MonitorAs")
        if monitor_as and not _TOPIC_LEVEL.fullmatch(monitor_as):
            self._place(file, message).note("MonitorAs", f"`{monitor_as}` can't be the name of a monitoring message",
                                            "letters, digits, - and _, beginning with a letter")
        return msgspec.structs.replace(message, signals=signals, monitor_as=monitor_as)

    def _with_role(self, signal: Signal, place: _Place) -> Signal:
        if not place.given("Role"):
            return signal
        role, checksum = place.word("Role", "None"), place.word("ChecksumType", next(iter(CHECKSUMS)))
        whole = signal.factor == 1 and signal.offset == 0 and not signal.signed and not signal.is_float
        if role != "None" and (not whole or signal.multiplexer_ids is not None):
            place.note("Role", f"a {role.lower()} is an unsigned whole number that is in every frame",
                       "factor 1, offset 0, not multiplexed")
            return signal
        if role == "Checksum" and (signal.length != 8 or first_bit(signal) % 8):
            place.note("Role", "a checksum takes one whole byte", "8 bits, beginning at a byte boundary")
            return signal
        return msgspec.structs.replace(signal, role=role, checksum=checksum)

    def _check_ids(self, messages: Iterable[tuple[DbcFile, Message]]) -> None:
        seen: dict[object, Message] = {}
        for file, message in messages:
            for bus in self._bindings.get(file.path, (0,)):
                if message.j1939:
                    key: object = bus, message.pgn, message.source
                    what = f"PGN {message.pgn} from " + ("any source" if message.source is None else f"source {message.source}")
                else:
                    key = frame_key(message.can_id, message.extended, bus)
                    what = f"identifier 0x{message.can_id:X}"
                first = seen.setdefault(key, message)
                if first is not message:
                    self._place(file, message).note("", f"{what} is used twice, first by {first.name} in {first.file}:{first.line}",
                                                    "one of them must go, or the files belong to different buses")
                    break

    # -- alarms -------------------------------------------------------------------------------------------------------

    def _alarm_places(self, places: Iterable[tuple[Message, Signal, _Place]]) -> list[tuple[Message, Signal, _Place]]:
        first: dict[str, _Place] = {}
        result: list[tuple[Message, Signal, _Place]] = []
        for message, signal, place in places:
            if not place.given("AlarmCode") and not place.given("AlarmWhen"):
                self._check_lonely(place)
                continue
            result.append((message, signal, place))
            other = first.setdefault(signal.name, place)
            if other is not place:
                place.note("", f"alarm name is used twice, first in {other.path}:{other.line}", "names of alarms must differ")
        return result

    def _check_lonely(self, place: _Place) -> None:
        lonely = [name for name, value in place.attributes.items()
                  if value.explicit and name in ATTRIBUTES and name.startswith(("Alarm", "Repair"))]
        if lonely:
            place.note(lonely[0], "is set, but the signal is no alarm", "give it AlarmCode and AlarmWhen", "warning")

    def _alarm(self, message: Message, signal: Signal, place: _Place, scope: Scope) -> Alarm | None:
        self._check_alarm_signal(message, signal, place)
        if not place.given("AlarmCode"):
            place.note("AlarmCode", "the alarm has no code", f"choose one from 1 to {MAX_CODE} that no other alarm has")
        if not place.text("AlarmWhen"):
            place.note("AlarmWhen", "the alarm has no condition", "say when it is raised")
        when = self._condition("AlarmWhen", place, scope)
        until = self._condition("AlarmUntil", place, scope)
        enabled = self._condition("AlarmEnabledWhen", place, scope)
        spn = place.number("AlarmSpn", -1, 0, resolver.MAX_SPN) if place.given("AlarmSpn") else -1
        fmi = place.number("AlarmFmi", -1, 0, resolver.MAX_FMI) if place.given("AlarmFmi") else -1
        numbers = self._numbers(place)
        repair = self._repair(place, scope)
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
            latch=place.word("AlarmLatch", "No") == "Yes", cause=place.text("AlarmCause"),
            consequence=place.text("AlarmConsequence"), action=place.text("AlarmAction"), comment=signal.comment,
            spn=spn if spn >= 0 else None, fmi=fmi if fmi >= 0 else None, repair=repair, file=place.path, line=place.line)

    def _numbers(self, place: _Place) -> dict[str, int]:
        day_ms = 86_400_000
        return {"AlarmCode": place.number("AlarmCode", 0, 1, MAX_CODE),
                "AlarmOnDelay": place.number("AlarmOnDelay", 0, 0, day_ms),
                "AlarmOffDelay": place.number("AlarmOffDelay", 0, 0, day_ms)}

    def _check_alarm_signal(self, message: Message, signal: Signal, place: _Place) -> None:
        if not message.sent_by_ucs:
            senders = " and ".join(message.senders) or "nobody"
            place.note("", f"an alarm belongs into a message that UCS sends; {message.name} is sent by {senders}",
                       f"write `BO_ … {message.name}: {message.length} UCS`")
        if signal.length < ALARM_BITS or signal.is_float or signal.factor != 1 or signal.offset != 0:
            place.note("", "an alarm's signal holds the states 0 to 3", f"{ALARM_BITS} bits, (1,0)")
        if signal.multiplexer_ids is not None:
            place.note("", "an alarm's signal can't be multiplexed", "give it bits of its own")

    def _condition(self, attribute: str, place: _Place, scope: Scope) -> Expression | None:
        text = place.text(attribute)
        if not text:
            return None
        node, findings = resolver.resolve_condition(text, scope)
        place.take(attribute, text, findings)
        return node

    def _repair(self, place: _Place, scope: Scope) -> Repair | None:
        steps = self._steps("Repair", place, scope)
        give_up = self._steps("RepairGiveUp", place, scope)
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
                      give_up_text=place.text("RepairGiveUp"))

    def _steps(self, attribute: str, place: _Place, scope: Scope) -> tuple[Step, ...]:
        text = place.text(attribute)
        if not text:
            return ()
        steps, findings = resolver.resolve_steps(text, scope)
        place.take(attribute, text, findings)
        return steps

    def _check_codes(self, alarms: Iterable[tuple[Message, Signal, _Place]]) -> None:
        first: dict[object, _Place] = {}
        for _, _, place in alarms:
            if not place.given("AlarmCode"):
                continue
            code = place.attributes["AlarmCode"].value
            other = first.setdefault(code, place)
            if other is not place:
                place.note("AlarmCode", f"code {code} is used twice, first by {other.owner[1]} in {other.path}:{other.line}",
                           "each alarm needs its own")

    def _take_doubts(self, alarm: Alarm, messages: Mapping[str, Message]) -> None:
        """What is doubtful in an alarm as a whole; nothing of an attribute in which an error is known already."""
        place = self._place_of(alarm)
        where = ".".join(place.owner)
        wrong = {(p.file, p.where, p.attribute) for p in self.problems if p.severity == "error"}
        for doubt in check.doubts(alarm, messages):
            if (alarm.file, where, doubt.attribute) not in wrong:
                place.note(doubt.attribute, doubt.message, doubt.hint, doubt.severity, text=place.text(doubt.attribute))

    def _place_of(self, alarm: Alarm) -> _Place:
        file = next(file for file in self._files if file.path == alarm.file)
        return _Place(file, (alarm.message, alarm.name), self.problems)

    # -- commands -----------------------------------------------------------------------------------------------------

    def _commands(self, messages: Iterable[tuple[DbcFile, Message]], scope: Scope) -> dict[str, Command]:
        result: dict[str, Command] = {}
        for file, message in messages:
            place = self._place(file, message)
            for command in self._message_commands(message, place, scope):
                if command.name in OWN_COMMANDS:
                    place.note("Commands", f"`{command.name}` is a command of the UCS itself", "choose another name")
                elif command.name in result:
                    place.note("Commands", f"command `{command.name}` is defined twice, first by {result[command.name].message}")
                result.setdefault(command.name, command)
        return result

    def _message_commands(self, message: Message, place: _Place, scope: Scope) -> Iterator[Command]:
        text = place.text("Commands")
        if not text:
            return
        if not message.sent_by_ucs:
            place.note("Commands", f"{message.name} is not sent by UCS", "commands belong to messages that UCS sends")
        commands, findings = resolver.resolve_commands(text, message, scope)
        place.take("Commands", text, findings)
        yield from commands
