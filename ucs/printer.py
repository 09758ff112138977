"""Lines for whoever reads them, without ever waiting for him: a stopped pager or a full pipe must not hold supervision up."""
from __future__ import annotations

import os
import sys
import threading
from collections import deque
from typing import TextIO

LINES = 1000
"""Lines that wait at most; beyond it the oldest are left out, and how many is said."""
LAST_S = 1.0
"""How long the end waits for what is still to be printed."""


class Printer:
    """A context manager with a thread that prints. `out` and `err` may be called by any thread."""

    def __init__(self, lines: int = LINES):
        self._waiting: deque[tuple[TextIO, str]] = deque()
        self._limit = lines
        self._left_out = 0
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._print, name="printer", daemon=True)
        self._thread.start()

    def __enter__(self) -> Printer:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(LAST_S)

    def out(self, text: str) -> None:
        """A line for standard output."""
        self._put(sys.stdout, text)

    def err(self, text: str) -> None:
        """A line for standard error."""
        self._put(sys.stderr, text)

    def _put(self, stream: TextIO, text: str) -> None:
        with self._changed:
            if len(self._waiting) >= self._limit:
                self._waiting.popleft()
                self._left_out += 1
            self._waiting.append((stream, text))
            self._changed.notify()

    def _print(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    return
                stream, text = self._waiting.popleft()
                left_out, self._left_out = self._left_out, 0
            if left_out:
                text = f"… {left_out} lines left out, nobody read them\n{text}"
            try:
                print(text, file=stream, flush=True)
            except OSError:
                _close(stream)
            except ValueError:  # closed at the end of the process
                return


def _close(stream: TextIO) -> None:
    """Nobody reads it any more: what follows goes nowhere, without an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
