"""From the texts of DBC files to a `Catalog`: alarms, repairs, commands, monitoring messages, and everything wrong with them.

Pure: `level1.io.definitions` reads the files and runs this in a child of its own. The steps, each a module: index and measure
the text (`level1.dbc_text`, `limits`), parse (`dbc_file`), attributes (`attributes`, `messages`, `alarms`), language
(`level1.language`), names and types (`level1.resolver`), what can come true (`level1.reach`, `level1.check`).
"""
from __future__ import annotations

import codecs
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from level1 import resolver
from level1.catalog import Catalog, Command, Message, Problem
from level1.definitions import dbc_file
from level1.definitions.alarms import alarm_places, alarms_at
from level1.definitions.attributes import ATTRIBUTES, Place, misuses
from level1.definitions.dbc_file import DbcFile
from level1.definitions.messages import check_identifiers, place_of, unique
from level1.resolver import Scope

__all__ = ["ATTRIBUTES", "Assembly", "Source", "assemble", "build", "decode", "read"]

OWN_COMMANDS = ("acknowledge", "reset")
"""Commands the core itself answers; a DBC can't define them."""


@dataclass(frozen=True, slots=True)
class Source:
    """A DBC file: the path that problems name, and its text."""

    path: str
    text: str


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
    problems = [problem for file in files for problem in (*file.problems, *misuses(file))]
    found = unique(files, problems)
    check_identifiers(found, bindings or {}, problems)
    places = alarm_places((message, signal, place_of(file, message, problems, signal))
                          for file, message in found for signal in message.signals)
    scope = Scope((message for _, message in found), {signal.name: message.name for message, signal, _ in places})
    catalog = Catalog(
        files=tuple(file.path for file in files),
        messages=scope.messages,
        alarms={alarm.name: alarm for alarm in alarms_at(places, scope)},
        commands=_commands(found, scope, problems),
        buses={message.name: tuple(bindings[file.path]) for file, message in found if bindings and file.path in bindings})
    order = {file.path: index for index, file in enumerate(files)}
    problems.sort(key=lambda problem: (order[problem.file], problem.line, problem.where, problem.attribute, problem.column))
    usable = not any(problem.severity == "error" for problem in problems)
    return Assembly(catalog if usable else None, tuple(problems), len(catalog.messages), len(places))


def _commands(messages: Iterable[tuple[DbcFile, Message]], scope: Scope, problems: list[Problem]) -> dict[str, Command]:
    """The commands of all messages, each name once."""
    result: dict[str, Command] = {}
    for file, message in messages:
        place = place_of(file, message, problems)
        for command in _message_commands(message, place, scope):
            if command.name in OWN_COMMANDS:
                place.note("Commands", f"`{command.name}` is a command of the UCS itself", "choose another name")
            elif command.name in result:
                place.note("Commands", f"command `{command.name}` is defined twice, first by {result[command.name].message}")
            result.setdefault(command.name, command)
    return result


def _message_commands(message: Message, place: Place, scope: Scope) -> Iterator[Command]:
    text = place.text("Commands")
    if not text:
        return
    if not message.sent_by_ucs:
        place.note("Commands", f"{message.name} is not sent by UCS", "commands belong to messages that UCS sends")
    commands, findings = resolver.resolve_commands(text, message, scope)
    place.take("Commands", text, findings)
    yield from commands
