"""The board: what is known of every signal in use, when it came, and how good it is.

Theory of operation. A *cell* holds the present class of one thing a condition can ask for (a signal, the silence of a
message, the time a value has been held, the state of an alarm …). A *page* is a message as received (one page for each
multiplexer branch): its last payload, its time, its decoder. Frames and deadlines move cells from class to class; a move
queues the *watches* (conditions) that read the cell, and `settle` evaluates each queued watch once, in a fixed order, when
all signals of a frame are in place. Unchanged payloads only refresh the time of their page.

Time never enters by counting frames: silence and age are deadlines (`timer`). A frame moves none of them: a *watchdog* looks
now and then which messages may fall silent before it looks again, and gives only those a deadline of their own.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any

from level1.catalog import STALE_CYCLES, Catalog, Message, Signal
from level1.decode import (
    GOOD,
    NEVER,
    OLD,
    SHORT,
    Classes,
    FloatClasses,
    RawValue,
    Scale,
    compile_handler,
    raw_of,
)
from level1.frame import BUS_SHIFT, EXTENDED, REMOTE, frame_key, j1939_pgn
from level1.frame import ERROR as ERROR_FRAME
from level1.protection import Protection
from level1.timer import FAR, Timers

BAD = (0, 2, 3, 2, 2, 3, 3, 3)
"""Verdict a quality forces on arithmetic: 0 none, 2 STALE, 3 ERROR (numbers of `condition.Verdict`)."""
ALWAYS: Any = object()
"""Stands for a last payload that equals no other: every frame is decoded."""
MAX_KEYS = 65_536
"""Identifiers remembered as nobody's: a babbling node with random 29-bit identifiers must not fill the memory."""
MAX_ROUNDS = 64
"""Rounds of evaluation at one instant before conditions that feed each other are left for the next input."""

Listener = Callable[[int, int, bytes], None]
"""listener(t_ns, key, data): told of every frame."""
_index = attrgetter("index")


class Watch:
    """A compiled condition in use. evaluate(): its present outcome, a small integer; sink(t_ns, outcome): told when it changes."""

    __slots__ = ("evaluate", "index", "outcome", "sink")

    def __init__(self, index: int, evaluate: Callable[[], int], sink: Callable[[int, int], None], outcome: int):
        self.index = index
        self.evaluate = evaluate
        self.sink = sink
        self.outcome = outcome


class Cell:
    """One thing a condition can ask for. k: index of its present class, for lookup in the condition's tables.

    Signals: classes of `decode.Classes`, then one class for each quality that has no raw value (see `signal_class`).
    bad, value: for arithmetic, kept only while `exact`.
    """

    __slots__ = ("bad", "base", "changed_ns", "classes", "exact", "held", "hi", "k", "lo", "message", "name", "page", "rate",
                 "raw", "scale", "signal", "value", "watches")

    def __init__(self, name: str, k: int):
        self.name = name
        self.k = k
        self.base = 0
        self.bad = BAD[NEVER]
        self.value: int | float = 0
        self.watches: list[Watch] = []
        self.exact = False
        self.lo: RawValue = 1
        self.hi: RawValue = 0
        self.raw: RawValue | None = None
        self.signal: Signal
        self.message: Message
        self.page: Page
        self.classes: Classes
        self.scale: Scale
        self.held: Held | None = None
        self.rate: Rate | None = None

    @property
    def quality(self) -> int:
        """Quality of a signal's present sample."""
        if self.k >= self.base:
            return self.k - self.base
        return self.classes.quality[self.k]

    def set_class(self, raw: RawValue) -> None:
        """Put a signal into the class of a raw value."""
        classes = self.classes
        k = self.k = classes.of(raw)
        self.lo, self.hi = classes.low[k], classes.high[k]

    def set_value(self, raw: RawValue) -> None:
        """Give an exact signal a raw value."""
        classes = self.classes
        k = self.k = classes.of(raw)
        self.lo = self.hi = self.raw = raw
        self.bad = BAD[classes.quality[k]]
        self.value = self.scale.physical(raw)


class Page:
    """A message as received. seen: its last payload (None: none yet, or none for so long that it counts as silent;
    ALWAYS: decode every frame). integrity: class = quality that counter and checksum give. level: how many of `limits`
    (ns of silence, rising) have passed; -1 before the first frame."""

    __slots__ = ("always", "board", "branches", "cells", "data", "decode", "due", "handle", "integrity", "level", "limits",
                 "message", "order", "others", "owner", "presence", "protection", "seen", "selector", "stale_level", "t_ns",
                 "watchdog")

    def __init__(self, board: Board, message: Message):
        self.board = board
        self.message = message
        self.order = board.timers.order()
        self.due = FAR
        self.seen: Any = None
        self.data = b""
        self.t_ns = 0
        self.level = -1
        self.limits: list[int] = []
        self.stale_level = 0
        self.presence = Cell(message.name, 0)
        self.integrity = Cell(message.name, NEVER)
        self.protection = Protection.of(message)
        self.always = self.protection is not None
        self.cells: list[Cell] = []
        self.handle: Callable[[int, bytes], None] = _ignore
        self.decode: Callable[[int, bytes], None] = _ignore
        self.branches: dict[str, list[Page]] = {}
        self.selector: tuple[Signal, frozenset[int]] | None = None
        self.owner: int | None = None
        self.others: list[int] = []
        self.watchdog: Watchdog | None = None

    def receive(self, t_ns: int, data: bytes) -> None:
        """A frame of this message; `Supervisor.receive_many` has the same in line."""
        self.t_ns = t_ns
        if self.seen != data:
            if self.seen is None:
                self.heard()
            self.data = data
            self.seen = ALWAYS if self.always else data
            self.handle(t_ns, data)

    def heard(self) -> None:
        """First frame, or first after a silence."""
        self.level = 0
        self.move_presence(0)
        if self.protection is not None:
            self.protection.restart()
        if self.watchdog is not None:
            self.board.timers.set(self, self.t_ns + self.limits[0])
            self.watchdog.wake(self.t_ns)

    def expire(self, now_ns: int) -> None:
        """A limit of silence has passed, unless frames have moved `t_ns` since: then the watchdog sees to the next deadline."""
        if self.t_ns + self.limits[self.level] > now_ns:
            return
        self.level += 1
        self.move_presence(self.level)
        if self.level == self.stale_level:
            self.board.lose(self)
        if self.level < len(self.limits):
            self.board.timers.set(self, self.t_ns + self.limits[self.level])
        self.seen = None

    def move_presence(self, k: int) -> None:
        """Enter a class of silence."""
        if self.presence.k != k:
            self.presence.k = k
            self.board.queue(self.presence)

    def check(self, t_ns: int, data: bytes) -> None:
        """Decode a protected frame if its counter and checksum are right; else its signals are errors."""
        assert self.protection is not None
        quality = self.protection.check(data)
        self.move_integrity(quality)
        if quality == GOOD:
            self.decode(t_ns, data)
            return
        self.board.counters["frames with a wrong counter or checksum"] += 1
        for cell in self.all_cells():
            self.board.spoil(cell, quality)

    def all_cells(self) -> Iterator[Cell]:
        """Its signals, those of its multiplexer branches too."""
        yield from self.cells
        for pages in self.branches.values():
            for page in pages:
                yield from page.all_cells()

    def move_integrity(self, k: int) -> None:
        """Enter a class of integrity."""
        if self.integrity.k != k:
            self.integrity.k = k
            self.board.queue(self.integrity)

    def select(self, t_ns: int, data: bytes) -> None:
        """Hand the frame to the branches its multiplexers name."""
        for pages in self.branches.values():
            for page in pages:
                assert page.selector is not None
                if raw_of(page.selector[0], data) in page.selector[1]:
                    page.receive(t_ns, data)


class Watchdog:
    """Watches over all pages with the same first limit of silence, so that their frames need not move a deadline.

    It makes a round each three fifths of the limit. A page whose limit ends by the next round gets its exact deadline; the
    others cost one comparison a round. On a healthy bus they are all others: a cyclic message is one cycle old at most, so
    that a limit of three cycles leaves two, and the next round is due in 1.8. It rests while all of its pages are silent.
    """

    __slots__ = ("due", "limit_ns", "order", "pages", "period_ns", "timers")

    def __init__(self, timers: Timers, limit_ns: int):
        self.timers = timers
        self.order = timers.order()
        self.due = FAR
        self.limit_ns = limit_ns
        self.period_ns = max(1, limit_ns * 3 // 5)
        self.pages: list[Page] = []

    def wake(self, t_ns: int) -> None:
        """A page has been heard again."""
        if self.due == FAR:
            self.timers.set(self, t_ns + self.period_ns)

    def expire(self, now_ns: int) -> None:
        """Make a round."""
        next_ns = now_ns + self.period_ns
        last_heard_ns = next_ns - self.limit_ns
        awake = False
        for page in self.pages:
            if page.t_ns > last_heard_ns:
                awake = True
            elif page.level == 0:
                awake = True
                self.timers.set(page, page.t_ns + self.limit_ns)
        if awake:
            self.timers.set(self, next_ns)


class Tap:
    """Listens to every frame of a parameter group or identifier and hands it on to the page of the identifier, if it has one.

    It stands in the table of identifiers like a page that decodes every frame.
    """

    __slots__ = ("always", "data", "handle", "seen", "t_ns")

    def __init__(self, key: int, listen: Listener, page: Page | Tap | None):
        self.always = True
        self.data = b""
        self.t_ns = 0
        self.seen: Any = ALWAYS

        def handle(t_ns: int, data: bytes) -> None:
            listen(t_ns, key, data)
            if page is not None:
                page.receive(t_ns, data)
        self.handle = handle

    def receive(self, t_ns: int, data: bytes) -> None:
        """A frame of this identifier."""
        self.handle(t_ns, data)

    def heard(self) -> None:
        """A tap never counts as silent."""


class Held:
    """How long the value of an exact cell has been the same: a cell whose class is the number of limits passed."""

    __slots__ = ("board", "cell", "due", "level", "limits", "order", "signal_cell", "since_ns")

    def __init__(self, board: Board, signal_cell: Cell):
        self.board = board
        self.order = board.timers.order()
        self.due = FAR
        self.signal_cell = signal_cell
        self.cell = Cell(signal_cell.name, 0)
        self.limits: list[int] = []
        self.level = 0
        self.since_ns = 0

    def restart(self, t_ns: int, bad: int) -> None:
        """The value has changed at t_ns (or is not good: bad 2 STALE, 3 ERROR)."""
        self.since_ns = t_ns
        self.level = 0
        self._move(len(self.limits) + bad - 1 if bad else 0)
        if self.limits and not bad:
            self.board.timers.set(self, t_ns + self.limits[0])
        else:
            self.due = FAR

    def expire(self, now_ns: int) -> None:
        """A limit has passed without a change."""
        self.level += 1
        self._move(self.level)
        if self.level < len(self.limits):
            self.board.timers.set(self, self.since_ns + self.limits[self.level])

    def _move(self, k: int) -> None:
        if self.cell.k != k:
            self.cell.k = k
            self.board.queue(self.cell)


class Rate:
    """Change per second between the last two good samples of a signal, as an exact cell of its own."""

    __slots__ = ("board", "cell", "last", "last_ns")

    def __init__(self, board: Board, name: str):
        self.board = board
        self.cell = Cell(name, 0)
        self.last: int | float | None = None
        self.last_ns = 0

    def sample(self, t_ns: int, value: int | float, bad: int) -> None:
        """A received sample. Two samples with one time stamp count as one (stamps of some recorders have a 1 ms grain)."""
        cell = self.cell
        if bad:
            self.last = None
            cell.bad = bad
        elif self.last is None:
            self.last, self.last_ns = value, t_ns
            cell.bad = 2
        elif t_ns > self.last_ns:
            cell.value = (value - self.last) * 1_000_000_000 / (t_ns - self.last_ns)
            cell.bad = 0
            self.last, self.last_ns = value, t_ns
        self.board.queue(cell)

    def lose(self) -> None:
        """The message has become stale."""
        self.last = None
        self.cell.bad = 2
        self.board.queue(self.cell)


def _ignore(t_ns: int, data: bytes) -> None:
    return None


def _as_it_is(page: Page) -> None:
    """Every frame has been received: there is nothing to bring up to date."""


class Board:
    """All cells and pages, and the evaluation of what they move. Built by `condition`, driven by `supervisor`.

    refresh(page): called before a page is looked at outside of conditions; over recordings, `sieve` then brings it up to date.
    """

    def __init__(self, catalog: Catalog, timers: Timers):
        self.catalog = catalog
        self.timers = timers
        self.counters: Counter[str] = Counter()
        self.cells: dict[str, Cell] = {}
        self.pages: dict[str, Page] = {}
        self.branches: dict[tuple[str, str, tuple[int, ...]], Page] = {}
        self.table: dict[int, Page | Tap | None] = {}
        self.listeners: dict[int, Listener] = {}
        self.identifiers: dict[int, Listener] = {}
        self.newcomer: Callable[[int], Listener | None] = _unnoticed
        self.queued: list[Cell] = []
        self.watches = 0
        self.refresh: Callable[[Page], None] = _as_it_is
        self._by_key: dict[int, list[str]] = {}
        self._by_pgn: dict[tuple[int, int], list[tuple[int | None, str]]] = {}

    # --- building ---------------------------------------------------------------------------------------------------------

    def page(self, message: str) -> Page:
        """The page of a message (its root page when it is multiplexed). Raises KeyError for an unknown one."""
        if message not in self.pages:
            self.pages[message] = Page(self, self.catalog.messages[message])
        return self.pages[message]

    def page_of(self, message: str, signal: Signal) -> Page:
        """The page on which a signal arrives: one for each multiplexer branch, inside that of the multiplexer itself."""
        root = self.page(message)
        if signal.multiplexer_ids is None or signal.multiplexer_signal is None:
            return root
        key = (message, signal.multiplexer_signal, signal.multiplexer_ids)
        if key not in self.branches:
            selector = root.message.signal(signal.multiplexer_signal)
            parent = self.page_of(message, selector)
            page = self.branches[key] = Page(self, root.message)
            page.selector = (selector, frozenset(signal.multiplexer_ids))
            parent.branches.setdefault(selector.name, []).append(page)
            parent.always = True
        return self.branches[key]

    def cell(self, message: str, signal: str) -> Cell:
        """The cell of a signal, made at the first asking; `compile` gives it its classes."""
        name = f"{message}.{signal}"
        if name not in self.cells:
            definition = self.catalog.messages[message].signal(signal)
            cell = self.cells[name] = Cell(name, 0)
            cell.signal = definition
            cell.message = self.catalog.messages[message]
            cell.scale = Scale(definition)
            cell.exact = definition.is_float
            cell.page = self.page_of(message, definition)
            cell.page.cells.append(cell)
        return self.cells[name]

    def held(self, message: str, signal: str) -> Held:
        """The clock beside a signal's value."""
        cell = self.cell(message, signal)
        cell.exact = True
        if cell.held is None:
            cell.held = Held(self, cell)
        return cell.held

    def rate(self, message: str, signal: str) -> Rate:
        """The slope of a signal; every frame of its page is a sample."""
        cell = self.cell(message, signal)
        cell.exact = True
        cell.page.always = True
        if cell.rate is None:
            cell.rate = Rate(self, cell.name)
        return cell.rate

    def set_classes(self, thresholds: dict[str, set[Any]]) -> None:
        """Cut the raw values of every signal in use by the constants it is compared with (cell name -> constants)."""
        for name, cell in self.cells.items():
            if cell.signal.is_float:
                cell.classes = FloatClasses(cell.signal)
            else:
                cell.classes = Classes(cell.signal, cell.message.j1939, () if cell.exact else thresholds.get(name, ()))
            cell.base = len(cell.classes.quality)
            cell.k = cell.base + NEVER
            cell.bad = BAD[NEVER]
            if cell.held is not None:
                cell.held.limits.sort()
                cell.held.cell.k = len(cell.held.limits) + 1
            if cell.rate is not None:
                cell.rate.cell.bad = BAD[NEVER]

    def set_limits(self) -> None:
        """Fix the silence limits of every page: those that conditions named, and the one at which its values are stale."""
        watchdogs: dict[int, Watchdog] = {}
        for page in [*self.pages.values(), *self.branches.values()]:
            stale = self.stale_after(page)
            if stale is not None:
                page.limits.append(stale)
            page.limits = sorted(set(page.limits))
            page.stale_level = page.limits.index(stale) + 1 if stale is not None else 0
            page.presence.k = len(page.limits) + 1
            if page.limits:
                page.watchdog = watchdogs.setdefault(page.limits[0], Watchdog(self.timers, page.limits[0]))
                page.watchdog.pages.append(page)

    def stale_after(self, page: Page) -> int | None:
        """Silence after which the values of a page are stale, ns; None for a message without cycle time.

        The branches of a multiplexer come in turn: each is given as many cycles as there are branches.
        """
        cycle = page.message.cycle_ns
        if not cycle:
            return None
        turns = 1
        if page.selector is not None:
            turns = max(1, sum(1 for key in self.branches if key[:2] == (page.message.name, page.selector[0].name)))
        return STALE_CYCLES * cycle * turns + 1

    def compile(self) -> None:
        """Make the decoders and the table of identifiers. After this the set of cells is fixed."""
        for page in [*self.pages.values(), *self.branches.values()]:
            every = {cell.signal.name for cell in page.cells if cell.rate is not None}
            page.handle = compile_handler(
                page.message, [(cell.signal, cell, self.measure if cell.exact else self.touch) for cell in page.cells],
                self._short_of(page), every, page.select if page.branches else None)
            if page.protection is not None and page.selector is None:
                page.decode, page.handle = page.handle, page.check
        for name in self.pages:
            message = self.catalog.messages[name]
            for bus in self.catalog.buses.get(name, (0,)):
                if message.j1939 and message.pgn is not None:
                    self._by_pgn.setdefault((bus, message.pgn), []).append((message.source, name))
                else:
                    key = frame_key(message.can_id, message.extended, bus)
                    self._by_key.setdefault(key, []).append(name)

    # --- running ----------------------------------------------------------------------------------------------------------

    def listen(self, pgn: int, listener: Listener) -> None:
        """Have listener(t_ns, key, data) called for every frame of a J1939 parameter group."""
        self.listeners[pgn] = listener

    def listen_to(self, can_id: int, listener: Listener) -> None:
        """The same for every data frame of an 11-bit identifier, on any bus."""
        self.identifiers[can_id] = listener

    def listener(self, key: int) -> Listener | None:
        """Who listens to all data frames of an identifier, besides its page."""
        if key & (REMOTE | ERROR_FRAME):
            return None
        return self.listeners.get(j1939_pgn(key & 0x1FFF_FFFF)) if key & EXTENDED else self.identifiers.get(key & 0x7FF)

    def deliver(self, t_ns: int, key: int, data: bytes) -> None:
        """A message that came in several frames, as if it had come in one."""
        page = self.table[key] if key in self.table else self.bind(key)
        if page is not None:
            page.receive(t_ns, data)

    def bind(self, key: int) -> Page | Tap | None:
        """Find the page of an identifier heard for the first time, and remember it; None: no definition asks for it.

        A J1939 message with any source address belongs to the first source that sends it, until that one falls silent:
        two sources that alternate must not make its values flap.
        """
        stranger = self.newcomer(key)
        page: Page | Tap | None = self._find(key)
        for listener in (self.listener(key), stranger):
            if listener is not None:
                page = Tap(key, listener, page)
        if page is None:
            self.counters["ids nobody asks for"] += 1
            if len(self.table) >= MAX_KEYS:
                for nobodys in [known for known, kept in self.table.items() if kept is None]:
                    del self.table[nobodys]
        self.table[key] = page
        return page

    def unbind(self, bus: int, source: int) -> None:
        """Have what comes from a J1939 address met anew."""
        for key in [key for key in self.table if key & EXTENDED and key & 0xFF == source and key >> BUS_SHIFT == bus]:
            del self.table[key]

    def _find(self, key: int) -> Page | None:
        page = self.fixed_page(key)
        for candidate in self.open_pages(key):
            page = page or self._claim(candidate, key)
        return page

    def fixed_page(self, key: int) -> Page | None:
        """The page that an identifier always belongs to, None if there is none."""
        if key in self._by_key:
            return self.pages[self._by_key[key][0]]
        named = [name for source, name in self._candidates(key) if source == key & 0xFF]
        return self.pages[named[-1]] if named else None

    def open_pages(self, key: int) -> list[Page]:
        """The pages that take the parameter group of an identifier from any source."""
        return [self.pages[name] for source, name in self._candidates(key) if source is None]

    def _candidates(self, key: int) -> list[tuple[int | None, str]]:
        if key in self._by_key or not key & EXTENDED or key & (REMOTE | ERROR_FRAME):
            return []
        return self._by_pgn.get((key >> BUS_SHIFT, j1939_pgn(key & 0x1FFF_FFFF)), [])

    def _claim(self, page: Page, key: int) -> Page | None:
        if page.owner is None or page.stale_level == 0 or page.owner == key:
            page.owner = key
            return page
        page.others.append(key)
        self.counters["other sources of a message"] += 1
        return None

    def touch(self, cell: Cell, raw: RawValue, t_ns: int) -> None:
        """A signal has left its class."""
        cell.set_class(raw)
        self.queued.append(cell)

    def measure(self, cell: Cell, raw: RawValue, t_ns: int) -> None:
        """An exact signal has another value, or has come again where every frame counts."""
        changed = raw != cell.raw
        cell.set_value(raw)
        if changed and cell.held is not None:
            cell.held.restart(t_ns, cell.bad)
        if cell.rate is not None:
            cell.rate.sample(t_ns, cell.value, cell.bad)
        self.queued.append(cell)

    def place(self, page: Page, t_ns: int, data: bytes) -> None:
        """Bring a page up to a frame that changes nothing for anyone: neither conditions nor clocks are told."""
        page.t_ns = t_ns
        page.data = data
        page.seen = ALWAYS if page.always else data
        for cell in page.cells:
            raw = raw_of(cell.signal, data)
            if raw is None:
                cell.k = cell.base + SHORT
                cell.lo, cell.hi, cell.raw = 1, 0, None
                cell.bad = BAD[SHORT]
            elif cell.exact:
                cell.set_value(raw)
            else:
                cell.set_class(raw)

    def spoil(self, cell: Cell, quality: int) -> None:
        """A signal has no raw value any more: NEVER, OLD, SHORT, CORRUPT or FROZEN."""
        cell.k = cell.base + quality
        cell.lo, cell.hi, cell.raw = 1, 0, None
        cell.bad = BAD[quality]
        if cell.held is not None:
            cell.held.restart(cell.page.t_ns, cell.bad)
        if cell.rate is not None:
            cell.rate.lose()
        self.queue(cell)

    def lose(self, page: Page) -> None:
        """A page has become stale: so have its signals; a J1939 message is free for another source."""
        page.move_integrity(OLD)
        for cell in page.cells:
            self.spoil(cell, OLD)
        if page.owner is not None:
            for key in (*page.others, page.owner):
                self.table.pop(key, None)
            page.owner = None
            page.others.clear()

    def _short_of(self, page: Page) -> Callable[[int, bytes], None]:
        def short(t_ns: int, data: bytes) -> None:
            """The frame ends before the last signal in use: those it holds count, the others are errors."""
            self.counters["short frames"] += 1
            for cell in page.cells:
                raw = raw_of(cell.signal, data)
                if raw is None:
                    self.spoil(cell, SHORT)
                elif cell.exact:
                    self.measure(cell, raw, t_ns)
                else:
                    self.touch(cell, raw, t_ns)
            if page.branches:
                page.select(t_ns, data)
        return short

    def queue(self, cell: Cell) -> None:
        """Have the conditions that read a cell evaluated at the next `settle`."""
        self.queued.append(cell)

    def settle(self, t_ns: int) -> None:
        """Evaluate what is queued, in a fixed order, until nothing moves any more."""
        queued = self.queued
        rounds = 0
        while queued:
            if len(queued) == 1:
                batch = queued.pop().watches
            else:
                batch = sorted({watch for cell in queued for watch in cell.watches}, key=_index)
                queued.clear()
            for watch in batch:
                evaluate = watch.evaluate  # by a local name: CPython finds what a slot holds slowly in a method call
                outcome = evaluate()
                if outcome != watch.outcome:
                    watch.outcome = outcome
                    watch.sink(t_ns, outcome)
            rounds += 1
            if rounds == MAX_ROUNDS:
                self.counters["conditions that feed each other"] += 1
                return

    # --- asking -----------------------------------------------------------------------------------------------------------

    def sample(self, cell: Cell) -> tuple[RawValue | None, int]:
        """Raw value (None where there is none) and quality of a signal, from the last payload. For events and monitoring."""
        page = cell.page
        self.refresh(page)
        if page.level < 0:
            return None, NEVER
        return raw_of(cell.signal, page.data), cell.quality


def _unnoticed(key: int) -> Listener | None:
    return None
