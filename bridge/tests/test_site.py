"""The site of `ucs bridge --make-site` with the real mosquitto (and NATS, see `brokers`): whom it lets in, and to what; bridge and
level 2 over mutual TLS."""
from __future__ import annotations

import errno
import os
import socket
import stat
import subprocess
import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import msgspec
import pytest

from bridge import wire
from bridge.delivered import delivered_path, delivered_upto
from bridge.mqtt import Address, MqttConnection, MqttError, Tls
from bridge.session import BridgeThread
from bridge.site import Authority, SiteError, make_site
from bridge.tests.brokers import NATS_SERVER, SITES, free_port, listens, mosquitto
from bridge.tests.peer import FLEET, UNIT, Unit, eventually
from level1.event import seconds


class Site:
    """A site with two units, one of them revoked, and its broker running."""

    def __init__(self, folder: Path, kind: str):
        self.folder = folder / "site"
        self.address = Address("127.0.0.1", free_port(), True)
        self.authority = make_site(self.folder, FLEET, [UNIT, "tractor-8", "tractor.9"], ["127.0.0.1", "localhost"],
                                   self.address.port, free_port())
        self.authority.revoke(self.authority.issue(self.folder, "stolen"))
        self.authority.issue(self.folder, "expired", valid=timedelta(hours=-1))
        self.authority.write_public(self.folder)
        configuration = self.folder / f"{kind}.conf"
        if kind == "mosquitto" and folder.stat().st_uid == 0:  # root's temporary folders are closed to mosquitto's own user
            configuration.write_text("user root\n" + configuration.read_text())
        self.log = self.folder / "log"
        with open(self.log, "wb") as log:
            program = mosquitto() if kind == "mosquitto" else NATS_SERVER
            self.process = subprocess.Popen([program, "-c", str(configuration)], stdout=log, stderr=log)
        eventually(lambda: listens(self.address.port) or self.process.poll() is not None)
        assert self.process.poll() is None, self.log.read_text()

    def tls(self, name: str) -> Tls:
        return Tls(str(self.folder / "ca.pem"), str(self.folder / f"{name}.pem"), str(self.folder / f"{name}-key.pem"))

    def connect(self, name: str, *topics: str, tls: Tls | None = None, address: Address | None = None) -> MqttConnection:
        connection = MqttConnection(address or self.address, f"test-{name.replace('.', '-')}", tls=tls or self.tls(name),
                                    subscribe=[(topic, 1) for topic in topics])
        while not connection.ready and not connection.lost:
            connection.wait(0.1)
        return connection

    def why_not(self, name: str, tls: Tls | None = None) -> str:
        """What keeps a certificate out; "" when nothing does."""
        try:
            topic = f"ucs/v1/{FLEET}/+/alarm" if name == "level2" else wire.topic(FLEET, name, "ack")
            connection = self.connect(name, topic, tls=tls)
        except MqttError as error:
            return str(error)
        connection.abandon()
        return "" if connection.ready else connection.lost

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()


@pytest.fixture(scope="module", params=SITES)
def site(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp(request.param), request.param)
    yield site
    site.close()


def test_certificates_of_the_site_come_in(site: Site) -> None:
    assert site.why_not(UNIT) == ""
    assert site.why_not("tractor.9") == ""
    assert site.why_not("level2") == ""


@pytest.mark.fault("wrong, expired, revoked or no certificate", "no connection")
@pytest.mark.parametrize("name", ["stolen", "expired"])
def test_revoked_and_expired_certificates_stay_out(site: Site, name: str) -> None:
    why = site.why_not(name)
    assert "see that our certificate is of its authority, still valid and not revoked" in why or "Not authorized" in why


@pytest.mark.fault("wrong, expired, revoked or no certificate")
def test_another_authoritys_certificate_stays_out(site: Site, tmp_path: Path) -> None:
    other = Authority("other")
    other.issue(tmp_path, UNIT)
    tls = Tls(str(site.folder / "ca.pem"), str(tmp_path / f"{UNIT}.pem"), str(tmp_path / f"{UNIT}-key.pem"))
    assert site.why_not(UNIT, tls) != ""


@pytest.mark.fault("wrong, expired, revoked or no certificate")
def test_nobody_comes_in_without_certificate(site: Site) -> None:
    assert site.why_not("nobody", Tls(ca=str(site.folder / "ca.pem"))) != ""


@pytest.mark.fault("a broker of another authority, under another name, or without TLS", "no connection; what to set is said")
def test_a_broker_of_another_authority_is_refused(site: Site, tmp_path: Path) -> None:
    Authority("other").write_public(tmp_path)
    tls = msgspec.structs.replace(site.tls(UNIT), ca=str(tmp_path / "ca.pem"))
    assert "its certificate is refused" in site.why_not(UNIT, tls)
    assert "set [bridge] ca to the authority that signed it" in site.why_not(UNIT, tls)


@pytest.mark.fault("a broker of another authority, under another name, or without TLS")
def test_a_broker_under_another_name_is_refused(site: Site) -> None:
    with pytest.raises(MqttError, match="its certificate is refused .*not valid for '127.0.0.2'"):
        site.connect(UNIT, "x", address=site.address._replace(host="127.0.0.2"))


@pytest.mark.fault("a broker of another authority, under another name, or without TLS")
def test_a_broker_without_tls_is_told(site: Site, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as plain:
        threading.Thread(target=lambda: plain.accept()[0].sendall(b"no TLS here"), daemon=True).start()
        with pytest.raises(MqttError, match="can't be reached"):
            site.connect(UNIT, "x", address=site.address._replace(port=plain.getsockname()[1]))


@pytest.mark.fault("a unit that writes to or listens on another's topics", "the broker lets nothing through")
def test_a_unit_writes_and_reads_only_what_is_its_own(site: Site) -> None:
    listener = site.connect("level2", f"ucs/v1/{FLEET}/+/alarm")
    for writer in (UNIT, "tractor-8"):
        connection = site.connect(writer, wire.topic(FLEET, writer, "command"))
        connection.publish(wire.topic(FLEET, UNIT, "alarm"), writer.encode(), 1)
        connection.close()
    eavesdropper = site.connect("tractor-8", wire.topic(FLEET, UNIT, "command"))  # mosquitto ignores it, NATS refuses it
    listener.publish(wire.topic(FLEET, UNIT, "command"), b"secret", 1)
    last = site.connect(UNIT, wire.topic(FLEET, UNIT, "ack"))
    last.publish(wire.topic(FLEET, UNIT, "alarm"), b"last", 1)
    received: list[bytes] = []
    while b"last" not in received:
        listener.wait(0.1)
        received += [message.payload for message in listener.take()]
        eavesdropper.wait(0)
    assert received == [UNIT.encode(), b"last"]
    assert eavesdropper.take() == []
    for connection in (listener, eavesdropper, last):
        connection.close()


def test_the_whole_way_works_over_mutual_tls(site: Site, tmp_path: Path) -> None:
    unit = Unit(tmp_path, site.address)
    unit.write(*range(1, 51))
    level2 = site.connect("level2", f"ucs/v1/{FLEET}/+/alarm")
    seqs: set[int] = set()
    with BridgeThread(msgspec.structs.replace(unit.settings, tls=site.tls(UNIT)), unit.said.append):
        while len(seqs) < 50:
            level2.wait(0.1)
            seqs |= {wire.decode(message.payload, wire.Alarm).seq for message in level2.take()}
            ack = wire.Ack(unit=UNIT, boot=1, seq=0, also=tuple((seq, seq) for seq in sorted(seqs)[-60:]), t=seconds(1))
            level2.publish(wire.topic(FLEET, UNIT, "ack"), wire.encode(ack), 1)
        eventually(lambda: delivered_upto(delivered_path(unit.path)) == {1: 50})
        states = site.connect("level2", f"ucs/v1/{FLEET}/+/connection")
        while not (retained := states.take()):
            states.wait(0.1)
        assert retained[0].retained and wire.decode(retained[0].payload, wire.Connection).state == "ONLINE"
        states.abandon()
    level2.close()
    unit.journal.close()


def test_private_keys_are_for_their_owner_alone(site: Site) -> None:
    keys = list(site.folder.glob("*-key.pem"))
    assert len(keys) == 8
    assert all(stat.S_IMODE(key.stat().st_mode) == 0o600 for key in keys)


@pytest.mark.parametrize(("fleet", "units", "told"), [
    ("a/b", ["t"], "can't stand in an MQTT topic"), ("farm", ["level2"], "the site has a file of that name itself"),
    ("farm", ["broker-key"], "the site has a file of that name itself")])
def test_names_that_do_not_do_are_told(tmp_path: Path, fleet: str, units: list[str], told: str) -> None:
    with pytest.raises(SiteError, match=told):
        make_site(tmp_path / "site", fleet, units, ["localhost"])


def test_a_folder_that_exists_is_left_alone(tmp_path: Path) -> None:
    with pytest.raises(SiteError, match="exists already; name a new folder"):
        make_site(tmp_path, "farm", ["t"], ["localhost"])
    assert tmp_path.is_dir()


def test_a_site_that_can_not_be_finished_stands_in_nobodys_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patch:
        patch.setattr("bridge.site._let_mosquitto_read", full)
        with pytest.raises(SiteError, match="can't be made"):
            make_site(tmp_path / "site", "farm", ["t"], ["localhost"])
    make_site(tmp_path / "site", "farm", ["t"], ["localhost"])
