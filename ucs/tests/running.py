"""A whole `ucs run` in this process, with something that happens beside it."""
from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

from ucs.main import main
from ucs.standing import RunStanding, ask_run


def unit_toml(channel: str) -> str:
    """A unit with the flaming tool on a virtual bus, its pilot flame lit again."""
    return f"""
[unit]
name = "tractor-7"
[[bus]]
name = "implement"
interface = "virtual"
channel = "{channel}"
dbc = ["flaming_tool.dbc"]
[repairs]
armed = ["PilotFlameOut"]
[journal]
path = "journal.db"
"""


def beside_run(unit: Path, body: Callable[[Path], None]) -> None:
    """`ucs run` in this thread until the body, in another, is done; what the body raises is raised."""
    failed: list[BaseException] = []

    def live() -> None:
        try:
            body(unit.parent / "journal.db")
        except BaseException as error:
            failed.append(error)
        os.kill(os.getpid(), signal.SIGTERM)
    thread = threading.Thread(target=live)
    thread.start()
    assert main(["run", str(unit)]) == 0
    thread.join()
    if failed:
        raise failed[0]


def awaited(journal: Path, enough: Callable[[RunStanding], bool] = lambda _: True) -> RunStanding:
    stop = time.monotonic() + 20
    while not (isinstance(told := ask_run(journal), RunStanding) and enough(told)):
        assert time.monotonic() < stop, told
        time.sleep(0.05)
    return told
