"""One DBC file, read: its messages as `level1.catalog` has them, its attributes with their lines, and what is wrong with it.

cantools parses; this module gives its result exact numbers and lines (from `level1.dbc_text`) and turns every refusal into
a `Problem`. Pure: text in, values out.
"""
from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, Any

import cantools.database.can
import msgspec
from cantools.database.errors import Error as CantoolsError
from textparser import ParseError

from level1 import dbc_text, similar
from level1.catalog import Message, Problem, Signal
from level1.dbc_text import (
    EXTENDED_ID,
    UNUSED_MESSAGE,
    AttributeText,
    DbcText,
    DefinitionText,
    EntryText,
    MessageText,
    SignalText,
)
from level1.decode import raw_range
from level1.definitions import limits
from level1.frame import j1939_pgn
from level1.scaling import FLOAT_LENGTHS, float_bits

if TYPE_CHECKING:
    from cantools.database.can.message import Message as DbcMessage
    from cantools.database.can.signal import Signal as DbcSignal

ANY_SOURCE = 0xFE
"""Source address in a J1939 identifier that stands for any (J1939-81: the null address; DESIGN §3)."""
MAX_CYCLE_MS = 86_400_000
"""Longest cycle time taken seriously: a day."""
CLASSIC_BYTES = 8
"""Payload of a classic CAN frame; an 11-bit message with more can only be CAN FD, whatever VFrameFormat leaves out."""
MAX_VIOLATIONS = 20
"""Exceeded limits told of one file; a hostile one may have thousands."""
_END = "\nBS_:\n"
"""Put behind the text: cantools has no error of its own for a text that ends inside a statement."""

Owner = tuple[str, str]
"""Message name and signal name ("" for the message itself): whose attribute it is."""


@dataclass(frozen=True, slots=True)
class Attribute:
    """A value of an attribute (enumerations as their word), its line (0: the default of the file), and whether it is set
    on the object itself and differs from the file's default."""

    value: str | int | float
    line: int
    explicit: bool


@dataclass(frozen=True, slots=True)
class DbcFile:
    """What a file holds. attributes: of messages and signals, with the defaults of the file."""

    path: str
    text: DbcText
    messages: tuple[Message, ...]
    attributes: Mapping[Owner, Mapping[str, Attribute]]
    problems: tuple[Problem, ...]
    lines: Mapping[Owner, int]


def read(path: str, text: str) -> DbcFile:
    """The content of a file. Its problems tell what could not be read; what could be is there all the same."""
    reader = _Reader(path, DbcText(text))
    return reader.read()


class _Reader:
    """Reads one file; collects its problems on the way."""

    def __init__(self, path: str, text: DbcText):
        self._path = path
        self._text = text
        self._problems: list[Problem] = []
        self._changes: dict[tuple[int, int], str] = {}

    def read(self) -> DbcFile:
        if oversize := list(limits.violations(self._text)):
            for violation in oversize[:MAX_VIOLATIONS]:
                self._problem(violation.line, violation.message, violation.hint)
            return DbcFile(self._path, self._text, (), {}, tuple(self._problems), {})
        self._find_malformed()
        self._find_duplicates()
        self._check_attributes()
        self._find_stray_entries()
        database = None if self._text.malformed else self._parse()
        pairs = list(self._pairs(database)) if database else []
        messages = tuple(self._message(parsed, text) for parsed, text in pairs)
        attributes = {owner: values for pair in pairs for owner, values in self._attributes(*pair)}
        lines = {owner: line for pair in pairs for owner, line in _lines(*pair)}
        return DbcFile(self._path, self._text, messages, attributes, tuple(self._problems), lines)

    def _problem(self, line: int, message: str, hint: str = "", *, where: str = "", attribute: str = "",
                 severity: str = "error") -> None:
        self._problems.append(Problem(self._path, line, where, attribute, 0, severity, message, hint))

    # -- before cantools: what it would stumble over ------------------------------------------------------------------

    def _find_malformed(self) -> None:
        for line, text in self._text.malformed:
            short = " ".join(text.split())
            self._problem(line, f"`{short} …` can't be read", "numbers, brackets or order of the statement are wrong")

    def _find_duplicates(self) -> None:
        ids: dict[int, MessageText] = {}
        names: dict[str, MessageText] = {}
        for message in self._text.messages:
            if message.name == UNUSED_MESSAGE:
                continue
            if first := ids.get(message.id):
                self._duplicate(message, f"identifier {_id_text(message.id)} is used twice, first by {first.name} in line "
                                f"{first.line}")
            elif first := names.get(message.name):
                self._duplicate(message, f"message name is used twice, first in line {first.line}")
            ids.setdefault(message.id, message)
            names.setdefault(message.name, message)
            self._find_duplicate_signals(message)

    def _duplicate(self, message: MessageText, text: str) -> None:
        self._problem(message.line, text, where=message.name)
        end = max([message.span[1], *(signal.span[1] for signal in message.signals)])
        self._changes[message.span[0], self._statement_end(end)] = ""

    def _find_duplicate_signals(self, message: MessageText) -> None:
        lines: dict[str, int] = {}
        for signal in message.signals:
            if signal.name in lines:
                self._problem(signal.line, f"signal name is used twice in its message, first in line {lines[signal.name]}",
                              where=f"{message.name}.{signal.name}")
            lines.setdefault(signal.name, signal.line)

    def _check_attributes(self) -> None:
        for attribute in [*self._text.attributes, *self._text.defaults]:
            definition = self._text.definitions.get(attribute.name)
            if definition is None:
                self._undefined(attribute)
            elif definition.type in ("INT", "HEX", "FLOAT"):
                self._check_number(attribute, definition)
        for attribute in self._text.attributes:
            definition = self._text.definitions.get(attribute.name)
            if definition and definition.type == "ENUM":
                self._check_word(attribute, definition)

    def _undefined(self, attribute: AttributeText) -> None:
        self._changes[attribute.span] = ""
        kind = f"{attribute.kind} " if attribute.kind else ""
        self._problem(attribute.line, f'attribute "{attribute.name}" is not defined in this file',
                      similar.hint(attribute.name, self._text.definitions)
                      or f'add a line like `BA_DEF_ {kind}"{attribute.name}" STRING ;`')

    def _check_word(self, attribute: AttributeText, definition: DefinitionText) -> None:
        """Some write the word of an enumeration where the format wants its number; both are understood."""
        value = attribute.value
        if value.startswith('"'):
            if value[1:-1] in definition.words:
                self._changes[attribute.value_span] = str(definition.words.index(value[1:-1]))
                return
            hint = similar.hint(value[1:-1], definition.words)
        elif re.fullmatch(r"\d{1,4}", value) and int(value) < len(definition.words):
            return
        else:
            hint = f"write 0 to {len(definition.words) - 1};"
        self._changes[attribute.span] = ""
        self._problem(attribute.line, f"{value} is no value of it", f"{hint} its values are {', '.join(definition.words)}".strip(),
                      where=self._owner(attribute), attribute=attribute.name)

    def _check_number(self, attribute: AttributeText, definition: DefinitionText) -> None:
        if attribute.value.startswith('"') and not re.fullmatch(r'"[-+]?\d{1,40}(?:\.\d{1,40})?"', attribute.value):
            self._changes[attribute.span] = ""
            if attribute.value != '""':
                self._problem(attribute.line, f"{attribute.value[:40]} is no number", "write a number without quotes",
                              where=self._owner(attribute), attribute=attribute.name)

    def _owner(self, attribute: AttributeText) -> str:
        message = next((message.name for message in self._text.messages if str(message.id) == attribute.object), attribute.object)
        return ".".join(part for part in (message, attribute.signal) if part)

    def _find_stray_entries(self) -> None:
        signals = {m.id: {s.name: s for s in m.signals} for m in self._text.messages}
        seen: set[tuple[str, int, str]] = set()
        for entry in self._text.entries:
            key = (entry.word, entry.id, entry.name)
            if entry.name not in signals.get(entry.id, ()):
                self._stray(entry, f"{entry.word} for {entry.name} of message {_id_text(entry.id)}, which is not there: ignored")
            elif key in seen and entry.word != "SG_MUL_VAL_":
                self._stray(entry, f"{entry.word} is given twice for {entry.name}: the first one is taken")
            seen.add(key)

    def _stray(self, entry: EntryText, message: str) -> None:
        self._changes[entry.span] = ""
        self._problem(entry.line, message, severity="warning")

    def _statement_end(self, position: int) -> int:
        end = self._text.text.find("\n", position)
        return len(self._text.text) if end < 0 else end

    # -- cantools -----------------------------------------------------------------------------------------------------

    def _parse(self) -> cantools.database.can.Database | None:
        database = cantools.database.can.Database(strict=False, sort_signals=None)
        try:
            database.add_dbc_string(self._text.changed(self._changes) + _END)
        except ParseError as error:
            self._problem(*self._syntax_error(error))
        except CantoolsError as error:
            self._problem(self._line_of_message(str(error)), str(error).rstrip("."))
        except ValueError as error:
            self._problem(*self._value_error(str(error)))
        except (TypeError, KeyError, IndexError, AssertionError, AttributeError, ArithmeticError,
                NotImplementedError, RecursionError) as error:
            # cantools trusts its input; whatever it trips over is a mistake in the file
            self._problem(*_senseless(error))
        else:
            return database
        return None

    def _syntax_error(self, error: ParseError) -> tuple[int, str, str]:
        lines = self._text.text.split("\n")
        line = int(error.line)
        column = int(error.column)
        if open_text := self._text.open_text(line):
            begins, ends = open_text
            return begins, f"not a valid DBC file: a text that begins here ends in line {ends} only", 'is its closing `"` missing?'
        if line > len(lines):
            return len(lines), "the file ends inside a statement", "is it complete? the closing `;` may be missing"
        found = re.match(r"\w+|.?", lines[line - 1][column - 1:column + 40])
        token = found.group() if found else ""
        what = f"`{token}` in column {column}" if token else f"column {column}"
        return line, f"not a valid DBC file: {what} is not expected here", ("the statement may have "
                "begun on a line before, or the `;` that ends the one before is missing")

    def _value_error(self, text: str) -> tuple[int, str, str]:
        literal = re.match(r"invalid literal for int\(\) with base \d+: '(.*)'$", text)
        if literal is None:
            return _senseless(ValueError(text))
        places = list(re.finditer(rf"(?<![\w.]){re.escape(literal[1])}(?![\w.])", self._text.text))
        line = self._text.line_at(places[0].start()) if len(places) == 1 else 0
        return line, f"`{literal[1][:40]}` stands where a whole number belongs", "write it without point and exponent"

    def _line_of_message(self, text: str) -> int:
        return next((m.line for m in self._text.messages if text.endswith(f"in message {m.name}.")), 0)

    def _pairs(self, database: cantools.database.can.Database) -> Iterator[tuple[DbcMessage, MessageText]]:
        texts: dict[int, MessageText] = {}
        for message in self._text.messages:
            texts.setdefault(message.id, message)
        for parsed in database.messages:
            identifier = parsed.frame_id | (EXTENDED_ID if parsed.is_extended_frame else 0)
            text = texts.get(identifier)
            if text and len(text.signals) == len(parsed.signals):
                yield parsed, text
            else:
                self._problem(text.line if text else 0, "its signals can't be told apart", "write one statement a line",
                              where=parsed.name)

    # -- after cantools -----------------------------------------------------------------------------------------------

    def _message(self, parsed: DbcMessage, text: MessageText) -> Message:
        j1939 = parsed.protocol == "j1939" and parsed.is_extended_frame
        if parsed.protocol == "j1939" and not parsed.is_extended_frame:
            self._problem(text.line, "VFrameFormat says J1939, but the identifier has 11 bits: matched by identifier",
                          where=parsed.name, attribute="VFrameFormat", severity="warning")
        source = parsed.frame_id & 0xFF
        long_names = {line.name: signal.name for signal, line in zip(parsed.signals, text.signals, strict=True)}
        signals = tuple(self._signal(parsed, *pair, long_names) for pair in zip(parsed.signals, text.signals, strict=True))
        self._find_overlaps(parsed, text, signals)
        return Message(
            name=parsed.name, can_id=parsed.frame_id, extended=parsed.is_extended_frame, length=parsed.length, signals=signals,
            senders=tuple(parsed.senders), cycle_ns=self._cycle_ns(parsed, text), j1939=j1939,
            pgn=j1939_pgn(parsed.frame_id) if j1939 else None, source=source if j1939 and source != ANY_SOURCE else None,
            is_fd=parsed.is_fd or (not parsed.is_extended_frame and parsed.length > CLASSIC_BYTES),
            comment=parsed.comment or "", file=self._path, line=text.line)

    def _cycle_ns(self, parsed: DbcMessage, text: MessageText) -> int | None:
        if not parsed.cycle_time:
            return None
        with contextlib.suppress(InvalidOperation):  # a file may define it as text
            cycle_ms = Decimal(str(parsed.cycle_time))
            if 0 <= cycle_ms <= MAX_CYCLE_MS:
                return int(cycle_ms * 1_000_000) or None
        self._problem(text.line, "its cycle time is not possible: ignored", f"1 to {MAX_CYCLE_MS} ms", where=parsed.name,
                      attribute="GenMsgCycleTime", severity="warning")
        return None

    def _signal(self, message: DbcMessage, parsed: DbcSignal, text: SignalText, long_names: Mapping[str, str]) -> Signal:
        where = f"{message.name}.{parsed.name}"
        factor, offset = dbc_text.decimal(text.factor), dbc_text.decimal(text.offset)
        is_float = bool(parsed.conversion.is_float)
        minimum, maximum = self._limits(where, text)
        if not factor:
            self._problem(text.line, "factor 0: every raw value would mean the same", "write the resolution of one bit",
                          where=where)
        if parsed.length < 1:
            self._problem(text.line, "a signal needs at least one bit", where=where)
        elif is_float and parsed.length not in FLOAT_LENGTHS:
            self._problem(text.line, f"a floating point signal can't have {parsed.length} bits", "16, 32 or 64", where=where)
        elif not _fits(parsed, message.length):
            self._problem(text.line, f"doesn't fit into its message of {message.length} bytes", where=where)
        signal = Signal(  # with an error noted, any usable value does: later checks shall find the other mistakes
            name=parsed.name, start=parsed.start, length=max(1, parsed.length), big_endian=parsed.byte_order == "big_endian",
            signed=parsed.is_signed, is_float=is_float, factor=factor or Decimal(1), offset=offset, minimum=minimum,
            maximum=maximum, unit=parsed.unit or "",
            choices={int(raw): str(name) for raw, name in (parsed.choices or {}).items()},
            is_multiplexer=bool(parsed.is_multiplexer), multiplexer_signal=long_names.get(parsed.multiplexer_signal or ""),
            multiplexer_ids=None if parsed.multiplexer_ids is None else tuple(sorted(parsed.multiplexer_ids)),
            comment=parsed.comment or "")
        return msgspec.structs.replace(signal, initial_raw=self._initial_raw(where, signal, parsed.raw_initial, text.line))

    def _limits(self, where: str, text: SignalText) -> tuple[Decimal | None, Decimal | None]:
        minimum, maximum = dbc_text.decimal(text.minimum), dbc_text.decimal(text.maximum)
        if not minimum and not maximum:
            return None, None
        if minimum > maximum:
            self._problem(text.line, f"its limits [{text.minimum}|{text.maximum}] are the wrong way round: ignored", where=where,
                          severity="warning")
            return None, None
        return minimum, maximum

    def _initial_raw(self, where: str, signal: Signal, initial: int | float | None, line: int) -> int:
        if initial is None:
            return 0
        if signal.is_float and signal.length in FLOAT_LENGTHS:
            with contextlib.suppress(OverflowError):
                return float_bits(float(initial), signal.length)
        else:
            low, high = raw_range(signal)
            if low <= initial <= high and int(initial) == initial:
                return int(initial)
        self._problem(line, f"start value {initial} is no raw value of {signal.length} bits: 0 is taken", where=where,
                      attribute="GenSigStartValue", severity="warning")
        return 0

    def _find_overlaps(self, message: DbcMessage, text: MessageText, signals: tuple[Signal, ...]) -> None:
        """Overlapping signals are an error only where the UCS sends them: real files do it on purpose for variants of a message."""
        plain = [(signal, line.line) for signal, line in zip(signals, text.signals, strict=True)
                 if signal.multiplexer_ids is None and 0 < signal.length <= 8 * message.length]
        owners: dict[int, str] = {}
        for signal, line in plain:
            taken = next((owners[bit] for bit in _bits(signal) if bit in owners), None)
            if taken:
                ours = "UCS" in message.senders
                self._problem(line, f"overlaps {taken}", "the UCS sends both: move one to free bits" if ours else "",
                              where=f"{message.name}.{signal.name}", severity="error" if ours else "warning")
            else:
                owners.update(dict.fromkeys(_bits(signal), signal.name))

    def _attributes(self, parsed: DbcMessage, text: MessageText) -> Iterator[tuple[Owner, Mapping[str, Attribute]]]:
        yield (parsed.name, ""), self._values(parsed, "BO_", text.id, "")
        for signal, line in zip(parsed.signals, text.signals, strict=True):
            yield (parsed.name, signal.name), self._values(signal, "SG_", text.id, line.name)

    def _values(self, item: Any, kind: str, identifier: int, signal: str) -> dict[str, Attribute]:
        values: dict[str, Attribute] = {}
        own = item.dbc.attributes or {}
        for name, definition in item.dbc.attribute_definitions.items():
            if definition.kind != kind:
                continue
            default = definition.default_value
            if name in own:
                line = self._text.attribute_line(name, identifier, signal)
                value = _word(definition, own[name].value)
                values[name] = Attribute(value, line, value != default and value != "")
            elif default is not None:
                values[name] = Attribute(default, 0, False)
        return values


def _word(definition: Any, value: Any) -> str | int | float:
    if definition.type_name == "ENUM":
        return str(definition.choices[int(value)])  # `_check_word` has seen to it that there is one
    return value if isinstance(value, str | int | float) else str(value)


def _lines(parsed: DbcMessage, text: MessageText) -> Iterator[tuple[Owner, int]]:
    yield (parsed.name, ""), text.line
    for signal, line in zip(parsed.signals, text.signals, strict=True):
        yield (parsed.name, signal.name), line.line


def _senseless(error: Exception) -> tuple[int, str, str]:
    return (0, f"the DBC reader can't make sense of it ({type(error).__name__}: {' '.join(str(error).split())[:200]})",
            "open it in a DBC editor and save it again")


def _id_text(identifier: int) -> str:
    return f"0x{identifier & 0x1FFF_FFFF:X}" + (" (29 bit)" if identifier & EXTENDED_ID else "")


def _first_bit(signal: Any) -> int:
    """Offset of a big-endian signal's highest bit, counted from the highest bit of byte 0."""
    return 8 * (int(signal.start) // 8) + 7 - int(signal.start) % 8


def _fits(signal: DbcSignal, length: int) -> bool:
    first = _first_bit(signal) if signal.byte_order == "big_endian" else signal.start
    return 0 <= first and first + signal.length <= 8 * length


def _bits(signal: Signal) -> Iterator[int]:
    """Bits of the payload a signal takes, as 8 * byte + bit."""
    if not signal.big_endian:
        yield from range(signal.start, signal.start + signal.length)
        return
    first = _first_bit(signal)
    yield from (8 * (bit // 8) + 7 - bit % 8 for bit in range(first, first + signal.length))
