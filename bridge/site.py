"""A test site: configurations of mosquitto and NATS with mutual TLS and rights for each unit, and all certificates it takes.

For trials and as a pattern. A real site keeps its authority's key off the broker and renews certificates by its own rules.
"""
from __future__ import annotations

import ipaddress
import json
import os
import pwd
import re
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from bridge import wire
from level1.io.error import OutsideError

VALID = timedelta(days=825)
LEVEL2 = "level2"
BROKER = "broker"
_PLAIN = re.compile(r"[\w.-]+")
RESERVED = (LEVEL2, BROKER, "ca", "crl")
KEY = "-key"
"""Ends the name of the file of a private key."""
CONFIGURATION = """\
# mosquitto for a test site: only certificates of this site's authority come in, each unit only to its own topics.
# Start: mosquitto -c {folder}/mosquitto.conf
listener {port}
cafile {folder}/ca.pem
certfile {folder}/broker.pem
keyfile {folder}/broker-key.pem
crlfile {folder}/crl.pem
tls_version tlsv1.2
set_tcp_nodelay true
require_certificate true
use_identity_as_username true
allow_anonymous false
acl_file {folder}/acl
# No message of ours is longer; nothing is kept for who is away: units and level 2 keep their own.
message_size_limit {payload}
max_queued_messages 1000
persistence false
log_dest stderr
log_type error
log_type warning
"""
RIGHTS = """\
# %u is the name in the certificate: a unit writes and reads what is its own.
pattern write {root}/%u/connection
pattern write {root}/%u/monitor/+
pattern write {root}/%u/alarm
pattern write {root}/%u/result
pattern read {root}/%u/ack
pattern read {root}/%u/command

user {level2}
topic read {root}/+/connection
topic read {root}/+/monitor/+
topic read {root}/+/alarm
topic read {root}/+/result
topic write {root}/+/ack
topic write {root}/+/command
"""

NATS = """\
# NATS with its MQTT listener: the same certificates, the same rights. For a fleet beyond one machine add a `cluster` to it.
# Start: nats-server -c {folder}/nats.conf
# It reads no revocation list: take a user out and send SIGHUP, and that certificate comes in no more.
listen: "127.0.0.1:{inner}"
server_name: "{fleet}"
jetstream {{ store_dir: "{folder}/jetstream" }}
mqtt {{
  listen: "0.0.0.0:{port}"
  tls {{
    cert_file: "{folder}/broker.pem"
    key_file: "{folder}/broker-key.pem"
    ca_file: "{folder}/ca.pem"
    verify_and_map: true
    min_version: "1.2"
  }}
}}
authorization {{ users: [
{users}
] }}
"""
NATS_PORT = 4222
"""For programs of the operator that speak NATS itself; on this machine only."""


class SiteError(OutsideError):
    """The site can't be made."""


class Authority:
    """Issues certificates: elliptic curve P-256, which TLS 1.2 knows."""

    def __init__(self, name: str, now: datetime | None = None):
        self._now = now or datetime.now(UTC)
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self._revoked: list[x509.RevokedCertificate] = []
        builder = self._builder(self._name, self._key, VALID).add_extension(x509.BasicConstraints(True, 0), True)
        usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
        self.certificate = builder.add_extension(usage, True).sign(self._key, hashes.SHA256())

    def issue(self, folder: Path, name: str, hosts: Sequence[str] = (), valid: timedelta = VALID) -> x509.Certificate:
        """Write `name.pem` and `name-key.pem`: of a server under these hosts' names, or without any of a client."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        use = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        builder = self._builder(subject, key, valid).add_extension(x509.BasicConstraints(False, None), True)
        builder = builder.add_extension(x509.ExtendedKeyUsage([use]), False)
        if hosts:
            builder = builder.add_extension(x509.SubjectAlternativeName([_general_name(host) for host in hosts]), False)
        certificate = builder.sign(self._key, hashes.SHA256())
        write_private(folder / f"{name}-key.pem", key)
        (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        return certificate

    def revoke(self, certificate: x509.Certificate) -> None:
        """Put a certificate on the list that `write_public` writes."""
        revoked = x509.RevokedCertificateBuilder().serial_number(certificate.serial_number).revocation_date(self._now)
        self._revoked.append(revoked.build())

    def write_public(self, folder: Path) -> None:
        """Write `ca.pem` and the revocation list `crl.pem`."""
        (folder / "ca.pem").write_bytes(self.certificate.public_bytes(serialization.Encoding.PEM))
        builder = x509.CertificateRevocationListBuilder().issuer_name(self._name)
        builder = builder.last_update(self._now).next_update(self._now + VALID)
        for revoked in self._revoked:
            builder = builder.add_revoked_certificate(revoked)
        (folder / "crl.pem").write_bytes(builder.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))

    def write_key(self, folder: Path) -> None:
        """Write `ca-key.pem`, for who issues more."""
        write_private(folder / "ca-key.pem", self._key)

    def _builder(self, subject: x509.Name, key: ec.EllipticCurvePrivateKey, valid: timedelta) -> x509.CertificateBuilder:
        begin = min(self._now, self._now + valid) - timedelta(days=1)
        return (x509.CertificateBuilder().subject_name(subject).issuer_name(self._name).public_key(key.public_key())
                .serial_number(x509.random_serial_number()).not_valid_before(begin).not_valid_after(self._now + valid))


def make_site(folder: Path, fleet: str, units: Sequence[str], hosts: Sequence[str], port: int = 8883,
              inner: int = NATS_PORT) -> Authority:
    """Write a site into a new folder; gives its authority. Raises SiteError.

    mosquitto.conf, acl, nats.conf, ca.pem, ca-key.pem, crl.pem, broker.pem, level2.pem, a certificate a unit, and the key of each.
    """
    for name in (fleet, *units):
        try:
            wire.check_name(name, "fleet" if name == fleet else "unit")
        except wire.WireError as error:
            raise SiteError(str(error)) from None
        if not _PLAIN.fullmatch(name):
            raise SiteError(f'"{name}": configurations of brokers take letters, digits, "-", "_" and "." in names')
        if name in units and (name in RESERVED or name.endswith(KEY)):
            raise SiteError(f'unit "{name}": the site has a file of that name itself; call the unit otherwise')
    folder = folder.absolute()
    try:
        folder.mkdir(parents=True)
        authority = Authority(f"{fleet} test authority")
        authority.write_public(folder)
        authority.write_key(folder)
        authority.issue(folder, BROKER, hosts)
        for name in (LEVEL2, *units):
            authority.issue(folder, name)
        root = "/".join((*wire.PREFIX, fleet))
        (folder / "acl").write_text(RIGHTS.format(root=root, level2=LEVEL2), encoding="utf-8")
        (folder / "mosquitto.conf").write_text(CONFIGURATION.format(folder=folder, port=port, payload=wire.PAYLOAD_BYTES),
                                               encoding="utf-8")
        (folder / "nats.conf").write_text(NATS.format(folder=folder, port=port, inner=inner, fleet=fleet,
                                                      users=_nats_users(fleet, units)), encoding="utf-8")
        _let_mosquitto_read(folder)
    except FileExistsError:
        raise SiteError(f"site {folder}: exists already; name a new folder") from None
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)  # a part of it would stand in the way of another try
        raise SiteError(f"site {folder}: can't be made ({error.strerror}); name a folder that this user may make") from None
    return authority


def write_private(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a private key that only its owner can read."""
    text = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(text)


def _nats_users(fleet: str, units: Sequence[str]) -> str:
    """The rights that mosquitto's file gives, in subjects: topics with `.` for `/`, and what each MQTT session needs itself."""
    def user(name: str, whose: str, kinds: Sequence[str], others: Sequence[str]) -> str:
        publish, subscribe = ([_subject(fleet, whose, kind) for kind in each] for each in (kinds, others))
        rights = json.dumps({"publish": publish, "subscribe": [*subscribe, "$MQTT.sub.>"]}, ensure_ascii=False)
        return f'  {{ user: "CN={name}", permissions: {rights} }}'

    return "\n".join([*(user(unit, unit, wire.UP, wire.DOWN) for unit in units), user(LEVEL2, "*", wire.DOWN, wire.UP)])


def _subject(fleet: str, unit: str, kind: str) -> str:
    """A topic as NATS names it: a point within a level becomes `//`."""
    levels = [*wire.PREFIX, fleet, unit, kind, *(["*"] if kind == "monitor" else [])]
    return ".".join(level.replace(".", "//") for level in levels)


def _let_mosquitto_read(folder: Path) -> None:
    """mosquitto started by root gives up root's rights for those of its own user, who must read its key."""
    if os.geteuid() != 0:
        return
    try:
        pwd.getpwnam("mosquitto")
    except KeyError:
        return
    shutil.chown(folder / f"{BROKER}-key.pem", "mosquitto")


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
