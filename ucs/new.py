"""`ucs new`: a DBC file to start from, with the attribute definitions of the alarm language, so that a DBC editor offers them."""
from __future__ import annotations

from argparse import ArgumentParser, Namespace
from importlib import resources
from pathlib import Path
from typing import Any

from level1.io.error import OutsideError


def add_parser(commands: Any) -> None:
    """The arguments."""
    parser: ArgumentParser = commands.add_parser(
        "new", help="write a DBC file to start your own alarms from",
        description="Write a small DBC file with three alarms and all attribute definitions of the alarm language: open it in any "
                    "DBC editor, put your messages in place of the example, and run `ucs check` on it.",
        epilog="Example: ucs new my_sprayer.dbc && ucs check my_sprayer.dbc")
    parser.add_argument("file", metavar="NAME.dbc", help="the file to write; an existing one is left alone")


def run(args: Namespace) -> int:
    """Write the file. Raises OutsideError when it can't."""
    path = Path(args.file)
    if path.suffix.lower() != ".dbc":
        raise OutsideError(f"{path}: the name of a DBC file ends in .dbc")
    text = resources.files("ucs").joinpath("start.dbc").read_text(encoding="utf-8")
    try:
        with path.open("x", encoding="utf-8", newline="\r\n") as file:
            file.write(text)
    except FileExistsError as error:
        raise OutsideError(f"{path}: is there already; choose another name") from error
    except OSError:
        if path.is_file():
            path.unlink()  # a part of it would stand in the way of another try
        raise
    print(f"{path}: three alarms to start from; next: ucs check {path}")
    return 0
