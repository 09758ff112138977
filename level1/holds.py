"""Command messages while repairs own them: who holds which, what was commanded, and the repetition at the cycle time.

Other programs of the UCS send the same messages; while a repair owns one they stop (DESIGN §5), so it is repeated here. What
a step does not name keeps what was last commanded: by the repair itself while it owns the message, else by whomever.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from level1.board import Board
from level1.catalog import Catalog, Message
from level1.decode import encode
from level1.event import SentFrame
from level1.expression import ResendStep, SendStep, Step
from level1.gate import Refused
from level1.timer import FAR, Timers

Transmit = Callable[[int, str, bytes, str, bool], None]


class Owner(Protocol):
    """A repair. rank: higher takes a message from lower."""

    @property
    def name(self) -> str:
        """Its alarm."""

    @property
    def rank(self) -> int:
        """Of its priority."""

    def taken(self, t_ns: int, by: str) -> None:
        """Another of higher rank has taken a message."""


class Hold:
    """One command message. payload: what the owner sent last; before: what was commanded before the episode, None if nothing."""

    __slots__ = ("before", "due", "holds", "message", "order", "owner", "payload")

    def __init__(self, holds: Holds, message: Message, order: int):
        self.holds = holds
        self.message = message
        self.order = order
        self.due = FAR
        self.owner: Owner | None = None
        self.payload = b""
        self.before: bytes | None = None

    def expire(self, now_ns: int) -> None:
        """Repeat it."""
        self.holds.repeat(self, now_ns)


class Holds:
    """All command messages of a unit. transmit(t_ns, message, payload, reason, safe) sends, or raises gate.Refused; fits(message,
    payload): whether all its values are within their limits; freed(t_ns) is told when messages have been handed back."""

    def __init__(self, catalog: Catalog, board: Board, timers: Timers, transmit: Transmit, fits: Callable[[str, bytes], bool],
                 freed: Callable[[int], None], counters: Counter[str]):
        self.catalog = catalog
        self.board = board
        self.timers = timers
        self.counters = counters
        self._transmit = transmit
        self._fits = fits
        self._freed = freed
        self._holds: dict[str, Hold] = {}

    def owner(self, message: str) -> Owner | None:
        """Who owns a message now."""
        hold = self._holds.get(message)
        return hold.owner if hold is not None else None

    def is_cyclic(self, message: str) -> bool:
        """Whether a command has a cycle time."""
        return bool(self.catalog.messages[message].cycle_ns)

    def claim(self, owner: Owner, t_ns: int, messages: Sequence[str]) -> str:
        """Own messages, all or none; from a repair of lower rank they are taken. Gives the alarm that keeps one, else ""."""
        holds = [self._hold(name) for name in messages]
        for hold in holds:
            if hold.owner is not None and hold.owner is not owner and hold.owner.rank >= owner.rank:
                return hold.owner.name
        losers = []
        for hold in holds:
            if hold.owner is not owner:
                if hold.owner is not None:
                    losers.append(hold.owner)
                hold.payload = b""
                hold.due = FAR
                hold.before = self.last_command(hold.message.name)
                hold.owner = owner
        for loser in dict.fromkeys(losers):
            loser.taken(t_ns, owner.name)
        return ""

    def release(self, owner: Owner, t_ns: int, but: Sequence[str] = ()) -> None:
        """Hand messages back, but not these, and let those who wait for one try again."""
        freed = [hold for hold in self._holds.values() if hold.owner is owner and hold.message.name not in but]
        for hold in freed:
            hold.owner = None
            hold.payload = b""
            hold.due = FAR
        if freed:
            self._freed(t_ns)

    def restore(self, owner: Owner, t_ns: int) -> None:
        """Return a repair's messages to what was commanded before the episode, where anyone did."""
        for hold in self._holds.values():
            if hold.owner is owner and hold.before is not None:
                hold.payload = hold.before
                self.repeat(hold, t_ns)

    def repeat(self, hold: Hold, t_ns: int) -> None:
        """Send a held message again, and so on at its cycle time."""
        if hold.owner is None:
            return
        try:
            self._transmit(t_ns, hold.message.name, hold.payload, f"held by the repair of {hold.owner.name}", False)
        except Refused:
            self.counters["frames refused by the gate"] += 1
        if hold.message.cycle_ns:
            self.timers.set(hold, t_ns + hold.message.cycle_ns)

    def transmit(self, owner: Owner, t_ns: int, step: SendStep | ResendStep, *, safe: bool = False) -> None:
        """Send a step's frame now, and go on repeating it at its cycle time while the episode lasts. Raises Refused.

        safe: a step into the safe state, which other frames of the same message, however many, don't hold up."""
        hold = self._hold(step.message)
        own = hold.owner is owner and hold.payload
        payload = self._payload(step, hold.payload if own else self.last_command(step.message))
        self._transmit(t_ns, step.message, payload, f"repair of {owner.name}", safe)
        hold.payload = payload
        if hold.message.cycle_ns:
            self.timers.set(hold, t_ns + hold.message.cycle_ns)

    def preview(self, steps: Sequence[Step]) -> tuple[SentFrame, ...]:
        """The frames that steps would send from here, one after the other."""
        frames = []
        payloads: dict[str, bytes] = {}
        for step in steps:
            if isinstance(step, (SendStep, ResendStep)):
                message = self.catalog.messages[step.message]
                base = payloads.get(step.message, self.last_command(step.message))
                if isinstance(step, SendStep):
                    base = encode(message, step.values, base)
                if base is not None:
                    payloads[step.message] = base
                    frames.append(SentFrame(step.message, f"{message.can_id:0{8 if message.extended else 3}X}", base.hex().upper()))
        return tuple(frames)

    def last_command(self, name: str) -> bytes | None:
        """The payload last commanded by whomever, as long as it still counts; None: nobody commands this now, or out of its limits,
        which no frame of ours may repeat: a stranger's nonsense must not keep a valve from being closed."""
        page = self.board.page(name)
        if page.level < 0 or (page.stale_level and page.level >= page.stale_level) or len(page.data) != page.message.length:
            return None
        return page.data if self._fits(name, page.data) else None

    def _hold(self, name: str) -> Hold:
        if name not in self._holds:
            self._holds[name] = Hold(self, self.catalog.messages[name], self.timers.order())
        return self._holds[name]

    def _payload(self, step: SendStep | ResendStep, last: bytes | None) -> bytes:
        if isinstance(step, SendStep):
            return encode(self.catalog.messages[step.message], step.values, last)
        if last is None:
            raise Refused(f"nobody has commanded {step.message} lately: there is nothing to send again")
        return last
