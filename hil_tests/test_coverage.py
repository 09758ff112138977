"""The page that says what proves each line of the specification is right, and nothing is missing on it."""
from __future__ import annotations

import msgspec
import pytest

from hil_tests.coverage import MONITORING, PAGE, SPEC, Proof, catalog, lines, page, problems, proofs
from level1.catalog import Catalog

REMAKE = "make it anew by `make coverage`, look at `git diff docs/coverage.md`, and commit it"


@pytest.fixture(scope="module")
def specification() -> str:
    return SPEC.read_text("utf-8")


@pytest.fixture(scope="module")
def known() -> Catalog:
    return catalog()


@pytest.fixture(scope="module")
def found() -> list[Proof]:
    return proofs()


def test_nothing_is_missing(specification: str, known: Catalog, found: list[Proof]) -> None:
    missing = problems(specification, known, found)
    assert not missing, "\n".join(missing)


def test_the_page_is_as_it_would_be_made_now(specification: str, known: Catalog, found: list[Proof]) -> None:
    assert PAGE.read_text("utf-8") == page(specification, known, found), REMAKE


def test_every_line_of_the_specification_is_read(specification: str) -> None:
    alarms, monitoring = lines(specification)
    assert len(alarms) == 30 + 4
    assert [line.what for line in alarms[-4:]] == ["a service disruption for every device that falls silent",
                                                   "J1939 DM1 trouble codes", "CANopen EMCY", "lost heartbeat"]
    assert len(monitoring) == 7


@pytest.mark.parametrize(("change", "told"), [
    (("| vehicle | mission finished |", "| vehicle | gone astray | |\n| vehicle | mission finished |"),
     "SPEC §2, vehicle, gone astray: no alarm"),
    (("| vehicle | mission finished |", "| vehicle | mission done |"),
     "vehicle, mission finished: the specification has no such line"),
    (("lost heartbeat", "silence"), "any subsystem, lost heartbeat: the specification has no such line"),
    (("| vehicle | controller |", "| vehicle | controller / engine |"), "SPEC §3, vehicle, engine: no message")])
def test_a_specification_that_has_changed_is_told(
        specification: str, known: Catalog, found: list[Proof], change: tuple[str, str], told: str) -> None:
    assert any(line.startswith(told) for line in problems(specification.replace(*change), known, found))


def test_what_no_test_has_seen_is_told(specification: str, known: Catalog, found: list[Proof]) -> None:
    less = [proof for proof in found if proof.what != "UnitStopped"
            and not (proof.what == "NoMainFlow" and "repaired" in proof.words)
            and not proof.what.startswith(f"{MONITORING}flaming tool")]
    told = problems(specification, known, [*less, Proof("Nonsense", ("raised",), "test_x", False)])
    assert told == [
        'NoMainFlow: no test in virtual time says covers("NoMainFlow", …, "repaired")',
        'UnitStopped: no test in virtual time says covers("UnitStopped", …, "raised")',
        'UnitStopped: no test in virtual time says covers("UnitStopped", …, "cleared")',
        'flaming tool, implement: no test says covers("monitoring: flaming tool implement")',
        'flaming tool, burners: no test says covers("monitoring: flaming tool burners")',
        "test_x: covers Nonsense, which is neither an alarm nor a monitoring message"]


def test_an_alarm_that_is_gone_or_has_lost_its_repair_is_told(specification: str, known: Catalog, found: list[Proof]) -> None:
    alarms = dict(known.alarms)
    alarms["PtoNotSet"] = msgspec.structs.replace(alarms["PtoNotSet"], repair=None)
    del alarms["HitchNotMoving"]
    told = problems(specification, msgspec.structs.replace(known, alarms=alarms), found)
    assert "HitchNotMoving: no such alarm is defined" in told
    assert "PtoNotSet: no repair; give one, or say why there is none in hil_tests/coverage.py" in told
