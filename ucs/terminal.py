"""The terminal as a screen: drawn in place, keys one by one, and left as it was, however the program ends."""
from __future__ import annotations

import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, TextIO

from rich.cells import cell_len, set_cell_size

Span = tuple[str, str]
"""A piece of a line and its colour (SGR code, "" for none)."""
Line = Sequence[Span]

ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[0m\x1b[?25h\x1b[?1049l"
BEGIN, END = "\x1b[?2026h\x1b[H", "\x1b[J\x1b[?2026l"
"""Drawn at once by terminals that can (synchronized output); others ignore it."""
KEYS = {
    "\x1b[A": "up", "\x1bOA": "up", "\x1b[B": "down", "\x1bOB": "down", "\x1b[5~": "page up", "\x1b[6~": "page down",
    "\x1b[H": "home", "\x1bOH": "home", "\x1b[F": "end", "\x1bOF": "end", "\x1b[Z": "back tab", "\t": "tab", "\r": "enter",
    "\n": "enter", "\x7f": "backspace", "\x08": "backspace", "\x1b": "escape",
}


class Terminal:
    """A screen on `out` with the keys of `keys`, inside `shown`. ended: a signal asked for the end."""

    def __init__(self, out: TextIO, keys: TextIO, colour: bool):
        self.ended = False
        self._out, self._keys, self._colour = out, keys, colour
        self._saved: Any = None

    @contextmanager
    def shown(self) -> Iterator[None]:
        """The screen is ours. Ctrl-C and SIGTERM set `ended`; Ctrl-Z gives the screen back until the program goes on."""
        handlers = {number: signal.signal(number, self._end) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._suspend)
        self._enter()
        try:
            yield
        finally:
            self._leave()
            for number, handler in handlers.items():
                signal.signal(number, handler)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines."""
        try:
            return tuple(os.get_terminal_size(self._out.fileno()))  # type: ignore[return-value]
        except OSError:
            return 80, 24

    def draw(self, lines: Sequence[Line]) -> None:
        """Show lines, as many as fit."""
        columns, rows = self.size
        drawn = [painted(line, columns, self._colour) + "\x1b[K" for line in lines[:rows]]
        self._write(BEGIN + "\r\n".join(drawn) + END)

    def wait(self, timeout_s: float) -> list[str]:
        """The keys pressed, after at most so long."""
        if self._saved is None:
            select.select([], [], [], timeout_s)
            return []
        if not select.select([self._keys], [], [], timeout_s)[0]:
            return []
        return list(keys_of(os.read(self._keys.fileno(), 1024).decode(errors="ignore")))

    def _enter(self) -> None:
        if self._keys.isatty():
            self._saved = termios.tcgetattr(self._keys)
            tty.setcbreak(self._keys)
        self._write(ENTER)

    def _leave(self) -> None:
        if self._saved is not None:
            termios.tcsetattr(self._keys, termios.TCSADRAIN, self._saved)
        self._write(LEAVE)

    def _end(self, number: int, frame: FrameType | None) -> None:
        self.ended = True

    def _suspend(self, number: int, frame: FrameType | None) -> None:
        self._leave()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._suspend)
        self._enter()

    def _write(self, text: str) -> None:
        try:
            self._out.write(text)
            self._out.flush()
        except OSError:
            self.ended = True


def keys_of(text: str) -> Iterator[str]:
    """The keys in what a terminal sent: a letter, or a name of `KEYS`; unknown sequences are left out."""
    while text:
        found = next((code for code in sorted(KEYS, key=len, reverse=True) if text.startswith(code)), "")
        if found == "\x1b" and text[1:2] in ("[", "O"):
            rest = text[2:].lstrip("0123456789;")
            text = rest[1:]
            continue
        if found:
            yield KEYS[found]
        elif text[0].isprintable():
            yield text[0]
        text = text[len(found) or 1:]


def plain(line: Line) -> str:
    """A line as text, for what is no terminal."""
    return "".join(harmless(text) for text, _ in line).rstrip()


def painted(line: Line, columns: int, colour: bool) -> str:
    """A line in at most so many columns."""
    found, left = "", columns
    for text, code in line:
        text = harmless(text)
        if (wide := cell_len(text)) > left:
            text, wide = set_cell_size(text, left), left
        left -= wide
        found += f"\x1b[{code}m{text}\x1b[0m" if colour and code and text else text
    return found


def harmless(text: str) -> str:
    """The text without what would steer the terminal: names and texts come from files."""
    return text if text.isprintable() else "".join(letter if letter.isprintable() else "·" for letter in text)


def out_is_terminal() -> bool:
    """Whether there is a screen to draw on."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"
