"""A whole `ucs run` in this process, with something that happens beside it."""
from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import dbc
from ucs.main import main
from ucs.standing import RunStanding, ask_run
from ucs.tests.units import unit_toml

WAIT_S = 60.0


def flaming_unit(channel: str) -> str:
    """A unit with the flaming tool on a virtual bus, its pilot flame lit again."""
    return unit_toml("flaming_tool.dbc", armed=["PilotFlameOut"], interface="virtual", channel=channel)


def patient_tool(folder: Path) -> None:
    """A flaming_tool.dbc beside the unit.toml whose status is not stale at once: this process may stand still for a while, and the
    attempt of a repair would fail, as it should."""
    text = dbc.path("flaming_tool.dbc").read_text(encoding="utf-8")
    for shipped, patient in (('BA_ "GenMsgCycleTime" BO_ 528 100;', 'BA_ "GenMsgCycleTime" BO_ 528 20000;'),
                             ("silent(FLAMER_STATUS, 1 s)", "silent(FLAMER_STATUS, 60 s)")):
        assert shipped in text
        text = text.replace(shipped, patient)
    (folder / "flaming_tool.dbc").write_text(text, encoding="utf-8")


def beside_run(unit: Path, body: Callable[[Path], None]) -> None:
    """`ucs run` in this thread until the body, in another, is done; what the body raises is raised."""
    failed: list[BaseException] = []
    over = threading.Event()
    usual = signal.getsignal(signal.SIGTERM)

    def live() -> None:
        try:
            body(unit.parent / "journal.db")
        except BaseException as error:
            failed.append(error)
        while signal.getsignal(signal.SIGTERM) is usual and not over.is_set():  # it would end this process
            time.sleep(0.01)
        if not over.is_set():
            os.kill(os.getpid(), signal.SIGTERM)
    thread = threading.Thread(target=live)
    thread.start()
    try:
        code = main(["run", str(unit)])
    finally:
        over.set()
        thread.join()
    if failed:
        raise failed[0]
    assert code == 0


def awaited(journal: Path, enough: Callable[[RunStanding], bool] = lambda _: True) -> RunStanding:
    stop = time.monotonic() + WAIT_S
    while not (isinstance(told := ask_run(journal), RunStanding) and enough(told)):
        assert time.monotonic() < stop, told
        time.sleep(0.05)
    return told
