"""A GNSS receiver on the tractor's bus speaks by PGN 65267 and 65256: `isobus_tractor.dbc` reads it like everything else."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from level1.event import Monitor
from level1.frame import Frame, frame_key
from level1.io.definitions import load
from level1.supervisor import Supervisor

S = 1_000_000_000
POSITION, MOTION = 0x18FEF31C, 0x18FEE81C
WHERE, HOW = bytes.fromhex("00F90295001BC97A"), bytes.fromhex("002D00060065A050")
CATALOG = load(["isobus_tractor.dbc"])


def monitored(frames: Sequence[tuple[int, bytes]]) -> tuple[dict[str, Any], dict[str, str]]:
    """Values and qualities of the monitoring message `motion` after these."""
    supervisor = Supervisor(CATALOG, unit="a", start_ns=0, monitor_ns=S)
    outputs = supervisor.receive_many([Frame(S // 2, frame_key(can_id, True), data) for can_id, data in frames])
    values: dict[str, Any] = {}
    quality: dict[str, str] = {}
    for output in [*outputs, *supervisor.tick(S)]:
        if isinstance(output, Monitor) and output.message == "motion":
            values, quality = values | output.values, quality | output.quality
    return values, quality


def test_position_and_motion_are_monitored() -> None:
    values, _ = monitored([(POSITION, WHERE), (MOTION, HOW)])
    assert (values["Latitude"], values["Longitude"]) == (40.0, -4.0)
    assert (values["Heading"], values["NavigationSpeed"], values["Altitude"]) == (90.0, 6.0, 80.0)


def test_a_receiver_without_a_fix_has_no_position() -> None:
    values, quality = monitored([(POSITION, bytes.fromhex("FF" * 8)), (MOTION, HOW)])
    assert (values["Latitude"], quality["Latitude"]) == (None, "unavailable")
    assert values["NavigationSpeed"] == 6.0
