"""Key files: who may command, told apart from who may not, and every mistake in them told."""
from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from bridge.keys import ROLES, Key, KeyFileError, KeyRing, add_key, load_keys, load_private, make_private, public_bytes, wire_name


def a_key(folder: Path, name: str, role: str = "pause") -> Key:
    return Key(name, role, public_bytes(make_private(folder / f"{name}.key")))


def test_keys_survive_their_files(tmp_path: Path) -> None:
    keys = {name: a_key(tmp_path, name, role) for name, role in zip("abcde", ROLES, strict=True)}
    for key in keys.values():
        add_key(tmp_path / "keys.toml", key)
    assert load_keys(tmp_path / "keys.toml") == keys
    message = b"pause"
    assert all(key.verifies(load_private(tmp_path / f"{name}.key").sign(message), message) for name, key in keys.items())


def test_a_private_key_is_for_its_owner_alone_and_never_overwritten(tmp_path: Path) -> None:
    make_private(tmp_path / "chief.key")
    assert stat.S_IMODE((tmp_path / "chief.key").stat().st_mode) == 0o600
    with pytest.raises(KeyFileError, match="File exists"):
        make_private(tmp_path / "chief.key")


def test_a_name_is_given_once(tmp_path: Path) -> None:
    add_key(tmp_path / "keys.toml", a_key(tmp_path, "chief"))
    with pytest.raises(KeyFileError, match='has a key "chief" already'):
        add_key(tmp_path / "keys.toml", Key("chief", "view", bytes(32)))


@pytest.mark.parametrize("name", ["", "a b", "a/b", "a.b", "x" * 65, "ü"])
def test_names_are_plain(name: str) -> None:
    with pytest.raises(KeyFileError):
        wire_name(name)


def test_every_mistake_in_a_key_file_is_told(tmp_path: Path) -> None:
    text = '[a]\nrole = "pauze"\npublic = ""\n[b]\nrole = "view"\npublic = "AAAA"\n[c]\nrole = "view"\n'
    (tmp_path / "keys.toml").write_text(text)
    with pytest.raises(KeyFileError) as error:
        load_keys(tmp_path / "keys.toml")
    assert [problem.partition(": [")[2] for problem in error.value.problems] == [
        'a]: no role is called "pauze"; did you mean "pause"?', "b]: public is not the base64 of an Ed25519 public key",
        'c]: expected role = "…" and public = "…"']


def test_a_name_twice_or_a_key_twice_is_no_key_file(tmp_path: Path) -> None:
    path = tmp_path / "keys.toml"
    add_key(path, Key("guest", "view", public_bytes(make_private(tmp_path / "guest.key"))))
    entry = path.read_text()
    path.write_text(entry + entry.replace('"view"', '"reset"'))
    with pytest.raises(KeyFileError, match="can't be read"):
        load_keys(path)
    path.write_text(entry + entry.replace("guest", "chief").replace('"view"', '"reset"'))
    with pytest.raises(KeyFileError, match=r"\[chief\]: the same key as \[guest\], so its role is not clear"):
        load_keys(path)


@pytest.mark.parametrize("content", [None, b"\xff", b"no = = toml"])
def test_a_key_file_that_cannot_be_read_is_told(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "keys.toml").write_bytes(content)
    with pytest.raises(KeyFileError, match="can't be read"):
        KeyRing(tmp_path / "keys.toml")


def test_a_private_key_that_is_none_is_told(tmp_path: Path) -> None:
    other = rsa.generate_private_key(65537, 2048)
    (tmp_path / "rsa.key").write_bytes(other.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    (tmp_path / "text.key").write_text("hello")
    for name, told in (("rsa.key", "is no Ed25519 key"), ("text.key", "can't be read"), ("missing.key", "No such file")):
        with pytest.raises(KeyFileError, match=told):
            load_private(tmp_path / name)


def test_a_key_taken_out_of_the_file_is_gone_at_once_and_a_broken_file_lets_nobody_in(tmp_path: Path) -> None:
    path = tmp_path / "keys.toml"
    add_key(path, a_key(tmp_path, "chief"))
    ring = KeyRing(path)
    assert set(ring.current()) == {"chief"}
    add_key(path, a_key(tmp_path, "deputy"))
    assert set(ring.current()) == {"chief", "deputy"}
    path.write_text("[chief")
    assert ring.current() == {} and "until then nobody may command" in ring.fault
    os.remove(path)
    assert ring.current() == {}


def test_without_a_file_nobody_may_command() -> None:
    assert KeyRing(None).current() == {}
