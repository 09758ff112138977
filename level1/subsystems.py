"""What subsystems on J1939 report themselves, and the UCS as a node among them.

Every active trouble code is a cause of the alarm `TroubleCode`, and answers `dtc()` in conditions. Where the UCS has claimed an
address, its own alarms go out as trouble codes, and strangers under its address or its identifiers are causes of
`AddressConflict` and `SecondTalker`, for as long as they talk and `QUIET_NS` longer. The alarms are those of `ucs.dbc`; without it
only `dtc()` and the node are left.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol
from zlib import crc32

from level1.board import Board, Listener
from level1.condition import Things
from level1.event import Send
from level1.frame import BUS_SHIFT, EXTENDED
from level1.j1939 import DM1, FMI_WORDS, TP_CM, TP_DT, Transport, TroubleCodeReport, parse_dm1
from level1.j1939_node import ADDRESS_CLAIMED, DM2, GLOBAL, NULL, REQUEST, Node, name_of
from level1.timer import FAR, Timers

TROUBLE_CODE = "TroubleCode"
"""Alarm of `ucs.dbc` whose causes are the active trouble codes of all senders."""
ADDRESS_CONFLICT = "AddressConflict"
"""Alarm of `ucs.dbc`: another node claims or uses the address of the UCS."""
SECOND_TALKER = "SecondTalker"
"""Alarm of `ucs.dbc`: someone else sends a message that is the UCS's own."""
QUIET_NS = 5_000_000_000
"""A stranger who has not been heard for so long has stopped: what only the UCS sends comes once a second."""
MOST_USED = 256
"""Identifiers with the own address that are watched: enough to know that a stranger is there, and no more for a babbling one."""
PROTOCOL_LIFE_NS = 1_000_000_000
"""A frame of a protocol is worthless after this: T3 of the transport protocol is 1.25 s, and the first claim of an address must
outlive the start of the program."""


class Host(Protocol):
    """What they ask of the supervisor."""

    def report(self, t_ns: int, alarm: str, key: str, present: bool, detail: dict[str, Any], text: str) -> None:
        """One cause of an alarm is there, or no more."""

    def causes(self, alarm: str) -> dict[str, dict[str, Any]]:
        """The causes of an alarm that are there, also those of an earlier boot, by key."""

    def hand_out(self, send: Send) -> None:
        """Send a frame of a protocol."""

    def tell(self, t_ns: int, message: str, values: dict[str, Any]) -> None:
        """Send a monitoring message upward."""


class Subsystems:
    """Trouble codes of all senders, and the UCS's own node on each bus where it has an address.

    addresses: bus index -> source address to claim. own_keys: identifiers that only the UCS sends.
    transport: puts messages in packets together; None where nothing is listened to.
    """

    def __init__(self, host: Host, board: Board, things: Things, timers: Timers, counters: Counter[str], *, unit: str,
                 addresses: Mapping[int, int], wanted: bool):
        self.host = host
        self.board = board
        self.things = things
        self.counters = counters
        self.own_keys: Collection[int] = ()
        self.transport: Transport | None = None
        self._timers = timers
        self._strangers: dict[tuple[str, str], _Stranger] = {}
        self._addresses: dict[int, int] = {}
        self._used: Counter[int] = Counter()
        self._codes: dict[int, dict[str, TroubleCodeReport]] = {}
        self._nodes = {bus: self._node(bus, address, unit, timers) for bus, address in addresses.items()}
        if wanted or self._nodes:
            self.transport = Transport(board.deliver, counters)
            self._listen(self.transport)
        board.newcomer = self.newcomer

    def start(self, t_ns: int) -> None:
        """The time line begins: claim the addresses. Strangers of an earlier boot are over unless they are heard again."""
        for alarm in (SECOND_TALKER, ADDRESS_CONFLICT):
            for key in self.host.causes(alarm):
                self._stranger(alarm, key).wait(t_ns)
        for node in self._nodes.values():
            node.start(t_ns)

    @property
    def speaks(self) -> bool:
        """Whether the UCS has an address anywhere."""
        return bool(self._nodes)

    def report(self, t_ns: int, codes: Sequence[tuple[int, int, int]], lamps: int) -> None:
        """The UCS's own active trouble codes are now these (SPN, FMI, occurrences); lamps as in the first byte of a DM1."""
        for node in self._nodes.values():
            node.report(t_ns, codes, lamps)

    def request_stored(self, t_ns: int, source: str) -> str:
        """Ask a sender for the trouble codes it has stored (DM2); they come as the monitoring message `dm2`. source: its address,
        "255" for all. Gives the reason of a refusal."""
        if not self._nodes:
            return "the UCS has no J1939 address to ask from: set j1939 on a [[bus]]"
        if not source.isdigit() or not 0 <= int(source) <= GLOBAL or int(source) == NULL:
            return f'"{source}" is no source address; name one of 0 to 253, or 255 for all'
        for node in self._nodes.values():
            node.request(t_ns, DM2, int(source))
        return ""

    def _stored(self, t_ns: int, key: int, data: bytes) -> None:
        """A DM2: what a sender has stored."""
        diagnosis = parse_dm1(data)
        if diagnosis is None:
            self.counters["trouble code messages cut short"] += 1
            return
        codes = "; ".join(f"SPN {code.spn} FMI {code.fmi} × {code.occurrences}" for code in diagnosis.codes)
        self.host.tell(t_ns, "dm2", {"SourceAddress": key & 0xFF, "Bus": key >> BUS_SHIFT, "Codes": codes})

    def newcomer(self, key: int) -> Listener | None:
        """An identifier is heard for the first time: is it one that only the UCS may send? Then every frame of it is looked at."""
        bus, can_id = key >> BUS_SHIFT, key & 0x1FFF_FFFF
        node = self._nodes.get(bus)
        uses_address = node is not None and bool(key & EXTENDED) and key & 0xFF == node.address and \
            key >> 8 & 0x3FF00 != ADDRESS_CLAIMED
        if uses_address:
            self._used[bus] += 1
            uses_address = self._used[bus] <= MOST_USED
        if key not in self.own_keys and not uses_address:
            return None

        def listener(t_ns: int, key: int, data: bytes) -> None:
            if key in self.own_keys:
                self._stranger(SECOND_TALKER, f"{key:X}").heard(
                    t_ns, {"Id": f"{can_id:X}", "Bus": bus}, f"someone else sends the message with identifier {can_id:X}")
            if node is not None and uses_address and key & 0xFF == node.address:
                node.used(t_ns)
                self._stranger(ADDRESS_CONFLICT, f"{bus}/use").heard(
                    t_ns, {"SourceAddress": key & 0xFF, "Bus": bus, "Name": "unknown"},
                    f"another node uses source address {key & 0xFF}")
        return listener

    def _stranger(self, alarm: str, key: str) -> _Stranger:
        if (alarm, key) not in self._strangers:
            self._strangers[alarm, key] = _Stranger(self.host, self._timers, alarm, key)
        return self._strangers[alarm, key]

    def _listen(self, transport: Transport) -> None:
        """Hear what J1939 says beyond single frames, and let the own node answer where there is one."""
        def answered(answer: Callable[[Node, int, int, bytes], None],
                     listen: Callable[[int, int, bytes], None] | None = None) -> Callable[[int, int, bytes], None]:
            def listener(t_ns: int, key: int, data: bytes) -> None:
                if listen is not None:
                    listen(t_ns, key, data)
                node = self._nodes.get(key >> BUS_SHIFT)
                if node is not None:
                    answer(node, t_ns, key, data)
            return listener
        self.board.listen(DM1, self._diagnosed)
        self.board.listen(DM2, self._stored)
        self.board.listen(TP_CM, answered(Node.connection, transport.connection))
        self.board.listen(TP_DT, answered(Node.packet, transport.packet))
        if self._nodes:
            self.board.listen(ADDRESS_CLAIMED, answered(Node.claimed))
            self.board.listen(REQUEST, answered(Node.requested))

    def _node(self, bus: int, address: int, unit: str, timers: Timers) -> Node:
        def transmit(t_ns: int, key: int, data: bytes, what: str) -> None:
            self.host.hand_out(Send(t_ns, key, data, what, "J1939", t_ns + PROTOCOL_LIFE_NS))

        def conflict(t_ns: int, contested: int, name: bytes | None) -> None:
            self.host.report(t_ns, ADDRESS_CONFLICT, str(bus), name is not None,
                             {"SourceAddress": contested, "Bus": bus, "Name": name.hex().upper() if name else ""},
                             f"another node claims source address {contested}")
            if name is None and self._addresses.get(bus) != contested:  # it is the own one from now on
                self._addresses[bus] = contested
                self._used[bus] = 0
                self.board.unbind(bus, contested)
        return Node(bus, name_of(crc32(unit.encode())), address, timers, transmit, conflict)

    def _diagnosed(self, t_ns: int, key: int, data: bytes) -> None:
        """A DM1: trouble codes appear and vanish."""
        diagnosis = parse_dm1(data)
        if diagnosis is None:
            self.counters["trouble code messages cut short"] += 1
            return
        source, bus = key & 0xFF, key >> BUS_SHIFT
        sender = bus << 8 | source
        now = {f"{bus}/{source}/{code.spn}/{code.fmi}": code for code in diagnosis.codes}
        known = (name for name in self.host.causes(TROUBLE_CODE) if name.startswith(f"{bus}/{source}/"))
        for name in sorted(set(known) - now.keys()):
            self.host.report(t_ns, TROUBLE_CODE, name, False, {}, "")
        for name, code in now.items():
            detail = {"SourceAddress": source, "SPN": code.spn, "FMI": code.fmi, "Occurrences": code.occurrences,
                      "Lamps": " ".join(diagnosis.lamps), "Bus": bus}
            text = f"SPN {code.spn} {FMI_WORDS[code.fmi]}, from source address {source}"
            self.host.report(t_ns, TROUBLE_CODE, name, True, detail, text)
        self._codes[sender] = now
        self._move_cells()

    def _move_cells(self) -> None:
        active = {(code.spn, code.fmi) for codes in self._codes.values() for code in codes.values()}
        for (spn, fmi), cell in self.things.codes.items():
            k = int(any(one == spn and fmi in (None, two) for one, two in active))
            if cell.k != k:
                cell.k = k
                self.board.queue(cell)


class _Stranger:
    """Someone who sends what only the UCS may: a cause of an alarm until it has been quiet."""

    __slots__ = ("_alarm", "_host", "_key", "_timers", "due", "last_ns", "order", "there")

    def __init__(self, host: Host, timers: Timers, alarm: str, key: str):
        self._host, self._timers, self._alarm, self._key = host, timers, alarm, key
        self.order = timers.order()
        self.due = FAR
        self.last_ns = 0
        self.there = False

    def heard(self, t_ns: int, detail: dict[str, Any], text: str) -> None:
        """A frame of it."""
        if not self.there:
            self.there = True
            self._host.report(t_ns, self._alarm, self._key, True, detail, text)
        self.wait(t_ns)

    def wait(self, t_ns: int) -> None:
        """See to it that its quiet is noticed. A deadline that is set already looks anew when it comes."""
        self.last_ns = t_ns
        if self.due == FAR:
            self._timers.set(self, t_ns + QUIET_NS)

    def expire(self, now_ns: int) -> None:
        """It may be quiet."""
        if self.last_ns + QUIET_NS > now_ns:
            self._timers.set(self, self.last_ns + QUIET_NS)
        else:
            self.there = False
            self._host.report(now_ns, self._alarm, self._key, False, {}, "")
