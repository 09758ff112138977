"""One contender over a datagram socket that stands for the CAN socket, in a process of its own: `benchmarks.live` starts it.

CONTENDER FOLDER N RATE ALONE: `core`, `journal` (the same with its journal), `peer`, or `shipped` (only loads). RATE 0: the socket
is full. ALONE 1: before all other programs. Prints its figures as JSON.
"""
from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

from level1.io.socketcan import enlarge

FRAME = 16
PORTION = 200
"""Frames that wait in the socket at a time: what fits where the buffer may not be enlarged."""
Drain = Callable[[], int]


def main(contender: str, folder: str, count: str, rate: str, alone: str) -> None:
    """Measure one contender."""
    if contender == "shipped":
        kept = shipped(Path(folder))
        print(json.dumps({"rss_mb": resident_mb("VmHWM"), "alarms": kept}))
        return
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    enlarge(sock)
    sock.bind(("127.0.0.1", 0))
    handled: list[tuple[int, int]] = []
    drain = peer(sock, Path(folder), handled) if contender == "peer" else core(sock, Path(folder), handled, contender == "journal")
    if int(rate):
        settle_on(1, alone == "1")
        print(json.dumps(paced(sock, Path(folder), int(count), int(rate), drain, handled, alone)))
    else:
        print(json.dumps({"cpu_s": full(sock, Path(folder), int(count), drain)}))


def settle_on(core: int, alone: bool) -> None:
    """Run on a core of its own where there are several; alone: before all other programs. Raises PermissionError."""
    if (os.cpu_count() or 1) > 1:
        os.sched_setaffinity(0, {core})
    if alone:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def full(sock: socket.socket, folder: Path, count: int, drain: Drain) -> float:
    """CPU seconds to drain and judge frames that wait in the socket."""
    data = (folder / "frames.bin").read_bytes()
    spent = 0.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(sock.getsockname())
        for begin in range(0, count, PORTION):
            portion = min(PORTION, count - begin)
            for i in range(begin, begin + portion):
                sender.send(data[i * FRAME:i * FRAME + FRAME])
            start = time.process_time()
            done = 0
            while done < portion:
                done += drain()
            spent += time.process_time() - start
    return spent


def paced(sock: socket.socket, folder: Path, count: int, rate: int, drain: Drain, handled: list[tuple[int, int]],
          alone: str) -> dict[str, Any]:
    """CPU share and times from a frame's leaving the sender to its verdict. handled: (frames, ns) of each batch."""
    command = [sys.executable, "-m", "benchmarks.sender",
               *map(str, (sock.getsockname()[1], rate, count, folder / "frames.bin", alone))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as sender:
        done = drain()
        while not done:
            done = drain()
        cpu_s, start_s = time.process_time(), time.perf_counter()
        end_s = start_s + count / rate + 1
        while done < count and time.perf_counter() < end_s:
            done += drain()
        cpu_s, seconds = time.process_time() - cpu_s, time.perf_counter() - start_s
        sent = array("q")
        sent.frombytes(sender.communicate()[0])
    verdicts = [t_ns for frames, t_ns in handled for _ in range(frames)]
    late = sorted((verdict - left) / 1e6 for verdict, left in zip(verdicts, sent, strict=False))
    return {"cpu_percent": 100 * cpu_s / seconds, "p50_ms": late[len(late) // 2], "p99_ms": late[len(late) * 99 // 100],
            "worst_ms": late[-1], "lost": count - done, "rss_mb": resident_mb("VmRSS")}


class NoJournal:
    """The peer has none."""

    fault: str | None = None
    incidents: tuple[str, ...] = ()

    def append(self, events: object, state: bytes, commands: object = ()) -> bool:
        """Nothing is kept."""
        return True


def core(sock: socket.socket, folder: Path, handled: list[tuple[int, int]], journaled: bool) -> Drain:
    """The live loop as `ucs run` puts it together. journaled: every event is on the disk before the next frame is looked at."""
    import ucs.run  # noqa: F401  whatever it loads belongs to the memory
    from level1.bus_health import ALARMS
    from level1.io import definitions
    from level1.io.can import Port
    from level1.io.config import Bus
    from level1.io.inbox import Inbox
    from level1.io.journal import Journal
    from level1.io.live import Live
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
        handled.append((len(frames), clock()))
        return outputs
    supervisor.receive_many = judged  # type: ignore[method-assign]

    def drain() -> int:
        before = len(handled)
        live.turn(live.patience_s())
        return sum(frames for frames, _ in handled[before:])
    return drain


def peer(sock: socket.socket, folder: Path, handled: list[tuple[int, int]]) -> Drain:
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

    def drain() -> int:
        message = bus.recv(0.1)
        if message is None:
            return 0
        monitor.receive(message)
        handled.append((1, time.monotonic_ns()))
        return 1
    return drain


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
