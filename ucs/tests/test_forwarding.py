"""Journal to level 2, all of it: in one process as the demonstration has it, and in four processes that are killed at random."""
from __future__ import annotations

import random
import signal
import time
from pathlib import Path

from level1.io.journal import Journal, Reader, read_events
from level2.store import Arrival, Outcome, Store
from ucs.forwarding import Forwarding
from ucs.tests.chain import Chain, an_event, eventually

KILLS = 12


def test_events_reach_level_2_over_mqtt_inside_one_process(tmp_path: Path) -> None:
    arrivals: list[Arrival] = []
    path = tmp_path / "journal.db"
    with Journal(path, "tractor-7") as journal, \
            Forwarding(path, "tractor-7", "demo", tmp_path / "level2.db", arrivals.append, lambda line: None) as way:
        assert way.wait_online()
        journal.append([an_event(1), an_event(2)], b"")
        assert way.wait_delivered()
        journal.append([an_event(3)], b"")
        assert way.wait_delivered()
    assert [arrival.alarm.seq for arrival in arrivals] == [1, 2, 3]
    assert all(arrival.outcome is Outcome.NEW and not arrival.alarm.historical for arrival in arrivals)


def test_waiting_for_a_delivery_that_does_not_come_ends(tmp_path: Path) -> None:
    path = tmp_path / "journal.db"
    with Journal(path, "tractor-7") as journal, \
            Forwarding(path, "tractor-7", "demo", tmp_path / "level2.db", lambda arrival: None, lambda line: None) as way:
        way.receiver.stop()
        journal.append([an_event(1)], b"")
        assert not way.wait_delivered(0.2)


def test_random_kills_of_every_process_lose_nothing_and_double_nothing(tmp_path: Path) -> None:
    dice = random.Random(6)
    chain = Chain(tmp_path)

    def explain() -> str:
        return f"{chain.stored()} stored\n" + "\n".join(chain.log(name)[-2000:] for name in ("broker", "level2", "bridge"))

    try:
        eventually(lambda: chain.stored() > 5, explain)
        for _ in range(KILLS):
            name = dice.choice([*chain.commands])
            chain.kill(name)
            chain.start(name)
            time.sleep(dice.uniform(0.1, 0.8))
        eventually(lambda: len(chain.promised()) > 50, explain)
        for name in ("unit", "bridge", "level2"):
            chain.kill(name)
        with Reader(tmp_path / "journal.db") as reader:  # recovers, for good, a commit that the unit's end left half done
            written = reader.events(limit=10**6)
        up = {(name, word): chain.log(name).count(word) for name, word in (("bridge", "connected"), ("level2", "receiving"))}
        for name, _ in up:
            chain.start(name)
        eventually(lambda: chain.stored() >= len(written)
                   and all(chain.log(name).count(word) > before for (name, word), before in up.items()), explain)
        assert chain.kill("bridge", signal.SIGTERM) == 0
        assert chain.kill("level2", signal.SIGTERM) == 0
    finally:
        chain.close()
    promised = chain.promised()
    with Store(tmp_path / "level2.db") as store:
        found = store.events()
        assert found == written == read_events(tmp_path / "journal.db", limit=10**6)
        assert promised <= {(event.boot, event.seq) for event in found}
        assert (store.count("conflict"), store.count("lost"), store.gaps()) == (0, 0, {})
