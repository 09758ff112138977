"""One contender over one recording, in a process of its own so that its memory can be told: `benchmarks.replay` starts it.

Prints CPU seconds, frames, peak resident kilobytes, alarms raised and cleared, and a digest of them. Definitions are made
ready and libraries imported before the clock starts.
"""
from __future__ import annotations

import pickle
import re
import sys
import time
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

AlarmLine = tuple[int, str, str]
"""Nanoseconds, name of the alarm, `raised` or `cleared`."""


class Outcome(NamedTuple):
    """What a contender has come to."""

    seconds: float
    frames: int
    alarms: list[AlarmLine]


def ours(log: str, dbc: str, blocks: bool = True) -> Outcome:
    """From a recording to events as lines of JSON, as `ucs replay` does it."""
    import level1.io.blf_blocks
    import level1.io.candump_blocks
    import level1.io.mf4_blocks
    import level1.io.pcap_blocks
    import level1.io.text_blocks
    import level1.sieve  # noqa: F401
    from level1.event import encode
    from level1.io import definitions
    from level1.io.replay import Log
    from ucs.recording import Replay
    catalog = definitions.load([dbc])
    alarms: list[AlarmLine] = []
    replay = Replay(Log(log, one_bus=True), catalog, None, blocks=blocks)
    start = time.process_time()
    for batch in replay.batches():
        for event in batch:
            encode(event)
            alarms.append((int(event.t.scaleb(9)), event.alarm, event.event))
    return Outcome(time.process_time() - start, replay.log.frames_read, alarms)


def peer(log: str, dbc: str, rules: str) -> Outcome:
    """The same recording through python-can's reader, cantools and the same rules, a pickle of `benchmarks.rules`."""
    import can
    import cantools

    from benchmarks.peer import Monitor
    monitor = Monitor(cantools.database.load_file(dbc), pickle.loads(Path(rules).read_bytes()))
    frames = 0
    start = time.process_time()
    messages: Iterable[Any]
    if log.endswith(".pcap"):
        from benchmarks.recordings import read_pcap
        messages = read_pcap(log)
    else:
        messages = can.LogReader(log)
    for message in messages:
        monitor.receive(message)
        frames += 1
    return Outcome(time.process_time() - start, frames, monitor.alarms)


def peak_kb() -> int:
    """Peak resident memory of this program alone: `getrusage` would tell that of whoever started it, were it larger."""
    found = re.search(r"^VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1])


def main(contender: str, *arguments: str) -> None:
    """contender: `ours`, with recording and definitions; or `peer`, with the rules too."""
    contenders: dict[str, Callable[..., Outcome]] = {"ours": ours, "peer": peer}
    seconds, frames, alarms = contenders[contender](*arguments)
    print(seconds, frames, peak_kb(), len(alarms), sha256(repr(sorted(alarms)).encode()).hexdigest())


if __name__ == "__main__":
    main(*sys.argv[1:])
