"""Sends one signed command to a unit and waits for the answer.

A command is valid on the unit's own clock, so that is learnt first: from the monitoring messages, which come all the time, or,
where there are none, from the refusal of a first attempt, which carries it.
"""
from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from bridge import wire
from bridge.error import OutsideError
from bridge.mqtt import Address, MqttConnection, Tls
from bridge.signing import signed

HEAR_NS = 2_000_000_000
"""How long to listen for the unit's clock before a first attempt without it."""
VALID_NS = 10_000_000_000
REPEAT_NS = 1_000_000_000
"""Pause before the same command is sent again; the unit gives the same answer and obeys once."""
PATIENCE_NS = 15_000_000_000


class CommandError(OutsideError):
    """The command could not be brought to the unit, or no answer came back."""


class Wish(msgspec.Struct, frozen=True):
    """What is to be commanded, see `wire.Order`."""

    unit: str
    name: str
    target: str = ""
    value: Decimal | None = None


class Signer(msgspec.Struct, frozen=True):
    """Who commands: the key's name at the unit, the private key, and what gives its next counter."""

    key: str
    private: Ed25519PrivateKey
    counter: Callable[[], int]


class _UnitClock(msgspec.Struct):
    boot: int
    t: Decimal
    heard_ns: int


class Commander:
    """Commands units of a fleet. Raises MqttError, WireError for names that can't stand in a topic."""

    def __init__(self, broker: Address, fleet: str, wish: Wish, signer: Signer, tls: Tls | None = None):
        self._fleet, self._wish, self._signer = fleet, wish, signer
        topics = [wire.topic(fleet, wish.unit, "connection"), wire.topic(fleet, wish.unit, "result"),
                  wire.topic(fleet, wish.unit, "monitor", "x")[:-1] + "+"]
        self._connection = MqttConnection(broker, f"ucs-command-{secrets.token_hex(4)}", subscribe=[(topic, 1) for topic in topics],
                                          tls=tls)
        self._clock: _UnitClock | None = None
        self._fresh = False
        self._state = ""
        self._results: list[wire.Result] = []

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def run(self) -> wire.Result:
        """The unit's answer. Raises CommandError where there is none."""
        unit = self._wish.unit
        self._hear(lambda: self._fresh, HEAR_NS)
        if self._clock is None:
            raise CommandError(f'unit "{unit}" of fleet "{self._fleet}": nothing heard from it; see that the names are right '
                               "and that its bridge runs")
        if self._state not in ("", "ONLINE"):
            raise CommandError(f'unit "{unit}": is {self._state}; it can be commanded when it is back')
        knew = self._fresh
        result = self._send(self._clock)
        if result.outcome == "refused" and not knew and self._fresh:
            result = self._send(self._clock)
        return result

    def _send(self, clock: _UnitClock) -> wire.Result:
        now = clock.t + wire.seconds(time.monotonic_ns() - clock.heard_ns)
        wish = self._wish
        order = wire.Order(unit=wish.unit, boot=clock.boot, seq=self._signer.counter(), t=now, id=secrets.token_hex(8),
                           expires_t=now + wire.seconds(VALID_NS), name=wish.name, target=wish.target, value=wish.value)
        payload = wire.encode(signed(order, self._fleet, self._signer.key, self._signer.private))
        ours = {order.id, wire.digest(payload)}
        self._results.clear()
        end_ns = time.monotonic_ns() + PATIENCE_NS
        while time.monotonic_ns() < end_ns:
            self._connection.publish(wire.topic(self._fleet, wish.unit, "command"), payload, qos=1)
            if self._hear(lambda: self._answer(ours) is not None, REPEAT_NS):
                break
        answer = self._answer(ours)
        if answer is None:
            raise CommandError(f'unit "{wish.unit}": no answer within {PATIENCE_NS // 10**9} s; whether it obeyed is not known')
        return answer

    def _answer(self, ours: set[str]) -> wire.Result | None:
        """By the id, or by the digest where the unit doesn't know us: a stranger's refusal must not look like ours."""
        return next((result for result in self._results if (result.id or result.digest) in ours), None)

    def _hear(self, condition: Callable[[], bool], timeout_ns: int) -> bool:
        """Take in what comes until a condition holds. Raises CommandError when the broker is lost."""
        end_ns = time.monotonic_ns() + timeout_ns
        while not condition() and (left_ns := end_ns - time.monotonic_ns()) > 0:
            self._connection.wait(left_ns / 1e9)
            if self._connection.lost:
                raise CommandError(f"broker {self._connection.address}: {self._connection.lost}")
            for message in self._connection.take():
                self._take(message.topic, message.payload, message.retained)
        return condition()

    def _take(self, topic: str, payload: bytes, retained: bool) -> None:
        try:
            message = wire.decode(payload, wire.KINDS[wire.parse_topic(topic).kind])
        except wire.WireError:
            return
        if isinstance(message, wire.Connection):
            self._state = message.state
        if isinstance(message, wire.Result):
            self._results.append(message)
        tells_time = isinstance(message, wire.Header) and getattr(message, "state", "") != "CONNECTION_BROKEN"
        if isinstance(message, wire.Header) and tells_time and not (retained and self._fresh):
            self._clock = _UnitClock(message.boot, message.t, time.monotonic_ns())
            self._fresh = not retained


def counter_beside(path: Path) -> Callable[[], int]:
    """Gives rising counters for the key in a file, and remembers them beside it. Raises CommandError.

    Milliseconds of the wall clock where that is ahead, so that copies of a key on several computers don't fall behind.
    """
    file = path.with_name(path.name + ".counter")

    def next_counter() -> int:
        try:
            last = int(file.read_text()) if file.exists() else 0
            counter = max(last + 1, time.time_ns() // 1_000_000)
            with open(file, "w", encoding="utf-8") as out:
                out.write(str(counter))
                out.flush()
                os.fsync(out.fileno())
        except (OSError, ValueError) as error:
            raise CommandError(f"counter {file}: can't be kept ({error}); see to that file and its folder") from None
        return counter

    return next_counter
