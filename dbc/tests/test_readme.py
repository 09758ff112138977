"""The README's examples, taken out of the page: every definition loads, every time line is what the supervisor really does."""
from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import pytest

from level1 import definitions, resolver
from level1.catalog import REPAIRING, Catalog, Signal
from level1.command import Order
from level1.decode import ERROR, UNAVAILABLE, RawValue, encode, raw_of, reserved
from level1.event import EVENTS, Event, Output, Result, Send
from level1.frame import Frame, frame_key
from level1.supervisor import Supervisor

README = Path(__file__).parents[1] / "README.md"
FILE = "seed_drill.dbc"
MS = 1_000_000
CYCLE_MS = 100
AFTER_MS = 1000
"""How long each time line is run on after its last entry: what it does not tell must not happen."""

_FENCE = re.compile(r"^```(\w*)(?: (\w+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_ENTRY = re.compile(r"(\d+\.\d+)\s+(->)?\s*(.+)")


@dataclass(frozen=True)
class Block:
    """A fenced block. definitions: the DBC file as it stands there, all blocks of its file up to here together."""

    language: str
    mark: str
    text: str
    line: int
    definitions: str


@dataclass
class Story:
    """A time line, taken apart: what is said to the supervisor, and what it is expected to say, by time in ms."""

    given: dict[int, list[str]] = field(default_factory=dict)
    expected: list[str] = field(default_factory=list)
    end_ms: int = 0


def grown(text: str, addition: str) -> str:
    """A DBC file with the lines of a block added: signals that stand first belong to its last message."""
    lines = addition.splitlines(keepends=True)
    signals = [line for line in lines if line.startswith(" SG_")]
    if not lines[0].startswith(" SG_"):
        return text + addition
    last = list(re.finditer(r"^ SG_[^\n]*\n", text, re.MULTILINE))[-1].end()
    return text[:last] + "".join(signals) + text[last:] + "".join(line for line in lines if line not in signals)


def blocks() -> Iterator[Block]:
    """Every fenced block of the page, in its order."""
    page = README.read_text()
    text = ""
    for fence in _FENCE.finditer(page):
        language, mark, body = fence[1], fence[2] or "", fence[3]
        if language == "dbc":
            whole = body if body.startswith("VERSION") else grown(text, body)
            text = text if mark == "mistakes" else whole
        else:
            whole = text
        yield Block(language, mark, body, page[:fence.start()].count("\n") + 1, whole)


BLOCKS = list(blocks())


def load(text: str) -> Catalog:
    """The catalog of a file without any problem."""
    catalog, problems = definitions.build([definitions.Source(FILE, text)])
    assert catalog is not None and not problems, "\n".join(map(str, problems))
    return catalog


def story(text: str) -> Story:
    """Take a time line apart."""
    told = Story()
    for line in text.splitlines():
        match = _ENTRY.fullmatch(line.strip())
        assert match, f"not an entry of a time line: {line}"
        moment = round(float(match[1]) * 1000)
        told.end_ms = max(told.end_ms, moment)
        if match[2]:
            told.expected.append(f"{moment / 1000:.1f} {match[3]}")
        else:
            told.given.setdefault(moment, []).append(match[3])
    return told


def raw_value(signal: Signal, j1939: bool, word: str) -> int:
    """The raw value of what a time line says of a signal: a number, a value-table name, `error` or `unavailable`."""
    named = {name: raw for raw, name in signal.choices.items()}
    if word in named:
        return named[word]
    if word in ("error", "unavailable"):
        quality = {"error": ERROR, "unavailable": UNAVAILABLE}[word]
        return next(low for low, _, kind in reserved(signal) if kind == quality and j1939)
    number = Fraction(int(word, 16)) if word.startswith("0x") else Fraction(word)
    exact = (number - Fraction(signal.offset)) / Fraction(signal.factor)
    assert exact.denominator == 1, f"{signal.name}={word} is no step of the signal"
    return int(exact)


def physical(signal: Signal, raw: RawValue | None) -> str:
    """What a time line says of a raw value: its name in the value table, else the physical value."""
    assert isinstance(raw, int)
    return signal.choices.get(raw) or f"{float(raw * signal.factor + signal.offset):g}"


class Bench:
    """A supervisor, the devices around it, and a record of what it says, in the words of the time lines."""

    def __init__(self, catalog: Catalog):
        self.catalog = catalog
        self.supervisor = Supervisor(catalog, unit="bench", boot=1, start_ns=0)
        self.owner = {signal.name: message.name for message in catalog.messages.values() for signal in message.signals}
        self.payloads: dict[str, bytes] = {}
        self.silent: set[str] = set()
        self.record: list[str] = []
        self.last_sent: dict[str, bytes] = {}

    def run(self, told: Story) -> list[str]:
        """Live through a time line: every device sends its message each 100 ms, the newest value first told."""
        for now_ms in range(0, told.end_ms + AFTER_MS, CYCLE_MS):
            for words in told.given.get(now_ms, ()):
                self._obey(words, now_ms)
            for name in list(self.payloads):
                self._transmit(name, now_ms)
        return self.record

    def _obey(self, words: str, now_ms: int) -> None:
        verb, *rest = words.split()
        if verb in ("acknowledge", "reset"):
            self._keep(self.supervisor.command(Order("1", verb, target=rest[0], origin="local"), now_ms * MS), now_ms)
        elif verb == "order":
            value = Decimal(rest[1]) if len(rest) > 1 else None
            self._keep(self.supervisor.command(Order("1", rest[0], value=value), now_ms * MS), now_ms)
        elif verb == "silence":
            self.silent.add(rest[0])
        else:
            for assignment in words.split():
                self._set(*assignment.split("="))

    def _set(self, signal: str, word: str) -> None:
        message = self.catalog.messages[self.owner[signal]]
        raw = raw_value(message.signal(signal), message.j1939, word)
        self.payloads[message.name] = encode(message, {signal: raw}, self.payloads.get(message.name))
        self.silent.discard(message.name)

    def _transmit(self, name: str, now_ms: int) -> None:
        message = self.catalog.messages[name]
        repairing = any(state >= REPAIRING for state in self.supervisor.alarm_states().values())
        if name in self.silent or (message.sent_by_ucs and repairing):
            return
        can_id = message.can_id & ~0xFF if message.j1939 and message.source is None else message.can_id
        frame = Frame(now_ms * MS, frame_key(can_id, message.extended), self.payloads[name])
        self._keep(self.supervisor.receive(frame), now_ms)

    def _keep(self, outputs: Sequence[Output], now_ms: int) -> None:
        for output in outputs:
            if isinstance(output, Event):
                attempt = f" {output.attempt}" if output.attempt else ""
                self.record.append(f"{output.t:.1f} {output.alarm} {output.event}{attempt}")
            elif isinstance(output, Send) and output.reason != "alarm states":
                if self.last_sent.get(output.message) != output.data:
                    self.record.append(f"{output.t_ns / 1e9:.1f} {self._words(output)}")
                self.last_sent[output.message] = output.data
            elif isinstance(output, Result) and output.outcome == "refused":
                self.record.append(f"{now_ms / 1000:.1f} refused: {output.reason}")

    def _words(self, send: Send) -> str:
        message = self.catalog.messages[send.message]
        values = (f"{signal.name}={physical(signal, raw_of(signal, send.data))}" for signal in message.signals)
        return " ".join([send.message, *values])


def ids(block: Block) -> str:
    return f"line {block.line}"


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "dbc" and b.mark != "mistakes"], ids=ids)
def test_every_definition_loads_without_a_word(block: Block) -> None:
    load(block.definitions)


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "timeline"], ids=ids)
def test_every_time_line_is_what_happens(block: Block) -> None:
    told = story(block.text)
    assert Bench(load(block.definitions)).run(told) == told.expected


def test_the_mistakes_are_told_as_the_page_says() -> None:
    position = next(i for i, block in enumerate(BLOCKS) if block.mark == "mistakes")
    wrong, told = BLOCKS[position], BLOCKS[position + 1]
    catalog, problems = definitions.build([definitions.Source(FILE, wrong.definitions)])
    assert catalog is None
    lines = re.sub(r"(\.dbc:)\d+", r"\1…", "\n".join(map(str, problems))).splitlines()
    for line, shown in zip(lines, told.text.splitlines(), strict=True):
        assert line.startswith(shown)  # the page may leave a hint out


def reference(title: str) -> str:
    """A section of the page."""
    page = README.read_text()
    begin = page.index(f"\n### {title}\n")
    return page[begin:page.find("\n##", begin + 4)]


def test_the_reference_names_every_attribute() -> None:
    named = set(re.findall(r"`(\w+)`", reference("Attributes")))
    assert set(definitions.ATTRIBUTES) <= named


def test_the_reference_names_every_function() -> None:
    named = set(re.findall(r"`(\w+)\(", reference("Functions")))
    assert named == set(resolver.FUNCTIONS), "the table of functions in README.md and resolver.FUNCTIONS differ"


def test_the_reference_names_every_event() -> None:
    assert set(EVENTS) <= set(re.findall(r"`(\w+)`", reference("States and events")))


def test_every_shipped_file_is_listed() -> None:
    listed = set(re.findall(r"`(\w+\.dbc)`", reference("What ships")))
    assert listed == {path.name for path in README.parent.glob("*.dbc")}


def test_every_link_into_the_page_has_its_heading() -> None:
    page = README.read_text()
    headings = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in re.findall(r"^#+ (.+)$", page, re.M)}
    assert set(re.findall(r"\]\(#([\w-]+)\)", page)) <= headings
