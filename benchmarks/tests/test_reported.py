"""docs/recordings.md says what is reported of the shared recordings."""
from __future__ import annotations

import pytest

from benchmarks.page import table
from benchmarks.reported import DATA, HEAD, PAGE, PARTS, Part, rows


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the shared recordings are not at {DATA}")
@pytest.mark.parametrize("part", PARTS, ids=[part.folder for part in PARTS])
def test_the_page_says_what_is_reported(part: Part) -> None:
    told = PAGE.read_text(encoding="utf-8").partition(f"<!-- {part.name} -->\n")[2].partition(f"<!-- end of {part.name} -->")[0]
    assert told.splitlines() == table(HEAD, list(rows(part))), "run python -m benchmarks.reported --write, and judge the difference"
