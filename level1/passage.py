"""The passage of one block of frames through a supervisor (see `sieve`).

First everything is found on columns: which rows belong to which page, the silences between them, the classes of their
signals, the outcomes of the answered conditions. Then the supervisor is driven through what remains.

A *slot* numbers what happens in a block: its frames, and the moments at which tracked pages pass a limit of silence, in the
order in which they happen. A deadline comes before the frames of its own time.
"""
from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from level1.block import HEAD_BYTES, Block, Ints
from level1.board import Board, Cell, Page, Watch, Watchdog
from level1.column_condition import ColumnCondition
from level1.columns import Column, changed_payloads
from level1.decode import OLD
from level1.plan import Node, Plan
from level1.timer import FAR

if TYPE_CHECKING:
    from level1.supervisor import Supervisor

NOBODY, FED = -1, -2
"""What stands in place of a tree for identifiers nobody asks for, and for those whose every frame is fed."""
_NONE: Ints = np.zeros(0, np.int64)


def clamped(t_ns: Ints, last_ns: int) -> tuple[Ints, int]:
    """Time stamps that never run backwards, nor behind `last_ns`; and how many had to be raised."""
    if t_ns[0] >= last_ns and not (t_ns[1:] < t_ns[:-1]).any():
        return t_ns, 0
    raised = np.maximum.accumulate(np.maximum(t_ns, last_ns))
    return raised, int(np.count_nonzero(raised != t_ns))


class Talkers(NamedTuple):
    """Of each talker of a block the number of its tree (or `NOBODY`, `FED`), and how many rows it has."""

    numbers: list[int]
    counts: list[int]


class Deal(NamedTuple):
    """The rows of a block, sorted by tree; `bounds`: where the trees begin, and the end. changed: payload differs from the row
    before; longest: gap between two rows of a tree, ns."""

    rows: Ints
    t_ns: Ints
    lengths: npt.NDArray[np.uint16]
    changed: npt.NDArray[np.bool_]
    bounds: list[int]
    longest: list[int]


class Table:
    """Where blocks are dealt out. It is used again for each block: fresh memory of this size costs more than what is done with
    it."""

    def __init__(self) -> None:
        self._make_room(0)

    def _make_room(self, rows: int) -> None:
        self._t_ns = np.empty(rows, np.int64)
        self._gaps = np.empty(rows, np.int64)
        self._heads = np.empty(rows, np.uint64)
        self._changed = np.empty(rows, bool)

    def deal(self, block: Block, t_ns: Ints, talkers: Talkers, trees: int) -> Deal:
        """Sort the rows of a block by tree, in order of time within each; the result holds until the next block is dealt."""
        lot = np.array([number if number >= 0 else trees for number in talkers.numbers])
        lots: npt.NDArray[Any] = lot.astype(np.uint8 if trees < 256 else np.uint16).take(block.talker)
        counts = np.bincount(lot, talkers.counts, trees + 1).astype(np.int64)
        if counts[trees] * 2 > len(block):
            some = np.flatnonzero(lots < trees)
            rows = some[np.argsort(lots[some], kind="stable")]
        else:
            rows = np.argsort(lots, kind="stable")[:len(block) - counts[trees]]
        bounds = np.concatenate(([0], np.cumsum(counts[:trees])))
        starts = bounds[:-1][counts[:trees] > 0]
        if len(rows) > len(self._t_ns):
            self._make_room(len(rows))
        times, heads, changed = self._t_ns[:len(rows)], self._heads[:len(rows)], self._changed[:len(rows)]
        t_ns.take(rows, out=times, mode="clip")
        block.head.take(rows, out=heads, mode="clip")
        np.not_equal(heads[1:], heads[:-1], out=changed[1:])
        shortest = block.length.min()
        if shortest == block.length.max():
            lengths = np.broadcast_to(shortest, len(rows))
        else:
            lengths = block.length.take(rows)
            changed[1:] |= lengths[1:] != lengths[:-1]
        changed[starts] = True
        return Deal(rows, times, lengths, changed, bounds.tolist(), self._longest(times, starts, counts[:trees]))

    def _longest(self, times: Ints, starts: Ints, counts: Ints) -> list[int]:
        """The longest gap of each tree."""
        longest = np.zeros(len(counts), np.int64)
        if len(starts):
            gaps = self._gaps[:len(times)]
            np.subtract(times[1:], times[:-1], out=gaps[:-1])
            gaps[starts - 1] = 0
            longest[counts > 0] = np.maximum.reduceat(gaps, starts)
        return longest.tolist()


class Silence(NamedTuple):
    """A page passes a limit of silence. place: of the row that ends it, among the rows of its page; level: it enters then."""

    due_ns: int
    order: int
    passing: PagePassage
    place: int
    level: int


class PagePassage:
    """A tracked page in the present block.

    rows: its frames; t_ns, lengths, changed: of each. placed: how many of them the board has taken in. heard: places of those
    that end a silence. dues: first deadline of each silence to come. lost: places before which its values become stale, and
    the slots of these moments. short: whether frames end before its last signal.
    """

    __slots__ = ("changed", "dues", "heard", "lengths", "lost_places", "lost_slots", "node", "page", "placed", "rows", "short",
                 "t_ns")

    def __init__(self, node: Node, rows: Ints, t_ns: Ints, lengths: npt.NDArray[np.uint16], changed: npt.NDArray[np.bool_]):
        self.node = node
        self.page = node.page
        self.rows = rows
        self.t_ns = t_ns
        self.lengths = lengths
        self.changed = changed
        self.placed = 0
        self.heard: list[int] = []
        self.dues: deque[int] = deque()
        self.lost_places: list[int] = []
        self.lost_slots: list[int] = []
        self.short = bool(len(rows)) and int(lengths.min()) < node.need

    def silences(self, end_ns: int, longest_ns: int) -> Iterator[Silence]:
        """All its silences up to the end of the block; notes which rows end them. longest_ns: gap between two of its rows."""
        page, limits = self.page, self.page.limits
        count = len(self.rows)
        if count and page.seen is None:
            self.heard.append(0)
        if not limits:
            return
        if page.level >= 0:
            until = int(self.t_ns[0]) if count else end_ns
            yield from self._silence(page.t_ns, until, page.level, 0)
        if longest_ns >= limits[0]:
            for place in np.flatnonzero(self.t_ns[1:] - self.t_ns[:-1] >= limits[0]).tolist():
                yield from self._silence(int(self.t_ns[place]), int(self.t_ns[place + 1]), 0, place + 1)
        if count:
            yield from self._silence(int(self.t_ns[-1]), end_ns, 0, count)

    def _silence(self, since_ns: int, until_ns: int, level: int, place: int) -> Iterator[Silence]:
        page = self.page
        for number in range(level, len(page.limits)):
            due = since_ns + page.limits[number]
            if due > until_ns:
                return
            if number == 0:
                self.dues.append(due)
                if place < len(self.rows):
                    self.heard.append(place)
            if number + 1 == page.stale_level:
                self.lost_places.append(place)
            yield Silence(due, page.order, self, place, number + 1)


class Flips(NamedTuple):
    """Frames at which the outcome of a condition changes, and to what."""

    watch: Watch
    rows: Ints
    outcomes: npt.NDArray[Any]


class Answer:
    """What an answered condition evaluates to in the course of a block: `outcomes`, each from its slot on."""

    __slots__ = ("outcomes", "passage", "place", "slots")

    def __init__(self, passage: Passage, first: int, slots: list[int], outcomes: list[int]):
        self.passage = passage
        self.slots = [-1, *slots, FAR]
        self.outcomes = [first, *outcomes]
        self.place = 0

    def __call__(self) -> int:
        now = self.passage.slot
        while self.slots[self.place + 1] <= now:
            self.place += 1
        return self.outcomes[self.place]


class Passage:
    """Drives a supervisor through one block. t_ns: its time stamps, none running backwards."""

    def __init__(self, supervisor: Supervisor, plan: Plan, table: Table, block: Block, t_ns: Ints, talkers: Talkers):
        self.board: Board = supervisor.board
        self._timers = supervisor.timers
        self._plan = plan
        self._block = block
        self._t_ns = t_ns
        self.pages: dict[Page, PagePassage] = {}
        self._row = -1
        self._slot = -1
        self._due: tuple[int, int] | None = None
        self._fed: list[Ints] = []
        self._moved: set[Column] = set()
        self._ends: dict[int, list[PagePassage]] = {}
        if FED in talkers.numbers:
            self._fed.append(np.flatnonzero(np.array([number == FED for number in talkers.numbers])[block.talker]))
        strangers = [place for place, key in enumerate(block.keys) if key not in self.board.table and talkers.counts[place]]
        if strangers:
            self._fed.append(block.first_rows()[strangers])
        silences = self._follow_times(table, talkers)
        self._deadlines = [(silence.due_ns, silence.order) for silence in silences]
        self._before = t_ns.searchsorted(np.array([silence.due_ns for silence in silences], np.int64), "left")
        self._deadline_slots = self._before + np.arange(len(silences))
        self._follow_presence(silences)
        for passing in self.pages.values():
            self._follow_signals(passing)
        self._answers, self._flips = self._evaluate()

    # --- on columns -------------------------------------------------------------------------------------------------------

    def _follow_times(self, table: Table, talkers: Talkers) -> list[Silence]:
        """Give each page its rows, and find all silences, in the order of their deadlines."""
        plan, end_ns = self._plan, int(self._t_ns[-1])
        dealt = table.deal(self._block, self._t_ns, talkers, max(plan.roots, default=-1) + 1)
        silences: list[Silence] = []
        for number, root in plan.roots.items():
            part = slice(dealt.bounds[number], dealt.bounds[number + 1])
            passing = PagePassage(root, dealt.rows[part], dealt.t_ns[part], dealt.lengths[part], dealt.changed[part])
            if len(root.windows) > 1 and len(self._block.wide_rows):
                passing.changed[1:] = changed_payloads(self._block, passing.rows, root.windows)
            self.pages[root.page] = passing
            silences += passing.silences(end_ns, dealt.longest[number])
            for child in root.children:
                self._follow_branch(passing, child, silences)
        silences.sort(key=_when)
        return silences

    def _follow_branch(self, parent: PagePassage, node: Node, silences: list[Silence]) -> None:
        """The rows of a multiplexer branch: those of its parent at which the selector names it."""
        assert node.bits is not None
        raws = node.bits.of(self._block.window(parent.rows, node.bits.window))
        places = np.flatnonzero(np.isin(raws, node.ids) & (parent.lengths >= node.bits.need))
        rows, t_ns = parent.rows[places], parent.t_ns[places]
        changed = np.ones(len(rows), bool)
        changed[1:] = changed_payloads(self._block, rows, node.windows)
        passing = self.pages[node.page] = PagePassage(node, rows, t_ns, parent.lengths[places], changed)
        silences += passing.silences(int(self._t_ns[-1]), int((t_ns[1:] - t_ns[:-1]).max(initial=0)))
        for child in node.children:
            self._follow_branch(passing, child, silences)

    def _slots(self, rows: Ints) -> Ints:
        return rows + self._before.searchsorted(rows, "right") if self._deadlines else rows

    def _follow_presence(self, silences: list[Silence]) -> None:
        """The columns of silence, and the slots at which values are lost."""
        for passing in self.pages.values():
            if passing.heard:
                rows = passing.rows[passing.heard]
                self._fed.append(rows)
                for row in rows.tolist():
                    self._ends.setdefault(row, []).append(passing)
        moves: dict[PagePassage, list[tuple[int, int]]] = {}
        for silence, slot in zip(silences, self._deadline_slots.tolist(), strict=True):
            moves.setdefault(silence.passing, []).append((slot, silence.level))
            if silence.level == silence.passing.page.stale_level:
                silence.passing.lost_slots.append(slot)
        for passing in self.pages.values():
            column = passing.node.presence
            if column in self._plan.wanted and (passing.heard or passing in moves):
                heard = self._slots(passing.rows[passing.heard]) if passing.heard else _NONE
                steps = sorted([*moves.get(passing, ()), *((slot, 0) for slot in heard.tolist())])
                column.slots = np.array([slot for slot, _ in steps], np.int64)
                column.ks = np.array([column.cell.k, *(level for _, level in steps)], np.uint16)
                self._moved.add(column)

    def _follow_signals(self, passing: PagePassage) -> None:
        """The columns of a page's signals, and the rows at which live ones change."""
        wanted = [column for column in passing.node.columns if column in self._plan.wanted]
        if not wanted or not (len(passing.rows) or passing.lost_places):
            return
        lost_places, lost_slots = np.array(passing.lost_places, np.int64), np.array(passing.lost_slots, np.int64)
        passing.changed[lost_places[lost_places < len(passing.rows)]] = True
        places = np.flatnonzero(passing.changed)
        rows = passing.rows[places]
        losses = places.searchsorted(lost_places)
        words = self._block.windows(rows, {column.bits.window for column in wanted})
        for column in wanted:
            if not (passing.short or passing.lost_places) and column.stays(words[column.bits.window]):
                continue
            short = passing.lengths[places] < column.bits.need if passing.short else None
            keep, at = column.follow(words[column.bits.window], short, losses, column.cell.base + OLD)
            changes = rows[keep]
            if len(changes) and column in self._plan.live:
                self._fed.append(changes)
            column.slots = self._slots(changes)
            if len(losses):
                column.slots = np.insert(column.slots, at, lost_slots)
            if len(column.slots):
                self._moved.add(column)

    def _flips_of(self, watch: Watch, slots: Ints, outcomes: npt.NDArray[Any]) -> Flips:
        """Those of the changes of an outcome that frames make. (Those that silences make are noticed when they fall due.)"""
        if not self._deadlines:
            return Flips(watch, slots, outcomes)
        before = self._deadline_slots.searchsorted(slots, "left")
        by_frames = before == self._deadline_slots.searchsorted(slots, "right")
        return Flips(watch, (slots - before)[by_frames], outcomes[by_frames])

    def _evaluate(self) -> tuple[dict[Watch, Answer], list[Flips]]:
        """The answers of all conditions, and the frames at which they change."""
        answers, flips = {}, []
        for watch, condition in self._plan.answered:
            moved = [column for column in condition.columns if column in self._moved]
            slots, outcomes = _NONE, _NONE
            if moved:
                slots, zones = self._zones(condition, moved)
                changes = np.flatnonzero(zones[1:] != zones[:-1])
                slots, outcomes = slots[changes], zones[1:][changes]
                if len(slots):
                    flips.append(self._flips_of(watch, slots, outcomes))
            answers[watch] = Answer(self, watch.outcome, slots.tolist(), outcomes.tolist())
        return answers, flips

    def _zones(self, condition: ColumnCondition, moved: list[Column]) -> tuple[Ints, npt.NDArray[Any]]:
        """The slots at which an input of a condition changes, and the zones: before the block, and from each of them on."""
        if condition.table is not None:
            return moved[0].slots, condition.table[moved[0].ks]
        slots, places = _merge([column.slots for column in moved])
        for column in condition.columns:
            if column not in self._moved:
                column.rest()
                column.at(np.zeros(len(slots) + 1, np.int64))
        for column, place in zip(moved, places, strict=True):
            column.at(place)
        return slots, np.broadcast_to(condition.zone(), (len(slots) + 1,))

    # --- in time ----------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Drive the supervisor through the block, to the time of its last frame."""
        kept = {watch: watch.evaluate for watch in self._answers}
        refresh, self.board.refresh = self.board.refresh, self.refresh
        watchdogs = self._take_over()
        try:
            for watch, answer in self._answers.items():
                watch.evaluate = answer
            self._drive()
        finally:
            for watch, evaluate in kept.items():
                watch.evaluate = evaluate
            self._hand_back(watchdogs)
            self.board.refresh = refresh
            self._answers.clear()  # they hold this passage, and with it the block

    @property
    def slot(self) -> int:
        """The slot that is being gone through."""
        if self._due is not None:
            self._locate(*self._due)
        return self._slot

    def refresh(self, page: Page) -> None:
        """Bring a tracked page up to now."""
        passing = self.pages.get(page)
        if passing is not None:
            if self._due is not None:
                self._locate(*self._due)
            self._place(passing, int(passing.rows.searchsorted(self._row, "right")))

    def _locate(self, due_ns: int, order: int) -> None:
        """Find where in the block a deadline stands: behind all frames before it, and behind the silences before it."""
        self._due = None
        row = int(self._t_ns.searchsorted(due_ns, "left")) - 1
        self._row = max(self._row, row)
        self._slot = max(self._slot, row + bisect_right(self._deadlines, (due_ns, order)))

    def _place(self, passing: PagePassage, count: int) -> None:
        """Have the board take in the first rows of a page, so many: that is, the last of them."""
        if count > passing.placed:
            passing.placed = count
            self.board.place(passing.page, int(passing.t_ns[count - 1]), self._block.payload(int(passing.rows[count - 1])))

    def _take_over(self) -> dict[Watchdog, list[Page]]:
        """From here on tracked pages get their exact deadlines from this passage; gives the watchdogs and their pages."""
        watchdogs = {}
        for page, passing in self.pages.items():
            if page.watchdog is not None:
                watchdogs[page.watchdog] = page.watchdog.pages
                page.watchdog = None
                if page.level == 0:
                    self._arm(passing)
        for watchdog, pages in watchdogs.items():
            watchdog.pages = [page for page in pages if page.watchdog is not None]
        return watchdogs

    def _arm(self, passing: PagePassage) -> None:
        """Let a page that is heard expire at the first deadline of its next silence in this block."""
        passing.page.due = FAR
        if passing.dues:
            self._timers.set(passing.page, passing.dues.popleft())

    def _hand_back(self, watchdogs: dict[Watchdog, list[Page]]) -> None:
        """Leave the board as single frames would have left it."""
        for passing in self.pages.values():
            self._place(passing, len(passing.rows))
        end_ns = int(self._t_ns[-1])
        for watchdog, pages in watchdogs.items():
            watchdog.pages = pages
            for page in pages:
                if page.watchdog is None:
                    page.watchdog = watchdog
                    if page.level == 0:
                        self._timers.set(page, page.t_ns + watchdog.limit_ns)
            if watchdog.due > end_ns + watchdog.period_ns:
                self._timers.set(watchdog, end_ns + watchdog.period_ns)

    def _drive(self) -> None:
        """Through everything that can matter, in order."""
        board, timers, queued = self.board, self._timers, self.board.queued
        watches = [flips.watch for flips in self._flips]
        fed = np.unique(np.concatenate([_NONE, *self._fed]))
        self._count_short(fed)
        frames = zip(self._block.talker[fed].tolist(), self._block.payloads(fed), strict=True)
        rows = np.concatenate([fed, *(flips.rows for flips in self._flips)])
        tags = np.repeat(np.arange(-1, len(self._flips)), [len(fed), *(len(flips.rows) for flips in self._flips)])
        outcomes = np.concatenate([np.zeros(len(fed), np.uint8), *(flips.outcomes for flips in self._flips)])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        shared = np.zeros(len(rows) + 1, bool)
        np.equal(rows[1:], rows[:-1], out=shared[1:-1])
        alone = ~(shared[1:] | shared[:-1])
        steps = zip(rows.tolist(), self._t_ns[rows].tolist(), self._slots(rows).tolist(), tags[order].tolist(),
                    outcomes[order].tolist(), alone.tolist(), strict=True)
        now_ns, last = 0, -1
        for row, t_ns, slot, tag, outcome, is_alone in steps:
            if row != last:
                if queued:
                    board.settle(now_ns)
                if t_ns >= timers.next_ns:
                    self._pass_time(t_ns)
                self._row, self._slot, self._due, now_ns, last = row, slot, None, t_ns, row
            if tag < 0:
                talker, data = next(frames)
                self._feed(t_ns, self._block.keys[talker], data)
            elif is_alone:  # what `settle` would do
                watch = watches[tag]
                watch.outcome = outcome
                watch.sink(t_ns, outcome)
            else:
                queued.append(_bell(watches[tag]))
        if queued:
            board.settle(now_ns)
        if last < len(self._block) - 1:
            self._pass_time(int(self._t_ns[-1]))

    def _pass_time(self, now_ns: int) -> None:
        """Everything due up to now, each at its own time."""
        timers = self._timers
        while (item := timers.pop(now_ns)) is not None:
            due = timers.popped_ns
            self._due = due, item.order
            if isinstance(item, Page):
                self.refresh(item)
            item.expire(due)
            if self.board.queued:
                self.board.settle(due)

    def _feed(self, t_ns: int, key: int, data: bytes) -> None:
        """A frame for the board, as in `Supervisor.receive_many`."""
        board = self.board
        page = board.table[key] if key in board.table else board.bind(key)
        if page is None:
            return
        passing = self.pages.get(page) if isinstance(page, Page) else None
        if passing is not None and passing.node.page is page and any(self.pages[node.page].short for node in passing.node.all()):
            self._catch_up(passing)
        page.receive(t_ns, data)
        for passing in self._ends.get(self._row, ()):
            self._arm(passing)

    def _catch_up(self, passing: PagePassage) -> None:
        """Bring a tree up to just before the present row: short frames are counted by what the frame before was."""
        for node in passing.node.all():
            part = self.pages[node.page]
            self._place(part, int(part.rows.searchsorted(self._row, "left")))

    def _count_short(self, fed: Ints) -> None:
        """Count the short frames that are not fed, as the board counts the others: all, or all with a new payload."""
        for page, passing in self.pages.items():
            if not passing.short:
                continue
            counts = passing.lengths < passing.node.need
            if not page.always:
                changed = changed_payloads(self._block, passing.rows, tuple(range(0, passing.node.need, HEAD_BYTES)))
                counts[1:] &= changed
                counts[0] &= page.seen != self._block.payload(int(passing.rows[0]))
            rows = passing.rows[counts]
            self.board.counters["short frames"] += len(rows) - int(np.isin(rows, fed).sum())


def _when(silence: Silence) -> tuple[int, int]:
    return silence.due_ns, silence.order


def _bell(watch: Watch) -> Cell:
    """A cell that moves for one condition alone."""
    cell = Cell("", 0)
    cell.watches.append(watch)
    return cell


def _merge(parts: list[Ints]) -> tuple[Ints, list[Ints]]:
    """All slots, rising, each once; and for each part how many of its own had come: before all of them, and at each."""
    joined = np.concatenate(parts)
    order = np.argsort(joined, kind="stable")
    joined = joined[order]
    last = np.ones(len(joined), bool)
    np.not_equal(joined[1:], joined[:-1], out=last[:-1])
    ends = np.flatnonzero(last)
    origin = np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part) for part in parts])[order]
    counts = [np.concatenate(([0], np.cumsum(origin == number)[ends])) for number in range(len(parts))]
    return joined[ends], counts
