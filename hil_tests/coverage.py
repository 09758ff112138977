"""The page docs/coverage.md: each line of the specification, the alarm that tells it, its repair, and the tests that prove it.

`python -m hil_tests.coverage` (or `make coverage`) writes it anew, from the specification (docs/SPEC.md), the shipped definitions
and the tests. A test says what it proves by a mark: `covers("HitchNotMoving", "raised", "repaired", "cleared")`, or
`covers("monitoring: vehicle motion")`. A line without an alarm, an alarm without a repair nor a reason for none, and a word of
an alarm's life that no test in virtual time has seen, are problems: they fail `hil_tests/test_coverage.py`, as an old page does.

As a plugin of pytest (`-p hil_tests.coverage`) it writes the marks of the tests that were collected where `OUT` says.
"""
from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import pytest

import dbc
from level1.catalog import Alarm, Catalog, Message
from level1.io import definitions
from ucs.words import abbreviated

ROOT = Path(__file__).parents[1]
SPEC, PAGE = ROOT / "docs" / "SPEC.md", ROOT / "docs" / "coverage.md"
OUT = "UCS_COVERAGE_OUT"
MARK = "covers"
MONITORING = "monitoring: "
LIFE = ("raised", "cleared")
REPAIRED = ("repair_started", "repaired", "locked_out")
DOZEN = 12
SECTIONS = [f"Section{n}NotSet" for n in range(1, 13)]
SENSORS = [f"Ultrasonic{n}NotWorking" for n in range(1, 9)]

ALARMS: Mapping[tuple[str, str], Sequence[str]] = {
    ("UCS", "critical mainboard temperature"): ["MainboardTemperatureCritical"],
    ("UCS", "critical CPU temperature"): ["CpuTemperatureCritical"],
    ("UCS", "critical RAM/storage level"): ["RamCritical", "StorageCritical", "StorageWriteFailed"],
    ("UCS", "application traffic logging error"): ["TrafficLogFailed"],
    ("UCS", "communication synchronisation error (GPS time)"): ["TimeSyncLost"],
    ("vehicle", "mission aborted: unit not moving"): ["UnitNotMoving"],
    ("vehicle", "mission aborted: unit stopped"): ["UnitStopped"],
    ("vehicle", "mission finished"): ["MissionFinished"],
    ("vehicle", "three-point hitch (TPH) not moving"): ["HitchNotMoving"],
    ("vehicle", "error in set/unset PTO"): ["PtoNotSet", "PtoNotUnset"],
    ("vehicle", "set/unset implement error"): ["ImplementSetUnsetFailure"],
    ("sprayer boom", "main tank volume critical"): ["MainTankCritical"],
    ("sprayer boom", "DIS tank volume critical"): ["DisTankCritical"],
    ("sprayer boom", "impossible to adjust main flow"): ["MainFlowNotAdjusted"],
    ("sprayer boom", "herbicide line blocked"): ["HerbicideLineBlocked"],
    ("sprayer boom", "boom is opening or closing"): ["BoomMoving"],
    ("sprayer boom", "impossible to adjust boom opening"): ["BoomOpeningNotAdjusted"],
    ("sprayer boom", "start/stop failure"): ["SprayingStartStopFailure"],
    ("sprayer boom", "change nozzles failure"): ["ChangeNozzlesFailure", *SECTIONS, "SectionStaysOpen"],
    ("sprayer boom", "open/close boom failure"): ["OpenCloseBoomFailure"],
    ("sprayer boom", "set main flow failure"): ["SetMainFlowFailure"],
    ("sprayer boom", "set DIS flow failure"): ["SetDisFlowFailure"],
    ("flaming tool", "bottle empty"): ["BottleEmpty"],
    ("flaming tool", "start/stop failure"): ["FlamingStartStopFailure"],
    ("flaming tool", "change burners failure"): ["ChangeBurnersFailure"],
    ("flaming tool", "pilot flame out (text of §2.4)"): ["PilotFlameOut", "PilotIgnitionFailure", "PilotFlameTooOften"],
    ("air-blast sprayer", "no flow in main line"): ["NoMainFlow"],
    ("air-blast sprayer", "tank level critical"): ["AirblastTankCritical"],
    ("air-blast sprayer", "ultrasonic (US) sensor not working"): [*SENSORS, "UltrasonicFrozen"],
    ("air-blast sprayer", "start/stop failure"): ["AirblastStartStopFailure"],
    ("any device", "a service disruption for every device that falls silent"): [
        "VehicleSilent", "SprayerSilent", "FlamerSilent", "AirblastSilent", "UltrasonicSilent", "HealthNotMeasured"],
    ("any subsystem", "J1939 DM1 trouble codes"): ["TroubleCode"],
    ("any subsystem", "CANopen EMCY"): ["DeviceEmergency"],
    ("any subsystem", "lost heartbeat"): ["DeviceSilent", "AirblastHeartbeatLost", "UltrasonicHeartbeatLost"],
}
"""Producer and alarm, as the specification writes them, and the alarms that tell it. The last four: its sentence "Besides"."""
MESSAGES: Mapping[tuple[str, str], str] = {
    ("vehicle", "controller"): "vehicle.dbc", ("vehicle", "motion"): "vehicle.dbc",
    ("flaming tool", "implement"): "flaming_tool.dbc", ("flaming tool", "burners"): "flaming_tool.dbc",
    ("sprayer boom", "implement"): "sprayer_boom.dbc", ("sprayer boom", "nozzles"): "sprayer_boom.dbc",
    ("air-blast sprayer", "implement"): "airblast_sprayer.dbc"}
"""Producer and monitoring message, and the file in which messages form it (`MonitorAs`)."""
NOT_REPAIRED = {
    "MainboardTemperatureCritical": "it has to cool down", "CpuTemperatureCritical": "it has to cool down",
    "RamCritical": "which program may be ended is not for level 1 to say",
    "StorageCritical": "the recorder deletes its oldest files by itself; the rest belongs to somebody",
    "StorageWriteFailed": "the journal tries again by itself; alarms leave by radio meanwhile",
    "UnitNotMoving": "nothing may move before someone has looked why", "UnitStopped": "whoever stopped it lets it go again",
    "MissionFinished": "no fault", "BoomMoving": "no fault",
    "MainTankCritical": "only filling helps", "DisTankCritical": "only filling helps",
    "ChangeNozzlesFailure": "the failing sections are repaired, each for itself",
    "BottleEmpty": "only another bottle helps", "PilotFlameTooOften": "counts what PilotFlameOut has repaired",
    "AirblastTankCritical": "only filling helps",
    "VehicleSilent": "it brakes by itself without commands, and can not be reached",
    "SprayerSilent": "it closes by itself without commands, and can not be reached",
    "FlamerSilent": "it closes by itself without commands, and can not be reached",
    "AirblastSilent": "it closes by itself without commands, and can not be reached",
    "UltrasonicSilent": "it can not be reached; nozzles close without it",
    "HealthNotMeasured": "a task that hangs takes no orders",
    "TroubleCode": "what helps depends on the code", "DeviceEmergency": "what helps depends on the error code",
    "DeviceSilent": "it can not be reached", "AirblastHeartbeatLost": "it works on",
    "UltrasonicHeartbeatLost": "it works on"}
"""Why an alarm has no local repair."""


class Line(NamedTuple):
    """A row of the specification: who produces it, and what."""

    producer: str
    what: str


class Proof(NamedTuple):
    """What a test says that it proves. words: of an alarm's life; vcan: on a real bus, by programs that run as processes."""

    what: str
    words: tuple[str, ...]
    test: str
    vcan: bool


def pytest_collection_finish(session: pytest.Session) -> None:
    """Write down what the tests say that they prove."""
    if out := os.environ.get(OUT):
        Path(out).write_text(json.dumps([
            (mark.args[0], mark.args[1:], item.nodeid, item.get_closest_marker("vcan") is not None)
            for item in session.items for mark in item.iter_markers(MARK)]))


def proofs() -> list[Proof]:
    """What the tests of this project prove, by collecting those files that say so. Raises RuntimeError when that fails."""
    files = [str(file) for file in sorted(ROOT.glob("*/tests/test_*.py")) + sorted(ROOT.glob("hil_tests/test_*.py"))
             if re.search(r"\bproves\(|mark\.covers\(", file.read_text("utf-8"))]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "proofs"
        command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "hil_tests.coverage", *files]
        env = {**os.environ, OUT: str(out), "PYTHONPATH": os.pathsep.join((str(ROOT), *sys.path[1:]))}
        run = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
        if run.returncode:
            raise RuntimeError(f"the tests can not be collected:\n{run.stdout}{run.stderr}")
        return [Proof(what, tuple(words), test, vcan) for what, words, test, vcan in json.loads(out.read_text())]


def lines(specification: str) -> tuple[list[Line], list[Line]]:
    """The alarms and the monitoring messages that the specification names."""
    alarms, monitoring = (specification.partition(f"## {n}.")[2].partition("\n## ")[0] for n in (2, 3))
    besides = " ".join(alarms.partition("Besides:")[2].split())
    told = [Line(producer, what) for producer, what in ALARMS if producer.startswith("any ") and what in besides]
    return ([*_rows(alarms), *told],
            [Line(producer, name) for producer, names in _rows(monitoring) for name in names.split(" / ")])


def _rows(text: str) -> Iterator[Line]:
    """The rows of a table, without its head."""
    for row in text.splitlines():
        cells = [cell.strip() for cell in row.split("|")[1:-1]]
        if len(cells) > 1 and cells[0] != "producer" and not cells[0].startswith("---"):
            yield Line(cells[0], cells[1])


def catalog() -> Catalog:
    """All shipped definitions."""
    return definitions.load(sorted(dbc.path("ucs.dbc").parent.glob("*.dbc")))


def problems(specification: str, known: Catalog, found: Sequence[Proof]) -> list[str]:
    """What is missing, a line each: what, and what to do."""
    alarms, monitoring = lines(specification)
    result = [f"SPEC §2, {line.producer}, {line.what}: no alarm; name it in hil_tests/coverage.py"
              for line in alarms if line not in ALARMS]
    result += [f"{producer}, {what}: the specification has no such line" for producer, what in ALARMS
               if Line(producer, what) not in alarms]
    result += [f"SPEC §3, {line.producer}, {line.what}: no message; name it in hil_tests/coverage.py"
               for line in monitoring if line not in MESSAGES]
    result += [f"{producer}, {what}: the specification has no such message" for producer, what in MESSAGES
               if Line(producer, what) not in monitoring]
    for name in dict.fromkeys(name for names in ALARMS.values() for name in names):
        result += _missing(name, known.alarms.get(name))
    for alarm in known.alarms.values():
        result += _unseen(alarm, found)
    for (producer, name), file in MESSAGES.items():
        if not _parts(name, file):
            result.append(f"{file}: no message with MonitorAs {name}")
        if not any(proof.what == f"{MONITORING}{producer} {name}" for proof in found):
            result.append(f'{producer}, {name}: no test says covers("{MONITORING}{producer} {name}")')
    names = {*known.alarms, *(f"{MONITORING}{producer} {name}" for producer, name in MESSAGES)}
    result += [f"{proof.test}: covers {proof.what}, which is neither an alarm nor a monitoring message" for proof in found
               if proof.what not in names]
    if (count := len(_on_the_wire(found))) < DOZEN:
        result.append(f"only {count} alarms are proved on vcan, not {DOZEN}")
    return result


def _missing(name: str, alarm: Alarm | None) -> Iterator[str]:
    if alarm is None:
        yield f"{name}: no such alarm is defined"
        return
    if not alarm.repair and name not in NOT_REPAIRED:
        yield f"{name}: no repair; give one, or say why there is none in hil_tests/coverage.py"
    if alarm.repair and name in NOT_REPAIRED:
        yield f"{name}: has a repair now; take it out of NOT_REPAIRED in hil_tests/coverage.py"


def _unseen(alarm: Alarm, found: Iterable[Proof]) -> Iterator[str]:
    seen = {word for proof in found if proof.what == alarm.name and not proof.vcan for word in proof.words}
    for word in (*LIFE, *(REPAIRED if alarm.repair else ())):
        if word not in seen:
            yield f'{alarm.name}: no test in virtual time says covers("{alarm.name}", …, "{word}")'


def _on_the_wire(found: Iterable[Proof]) -> set[str]:
    return {proof.what for proof in found if proof.vcan and not proof.what.startswith(MONITORING)}


# --- the page -----------------------------------------------------------------------------------------------------------------

HEAD = """# What proves each line of the specification

Made by `make coverage` from [the specification](SPEC.md), the definitions in [dbc/](../dbc) and the marks of the tests; do not edit
it. `hil_tests/test_coverage.py` fails when it is not as it would be made now, when a line has no alarm or message, or its alarm
neither a repair nor a reason for none, or when no test in virtual time has seen an alarm raised and cleared, and a repair succeed,
be verified, and give up.

Each test injects the fault into the simulated device. *Virtual time*: level 1 and the devices on a simulated bus, in one
process. *vcan*: device, `ucs run` and where needed level 2 as processes of their own on real SocketCAN. The numbers are
those of tests; which, is listed below the tables.
"""

OTHERS = """
## Alarms beyond the specification

What every alarm must do whatever its condition is (delays, lost data, flapping) is tested for each of them, these and those
above, by `level1/tests/test_every_alarm.py`. Tests in virtual time have seen as much of each of these as of those above.
"""


def page(specification: str, known: Catalog, found: Sequence[Proof]) -> str:
    """The page, in Markdown."""
    alarms, monitoring = lines(specification)
    told = [name for line in alarms for name in ALARMS.get(line, ())]
    others = sorted((alarm.code, name) for name, alarm in known.alarms.items() if name not in told)
    wire = sorted(_on_the_wire(found))
    parts = [HEAD, f"## Alarms ({len(told)} for {len(alarms)} lines of SPEC §2)\n", *_alarm_table(alarms, known, found),
             "\n## Monitoring messages (SPEC §3)\n", *_message_table(monitoring, found),
             OTHERS, *_other_table(others, known, found),
             f"\n## On vcan\n\n{len(wire)} alarms are proved there: {', '.join(wire)}.", "\n## The tests\n", *_tests(found)]
    return "\n".join(parts) + "\n"


def _alarm_table(alarms: Sequence[Line], known: Catalog, found: Sequence[Proof]) -> Iterator[str]:
    yield ("| producer | line | alarm | code | priority | definition | repair, with what proves it; its budget; its end "
           "| virtual time | vcan |")
    yield "|---|---|---|---|---|---|---|---|---|"
    for line in alarms:
        head = f"{line.producer} | {line.what}"
        for family in _families(ALARMS.get(line, ()), known):
            yield f"| {head} | {' | '.join(_alarm_cells(family, known, found))} |"
            head = " | "


def _alarm_cells(family: Sequence[str], known: Catalog, found: Sequence[Proof]) -> Iterator[str]:
    first, last = known.alarms[family[0]], known.alarms[family[-1]]
    yield first.name if len(family) == 1 else f"{first.name} … {last.name}"
    yield str(first.code) if len(family) == 1 else f"{first.code}–{last.code}"
    yield first.priority
    yield f"`{Path(first.file).name}` {first.message}.{first.signal}"
    yield _repair(first)
    yield from _counts(family, found)


def _repair(alarm: Alarm) -> str:
    """What is tried, what proves it, what follows when it is given up; or why nothing is tried."""
    repair = alarm.repair
    if repair is None:
        return f"none: {NOT_REPAIRED.get(alarm.name, '')}"
    failed = "" if repair.counts_good else "failed "
    tries = f"{repair.attempts} {failed}attempt{'s' * (repair.attempts != 1)} in {abbreviated(repair.window_ns)}"
    end = f"`{_cell(repair.give_up_text)}`" if repair.give_up_text else "locked out"
    return f"`{_cell(repair.text)}`; {tries}; then {end}"


def _message_table(monitoring: Sequence[Line], found: Sequence[Proof]) -> Iterator[str]:
    yield "| producer | message | definition | signals | virtual time | vcan |"
    yield "|---|---|---|---|---|---|"
    for line in monitoring:
        file = MESSAGES.get(line, "")
        parts = _parts(line.what, file)
        signals = ", ".join(signal.name for message in parts for signal in message.signals if signal.role == "None")
        yield (f"| {line.producer} | {line.what} | `{file}` {', '.join(message.name for message in parts)} | {signals} | "
               f"{' | '.join(_counts([f'{MONITORING}{line.producer} {line.what}'], found))} |")


def _other_table(others: Sequence[tuple[int, str]], known: Catalog, found: Sequence[Proof]) -> Iterator[str]:
    yield "| alarm | code | priority | definition | virtual time | vcan |"
    yield "|---|---|---|---|---|---|"
    for code, name in others:
        alarm = known.alarms[name]
        yield (f"| {name} | {code} | {alarm.priority} | `{Path(alarm.file).name}` {alarm.message} | "
               f"{' | '.join(count or '–' for count in _counts([name], found))} |")


def _tests(found: Sequence[Proof]) -> Iterator[str]:
    for what in sorted({proof.what for proof in found}, key=lambda what: (what.startswith(MONITORING), _natural(what))):
        yield f"### {what}\n"
        for proof in dict.fromkeys(proof for proof in found if proof.what == what):
            words = ", ".join(word.replace("_", " ") for word in proof.words)
            yield f"- {'vcan: ' if proof.vcan else ''}`{proof.test}`{f' ({words})' if words else ''}"
        yield ""


def _counts(names: Sequence[str], found: Sequence[Proof]) -> list[str]:
    """How many tests prove them, in virtual time and on vcan."""
    return [str(len({proof.test for proof in found if proof.what in names and proof.vcan == vcan}) or "") for vcan in (False, True)]


@cache
def _parts(name: str, file: str) -> list[Message]:
    """The messages of a file that form a monitoring message."""
    messages = definitions.load([file]).messages.values() if file else ()
    return [message for message in messages if message.monitor_as == name]


def _families(names: Sequence[str], known: Catalog) -> Iterator[list[str]]:
    """Alarms that differ only by a number stand together."""
    for _, family in groupby((name for name in names if name in known.alarms), key=lambda name: re.sub(r"\d+", "", name)):
        yield list(family)


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def _cell(text: str) -> str:
    return text.replace("|", r"\|")


def main() -> int:
    """Write the page; 1 when something is missing."""
    specification, known, found = SPEC.read_text("utf-8"), catalog(), proofs()
    PAGE.write_text(page(specification, known, found), "utf-8")
    missing = problems(specification, known, found)
    print("\n".join([*missing, f"{PAGE.relative_to(ROOT)}: {len(found)} proofs, {len(missing)} problems"]))
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
