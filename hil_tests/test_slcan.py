"""A CAN adapter on a serial line by the kernel's own slcan: `ucs run` on the interface it makes, its plug pulled and put in."""
from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hil_tests.conftest import SOON_S, START_S, Process, lose_the_flame
from level1.tests.lawicel import Adapter
from ucs.tests.units import unit_toml

pytestmark = pytest.mark.vcan

IN_TIME_S = 1.0


class Line:
    """The adapter, and `slcand`, which makes an interface of its serial line."""

    def __init__(self, path: Path):
        self.adapter = Adapter(path)
        self._daemon: subprocess.Popen[bytes] | None = None
        self.attach()

    def attach(self) -> None:
        self._daemon = subprocess.Popen(["slcand", "-F", "-o", "-s5", os.path.realpath(self.adapter.path), "slcan0"],
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end = time.monotonic() + SOON_S
        while not Path("/sys/class/net/slcan0").exists():
            assert time.monotonic() < end, "the kernel makes no interface"
            time.sleep(0.05)
        subprocess.run(["ip", "link", "set", "slcan0", "up"], check=True)

    def detach(self) -> None:
        """The adapter is pulled out."""
        if self.adapter.is_plugged:
            self.adapter.unplug()
        if self._daemon is not None:
            self._daemon.kill()
            self._daemon.wait()
            self._daemon = None


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    one = Line(tmp_path / "ttyCAN")
    yield one
    one.detach()
    one.adapter.stop()


def test_an_adapter_by_the_kernels_slcan_is_supervised_pulled_out_and_found_again(
        process: Callable[..., Process], line: Line, tmp_path: Path) -> None:
    (tmp_path / "unit.toml").write_text(
        unit_toml("ucs.dbc", "flaming_tool.dbc", armed=["PilotFlameOut"], channel="slcan0"))
    run = process("run", "unit.toml")
    run.expect("; supervising$", START_S)
    line.detach()
    run.expect("CanBusDown +raised", IN_TIME_S)
    line.adapter.plug()
    line.attach()
    run.expect("CanBusDown +cleared", SOON_S)
    lose_the_flame(run, line.adapter.hear)
    run.expect("PilotFlameOut +repair started", SOON_S)
    end = time.monotonic() + SOON_S
    while not any(sent.startswith("t110") for sent in line.adapter.sent):
        assert time.monotonic() < end, "no command reaches the adapter"
        time.sleep(0.05)
    assert run.stop() == 0
