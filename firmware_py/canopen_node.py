"""A CANopen device (CiA 301) as a node: NMT, heartbeat, emergencies, SDO, PDOs, by the package `canopen` in the node's own time.

Theory of operation. `canopen.LocalNode` keeps the object dictionary of the EDS and answers SDO and NMT. It wants a network: `Wire`
is one that only collects what it sends, heartbeat included, until the node steps. What a PDO holds is described twice and is the
same (a test says so): as messages and signals in the DBC, which the node computes with, and as mapped objects in the EDS.

    off ──power on, reset──▶ boot-up message ──▶ pre-operational ──NMT start──▶ operational
                                 ▲                     ◀──enter pre-operational──  │
                                 └── NMT reset, after `REBOOT_NS` ◀── any state ◀──┴──NMT stop──▶ stopped

PDOs go and are taken only in operational: when their event timer has run out, or when something has changed and their inhibit time
is over. Emergencies go in all states but stopped; an emergency stays in the error register and in the error history
(objects 0x1001, 0x1003) until it is over.
"""
from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar

import dbc
from firmware_py.codec import Codec
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.participant import BusFrame

REBOOT_NS = 800_000_000
"""From an NMT command to reset to the boot-up message."""
NMT_COMMAND = 0
OPERATIONAL, STOPPED, PRE_OPERATIONAL, INITIALISING = 5, 4, 127, 0
RESET_NODE, RESET_COMMUNICATION = 129, 130
ERROR_REGISTER, ERROR_FIELD, HEARTBEAT_PRODUCER = 0x1001, 0x1003, 0x1017
HISTORY = 8
"""Errors that the history keeps."""
GENERIC = 0x01
REGISTER_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x80}
"""Bits of the error register, by the first digit of the error code; each error sets the generic bit as well."""
SUPPLY_LOW = 0x3120

CANOPEN_FAULTS = (
    Phrase("", "emergency", "reports that its supply voltage is too low"),
    Phrase("", "babbling", "sends status, heartbeat and emergencies without a pause"),
    Phrase("", "heartbeat off", "sends no heartbeat any more, but works on"),
    Phrase("", "stopped", "has been stopped by a stray NMT command", lasts=False),
    *COMMON_FAULTS,
)

# The package tells its log what it also does; nobody reads it here.
logging.getLogger("canopen").addHandler(logging.NullHandler())


class Periodic:
    """A message that the package wants to be sent again and again."""

    def __init__(self, wire: Wire, can_id: int, data: bytes, period_ns: int):
        self._wire = wire
        self.can_id, self.data, self.period_ns = can_id, bytes(data), period_ns
        self.due_ns = wire.now_ns + period_ns

    def update(self, data: bytes) -> None:
        """Send this from now on."""
        self.data = bytes(data)

    def stop(self) -> None:
        """Send it no more."""
        self._wire.periodic.remove(self)


class Wire:
    """What the package takes for a network: frames gather in `sent`, periodic ones when `advance` finds them due."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns
        self.sent: list[BusFrame] = []
        self.periodic: list[Periodic] = []
        self._subscribers: dict[int, list[Callable[[int, bytearray, float], None]]] = {}

    def subscribe(self, can_id: int, callback: Callable[[int, bytearray, float], None]) -> None:
        """Hear an identifier."""
        self._subscribers.setdefault(can_id, []).append(callback)

    def unsubscribe(self, can_id: int, callback: Callable[[int, bytearray, float], None] | None = None) -> None:
        """Hear it no more."""
        self._subscribers[can_id] = [one for one in self._subscribers.get(can_id, ()) if callback not in (None, one)]

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """A frame to send."""
        self.sent.append(BusFrame(can_id, False, bytes(data)))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Periodic:
        """A frame to send every so many seconds."""
        task = Periodic(self, can_id, bytes(data), round(period * 1e9))
        self.periodic.append(task)
        return task

    def notify(self, can_id: int, data: bytes) -> bool:
        """Hand a frame to those who hear it; False when it made no sense to them."""
        try:
            for callback in self._subscribers.get(can_id, ()):
                callback(can_id, bytearray(data), self.now_ns / 1e9)
        except (struct.error, IndexError, TypeError):
            return False
        return True

    def advance(self, now_ns: int) -> None:
        """Time has passed."""
        self.now_ns = now_ns
        for task in self.periodic:
            if task.due_ns <= now_ns:
                task.due_ns += task.period_ns * (1 + (now_ns - task.due_ns) // task.period_ns)
                self.sent.append(BusFrame(task.can_id, False, task.data))

    def take(self) -> list[BusFrame]:
        """What gathered."""
        sent, self.sent = self.sent, []
        return sent


class CanopenNode(Node):
    """Base of CANopen nodes. A subclass also names its EDS and node id; SENDS are its TPDOs in order, HEARS what it hears.

    `tick` is for the device's own work, `reboot` puts it back to where it stands after switching on. device: the package's node.
    errors: those that last, by code and maker's bytes, and whether the emergency, which is sent once, has left the device.
    ended_unheard: the end of one has not: who heard of it still believes in it, until a boot-up or the end of all errors is heard.
    """

    EDS: ClassVar[str] = ""
    NODE_ID: ClassVar[int] = 0
    FAULTS: ClassVar[tuple[Phrase, ...]] = CANOPEN_FAULTS

    def __init__(self, name: str, codec: Codec, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        self.errors: dict[tuple[int, bytes], bool] = {}
        self.ended_unheard = False
        self.wire = Wire(start_ns)
        self.device = _local_node(self.EDS, self.NODE_ID)
        self.device.associate_network(self.wire)
        self.device.tpdo.read(from_od=True)
        self.device.rpdo.read(from_od=True)
        self.device.add_read_callback(self._mapped)
        self.device.add_write_callback(self._written)
        self._due_ns.clear()
        self._pdos = {message: self.device.tpdo[number] for number, message in enumerate(self.SENDS, 1)}
        self._sent_ns: dict[str, int] = {}
        self._babbles = False
        self._start_up(start_ns)

    # --- participant ------------------------------------------------------------------------------------------------------

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """Hear a frame: SDO requests and NMT commands for the package, messages of `HEARS` when operational."""
        if not extended and self.powered and not self._frozen and (self.nmt_state != STOPPED or can_id == NMT_COMMAND):
            self.wire.now_ns = t_ns
            if not self.wire.notify(can_id, data):
                self.short_frames += 1
            if can_id == NMT_COMMAND:
                self._commanded(t_ns, data)
        if self.nmt_state == OPERATIONAL or (can_id, extended) in self._own:
            super().receive(t_ns, can_id, extended, data)

    def hears(self, can_id: int, extended: bool) -> bool:
        """Every frame of CANopen: the package decides."""
        return not extended or super().hears(can_id, extended)

    def step(self, now_ns: int) -> list[BusFrame]:
        """All ticks up to now, and the frames that are due."""
        super().step(now_ns)
        self.wire.advance(now_ns)
        for message, pdo in self._pdos.items():
            if self.powered and self.nmt_state == OPERATIONAL and self._is_due(now_ns, message, pdo):
                frame = self._frame(message)
                if frame is not None:
                    self._sent_ns[message] = now_ns
                    pdo.data = bytearray(frame.data)
                    pdo.transmit()
        if self._babbles:
            self._babble(now_ns)
        frames = self.wire.take()
        return frames if self.powered and not self._silent else []

    def next_deadline(self) -> int | None:
        """The next tick; at once while an answer waits."""
        return self.wire.now_ns if self.wire.sent else super().next_deadline()

    @property
    def nmt_state(self) -> int:
        """NMT state, as heartbeats say it."""
        return int(self.device.nmt._state)

    @property
    def beats(self) -> bool:
        """Whether heartbeats are on. A reset, by NMT too, puts back what was switched off."""
        return bool(self.device.sdo[HEARTBEAT_PRODUCER].raw)

    # --- errors -----------------------------------------------------------------------------------------------------------

    def raise_error(self, code: int, maker: bytes = b"") -> None:
        """An error has come: emergency, error register, history. Nothing when it is there already."""
        if (code, maker) in self.errors:
            return
        speaks = self.nmt_state not in (STOPPED, INITIALISING)
        self.errors[code, maker] = speaks and self.talks
        self._set_register()
        history = self._history()
        self._set_history([code | int.from_bytes(maker[:2].ljust(2, b"\0"), "little") << 16, *history][:HISTORY])
        if speaks:
            self.device.emcy.send(code, self._register(), maker.ljust(5, b"\0"))

    def clear_error(self, code: int, maker: bytes = b"") -> None:
        """An error is over: the emergency that says so, with what is left in the error register."""
        if (code, maker) not in self.errors:
            return
        del self.errors[code, maker]
        self._set_register()
        speaks = self.nmt_state not in (STOPPED, INITIALISING)
        if speaks:
            self.device.emcy.reset(self._register(), bytes(5))
        if not speaks or not self.talks:
            self.ended_unheard = True
        elif not self.errors:
            self.ended_unheard = False

    def _register(self) -> int:
        register = GENERIC if self.errors else 0
        for code, _ in self.errors:
            register |= REGISTER_BITS.get(code >> 12, 0)
        return register

    def _set_register(self) -> None:
        self.device.set_data(ERROR_REGISTER, 0, bytes([self._register()]))

    def _history(self) -> list[int]:
        count = self.device.sdo[ERROR_FIELD][0].raw
        return [self.device.sdo[ERROR_FIELD][place].raw for place in range(1, count + 1)]

    def _set_history(self, codes: list[int]) -> None:
        for place, code in enumerate(codes, 1):
            self.device.set_data(ERROR_FIELD, place, code.to_bytes(4, "little"))
        self.device.data_store.setdefault(ERROR_FIELD, {})[0] = bytes([len(codes)])

    # --- the package's callbacks --------------------------------------------------------------------------------------------

    def _mapped(self, *, index: int, subindex: int, od: Any) -> Any:
        """What SDO reads of a mapped object is what the last PDO held."""
        for pdo in (*self._pdos.values(), *self.device.rpdo.values()):
            for variable in pdo:
                if (variable.index, variable.subindex) == (index, subindex):
                    return variable.raw if pdo.data else None
        return None

    def _written(self, *, index: int, subindex: int, od: Any, data: bytes) -> None:
        """Writing 0 to the number of errors clears the history (CiA 301)."""
        if index == ERROR_FIELD and subindex == 0:
            self.device.data_store.pop(ERROR_FIELD, None)

    # --- within -----------------------------------------------------------------------------------------------------------

    def _start_up(self, t_ns: int) -> None:
        """Boot-up message, then pre-operational with heartbeat."""
        self.wire.now_ns = t_ns
        self.wire.periodic.clear()
        self.device.nmt._send_task = None
        self.ended_unheard = self._silent and (self.ended_unheard or bool(self.errors))
        self.errors.clear()
        self._set_register()
        self._sent_ns.clear()
        self.device.nmt.state = "INITIALISING"
        self.device.nmt.state = "PRE-OPERATIONAL"

    def _commanded(self, t_ns: int, data: bytes) -> None:
        if len(data) < 2 or data[1] not in (0, self.NODE_ID):
            return
        if data[0] in (RESET_NODE, RESET_COMMUNICATION):
            self.tell(t_ns, "is reset by NMT")
            self.powered = False
            self._boots_ns = t_ns + REBOOT_NS
        elif self.nmt_state == OPERATIONAL:
            self._sent_ns.clear()

    def restart(self, t_ns: int) -> None:
        """Begin anew after a reset."""
        self._babbles = False
        self.device.data_store.pop(HEARTBEAT_PRODUCER, None)
        self._start_up(t_ns)
        self.reboot(t_ns)

    def _is_due(self, now_ns: int, message: str, pdo: Any) -> bool:
        sent_ns = self._sent_ns.get(message)
        if sent_ns is None:
            return True
        since_ns, inhibited_ns, latest_ns = now_ns - sent_ns, pdo.inhibit_time * 100_000, pdo.event_timer * 1_000_000
        if since_ns >= latest_ns:
            return True
        if self._frozen or since_ns < inhibited_ns:
            return False
        values = self.values(message)
        return values is not None and self.codec.encode(message, values) != bytes(pdo.data)

    def _babble(self, now_ns: int) -> None:
        for message, pdo in self._pdos.items():
            if (frame := self._frame(message)) is not None:
                pdo.data = bytearray(frame.data)
                pdo.transmit()
        self.wire.send_message(0x700 + self.NODE_ID, bytes([self.nmt_state]))
        self.device.emcy.send(0x6100, GENERIC, (now_ns // 1000 & 0xFF_FFFF_FFFF).to_bytes(5, "little"))

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `CANOPEN_FAULTS`."""
        match statement.device, statement.action:
            case "", "emergency":
                self.raise_error(SUPPLY_LOW)
            case "", "babbling":
                self._babbles = True
            case "", "heartbeat off":
                self.device.sdo[HEARTBEAT_PRODUCER].raw = 0
            case "", "stopped":
                self.receive(now_ns, NMT_COMMAND, False, bytes([2, self.NODE_ID]))
            case _:
                super().fault(now_ns, statement)

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of the faults; `works` without a device also ends those above."""
        super().inject(now_ns, statement)
        if statement == Statement("", None, WORKS):
            self.clear_error(SUPPLY_LOW)
            if self._babbles:
                self._babbles = False
                self.device.emcy.reset(self._register(), bytes(5))
            if not self.beats:
                self.device.data_store.pop(HEARTBEAT_PRODUCER)
                self.device.nmt.start_heartbeat(self.device.sdo[HEARTBEAT_PRODUCER].raw)

    # --- for subclasses ---------------------------------------------------------------------------------------------------

    def reboot(self, t_ns: int) -> None:
        """Put the device back to where it stands after switching on; the plant is where it was."""
        raise NotImplementedError


def _local_node(eds: str, node_id: int) -> Any:
    import canopen  # takes a tenth of a second: scenarios without such a node need not wait for it
    return canopen.LocalNode(node_id, _object_dictionary(eds, node_id))


@cache
def _object_dictionary(eds: str, node_id: int) -> Any:
    import canopen
    return canopen.import_od(str(dbc.path(eds)), node_id)
