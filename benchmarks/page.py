"""docs/performance.md: each benchmark keeps its own part of the page, between two marks; the rest is written by hand."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "performance.md"


def put(part: str, lines: Sequence[str], page: Path = PAGE) -> None:
    """Replace what stands between `<!-- part -->` and `<!-- end of part -->`. Raises ValueError when the marks are not there."""
    begin, end = f"<!-- {part} -->\n", f"<!-- end of {part} -->\n"
    text = page.read_text(encoding="utf-8")
    before, mark, rest = text.partition(begin)
    _, closing, after = rest.partition(end)
    if not mark or not closing:
        raise ValueError(f"{page}: no part {part}")
    page.write_text(before + begin + "".join(line + "\n" for line in lines) + end + after, encoding="utf-8")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table in Markdown."""
    return ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]
