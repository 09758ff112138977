"""J1939 against an independent peer: the transport protocol and the sockets of the Linux kernel (can-j1939)."""
from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from hil_tests.conftest import SOON_S, START_S
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

UNIT = unit_toml("ucs.dbc", "isobus_tractor.dbc", more="j1939 = 128")
ENGINE, UCS = 0x00, 0x80
DM1 = 65226
ADDRESS_CLAIM = 0x18EEFF00


def dm1(*spns: int) -> bytes:
    """A DM1 with the amber lamp and these codes, each with FMI 4."""
    return b"\x04\xff" + b"".join(bytes([spn & 0xFF, spn >> 8, spn >> 16 << 5 | 4, 1]) for spn in spns)


@pytest.fixture
def supervisor(process: Any, tmp_path: Path) -> Any:
    (tmp_path / "unit.toml").write_text(UNIT)
    running = process("run", "unit.toml", cwd=tmp_path)
    running.expect("supervising", START_S)
    return running


@pytest.fixture
def engine() -> Iterator[socket.socket]:
    """The kernel's J1939 socket at the engine's address."""
    with socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as peer:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        peer.bind(("vcan0", socket.J1939_NO_NAME, socket.J1939_NO_PGN, ENGINE))
        yield peer


@pytest.mark.covers("TroubleCode", "raised", "cleared")
def test_the_kernels_broadcast_in_packets_is_understood(supervisor: Any, engine: socket.socket) -> None:
    engine.sendto(dm1(100, 110, 190), ("vcan0", socket.J1939_NO_NAME, DM1, socket.J1939_NO_ADDR))
    for spn in (100, 110, 190):
        supervisor.expect(f"TroubleCode +raised .*SPN {spn}")
    engine.sendto(dm1(100), ("vcan0", socket.J1939_NO_NAME, DM1, socket.J1939_NO_ADDR))
    supervisor.expect("TroubleCode +cleared")


def test_the_kernels_session_with_flow_control_is_granted_and_acknowledged(supervisor: Any, engine: socket.socket) -> None:
    time.sleep(0.5)
    engine.settimeout(SOON_S)
    engine.sendto(dm1(*range(100, 140)), ("vcan0", socket.J1939_NO_NAME, DM1, UCS))
    for spn in (100, 139):
        supervisor.expect(f"TroubleCode +raised .*SPN {spn}")


def test_the_address_is_claimed_defended_and_given_up_to_a_stronger_name(process: Any, tmp_path: Path) -> None:
    (tmp_path / "unit.toml").write_text(UNIT)
    with can.Bus("vcan0", interface="socketcan") as bus:
        running = process("run", "unit.toml", cwd=tmp_path)
        running.expect("supervising", START_S)
        name = heard(bus, ADDRESS_CLAIM | UCS)
        bus.send(can.Message(arbitration_id=ADDRESS_CLAIM | UCS, data=b"\xff" * 8))
        assert heard(bus, ADDRESS_CLAIM | UCS) == name
        bus.send(can.Message(arbitration_id=ADDRESS_CLAIM | UCS, data=bytes(8)))
        assert heard(bus, ADDRESS_CLAIM | (UCS + 1)) == name
        running.expect("AddressConflict +raised")


def test_the_kernels_own_claim_with_a_stronger_name_takes_the_address(supervisor: Any) -> None:
    time.sleep(0.5)
    with socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as stronger:
        stronger.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        stronger.bind(("vcan0", 1, socket.J1939_NO_PGN, UCS))
        with can.Bus("vcan0", interface="socketcan") as bus:
            stronger.sendto((1).to_bytes(8, "little"), ("vcan0", socket.J1939_NO_NAME, 0xEE00, socket.J1939_NO_ADDR))
            assert heard(bus, ADDRESS_CLAIM | UCS + 1) not in (b"", (1).to_bytes(8, "little"))
        supervisor.expect("AddressConflict +raised.*SourceAddress 128")
        time.sleep(0.4)
        stronger.sendto(dm1(100), ("vcan0", socket.J1939_NO_NAME, DM1, socket.J1939_NO_ADDR))
        supervisor.expect("TroubleCode +raised .*SourceAddress 128, SPN 100")


def heard(bus: can.BusABC, can_id: int) -> bytes:
    """The payload of the next frame with this identifier."""
    end = time.monotonic() + SOON_S
    while time.monotonic() < end:
        message = bus.recv(1)
        if message is not None and message.arbitration_id == can_id:
            return bytes(message.data)
    raise AssertionError(f"no frame {can_id:X} came")
