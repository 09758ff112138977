"""The attributes of the alarm language (DESIGN §3): what there is, where one stands, and what is wrong with its use."""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from level1 import similar
from level1.catalog import Problem
from level1.dbc_text import AttributeText
from level1.definitions.dbc_file import Attribute, DbcFile, Owner
from level1.event import PRIORITIES
from level1.protection import CHECKSUMS
from level1.resolver import Finding

MAX_FINDINGS = 10
"""Mistakes told of one text."""


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
    "AlarmLatch": AttributeSpec("SG_", ("ENUM",), ("No", "Yes", "Local")),
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
    "RepairCounts": AttributeSpec("SG_", ("ENUM",), ("All", "Failed")),
    "Role": AttributeSpec("SG_", ("ENUM",), ("None", "Counter", "Checksum")),
    "ChecksumType": AttributeSpec("SG_", ("ENUM",), tuple(CHECKSUMS)),
    "MonitorAs": AttributeSpec("BO_", ("STRING",)),
    "Commands": AttributeSpec("BO_", ("STRING",)),
}
"""Every attribute of the alarm language (DESIGN §3), besides Vector's own."""
_KINDS = {"SG_": "signals", "BO_": "messages"}


class Place:
    """Where an attribute stands: makes its problems."""

    def __init__(self, file: DbcFile, owner: Owner, problems: list[Problem]):
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

    def is_wrong(self, attribute: str) -> bool:
        """Whether an error of this attribute is known already."""
        where = ".".join(part for part in self.owner if part)
        return any(problem.severity == "error" and (problem.file, problem.where, problem.attribute) == (self.path, where, attribute)
                   for problem in self._problems)

    def given(self, name: str) -> bool:
        """Whether it is set here and differs from the file's default."""
        value = self.attributes.get(name)
        return value is not None and value.explicit


def misuses(file: DbcFile) -> Iterator[Problem]:
    """Attributes of the alarm language defined as something else, and those that cantools would pass over in silence."""
    yield from _definitions(file)
    yield from _uses(file)


def _definitions(file: DbcFile) -> Iterator[Problem]:
    used = {attribute.name for attribute in file.text.attributes}
    for name, definition in file.text.definitions.items():
        spec = ATTRIBUTES.get(name)
        if spec and name in used and (definition.kind != spec.kind or definition.type not in spec.types):
            words = " " + ",".join(f'"{word}"' for word in spec.words) if spec.words else ""
            yield Problem(file.path, definition.line, "", "", 0, "error",
                          f"{name} belongs to {_KINDS[spec.kind]} and is {spec.types[0]}",
                          f'write `BA_DEF_ {spec.kind} "{name}" {spec.types[0]}{words} ;`')
        elif not spec and name.startswith(("Alarm", "Repair")) and (near := similar.closest(name, ATTRIBUTES)):
            yield Problem(file.path, definition.line, "", "", 0, "warning", f'attribute "{name}" means nothing here',
                          f"did you mean `{near}`?")


def _uses(file: DbcFile) -> Iterator[Problem]:
    """Attributes on nothing, on a wrong object, or twice on the same."""
    objects = {str(message.id): (message.name, [signal.name for signal in message.signals]) for message in file.text.messages}
    lines: dict[tuple[str, str, str], int] = {}
    for given in file.text.attributes:
        if given.name not in ATTRIBUTES:
            continue
        first = lines.setdefault((given.name, given.object, given.signal), given.line)
        message, signals = objects.get(given.object, ("", []))
        where = ".".join(part for part in (message or given.object, given.signal) if part)
        if wrong := _misplaced(given, ATTRIBUTES[given.name].kind, message, signals, objects):
            yield Problem(file.path, given.line, where, given.name, 0, "error", *wrong)
        elif first != given.line:
            yield Problem(file.path, given.line, where, given.name, 0, "warning",
                          f"is set twice, first in line {first}: the last one counts", "remove one of them")


def _misplaced(given: AttributeText, kind: str, message: str, signals: Sequence[str],
               objects: Mapping[str, object]) -> tuple[str, str] | None:
    """What is wrong with the object an attribute stands on, and what to do."""
    if given.kind != kind:
        return f"belongs to {_KINDS[kind]}", f"write {kind}, an identifier" + (" and a signal" if kind == "SG_" else "")
    if not message:
        return f"there is no message with the identifier {given.object}", similar.hint(given.object, objects)
    if kind == "SG_" and given.signal not in signals:
        return f"message {message} has no signal `{given.signal}`", similar.hint(given.signal, signals)
    return None
