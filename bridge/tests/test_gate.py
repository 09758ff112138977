"""No stranger is obeyed, nobody beyond their role, nothing twice, nothing late; each refusal has its reason."""
from __future__ import annotations

import base64
import os
import random
import sqlite3
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from bridge import wire
from bridge.gate import VALID_NS, Decision, Gate, Passed, Refused, Repeated
from bridge.keys import RIGHTS, ROLES, Key, public_bytes
from bridge.signing import signed
from level1.command import Order
from level1.event import seconds
from level1.io.error import OutsideError

S = 1_000_000_000
NOW = 5000 * S
FLEET, UNIT, BOOT = "farm", "tractor-7", 3
PRIVATE = {role: Ed25519PrivateKey.from_private_bytes(bytes([number]) * 32) for number, role in enumerate(ROLES, 1)}
KEYS = {role: Key(role, role, public_bytes(private)) for role, private in PRIVATE.items()}


def an_order(seq: int = 1, **changes: Any) -> wire.Order:
    fields: dict[str, Any] = {"unit": UNIT, "boot": BOOT, "seq": seq, "t": seconds(NOW - S), "id": f"c-{seq}", "name": "pause",
                              "expires_t": seconds(NOW + 5 * S)}
    return wire.Order(**fields | changes)


def sealed(order: wire.Order, key: str = "reset", fleet: str = FLEET) -> bytes:
    return wire.encode(signed(order, fleet, key, PRIVATE[key]))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.db.commands"


@pytest.fixture
def gate(path: Path) -> Iterator[Gate]:
    gate = Gate(path, FLEET, UNIT, KEYS, NOW - 600 * S)
    yield gate
    gate.close()


def decide(gate: Gate, payload: bytes, now_ns: int = NOW, boot: int = BOOT) -> Decision:
    return gate.decide(payload, boot, now_ns)


def reason(decision: Decision) -> str:
    assert isinstance(decision, Refused), decision
    return decision.reason


def test_a_good_command_becomes_an_order(gate: Gate) -> None:
    passed = decide(gate, sealed(an_order(7, name="reduce_speed", value=Decimal("2.5"))))
    assert isinstance(passed, Passed)
    assert (passed.id, passed.seq) == ("c-7", 7)
    assert passed.order == Order(f"{KEYS['reset'].fingerprint}-7", "reduce_speed", "", Decimal("2.5"), "above", NOW + 5 * S,
                                 "reset", "c-7")


# Who


@pytest.mark.fault("a command by a stranger, forged or changed on the way", "refused: unknown key, wrong signature")
def test_a_stranger_is_refused(gate: Gate) -> None:
    stranger = Ed25519PrivateKey.generate()
    assert reason(decide(gate, wire.encode(signed(an_order(), FLEET, "nobody", stranger)))) == "unknown key"
    assert reason(decide(gate, wire.encode(signed(an_order(), FLEET, "reset", stranger)))) == "wrong signature"


@pytest.mark.fault("a command by a stranger, forged or changed on the way")
def test_every_changed_byte_of_the_order_breaks_the_signature(gate: Gate) -> None:
    command = signed(an_order(), FLEET, "reset", PRIVATE["reset"])
    for at in range(0, len(command.body), 3):
        changed = command.body[:at] + chr(ord(command.body[at]) ^ 1) + command.body[at + 1:]
        assert reason(decide(gate, wire.encode(msgspec.structs.replace(command, body=changed)))) == "wrong signature"


@pytest.mark.fault("a command by a stranger, forged or changed on the way")
@pytest.mark.parametrize("signature", ["", "AAAA", "no base64!", "A" * 88, "ü" * 10])
def test_a_malformed_signature_is_refused(gate: Gate, signature: str) -> None:
    command = msgspec.structs.replace(signed(an_order(), FLEET, "reset", PRIVATE["reset"]), signature=signature)
    assert reason(decide(gate, wire.encode(command))) == "wrong signature"


@pytest.mark.fault("a command beyond the role", "refused with the role")
@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("name", [*RIGHTS, "nozzle_pressure"])
def test_each_role_may_do_what_it_may_and_no_more(gate: Gate, role: str, name: str) -> None:
    decision = decide(gate, sealed(an_order(name=name), role))
    may = ROLES.index(role) >= ROLES.index(RIGHTS.get(name, "reset"))
    assert isinstance(decision, Passed) == may
    if not may:
        assert reason(decision) == f'the role "{role}" may not {name}'


@pytest.mark.fault("a command by a stranger, forged or changed on the way")
def test_a_key_taken_away_may_nothing(gate: Gate) -> None:
    gate.keys = {name: key for name, key in KEYS.items() if name != "reset"}
    assert reason(decide(gate, sealed(an_order()))) == "unknown key"


# For whom


@pytest.mark.fault("a command for another unit, fleet or boot", "refused")
@pytest.mark.parametrize(("fleet", "changes", "told"), [
    ("other-farm", {}, "wrong signature"),
    (FLEET, {"unit": "tractor-8"}, "wrong signature"),
    (FLEET, {"boot": BOOT - 1}, "for boot 2 of the unit, which is in boot 3"),
])
def test_a_command_for_another_is_refused(gate: Gate, fleet: str, changes: dict[str, Any], told: str) -> None:
    assert reason(decide(gate, sealed(an_order(**changes), fleet=fleet))) == told


@pytest.mark.fault("a command for another unit, fleet or boot")
def test_an_order_for_another_unit_under_this_units_topic_is_refused(gate: Gate) -> None:
    order = an_order(unit="tractor-8")
    body = wire.encode(order).decode()
    command = signed(an_order(), FLEET, "reset", PRIVATE["reset"])
    signature = base64.b64encode(PRIVATE["reset"].sign(wire.signed_bytes(FLEET, UNIT, body))).decode()
    assert reason(decide(gate, wire.encode(msgspec.structs.replace(command, body=body, signature=signature)))) == "for another unit"


# When


@pytest.mark.fault("a command too late, too early or valid for too long", "refused with the reason, to the nanosecond")
@pytest.mark.parametrize(("t_s", "expires_s", "told"), [
    (-20, -1, "expired"), (-29, 2, "valid for longer than 30 s"), (3, 10, "from the future"), (0, 0, "valid for longer than 30 s"),
    (0, -5, "valid for longer than 30 s"), (0, 10**9, "valid for longer than 30 s"), (-6000, -5990, "valid for longer than 30 s")])
def test_a_command_at_the_wrong_time_is_refused(gate: Gate, t_s: int, expires_s: int, told: str) -> None:
    order = an_order(t=seconds(NOW + t_s * S), expires_t=seconds(NOW + expires_s * S))
    assert reason(decide(gate, sealed(order))) == told


@pytest.mark.fault("a command too late, too early or valid for too long")
def test_a_command_is_valid_to_its_last_nanosecond(gate: Gate) -> None:
    order = an_order(t=seconds(NOW), expires_t=seconds(NOW + VALID_NS))
    assert isinstance(decide(gate, sealed(order), NOW + VALID_NS), Passed)
    assert reason(decide(gate, sealed(msgspec.structs.replace(order, seq=2)), NOW + VALID_NS + 1)) == "expired"


@pytest.mark.parametrize("number", ["1E999999999", "-1E999999999", "1E-999999999", "1" * 200])
@pytest.mark.parametrize("field", ["t", "expires_t", "value"])
def test_monstrous_numbers_are_refused(gate: Gate, number: str, field: str) -> None:
    changes: dict[str, Any] = {field: Decimal(number)}
    assert reason(decide(gate, sealed(an_order(**changes)))) == f"malformed order: {field} is no plain number"


# Once


@pytest.mark.fault("a command that comes again", "the same answer, obeyed once; an older counter is refused, also after a restart")
def test_a_command_that_comes_again_gets_the_same_answer_and_no_second_obedience(gate: Gate) -> None:
    passed = decide(gate, sealed(an_order()))
    assert isinstance(passed, Passed)
    assert decide(gate, sealed(an_order())) == Repeated("c-1", 1, "", "")
    gate.remember(passed, "done", "")
    assert decide(gate, sealed(an_order()), NOW + 3600 * S) == Repeated("c-1", 1, "done", "")


@pytest.mark.fault("a command that comes again")
def test_a_counter_never_goes_back(gate: Gate) -> None:
    assert isinstance(decide(gate, sealed(an_order(5))), Passed)
    assert reason(decide(gate, sealed(an_order(4)))) == "its counter was used before"
    assert reason(decide(gate, sealed(an_order(5, name="stop")))) == "its counter was used before"
    assert isinstance(decide(gate, sealed(an_order(6))), Passed)


@pytest.mark.fault("a command that comes again")
def test_each_key_has_its_own_counter_whatever_it_is_called(gate: Gate) -> None:
    assert isinstance(decide(gate, sealed(an_order(5))), Passed)
    assert isinstance(decide(gate, sealed(an_order(1), "pause")), Passed)
    gate.keys = {"pause": msgspec.structs.replace(KEYS["reset"], name="pause")}
    command = signed(an_order(5, id="x"), FLEET, "pause", PRIVATE["reset"])
    assert reason(decide(gate, wire.encode(command))) == "its counter was used before"


@pytest.mark.fault("a command that comes again")
def test_a_counter_is_on_the_disk_before_its_order_is_given_out(gate: Gate, path: Path) -> None:
    decide(gate, sealed(an_order(5)))
    again = Gate(path, FLEET, UNIT, KEYS, NOW)
    assert isinstance(decide(again, sealed(an_order(5))), Repeated)
    assert reason(decide(again, sealed(an_order(4)))) == "its counter was used before"
    again.close()


@pytest.mark.fault("counters lost, damaged, or not to be written")
def test_no_disk_no_obedience(gate: Gate, path: Path) -> None:
    other = sqlite3.connect(path, isolation_level=None)
    gate._connection.execute("PRAGMA busy_timeout = 0")
    other.execute("BEGIN IMMEDIATE")
    assert "the unit's disk does not take the counter" in reason(decide(gate, sealed(an_order())))
    other.execute("ROLLBACK")
    other.close()
    assert isinstance(decide(gate, sealed(an_order())), Passed)


@pytest.mark.fault("a command that comes again")
def test_old_answers_are_forgotten_but_not_the_counter(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bridge.gate.ANSWERS", 20)
    for seq in range(1, 23):
        assert isinstance(decide(gate, sealed(an_order(seq))), Passed)
    assert reason(decide(gate, sealed(an_order(2)))) == "its counter was used before"
    assert isinstance(decide(gate, sealed(an_order(3))), Repeated)


@pytest.mark.fault("counters lost, damaged, or not to be written",
                   "what was issued before is refused; without a disk everything is")
@pytest.mark.parametrize("damage", [b"not a database" * 100, b"SQLite format 3\0" + bytes(100)])
def test_lost_counters_let_nothing_old_in(path: Path, damage: bytes) -> None:
    path.write_bytes(damage)
    gate = Gate(path, FLEET, UNIT, KEYS, NOW)
    assert gate.renewed
    assert reason(decide(gate, sealed(an_order()))) == "issued before the unit lost its counters"
    assert isinstance(decide(gate, sealed(an_order(t=seconds(NOW)))), Passed)
    assert path.with_name(path.name + ".corrupt").read_bytes() == damage
    gate.close()


@pytest.mark.fault("counters lost, damaged, or not to be written")
def test_counters_taken_away_let_nothing_old_in_either(gate: Gate, path: Path) -> None:
    captured = sealed(an_order(5))
    assert isinstance(decide(gate, captured), Passed)
    for file in path.parent.iterdir():
        file.unlink()
    for begun_ns in (NOW, NOW + S):  # and a restart of the bridge does not make it forget that
        again = Gate(path, FLEET, UNIT, KEYS, begun_ns)
        assert reason(decide(again, captured, NOW + 2 * S)) == "issued before the unit lost its counters"
        assert isinstance(decide(again, sealed(an_order(begun_ns, t=seconds(NOW)), "pause")), Passed)
        again.close()


def test_a_clock_that_began_anew_makes_no_command_late(path: Path) -> None:
    Gate(path, FLEET, UNIT, KEYS, NOW).close()
    rebooted = Gate(path, FLEET, UNIT, KEYS, 20 * S)
    assert isinstance(decide(rebooted, sealed(an_order(t=seconds(21 * S), expires_t=seconds(30 * S))), 22 * S), Passed)
    rebooted.close()


def test_a_folder_that_cannot_be_written_is_told() -> None:
    with pytest.raises(OutsideError, match="can't be used"):
        Gate(Path("/proc/journal.db.commands"), FLEET, UNIT, KEYS, NOW)


# Everything at once


@pytest.mark.fault("a command by a stranger, forged or changed on the way")
def test_forged_replayed_expired_and_malformed_commands_are_never_obeyed(gate: Gate) -> None:
    dice = random.Random(1)
    good = [sealed(an_order(seq)) for seq in (1, 2, 3)]
    for payload in good:
        decide(gate, payload)
    obeyed = 0
    for _ in range(2000):
        forged = bytearray(dice.choice(good))
        for _ in range(dice.randint(1, 4)):
            at = dice.randrange(len(forged))
            forged[at:at + dice.randint(0, 2)] = os.urandom(dice.randint(0, 2))
        decision = decide(gate, bytes(forged))
        obeyed += isinstance(decision, Passed)
    assert obeyed == 0
