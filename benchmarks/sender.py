"""Sends CAN frames as datagrams, evenly, and tells when each left: `benchmarks.receiver` starts it.

PORT RATE N FRAMES ALONE: `FRAMES` holds 16-byte frames. Writes N times of the monotonic clock to its output, ns, as 64-bit
integers.
"""
from __future__ import annotations

import socket
import sys
import time
from array import array
from pathlib import Path

from benchmarks.receiver import FRAME, settle_on


def main(port: str, rate: str, count: str, path: str, alone: str) -> None:
    """Send, looking at the clock all the time: a sleep would wake up late."""
    settle_on(0, alone == "1")
    data = Path(path).read_bytes()
    period_ns = 1_000_000_000 / int(rate)
    sent = array("q", bytes(8 * int(count)))
    now = time.monotonic_ns
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect(("127.0.0.1", int(port)))
        send = sock.send
        begin_ns = now()
        for i in range(int(count)):
            due_ns = begin_ns + int(i * period_ns)
            while (t_ns := now()) < due_ns:
                pass
            sent[i] = t_ns
            send(data[i * FRAME:i * FRAME + FRAME])
    sys.stdout.buffer.write(sent.tobytes())


if __name__ == "__main__":
    main(*sys.argv[1:])
