"""The UCS as a node of a J1939 bus: claims an address, reports its own alarms as DM1, takes messages addressed to it.

Theory of operation (SAE J1939-81 §4, -21 §5.10, -73 §5.7; ISO 11783-5, -3). The node claims its address when it starts and is
silent for 250 ms; a claim with a smaller NAME for the same address wins, then the node moves to a free one of the range for
self-configuring nodes, or, without one, says that it can't claim and stays silent. From then on it broadcasts its active
trouble codes once a second while there are any, and at every change (again not more often than once a second); more than one
code goes out as a broadcast in packets, 50 ms apart. Messages sent to its address with flow control are acknowledged packet
window by packet window.

Pure: frames and time in, frames out.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from level1.frame import BUS_SHIFT, EXTENDED
from level1.j1939 import DM1, MAX_SIZE, TP_CM, TP_DT
from level1.timer import FAR, Timers

ADDRESS_CLAIMED = 60928
REQUEST = 59904
ACKNOWLEDGEMENT = 59392
DM2 = 65227
SENT_GROUPS = frozenset({ADDRESS_CLAIMED, REQUEST, ACKNOWLEDGEMENT, DM1, TP_CM, TP_DT})
"""All that a node sends by itself."""
GLOBAL, NULL = 255, 254
CLAIM_NS = 250_000_000
"""Silence after a claim (J1939-81 §4.2.2)."""
SELF_CONFIGURING = range(128, 248)
"""Addresses a node may move to by itself (J1939-81 §4.1)."""
DM1_NS = 1_000_000_000
PACKET_NS = 50_000_000
"""Gap between the packets of a broadcast; 50–200 ms are allowed (J1939-21 §5.10.2.4)."""
MAX_CODES = (MAX_SIZE - 2) // 4
_AGRICULTURE = 2
_NOT_AVAILABLE = b"\xff"

Transmit = Callable[[int, int, bytes, str], None]


def name_of(identity: int, *, manufacturer: int = 0, function: int = 0xFF) -> bytes:
    """The NAME of an agricultural, self-configuring node (J1939-81 §4.1.1). identity: 21 bits, unique for the manufacturer."""
    value = identity & 0x1F_FFFF | (manufacturer & 0x7FF) << 21 | function << 40 | _AGRICULTURE << 60 | 1 << 63
    return value.to_bytes(8, "little")


class Node:
    """The UCS on one bus.

    address: the present source address, None while it is being claimed or can't be. transmit(t_ns, key, data, what) sends.
    conflict(t_ns, address, name): another node claims this one's address; name None: that is over, the address is its own.
    """

    __slots__ = ("_claimed", "_conflict", "_messages", "_queue", "_sender", "_taken", "_transmit", "address", "bus", "codes", "due",
                 "lamps", "name", "order", "preferred", "state", "timers", "wanted")

    def __init__(self, bus: int, name: bytes, preferred: int, timers: Timers, transmit: Transmit,
                 conflict: Callable[[int, int, bytes | None], None]):
        self.bus = bus
        self.name = name
        self.preferred = self.wanted = preferred
        self.address: int | None = None
        self.timers = timers
        self.order = timers.order()
        self.due = FAR
        self.codes: tuple[tuple[int, int, int], ...] = ()
        self.lamps = 0
        self._transmit = transmit
        self._conflict = conflict
        self._taken: dict[int, bytes] = {}
        self._claimed = False
        self._queue: deque[tuple[int, bytes]] = deque()
        self._sender = _Broadcaster(self)
        self._messages = _Receiver(self)

    def start(self, t_ns: int) -> None:
        """Claim the preferred address."""
        self._claim(t_ns, self.preferred)

    def key(self, pgn: int, destination: int = GLOBAL, priority: int = 6) -> int:
        """The frame key of a parameter group sent by this node."""
        source = self.address if self.address is not None else self.wanted
        group = pgn | destination if pgn >> 8 & 0xFF < 240 else pgn
        return self.bus << BUS_SHIFT | EXTENDED | priority << 26 | group << 8 | source

    # --- address claim ------------------------------------------------------------------------------------------------------

    def _claim(self, t_ns: int, address: int) -> None:
        self.address, self.wanted, self._claimed = None, address, False
        self._transmit(t_ns, self.key(ADDRESS_CLAIMED), self.name, "address claim")
        self.timers.set(self, t_ns + CLAIM_NS)

    def claimed(self, t_ns: int, key: int, data: bytes) -> None:
        """Another node has claimed an address."""
        source = key & 0xFF
        if len(data) != 8 or source == NULL:
            return
        self._taken[source] = data
        if source != (self.address if self.address is not None else self.wanted) or self._claimed and self.address is None:
            return
        self._conflict(t_ns, source, data)
        if int.from_bytes(self.name, "little") < int.from_bytes(data, "little"):
            self._transmit(t_ns, self.key(ADDRESS_CLAIMED), self.name, "address claim")
            return
        free = next((address for address in SELF_CONFIGURING if address not in self._taken), None)
        if free is not None:
            self._claim(t_ns, free)
        else:
            self.address, self.wanted, self._claimed = None, NULL, True
            self.timers.set(self, t_ns + int.from_bytes(self.name, "little") % 153 * 1_000_000)

    def requested(self, t_ns: int, key: int, data: bytes) -> None:
        """Another node asks for a parameter group."""
        destination = key >> 8 & 0xFF
        own = self.address if self.address is not None else self.wanted
        if len(data) < 3 or destination not in (GLOBAL, own):
            return
        pgn = int.from_bytes(data[:3], "little")
        if pgn == ADDRESS_CLAIMED:
            self._transmit(t_ns, self.key(ADDRESS_CLAIMED), self.name, "address claim")
        elif self.address is None:
            return
        elif pgn == DM1:
            self._sender.now(t_ns)
        elif destination != GLOBAL:
            refusal = b"\x01\xff\xff\xff" + bytes([key & 0xFF]) + data[:3]
            self._transmit(t_ns, self.key(ACKNOWLEDGEMENT), refusal, "negative acknowledgement")

    def expire(self, now_ns: int) -> None:
        """The claim has stood for 250 ms, or the time has come to say that none can."""
        if self.wanted == NULL:
            self._transmit(now_ns, self.key(ADDRESS_CLAIMED), self.name, "cannot claim an address")
            return
        known = self.address is not None
        self.address, self._claimed = self.wanted, True
        self._conflict(now_ns, self.wanted, None)
        if not known:
            self._sender.begin(now_ns)

    def used(self, t_ns: int) -> None:
        """A frame has come in from this node's own address: someone else uses it, and is told whose it is (J1939-81 §4.4)."""
        if self.address is not None and self.due == FAR:
            self._transmit(t_ns, self.key(ADDRESS_CLAIMED), self.name, "address claim")
            self.timers.set(self, t_ns + CLAIM_NS)

    # --- own trouble codes --------------------------------------------------------------------------------------------------

    def report(self, t_ns: int, codes: Sequence[tuple[int, int, int]], lamps: int) -> None:
        """The active trouble codes are now these (SPN, FMI, occurrences); lamps: first byte of the DM1."""
        if (tuple(codes), lamps) != (self.codes, self.lamps):
            self.codes, self.lamps = tuple(codes)[:MAX_CODES], lamps
            self._sender.changed(t_ns)

    def payload(self) -> bytes:
        """The DM1 of the present codes (J1939-73 §5.7.1): lamps, flash not available, four bytes a code."""
        body = b"".join(bytes([spn & 0xFF, spn >> 8 & 0xFF, spn >> 16 << 5 | fmi, min(count, 126)])
                        for spn, fmi, count in self.codes)
        return bytes([self.lamps, 0xFF]) + (body or bytes(4))

    def send(self, t_ns: int, pgn: int, data: bytes, what: str, destination: int = GLOBAL, priority: int = 6) -> None:
        """Send one frame, if there is an address to send it from."""
        if self.address is not None:
            self._transmit(t_ns, self.key(pgn, destination, priority), data, what)

    def request(self, t_ns: int, pgn: int, destination: int) -> None:
        """Ask another node for a parameter group (DM2, say)."""
        self.send(t_ns, REQUEST, pgn.to_bytes(3, "little"), f"request of {pgn}", destination)

    # --- messages addressed to this node ------------------------------------------------------------------------------------

    def connection(self, t_ns: int, key: int, data: bytes) -> None:
        """A TP.CM frame; what is put together is the business of `j1939.Transport`, which hears the same frames."""
        if self.address is not None and key >> 8 & 0xFF == self.address:
            self._messages.connection(t_ns, key, data)

    def packet(self, t_ns: int, key: int, data: bytes) -> None:
        """A TP.DT frame."""
        if self.address is not None and key >> 8 & 0xFF == self.address:
            self._messages.packet(t_ns, key, data)


class _Broadcaster:
    """Sends the DM1: at once at a change, but not more often than once a second; every second while codes are active."""

    __slots__ = ("due", "last_ns", "node", "order", "packets", "pending")

    def __init__(self, node: Node):
        self.node = node
        self.order = node.timers.order()
        self.due = FAR
        self.last_ns: int | None = None
        self.pending = False
        self.packets: deque[bytes] = deque()

    def begin(self, t_ns: int) -> None:
        """An address has been won."""
        if self.node.codes or self.pending:
            self.now(t_ns)

    def changed(self, t_ns: int) -> None:
        """Codes have come or gone."""
        self.pending = True
        if self.node.address is None or self.packets:
            return
        if self.last_ns is None or t_ns - self.last_ns >= DM1_NS:
            self.now(t_ns)
        elif self.due == FAR:
            self.node.timers.set(self, self.last_ns + DM1_NS)

    def now(self, t_ns: int) -> None:
        """Send it."""
        if self.packets:
            return
        self.pending = False
        self.last_ns = t_ns
        payload = self.node.payload()
        if len(payload) <= 8:
            self.node.send(t_ns, DM1, payload.ljust(8, _NOT_AVAILABLE), "DM1")
        else:
            count = (len(payload) + 6) // 7
            head = bytes([32]) + len(payload).to_bytes(2, "little") + bytes([count, 0xFF]) + DM1.to_bytes(3, "little")
            self.node.send(t_ns, TP_CM, head, "DM1 in packets", priority=7)
            padded = payload.ljust(7 * count, _NOT_AVAILABLE)
            self.packets.extend(bytes([n + 1]) + padded[7 * n:7 * n + 7] for n in range(count))
        self._next(t_ns)

    def expire(self, now_ns: int) -> None:
        """The next packet, or the next second."""
        if self.packets:
            self.node.send(now_ns, TP_DT, self.packets.popleft(), "DM1 in packets", priority=7)
            self._next(now_ns)
        elif self.pending or self.node.codes:
            self.now(now_ns)

    def _next(self, t_ns: int) -> None:
        if self.packets:
            self.node.timers.set(self, t_ns + PACKET_NS)
        elif self.node.codes or self.pending:
            assert self.last_ns is not None
            self.node.timers.set(self, max(self.last_ns + DM1_NS, t_ns))


class _Receiver:
    """Grants and acknowledges messages sent to this node with flow control: all packets in one window of at most 16."""

    __slots__ = ("node", "sessions")
    WINDOW = 16
    MAX_SESSIONS = 16

    def __init__(self, node: Node):
        self.node = node
        self.sessions: dict[int, tuple[int, int, int, bytes]] = {}

    def connection(self, t_ns: int, key: int, data: bytes) -> None:
        """Request to send, or the other side breaks off."""
        source = key & 0xFF
        if len(data) < 8 or data[0] not in (16, 255):
            return
        if data[0] == 255:
            self.sessions.pop(source, None)
            return
        size, count = data[1] | data[2] << 8, data[3]
        if not 9 <= size <= MAX_SIZE or count != (size + 6) // 7 or len(self.sessions) >= self.MAX_SESSIONS:
            self._say(t_ns, source, b"\xff\x02\xff\xff\xff" + data[5:8])
            return
        self.sessions[source] = (size, count, 0, data[5:8])
        self._grant(t_ns, source)

    def packet(self, t_ns: int, key: int, data: bytes) -> None:
        """A packet: at the end of a window the next is granted, at the end of the message it is acknowledged."""
        source = key & 0xFF
        if source not in self.sessions or not data:
            return
        size, count, received, group = self.sessions[source]
        if data[0] != received + 1:
            self._grant(t_ns, source)
            return
        self.sessions[source] = (size, count, received + 1, group)
        if received + 1 == count:
            del self.sessions[source]
            self._say(t_ns, source, bytes([19]) + size.to_bytes(2, "little") + bytes([count, 0xFF]) + group)
        elif (received + 1) % self.WINDOW == 0:
            self._grant(t_ns, source)

    def _grant(self, t_ns: int, source: int) -> None:
        _, count, received, group = self.sessions[source]
        self._say(t_ns, source, bytes([17, min(self.WINDOW, count - received), received + 1, 0xFF, 0xFF]) + group)

    def _say(self, t_ns: int, destination: int, data: bytes) -> None:
        self.node.send(t_ns, TP_CM, data, "flow control", destination, priority=7)
