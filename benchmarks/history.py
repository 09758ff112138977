"""What the monitoring history costs: tractor with sprayer boom over the whole field, in virtual time, all monitoring messages kept.

    python -m benchmarks.history [--write]      # --write: into docs/operation.md
"""
from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks import page
from benchmarks.simulation import FILES, MONITOR_NS, SCENARIO
from firmware_py.scenario import build
from firmware_py.virtual_bus import Simulation
from level1.event import Monitor, Output
from level1.io import definitions
from level1.io.config import JournalFile
from level1.io.journal_monitor import Gatherer, History, HistoryReader
from level1.supervisor import Supervisor
from ucs.simulate import load
from ucs.simulated_unit import SimulatedUnit

PAGE = page.PAGE.with_name("operation.md")
UTC_NS = 1_746_093_600_000_000_000
"""Every sample has a label, as on a unit that knows the time."""
BOUND_BYTES = 1 << 40
JITTER_NS = 500_000
"""By so much frames come late, as on a real bus: without it the ages of the values would be round, and take half the room."""


class JitteryUnit(SimulatedUnit):
    """Hears each frame a moment after it was sent."""

    dice = random.Random(1)

    def receive(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """See `SimulatedUnit`."""
        super().receive(t_ns + self.dice.randrange(JITTER_NS), can_id, extended, data)


def mission(folder: Path) -> list[list[str]]:
    """One run; rows of a table."""
    scenario = load(SCENARIO)
    journal = folder / "journal.db"
    incidents: list[str] = []
    gatherer, history = Gatherer(), History(journal, BOUND_BYTES, lambda: True, incidents)
    gather_s = pack_s = 0.0
    samples = lines = 0

    def deliver(outputs: Sequence[Output]) -> None:
        nonlocal gather_s, pack_s, samples, lines
        monitors = [output for output in outputs if isinstance(output, Monitor)]
        samples += len(monitors)
        begun = time.process_time()
        piece = gatherer.add(monitors)
        gathered = time.process_time()
        gather_s += gathered - begun
        if piece is not None:
            lines += len(piece.lines)
            history.take([piece], 1)
            pack_s += time.process_time() - gathered
    unit = JitteryUnit(Supervisor(definitions.load(FILES), unit="tractor-7", start_ns=0, monitor_ns=MONITOR_NS,
                                  utc_offset_ns=UTC_NS, utc_trusted=True), deliver)
    Simulation([*build(scenario).participants, unit]).run(scenario.duration_ns)
    if rest := gatherer.rest():
        history.take([rest], 1)
    history.write(1)
    history.close()
    assert not incidents and not history.lost
    with HistoryReader(journal) as reader:
        batches = len(reader.batches())
    hours = scenario.duration_ns / 3600e9
    size = history.path.stat().st_size
    bound_mb = JournalFile("").monitor_mb
    return [
        ["monitoring messages kept", f"{samples / hours / 3600:.0f} a second"],
        ["as JSON lines", f"{lines / hours / 1e6:.0f} MB an hour"],
        ["in the file", f"{size / hours / 1e6:.1f} MB an hour, {lines / size:.0f} times less, {size / batches / 1e3:.0f} kB each"],
        [f"hours in the default bound of {bound_mb} MB", f"{bound_mb * 1e6 / (size / hours):.0f}"],
        ["work of the live loop", f"{gather_s / samples * 1e6:.0f} µs a message, {100 * gather_s / hours / 3600:.3f} % of a core"],
        ["work of the journal's thread", f"{100 * pack_s / hours / 3600:.3f} % of a core"],
    ]


def main() -> None:
    """Print the table, and put it into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put it into docs/operation.md")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="history-") as folder:
        table = page.table(["tractor and sprayer boom, all shipped definitions of both", ""], mission(Path(folder)))
    print(*table, sep="\n")
    if args.write:
        page.put("history", table, PAGE)


if __name__ == "__main__":
    main()
