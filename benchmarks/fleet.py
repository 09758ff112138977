"""A fleet at one receiver: `python -m benchmarks.fleet` runs 2,000 simulated units at 4 Hz against mosquitto and `level2`.

Each unit is an MQTT connection of its own that sends a monitoring message every 250 ms and an event every 10 s, and sends the
event again until it is acknowledged. Prints loss, delay from the unit's stamp to the receiver's disk or memory, CPU and memory;
`--write` puts them into docs/performance.md.
"""
from __future__ import annotations

import os
import random
import selectors
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks import page
from bridge import wire
from bridge.mqtt import Address
from level1.event import Event, Monitor, seconds
from level2.receiver import Receiver, Settings
from level2.store import Arrival, Store

FLEET = "farm"
PERIOD_NS = 250_000_000
EVENT_NS = 10_000_000_000
RETRY_NS = 2_000_000_000
MOSQUITTO = """\
listener {port} 127.0.0.1
allow_anonymous true
persistence false
set_tcp_nodelay true
max_queued_messages 0
log_type error
"""


class Unit:
    """A unit's side of MQTT by hand, cheap enough to have thousands of in one process."""

    def __init__(self, name: str, port: int):
        self.name = name
        self.samples = self.events = self.acknowledged = 0
        self.sample_due_ns = self.event_due_ns = 0
        self._pending: dict[int, tuple[bytes, int]] = {}
        self.socket = socket.create_connection(("127.0.0.1", port))
        client = name.encode()
        variable = b"\0\4MQTT\4\2\0\0" + len(client).to_bytes(2, "big") + client
        self.socket.sendall(b"\x10" + _length(len(variable)) + variable)
        assert self.socket.recv(4)[3] == 0, "refused"
        topic = wire.topic(FLEET, name, "ack").encode()
        subscribe = b"\0\1" + len(topic).to_bytes(2, "big") + topic + b"\0"
        self.socket.sendall(b"\x82" + _length(len(subscribe)) + subscribe)
        self.socket.recv(5)
        self.socket.setblocking(False)
        self._monitor = wire.topic(FLEET, name, "monitor", "motion")
        self._alarm = wire.topic(FLEET, name, "alarm")
        self._buffer = b""

    def turn(self, now_ns: int) -> None:
        """Send what is due."""
        if now_ns >= self.sample_due_ns:
            self.sample_due_ns += PERIOD_NS
            self.samples += 1
            values = {"speed": 3.0, "heading": 12.5, "x": 5.0, "y": 7.0}
            sample = Monitor(self.name, 1, seconds(time.monotonic_ns()), None, False, "motion", values, dict.fromkeys(values, 0.01),
                             dict.fromkeys(values, "ok"))
            self._publish(self._monitor, wire.encode(wire.monitor_message(sample, self.samples)))
        if now_ns >= self.event_due_ns:
            self.event_due_ns += EVENT_NS
            self.events += 1
            now = seconds(time.monotonic_ns())
            event = Event(self.name, 1, self.events, now, None, False, "NozzlesNotSet", 2109, "Medium", "raised", self.events,
                          0, {"SPRAYER_STATUS.Valves": 4095, "SPRAYER_CMD.Valves": 4094}, "Nozzles not set")
            payload = wire.encode(wire.alarm_message(event, self.events - 1, False))
            self._pending[self.events] = (payload, now_ns + RETRY_NS)
            self._publish(self._alarm, payload)
        for seq, (payload, due_ns) in list(self._pending.items()):
            if now_ns >= due_ns:
                self._pending[seq] = (payload, now_ns + RETRY_NS)
                self._publish(self._alarm, payload)

    def hear(self) -> None:
        """Take in acknowledgements."""
        self._buffer += self.socket.recv(65536)
        while len(self._buffer) > 2:
            length, used = _read_length(self._buffer[1:5])
            if len(self._buffer) < 1 + used + length:
                return
            packet, self._buffer = self._buffer[1 + used:1 + used + length], self._buffer[1 + used + length:]
            topic = int.from_bytes(packet[:2], "big")
            ack = wire.decode(packet[2 + topic:], wire.Ack)
            for seq in [seq for seq in self._pending if seq <= ack.seq]:
                del self._pending[seq]
                self.acknowledged += 1

    def _publish(self, topic: str, payload: bytes) -> None:
        name = topic.encode()
        body = len(name).to_bytes(2, "big") + name + payload
        self.socket.sendall(b"\x30" + _length(len(body)) + body)


def units(count: int, port: int, run_s: float) -> None:
    """The fleet's process: run it, then wait for the last acknowledgements and print what was sent."""
    selector = selectors.DefaultSelector()
    fleet = [Unit(f"unit-{number}", port) for number in range(count)]
    begin_ns = time.monotonic_ns()
    for unit in fleet:
        unit.sample_due_ns = begin_ns + random.randrange(PERIOD_NS)
        unit.event_due_ns = begin_ns + random.randrange(EVENT_NS)
        selector.register(unit.socket, selectors.EVENT_READ, unit)
    end_ns = begin_ns + int(run_s * 1e9)
    while (now_ns := time.monotonic_ns()) < end_ns:
        for unit in fleet:
            unit.turn(now_ns)
        for key, _ in selector.select(0.005):
            key.data.hear()
    drained_ns = end_ns + 10_000_000_000
    while any(unit.events > unit.acknowledged for unit in fleet) and time.monotonic_ns() < drained_ns:
        for key, _ in selector.select(0.05):
            key.data.hear()
    print(sum(unit.samples for unit in fleet), sum(unit.events for unit in fleet), sum(unit.acknowledged for unit in fleet))


class TimedReceiver(Receiver):
    """Notes how old each monitoring message is when it is taken in."""

    def __init__(self, settings: Settings, store: Store):
        self.delays_ns: list[int] = []
        self.event_delays_ns: list[int] = []
        self.quiet: list[str] = []
        super().__init__(settings, store, told=self._note, say=self.quiet.append)

    def _hear(self, topic: wire.Topic, sample: wire.MonitorMessage, now_ns: int) -> None:
        super()._hear(topic, sample, now_ns)
        self.delays_ns.append(time.monotonic_ns() - int(sample.t.scaleb(9)))

    def _note(self, arrival: Arrival) -> None:
        self.event_delays_ns.append(time.monotonic_ns() - int(arrival.alarm.t.scaleb(9)))


@contextmanager
def mosquitto(folder: Path) -> Iterator[tuple[int, int]]:
    """A broker; gives its port and process id."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    (folder / "mosquitto.conf").write_text(MOSQUITTO.format(port=port))
    program = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        sys.exit("apt-get install mosquitto")
    broker = subprocess.Popen([program, "-c", str(folder / "mosquitto.conf")], stderr=subprocess.DEVNULL)
    while socket.socket().connect_ex(("127.0.0.1", port)):
        time.sleep(0.05)
    try:
        yield port, broker.pid
    finally:
        broker.terminate()
        broker.wait()


def cpu_s(pid: int) -> float:
    """CPU time a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Memory a process has now."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def _length(length: int) -> bytes:
    out = bytearray()
    while True:
        length, rest = divmod(length, 128)
        out.append(rest | (128 if length else 0))
        if not length:
            return bytes(out)


def _read_length(data: bytes) -> tuple[int, int]:
    value = 0
    for index, byte in enumerate(data):
        value |= (byte & 127) << 7 * index
        if not byte & 128:
            return value, index + 1
    return 1 << 30, 0


def _delays(values_ns: list[int]) -> str:
    if not values_ns:
        return "unknown"
    ordered = sorted(values_ns)
    half, most, worst = (ordered[int((len(ordered) - 1) * share)] / 1e6 for share in (0.5, 0.99, 1))
    return f"p50 {half:.1f} ms, p99 {most:.1f} ms, worst {worst:.1f} ms"


def main() -> int:
    """Run and print; 1 when anything was lost."""
    parser = ArgumentParser(prog="python -m benchmarks.fleet", description=__doc__)
    parser.add_argument("--units", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--fleet-process", type=int, metavar="PORT", help="(the fleet's own process)")
    parser.add_argument("--write", action="store_true", help="write docs/performance.md")
    args = parser.parse_args()
    if args.fleet_process:
        units(args.units, args.fleet_process, args.seconds)
        return 0
    with tempfile.TemporaryDirectory(prefix="fleet-") as name, mosquitto(Path(name)) as (port, broker), \
            Store(Path(name) / "level2.db") as store:
        receiver = TimedReceiver(Settings(Address("127.0.0.1", port, False), FLEET), store)
        thread = threading.Thread(target=receiver.run)
        thread.start()
        command = [sys.executable, "-m", "benchmarks.fleet", "--units", str(args.units), "--seconds", str(args.seconds)]
        before = cpu_s(os.getpid()), cpu_s(broker)
        load = os.getloadavg()[0]
        fleet = subprocess.run([*command, "--fleet-process", str(port)], capture_output=True, text=True, check=True)
        used = cpu_s(os.getpid()) - before[0], cpu_s(broker) - before[1]
        memory = resident_mb(os.getpid()), resident_mb(broker)
        receiver.stop()
        thread.join()
        samples, events, acknowledged = map(int, fleet.stdout.split())
        stored = store.count("event")
    spent = os.times()
    silent = sum("silent" in line for line in receiver.quiet)
    lines = [
        f"| {args.units} units at 4 Hz for {args.seconds:g} s | |", "|---|---|",
        f"| monitoring messages | {samples} sent, {samples - len(receiver.delays_ns)} lost |",
        f"| their age when taken in | {_delays(receiver.delays_ns)} |",
        f"| events | {events} sent, {stored} stored, {acknowledged} acknowledged |",
        f"| their age on level 2's disk | {_delays(receiver.event_delays_ns)} |",
        f"| units told silent while they sent | {silent} |",
        *(f"| {who} | {cpu / args.seconds:.0%} of a core, {resident:.0f} MB |"
          for who, cpu, resident in zip(("receiver", "broker (mosquitto)"), used, memory, strict=True)),
        f"| the simulated units | {(spent.children_user + spent.children_system) / args.seconds:.0%} of a core |",
        f"| load of the machine before | {load:.1f} on {os.cpu_count()} cores |"]
    print(*lines, sep="\n")
    if args.write:
        page.put("fleet", lines)
    return 0 if stored == events == acknowledged and len(receiver.delays_ns) == samples else 1


if __name__ == "__main__":
    sys.exit(main())
