"""A supervisor fed with blocks of frames: columns tell what can matter, everything else is left out.

Theory of operation. The supervisor, its board, timers, alarms and repairs are the objects that run live; nothing here decides
about an alarm. For each block, columns give the moments at which conditions change their outcome, and the supervisor is
driven through just these moments and its own deadlines, in time order (`passage`):

- A *tracked* page (a message whose recorded frames alone move its signals) is not decoded frame by frame. Its silences follow
  from the gaps between its frames; a frame that ends one is *fed*: received by the board as live.
- A condition that reads nothing but tracked pages is *answered*: what it evaluates to at any moment comes from columns.
- Cells that someone else reads as well (conditions with states of alarms, the clocks of `held`, feedback of repairs) are
  *live*: each frame that moves one of them is fed.
- Every frame of a page that is not tracked is fed: of messages the supervisor sends itself, of those protected by counters,
  sampled by `rate`, listened to, put together from packets, or of a J1939 source that changes within the block.
- Who looks at a page for other reasons (freeze frames, monitoring) finds it brought up to date (`Board.refresh`).

At the end of a block the board stands as it would have stood frame by frame, so that blocks and single frames mix freely.
This module holds what stays from block to block.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from level1.alarm import AlarmMachine
from level1.block import Block, Ints
from level1.board import MAX_KEYS, Cell, Page, Watch
from level1.catalog import Catalog
from level1.column_condition import ColumnCondition, compile_zone
from level1.columns import Column, Unsupported
from level1.condition import walk
from level1.event import Output
from level1.expression import AlarmState, Count, ExpectStep
from level1.frame import BUS_SHIFT, EXTENDED, frame_key, j1939_pgn
from level1.j1939 import TP_CM
from level1.passage import FED, NOBODY, Passage, Table, Talkers, clamped
from level1.plan import Node, Plan
from level1.supervisor import Supervisor

LEAST_ROWS = 64
"""Shorter blocks go through `Supervisor.receive_many`: columns would take longer."""


class Group(NamedTuple):
    """A parameter group that its page takes from whichever source it hears first."""

    bus: int
    pgn: int


def feeds_itself(catalog: Catalog) -> bool:
    """Whether the condition of some alarm depends on its own state, by way of others or not. Such conditions may never come to
    rest, and what the board then leaves for the next input depends on every single frame."""
    reads: dict[str, set[str]] = {}
    for alarm in catalog.alarms.values():
        expects = [step.condition for step in alarm.repair.steps if isinstance(step, ExpectStep)] if alarm.repair else []
        reads[alarm.name] = {node.alarm for part in (alarm.when, alarm.until, alarm.enabled, *expects) for node in walk(part)
                             if isinstance(node, (AlarmState, Count))}
    while calm := [name for name, others in reads.items() if not others & reads.keys()]:
        for name in calm:
            del reads[name]
    return bool(reads)


class Sieve:
    """Feeds a supervisor with blocks. The outputs are those of `Supervisor.receive_many`, byte for byte.

    least_rows: shorter blocks are received frame by frame.
    """

    def __init__(self, supervisor: Supervisor, least_rows: int = LEAST_ROWS):
        self.supervisor = supervisor
        self.board = supervisor.board
        self._least_rows = least_rows
        roots = [node for page in self.board.pages.values() if (node := self._root(page)) is not None]
        self._roots = dict(enumerate(roots))
        self._numbers = {node.page: number for number, node in self._roots.items()}
        self._pgns = {number: j1939_pgn(node.page.message.can_id) for number, node in self._roots.items()
                      if node.page.message.extended}
        self._kinds: dict[int, int | Group] = {}
        self._conditions = self._compile()
        self._is_cyclic = feeds_itself(self.board.catalog)
        self._table = Table()
        self._plans: dict[frozenset[int], Plan] = {}

    # --- building ---------------------------------------------------------------------------------------------------------

    def _root(self, page: Page) -> Node | None:
        """The tree of a page that can be tracked, else None."""
        message, board = page.message, self.board
        if message.name in self.supervisor.sendable() or page.protection is not None:
            return None
        if board.listener(frame_key(message.can_id, message.extended)) is not None:
            return None
        if message.j1939 and message.source is None and len(board.catalog.buses.get(message.name, (0,))) > 1:
            return None
        try:
            root = Node(page)
        except Unsupported:
            return None
        pages = [node.page for node in root.all()]
        if any(cell.rate is not None for page in pages for cell in page.cells):
            return None
        return None if any(page.limits and page.limits[0] < 1 for page in pages) else root

    def _compile(self) -> dict[Watch, ColumnCondition]:
        """The conditions of alarms that columns can answer."""
        columns: dict[Cell, Column] = {}
        for root in self._roots.values():
            for node in root.all():
                columns[node.page.presence] = node.presence
                columns.update((column.cell, column) for column in node.columns)
        found = {}
        for watch in self.supervisor.watches:
            machine = getattr(watch.sink, "__self__", None)
            if isinstance(machine, AlarmMachine):
                alarm = machine.definition
                try:
                    found[watch] = compile_zone(self.board, columns, alarm.when, alarm.until, alarm.enabled)
                except Unsupported:
                    continue
        return found

    def _plan(self, loose: frozenset[int]) -> Plan:
        """What to do while these trees are not tracked."""
        if loose not in self._plans:
            roots = {number: root for number, root in self._roots.items() if number not in loose}
            nodes = [node for root in roots.values() for node in root.all()]
            tracked: set[Column] = {column for node in nodes for column in (node.presence, *node.columns)}
            answered = tuple((watch, condition) for watch, condition in self._conditions.items()
                             if tracked.issuperset(condition.columns))
            watches = {watch for watch, _ in answered}
            live = frozenset(column for node in nodes for column in node.columns
                             if column.cell.held is not None or not watches.issuperset(column.cell.watches))
            wanted = live.union(*(condition.columns for _, condition in answered))
            self._plans[loose] = Plan(roots, answered, wanted, live)
        return self._plans[loose]

    # --- a block ----------------------------------------------------------------------------------------------------------

    def receive(self, block: Block) -> list[Output]:
        """The frames of a block, in order."""
        if len(block) < self._least_rows or not len(block) or self._is_cyclic or self.board.queued:
            return self.supervisor.receive_many(block.frames())
        self.supervisor.begin(int(block.t_ns[0]))
        t_ns, backwards = clamped(block.t_ns, self.supervisor.now_ns)
        if backwards:
            self.supervisor.counters["time stamps that ran backwards"] += backwards
        counts = block.counts()
        numbers, loose = self._assign(block, counts, t_ns)
        Passage(self.supervisor, self._plan(loose), self._table, block, t_ns, Talkers(numbers, counts)).run()
        return self.supervisor.take(int(t_ns[-1]))

    def _assign(self, block: Block, counts: list[int], t_ns: Ints) -> tuple[list[int], frozenset[int]]:
        """For each talker of a block the number of its tree, `NOBODY` or `FED`; and the trees that are not tracked in it."""
        if len(self._kinds) > MAX_KEYS:
            self._kinds.clear()
        numbers: list[int] = []
        groups: dict[Group, list[int]] = {}
        for place, key in enumerate(block.keys):
            kind = self._kinds.get(key)
            if kind is None:
                kind = self._kinds[key] = self._kind(key)
            if isinstance(kind, Group):
                if counts[place]:
                    groups.setdefault(kind, []).append(place)
                kind = NOBODY
            numbers.append(kind)
        loose = self._packed(block)
        for group, places in groups.items():
            self._resolve(group, places, block, t_ns, numbers, loose)
        return [FED if number in loose else number for number in numbers], frozenset(loose)

    def _kind(self, key: int) -> int | Group:
        """What `Board.bind` would find for an identifier, as far as that never changes."""
        board = self.board
        if board.listener(key) is not None:
            return FED
        page = board.fixed_page(key)
        if page is not None:
            return self._numbers.get(page, FED)
        return Group(key >> BUS_SHIFT, j1939_pgn(key & 0x1FFF_FFFF)) if board.open_pages(key) else NOBODY

    def _resolve(self, group: Group, places: list[int], block: Block, t_ns: Ints, numbers: list[int], loose: set[int]) -> None:
        """Whose frames the page of a group takes in this block, where that is one source from its begin to its end."""
        keys = [block.keys[place] for place in places]
        pages = self.board.open_pages(keys[0])
        page = pages[0]
        number = self._numbers.get(page, FED)
        if len(pages) > 1 or number == FED:
            loose.update(self._numbers[page] for page in pages if page in self._numbers)
            taken = list(places)
            number = FED
        elif page.stale_level == 0 or {*keys, page.owner} <= {keys[0], None}:
            taken = places
        elif page.owner is not None and self._stays(page, places, block, t_ns):
            taken = [place for place in places if block.keys[place] == page.owner]
        else:
            loose.add(number)
            taken, number = places, FED
        for place in taken:
            numbers[place] = number

    @staticmethod
    def _stays(page: Page, places: list[int], block: Block, t_ns: Ints) -> bool:
        """Whether the owner of a page sends so often that no other source can take it over."""
        own = [place for place in places if block.keys[place] == page.owner]
        heard = t_ns[block.talker == own[0]] if own else t_ns[:0]
        times = np.concatenate(([page.t_ns], heard, t_ns[-1:]))
        return page.level >= 0 and int(np.diff(times).max()) < page.limits[page.stale_level - 1]

    def _packed(self, block: Block) -> set[int]:
        """Trees of parameter groups that a transport session delivers or may deliver in this block."""
        transport = self.supervisor.subsystems.transport
        if transport is None:
            return set()
        pgns = {j1939_pgn(session.key & 0x1FFF_FFFF) for session in transport.sessions.values()}
        announcing = [place for place, key in enumerate(block.keys) if key & EXTENDED and j1939_pgn(key & 0x1FFF_FFFF) == TP_CM]
        for place in announcing:
            for head in np.unique(block.head[block.talker == place]).tolist():
                pgns.add(j1939_pgn((head >> 40 & 0x3FFFF) << 8))
        return {number for number, pgn in self._pgns.items() if pgn in pgns}
