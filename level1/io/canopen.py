"""CANopen where it touches the world: data sheets (EDS) from disk, and the error history of a device, read by SDO.

The history is read only where the configuration says so (`history = true`), as that sends: requests to read object 0x1003, nothing
else, at most so many in a time. They leave by the live loop, through the gate that all goes through. The answers pass on the bus
like everything else, and the supervisor takes them from there (`level1.canopen`), so that a replay of the traffic says the same.
"""
from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import dbc
from level1.canopen import DEVICE_EMERGENCY, HISTORY, LIFE_FACTOR, MAX_HISTORY, SDO_ANSWER, SDO_REQUEST, Device
from level1.eds import MAX_SIZE, DataSheet, EdsError, parse
from level1.event import Event
from level1.io.config import SHORTEST_GUARD_NS, Bus, CanopenDevice, Config, ConfigError
from level1.io.error import did_you_mean

ANSWER_S = 0.3
"""A device that has not answered by then is not waited for any longer; the package has a time-out for each answer only."""
PAUSE_S = 10.0
"""Between two readings of one device's history."""
WAITING = 32
"""Readings that may wait; a bus with more emergencies than that has other troubles."""


def devices(settings: Config) -> tuple[Device, ...]:
    """The CANopen devices of a configuration, with what their data sheets say. Raises ConfigError with every mistake found."""
    found: list[Device] = []
    problems: list[str] = []
    for index, bus in enumerate(settings.bus):
        for place, device in enumerate(bus.canopen):
            try:
                found.append(_device(index, device))
            except EdsError as error:
                problems.append(f"{settings.path}: bus[{index}].canopen[{place}].eds: {device.eds} {error}")
    if problems:
        raise ConfigError(*problems)
    return tuple(found)


def _device(bus: int, device: CanopenDevice) -> Device:
    sheet = _sheet(device.eds) if device.eds is not None else DataSheet()
    heartbeat_ns = device.heartbeat_ns if device.heartbeat_ns is not None else sheet.heartbeat_ns
    guard_ns = device.guard_ns
    if guard_ns is None and not heartbeat_ns and sheet.guard_ns:  # a device that has both sends its heartbeat (CiA 301 §7.2.8.3.2)
        guard_ns = max(sheet.guard_ns, SHORTEST_GUARD_NS)
    return Device(bus, device.node, device.name or sheet.name, 0 if guard_ns else heartbeat_ns, device.required, sheet.errors,
                  guard_ns or None, device.life_factor or sheet.life_factor or LIFE_FACTOR, device.history)


def _sheet(name: str) -> DataSheet:
    """The data sheet in a file, or the shipped one of that name. Raises EdsError."""
    path = Path(name)
    if not path.exists() and path.name == name and (dbc.FOLDER / name).is_file():
        path = dbc.FOLDER / name
    try:
        with path.open("rb") as file:
            content = file.read(MAX_SIZE + 1)
    except OSError as error:
        near = did_you_mean(path.name, [file.name for file in dbc.FOLDER.glob("*.eds")])
        raise EdsError(f"can't be read ({error.strerror}){near}") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")
    try:
        return parse(text)
    except EdsError as error:
        raise EdsError(f"is no data sheet: {error}") from None


Ask = Callable[[int, int, bytes], None]


class HistoryReader:
    """Reads error histories in a thread of its own, so that supervision waits for no device.

    buses: of the configuration, by index. notice: told of a device that does not answer, in one line. ask: sends a request
    (bus, identifier, data), or refuses it. clock: monotonic, s.
    """

    def __init__(self, buses: Sequence[Bus], notice: Callable[[str], None], ask: Ask, clock: Callable[[], float] = time.monotonic):
        self.read = 0
        self._ask = ask
        self._buses = buses
        self._notice = notice
        self._clock = clock
        self._wanted = {(index, device.node) for index, bus in enumerate(buses) for device in bus.canopen if device.history}
        self._waiting: queue.Queue[tuple[int, int] | None] = queue.Queue(WAITING)
        self._asked_s: dict[tuple[int, int], float] = {}
        self._thread: threading.Thread | None = None
        self._stopping = False

    def told(self, event: Event) -> None:
        """An event: an emergency of a device whose history is wanted is followed by a reading. Never blocks."""
        if event.alarm != DEVICE_EMERGENCY or event.event != "raised":
            return
        device = event.values.get("Bus"), event.values.get("Node")
        if device not in self._wanted or self._clock() - self._asked_s.get(device, -PAUSE_S) < PAUSE_S:
            return
        try:
            self._waiting.put_nowait(device)
        except queue.Full:
            return
        self._asked_s[device] = self._clock()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="error histories", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the thread; readings that wait are dropped."""
        self._stopping = True
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join()
            self._thread = None

    def _work(self) -> None:
        while (device := self._waiting.get()) is not None and not self._stopping:
            bus, node = device
            try:
                with _Line(bus, self._buses[bus], node, self._ask) as line:
                    for _ in read_history(line, node):
                        pass
                self.read += 1
            except Exception as error:  # whatever a driver or the package raises: a thread that dies is worse
                why = str(error) or type(error).__name__
                self._notice(f"bus {self._buses[bus].name}: the error history of node {node} can't be read ({why})")


def read_history(line: Any, node: int) -> Iterator[int]:
    """The last errors of a device, newest first: what its object 0x1003 holds. line: as `_Line`. Raises the package's errors."""
    import canopen
    package: Any = canopen
    client = package.sdo.SdoClient(SDO_REQUEST + node, SDO_ANSWER + node, package.ObjectDictionary())
    client.network = client.responses = line
    client.RESPONSE_TIMEOUT = ANSWER_S
    count = int.from_bytes(client.upload(HISTORY, 0)[:1], "little")
    for place in range(1, min(count, MAX_HISTORY) + 1):
        yield int.from_bytes(client.upload(HISTORY, place)[:4], "little")


class _Line:
    """A bus for one conversation: hands requests on, sends nothing itself, and is the queue the package takes the answers from."""

    def __init__(self, index: int, bus: Bus, node: int, ask: Ask):
        import can
        self._index, self._ask = index, ask
        options: Mapping[str, Any] = {"bitrate": bus.bitrate, "fd": bus.fd or None, **bus.options}
        self._bus = can.Bus(interface=bus.interface, channel=bus.channel,
                            can_filters=[{"can_id": SDO_ANSWER + node, "can_mask": 0x7FF, "extended": False}],
                            **{name: value for name, value in options.items() if value is not None})
        self._answer = SDO_ANSWER + node

    def __enter__(self) -> _Line:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Have a request sent."""
        if not remote:
            self._ask(self._index, can_id, bytes(data))

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        """The next answer. Raises queue.Empty when none comes in time."""
        end_s = time.monotonic() + (timeout if timeout is not None else ANSWER_S)
        while (left_s := end_s - time.monotonic()) > 0:
            message = self._bus.recv(left_s)
            if message is not None and message.arbitration_id == self._answer and not message.is_extended_id \
                    and not message.is_error_frame and not message.is_remote_frame and len(message.data) == 8:
                return bytes(message.data)
        raise queue.Empty

    def empty(self) -> bool:
        """Nothing waits: the package would throw it away."""
        return True
