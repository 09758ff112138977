"""The operation page and the service files say what is there."""
from __future__ import annotations

import re
from configparser import ConfigParser
from pathlib import Path

import pytest

from level1.io.definitions import load
from ucs.main import COMMANDS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "operation.md").read_text()
SERVICES = sorted((ROOT / "examples" / "systemd").glob("*.service"))


def test_the_page_tells_what_to_do_about_each_alarm_of_the_ucs_itself() -> None:
    assert [name for name in load(["ucs.dbc"]).alarms if f"`{name}`" not in PAGE] == []


def test_the_page_names_only_commands_and_files_that_are_there() -> None:
    assert set(re.findall(r"\bucs (?=[a-z])([a-z0-9]+)", PAGE)) - set(COMMANDS) <= {"ucs"}, "beside the user of that name"
    folder = ROOT / "examples" / "systemd"
    for name in re.findall(r"[\w-]+\.(?:service|network)\b", PAGE):
        assert (folder / name).is_file() or name.startswith("systemd"), name


@pytest.mark.parametrize("file", SERVICES, ids=lambda file: file.name)
def test_a_service_is_watched_restarted_and_without_root(file: Path) -> None:
    parser = ConfigParser(interpolation=None, comment_prefixes="#")
    parser.optionxform = str  # type: ignore[assignment]
    parser.read(file)
    service = parser["Service"]
    assert (service["Type"], service["Restart"], service["User"]) == ("notify", "always", "ucs")
    assert int(service["WatchdogSec"]) >= 10
    assert service["ExecStart"].split()[1] in COMMANDS and service["ProtectSystem"] == "strict"
