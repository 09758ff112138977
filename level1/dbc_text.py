"""The text of a DBC file as an index of its statements: where each one stands, and its numbers exactly as written.

The parser proper is cantools; it keeps neither lines nor decimals, raises at the first mistake, and trusts what it reads.
This index gives every problem its line, finds what cantools would stumble over, and measures a file before cantools sees it.
A pure function of the text; its one pass takes time in proportion to the text's length, whatever it holds.
"""
from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal

EXTENDED_ID = 0x8000_0000
"""Bit of a 29-bit identifier as a DBC file writes it."""
UNUSED_MESSAGE = "VECTOR__INDEPENDENT_SIG_MSG"
"""Vector's name for the message that holds signals of no message; cantools leaves it out too."""

STRING = r'"[^"\\]*+(?:\\"?[^"\\]*+)*+(?:"|\Z)'
"""A string as cantools reads it: `\\"` is a quote inside. Possessive, so that no text makes it look twice; one without end
reaches to the end of the file."""
_NUMBER = r"[-+]?\d{1,400}\.?\d{0,400}(?:[eE][-+]?\d{1,3})?(?![\w.])"
_INT = r"\d{1,12}"
_OBJECT = r"(?:(?P<kind>SG_|BO_|BU_|EV_)\s+(?P<object>\w+)(?:\s+(?P<signal>[A-Za-z_]\w*))?\s*)?"

_HEAD = re.compile(
    rf"{STRING}|\b(?P<word>BO_|SG_|BA_|BA_DEF_|BA_DEF_DEF_|VAL_|SIG_VALTYPE_|SG_MUL_VAL_)(?=\s)", re.DOTALL)
_BODIES: Mapping[str, re.Pattern[str]] = {
    "BO_": re.compile(rf"BO_\s+(?P<id>{_INT})\s+(?P<name>\w+)\s*:\s*(?P<length>{_INT})\s+(?P<sender>\w+)"),
    "SG_": re.compile(
        rf"SG_\s+(?P<name>\w+)(?:\s+(?P<mux>\w+))?\s*:\s*(?P<start>{_INT})\s*\|\s*(?P<length>{_INT})\s*@\s*(?P<order>[01])"
        rf"\s*(?P<sign>[-+])\s*\(\s*(?P<factor>{_NUMBER})\s*,\s*(?P<offset>{_NUMBER})\s*\)"
        rf"\s*\[\s*(?P<minimum>{_NUMBER})\s*\|\s*(?P<maximum>{_NUMBER})\s*\]"),
    "BA_": re.compile(rf'BA_\s+"(?P<name>[^"]*)"\s*{_OBJECT}(?P<value>{STRING}|{_NUMBER})\s*;', re.DOTALL),
    "BA_DEF_": re.compile(
        r'BA_DEF_\s+(?:(?P<kind>SG_|BO_|BU_|EV_)\s+)?"(?P<name>[^"]*)"\s*(?P<type>\w+)'
        rf"(?P<words>(?:\s*,?\s*{STRING})*+)", re.DOTALL),
    "BA_DEF_DEF_": re.compile(rf'BA_DEF_DEF_\s+"(?P<name>[^"]*)"\s*(?P<value>{STRING}|{_NUMBER})\s*;', re.DOTALL),
    "VAL_": re.compile(rf"VAL_\s+(?P<id>{_INT})\s+(?P<name>\w+)(?P<rest>(?:\s*{_NUMBER}\s*{STRING})*+)\s*;", re.DOTALL),
    "SIG_VALTYPE_": re.compile(rf"SIG_VALTYPE_\s+(?P<id>{_INT})\s+(?P<name>\w+)\s*:\s*(?P<type>{_INT})\s*;"),
    "SG_MUL_VAL_": re.compile(
        rf"SG_MUL_VAL_\s+(?P<id>{_INT})\s+(?P<name>\w+)\s+(?P<multiplexer>\w+)\s+(?P<ranges>{_INT}\s*-\s*{_INT}(?:\s*,\s*{_INT}\s*-\s*{_INT})*+)\s*;"),
}
_MALFORMED: Mapping[str, re.Pattern[str]] = {
    "BO_": re.compile(r"BO_\s++[\w.+-]++\s*+\w*+\s*+:"),
    "SG_": re.compile(r"SG_\s++\w++\s*+\w*+\s*+:"),
    "SG_MUL_VAL_": re.compile(r"SG_MUL_VAL_\s++\d++[^;\n]{0,40}+"),
}
"""What is meant as such a statement although it can't be read: cantools must not see what the index has not measured."""

_KEYWORDS = frozenset("""
    NS_ NS_DESC_ CM_ BA_DEF_ BA_ VAL_ CAT_DEF_ CAT_ FILTER BA_DEF_DEF_ EV_DATA_ ENVVAR_DATA_ SGTYPE_ SGTYPE_VAL_ BA_DEF_SGTYPE_
    BA_SGTYPE_ SIG_TYPE_REF_ VAL_TABLE_ SIG_GROUP_ SIG_VALTYPE_ SIGTYPE_VALTYPE_ BO_TX_BU_ BA_DEF_REL_ BA_REL_
    BA_DEF_DEF_REL_ BU_SG_REL_ BU_EV_REL_ BU_BO_REL_ SG_MUL_VAL_ BS_ BU_ BO_ SG_ EV_ VERSION""".split())


@dataclass(frozen=True, slots=True)
class SignalText:
    """A `SG_` line: numbers as written. multiplexer: `M`, `m3`, `m3M` or ""."""

    line: int
    span: tuple[int, int]
    name: str
    multiplexer: str
    start: str
    length: str
    factor: str
    offset: str
    minimum: str
    maximum: str


@dataclass(frozen=True, slots=True)
class MessageText:
    """A `BO_` line and its signals. id: as written, 29-bit identifiers with `EXTENDED_ID`. length: bytes."""

    line: int
    span: tuple[int, int]
    id: int
    name: str
    length: int
    signals: list[SignalText] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class AttributeText:
    """A `BA_` line, or a `BA_DEF_DEF_` line without object. kind: `SG_`, `BO_`, `BU_`, `EV_` or "" (the network).

    object: id or node name. value, value_span: as written, and where.
    """

    line: int
    span: tuple[int, int]
    value_span: tuple[int, int]
    name: str
    kind: str
    object: str
    signal: str
    value: str


@dataclass(frozen=True, slots=True)
class DefinitionText:
    """A `BA_DEF_` line; words: of an enumeration."""

    line: int
    name: str
    kind: str
    type: str
    words: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class EntryText:
    """A `VAL_`, `SIG_VALTYPE_` or `SG_MUL_VAL_` statement; text: the statement."""

    line: int
    span: tuple[int, int]
    word: str
    id: int
    name: str
    text: str
    ranges: tuple[tuple[int, int], ...] = ()
    multiplexer: str = ""


class DbcText:
    """The statements of a text, in its order."""

    def __init__(self, text: str):
        self.text = text = _without_comments(text)
        self.messages: list[MessageText] = []
        self.attributes: list[AttributeText] = []
        self.definitions: dict[str, DefinitionText] = {}
        self.defaults: list[AttributeText] = []
        self.entries: list[EntryText] = []
        self.malformed: list[tuple[int, str]] = []
        self._newlines = [match.start() for match in re.finditer("\n", text)]
        for word, match in _statements(text):
            if match.re is _MALFORMED.get(word):
                self.malformed.append((self.line_at(match.start()), match.group()[:60]))
            else:
                self._add(word, match)
        self._attribute_lines = {(a.kind, a.object, a.signal, a.name): a.line for a in self.attributes}

    def line_at(self, offset: int) -> int:
        """1-based line of an offset."""
        return bisect_right(self._newlines, offset - 1) + 1

    def open_text(self, line: int) -> tuple[int, int] | None:
        """Where a text begins and ends whose closing quote is missing, up to a line with a mistake: it ends in a later line than
        it begins, at a quote with which another one seems to begin. None where there is none."""
        for match in re.finditer(STRING, self.text, re.DOTALL):
            begins, ends = self.line_at(match.start()), self.line_at(match.end() - 1)
            if ends > line:
                break
            if begins < ends and re.match(r"[^\s;,]", self.text[match.end():match.end() + 1]):
                return begins, ends
        return None

    def attribute_line(self, name: str, message_id: int, signal: str = "") -> int:
        """Line of a message's or signal's attribute, 0 when it is not set there."""
        kind = "SG_" if signal else "BO_"
        return self._attribute_lines.get((kind, str(message_id), signal, name), 0)

    def changed(self, changes: Mapping[tuple[int, int], str]) -> str:
        """The text with other text in some places, each padded with blanks to its old length: every line where it was."""
        parts: list[str] = []
        position = 0
        for (start, end), new in sorted(changes.items()):
            if start >= position:
                parts.append(self.text[position:start])
                parts.append(new + re.sub(r"[^\n]", " ", self.text[start + len(new):end]))
                position = end
        return "".join([*parts, self.text[position:]])

    def _add(self, word: str, match: re.Match[str]) -> None:
        line, span = self.line_at(match.start()), match.span()
        group = match.group
        if word == "BO_":
            self.messages.append(MessageText(line, span, int(group("id")), group("name"), int(group("length"))))
        elif word == "SG_":
            if self.messages:
                self.messages[-1].signals.append(SignalText(
                    line, span, group("name"), group("mux") or "", group("start"), group("length"), group("factor"),
                    group("offset"), group("minimum"), group("maximum")))
        elif word == "BA_":
            self.attributes.append(AttributeText(
                line, span, match.span("value"), group("name"), group("kind") or "", group("object") or "",
                group("signal") or "", group("value")))
        elif word == "BA_DEF_":
            words = tuple(word[1:-1] for word in re.findall(STRING, group("words"), re.DOTALL))
            self.definitions[group("name")] = DefinitionText(line, group("name"), group("kind") or "", group("type"), words)
        elif word == "BA_DEF_DEF_":
            self.defaults.append(AttributeText(line, span, match.span("value"), group("name"), "", "", "", group("value")))
        elif word == "SG_MUL_VAL_":
            self.entries.append(EntryText(line, span, word, int(group("id")), group("name"), group(), _ranges(group("ranges")),
                                          group("multiplexer")))
        elif word in ("VAL_", "SIG_VALTYPE_"):
            self.entries.append(EntryText(line, span, word, int(group("id")), group("name"), group()))


def decimal(number: str) -> Decimal:
    """A number of a DBC file, exactly."""
    return Decimal(number)


def _ranges(text: str) -> tuple[tuple[int, int], ...]:
    return tuple((int(low), int(high)) for low, high in re.findall(r"(\d+)\s*-\s*(\d+)", text))


def _without_comments(text: str) -> str:
    if "//" not in text:
        return text
    return re.sub(rf"{STRING}|//[^\n]*", lambda m: m[0] if m[0][0] == '"' else " " * len(m[0]), text, flags=re.DOTALL)


def _statements(text: str) -> Iterator[tuple[str, re.Match[str]]]:
    position = 0
    while head := _HEAD.search(text, position):
        position = head.end()
        word = head["word"]
        if word is None:
            continue
        match = _BODIES[word].match(text, head.start())
        if match is None and word in _MALFORMED:
            match = _MALFORMED[word].match(text, head.start())
            if match and _KEYWORDS.issuperset(re.findall(r"\w+", match.group())):
                continue  # the list of keywords behind NS_
        if match:
            position = match.end()
            yield word, match
