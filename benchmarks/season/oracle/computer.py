"""What faults of the UCS's own computer show as."""
from __future__ import annotations

from collections.abc import Mapping

from benchmarks.season.oracle.table import Row, State, Symptom, symptom


def _part(alarm: str, within_s: float, device: str) -> Symptom:
    return symptom(alarm, within_s, lambda w, n: w.computer.talks and w.computer.fails(device))


CPU_HOT = symptom("CpuTemperatureCritical", 13.0, lambda w, n: w.computer.talks and w.computer.cpu_c > 95)
BOARD_HOT = symptom("MainboardTemperatureCritical", 13.0, lambda w, n: w.computer.talks and w.computer.board_c > 83)
RAM_FULL = symptom("RamCritical", 33.0, lambda w, n: w.computer.talks and w.computer.ram_percent > 93)
STORAGE_FULL = symptom("StorageCritical", 33.0, lambda w, n: w.computer.talks and w.computer.storage_percent > 96)
NOT_MEASURED = symptom("HealthNotMeasured", 5.5, lambda w, n: not w.computer.sends)

COMPUTER: Mapping[str, Row] = {
    "cpu overheats": Row((CPU_HOT,)),
    "board overheats": Row((BOARD_HOT,)),
    "memory leaks": Row((RAM_FULL,)),
    "storage fills": Row((STORAGE_FULL,)),
    "storage fails": Row((_part("StorageWriteFailed", 4.0, "storage"), _part("JournalFault", 4.0, "storage"))),
    "recorder fails": Row((_part("TrafficLogFailed", 4.0, "recorder"),)),
    "clock lost": Row((_part("TimeSyncLost", 122.5, "clock"),)),
    "loop late": Row((_part("LoopLate", 7.0, "loop"),)),
    "bus overloaded": Row((_part("BusOverloaded", 12.0, "bus"),)),
    "silent": Row((NOT_MEASURED,)),
    "frozen": Row(),
    "reset": Row(),
}

ROWS: Mapping[str, Mapping[str, Row]] = {"computer": COMPUTER}
NATURAL: Mapping[str, State] = {}
LINGERS: Mapping[str, State] = {}
