"""The embedded broker: amqtt on the loopback interface, for demonstrations and tests.

It has no users, no rights and no TLS, so it refuses every address but this machine's own. A site runs mosquitto.
"""
from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
import threading
import warnings
from typing import Any

from bridge.mqtt import Address, MqttError

START_S = 10.0


class EmbeddedBroker:
    """A broker in a thread of its own; a context manager. Raises MqttError when it can't listen there.

    port 0 takes a free one; `address` says which.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0):
        self.address = Address(host, _checked_port(host, port), False)
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda loop, context: None)  # a client's broken connection is no news
        self._started = threading.Event()
        self._stop = asyncio.Event()
        self._failure = ""
        self._thread = threading.Thread(target=self._run, name="broker", daemon=True)
        self._thread.start()
        if not self._started.wait(START_S) or self._failure:
            raise MqttError(f"broker {self.address}: can't start ({self._failure or 'no answer'}); choose another port")

    def __enter__(self) -> EmbeddedBroker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop it; retained messages go with it."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(START_S)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:  # told by the constructor
            self._failure = str(error) or type(error).__name__
        finally:
            self._started.set()
            self._end_tasks()
            self._loop.close()

    async def _serve(self) -> None:
        broker = _quiet_broker(self.address)
        await broker.start()
        self._started.set()
        await self._stop.wait()
        await broker.shutdown()

    def _end_tasks(self) -> None:
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))


def _quiet_broker(address: Address) -> Any:
    """amqtt's broker without its log lines, `$SYS` topics and plug-ins of other packages."""
    for name in ("amqtt", "transitions"):
        logging.getLogger(name).addHandler(logging.NullHandler())
        logging.getLogger(name).propagate = False
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from amqtt.broker import Broker
        from amqtt.contexts import BrokerConfig, ListenerConfig, ListenerType
        listener = ListenerConfig(type=ListenerType.TCP, bind=f"{address.host}:{address.port}", max_connections=0)
        anonymous = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
        return Broker(BrokerConfig(listeners={"default": listener}, plugins=anonymous))


def _checked_port(host: str, port: int) -> int:
    """The port, a free one for 0. Raises MqttError where it is taken, or the host is not this machine alone."""
    if not is_loopback(host):
        raise MqttError(f"broker {host}: the embedded broker knows no users and no TLS, so it listens on 127.0.0.1 only; "
                        "run mosquitto for other machines (see `ucs bridge --help`)")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise MqttError(f"broker {host}:{port}: can't listen there ({error.strerror}); choose another port") from None
        return int(probe.getsockname()[1])


def is_loopback(host: str) -> bool:
    """Whether an address names this machine and nothing else."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
