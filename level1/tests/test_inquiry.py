"""The desk: one question, one answer, and nobody who asks can hold it up."""
from __future__ import annotations

import os
import socket
import stat
import time
from pathlib import Path

import pytest

from level1.io.inquiry import Desk, Silence, ask

LONG = "a/" * 60
"""A folder whose path is longer than that of a socket may be."""


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    folder = tmp_path / LONG
    folder.mkdir(parents=True)
    return folder / "journal.db"


def test_each_question_gets_a_new_answer(journal: Path) -> None:
    answers = iter([b"first", b"second" * 100_000])
    with Desk(journal, "run", lambda: next(answers)):
        assert [ask(journal, "run"), ask(journal, "run")] == [b"first", b"second" * 100_000]
    assert ask(journal, "run") is Silence.ABSENT
    assert not list(journal.parent.iterdir())


def test_whose_folder_is_missing_is_absent(tmp_path: Path) -> None:
    assert ask(tmp_path / "nowhere" / "journal.db", "run") is Silence.ABSENT


def test_a_socket_that_a_killed_process_left_is_absent_and_is_taken_over(journal: Path) -> None:
    with Desk(journal, "run", lambda: b"old"):
        left = next(journal.parent.iterdir())
        os.link(left, left.with_name("kept"))
    left.with_name("kept").rename(left)
    assert ask(journal, "run") is Silence.ABSENT
    with Desk(journal, "run", lambda: b"new"):
        assert ask(journal, "run") == b"new"


def test_who_listens_and_never_answers_is_mute(journal: Path) -> None:
    folder = os.open(journal.parent, os.O_RDONLY)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"/proc/self/fd/{folder}/journal.db.run.ask")
        listening.listen()
        began = time.monotonic()
        assert ask(journal, "run", patience_s=0.05) is Silence.MUTE
        assert time.monotonic() - began < 5
    os.close(folder)


def test_run_and_bridge_have_a_desk_each_that_everybody_may_ask(journal: Path) -> None:
    with Desk(journal, "run", lambda: b"r"), Desk(journal, "bridge", lambda: b"b"):
        assert (ask(journal, "run"), ask(journal, "bridge")) == (b"r", b"b")
        assert {stat.S_IMODE(file.stat().st_mode) for file in journal.parent.iterdir()} == {0o666}


def test_who_asks_and_does_not_read_does_not_stop_the_others(journal: Path) -> None:
    with Desk(journal, "run", lambda: b"x" * 4_000_000):
        folder = os.open(journal.parent, os.O_RDONLY)
        with socket.socket(socket.AF_UNIX) as rude:
            rude.connect(f"/proc/self/fd/{folder}/journal.db.run.ask")
            answer = ask(journal, "run", patience_s=10)
        os.close(folder)
        assert isinstance(answer, bytes) and len(answer) == 4_000_000
