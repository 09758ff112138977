"""Nothing lost, no stranger obeyed, at length: `python -m benchmarks.soak` (a quarter of an hour; `--quick`: a tenth). Needs Go.

Each trial counts what went in and what came out; `--write` puts the counts into docs/reliability.md. Exit status 1 when a count
is not what it has to be.
"""
from __future__ import annotations

import base64
import os
import random
import signal
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from benchmarks import faults, killed_unit, nats, page, powercut
from benchmarks.chain import peak_kb
from bridge import wire
from bridge.gate import Gate, Passed, Refused
from bridge.keys import Key, public_bytes
from bridge.signing import signed
from level1.event import seconds
from level1.io.journal import Journal, read_events
from level2.store import Store
from ucs.tests.chain import Chain, an_event, eventually

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
S = 1_000_000_000


class Row(NamedTuple):
    """A line of the table: what was done, how often, what came of it; good: as it has to be."""

    fault: str
    often: str
    outcome: str
    good: bool


def kill_processes(events: int, dice: random.Random, nats_server: str = "") -> Row:
    """SIGKILL to unit, bridge, broker and receiver in any order while events flow."""
    kills: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = Path(name)
        chain = Chain(folder, 0.003, nats_server)
        try:
            eventually(lambda: chain.stored() > 0, lambda: chain.log("level2"))
            while chain.stored() < events:
                victim = dice.choice([*chain.commands])
                chain.kill(victim)
                chain.start(victim)
                kills[victim] += 1
                time.sleep(dice.uniform(0.1, 1.5))
                _progress(f"{sum(kills.values())} kills, {chain.stored()} of {events} events at level 2")
            chain.kill("unit")
            written = read_events(folder / "journal.db", limit=10**7)
            end = time.monotonic() + len(written) / 50 + 60
            while chain.stored() < len(written) and time.monotonic() < end:
                time.sleep(0.1)
            chain.kill("bridge", signal.SIGTERM)
            chain.kill("level2", signal.SIGTERM)
        finally:
            chain.close()
        promised = chain.promised()
        with Store(folder / "level2.db") as store:
            found = store.events()
            conflicts, lost = store.count("conflict"), store.count("lost")
    identities = {(event.boot, event.seq) for event in found}
    missing, doubled = len(promised - identities), len(found) - len(identities)
    killed = ", ".join(f"{name} {count}" for name, count in sorted(kills.items()))
    return Row(f"SIGKILL of unit, bridge, broker{' (NATS)' * bool(nats_server)}, receiver in any order",
               f"{sum(kills.values())} kills ({killed}), {len(written)} events",
               f"{missing} lost, {doubled} doubled, {conflicts} identities given twice",
               found == written and not missing and not doubled and not conflicts and not lost)


def kill_processes_on_nats(events: int, dice: random.Random) -> Row:
    """The same with NATS, through its MQTT listener, as the broker."""
    return kill_processes(events, dice, nats.server())


def try_nats(_: int, dice: random.Random) -> Row:
    """The bridge's tests with NATS as the broker."""
    passed, bad, _text = nats.run_tests(nats.server())
    return Row("NATS as the broker, through its MQTT listener, with and without mutual TLS", f"{passed + bad} tests of the bridge",
               f"{bad} failed", passed > 0 and not bad)


def kill_writer(kills: int, dice: random.Random) -> Row:
    """SIGKILL to the journal's writer, each time at another moment."""
    promised: set[tuple[int, int]] = set()
    boots: list[int] = []
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        path = Path(name) / "journal.db"
        for number in range(kills):
            reader, writer = os.pipe()
            child = os.fork()
            if child == 0:
                _write_until_killed(path, writer)
            os.close(writer)
            with open(reader, "rb") as output:
                first = output.readline()
                time.sleep(dice.uniform(0, 0.02))
                os.kill(child, signal.SIGKILL)
                lines = [first, *output]
            os.waitpid(child, 0)
            done = [line.split() for line in lines if line.endswith(b"\n")]
            promised |= {(int(boot), int(seq)) for boot, seq in done}
            boots += [int(boot) for boot, _ in done[:1]]
            if number % 50 == 49:
                _progress(f"{number + 1} kills, {len(promised)} events promised")
        found = [(event.boot, event.seq) for event in read_events(path, limit=10**7)]
    lost, reused = len(promised - set(found)), len(boots) - len(set(boots))
    return Row("SIGKILL of the journal's writer", f"{kills} kills, {len(promised)} acknowledged commits",
               f"{lost} lost, {reused} boot ids reused", not lost and not reused and len(set(found)) == len(found))


def _write_until_killed(path: Path, output: int) -> None:
    try:
        journal = Journal(path, "tractor-7")
        seq = 0
        while True:
            seq += 1
            if journal.append([an_event(seq, journal.boot)], b"state"):
                os.write(output, b"%d %d\n" % (journal.boot, seq))
    finally:
        os._exit(1)


def kill_unit(kills: int, dice: random.Random) -> Row:
    """SIGKILL to a whole `ucs run` in the middle of repairs."""
    outcome = killed_unit.kill(kills, dice)
    for problem in outcome.problems:
        print(f"\n  {problem}")
    return Row("SIGKILL of `ucs run` in the middle of repairs",
               f"{kills} kills, {outcome.told} events told, {outcome.sent.total()} commands on the bus",
               f"{len(outcome.problems)} told or sent and not in the journal; {outcome.sent['ValveStuck']} attempts of a budget of "
               f"{killed_unit.BUDGET}", outcome.told > kills and outcome.sent.total() > kills and not outcome.problems)


def cut_power(cuts: int, dice: random.Random) -> Row:
    """The power goes while the journal is written; judged by the next boot."""
    outcome = powercut.cut(cuts, dice)
    reused = len(outcome.boots) - len(set(outcome.boots))
    return Row("power cut (User Mode Linux killed over a disk image)", f"{cuts} cuts, {len(outcome.promised)} acknowledged commits",
               f"{len(outcome.lost)} lost, {reused} boot ids reused, {len(outcome.incidents)} corrupt",
               not outcome.lost and not reused and not outcome.incidents and len(outcome.boots) == cuts + 1)


FORGERIES: dict[str, str] = {
    "of a stranger": "unknown key", "with another's signature": "wrong signature", "changed on the way": "wrong signature",
    "for another unit": "wrong signature", "for another fleet": "wrong signature", "of an earlier boot": "for boot",
    "expired": "expired", "valid for too long": "valid for longer", "from the future": "from the future",
    "replayed with its counter": "its counter was used before", "beyond the role": "the role", "malformed": "malformed",
}
"""Kind of a bad command -> how its refusal begins."""


def forge_commands(count: int, dice: random.Random) -> Row:
    """Bad commands of every kind among good ones."""
    chief, guest, stranger = (Ed25519PrivateKey.from_private_bytes(dice.randbytes(32)) for _ in range(3))
    keys = {"chief": Key("chief", "reset", public_bytes(chief)), "guest": Key("guest", "view", public_bytes(guest))}
    wrong: Counter[str] = Counter()
    obeyed = 0
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        gate = Gate(Path(name) / "commands", "farm", "tractor-7", keys, 0)
        base_kb = 0
        for number in range(1, count + 1):
            now_ns = 1_000_000 * S + number * 1_000_000
            order = wire.Order(unit="tractor-7", boot=3, seq=number + 1, t=seconds(now_ns), id=f"c-{number}", name="pause",
                               expires_t=seconds(now_ns + 5 * S))
            if number % 1000 == 1:
                assert isinstance(gate.decide(wire.encode(signed(order, "farm", "chief", chief)), 3, now_ns), Passed)
                continue
            kind = dice.choice([*FORGERIES])
            decision = gate.decide(_forged(kind, order, (chief, guest, stranger), dice), 3, now_ns)
            obeyed += isinstance(decision, Passed)
            wrong[kind] += not (isinstance(decision, Refused) and decision.reason.startswith(FORGERIES[kind]))
            if number == count // 5:
                base_kb = peak_kb()
            if number % 5000 == 0:
                _progress(f"{number} of {count} commands")
        grown_kb = peak_kb() - base_kb
        gate.close()
    misjudged = sum(wrong.values())
    return Row("forged, replayed, expired, re-targeted, malformed commands", f"{count} of {len(FORGERIES)} kinds",
               f"{obeyed} obeyed, {misjudged} refused for another reason, memory +{grown_kb / 1024:.1f} MB",
               not obeyed and not misjudged and grown_kb < 4096)


def _forged(kind: str, order: wire.Order, keys: tuple[Ed25519PrivateKey, ...], dice: random.Random) -> bytes:
    from msgspec.structs import replace
    chief, guest, stranger = keys
    changes: dict[str, Callable[[], wire.Command]] = {
        "of a stranger": lambda: signed(order, "farm", "nobody", stranger),
        "with another's signature": lambda: signed(order, "farm", "chief", stranger),
        "changed on the way": lambda: replace(good, body=good.body.replace('"pause"', '"reset"')),
        "for another unit": lambda: signed(replace(order, unit="tractor-8"), "farm", "chief", chief),
        "for another fleet": lambda: signed(order, "other", "chief", chief),
        "of an earlier boot": lambda: signed(replace(order, boot=2), "farm", "chief", chief),
        "expired": lambda: signed(replace(order, t=order.t - 20, expires_t=order.t - 1), "farm", "chief", chief),
        "valid for too long": lambda: signed(replace(order, expires_t=order.t + 31), "farm", "chief", chief),
        "from the future": lambda: signed(replace(order, t=order.t + 3), "farm", "chief", chief),
        "replayed with its counter": lambda: signed(replace(order, seq=1 + dice.randrange(2)), "farm", "chief", chief),
        "beyond the role": lambda: signed(replace(order, name=dice.choice(["stop", "reset", "pause"])), "farm", "guest", guest),
        "malformed": lambda: replace(good, body="", signature=base64.b64encode(dice.randbytes(9)).decode()),
    }
    good = signed(order, "farm", "chief", chief)
    if kind == "malformed":
        text = wire.encode(good)
        return text[:dice.randrange(len(text) - 1)]
    return wire.encode(changes[kind]())


def _progress(text: str) -> None:
    print(f"\r  {text}\x1b[K", end="" if sys.stdout.isatty() else "\n", flush=True)


def put_into_page(rows: list[Row]) -> None:
    """Replace the counts in docs/reliability.md; the rest of the page is written by hand."""
    lines = (f"| {row.fault} | {row.often} | {row.outcome} |" for row in rows)
    page.put("counts", ["| fault | how often | outcome |", "|---|---|---|", *lines], PAGE)


def main() -> int:
    """Run the trials and print the table."""
    parser = ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of everything")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--seed", type=int, default=1, help="of the dice (default %(default)s)")
    args = parser.parse_args()
    nats.server()  # built before anything else: without Go it is said now, not in the end
    share = 10 if args.quick else 1
    dice = random.Random(args.seed)
    trials: list[tuple[Callable[[int, random.Random], Row], int]] = [
        (kill_writer, 1000), (kill_unit, 100), (forge_commands, 100_000), (cut_power, 20), (kill_processes, 10_000),
        (try_nats, 0), (kill_processes_on_nats, 2_000)]
    rows: list[Row] = []
    for trial, count in trials:
        print(f"{trial.__name__.replace('_', ' ')}", flush=True)
        rows.append(trial(max(2, count // share), dice))
        print(f"\r{'good' if rows[-1].good else 'BAD'}: {rows[-1].fault}: {rows[-1].often}: {rows[-1].outcome}\x1b[K", flush=True)
    found, told = faults.gather(run=True)
    cases, passed = sum(fault.cases for fault in found), sum(fault.passed for fault in found)
    good = cases == passed > 0
    print(f"{'good' if good else 'BAD'}: {len(found)} faults in {cases} tests: {passed} passed")
    if args.write and good:
        put_into_page(rows)
        faults.put_into_page(found)
    return 0 if good and all(row.good for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
