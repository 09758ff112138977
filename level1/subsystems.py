"""What subsystems on J1939 report themselves, and the UCS as a node among them.

Every active trouble code is a cause of the alarm `TroubleCode`, and answers `dtc()` in conditions. Where the UCS has claimed an
address, its own alarms go out as trouble codes, and strangers under its address or its identifiers are causes of
`AddressConflict` and `SecondTalker`. The alarms are those of `ucs.dbc`; without it only `dtc()` and the node are left.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol
from zlib import crc32

from level1.board import Board
from level1.condition import Things
from level1.event import Send
from level1.frame import BUS_SHIFT, EXTENDED
from level1.j1939 import DM1, FMI_WORDS, TP_CM, TP_DT, Transport, TroubleCodeReport, parse_dm1
from level1.j1939_node import ADDRESS_CLAIMED, DM2, GLOBAL, NULL, REQUEST, Node, name_of
from level1.timer import Timers

TROUBLE_CODE = "TroubleCode"
"""Alarm of `ucs.dbc` whose causes are the active trouble codes of all senders."""
ADDRESS_CONFLICT = "AddressConflict"
"""Alarm of `ucs.dbc`: another node claims or uses the address of the UCS."""
SECOND_TALKER = "SecondTalker"
"""Alarm of `ucs.dbc`: someone else sends a message that is the UCS's own."""
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
        self.heard_ns = 0
        self.transport: Transport | None = None
        self._codes: dict[int, dict[str, TroubleCodeReport]] = {}
        self._nodes = {bus: self._node(bus, address, unit, timers) for bus, address in addresses.items()}
        if wanted or self._nodes:
            self.transport = Transport(board.deliver, counters)
            self._listen(self.transport)
        board.newcomer = self.newcomer

    def start(self, t_ns: int) -> None:
        """The time line begins: claim the addresses."""
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

    def newcomer(self, key: int) -> None:
        """An identifier is heard for the first time: is it one that only the UCS may send?"""
        if key in self.own_keys:
            self.host.report(self.heard_ns, SECOND_TALKER, f"{key:X}", True,
                             {"Id": f"{key & 0x1FFF_FFFF:X}", "Bus": key >> BUS_SHIFT},
                             f"someone else sends the message with identifier {key & 0x1FFF_FFFF:X}")
        node = self._nodes.get(key >> BUS_SHIFT)
        if node is not None and key & EXTENDED and key >> 8 & 0x3FF00 != ADDRESS_CLAIMED:
            node.used(self.heard_ns, key)

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
            other = name.hex().upper() if name else "unknown"
            self.host.report(t_ns, ADDRESS_CONFLICT, str(bus), name is not None,
                             {"SourceAddress": contested, "Bus": bus, "Name": other},
                             f"another node {'claims' if name else 'uses'} source address {contested}")
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
