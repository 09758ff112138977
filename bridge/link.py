"""The short way between `ucs run` and the bridge on the same machine: two datagram sockets beside the journal.

Best effort by design: what must not be lost is in the journal, and neither process ever waits for the other. `ucs run`
makes a `RunLink`, the bridge a `BridgeLink`; either may start first, end, and start again. Where the disk has no room for a
socket `ucs run` goes on without, and makes it later (`ready`).

    run → bridge   Poke       the journal has news (it is looked at every 50 ms anyhow)
                   Samples    the latest monitoring messages; also the sign that supervision is alive
                   Beside     events that the journal can't take now (`Journal.pending`): they leave all the same
                   Answer     the result of an order
    bridge → run   Instruct   an order that passed the gate; at a socket of its own, from someone at the machine
                   Refusal    somebody commanded who may not: supervision makes an alarm of it
"""
from __future__ import annotations

import os
import socket
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from bridge.wire import is_plain
from level1.command import Order
from level1.event import Event, Monitor, Result
from level1.io import local_socket

DATAGRAM_BYTES = 100_000
"""A Unix datagram may have about 200 kB."""
REFUSALS = 100
RECEIVE = 100
"""Datagrams taken in one call."""


class Poke(msgspec.Struct, frozen=True, tag=True):
    """The journal has news."""


class Samples(msgspec.Struct, frozen=True, tag=True):
    """The latest of each monitoring message."""

    monitors: tuple[Monitor, ...] = ()


class Beside(msgspec.Struct, frozen=True, tag=True):
    """Events that are not in the journal."""

    events: tuple[Event, ...]


class Answer(msgspec.Struct, frozen=True, tag=True):
    """The result of an order."""

    result: Result


class Instruct(msgspec.Struct, frozen=True, tag=True):
    """An order from above that passed the gate."""

    order: Order


class Refusal(msgspec.Struct, frozen=True, tag=True):
    """Commands from above were refused by the gate. key: who signed, as far as that is known; count: since the last one told."""

    reason: str
    key: str
    count: int


FromRun = Poke | Samples | Beside | Answer
FromBridge = Instruct | Refusal
T = TypeVar("T")

_encoder = msgspec.json.Encoder(decimal_format="number")


class _End(Generic[T]):
    """One end: receives at its own socket, sends to the other's, which may not be there. Nothing comes or goes until `ready`.

    patient: it may become ready later; else it raises OSError where the folder can't be written.
    """

    def __init__(self, journal: Path, own: str, other: str, decoder: msgspec.json.Decoder[T], *, patient: bool):
        self.malformed = 0
        self._decoder = decoder
        self._name, self._other = _name(journal, own), _name(journal, other)
        self._place = journal.absolute().parent
        self._folder = -1
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        os.fchmod(self._socket.fileno(), 0o600)  # orders come this way
        try:
            self._open()
        except OSError:
            if not patient:
                self._socket.close()
                raise

    def _open(self) -> None:
        self._folder = local_socket.bind(self._socket, self._place, self._name)

    @property
    def ready(self) -> bool:
        """Whether it is open; tries to open it where it is not."""
        if self._folder < 0:
            with suppress(OSError):
                self._open()
        return self._folder >= 0

    def fileno(self) -> int:
        """Readable when something came."""
        return self._socket.fileno()

    def _receive(self) -> list[T]:
        """What came; malformed datagrams are counted and left out."""
        found: list[T] = []
        for _ in range(RECEIVE):
            try:
                datagram = self._socket.recv(DATAGRAM_BYTES + 1)
            except OSError:
                break
            try:
                message = self._decoder.decode(datagram)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ArithmeticError):
                self.malformed += 1
                continue
            if isinstance(message, Instruct) and message.order.value is not None and not is_plain(message.order.value):
                self.malformed += 1  # supervision would reckon with it
            else:
                found.append(message)
        return found

    def close(self) -> None:
        """Close the socket and remove it from the folder."""
        self._socket.close()
        if self._folder >= 0:
            local_socket.unbind(self._folder, self._name)

    def _send(self, message: msgspec.Struct) -> bool:
        """Whether the other end's socket took it."""
        datagram = _encoder.encode(message)
        if len(datagram) > DATAGRAM_BYTES or self._folder < 0:
            return False
        try:
            self._socket.sendto(datagram, local_socket.name_in(self._folder, self._other))
            return True
        except OSError:
            return False


class RunLink(_End[FromBridge]):
    """The end of `ucs run`.

    refusals: told by the gate and not yet taken, the newest `REFUSALS`.
    """

    def __init__(self, journal: Path):
        super().__init__(journal, "run", "bridge", msgspec.json.Decoder(FromBridge), patient=True)
        self.refusals: deque[Refusal] = deque(maxlen=REFUSALS)

    def receive(self) -> list[Instruct]:
        """The orders that came; refusals that came with them are put with the others."""
        messages = self._receive()
        self.refusals.extend(message for message in messages if isinstance(message, Refusal))
        return [message for message in messages if isinstance(message, Instruct)]

    def poke(self) -> bool:
        """Tell that the journal has news."""
        return self._send(Poke())

    def send_samples(self, *monitors: Monitor) -> bool:
        """Hand over the latest monitoring messages; without any it still tells that supervision is alive."""
        return self._send(Samples(monitors))

    def send_beside(self, events: tuple[Event, ...]) -> bool:
        """Hand over events that the journal can't take; to be repeated while it can't (best effort)."""
        return all(self._send(Beside(events[first:first + 50])) for first in range(0, len(events), 50))

    def answer(self, result: Result) -> bool:
        """Hand over the result of an order."""
        return self._send(Answer(result))


class BridgeLink(_End[FromRun]):
    """The bridge's end. Raises OSError where the folder can't be written."""

    def __init__(self, journal: Path):
        super().__init__(journal, "bridge", "run", msgspec.json.Decoder(FromRun), patient=False)

    def receive(self) -> list[FromRun]:
        """What came."""
        return self._receive()

    def instruct(self, order: Order) -> bool:
        """Hand over an order; False when `ucs run` isn't there, which the sender has to be told."""
        return self._send(Instruct(order))

    def refuse(self, reason: str, key: str, count: int) -> bool:
        """Tell that commands were refused."""
        return self._send(Refusal(reason, key, count))


class LocalEnd(_End[Instruct]):
    """Where `ucs run` hears someone at the machine: a socket of its own, which a bridge need not reach."""

    def __init__(self, journal: Path):
        super().__init__(journal, "local", "order", msgspec.json.Decoder(Instruct), patient=True)

    def receive(self) -> list[Instruct]:
        """The orders that came."""
        return self._receive()

    def answer(self, result: Result) -> bool:
        """Hand over the result of an order; nobody may wait for it."""
        return self._send(Answer(result))


class OrderEnd(_End[Answer]):
    """The end of someone at the machine. Raises OSError where the folder can't be written."""

    def __init__(self, journal: Path):
        super().__init__(journal, "order", "local", msgspec.json.Decoder(Answer), patient=False)

    def instruct(self, order: Order) -> bool:
        """Hand over an order; False when `ucs run` isn't there."""
        return self._send(Instruct(order))

    def receive(self) -> list[Answer]:
        """The results that came."""
        return self._receive()


def _name(journal: Path, end: str) -> str:
    return f"{journal.name}.{end}.sock"
