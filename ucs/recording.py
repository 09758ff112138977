"""One recording run through a supervisor of its own, and what came of it."""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from level1.catalog import NORMAL, Catalog
from level1.event import Event, Output, Send, decode
from level1.frame import Frame
from level1.freeze_frame import STATE_WORDS
from level1.io.merged import MergedLog
from level1.io.replay import Log
from level1.supervisor import Supervisor
from ucs.remarks import remarks

if TYPE_CHECKING:
    from level1.sieve import Sieve

UNIT, BOOT = "replay", 1
"""Identity of a replay's events; every recording is a run of its own, so that it gives the same bytes beside others."""
Through = Callable[[Iterator[list[Frame]]], Iterator[list[Frame]]]


class Outcome(msgspec.Struct, frozen=True):
    """What came of a recording. events: JSON lines. standing: state of each alarm that is not normal at the end. sends: frames that
    repairs would have sent. remarks: what was odd. error: why the recording could not be used, else empty."""

    path: str
    events: tuple[bytes, ...] = ()
    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0
    skipped: int = 0
    standing: dict[str, str] = {}
    sends: int = 0
    remarks: tuple[str, ...] = ()
    error: str = ""

    def decoded(self) -> list[Event]:
        """The events."""
        return [decode(line) for line in self.events]

    @property
    def hours(self) -> float:
        """Length of the recording."""
        return (self.last_ns - self.first_ns) / 3.6e12


class Replay:
    """A recording run through a supervisor of its own.

    through: what takes the batches of frames on their way and hands them on (plays, draws), None for nothing.
    blocks: frames in columns (`level1.sieve`) or one by one, which gives the same events; None: whatever is sooner done.
    counts: (alarm, event) -> how often. sends: frames that repairs would have sent. keys: of all frames seen.
    """

    def __init__(self, log: Log | MergedLog, catalog: Catalog, armed: Collection[str] | None, through: Through | None = None,
                 blocks: bool | None = None):
        self.log = log
        self.through = through
        self.supervisor = Supervisor(catalog, unit=UNIT, boot=BOOT, armed=armed, broadcast=False)
        self._sieve: Sieve | None = None
        if through is None and (log.is_long if blocks is None else blocks):
            from level1.sieve import Sieve  # numpy takes a tenth of a second to import
            self._sieve = Sieve(self.supervisor)
        self.counts: Counter[tuple[str, str]] = Counter()
        self.sends = 0
        self.keys: set[int] = set()

    def batches(self) -> Iterator[list[Event]]:
        """The events, a list for each batch of frames; ends with the deadlines up to the last time stamp."""
        for outputs in self._in_blocks(self._sieve) if self._sieve else self._one_by_one():
            yield self._events(outputs)
        yield self._events(self.supervisor.tick(self.log.last_ns))

    def _one_by_one(self) -> Iterator[Sequence[Output]]:
        batches = self.log.batches()
        for batch in self.through(batches) if self.through else batches:
            self._begin()
            self.keys.update([frame.key for frame in batch])
            yield self.supervisor.receive_many(batch)

    def _in_blocks(self, sieve: Sieve) -> Iterator[Sequence[Output]]:
        for block in self.log.blocks():
            self._begin()
            self.keys.update(block.keys)
            yield sieve.receive(block)

    def _begin(self) -> None:
        """The first time stamp has been read: is it of the wall clock?"""
        if self.log.is_utc:
            self.supervisor.utc_offset_ns = 0

    def outcome(self, asked: Iterable[str], events: tuple[bytes, ...] = ()) -> Outcome:
        """What came of it, once all batches were taken. asked: channels that the user named."""
        log, supervisor = self.log, self.supervisor
        standing = {name: STATE_WORDS[state] for name, state in supervisor.alarm_states().items() if state != NORMAL}
        told = tuple(remarks(log, supervisor.counters, self.keys, supervisor.catalog, asked))
        return Outcome(str(log.path), events, log.frames_read, log.first_ns, log.last_ns, log.skipped, standing, self.sends,
                              told)

    def _events(self, outputs: Iterable[Any]) -> list[Event]:
        events = []
        for output in outputs:
            if isinstance(output, Event):
                self.counts[output.alarm, output.event] += 1
                events.append(output)
            else:
                self.sends += isinstance(output, Send)
        return events
