"""One connection to an MQTT broker, driven by its owner's thread.

paho's own thread dies without a word when a callback raises, and its queue is memory only; so there is neither here: the
owner calls `wait` in its loop, takes what came, and learns from `lost` when the connection is gone. Then it makes a new
one: nothing is carried over, since the outbox knows what to send (MQTT 3.1.1, clean session; nothing that 5 lacks).
"""
from __future__ import annotations

import select
import socket
import ssl
import time
from collections.abc import Sequence
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgspec
import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from bridge.wire import PAYLOAD_BYTES
from level1.io.error import OutsideError

KEEP_ALIVE_S = 5
"""A broken radio link is noticed after one and a half of it, by either side (MQTT 3.1.1 §3.1.2.10)."""
CONNECT_S = 5.0
"""Patience with name look-up, TCP and TLS; then as much again with the broker's own answers."""
GOODBYE_S = 1.0
PACKET_BYTES = 1 << 20
"""A longer packet ends the connection before it is read: no payload of ours comes near it."""
BLOCK_BYTES = 65_536
TAKE = 1000
"""Messages taken in before the owner gets its turn."""
PORTS = {"mqtt": 1883, "mqtts": 8883}


class MqttError(OutsideError):
    """The broker can't be used. One line: what is wrong, what to do."""


class Tls(msgspec.Struct, frozen=True):
    """PEM files for `mqtts`. ca: who signs the broker's certificate, None for the system's list; certificate and key: ours."""

    ca: str | None = None
    certificate: str | None = None
    key: str | None = None


class Address(NamedTuple):
    """Where a broker listens."""

    host: str
    port: int
    tls: bool

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}"


class Received(NamedTuple):
    """A message as it came; retained: it lay at the broker before we subscribed."""

    topic: str
    payload: bytes
    retained: bool


def parse_address(url: str) -> Address:
    """The address in `mqtt://host:1883` or `mqtts://host:8883`; the ports are the defaults. Raises MqttError."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme not in PORTS or not parts.hostname or port == 0:
        raise MqttError(f'broker "{url}": no MQTT address; write "mqtt://host:1883" or "mqtts://host:8883"')
    return Address(parts.hostname, port or PORTS[parts.scheme], parts.scheme == "mqtts")


class _Client(paho.Client):
    """paho's client, reading the socket in blocks (it asks for single bytes) and refusing monstrous packets."""

    block = b""
    at = 0

    def _sock_recv(self, bufsize: int) -> bytes:
        if self._in_packet["remaining_length"] > PACKET_BYTES:
            raise ConnectionError("packet too long")
        if self.at >= len(self.block):
            self.block, self.at = super()._sock_recv(BLOCK_BYTES), 0
        taken = self.block[self.at:self.at + bufsize]
        self.at += len(taken)
        return taken

    @property
    def has_block(self) -> bool:
        """Whether something is read and not yet taken apart; poll() doesn't know of it."""
        return self.at < len(self.block)


class MqttConnection:
    """A connection. Making it takes up to `CONNECT_S` and raises MqttError when there is no broker.

    subscribe: pairs of topic filter and QoS. will: topic and payload that the broker publishes, retained, when we vanish.
    ready: the broker accepted us and our subscriptions. lost: why it is over, "" while it is not.
    """

    def __init__(self, address: Address, client_id: str, *, subscribe: Sequence[tuple[str, int]],
                 will: tuple[str, bytes] | None = None, tls: Tls | None = None, keep_alive_s: int = KEEP_ALIVE_S):
        self.address = address
        self.ready = False
        self.lost = ""
        self._accepted = False
        self._subscribe = list(subscribe)
        self._received: list[Received] = []
        self._last: paho.MQTTMessageInfo | None = None
        self._deadline = time.monotonic() + 2 * CONNECT_S
        self._client = _Client(CallbackAPIVersion.VERSION2, client_id, clean_session=True, protocol=paho.MQTTv311,
                               reconnect_on_failure=False)
        self._client.connect_timeout = CONNECT_S
        self._client.max_inflight_messages_set(500)
        self._client.on_connect = self._on_connect
        self._client.on_subscribe = self._on_subscribe
        self._client.on_disconnect = self._on_disconnect
        self._client.on_message = self._on_message
        if will:
            self._client.will_set(*will, qos=1, retain=True)
        self._connect(tls or Tls(), keep_alive_s)

    def wait(self, timeout_s: float, readers: Sequence[int] = ()) -> list[int]:
        """Work until something comes or the time is over. Gives which of the other file descriptors can be read."""
        sock = self._client.socket()
        if sock is None:
            self.lost = self.lost or "the connection broke"
            return []
        poll = select.poll()
        for reader in readers:
            poll.register(reader, select.POLLIN)
        poll.register(sock, select.POLLIN | (select.POLLOUT if self._client.want_write() else 0))
        buffered = self._client.has_block or (isinstance(sock, ssl.SSLSocket) and sock.pending() > 0)
        ready = dict(poll.poll(0 if buffered else max(0.0, timeout_s) * 1000))
        mine = ready.pop(sock.fileno(), select.POLLIN if buffered else 0)
        if mine & ~select.POLLOUT or buffered:
            self._read()
        if mine & select.POLLOUT and not self.lost:
            self._check(self._client.loop_write())
        if not self.lost:
            self._check(self._client.loop_misc())
        if not self.ready and not self.lost and time.monotonic() > self._deadline:
            self.lost = "the broker does not answer"
        return list(ready)

    def take(self) -> list[Received]:
        """What came since the last call."""
        taken, self._received = self._received, []
        return taken

    def publish(self, topic: str, payload: bytes, qos: int = 0, retain: bool = False) -> None:
        """Send, or begin to; whether it arrived is told by an answer from level 2, by nothing else."""
        if not self.lost:
            self._last = self._client.publish(topic, payload, qos, retain)
            self._check(self._last.rc)

    @property
    def congested(self) -> bool:
        """Whether the network doesn't take what was published: what is only worth something now had better wait."""
        return self._client.want_write()

    def close(self) -> None:
        """Say goodbye, so that the last will stays unsaid, once the broker has what was published (amqtt drops the rest)."""
        end = time.monotonic() + GOODBYE_S
        while not self.lost and self._last and not self._last.is_published() and time.monotonic() < end:
            self.wait(0.05)
        self._client.disconnect()
        self._client.loop_misc()
        self.abandon()

    def abandon(self) -> None:
        """Close the socket without a word: the broker says the last will."""
        sock = self._client.socket()
        self._client.on_disconnect = None
        if sock is not None:
            sock.close()
        self.lost = self.lost or "closed"

    def _connect(self, tls: Tls, keep_alive_s: int) -> None:
        try:
            if self.address.tls:
                self._client.tls_set_context(tls_context(tls))
            self._check(self._client.connect(self.address.host, self.address.port, keepalive=keep_alive_s))
            if isinstance(sock := self._client.socket(), socket.socket):
                # else an alarm waits up to 40 ms for the TCP acknowledgement of the message before it
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except ssl.SSLCertVerificationError as error:
            raise MqttError(f"broker {self.address}: its certificate is refused ({error.verify_message}); "
                            "set [bridge] ca to the authority that signed it") from None
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or type(error).__name__
            raise MqttError(f"broker {self.address}: can't be reached ({reason}); see that it runs there") from None

    def _read(self) -> None:
        self._check(self._client.loop_read())
        while self._client.has_block and not self.lost and len(self._received) < TAKE:
            self._check(self._client.loop_read())

    def _check(self, result: MQTTErrorCode) -> None:
        if result not in (MQTTErrorCode.MQTT_ERR_SUCCESS, MQTTErrorCode.MQTT_ERR_QUEUE_SIZE, MQTTErrorCode.MQTT_ERR_AGAIN):
            self._lose(paho.error_string(result).rstrip(".").lower())

    def _lose(self, why: str) -> None:
        """It is over. In TLS 1.3 a certificate that the broker does not want shows in nothing else than this."""
        if self.address.tls and not self._accepted:
            why = ("the broker ended the connection before it answered; see that our certificate is of its authority, still valid "
                   "and not revoked")
        self.lost = self.lost or why

    def _on_connect(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        self._accepted = True
        if reason.is_failure:
            self.lost = f"the broker refuses us: {reason}"
        elif self._subscribe:
            client.subscribe(self._subscribe)
        else:
            self.ready = True

    def _on_subscribe(self, client: Any, data: Any, mid: int, reasons: Any, properties: Any) -> None:
        refused = [topic for (topic, _), reason in zip(self._subscribe, reasons, strict=False) if reason.is_failure]
        if refused:
            self.lost = f"the broker does not let us subscribe to {', '.join(refused)}"
        self.ready = not refused

    def _on_disconnect(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        self._lose(f"the connection broke ({reason})")

    def _on_message(self, client: Any, data: Any, message: paho.MQTTMessage) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            topic = ""
        # one byte too many is enough to be refused by `wire.decode`
        self._received.append(Received(topic, bytes(message.payload[:PAYLOAD_BYTES + 1]), message.retain))


def tls_context(tls: Tls) -> ssl.SSLContext:
    """TLS 1.2 or later, the broker's certificate and name checked. Raises MqttError for files that can't be used."""
    try:
        context = ssl.create_default_context(cafile=tls.ca)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        if tls.certificate:
            context.load_cert_chain(tls.certificate, tls.key)
        return context
    except (OSError, ValueError) as error:
        names = ", ".join(name for name in (tls.ca, tls.certificate, tls.key) if name)
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise MqttError(f"TLS files {names}: can't be used ({reason}); give PEM files in [bridge] ca, certificate, key") from None


class Waker:
    """Lets another thread end a `wait`: hand `fileno()` to it as a reader."""

    def __init__(self) -> None:
        self._here, self._there = socket.socketpair()
        self._here.setblocking(False)
        self._there.setblocking(False)

    def fileno(self) -> int:
        """What becomes readable."""
        return self._here.fileno()

    def wake(self) -> None:
        """End the wait. Safe from any thread and from signal handlers."""
        try:
            self._there.send(b"\0")
        except OSError:
            pass  # full of wake-ups, or closed: nobody has to be woken

    def clear(self) -> None:
        """Take the wake-ups in."""
        try:
            self._here.recv(4096)
        except BlockingIOError:
            pass

    def close(self) -> None:
        """Close both ends."""
        self._here.close()
        self._there.close()
