"""CANopen devices as level 1 sees them (CiA 301): heartbeat, node guarding, boot-up, NMT commands, emergencies, error history.

Pure: time comes with frames and deadlines. It commands nobody; the only things it sends are questions: node guarding, and the
error history. What it finds becomes causes of two alarms of `ucs.dbc`: each emergency one of `DeviceEmergency`, each device that is
not heard any more one of `DeviceSilent`.

Theory of operation. A device is known from the configuration, or from its first boot-up or heartbeat: an implement may be coupled
while the program runs. From then on its heartbeat must come:

    unknown ──boot-up, heartbeat──▶ heard ──nothing for `MARGIN` heartbeat times──▶ silent ──boot-up, heartbeat──▶ heard

- The heartbeat time is the configured one, else that of the EDS, else learned: the longest gap between the first heartbeats.
- A device that is guarded instead is asked for its state, by a remote frame, every guard time, whether it is there or not: it may
  be coupled at any time. It is silent when no right answer has come for its life time, guard time × life time factor, and half a
  guard time in which the last answer may be late. In right answers the highest bit alternates (CiA 301 §7.2.8.3.2.2.1): one with
  the bit of the answer before is none, so that a device whose program is dead is silent though its controller answers. After a
  question without an answer either bit is right: it may be the question that was lost, or the answer. When the program was held
  up, what it has missed to ask is asked once, and the answer is waited for before a device counts as silent.
- After a command to reset, the device has `BOOT_NS` to come back. A device that sends no heartbeat is not missed.
- An emergency stays until the device says that it is over (error code 0x00xx) or has booted: both forget all its errors. When the
  error register that comes with 0x00xx still has bits set, only the errors are over whose own bit is not among them.
- A silent device that was taken off on purpose is forgotten when someone at the machine says so (reset of `DeviceSilent`).
- Answers to whoever reads the error history (object 0x1003 by SDO) are taken along with the emergencies. Of a device for which the
  configuration wants it, the UCS reads it itself: `level1.io.canopen` asks, and what it asks leaves through the gate like all else,
  which lets requests to read pass and nothing that writes.

The identifiers of heartbeats and emergencies mean that only on a CANopen bus. A bus is one when it has a configured device, or
when a well-formed heartbeat was heard on it; an identifier that a DBC file gives to another message is never taken for one.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import Any, Protocol

import msgspec

from level1.catalog import Catalog, Message
from level1.event import Send
from level1.frame import BUS_SHIFT, REMOTE, frame_key
from level1.timer import FAR, Timers

DEVICE_EMERGENCY, DEVICE_SILENT = "DeviceEmergency", "DeviceSilent"
NMT, EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x580, 0x600, 0x700
"""Identifiers of the predefined connection set; all but NMT's plus the node id."""
NODES = range(1, 128)
MARGIN = Fraction(7, 2)
"""Heartbeat times without a heartbeat that make a device silent: two frames may be lost, and the third be late."""
SHORTEST_NS = 300_000_000
"""Silence that is never told: heartbeats of 100 ms and less may come as late as that, and so may answers."""
LIFE_FACTOR = 3
"""Life time factor of a guarded device for which none is given."""
TOGGLE = 0x80
"""The bit that alternates in the answers of a guarded device."""
QUESTION_NS = 1_000_000_000
"""A question is worth asking for so long at least; late it does no harm, as a command would."""
STAGGER_NS = 1_000_000
"""The first questions come this far apart by node id, so that not all are asked at once."""
LONGEST_LEARNED_NS = 65_535_000_000
"""Longest heartbeat time that object 0x1017 can hold."""
LEARN = 3
"""Heartbeats from which an unknown heartbeat time is learned."""
BOOT_NS = 5_000_000_000
"""Time for a device to come back after it was reset."""
MAX_ERRORS = 16
"""Emergencies of one device at a time; more are counted, not kept: a babbling device must not crowd the others out."""
MAX_HISTORY = 8
"""Entries of the error history that events carry."""
HISTORY = 0x1003
SDO = "SDO request"
"""What requests to read are called among the frames sent."""
REQUEST_NS = 200_000_000
"""A request to read is worth sending for so long: who asks waits 0.3 s for the answer."""
INITIATE_UPLOAD, UPLOAD_SEGMENT, ABORT = 0x40, (0x60, 0x70), 0x80
"""First bytes of the only SDO requests that the UCS may send (CiA 301 §7.2.4.3): read an object, read on, give up reading. A write
begins with 0x20 to 0x2F (initiate download), goes on with 0x00 to 0x1F (its segments) or is one of blocks (0xC0 to 0xDF)."""

STATES = {0: "booting", 4: "stopped", 5: "operational", 127: "pre-operational"}
"""NMT states, as heartbeats say them."""
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
REGISTER = ("generic", "current", "voltage", "temperature", "communication", "device profile", "reserved", "manufacturer")
"""Bits of the error register, object 0x1001."""

ERRORS: Mapping[int, str] = {
    0x1000: "an error it does not name", 0x2000: "current", 0x2100: "current on the input side", 0x2200: "current inside",
    0x2300: "current on the output side", 0x3000: "voltage", 0x3100: "supply voltage", 0x3200: "voltage inside",
    0x3300: "output voltage", 0x4000: "temperature", 0x4100: "ambient temperature", 0x4200: "temperature of the device",
    0x5000: "its hardware", 0x6000: "its software", 0x6100: "its internal software", 0x6200: "its user software",
    0x6300: "its data set", 0x7000: "an additional module", 0x8000: "monitoring", 0x8100: "communication",
    0x8110: "frames lost by overrun", 0x8120: "CAN error passive", 0x8130: "a heartbeat or life guard it waits for is missing",
    0x8140: "back from bus-off", 0x8150: "another device uses its identifier", 0x8200: "protocol",
    0x8210: "a PDO too short to be used", 0x8220: "a PDO longer than defined", 0x8230: "a multiplexed PDO without destination",
    0x8240: "a SYNC of wrong length", 0x8250: "a PDO it waits for is missing", 0x9000: "an error outside of it",
    0xF000: "an additional function", 0xFF00: "an error of its own kind",
}
"""What an error code is about (CiA 301, table of emergency error codes, in other words). A code stands for its group: 0x31xx."""
_REGISTER_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10}
"""Bits of the error register that belong to an error code, by its first digit."""

Listener = Callable[[int, int, bytes], None]


class Device(msgspec.Struct, frozen=True):
    """A device known from the configuration.

    bus: its index. node: 1 to 127. heartbeat_ns: its heartbeat time, None: learned; 0: it has none and is not missed.
    required: it is missed also when it was never heard; else only from its first sign of life on. errors: texts by error code.
    guard_ns: it is guarded, and asked so often; life_factor: times that without a right answer make it silent. history: its last
    errors may be read by SDO.
    """

    bus: int
    node: int
    name: str = ""
    heartbeat_ns: int | None = None
    required: bool = False
    errors: dict[int, str] = {}
    guard_ns: int | None = None
    life_factor: int = LIFE_FACTOR
    history: bool = False


class Host(Protocol):
    """What this asks of the supervisor."""

    def report(self, t_ns: int, alarm: str, key: str, present: bool, detail: dict[str, Any], text: str) -> None:
        """One cause of an alarm is there, or no more."""

    def causes(self, alarm: str) -> Mapping[str, dict[str, Any]]:
        """The causes of an alarm that are there, by key, with their details."""

    def hand_out(self, send: Send) -> None:
        """Send a frame of a protocol, through the gate."""


class Emergency(msgspec.Struct, frozen=True):
    """An emergency message. code: error code; register: error register; maker: the five bytes that its maker defines."""

    code: int
    register: int
    maker: bytes

    @property
    def is_reset(self) -> bool:
        """Whether it says that an error is over."""
        return self.code < 0x100

    @property
    def flags(self) -> str:
        """The bits of the error register in words."""
        return ", ".join(word for place, word in enumerate(REGISTER) if self.register >> place & 1)


def parse_emergency(data: bytes) -> Emergency | None:
    """Read an emergency message (CiA 301 §7.2.7); None unless it has eight bytes."""
    if len(data) != 8:
        return None
    return Emergency(data[0] | data[1] << 8, data[2], bytes(data[3:]))


def describe(code: int, own: Mapping[int, str] = {}) -> str:
    """An error code in words: those of the device (`own`), else those of the standard, from the whole code to its first digit."""
    for table in (own, ERRORS):
        for known in (code, code & 0xFF00, code & 0xF000):
            if known in table:
                return table[known]
    return "an unknown error"


def outlives(code: int, register: int) -> bool:
    """Whether an error may still be there when 0x00xx came with this error register."""
    if code & 0xFF00 == 0xFF00:
        return bool(register & 0xA0)
    bit = _REGISTER_BITS.get(code >> 12)
    return bool(register & bit) if bit is not None else register != 0


class _Node:
    """A device that was heard or is waited for. heartbeat_ns: None while unknown; gaps: what it is learned from. guard_ns, life_ns:
    guard time and life time of a guarded one, else 0. toggle: highest bit of its last answer, None: either is right next;
    answered_ns: when that came. stuck: its answers do not alternate any more."""

    __slots__ = ("_devices", "answered_ns", "boots_ns", "bus", "due", "gaps", "guard_ns", "heard", "heartbeat_ns", "history",
                 "last_ns", "life_ns", "node", "order", "ordered", "silent", "state", "stuck", "toggle")

    def __init__(self, devices: Devices, bus: int, node: int, device: Device | None):
        self._devices = devices
        self.bus, self.node = bus, node
        self.heartbeat_ns = device.heartbeat_ns if device is not None else None
        self.guard_ns = device.guard_ns or 0 if device is not None else 0
        self.life_ns = self.guard_ns * device.life_factor + self.guard_ns // 2 if device is not None else 0
        self.toggle: int | None = None
        self.answered_ns = 0
        self.stuck = False
        self.gaps: list[int] = []
        self.order = devices.timers.order()
        self.due = FAR
        self.state: int | None = None
        self.heard = self.silent = self.ordered = False
        self.last_ns = 0
        self.boots_ns = 0
        self.history: dict[int, int] = {}

    @property
    def deadline_ns(self) -> int | None:
        """When it counts as silent if nothing comes; None: never."""
        limit_ns = self.life_ns or round(MARGIN * (self.heartbeat_ns or 0))
        return max(self.last_ns + max(limit_ns, SHORTEST_NS), self.boots_ns) if limit_ns else None

    def is_right(self, t_ns: int, answer: int) -> bool:
        """Whether what a guarded device says is a boot-up or a right answer; of others everything is right."""
        if not self.guard_ns:
            return True
        toggle = answer & TOGGLE if answer else None
        follows = 2 * (t_ns - self.answered_ns) < 3 * self.guard_ns
        self.stuck = toggle is not None and toggle == self.toggle and follows
        self.toggle, self.answered_ns = toggle, t_ns
        return not self.stuck

    def sign(self, t_ns: int, state: int) -> None:
        """A boot-up or heartbeat."""
        if state and self.state and not self.silent:
            self._learn(t_ns - self.last_ns)
        self.heard = True
        self.silent = False
        self.state = state
        self.last_ns = t_ns
        self.boots_ns = 0
        self.wait()

    def wait(self) -> None:
        """See to it that silence will be noticed. A deadline that is set already looks anew when it comes."""
        deadline = self.deadline_ns
        if deadline is not None and self.due > deadline:
            self._devices.timers.set(self, deadline)

    def _learn(self, gap_ns: int) -> None:
        if self.heartbeat_ns is None and not self.guard_ns and 0 < gap_ns <= LONGEST_LEARNED_NS:
            self.gaps.append(gap_ns)
            if len(self.gaps) >= LEARN - 1:
                self.heartbeat_ns = max(self.gaps)

    def expire(self, now_ns: int) -> None:
        """It may have fallen silent."""
        deadline = self.deadline_ns
        if deadline is None or self.silent:
            return
        until_ns = self._devices.timers.until_ns
        if self.guard_ns and self._devices.asks and until_ns - now_ns > self.guard_ns // 2:
            deadline = until_ns + self.guard_ns + self.guard_ns // 2
        if deadline > now_ns:
            self._devices.timers.set(self, deadline)
        else:
            self.silent = True
            self._devices.lost(now_ns, self)


class _Guard:
    """Asks a device for its state at its guard time."""

    __slots__ = ("_host", "_key", "_timers", "due", "guard_ns", "order")

    def __init__(self, host: Host, timers: Timers, key: int, guard_ns: int):
        self._host, self._timers, self._key = host, timers, key
        self.guard_ns = guard_ns
        self.order = timers.order()
        self.due = FAR

    def expire(self, now_ns: int) -> None:
        """Ask, unless the next question is due as well."""
        next_ns = now_ns + self.guard_ns
        if next_ns > self._timers.until_ns:
            self._host.hand_out(Send(now_ns, self._key, b"\0", "node guarding", "CANopen", max(next_ns, now_ns + QUESTION_NS)))
        self._timers.set(self, next_ns)


class Devices:
    """The CANopen devices of all buses.

    catalog: what DBC files define, so that its identifiers are not mistaken. devices: those known from the configuration.
    counters: takes what is worth counting, but no alarm. asks: guarded devices are asked; else it is only listened to them.
    """

    def __init__(self, catalog: Catalog, devices: Iterable[Device], host: Host, timers: Timers, counters: Counter[str],
                 asks: bool = True):
        self.timers = timers
        self.asks = asks
        self._host = host
        self._counters = counters
        self._known = {(device.bus, device.node): device for device in devices}
        self._buses = {bus for bus, _ in self._known}
        self._defined: dict[tuple[int, int], Message] = {
            (bus, message.can_id): message for name, message in catalog.messages.items() if not message.extended
            for bus in catalog.buses.get(name, (0,))}
        self._nodes: dict[tuple[int, int], _Node] = {}
        self._guards = {guard_key(bus, node): _Guard(host, timers, guard_key(bus, node), device.guard_ns)
                        for (bus, node), device in self._known.items() if asks and device.guard_ns}

    @property
    def questions(self) -> frozenset[int]:
        """Keys of the remote frames that it may send."""
        return frozenset(self._guards)

    @property
    def readable(self) -> frozenset[int]:
        """Keys of the SDO requests by which error histories may be read."""
        return frozenset(sdo_key(bus, node) for (bus, node), device in self._known.items() if self.asks and device.history)

    def listeners(self) -> dict[int, Listener]:
        """Who wants to hear which 11-bit identifier."""
        wanted: dict[int, Listener] = {NMT: self.command}
        for node in NODES:
            wanted |= {EMERGENCY + node: self.emergency, SDO_ANSWER + node: self.answer, HEARTBEAT + node: self.heartbeat}
        return wanted

    def start(self, t_ns: int) -> None:
        """The time line begins: from now on devices that must be there are waited for."""
        for (bus, number), device in self._known.items():
            node = self._node(bus, number) if device.required else None
            if node is not None and node.deadline_ns is not None:
                node.last_ns = t_ns
                node.boots_ns = t_ns + BOOT_NS
                node.wait()
        for key, guard in self._guards.items():
            self.timers.set(guard, t_ns + (key & 0x7F) * STAGGER_NS)

    def name(self, bus: int, node: int) -> str:
        """How to call a device in a text."""
        device = self._known.get((bus, node))
        return f"{device.name} (node {node})" if device is not None and device.name else f"node {node}"

    def taken_off(self, t_ns: int) -> str:
        """Someone at the machine says that the silent devices were taken off on purpose: they are forgotten until heard again.

        Gives the reason of a refusal: there is none, or one of them must be there.
        """
        silent = [(int(bus), int(node)) for bus, node in (key.split("/") for key in self._host.causes(DEVICE_SILENT))]
        needed = [place for place in silent if (device := self._known.get(place)) is not None and device.required]
        for bus, number in silent:
            if (bus, number) not in needed:
                node = self._nodes.pop((bus, number), None)
                if node is not None:
                    node.due = FAR
                self._host.report(t_ns, DEVICE_SILENT, f"{bus}/{number}", False, {}, "")
        if needed:
            return f"{', '.join(self.name(*place) for place in needed)} must be there by the configuration"
        return "" if silent else "no device is silent"

    # --- what is heard ----------------------------------------------------------------------------------------------------

    def heartbeat(self, t_ns: int, key: int, data: bytes) -> None:
        """A heartbeat, a boot-up, or the answer of a guarded device."""
        bus, number = key >> BUS_SHIFT, key & 0x7F
        defined = self._defined.get((bus, key & 0x7FF))
        if len(data) != 1 or data[0] & 0x7F not in STATES or defined is not None and defined.length != 1:
            if (bus, number) in self._nodes:
                self._counters["CANopen: malformed heartbeats"] += 1
            return
        self._buses.add(bus)
        node = self._node(bus, number)
        if not node.is_right(t_ns, data[0]):
            self._counters["CANopen: answers to guarding that do not alternate"] += 1
            return
        if data[0] == 0:
            self._booted(t_ns, node)
        known = node.heard and not node.silent
        node.sign(t_ns, data[0] & 0x7F)
        if not known:
            self._host.report(t_ns, DEVICE_SILENT, f"{bus}/{number}", False, {}, "")

    def _booted(self, t_ns: int, node: _Node) -> None:
        if node.heard and not node.ordered and not node.silent:
            self._counters["CANopen: devices that booted by themselves"] += 1
        node.ordered = False
        node.history.clear()
        self._forget(t_ns, node.bus, node.node, 0)

    def command(self, t_ns: int, key: int, data: bytes) -> None:
        """An NMT command, of whomever, the UCS included: to one device, or to all (node 0)."""
        bus = key >> BUS_SHIFT
        if len(data) != 2 or data[0] not in (RESET_NODE, RESET_COMMUNICATION) or bus not in self._buses:
            return
        for (its_bus, number), node in self._nodes.items():
            if its_bus == bus and data[1] in (0, number):
                node.ordered = True
                node.boots_ns = t_ns + BOOT_NS

    def emergency(self, t_ns: int, key: int, data: bytes) -> None:
        """An emergency message."""
        bus, number = key >> BUS_SHIFT, key & 0x7F
        known = (bus, number) in self._known or (bus, number) in self._nodes
        if bus not in self._buses or not known and (bus, key & 0x7FF) in self._defined:
            return
        emergency = parse_emergency(data)
        if emergency is None:
            self._counters["CANopen: malformed emergencies"] += 1
        elif emergency.is_reset:
            self._forget(t_ns, bus, number, emergency.register)
        else:
            self._tell(t_ns, bus, number, emergency)

    def answer(self, t_ns: int, key: int, data: bytes) -> None:
        """An answer of a device to someone who reads it; of use when it is an entry of the error history (expedited upload)."""
        bus, number = key >> BUS_SHIFT, key & 0x7F
        if (bus, number) not in self._nodes or len(data) != 8 or data[0] & 0xE2 != 0x42 or data[1] | data[2] << 8 != HISTORY:
            return
        node, place = self._nodes[bus, number], data[3]
        if place == 0:
            node.history = {old: code for old, code in node.history.items() if old <= data[4]}
        elif place <= MAX_HISTORY:
            node.history[place] = data[4] | data[5] << 8
            for error, detail in self._errors(bus, number).items():
                self._host.report(t_ns, DEVICE_EMERGENCY, error, True, detail | _history(node), "")

    # --- what comes of it -------------------------------------------------------------------------------------------------

    def lost(self, t_ns: int, node: _Node) -> None:
        """A device has fallen silent."""
        last = STATES[node.state] if node.state is not None else "never heard"
        quiet_s = (t_ns - node.last_ns) / 1e9
        detail = self._who(node.bus, node.node) | {"LastState": last, "Silent": f"{quiet_s:.3f} s"}
        said = "no heartbeat" if not node.guard_ns else "no right answer to guarding (its toggle bit stands still)" \
            if node.stuck else "no answer to guarding"
        why = f"has not come back {quiet_s:g} s after it was reset" if node.ordered else \
            f"{said} for {quiet_s:g} s" if node.heard else f"was not heard within {quiet_s:g} s of the start"
        node.ordered = False
        self._host.report(t_ns, DEVICE_SILENT, f"{node.bus}/{node.node}", True, detail, f"{self.name(node.bus, node.node)}: {why}")

    def _tell(self, t_ns: int, bus: int, number: int, emergency: Emergency) -> None:
        """An emergency. Two with the same code and maker's bytes are one error: the register tells of all errors of the device."""
        key = f"{bus}/{number}/{emergency.code:04X}/{emergency.maker.hex().upper()}"
        others = self._errors(bus, number)
        if key not in others and len(others) >= MAX_ERRORS:
            self._counters["CANopen: emergencies of one device beyond the limit"] += 1
            return
        device = self._known.get((bus, number))
        words = describe(emergency.code, device.errors if device is not None else {})
        detail = self._who(bus, number) | {"ErrorCode": f"0x{emergency.code:04X}", "Error": words, "ErrorRegister": emergency.flags,
                                           "MakerBytes": emergency.maker.hex().upper()}
        node = self._nodes.get((bus, number))
        text = f"{self.name(bus, number)}: {words} (0x{emergency.code:04X})"
        self._host.report(t_ns, DEVICE_EMERGENCY, key, True, detail | (_history(node) if node is not None else {}), text)

    def _forget(self, t_ns: int, bus: int, number: int, register: int) -> None:
        for key in self._errors(bus, number):
            if not outlives(int(key.split("/")[2], 16), register):
                self._host.report(t_ns, DEVICE_EMERGENCY, key, False, {}, "")

    def _errors(self, bus: int, number: int) -> dict[str, dict[str, Any]]:
        """The errors of a device, those from before a restart of the program too."""
        start = f"{bus}/{number}/"
        return {key: detail for key, detail in self._host.causes(DEVICE_EMERGENCY).items() if key.startswith(start)}

    def _who(self, bus: int, number: int) -> dict[str, Any]:
        device = self._known.get((bus, number))
        return {"Bus": bus, "Node": number, "Device": device.name if device is not None else ""}

    def _node(self, bus: int, number: int) -> _Node:
        node = self._nodes.get((bus, number))
        if node is None:
            node = self._nodes[bus, number] = _Node(self, bus, number, self._known.get((bus, number)))
        return node


def guard_key(bus: int, node: int) -> int:
    """The key of the remote frame by which a device is guarded."""
    return frame_key(HEARTBEAT + node, False, bus) | REMOTE


def sdo_key(bus: int, node: int) -> int:
    """The key of the SDO requests to a device."""
    return frame_key(SDO_REQUEST + node, False, bus)


def is_reading(request: bytes) -> bool:
    """Whether an SDO request reads the error history, or goes on or ends with that: it changes nothing in the device."""
    if len(request) != 8:
        return False
    if request[0] == INITIATE_UPLOAD:
        return request[1] | request[2] << 8 == HISTORY
    return request[0] in UPLOAD_SEGMENT or request[0] == ABORT


def _history(node: _Node) -> dict[str, Any]:
    """The last errors, the newest first, as far as they were heard."""
    codes = [f"0x{code:04X}" for _, code in sorted(node.history.items())]
    return {"ErrorHistory": " ".join(codes)} if codes else {}
