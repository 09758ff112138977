"""`ucs run`'s end of the way to the bridge process: what the live loop hands over, and the orders that come back."""
from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from bridge.delivered import delivered_path, delivered_upto
from bridge.link import LocalEnd, Refusal, RunLink
from level1.bus_health import Report
from level1.event import Event, Monitor, Result
from level1.io.inbox import Inbox
from level1.io.journal import Journal

ALIVE_NS = 500_000_000
"""So often the bridge hears at least that supervision is alive; it gives it up after 2 s."""
BESIDE_NS = 2_000_000_000
"""So often the events that the journal can't take are handed over again: nobody says whether they arrived."""

COMMAND_REFUSED = "CommandRefused"
"""Alarm of `ucs.dbc` whose causes are commands that the gate has refused."""
RETRY_S = 1.0
"""So often a socket is tried again for which the disk had no room."""
PRUNE_S = 60.0
"""So often the journal learns what level 2 has, and may shrink to its bound."""


class Uplink:
    """A context manager. publish is called by the live loop, which alone shows that supervision is alive.

    Orders come at two sockets: from above through the bridge, and from someone at the machine (`ucs order`).
    """

    def __init__(self, journal: Journal, inbox: Inbox, clock: Callable[[], int]):
        self._link = RunLink(Path(journal.path))
        self._local = LocalEnd(Path(journal.path))
        self._journal, self._inbox, self._clock = journal, inbox, clock
        self._alive_due_ns = self._beside_due_ns = 0
        self._wake, self._awake = os.pipe()
        self._thread = threading.Thread(target=self._listen, name="orders", daemon=True)
        self._thread.start()

    def __enter__(self) -> Uplink:
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._awake, b".")
        self._thread.join()
        self._link.close()
        self._local.close()
        os.close(self._wake)
        os.close(self._awake)

    def publish(self, events: Sequence[Event], outputs: Sequence[Monitor | Result]) -> None:
        """Hand over what is new, without waiting for anyone."""
        now_ns = self._clock()
        if events:
            self._link.poke()
        for output in outputs:
            if isinstance(output, Result):
                self._link.answer(output)
                self._local.answer(output)
        monitors = [output for output in outputs if isinstance(output, Monitor)]
        if monitors or now_ns >= self._alive_due_ns:
            self._alive_due_ns = now_ns + ALIVE_NS
            self._link.send_samples(*monitors)
        if now_ns >= self._beside_due_ns and (pending := self._journal.pending):
            self._beside_due_ns = now_ns + BESIDE_NS
            self._link.send_beside(pending)

    def _listen(self) -> None:
        """Orders, until the end; and now and then what level 2 has acknowledged."""
        while True:
            patience_s = PRUNE_S if self._link.ready and self._local.ready else RETRY_S
            readable, _, _ = select.select([self._link.fileno(), self._local.fileno(), self._wake], [], [], patience_s)
            if self._wake in readable:
                return
            # where an order came in says who gave it, whatever it says itself
            for instruct in self._link.receive():
                self._inbox.order(msgspec.structs.replace(instruct.order, origin="above"))
            for instruct in self._local.receive():
                self._inbox.order(msgspec.structs.replace(instruct.order, origin="local"))
            while self._link.refusals:
                self._inbox.report(refused(self._link.refusals.popleft(), self._clock()))
            if not readable:
                self._journal.prune(delivered_upto(delivered_path(Path(self._journal.path))))


def refused(refusal: Refusal, now_ns: int) -> tuple[Report, Report]:
    """Raised and cleared at once: a command that was refused is an occasion, not a state."""
    key = f"{refusal.reason}/{refusal.key}"
    detail = {"Reason": refusal.reason, "Key": refusal.key, "Count": refusal.count}
    text = f"{refusal.count} command{'' if refusal.count == 1 else 's'} refused: {refusal.reason}"
    return (Report(now_ns, COMMAND_REFUSED, key, True, detail, text), Report(now_ns, COMMAND_REFUSED, key, False, detail, text))
