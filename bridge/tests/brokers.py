"""The brokers that the tests of bridge and level 2 run against, each as a process or thread of its own, without TLS.

The embedded one and mosquitto always; NATS through its MQTT listener where the environment variable NATS_SERVER names the
program (`python -m benchmarks.nats` builds it and runs these tests).
"""
from __future__ import annotations

import os
import random
import shutil
import socket
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from bridge.broker import EmbeddedBroker
from bridge.mqtt import Address

WAIT_S = 60.0
NATS_SERVER = os.environ.get("NATS_SERVER", "")
DICE = random.SystemRandom()
SITES = ["mosquitto", *(["nats"] if NATS_SERVER else [])]
"""Those with certificates and rights."""
KINDS = ["embedded", *SITES]
MOSQUITTO = "listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\npersistence false\n"
NATS = 'listen: 127.0.0.1:{other}\nserver_name: test\njetstream {{ store_dir: "{folder}" }}\nmqtt {{ listen: 127.0.0.1:{port} }}\n'


class Broker(Protocol):
    """Something that listens until it is closed."""

    address: Address

    def close(self) -> None:
        """End it, at once."""


class BrokerProcess:
    """A broker of another project. Nothing of it outlives it."""

    def __init__(self, program: str, configuration: str, port: int):
        self.address = Address("127.0.0.1", port or free_port(), False)
        self._folder = tempfile.TemporaryDirectory(prefix="broker-")
        file = Path(self._folder.name) / "configuration"
        file.write_text(configuration.format(port=self.address.port, other=free_port(), folder=self._folder.name))
        self._process = subprocess.Popen([program, "-c", str(file)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end = time.monotonic() + WAIT_S
        while not listens(self.address.port):
            assert self._process.poll() is None and time.monotonic() < end, f"{program} did not start"
            time.sleep(0.02)

    def close(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()


def start(kind: str, port: int = 0) -> Broker:
    """A broker of a kind, on a free port or on this one."""
    if kind == "embedded":
        return EmbeddedBroker(port=port or free_port())
    if kind == "nats":
        return BrokerProcess(NATS_SERVER, NATS, port)
    return BrokerProcess(mosquitto(), MOSQUITTO, port)


def mosquitto() -> str:
    """Where mosquitto is."""
    found = shutil.which("mosquitto", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
    assert found, "mosquitto is not installed: apt-get install mosquitto"
    return found


def free_port() -> int:
    """A port that nobody listens on, of those that the kernel gives nobody by itself: so it is still free when it is needed, even
    for a broker that comes back after a while."""
    while True:
        port = DICE.randrange(10_000, 30_000)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def listens(port: int) -> bool:
    """Whether somebody listens on a port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
