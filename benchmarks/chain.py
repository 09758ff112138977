"""One contender over one candump file, in a process of its own so that its memory can be told: `benchmarks.core` starts it.

Prints CPU seconds, peak resident kilobytes and a digest of the alarms.
"""
from __future__ import annotations

import pickle
import re
import sys
from hashlib import sha256
from pathlib import Path

from benchmarks import runs


def main(contender: str, log: str, dbc: str, rules: str) -> None:
    """contender: `core` or `peer`; log: candump file; dbc: definitions; rules: the same as a pickle of `benchmarks.rules`."""
    if contender == "core":
        from level1.io import definitions
        seconds, alarms = runs.chain_core(definitions.load([dbc]), log)
    else:
        import cantools
        seconds, alarms = runs.chain_peer(cantools.database.load_file(dbc), pickle.loads(Path(rules).read_bytes()), log)
    print(seconds, peak_kb(), sha256(repr(sorted(alarms)).encode()).hexdigest())


def peak_kb() -> int:
    """Peak resident memory of this program alone: `getrusage` would tell that of whoever started it, were it larger."""
    found = re.search(r"^VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1])


if __name__ == "__main__":
    main(*sys.argv[1:])
