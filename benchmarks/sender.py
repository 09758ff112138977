"""Sends CAN frames as datagrams, evenly, and tells when each left: `benchmarks.receiver` starts it.

PORT RATE N FRAMES ALONE: `FRAMES` holds 16-byte frames. Writes N times of the monotonic clock to its output, ns, as 64-bit
integers. Where it was held up it sends later from then on: a bus that was to be caught up with would be faster than a bus can be.
"""
from __future__ import annotations

import socket
import sys
import time
from array import array
from pathlib import Path

from benchmarks.receiver import FRAME, settle_on

CATCH_UP_NS = 500_000
"""So much lateness is made up for."""
SLEEP_NS = 60_000
"""Where it runs before all others it may not look at the clock all the time, but sleeps while there is so long to go."""


def main(port: str, rate: str, count: str, path: str, alone: str) -> None:
    """Send, looking at the clock all the time: a sleep wakes up late, but for who runs before all others."""
    settle_on(0, alone == "1")
    data = Path(path).read_bytes()
    period_ns = 1_000_000_000 / int(rate)
    sent = array("q", bytes(8 * int(count)))
    now = time.monotonic_ns
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect(("127.0.0.1", int(port)))
        send = sock.send
        due_ns = float(now())
        for i in range(int(count)):
            while (t_ns := now()) < due_ns:
                if alone == "1" and due_ns - t_ns > SLEEP_NS:
                    time.sleep((due_ns - t_ns - SLEEP_NS / 2) / 1e9)
            sent[i] = t_ns
            send(data[i * FRAME:i * FRAME + FRAME])
            due_ns = max(due_ns, t_ns - CATCH_UP_NS) + period_ns
    sys.stdout.buffer.write(sent.tobytes())


if __name__ == "__main__":
    main(*sys.argv[1:])
