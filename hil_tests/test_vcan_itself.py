"""The ground the other tests stand on: the virtual buses, the kernel's time stamps, and how pytest gets to them."""
from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from hil_tests import vcan_run
from hil_tests.conftest import ROOT, Process

FLAMER_STATUS = 0x18FF_5021
PAYLOAD = bytes.fromhex("00ff10a5c3000180")
IN_TIME_S = 2.0


@pytest.fixture
def open_bus() -> Iterator[Callable[[str], can.BusABC]]:
    """Opens buses and closes them after the test."""
    opened: list[can.BusABC] = []

    def open_(channel: str) -> can.BusABC:
        opened.append(can.Bus(channel=channel, interface="socketcan"))
        return opened[-1]

    yield open_
    for bus in opened:
        bus.shutdown()


def frame(data: bytes = PAYLOAD) -> can.Message:
    return can.Message(arbitration_id=FLAMER_STATUS, is_extended_id=True, data=data)


@pytest.mark.vcan
def test_a_frame_arrives_with_its_29_bit_id_its_payload_and_the_kernels_time(
        open_bus: Callable[[str], can.BusABC]) -> None:
    receiver, sender = open_bus("vcan0"), open_bus("vcan0")
    before_s = time.time()
    sender.send(frame())
    after_s = time.time()
    received = receiver.recv(IN_TIME_S)
    assert received is not None
    assert (received.arbitration_id, received.is_extended_id, bytes(received.data)) == (FLAMER_STATUS, True, PAYLOAD)
    assert before_s <= received.timestamp <= after_s, "the stamp is that of sending, not of the call of recv"


@pytest.mark.vcan
def test_frames_keep_their_order(open_bus: Callable[[str], can.BusABC]) -> None:
    receiver, sender = open_bus("vcan0"), open_bus("vcan0")
    for number in range(200):
        sender.send(frame(bytes([number])))
    received = [receiver.recv(IN_TIME_S) for _ in range(200)]
    assert [one.data[0] for one in received if one is not None] == list(range(200))


@pytest.mark.vcan
def test_vcan1_is_another_bus(open_bus: Callable[[str], can.BusABC]) -> None:
    receiver, sender = open_bus("vcan1"), open_bus("vcan0")
    sender.send(frame())
    assert receiver.recv(0.2) is None


@pytest.mark.vcan
def test_link_down_is_told_once_and_the_socket_works_after_up(
        open_bus: Callable[[str], can.BusABC], set_link: Callable[[str, bool], None]) -> None:
    receiver, sender = open_bus("vcan0"), open_bus("vcan0")
    set_link("vcan0", False)
    with pytest.raises(can.CanOperationError):
        receiver.recv(IN_TIME_S)
    assert receiver.recv(0.1) is None
    set_link("vcan0", True)
    open_bus("vcan0").send(frame())
    received = receiver.recv(IN_TIME_S)
    assert received is not None and bytes(received.data) == PAYLOAD
    with pytest.raises(can.CanOperationError):
        sender.recv(IN_TIME_S)


@pytest.mark.vcan
def test_a_program_of_its_own_hears_the_bus(
        open_bus: Callable[[str], can.BusABC], process: Callable[..., Process]) -> None:
    listener = process("-c", "import can\nwith can.Bus(channel='vcan0', interface='socketcan') as bus:\n"
                             " print('ready')\n print(bus.recv(9).data.hex())", program=(sys.executable,))
    listener.expect("^ready$")
    open_bus("vcan0").send(frame())
    assert listener.expect("^[0-9a-f]+$").group() == PAYLOAD.hex()
    assert listener.wait() == 0


def run_pytest(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A pytest run of its own, with this project's conftest.py."""
    shutil.copy(ROOT / "conftest.py", folder)
    (folder / "test_one.py").write_text(
        "import pytest, socket\n"
        "def test_native(): pass\n"
        "@pytest.mark.vcan\ndef test_on_vcan(): assert 'vcan0' in [name for _, name in socket.if_nameindex()]\n"
        "@pytest.mark.vcan\ndef test_that_fails(): assert 'the guest' == 'not this'\n"
        "@pytest.mark.vcan\ndef test_that_ends_the_guest():\n import os\n os._exit(3)\n")
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n    vcan\n")
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=folder, capture_output=True, text=True,
                          check=False, env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHONPATH": str(ROOT), **environment})


def test_tests_here_and_on_vcan_give_one_summary_and_one_status(tmp_path: Path) -> None:
    result = run_pytest(tmp_path, "-k", "not ends_the_guest")
    assert "vcan tests: 1 passed, 1 failed" in result.stdout.replace("1 failed, 1 passed", "1 passed, 1 failed")
    assert "assert 'the guest' == 'not this'" in result.stdout
    assert "1 failed, 2 passed, 1 deselected" in result.stdout
    assert result.returncode == pytest.ExitCode.TESTS_FAILED


@pytest.mark.skipif(vcan_run.present(), reason="here the test would end this pytest's own kind: vcan0 is on this network")
def test_a_test_that_ends_the_guest_is_an_error(tmp_path: Path) -> None:
    result = run_pytest(tmp_path, "-k", "native or ends_the_guest")
    assert "the guest ended, status 3 before this test had finished" in result.stdout
    assert "1 passed, 2 deselected, 1 error" in result.stdout
    assert result.returncode == pytest.ExitCode.TESTS_FAILED


def test_selecting_no_vcan_test_starts_no_guest(tmp_path: Path) -> None:
    result = run_pytest(tmp_path, "-m", "not vcan", PATH="/nowhere")
    assert "1 passed, 3 deselected" in result.stdout
    assert result.returncode == pytest.ExitCode.OK


@pytest.mark.skipif(vcan_run.present(), reason="vcan0 is on this network")
def test_without_a_way_to_vcan_pytest_ends_with_125_and_names_the_packages(tmp_path: Path) -> None:
    result = run_pytest(tmp_path, PATH="/nowhere")
    assert result.returncode == vcan_run.NO_WAY
    assert "3 tests need vcan0" in result.stdout and "apt-get install" in result.stdout
    assert "user-mode-linux" in result.stdout


def test_the_runner_gives_the_commands_exit_status() -> None:
    result = subprocess.run([sys.executable, vcan_run.__file__, "sh", "-c", "ip -br link show vcan1; echo no >&2; exit 7"],
                            capture_output=True, text=True, check=False)
    assert result.stdout.startswith("vcan1 ") and result.stderr == "no\n"
    assert result.returncode == 7


def test_the_runner_stops_what_runs_too_long() -> None:
    result = subprocess.run([sys.executable, vcan_run.__file__, "-t", "15", "sleep", "60"], capture_output=True, check=False)
    assert result.returncode == vcan_run.TIMED_OUT
