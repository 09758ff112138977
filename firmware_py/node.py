"""A node on a bus: what all of them have in common. Sans I/O: frames and time come in, frames go out.

Theory of operation. A node lives in ticks of `TICK_NS`: each tick computes protocol and plant, then messages whose cycle time
has come are sent. A late `step` makes up for all missed ticks, so that the plant does not depend on who calls and how often,
but sends each message only once. Faults that every node knows: `silent` (computes and hears, sends nothing), `frozen` (its
program stands: hears nothing, the last payloads are sent on), `reset` (off for a moment, then starts anew).
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.participant import BusFrame, Happening
from firmware_py.quantity import Setting

BOOT_NS = 1_500_000_000
"""How long a reset node is off."""
REMIND_NS = 10_000_000_000
"""A second talker on one's own identifier is told again after this."""

COMMON_FAULTS = (
    Phrase("", "silent", "sends nothing"),
    Phrase("", "frozen", "its program stands: it repeats what it sent last and hears nothing"),
    Phrase("", "reset", f"is off for {BOOT_NS / 1e9:g} s and starts anew", lasts=False),
    Phrase("", WORKS, "ends the faults above", lasts=False),
)
BABBLING = Phrase("", "babbling", "sends everything at every tick")
WRONG_COUNTER = Phrase("", "wrong counter", "the counter of its status stands still, the rest is right")
"""Faults that every node knows, but tells only where no subclass has another kind of them."""


class Node:
    """Base of the nodes. A subclass names its DBC node, messages, faults and settings, and gives the five methods at the end.

    DBC: the file that defines it; MORE_DBC: further ones with messages that it sends or hears.

    name: how scenarios and stories call it. codec: of the DBC files it speaks. start_ns: when it is switched on.
    """

    TICK_NS: ClassVar[int] = 20_000_000
    DBC: ClassVar[str] = ""
    MORE_DBC: ClassVar[tuple[str, ...]] = ()
    DBC_NODE: ClassVar[str] = ""
    SENDS: ClassVar[tuple[str, ...]] = ()
    HEARS: ClassVar[tuple[str, ...]] = ()
    FAULTS: ClassVar[tuple[Phrase, ...]] = COMMON_FAULTS
    ORDERS: ClassVar[tuple[Phrase, ...]] = ()
    SETTINGS: ClassVar[tuple[Setting, ...]] = ()

    def __init__(self, name: str, codec: Codec, *, start_ns: int = 0):
        self.name = name
        self.codec = codec
        self.powered = True
        self.short_frames = 0
        self._frozen = False
        self._silent = False
        self._floods = self._miscounts = False
        self._next_tick_ns = start_ns
        self._boots_ns: int | None = None
        self._due_ns = dict.fromkeys(self.SENDS, start_ns)
        self._first_due_ns = start_ns
        self._identifiers = {message: codec.identifier(message) for message in self.SENDS}
        self._cycles_ns = {message: codec.cycle_ns(message) for message in self.SENDS}
        self._sent: dict[str, BusFrame] = {}
        self._heard = {codec.identifier(message): message for message in self.HEARS}
        self._own = {codec.identifier(message): message for message in self.SENDS
                     if codec.senders(message) == (self.DBC_NODE,)}
        self._reminded_ns: int | None = None
        self._happenings: list[Happening] = []

    # --- participant ------------------------------------------------------------------------------------------------------

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """Hear a frame; one that is shorter than its definition is ignored and counted."""
        message = self._heard.get((can_id, extended))
        if message is None:
            if (can_id, extended) in self._own:
                self._second_talker(t_ns, self._own[can_id, extended])
            return
        if not self.powered or self._frozen:
            return
        values = self.codec.decode(message, data)
        if values is None:
            self.short_frames += 1
        else:
            self.hear(t_ns, message, values)

    def hears(self, can_id: int, extended: bool) -> bool:
        """Messages of `HEARS`; and its own, which nobody else should send."""
        return (can_id, extended) in self._heard or (can_id, extended) in self._own

    def step(self, now_ns: int) -> list[BusFrame]:
        """All ticks up to now, and the frames that are due."""
        due: dict[str, None] = {}
        while self._next_tick_ns <= now_ns:
            t_ns = self._next_tick_ns
            self._next_tick_ns = t_ns + self.TICK_NS
            if self._boots_ns is not None and t_ns >= self._boots_ns:
                self._boot(t_ns)
            self.tick(t_ns)
            if t_ns >= self._first_due_ns:
                self._fall_due(t_ns, due)
        if self._floods:
            due = dict.fromkeys(self.SENDS)
        if not due:
            return []
        return [frame for message in due if (frame := self._frame(message)) is not None]

    def _fall_due(self, t_ns: int, due: dict[str, None]) -> None:
        """Note the messages whose time has come."""
        first_ns = t_ns + max(self._cycles_ns.values(), default=0)
        for message, due_ns in self._due_ns.items():
            if t_ns >= due_ns:
                due_ns = self._due_ns[message] = due_ns + self._cycles_ns[message]
                due[message] = None
            if due_ns < first_ns:
                first_ns = due_ns
        self._first_due_ns = first_ns

    def next_deadline(self) -> int | None:
        """The next tick."""
        return self._next_tick_ns

    def take_happenings(self) -> list[Happening]:
        """What happened since the last call."""
        if not self._happenings:
            return []
        happenings, self._happenings = self._happenings, []
        return happenings

    @property
    def sends(self) -> bool:
        """Whether anything leaves it."""
        return self.powered and not self._silent

    @property
    def talks(self) -> bool:
        """Whether what leaves it is what it knows: not silent, not frozen, not off."""
        return self.powered and not self._silent and not self._frozen

    @property
    def is_believed(self) -> bool:
        """Whether it talks, and nothing is wrong with the counter, or the checksum, of its status."""
        return self.talks and not self._miscounts

    # --- faults -----------------------------------------------------------------------------------------------------------

    def inject(self, now_ns: int, statement: Statement) -> None:
        """Make something of `FAULTS` happen. Raises ValueError when it isn't one of them."""
        self.tell(now_ns, f"{statement} again" if statement.action == WORKS else f"fault: {statement}")
        if statement.device:
            self.fault(now_ns, statement)
            return
        match statement.action:
            case "silent":
                self._silent = True
            case "frozen":
                self._frozen = True
            case "reset":
                self._boots_ns = now_ns + BOOT_NS
                self.powered = False
            case "works":
                self._silent = self._frozen = self._floods = self._miscounts = False
            case _:
                self.fault(now_ns, statement)

    def tell(self, t_ns: int, text: str) -> None:
        """Record something worth telling."""
        self._happenings.append(Happening(t_ns, self.name, text))

    # --- within -----------------------------------------------------------------------------------------------------------

    def _boot(self, t_ns: int) -> None:
        self._boots_ns = None
        self.powered = True
        self._sent.clear()
        self._silent = self._frozen = self._floods = self._miscounts = False
        self.restart(t_ns)
        self.tell(t_ns, "starts anew")

    def _frame(self, message: str) -> BusFrame | None:
        if self._silent or not self.powered:
            return None
        if self._frozen:
            return self._sent.get(message)
        values = self.values(message)
        if values is None:
            return None
        can_id, extended = self._identifiers[message]
        frame = BusFrame(can_id, extended, self.codec.encode(message, values))
        self._sent[message] = frame
        return frame

    def _second_talker(self, t_ns: int, message: str) -> None:
        if self._reminded_ns is None or t_ns - self._reminded_ns >= REMIND_NS:
            self._reminded_ns = t_ns
            self.tell(t_ns, f"hears its own {message} from somebody else: is this node started twice?")

    # --- for subclasses ---------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """A message of `HEARS` has come."""

    def tick(self, t_ns: int) -> None:
        """Compute protocol and plant; also called while `powered` is False, for the plant's sake."""
        raise NotImplementedError

    def values(self, message: str) -> Mapping[str, Value] | None:
        """Every signal of a message that is due, or None to send nothing."""
        raise NotImplementedError

    def restart(self, t_ns: int) -> None:
        """Begin anew after a reset; the plant is where it was."""
        raise NotImplementedError

    def fault(self, now_ns: int, statement: Statement) -> None:
        """Make one of the node's own faults happen. Raises ValueError for one it doesn't know."""
        match statement.device, statement.action:
            case "", BABBLING.action:
                self._floods = True
            case "", WRONG_COUNTER.action:
                self._miscounts = True
            case _:
                raise ValueError(f"{self.name} knows no fault {statement}")

    def count(self, counter: int) -> int:
        """What a counter of 4 bits says after this value."""
        return counter if self._miscounts else (counter + 1) % 16
