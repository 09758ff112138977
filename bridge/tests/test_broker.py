"""The embedded broker: quiet, for this machine only, and honest about why it can't start."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bridge.broker import EmbeddedBroker
from bridge.mqtt import Address, MqttConnection, MqttError, Tls, parse_address

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "level2.local", ""])
def test_addresses_that_others_can_reach_are_refused(host: str) -> None:
    with pytest.raises(MqttError, match="listens on 127.0.0.1 only; run mosquitto"):
        EmbeddedBroker(host)


def test_a_port_in_use_is_told_in_one_line() -> None:
    with EmbeddedBroker() as broker, pytest.raises(MqttError, match=r"can't listen there \(Address already in use\)"):
        EmbeddedBroker(port=broker.address.port)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1"])
def test_every_name_of_this_machine_will_do(host: str) -> None:
    with EmbeddedBroker(host) as broker:
        connection = MqttConnection(broker.address, "x", subscribe=[("a", 1)])
        while not connection.ready:
            assert not connection.lost, connection.lost
            connection.wait(0.1)
        connection.close()


def test_it_makes_no_noise() -> None:
    script = """
import gc, warnings
warnings.simplefilter("default")
from bridge.broker import EmbeddedBroker
from bridge.mqtt import MqttConnection
with EmbeddedBroker() as broker:
    one = MqttConnection(broker.address, "same", subscribe=[("a", 1)])
    two = MqttConnection(broker.address, "same", subscribe=[("a", 1)])
    for _ in range(10):
        one.wait(0.02), two.wait(0.02)
    one.abandon(), two.abandon()
gc.collect()
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(("url", "address"), [
    ("mqtt://farm.local", Address("farm.local", 1883, False)), ("mqtts://farm.local", Address("farm.local", 8883, True)),
    ("mqtt://[::1]:99", Address("::1", 99, False))])
def test_addresses_are_read(url: str, address: Address) -> None:
    assert parse_address(url) == address


@pytest.mark.parametrize("url", ["", "farm.local", "http://farm.local", "mqtt://", "mqtt://x:0", "mqtt://x:99999", "mqtt://x:y"])
def test_what_is_no_address_is_told(url: str) -> None:
    with pytest.raises(MqttError, match='write "mqtt://host:1883"'):
        parse_address(url)


def test_files_for_tls_that_cannot_be_used_are_told(tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_text("no certificate")
    for name in ("ca.pem", "missing.pem"):
        with pytest.raises(MqttError, match="TLS files .*can't be used .*give PEM files"):
            MqttConnection(Address("127.0.0.1", 1, True), "x", subscribe=[], tls=Tls(ca=str(tmp_path / name)))
