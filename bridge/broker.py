"""The embedded broker: amqtt on the loopback interface, for demonstrations and tests.

It has no users, no rights and no TLS, so it refuses every address but this machine's own. A site runs mosquitto.
"""
from __future__ import annotations

import asyncio
import ipaddress
import logging
import os
import threading
import warnings
from contextlib import suppress
from typing import Any

from bridge.mqtt import Address, MqttError

START_S = 60.0
SHUTDOWN_S = 1.0
"""Patience with amqtt's own ending, which now and then never comes (it loses a cancellation of its reader)."""


class EmbeddedBroker:
    """A broker in a thread of its own; a context manager. Raises MqttError when it can't listen there.

    port 0 takes a free one; `address` says which.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0):
        if not is_loopback(host):
            raise MqttError(f'broker "{host}": the embedded broker knows no users and no TLS, so it listens on 127.0.0.1 only; '
                            "run mosquitto for other machines (see `ucs bridge --help`)")
        self.address = Address(host, port, False)
        self._writers: set[asyncio.StreamWriter] = set()
        self._started = threading.Event()
        self._stop = asyncio.Event()
        self._failure = ""
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda loop, context: None)  # a client's broken connection is no news
        self._thread = threading.Thread(target=self._run, name="broker", daemon=True)
        self._thread.start()
        if not self._started.wait(START_S) or self._failure:
            raise MqttError(f"broker {host}:{port}: can't listen there ({self._failure or 'no answer'}); choose another port")

    def __enter__(self) -> EmbeddedBroker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop it, without a word to its clients; retained messages go with it."""
        with suppress(RuntimeError):  # stopped before
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        except OSError as error:
            self._failure = os.strerror(error.errno) if error.errno else str(error)
        except Exception as error:  # told by the constructor
            self._failure = str(error) or type(error).__name__
        finally:
            self._started.set()
            self._end_tasks()
            self._loop.close()

    async def _serve(self) -> None:
        # the listening is ours: amqtt's own neither tells the port it took nor lets go of connections for certain
        broker = _quiet_broker()
        await broker.start()
        server = await asyncio.start_server(lambda reader, writer: self._accept(broker, reader, writer), *self.address[:2])
        self.address = self.address._replace(port=server.sockets[0].getsockname()[1])
        self._started.set()
        await self._stop.wait()
        server.close()
        for writer in list(self._writers):
            writer.transport.abort()
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(broker.shutdown(), SHUTDOWN_S)

    async def _accept(self, broker: Any, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter
        self._writers.add(writer)
        try:
            await broker.external_connected(StreamReaderAdapter(reader), StreamWriterAdapter(writer), "default")
        finally:
            self._writers.discard(writer)
            writer.close()

    def _end_tasks(self) -> None:
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.wait(tasks, timeout=SHUTDOWN_S) if tasks else asyncio.sleep(0))


def _quiet_broker() -> Any:
    """amqtt's broker without its log lines, `$SYS` topics and plug-ins of other packages."""
    for name in ("amqtt", "transitions"):
        logging.getLogger(name).addHandler(logging.NullHandler())
        logging.getLogger(name).propagate = False
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from amqtt.broker import Broker
        from amqtt.contexts import BrokerConfig, ListenerConfig, ListenerType
        anonymous = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
        return Broker(BrokerConfig(listeners={"default": ListenerConfig(type=ListenerType.EXTERNAL)}, plugins=anonymous))


def is_loopback(host: str) -> bool:
    """Whether an address names this machine and nothing else."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
