"""What is printed while supervising: never waited for."""
from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from typing import cast

import pytest

from ucs.printer import Printer

PROGRAM = """
import sys
from ucs.printer import Printer
with Printer() as printer:
    for number in range(5000):
        printer.out("x" * 1000)
    printer.err("went on")
"""


def test_lines_come_in_order_and_to_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    with Printer() as printer:
        for number in range(100):
            printer.out(str(number))
        printer.err("error")
    captured = capsys.readouterr()
    assert captured.out.split() == [str(number) for number in range(100)] and captured.err == "error\n"


@pytest.mark.parametrize("reader", ["gone", "stopped"])
def test_a_reader_that_is_gone_or_stopped_holds_nothing_up(reader: str) -> None:
    read, write = os.pipe()
    if reader == "gone":
        os.close(read)
    with subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=write, stderr=subprocess.PIPE, text=True) as process:
        os.close(write)
        _, err = process.communicate(timeout=60)
    if reader == "stopped":
        os.close(read)
        # The thread is stuck in the pipe; the process ends all the same.
        assert process.returncode is not None
    else:
        assert process.returncode == 0 and err == "went on\n"


def test_what_nobody_read_in_time_is_counted() -> None:
    go = threading.Event()

    class Slow:
        """A stream whose first line takes until it is told to go on."""

        def __init__(self) -> None:
            self.text = ""

        def write(self, text: str) -> None:
            go.wait(60)
            self.text += text

        def flush(self) -> None:
            """Nothing is kept back."""

    stream, printer = Slow(), Printer(lines=3)
    with printer, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", cast(object, stream))
        printer.out("0")
        while printer._waiting:
            time.sleep(0.001)
        for number in range(1, 10):
            printer.out(str(number))
        go.set()
    assert stream.text.splitlines() == ["0", "… 6 lines left out, nobody read them", "7", "8", "9"]
