"""Bounds of a DBC file, checked on its text before the parser sees it: the parser trusts what it reads.

An 88-byte file can ask cantools for a million-bit signal, one line of `SG_MUL_VAL_` for gigabytes. Each limit stands in one
table with its reason; honest files stay far below all of them.
"""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from level1.dbc_text import STRING, DbcText, EntryText, MessageText


class Limit(Enum):
    """A bound: the largest value allowed, and why that one."""

    CHARACTERS = 10_000_000, "100,000 lines take 8 million; cantools needs 70 bytes of memory a character"
    STRING = 65_536, "cantools needs 200 bytes of memory a character of a string"
    DIGITS = 400, "the largest double has 309 digits"
    EXPONENT_DIGITS = 3, "the largest double is 1.8e308; an integer attribute of 1e999999999 would fill the memory"
    MESSAGE_BYTES = 1785, "the longest message of the J1939 transport protocol (SAE J1939-21)"
    SIGNALS = 4_096, "signals of one message; 64 bytes of CAN FD have 512 bits"
    SENDERS = 1_000, "nodes named by BO_TX_BU_ for one message; cantools compares each with all others"
    MULTIPLEXED_LAYOUTS = 20_000, "layouts of one multiplexed message; cantools builds each (25 us, 5 kB)"
    MULTIPLEXED_VISITS = 1_000_000, "signals times multiplexer values of a file; cantools looks at each (2 us)"

    @property
    def most(self) -> int:
        """The largest value allowed."""
        return self.value[0]


@dataclass(frozen=True, slots=True)
class Violation:
    """A bound that a file exceeds, and where."""

    line: int
    message: str
    hint: str = ""


def violations(text: DbcText) -> Iterator[Violation]:
    """Everything in a file that cantools must not see."""
    yield from _characters(text)
    yield from _strings_and_numbers(text)
    for message in text.messages:
        yield from _sizes(message)
    yield from _senders(text)
    yield from _multiplexing(text)


def _characters(text: DbcText) -> Iterator[Violation]:
    if len(text.text) > Limit.CHARACTERS.most:
        yield Violation(0, f"has {len(text.text)} characters: too large for a DBC file", f"at most {Limit.CHARACTERS.most}")
    if control := re.search(r"[\x00-\x08\x0e-\x1f]", text.text):
        yield Violation(text.line_at(control.start()), "is not a text file: it holds control characters",
                        "give a DBC file; databases, archives and recordings are something else")
    elif re.match(r"\s*<", text.text):
        yield Violation(1, "is XML, not a DBC file", "export it as DBC from your editor")
    elif not re.search(r"\b(?:VERSION|NS_|BS_|BU_|BO_|BA_DEF_|VAL_TABLE_)(?!\w)", text.text):
        yield Violation(1, "holds no DBC statement", "is this the right file?")


_TOO_MANY_DIGITS = rf"(?<!\w)\d{{{Limit.DIGITS.most + 1}}}"
_TOO_LARGE = (rf"(?<![\w.])\d{{1,{Limit.DIGITS.most}}}\.?\d{{0,{Limit.DIGITS.most}}}"
              rf"[eE][-+]?\d{{{Limit.EXPONENT_DIGITS.most + 1}}}")
_OVERSIZE = re.compile(rf"(?P<string>{STRING})|{_TOO_MANY_DIGITS}|{_TOO_LARGE}", re.DOTALL)


def _strings_and_numbers(text: DbcText) -> Iterator[Violation]:
    largest = f"at most {Limit.DIGITS.most} digits and e{'9' * Limit.EXPONENT_DIGITS.most}"
    for match in _OVERSIZE.finditer(text.text):
        line = text.line_at(match.start())
        if match["string"] is None:
            yield Violation(line, "a number is out of any range", largest)
        elif len(match["string"]) > Limit.STRING.most + 2:
            yield Violation(line, f"a text of {len(match['string']) - 2} characters is too long", f"at most {Limit.STRING.most}")


def _sizes(message: MessageText) -> Iterator[Violation]:
    if message.length > Limit.MESSAGE_BYTES.most:
        yield Violation(message.line, f"{message.name}: a message of {message.length} bytes is too long",
                        f"at most {Limit.MESSAGE_BYTES.most}, what the J1939 transport protocol carries")
    if len(message.signals) > Limit.SIGNALS.most:
        yield Violation(message.line, f"{message.name}: {len(message.signals)} signals are too many",
                        f"at most {Limit.SIGNALS.most}")
    bits = 8 * Limit.MESSAGE_BYTES.most
    for signal in message.signals:
        if int(signal.length) > bits or int(signal.start) > bits:
            yield Violation(signal.line, f"{message.name}.{signal.name}: {signal.length} bits from bit {signal.start}: no message "
                            "is so long", f"this one has {8 * message.length} bits")


def _senders(text: DbcText) -> Iterator[Violation]:
    counts: Counter[str] = Counter()
    for match in re.finditer(r"\bBO_TX_BU_\s++(\d++)\s*+:([\w\s,]*+)", text.text):
        counts[match[1]] += match[2].count(",") + 1
        if counts[match[1]] > Limit.SENDERS.most:
            yield Violation(text.line_at(match.start()), f"{counts[match[1]]} senders of one message are too many",
                            f"at most {Limit.SENDERS.most}")
            return


# -- multiplexing -------------------------------------------------------------------------------------------------------


def _multiplexing(text: DbcText) -> Iterator[Violation]:
    entries: dict[int, list[EntryText]] = {}
    for entry in text.entries:
        entries.setdefault(entry.id, []).append(entry)
    visits = 0
    for message in text.messages:
        if not any(signal.multiplexer for signal in message.signals):
            continue
        tree = _Multiplexers(message, entries.get(message.id, []))
        if tree.circular:
            yield Violation(message.line, f"{message.name}: its multiplexers depend on each other in a circle")
            continue
        visits += tree.visits
        if tree.layouts > Limit.MULTIPLEXED_LAYOUTS.most or visits > Limit.MULTIPLEXED_VISITS.most:
            yield Violation(message.line, f"{message.name}: its multiplexers have {tree.layouts} layouts, too many",
                            f"at most {Limit.MULTIPLEXED_LAYOUTS.most}: narrow the ranges of SG_MUL_VAL_")
            return


class _Multiplexers:
    """How cantools would lay out a multiplexed message: by the rules of its loader, counted without building anything.

    layouts: how many; visits: how many signals it looks at for them; circular: whether it would never end.
    """

    def __init__(self, message: MessageText, entries: list[EntryText]):
        switches = [signal.name for signal in message.signals if signal.multiplexer.endswith("M")]
        only = switches[0] if len(switches) == 1 else None
        parents = {entry.name: entry.multiplexer for entry in entries if entry.word == "SG_MUL_VAL_"}
        self._children: dict[str, list[str]] = {}
        self._values: dict[str, int] = dict.fromkeys(switches, 0)
        for signal in message.signals:
            parent = (only or parents.get(signal.name)) if signal.multiplexer and signal.name != only else None
            if parent in self._values:
                self._children.setdefault(parent, []).append(signal.name)
                self._values[parent] += 1
        for entry in entries:
            if entry.word == "SG_MUL_VAL_" and entry.multiplexer in self._values:
                self._values[entry.multiplexer] += sum(max(0, high - low + 1) for low, high in entry.ranges)
            elif entry.word == "VAL_" and entry.name in self._values:
                self._values[entry.name] += entry.text.count('"') // 2
        self.circular = any(self._returns(switch) for switch in switches)
        self.layouts = self.visits = 0
        if not self.circular:
            below = {child for children in self._children.values() for child in children}
            for switch in switches:
                if switch not in below:
                    self._count(switch, 1)

    def _returns(self, switch: str) -> bool:
        """Whether a multiplexer comes back to itself through what it multiplexes."""
        seen: set[str] = set()
        pending = [switch]
        while pending:
            for child in self._children.get(pending.pop(), ()):
                if child == switch:
                    return True
                if child in self._values and child not in seen:
                    seen.add(child)
                    pending.append(child)
        return False

    def _count(self, root: str, times: int) -> None:
        """Counts layouts below a multiplexer that itself occurs so many times; stops soon above the limits."""
        pending = [(root, times)]
        while pending and self.layouts <= Limit.MULTIPLEXED_LAYOUTS.most and self.visits <= Limit.MULTIPLEXED_VISITS.most:
            switch, occurs = pending.pop()
            layouts = occurs * self._values[switch]
            children = self._children.get(switch, [])
            self.layouts += layouts
            self.visits += layouts * len(children)
            pending.extend((child, max(1, layouts)) for child in children if child in self._values)
