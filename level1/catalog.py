"""What the DBC files define, as plain values: messages, signals, alarms, repairs, commands, monitoring messages.

Built by `level1.definitions` from the texts of DBC files; nothing here reads a file. All of it can be encoded (msgspec).
"""
from __future__ import annotations

from decimal import Decimal

import msgspec

from level1.event import PRIORITIES
from level1.expression import Expression, Step

NORMAL, ACTIVE, REPAIRING, LOCKED_OUT = range(4)
"""Raw values of an alarm signal on the bus (DESIGN §3)."""

STALE_CYCLES = 3
"""An input older than so many cycle times is stale (DESIGN §4)."""


class Signal(msgspec.Struct, frozen=True):
    """A signal of a message.

    start: bit number as the DBC writes it (Intel: lowest bit; Motorola: highest, sawtooth numbering). length: bits.
    physical = raw * factor + offset. minimum, maximum: physical limits, None where the file gives [0|0].
    choices: value table, raw -> name. initial_raw: GenSigStartValue, what a command holds before anyone commanded it.
    multiplexer_ids: None for a signal that is always there; else the values of `multiplexer_signal` at which it is.
    role: None, Counter or Checksum (end-to-end protection); checksum: algorithm, a key of `protection.CHECKSUMS`.
    """

    name: str
    start: int
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    factor: Decimal
    offset: Decimal
    minimum: Decimal | None = None
    maximum: Decimal | None = None
    unit: str = ""
    choices: dict[int, str] = {}
    initial_raw: int = 0
    is_multiplexer: bool = False
    multiplexer_signal: str | None = None
    multiplexer_ids: tuple[int, ...] | None = None
    role: str = "None"
    checksum: str = "CRC8_SAE_J1850"
    comment: str = ""


class Command(msgspec.Struct, frozen=True):
    """A command from above, as the attribute `Commands` of a UCS message names it: raw values, or None for `$value`."""

    name: str
    message: str
    values: dict[str, int | None]


class Message(msgspec.Struct, frozen=True):
    """A message.

    length: bytes. cycle_ns: GenMsgCycleTime, None when it has none. senders: node names; `UCS` may send it if among them.
    j1939: matched by parameter group number (VFrameFormat); source None = any source address (0xFE in the DBC id).
    file, line: where it is defined.
    """

    name: str
    can_id: int
    extended: bool
    length: int
    signals: tuple[Signal, ...]
    senders: tuple[str, ...] = ()
    cycle_ns: int | None = None
    j1939: bool = False
    pgn: int | None = None
    source: int | None = None
    is_fd: bool = False
    monitor_as: str = ""
    comment: str = ""
    file: str = ""
    line: int = 0

    def signal(self, name: str) -> Signal:
        """The signal of that name. Raises KeyError."""
        for signal in self.signals:
            if signal.name == name:
                return signal
        raise KeyError(name)

    @property
    def sent_by_ucs(self) -> bool:
        """Whether the UCS may send it."""
        return "UCS" in self.senders


class Repair(msgspec.Struct, frozen=True):
    """The local repair of an alarm: steps, the steps into the safe state, and the budget (DESIGN §5).

    moves: it moves something, so it is inhibited while the unit is stopped or paused from above (attribute RepairMoves,
    default Yes). safe_between: a failed attempt enters the safe state at once; else (attribute RepairBetween, AsCommanded)
    its messages return to what was commanded before the episode, and each attempt begins from there. local_reset: a lock-
    out can only be reset on board (attribute RepairReset, default Local). counts_good: attempts that were good use up the budget,
    too (attribute RepairCounts, default All).
    """

    steps: tuple[Step, ...]
    give_up: tuple[Step, ...] = ()
    attempts: int = 1
    window_ns: int = 3_600_000_000_000
    pause_ns: int = 0
    moves: bool = True
    local_reset: bool = True
    safe_between: bool = True
    counts_good: bool = True
    text: str = ""
    give_up_text: str = ""


class Alarm(msgspec.Struct, frozen=True):
    """An alarm: a signal of a message that the node `UCS` sends (DESIGN §3).

    when: raises it. until: clears it (None: not `when`). enabled: suppressed by design while FALSE (None: always enabled).
    latch: it stays until acknowledged; local_latch: by someone at the machine, not from above. The texts as written stand beside
    the resolved conditions.
    """

    name: str
    message: str
    code: int
    priority: str
    when: Expression
    until: Expression | None = None
    enabled: Expression | None = None
    when_text: str = ""
    until_text: str = ""
    enabled_text: str = ""
    on_delay_ns: int = 0
    off_delay_ns: int = 0
    latch: bool = False
    local_latch: bool = False
    cause: str = ""
    consequence: str = ""
    action: str = ""
    comment: str = ""
    spn: int | None = None
    fmi: int | None = None
    repair: Repair | None = None
    file: str = ""
    line: int = 0

    @property
    def signal(self) -> str:
        """Name of its signal in its message; the alarm's own name carries the bus where there are several (`buses`)."""
        return self.name.partition("@")[0]

    @property
    def is_fault(self) -> bool:
        """Whether it reports a fault; priority Event does not (mission finished)."""
        return self.priority != PRIORITIES[0]


class Catalog(msgspec.Struct, frozen=True):
    """Everything the loaded DBC files define. buses: message name -> indexes of the buses it is bound to."""

    files: tuple[str, ...]
    messages: dict[str, Message]
    alarms: dict[str, Alarm]
    commands: dict[str, Command] = {}
    buses: dict[str, tuple[int, ...]] = {}


class Problem(msgspec.Struct, frozen=True):
    """An error or warning in a definition, and where it stands.

    line, column: 1-based, 0 where unknown; column counts in the attribute's text, `text`. hint: what to do.
    """

    file: str
    line: int
    where: str
    attribute: str
    column: int
    severity: str
    message: str
    hint: str = ""
    text: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        subject = " ".join(part for part in (self.where, self.attribute) if part)
        column = f" (column {self.column})" if self.column else ""
        hint = f"; {self.hint}" if self.hint else ""
        head = f"{place}: {self.severity}: " + (f"{subject}{column}: " if subject else "")
        caret = f"\n    {self.text}\n    {' ' * (self.column - 1)}^" if self.column and self.text else ""
        return f"{head}{self.message}{hint}{caret}"


class DefinitionError(Exception):
    """Definitions that can't be used; `problems` holds every error and warning found, of all files."""

    def __init__(self, problems: tuple[Problem, ...]):
        super().__init__("\n".join(map(str, problems)))
        self.problems = problems
