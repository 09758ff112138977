"""Who may command: Ed25519 keys by name, each with a role. The unit holds public keys, level 2 its own private ones.

A unit's key file is TOML, a table a key:

    [chief]
    role = "reset"
    public = "rYVB…="                 # base64 of the 32 bytes of RFC 8032

A private key is a PEM file (PKCS #8), such as other tools make: `openssl genpkey -algorithm ed25519`.
"""
from __future__ import annotations

import base64
import hashlib
import os
import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from level1.io.error import OutsideError, did_you_mean

ROLES = ("view", "acknowledge", "stop", "pause", "reset")
"""From least to most; each may do what those before it may."""
RIGHTS = {"acknowledge": "acknowledge", "stop": "stop", "pause": "pause", "reduce_speed": "pause", "resume": "reset",
          "reset": "reset", "monitor_period": "view", "request_dm2": "view"}
"""The role a command needs. A command that is not named here, from the definitions, needs the last one."""


_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


class KeyFileError(OutsideError):
    """A key or key file that can't be used."""


class Key(msgspec.Struct, frozen=True):
    """A public key with its name and role."""

    name: str
    role: str
    public: bytes

    def may(self, command: str) -> bool:
        """Whether the role is enough for a command."""
        return ROLES.index(self.role) >= ROLES.index(RIGHTS.get(command, ROLES[-1]))

    def verifies(self, signature: bytes, message: bytes) -> bool:
        """Whether the signature is this key's over the message."""
        try:
            Ed25519PublicKey.from_public_bytes(self.public).verify(signature, message)
        except InvalidSignature:
            return False
        return True

    @property
    def fingerprint(self) -> str:
        """Names the key itself, whatever it is called: 16 hexadecimal digits."""
        return hashlib.sha256(self.public).hexdigest()[:16]


def load_keys(path: Path) -> dict[str, Key]:
    """The public keys in a file, by name. Raises KeyFileError with every mistake found."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise KeyFileError(f"keys {path}: can't be read ({reason}); make one with `ucs keys make NAME --keys {path}`") from None
    problems: list[str] = []
    keys: dict[str, Key] = {}
    for name, entry in table.items():
        found = _key(name, entry)
        twin = next((key.name for key in keys.values() if isinstance(found, Key) and key.public == found.public), None)
        if twin is not None:
            problems.append(f"keys {path}: [{name}]: the same key as [{twin}], so its role is not clear; give each their own")
        elif isinstance(found, Key):
            keys[name] = found
        else:
            problems.append(f"keys {path}: [{name}]: {found}")
    if problems:
        raise KeyFileError(*problems)
    return keys


class KeyRing:
    """The keys in a file, read anew when it changes: who is taken out commands no more. Raises KeyFileError at first.

    fault: why the file can't be read now; then nobody may command.
    """

    def __init__(self, path: Path | None):
        self._path = path
        self._stamp = _stamp(path)
        self._keys = load_keys(path) if path else {}
        self.fault = ""

    def current(self) -> dict[str, Key]:
        """The keys as the file has them now."""
        stamp = _stamp(self._path)
        if self._path and stamp != self._stamp:
            self._stamp = stamp
            try:
                self._keys, self.fault = load_keys(self._path), ""
            except KeyFileError as error:
                self._keys, self.fault = {}, f"{error.problems[0]} (until then nobody may command)"
        return self._keys


def add_key(path: Path, key: Key) -> None:
    """Put a public key into a file, which is made where there is none. Raises KeyFileError for a name it has already."""
    keys = load_keys(path) if path.exists() else {}
    if key.name in keys:
        raise KeyFileError(f'keys {path}: has a key "{key.name}" already; choose another name, or take that one out')
    wire_name(key.name)
    text = f'[{key.name}]\nrole = "{key.role}"\npublic = "{base64.b64encode(key.public).decode()}"\n'
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write(("\n" if keys else "") + text)
    except OSError as error:
        raise KeyFileError(f"keys {path}: can't be written ({error.strerror}); choose another file") from None


def make_private(path: Path) -> Ed25519PrivateKey:
    """A new private key in a file that only its owner can read. Raises KeyFileError, also where the file exists."""
    private = Ed25519PrivateKey.generate()
    text = private.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(text)
    except OSError as error:
        raise KeyFileError(f"key {path}: can't be made ({error.strerror}); choose another file") from None
    return private


def load_private(path: Path) -> Ed25519PrivateKey:
    """The private key in a file. Raises KeyFileError."""
    try:
        private = serialization.load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a PEM private key without password"
        raise KeyFileError(f"key {path}: can't be read ({reason}); make one with `ucs keys make`") from None
    if not isinstance(private, Ed25519PrivateKey):
        raise KeyFileError(f"key {path}: is no Ed25519 key; make one with `ucs keys make`")
    return private


def public_bytes(private: Ed25519PrivateKey) -> bytes:
    """The 32 bytes of the public half."""
    return private.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)


def wire_name(name: str) -> str:
    """A name that can stand in a message, a file name and a TOML table. Raises KeyFileError."""
    if not _NAME.fullmatch(name):
        raise KeyFileError(f'key "{name}": use letters, digits, "-" and "_", at most 64')
    return name


def _stamp(path: Path | None) -> tuple[int, int, int] | None:
    """Changes whenever a file does."""
    try:
        found = os.stat(path) if path else None
    except OSError:
        return None
    return (found.st_mtime_ns, found.st_size, found.st_ino) if found else None


def _key(name: str, entry: Any) -> Key | str:
    """The key of a table, or what is wrong with it."""
    if not _NAME.fullmatch(name):
        return 'the name has other than letters, digits, "-" and "_"'
    if not isinstance(entry, dict) or set(entry) != {"role", "public"}:
        return 'expected role = "…" and public = "…"'
    role, public = entry["role"], entry["public"]
    if role not in ROLES:
        return f'no role is called "{role}"{did_you_mean(str(role), ROLES)}'
    try:
        raw = base64.b64decode(public, validate=True)
        Ed25519PublicKey.from_public_bytes(raw)
    except (ValueError, TypeError):
        return "public is not the base64 of an Ed25519 public key"
    return Key(name, role, raw)
