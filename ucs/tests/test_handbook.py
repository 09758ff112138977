"""The handbook says in words what the definitions say in the alarm language."""
from __future__ import annotations

from decimal import Decimal
from html.parser import HTMLParser
from pathlib import Path

import pytest

from level1.expression import And, Arithmetic, Compare, Count, Elapsed, Function, Not, Number, Or, Quality, SignalValue, Silent
from level1.io.definitions import load
from ucs import main
from ucs.handbook import html, markdown
from ucs.words import Words, abbreviated, duration, spaced

CATALOG = load(["flaming_tool.dbc", "isobus_tractor.dbc", "ucs.dbc"])


class Balance(HTMLParser):
    """Counts tags that are left open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in ("meta", "li", "td", "th", "tr", "path", "line", "rect"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self.open and self.open[-1] == tag:
            self.open.pop()


def test_every_alarm_has_its_page_and_nothing_is_fetched_from_outside() -> None:
    page = html(CATALOG)
    for alarm in CATALOG.alarms.values():
        assert f'id="a{alarm.code}"' in page
    assert "http" not in page and "src=" not in page
    balance = Balance()
    balance.feed(page)
    assert balance.open == []


def test_the_pilot_flame_in_words() -> None:
    page = markdown(CATALOG)
    assert "the pilot flame is Off, for 300 milliseconds without a break" in page
    assert "2. Wait 30 seconds." in page and "Check that the pilot flame is On, within 3 seconds." in page


def test_conditions_in_words() -> None:
    words = Words(CATALOG)
    oil = SignalValue("EFL_P1", "EngineOilPressure")
    low = Compare("<", oil, Number(Decimal(100)))
    assert words.condition(low) == "the engine oil pressure is below 100 kPa"
    assert words.condition(Not(low)) == "the engine oil pressure is at least 100 kPa"
    assert words.condition(Compare(">", Number(Decimal(100)), oil)) == words.condition(low)
    assert words.condition(Silent("EEC1", 3_000_000_000)) == "EEC1 has not been received for 3 seconds"
    assert words.condition(Quality("error", "EFL_P1", "EngineOilPressure")) == "the engine oil pressure reports an error"
    held = Elapsed("held", "EFL_P1", "EngineOilPressure", ">=", 60_000_000_000)
    assert words.condition(held) == "the engine oil pressure has not changed for at least 1 minute"
    often = Compare(">=", Count("PilotFlameOut", 600_000_000_000), Number(Decimal(3)))
    assert words.condition(often) == "the alarm PilotFlameOut was raised at least 3 times within 10 minutes"
    assert words.condition(And((low, Or((often, held))))) == \
        f"{words.condition(low)} and ({words.condition(often)} or {words.condition(held)})"
    apart = Compare(">", Function("abs", (Arithmetic("-", oil, oil),)), Number(Decimal(5)))
    assert words.condition(apart).endswith("is above 5")


def test_words_for_names_and_durations() -> None:
    assert [spaced(name) for name in ("EngineOilPressure", "RearPtoSpeed", "EngineEcuSilent", "Burner4")] == \
        ["engine oil pressure", "rear PTO speed", "engine ECU silent", "burner 4"]
    assert [duration(ns) for ns in (300_000_000, 1_000_000_000, 900_000_000_000, 1_500_000_000)] == \
        ["300 milliseconds", "1 second", "15 minutes", "1.5 seconds"]
    assert [abbreviated(ns) for ns in (300_000_000, 120_000_000_000)] == ["300 ms", "2 min"]


def test_the_command_writes_it_and_refuses_other_endings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "handbook.html"
    assert main.main(["alarms", "flaming_tool.dbc", "--handbook", str(out)]) == 0
    assert "Pilot flame out" in out.read_text() and "handbook of" in capsys.readouterr().out
    assert main.main(["alarms", "flaming_tool.dbc", "--handbook", str(tmp_path / "x.pdf")]) == 2
    assert main.main(["alarms", "flaming_tool.dbc", "--handbook", str(tmp_path / "no" / "x.md")]) == 2
