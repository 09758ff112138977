"""The definitions that ship with the UCS: DBC files of the unit and its implements. `README.md` here teaches their language."""
from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
"""Where the shipped files are."""


def path(name: str) -> Path:
    """A shipped file by its name. Raises FileNotFoundError, naming what there is."""
    file = FOLDER / name
    if Path(name).name != name or not file.is_file():
        raise FileNotFoundError(f"{name} is not among the shipped definitions: {', '.join(shipped()) or 'none'}")
    return file


def shipped() -> tuple[str, ...]:
    """Names of all shipped DBC files."""
    return tuple(sorted(file.name for file in FOLDER.glob("*.dbc")))
