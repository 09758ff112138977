"""Every plug pulled while running: `python -m benchmarks.plugs` (about five minutes; `--write` puts the counts into
docs/reliability.md).

One `ucs run` with two CAN adapters (slcan), a GNSS receiver, a CANopen device, an implement, its journal and its recordings on
disks of their own, and the computer's temperature sensor. Each of them is pulled at random, in any order, several at a time, and
put in again; the computer is not restarted. Then the journal is compared with what was done: each pull told by its alarm from
when to when, no alarm without a pull, no event missing, and every frame that could not be sent or recorded in its counts. Exit
status 1 when that is not so.
"""
from __future__ import annotations

import io
import os
import random
import re
import signal
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import dbc
from benchmarks import page
from level1.decode import encode
from level1.event import Event
from level1.io import recorder
from level1.io.definitions import load
from level1.io.host import Places
from level1.io.journal import read_events
from level1.tests.lawicel import Adapter
from level1.tests.plug import FIX, Plug
from ucs import readings
from ucs.main import main as ucs

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
UNIT = """
[unit]
name = "tractor-7"
[[bus]]
name = "tractor"
interface = "slcan"
channel = "{folder}/ttyTractor"
dbc = ["ucs.dbc"]
options = {{ sleep_after_open = 0.0 }}
[[bus.canopen]]
node = 42
name = "Sensors"
heartbeat = "200 ms"
[[bus]]
name = "implement"
interface = "slcan"
channel = "{folder}/ttyImplement"
dbc = ["flaming_tool.dbc"]
options = {{ sleep_after_open = 0.0 }}
[gnss]
port = "{folder}/ttyGnss"
[recorder]
path = "card/traffic"
max_mb = 10
[journal]
path = "disk/journal.db"
"""
STATUS = load(["flaming_tool.dbc"]).messages["FLAMER_STATUS"]
SOON_S = 1.5
"""Beyond its own delays an alarm may come or go so much later, on a machine that does other things besides."""
START_S = 60.0


class Socket(NamedTuple):
    """Something that can be pulled. alarm: tells it, by the events that are its own. told_s, over_s: the longest from pulling and
    from plugging to the alarm, its delays included. bus: the one it hangs on, by the name of its socket: it is silent when that is
    out, too."""

    name: str
    alarm: str
    told_s: float
    over_s: float
    pull: Callable[[], None]
    plug: Callable[[], None]
    is_its: Callable[[Event], bool] = lambda event: True
    bus: str = ""


class Pull(NamedTuple):
    """What was done, in seconds of the monotonic clock."""

    socket: str
    out_s: float
    in_s: float


class Outcome(NamedTuple):
    """What came of it. problems: what is not as it has to be."""

    pulls: list[Pull]
    events: list[Event]
    not_sent: int
    not_recorded: int
    problems: list[str]


class Site:
    """The world of the unit: everything speaks, unless it is pulled. is_quick: alarms of disks go off after 1 s instead of 10, and
    the recorder tries again as soon."""

    def __init__(self, folder: Path, is_quick: bool):
        self.folder = folder
        self.off_s, self.retry_s = (1.0, 2.0) if is_quick else (10.0, 10.0)
        for name in ("disk", "card", "thermal"):
            (folder / name).mkdir()
        self._heat(True)
        self.tractor, self.implement = Adapter(folder / "ttyTractor"), Adapter(folder / "ttyImplement")
        self.gnss = Plug(folder / "ttyGnss")
        self.out: set[str] = set()
        self.flame = True
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._talk)
        self._thread.start()
        (folder / "unit.toml").write_text(UNIT.format(folder=folder))
        shipped = dbc.path("ucs.dbc").read_text(encoding="utf-8")
        if is_quick:
            shipped = re.sub(r'("AlarmOffDelay" SG_ \d+ (?:JournalFault|TrafficLogFailed)) 10000', r"\1 1000", shipped)
        (folder / "ucs.dbc").write_text(shipped, encoding="utf-8")

    def stop(self) -> None:
        """Everything ends."""
        self._ended.set()
        self._thread.join()
        self.tractor.stop()
        self.implement.stop()
        self.gnss.unplug()

    def sockets(self) -> list[Socket]:
        """What can be pulled."""
        def of_bus(name: str) -> Callable[[Event], bool]:
            return lambda event: event.values.get("Bus") == name
        return [
            Socket("CAN bus tractor", "CanBusDown", 0.5, 0.5, self.tractor.unplug, self.tractor.plug, of_bus("tractor")),
            Socket("CAN bus implement", "CanBusDown", 0.5, 0.5, self.implement.unplug, self.implement.plug, of_bus("implement")),
            Socket("GNSS receiver", "GnssNoData", 2.5, 3.5, *self._gnss()),
            Socket("CANopen device", "DeviceSilent", 0.7, 0.2, *self._silence("device"), bus="CAN bus tractor"),
            Socket("implement", "FlamerSilent", 1.0, 1.1, *self._silence("flamer"), bus="CAN bus implement"),
            Socket("disk of the journal", "JournalFault", 4.0, 2.5 + self.off_s, *self._away("disk")),
            Socket("card of the recordings", "TrafficLogFailed", 5.0, 2 + self.off_s + self.retry_s, *self._away("card")),
            Socket("temperature sensor", "HealthNotMeasured", 3.1, 1.1, lambda: self._heat(False), lambda: self._heat(True))]

    def _talk(self) -> None:
        counter = 0
        while not self._ended.wait(0.05):
            counter += 1
            if "device" not in self.out and counter % 4 == 0:
                self.tractor.hear(0x72A, b"\5")
            if "flamer" not in self.out:
                self.implement.hear(STATUS.can_id, encode(STATUS, {
                    "Flaming": 1, "PilotFlame": int(self.flame), "GasValve": 1, "AliveCounter": counter % 4}, None))
            with self._lock:
                if "gnss" not in self.out and counter % 4 == 0:
                    now = time.time()
                    stamp = time.strftime("%H%M%S", time.gmtime(now)) + f".{int(now * 100) % 100:02d}"
                    self.gnss.say(FIX.replace("120000.00", stamp))

    def _silence(self, who: str) -> tuple[Callable[[], None], Callable[[], None]]:
        return lambda: self.out.add(who), lambda: self.out.discard(who)

    def _gnss(self) -> tuple[Callable[[], None], Callable[[], None]]:
        def pull() -> None:
            with self._lock:
                self.out.add("gnss")
                self.gnss.unplug()

        def plug() -> None:
            with self._lock:
                self.gnss.plug()
                self.out.discard("gnss")
        return pull, plug

    def _away(self, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
        """A folder is gone, and a file of its name takes no files."""
        here, there = self.folder / name, self.folder / f"{name}.out"

        def pull() -> None:
            here.rename(there)
            here.write_text("")

        def plug() -> None:
            here.unlink()
            there.rename(here)
        return pull, plug

    def _heat(self, is_in: bool) -> None:
        zone = self.folder / "thermal" / "thermal_zone0"
        if is_in:
            zone.mkdir()
            (zone / "type").write_text("cpu-thermal")
            (zone / "temp").write_text("50000")
        else:
            for name in ("type", "temp"):
                (zone / name).unlink()
            zone.rmdir()


def pull(count: int, dice: random.Random, folder: Path, progress: Callable[[str], None], is_quick: bool = False) -> Outcome:
    """Pull so many plugs, each as often as the others, in any order, and judge what the journal tells."""
    site = Site(folder, is_quick)
    pulls: list[Pull] = []
    failed: list[BaseException] = []
    sockets = site.sockets()
    turns = Counter(sockets[number % len(sockets)].name for number in range(count))

    def story() -> None:
        try:
            _until(lambda: bool(site.tractor.sent and site.implement.sent), START_S)
            time.sleep(3)
            hands = [threading.Thread(target=_serve, args=(
                socket, turns[socket.name], random.Random(dice.random()), pulls, progress)) for socket in sockets]
            for hand in hands:
                hand.start()
            for hand in hands:
                hand.join()
            site.implement.sent.clear()
            site.flame = False
            _until(lambda: any(line.startswith("t650") and int(line[5:7], 16) & 3 for line in site.implement.sent), START_S)
        except BaseException as error:
            failed.append(error)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
    teller = threading.Thread(target=story)
    said = io.StringIO()
    try:
        with _sensor_of(folder), _recorder_tries(is_quick), redirect_stdout(said):
            teller.start()
            code = ucs(["run", str(folder / "unit.toml")])
        teller.join()
    finally:
        site.stop()
    if failed:
        raise failed[0]
    events = list(read_events(folder / "disk" / "journal.db", limit=10**6))
    problems = [f"`ucs run` ended with {code}"] * (code != 0)
    for socket in sockets:
        told = [event for event in events if event.event in ("raised", "cleared")  # a repair only says what it would do
                and event.alarm == socket.alarm and socket.is_its(event)]
        problems += _misjudged_on_a_bus(socket, pulls, told) if socket.bus else _misjudged(socket, pulls, told)
    ends = said.getvalue()
    not_sent, not_recorded = _unsent(events), _unrecorded(events)
    problems += _compare("frames not sent", not_sent, _count(ends, r"(\d+) (?:dropped|expired|failed)\b"))
    problems += _compare("frames not recorded", not_recorded, _count(ends, r"(\d+) frames not recorded"))
    seqs = [event.seq for event in events]
    if seqs != list(range(1, len(seqs) + 1)):
        problems.append(f"{len(seqs)} events in the journal, numbered {seqs[0]} to {seqs[-1]}")
    return Outcome(sorted(pulls, key=lambda one: one.out_s), events, not_sent, not_recorded, problems)


def _serve(socket: Socket, times: int, dice: random.Random, pulls: list[Pull], progress: Callable[[str], None]) -> None:
    """Pull one plug again and again; each time long enough that its alarm has to come, and to go."""
    time.sleep(dice.uniform(0, 3))
    for _ in range(times):
        out_s = time.monotonic()
        socket.pull()
        time.sleep(socket.told_s + SOON_S + dice.uniform(0, 2))
        in_s = time.monotonic()
        socket.plug()
        pulls.append(Pull(socket.name, out_s, in_s))
        progress(f"{len(pulls)} plugs pulled")
        time.sleep(socket.over_s + SOON_S + dice.uniform(0, 2))


def _misjudged(socket: Socket, pulls: list[Pull], told: list[Event]) -> Iterator[str]:
    """Where what the journal tells of a socket is not what was done."""
    pulls = [one for one in pulls if one.socket == socket.name]
    if [event.event for event in told] != ["raised", "cleared"] * len(pulls):
        yield f"{socket.name}: pulled {len(pulls)} times, told {Counter(event.event for event in told)}"
        return
    for done, raised, cleared in zip(pulls, told[::2], told[1::2], strict=True):
        late_s, over_s = float(raised.t) - done.out_s, float(cleared.t) - done.in_s
        if not 0 <= late_s <= socket.told_s + SOON_S or not 0 <= over_s <= socket.over_s + SOON_S:
            yield f"{socket.name}: told {late_s:.2f} s after it was pulled, over {over_s:.2f} s after it was put in again"
        away_s = cleared.values.get("AwaySeconds")
        if away_s is not None and abs(away_s - (done.in_s - done.out_s)) > SOON_S:
            yield f"{socket.name}: out for {done.in_s - done.out_s:.2f} s, and away for {away_s} s by the journal"


def _misjudged_on_a_bus(socket: Socket, pulls: list[Pull], told: list[Event]) -> Iterator[str]:
    """The same of one that is silent also when its bus is out: each pull is within what was told, and all that was told within
    pulls of the two."""
    if [event.event for event in told] != ["raised", "cleared"] * (len(told) // 2):
        yield f"{socket.name}: told {Counter(event.event for event in told)}"
        return
    spans = [(float(raised.t), float(cleared.t)) for raised, cleared in zip(told[::2], told[1::2], strict=True)]
    for one in pulls:
        late_s = one.out_s + socket.told_s + SOON_S
        if one.socket == socket.name and not any(begin <= late_s and one.in_s <= end for begin, end in spans):
            yield f"{socket.name}: pulled for {one.in_s - one.out_s:.1f} s and not told"
    for begin, end in spans:
        whose = [one for one in pulls if one.socket in (socket.name, socket.bus)]
        if not any(one.out_s <= begin <= one.in_s + SOON_S for one in whose) or \
                not any(one.in_s <= end <= one.in_s + socket.over_s + 2 * SOON_S for one in whose):
            yield f"{socket.name}: told from {begin:.2f} to {end:.2f} s, when it was in"


def _unsent(events: list[Event]) -> int:
    """Frames that could not be sent, by the journal."""
    return sum(sum(event.values.get("NotSent", {}).values()) for event in events
               if event.event == "cleared" and event.alarm in ("CanBusDown", "SendFailed"))


def _unrecorded(events: list[Event]) -> int:
    """Frames that were not recorded, by the journal."""
    return max((event.values["UCS_LOAD.TrafficLogDropped"] for event in events if event.alarm == "TrafficLogFailed"), default=0)


def _count(text: str, pattern: str) -> int:
    """What the run counted itself, as it says at its end."""
    return sum(map(int, re.findall(pattern, text)))


def _compare(what: str, by_journal: int, by_run: int) -> Iterator[str]:
    if by_journal != by_run:
        yield f"{what}: {by_journal} by the journal, {by_run} by the run"


@contextmanager
def _recorder_tries(is_quick: bool) -> Iterator[None]:
    """The recorder tries again, and is well again, after a second."""
    second = 1_000_000_000
    with patch.object(recorder, "RETRY_NS", second if is_quick else recorder.RETRY_NS), \
            patch.object(recorder, "TOLD_NS", second if is_quick else recorder.TOLD_NS):
        yield


@contextmanager
def _sensor_of(folder: Path) -> Iterator[None]:
    """The computer has one sensor, which the site has in its hands."""
    def places(storage: Path) -> Places:
        return Places(storage=folder, thermal=folder / "thermal", hwmon=folder / "none")
    with patch.object(readings, "Places", places):
        yield


def _until(happened: Callable[[], bool], within_s: float) -> None:
    end = time.monotonic() + within_s
    while not happened():
        if time.monotonic() > end:
            raise TimeoutError("the unit does not work")
        time.sleep(0.01)


def lines(outcome: Outcome) -> list[str]:
    """The table of the page."""
    counts = Counter(one.socket for one in outcome.pulls)
    away = Counter[str]()
    for one in outcome.pulls:
        away[one.socket] += round(1000 * (one.in_s - one.out_s))
    rows = [(name, str(count), f"{away[name] / 1000:.0f} s") for name, count in counts.items()]
    return [*page.table(("plug", "pulled", "out for"), sorted(rows)), "",
            f"{len(outcome.pulls)} plugs pulled, each told from when to when; {len(outcome.events)} events, none missing; "
            f"{outcome.not_sent} frames not sent and {outcome.not_recorded} not recorded, each in the journal's counts."]


def main() -> int:
    """Pull, print and write."""
    parser = ArgumentParser(prog="python -m benchmarks.plugs", description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="plugs to pull (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the dice (default %(default)s)")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="plugs-") as name:
        outcome = pull(args.count, random.Random(args.seed), Path(name), lambda text: print(f"\r{text}", end="", file=sys.stderr))
    print(*lines(outcome), *outcome.problems, sep="\n")
    if args.write and not outcome.problems:
        page.put("plugs: python -m benchmarks.plugs --write", lines(outcome), PAGE)
    return 1 if outcome.problems else 0


if __name__ == "__main__":
    sys.exit(main())
