"""Every plug pulled once, several at a time: the short form of `python -m benchmarks.plugs`."""
from __future__ import annotations

import random
from pathlib import Path

from benchmarks import page
from benchmarks.plugs import PAGE, lines, pull


def test_every_plug_is_told_from_when_to_when_and_nothing_is_missing_in_the_journal(tmp_path: Path) -> None:
    outcome = pull(8, random.Random(1), tmp_path, lambda text: None, is_quick=True)
    assert outcome.problems == []
    assert len({one.socket for one in outcome.pulls}) == len(outcome.pulls) == 8
    assert outcome.not_sent > 0 and outcome.not_recorded > 0
    copy = tmp_path / PAGE.name
    copy.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    page.put("plugs: python -m benchmarks.plugs --write", lines(outcome), copy)
    assert "8 plugs pulled" in copy.read_text(encoding="utf-8")
