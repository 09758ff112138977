"""One contender over a datagram socket that stands for the CAN socket, in a process of its own: `benchmarks.live` starts it.

CONTENDER FOLDER N RATE ALONE: `core`, `journal` (the same with its journal), `peer`, or `shipped` (only loads). RATE 0: the socket
is full. ALONE 1: before all other programs. Prints its figures as JSON.
"""
from __future__ import annotations

import json
import math
import os
import re
import resource
import socket
import subprocess
import sys
import threading
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from level1.io.socketcan import enlarge

FRAME = 16
PORTION = 200
"""Frames that wait in the socket at a time: what fits where the buffer may not be enlarged."""
GRACE_S = 2.0
"""So long after the last frame was sent frames that have not come are lost."""
GRAIN_S = 0.02


class Spent(NamedTuple):
    """What this process has used so far: CPU time of all its threads, user and system; times it went to sleep. clock_s: when."""

    cpu_s: float
    sleeps: int
    clock_s: float

    @classmethod
    def now(cls) -> Spent:
        """Until now."""
        return cls(time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw, time.perf_counter())


class Tally:
    """How many frames were judged, and when: in arrays, so that to note it costs next to nothing."""

    def __init__(self) -> None:
        self.frames, self.times_ns = array("q"), array("q")

    def note(self, frames: int) -> None:
        """So many frames have just been judged."""
        self.frames.append(frames)
        self.times_ns.append(time.monotonic_ns())

    def late_ms(self, sent_ns: array[int]) -> list[float]:
        """Times from a frame's leaving the sender to its verdict, the shortest first; none where frames were lost, because
        nobody knows which."""
        verdicts = [t_ns for frames, t_ns in zip(self.frames, self.times_ns, strict=True) for _ in range(frames)]
        if len(verdicts) != len(sent_ns):
            return [math.nan]
        return sorted((verdict - left) / 1e6 for verdict, left in zip(verdicts, sent_ns, strict=True))


class Contender(NamedTuple):
    """A program under test. drain: do all there is; run: go on until `stop` is called."""

    drain: Callable[[], None]
    run: Callable[[], None]
    stop: Callable[[], None]


def main(contender: str, folder: str, count: str, rate: str, alone: str) -> None:
    """Measure one contender."""
    if contender == "shipped":
        kept = shipped(Path(folder))
        print(json.dumps({"rss_mb": resident_mb("VmHWM"), "alarms": kept}))
        return
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    enlarge(sock)
    sock.bind(("127.0.0.1", 0))
    tally = Tally()
    made = peer(sock, Path(folder), tally) if contender == "peer" else core(sock, Path(folder), tally, contender == "journal")
    if int(rate):
        settle_on(1, alone == "1")
        print(json.dumps(paced(sock, Path(folder), (int(count), int(rate)), made, tally, alone)))
    else:
        print(json.dumps({"cpu_s": full(sock, Path(folder), int(count), made, tally)}))


def settle_on(core: int, alone: bool) -> None:
    """Run on a core of its own where there are several; alone: before all other programs. Raises PermissionError."""
    if (os.cpu_count() or 1) > 1:
        os.sched_setaffinity(0, {core})
    if alone:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def full(sock: socket.socket, folder: Path, count: int, contender: Contender, tally: Tally) -> float:
    """CPU seconds to drain and judge frames that wait in the socket."""
    data = (folder / "frames.bin").read_bytes()
    spent_s = 0.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(sock.getsockname())
        for begin in range(0, count, PORTION):
            portion = min(PORTION, count - begin)
            for i in range(begin, begin + portion):
                sender.send(data[i * FRAME:i * FRAME + FRAME])
            del tally.frames[:]
            start = time.process_time()
            while sum(tally.frames) < portion:
                contender.drain()
            spent_s += time.process_time() - start
    return spent_s


def paced(sock: socket.socket, folder: Path, planned: tuple[int, int], contender: Contender, tally: Tally,
          alone: str) -> dict[str, Any]:
    """What it costs to judge frames that come one by one, and how long after its leaving the sender each is. planned: frames,
    and how many of them a second."""
    count, rate = planned
    command = [sys.executable, "-m", "benchmarks.sender",
               *map(str, (sock.getsockname()[1], rate, count, folder / "frames.bin", alone))]
    sent = array("q")
    results: dict[str, Any] = {}

    def watch() -> None:
        """Beside the contender: measure while frames come, then stop it."""
        with subprocess.Popen(command, stdout=subprocess.PIPE) as sender:
            while not tally.frames and sender.poll() is None:
                time.sleep(GRAIN_S)
            begun, before = Spent.now(), sum(tally.frames)
            sent.frombytes(sender.communicate()[0])
            end_s = time.perf_counter() + GRACE_S
        used, done = Spent.now(), sum(tally.frames)
        while sum(tally.frames) < count and time.perf_counter() < end_s:
            time.sleep(GRAIN_S)
        contender.stop()
        seconds = used.clock_s - begun.clock_s
        results.update(cpu_percent=100 * (used.cpu_s - begun.cpu_s) / seconds, wakes_per_s=(used.sleeps - begun.sleeps) / seconds,
                       frames_per_s=(done - before) / seconds, rss_mb=resident_mb("VmRSS"), lost=count - sum(tally.frames))
    beside = threading.Thread(target=watch)
    beside.start()
    contender.run()
    beside.join()
    late = tally.late_ms(sent)
    return results | {"p50_ms": late[len(late) // 2], "p99_ms": late[len(late) * 99 // 100], "worst_ms": late[-1]}


class NoJournal:
    """The peer has none."""

    fault: str | None = None
    incidents: tuple[str, ...] = ()

    def append(self, events: object, state: bytes, commands: object = ()) -> bool:
        """Nothing is kept."""
        return True

    def record(self, monitors: object) -> None:
        """Nothing is kept."""


def core(sock: socket.socket, folder: Path, tally: Tally, journaled: bool) -> Contender:
    """The live loop as `ucs run` puts it together. journaled: every event is on the disk before the next frame is looked at."""
    import ucs.run  # noqa: F401  whatever it loads belongs to the memory
    from level1.bus_health import ALARMS
    from level1.io import definitions
    from level1.io.can import Port
    from level1.io.config import Bus
    from level1.io.inbox import Inbox
    from level1.io.journal import Journal
    from level1.io.live import Live, settle_memory
    from level1.io.socketcan import CLASSIC, Batches
    from level1.supervisor import Supervisor
    from ucs.uplink import Uplink

    class Wire(Batches):
        """A datagram socket where an interface belongs."""

        impossible = 0

        def fileno(self) -> int:
            return sock.fileno()

        def errors(self, bus: int) -> list[Any]:
            return []

        def listen(self, filters: object) -> None:
            pass

        def send(self, key: int, data: bytes) -> bool:
            return True

        def traffic(self) -> None:
            return None

        def close(self) -> None:
            pass

    sock.setblocking(False)
    clock = time.monotonic_ns
    catalog = definitions.load([str(folder / "live.dbc")])
    assert not set(ALARMS) & catalog.alarms.keys()
    inbox = Inbox()
    port = Port(0, Bus("bench", "none"), inbox, clock, time.time_ns, lambda *_: Wire(sock, CLASSIC, clock, time.time_ns))
    supervisor = Supervisor(catalog, unit="benchmark", broadcast=False, start_ns=clock())
    journal = Journal(folder / f"journal-{os.getpid()}.db", "benchmark").__enter__()
    live = Live(supervisor, journal if journaled else NoJournal(), [port], inbox, clock=clock, wall=time.time_ns,
                told=lambda _: None, notice=lambda text: print(text, file=sys.stderr), link=Uplink(journal, inbox, clock))
    port.start()
    receive_many = supervisor.receive_many

    def judged(frames: Any) -> Any:
        outputs = receive_many(frames)
        tally.note(len(frames))
        return outputs
    supervisor.receive_many = judged  # type: ignore[method-assign]
    settle_memory()
    return Contender(lambda: live.turn(live.patience_s()), live.run, live.stop)


def peer(sock: socket.socket, folder: Path, tally: Tally) -> Contender:
    """python-can's SocketCAN bus on the socket, cantools, rules: one frame a call."""
    import pickle

    import cantools
    from can.interfaces.socketcan.socketcan import SocketcanBus

    from benchmarks.peer import Monitor
    bus = object.__new__(SocketcanBus)
    bus.socket, bus.channel, bus.channel_info, bus._is_filtered, bus._filters = sock, "none", "none", False, None
    bus._is_shutdown, bus._periodic_tasks = True, []
    sock.setsockopt(socket.SOL_SOCKET, 35, 1)
    monitor = Monitor(cantools.database.load_file(folder / "live.dbc"), pickle.loads((folder / "rules.pickle").read_bytes()))

    def drain() -> None:
        message = bus.recv(0.1)
        if message is not None:
            monitor.receive(message)
            tally.note(1)
    stopped = threading.Event()

    def run() -> None:
        while not stopped.is_set():
            drain()
    return Contender(drain, run, stopped.set)


def shipped(folder: Path) -> int:
    """What `ucs run` holds before the first frame: all shipped definitions, a supervisor, a journal. Gives the alarms."""
    import dbc
    import ucs.run  # noqa: F401
    from level1.io import definitions
    from level1.io.inbox import Inbox
    from level1.io.journal import Journal
    from level1.supervisor import Supervisor
    from ucs.uplink import Uplink
    catalog = definitions.load(dbc.shipped())
    supervisor = Supervisor(catalog, unit="benchmark", start_ns=time.monotonic_ns(), monitor_ns=250_000_000)
    with Journal(folder / "shipped.db", "benchmark") as journal, Uplink(journal, Inbox(), time.monotonic_ns):
        supervisor.tick(time.monotonic_ns())
        return len(catalog.alarms)


def resident_mb(which: str) -> float:
    """Resident memory of this program: now (VmRSS) or at most (VmHWM)."""
    found = re.search(rf"^{which}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1]) / 1000


if __name__ == "__main__":
    main(*sys.argv[1:])
