"""Which events to send, and when: those of the journal that level 2 has not acknowledged (DESIGN §6).

Theory of operation. The journal is the outbox; nothing is copied. A connection divides it at a mark, its last event at
that moment: what comes later is *fresh* and goes first, what was there before is *backlog*, goes oldest first, at a
bounded rate, and says `historical`. A sent event is *in flight* until an acknowledgement names it, at most `window` of
them; after a time without one it is sent again, each time later, with jitter, so that a fleet doesn't answer in step.

An acknowledgement counts only for what this process sent: whatever else it names is still there, and is sent.
No clock and no network here; the journal is read, `Delivered` written.
"""
from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from enum import Enum
from typing import NamedTuple

from bridge.delivered import Delivered
from bridge.ranges import Ranges
from level1.event import Event
from level1.io.journal import FIRST, Position, Reader

WINDOW = 32
"""Events in flight at most."""
RESERVED = 4
"""One part in so many of the window is for fresh events alone: a backlog that a poor link doesn't take must not hold them up."""
RETRY_NS = 2_000_000_000
"""Wait for the first acknowledgement; doubled each time, up to `RETRY_LONGEST_NS`, give or take `JITTER`."""
RETRY_LONGEST_NS = 60_000_000_000
JITTER = 0.25
BACKLOG_PER_S = 100
"""Backlog events a second: a week's events leave in minutes, and leave room for the fresh ones of a whole fleet."""
FRESH = 100
"""With more fresh events than this waiting, they are backlog: the link is poor, and the newest must not wait for them."""
ASKED = 64
"""Ranges asked for again that are remembered."""
UNJOURNALED = 10_000
"""Events kept here that the journal can't take, at most."""


class Verdict(Enum):
    """What became of an acknowledgement."""

    NEW = "new"
    NOTHING_NEW = "nothing new"
    BACKWARDS = "names less than an earlier one"
    NEVER_SENT = "names events that never were"


class Delivery(NamedTuple):
    """An event to send now; see `wire.Alarm` for prev and historical."""

    event: Event
    prev: int
    historical: bool


class _Flight:
    __slots__ = ("delivery", "due_ns", "tries")

    def __init__(self, delivery: Delivery, due_ns: int):
        self.delivery = delivery
        self.due_ns = due_ns
        self.tries = 1


class Outbox:
    """The unacknowledged events of a journal. Times are nanoseconds of one monotonic clock, the caller's."""

    def __init__(self, journal: Reader, delivered: Delivered, *, window: int = WINDOW, retry_ns: int = RETRY_NS,
                 backlog_per_s: float = BACKLOG_PER_S, jitter: random.Random | None = None):
        self._journal, self._delivered = journal, delivered
        self._window, self._retry_ns = window, retry_ns
        self._backlog_ns = int(1e9 / backlog_per_s)
        self._jitter = jitter or random.Random()
        self._flights: dict[Position, _Flight] = {}
        self._sent: dict[int, Ranges] = {}
        self._acknowledged: dict[int, int] = {}
        self._unjournaled: dict[Position, Event] = {}
        self._asked: dict[int, Ranges] = {}
        self._mark = self._backlog_at = self._fresh_at = FIRST
        self._backlog_due_ns = self._heard_ns = 0
        self._backlog_ended = False

    def connected(self, now_ns: int) -> None:
        """A connection is there: everything unacknowledged is backlog and goes out anew."""
        self._flights.clear()
        self._mark_here()
        self._backlog_at, self._backlog_ended = FIRST, False
        self._backlog_due_ns = now_ns

    def due(self, now_ns: int) -> list[Delivery]:
        """What to send now. Counts as sent with the return."""
        deliveries = list(self._again(now_ns))
        if len(self._flights) < self._window:
            deliveries += self._send(self._fresh(self._window - len(self._flights)), now_ns)
        room = min(self._backlog_room, self._backlog_allowed(now_ns))
        if room > 0:
            deliveries += self._send(self._backlog(room) if not self._backlog_ended else self._lacking(room), now_ns)
        return deliveries

    def next_due_ns(self) -> int | None:
        """When `due` will have something again, as far as it is known now; new events come on their own."""
        times = [flight.due_ns for flight in self._flights.values()]
        if self._backlog_waits and self._backlog_room > 0:
            times.append(self._backlog_due_ns)
        return min(times, default=None)

    def unjournaled(self, events: Iterable[Event]) -> None:
        """Events the journal can't take now; they leave all the same."""
        for event in events:
            if len(self._unjournaled) < UNJOURNALED and event.seq not in self._delivered.of(event.boot):
                self._unjournaled[event.boot, event.seq] = event

    def acknowledge(self, boot: int, upto: int, also: Iterable[tuple[int, int]] = ()) -> Verdict:
        """Level 2 has committed the seqs up to one, and ranges above it, of a boot."""
        pairs = [(first, last) for first, last in ((1, upto), *also) if first <= last]
        if not pairs:
            return Verdict.NOTHING_NEW
        if max(last for _, last in pairs) > self._last_seq(boot):
            return Verdict.NEVER_SENT
        backwards = upto < self._acknowledged.get(boot, 0)
        self._acknowledged[boot] = max(upto, self._acknowledged.get(boot, 0))
        delivered, sent = self._delivered.of(boot), self._sent.get(boot, Ranges())
        covered = Ranges(part for pair in pairs for part in sent.common(*pair))
        for waiting in (self._flights, self._unjournaled):
            for position in [position for position in waiting if position[0] == boot and position[1] in covered]:
                waiting.pop(position)
        new = Ranges(gap for part in covered for gap in delivered.missing(*part))
        if not len(new):
            return Verdict.BACKWARDS if backwards else Verdict.NOTHING_NEW
        self._delivered.add(boot, new)
        return Verdict.NEW

    def heard(self, now_ns: int) -> None:
        """Level 2 is there. If it was quiet, what would wait for it ever longer is sent again within the first patience."""
        for flight in self._flights.values() if now_ns - self._heard_ns > 2 * self._retry_ns else ():
            if flight.tries > 1:
                flight.tries = 1
                flight.due_ns = min(flight.due_ns, now_ns + int(self._retry_ns * self._jitter.random()))
        self._heard_ns = now_ns

    def ask(self, boot: int, ranges: Iterable[tuple[int, int]]) -> None:
        """Level 2 lacks these, acknowledged or not (it may have lost its disk): they are sent again at the backlog's rate.

        What was never acknowledged comes anyhow, and ranges beyond `ASKED` at a time have to be asked for again.
        """
        delivered, asked = self._delivered.of(boot), self._asked.setdefault(boot, Ranges())
        for pair in ranges:
            for part in delivered.common(*pair):
                if len(asked) < ASKED:
                    asked.add(*part)

    def waiting(self) -> int:
        """Events of the journal and beside it that level 2 has not acknowledged; an upper bound where seqs are lost."""
        total = sum(last - self._delivered.of(boot).count() for boot, last in self._journal.last_seqs().items())
        return max(0, total) + sum(1 for position in self._unjournaled if position > self._journal.last())

    @property
    def in_flight(self) -> int:
        """Events sent and not yet acknowledged."""
        return len(self._flights)

    def _again(self, now_ns: int) -> Iterator[Delivery]:
        for flight in self._flights.values():
            if flight.due_ns <= now_ns:
                flight.due_ns = now_ns + self._patience_ns(flight.tries)
                flight.tries += 1
                yield flight.delivery

    def _send(self, deliveries: Iterable[Delivery], now_ns: int) -> Iterator[Delivery]:
        for delivery in deliveries:
            event = delivery.event
            self._flights[event.boot, event.seq] = _Flight(delivery, now_ns + self._patience_ns(0))
            self._sent.setdefault(event.boot, Ranges()).add(event.seq, event.seq)
            yield delivery

    def _patience_ns(self, tries: int) -> int:
        longest = min(self._retry_ns << min(tries, 32), RETRY_LONGEST_NS)
        return int(longest * self._jitter.uniform(1 - JITTER, 1 + JITTER))

    def _fresh(self, room: int) -> Iterator[Delivery]:
        """Events since the mark: those of the journal, then those it can't take."""
        events = self._undelivered(self._fresh_at, room)
        if len(events) == room and len(self._journal.events(self._fresh_at, FRESH + 1)) > FRESH:
            self._mark_here()
            self._backlog_ended = False
            events = []
        for event in events:
            self._fresh_at = (event.boot, event.seq)
            if self._fresh_at not in self._flights:
                yield self._delivery(event, False)
        beside = [event for position, event in self._unjournaled.items() if position not in self._flights]
        yield from (Delivery(event, event.seq - 1, False) for event in beside[:max(0, room - len(events))])

    def _backlog(self, room: int) -> Iterator[Delivery]:
        """Events up to the mark, oldest first."""
        events = self._undelivered(self._backlog_at, room)
        for event in events:
            position = (event.boot, event.seq)
            if position > self._mark:
                break
            self._backlog_at = position
            self._backlog_due_ns += self._backlog_ns
            if position not in self._flights:
                yield self._delivery(event, True)
        else:
            if events:
                return
        self._backlog_ended = True

    def _lacking(self, room: int) -> Iterator[Delivery]:
        """Acknowledged events that level 2 asked for again, as far as the journal still has them."""
        for boot, asked in list(self._asked.items()):
            for first, last in list(asked)[:1]:
                events = self._journal.events((boot, first - 1), room, before=(boot, last + 1))
                end = events[-1].seq if len(events) == room else last
                self._asked[boot] = Ranges(asked.common(end + 1, asked.last))
                for event in events:
                    self._backlog_due_ns += self._backlog_ns
                    if (event.boot, event.seq) not in self._flights:
                        yield self._delivery(event, True)
                return
            del self._asked[boot]

    @property
    def _backlog_room(self) -> int:
        return self._window - self._window // RESERVED - len(self._flights)

    @property
    def _backlog_waits(self) -> bool:
        return not self._backlog_ended or bool(self._asked)

    def _backlog_allowed(self, now_ns: int) -> int:
        """How many backlog events the rate allows now; unused time is worth one window at most."""
        if not self._backlog_waits:
            return 0
        self._backlog_due_ns = max(self._backlog_due_ns, now_ns - self._window * self._backlog_ns)
        return (now_ns - self._backlog_due_ns) // self._backlog_ns + 1 if now_ns >= self._backlog_due_ns else 0

    def _undelivered(self, after: Position, count: int) -> list[Event]:
        """Up to `count` events after a position that are not acknowledged; passes over long acknowledged stretches."""
        found: list[Event] = []
        while len(found) < count:
            boot, seq = after
            if seq + 1 in self._delivered.of(boot):
                after = (boot, self._delivered.of(boot).around(seq + 1)[1])
            events = self._journal.events(after, count)
            found += [event for event in events if event.seq not in self._delivered.of(event.boot)]
            if len(events) < count:
                break
            after = (events[-1].boot, events[-1].seq)
        return found[:count]

    def _delivery(self, event: Event, historical: bool) -> Delivery:
        return Delivery(event, self._journal.seq_before((event.boot, event.seq)), historical)

    def _mark_here(self) -> None:
        self._mark = self._fresh_at = self._journal.last()

    def _last_seq(self, boot: int) -> int:
        beside = max((seq for of, seq in self._unjournaled if of == boot), default=0)
        return max(self._journal.last_seq(boot), beside)
