"""The whole way from a journal to level 2 inside one process, really over MQTT: for `ucs demo` and tests."""
from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from bridge.broker import EmbeddedBroker
from bridge.delivered import delivered_path, delivered_upto
from bridge.session import Bridge, BridgeThread, Settings
from level1.io.journal import Reader
from level2.receiver import Receiver, ReceiverThread
from level2.receiver import Settings as ReceiverSettings
from level2.store import Arrival, Store

POLL_S = 0.02


class Forwarding:
    """Embedded broker, bridge and receiver, each in a thread of its own; a context manager. Raises OutsideError.

    journal: of `unit`; it may be begun later. store: level 2's file. told: called, in the receiver's thread, with every
    event that level 2 has on its disk. say: called with lines about connections and trouble; say_bridge: with those of
    the bridge, where they are to be told apart.
    """

    def __init__(self, journal: Path, unit: str, fleet: str, store: Path, told: Callable[[Arrival], None],
                 say: Callable[[str], None], say_bridge: Callable[[str], None] | None = None):
        self.journal, self.unit = journal, unit
        self._stack = ExitStack()
        try:
            self.broker: EmbeddedBroker = self._stack.enter_context(EmbeddedBroker())
            level2 = self._stack.enter_context(Store(store))
            receiver = Receiver(ReceiverSettings(self.broker.address, fleet), level2, told=told, say=say)
            self.receiver: Receiver = self._stack.enter_context(ReceiverThread(receiver))
            settings = Settings(journal, unit, fleet, self.broker.address)
            self.bridge: Bridge = self._stack.enter_context(BridgeThread(settings, say_bridge or say))
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Forwarding:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the bridge, then the receiver, then the broker."""
        self._stack.close()

    def wait_online(self, timeout_s: float = 10.0) -> bool:
        """Wait until bridge and receiver are connected; the bridge connects once the journal exists."""
        return _wait(lambda: self.bridge.online and self.receiver.online, timeout_s)

    def wait_delivered(self, timeout_s: float = 10.0) -> bool:
        """Wait until level 2 has acknowledged every event that is in the journal now."""
        with Reader(self.journal) as reader:
            last = reader.last_seqs()
        delivered = delivered_path(self.journal)

        def arrived() -> bool:
            upto = delivered_upto(delivered)
            return all(upto.get(boot, 0) >= seq for boot, seq in last.items())

        return _wait(arrived, timeout_s)


def _wait(condition: Callable[[], bool], timeout_s: float) -> bool:
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(POLL_S)
    return True
