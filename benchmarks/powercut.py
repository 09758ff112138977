"""Power cuts: a guest of User Mode Linux writes a journal on a disk image and is killed; the next one looks what is left.

The guest's memory is gone with it, as with the mains; what it synchronised is in the image. Nothing else touches the image.
"""
from __future__ import annotations

import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from hil_tests import vcan_run

IMAGE_BYTES = 64 << 20
BOOT_S = 120.0
UBD_MAJOR = 98
GUEST = """
    import sys
    from pathlib import Path
    from level1.io.journal import Journal, read_events
    from ucs.tests.chain import an_event
    path = Path(sys.argv[1])
    with Journal(path, "tractor-7") as journal:
        for event in read_events(path, limit=10**6):
            print("have", event.boot, event.seq)
        print("begin", journal.boot, journal.incidents, flush=True)
        seq = 0
        while sys.argv[2] == "write":
            seq += 1
            if journal.append([an_event(seq, journal.boot)], b"%d" % seq):
                print("done", journal.boot, seq, flush=True)
"""


class Outcome:
    """What power cuts left. promised, found: positions of events; boots: ids in the order in which they began."""

    def __init__(self) -> None:
        self.promised: set[tuple[int, int]] = set()
        self.found: set[tuple[int, int]] = set()
        self.boots: list[int] = []
        self.incidents: list[str] = []

    @property
    def lost(self) -> set[tuple[int, int]]:
        """Promised and not found."""
        return self.promised - self.found


def cut(count: int, dice: random.Random) -> Outcome:
    """Cut the power so many times while events are written. Raises RuntimeError where no guest can run."""
    if missing := vcan_run.missing_packages():
        raise RuntimeError(f"apt-get install {' '.join(missing)}")
    outcome = Outcome()
    with tempfile.TemporaryDirectory(prefix="powercut-") as name:
        image = Path(name) / "disk"
        with open(image, "wb") as file:
            file.truncate(IMAGE_BYTES)
        subprocess.run([vcan_run.program("mkfs.ext4") or "mkfs.ext4", "-q", image], check=True)
        for number in range(count + 1):
            last = number == count
            _run(image, "look" if last else "write", None if last else dice.uniform(0.2, 2.0), outcome)
            print(f"  boot {number + 1}: {len(outcome.found)} events found, {len(outcome.promised)} promised by now", flush=True)
    return outcome


def _run(image: Path, mode: str, cut_after_s: float | None, outcome: Outcome) -> None:
    """One life of the guest, cut some time after it began to write; None: it looks and ends."""
    python = shlex.join([sys.executable, "-c", textwrap.dedent(GUEST), "/run/mnt/journal.db", mode])
    command = (f"mknod /run/disk b {UBD_MAJOR} 0 && mkdir -p /run/mnt && mount -t ext4 /run/disk /run/mnt && {python}; "
               "umount /run/mnt")
    with tempfile.TemporaryDirectory(prefix="guest-") as name:
        guest, output, keyboard = _boot(Path(name), image, ["sh", "-c", command])
        try:
            outcome.found.clear()
            _listen(output, guest, cut_after_s, outcome)
        finally:
            _pull_the_plug(guest)
            guest.wait()
            output.close()
            os.close(keyboard)
    time.sleep(0.2)


def _listen(output: IO[bytes], guest: subprocess.Popen[bytes], cut_after_s: float | None, outcome: Outcome) -> None:
    end = None
    for line in output:
        if not line.endswith(b"\n"):
            return  # cut in the middle of a word
        word, *rest = line.decode(errors="replace").split(maxsplit=2)
        if word == "have":
            outcome.found.add((int(rest[0]), int(rest[1])))
        elif word == "begin":
            outcome.boots.append(int(rest[0]))
            outcome.incidents += [rest[1].strip()] if rest[1].strip() != "()" else []
            end = None if cut_after_s is None else time.monotonic() + cut_after_s
        elif word == "done":
            outcome.promised.add((int(rest[0]), int(rest[1])))
        else:
            raise RuntimeError(f"the guest said: {line.decode(errors='replace').strip()}")
        if end is not None and time.monotonic() > end:
            _pull_the_plug(guest)
            end = None


def _pull_the_plug(guest: subprocess.Popen[bytes]) -> None:
    """Kill all processes a guest is made of, at once."""
    with suppress(ProcessLookupError):
        os.killpg(guest.pid, signal.SIGKILL)


def _boot(job: Path, image: Path, command: Sequence[str]) -> tuple[subprocess.Popen[bytes], IO[bytes], int]:
    """Start a guest with the image as its disk; gives its output, and its keyboard, which must stay plugged in."""
    keys, press = os.pipe()
    out, tty = os.pipe()
    options = ["mem=512M", "rootfstype=hostfs", "rootflags=/", "rw", "quiet", f"init={vcan_run.write_init(job, command)}",
               f"uml_dir={job}", f"ubd0={image}", "con=null", "con0=null", f"ssl0=fd:{keys},fd:{tty}", "ssl1=null,null"]
    with (job / "log").open("w") as log:
        started = [vcan_run.program("setpriv") or "setpriv", "--pdeathsig", "KILL", str(vcan_run.kernel(job))]
        guest = subprocess.Popen([*started, *options],
                                 stdin=subprocess.DEVNULL, stdout=log, stderr=log, pass_fds=(keys, tty), start_new_session=True)
    os.close(keys)
    os.close(tty)
    return guest, open(out, "rb"), press
