"""SIGKILL of a whole `ucs run`, in the middle of repairs: what it told and sent is held against its journal.

A drill on a CAN adapter (slcan): its fan stops again and again and starts on command, its valve is stuck for good. Told is a line
on the terminal, sent a command on the bus; both come after the journal, so each must stand in it. The valve's repair has three
attempts a day: no kill may buy a fourth.
"""
from __future__ import annotations

import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from level1.event import Event
from level1.io.journal import read_events
from level1.tests.lawicel import Adapter
from ucs.render import clock, event_line
from ucs.tests.units import unit_toml

DBC = """VERSION ""
BU_: UCS DRILL
BO_ 640 DRILL_STATUS: 1 DRILL
 SG_ Fan : 0|2@1+ (1,0) [0|1] "" UCS
 SG_ Valve : 2|2@1+ (1,0) [0|1] "" UCS
BO_ 641 FAN_CMD: 1 UCS
 SG_ SetFan : 0|2@1+ (1,0) [0|1] "" DRILL
BO_ 642 VALVE_CMD: 1 UCS
 SG_ SetValve : 0|2@1+ (1,0) [0|1] "" DRILL
BO_ 1680 DRILL_ALARMS: 1 UCS
 SG_ FanStopped : 0|2@1+ (1,0) [0|3] "" DRILL
 SG_ ValveStuck : 2|2@1+ (1,0) [0|3] "" DRILL
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_ SG_ "Repair" STRING;
BA_DEF_ SG_ "RepairAttempts" INT 0 100;
BA_DEF_ SG_ "RepairWindow" INT 0 86400;
BA_DEF_ SG_ "RepairPause" INT 0 3600000;
BA_DEF_DEF_ "GenMsgCycleTime" 1000;
BA_DEF_DEF_ "AlarmCode" 0;
BA_DEF_DEF_ "AlarmWhen" "";
BA_DEF_DEF_ "Repair" "";
BA_DEF_DEF_ "RepairAttempts" 3;
BA_DEF_DEF_ "RepairWindow" 86400;
BA_DEF_DEF_ "RepairPause" 0;
BA_ "AlarmCode" SG_ 1680 FanStopped 60001;
BA_ "AlarmWhen" SG_ 1680 FanStopped "Fan == Off";
BA_ "Repair" SG_ 1680 FanStopped "send FAN_CMD(SetFan=On); expect Fan == On within 500 ms";
BA_ "RepairAttempts" SG_ 1680 FanStopped 100;
BA_ "RepairWindow" SG_ 1680 FanStopped 5;
BA_ "AlarmCode" SG_ 1680 ValveStuck 60002;
BA_ "AlarmWhen" SG_ 1680 ValveStuck "Valve == Shut";
BA_ "Repair" SG_ 1680 ValveStuck "send VALVE_CMD(SetValve=Open); expect Valve == Open within 500 ms";
BA_ "RepairPause" SG_ 1680 ValveStuck 300;
VAL_ 640 Fan 0 "Off" 1 "On";
VAL_ 641 SetFan 0 "Off" 1 "On";
VAL_ 640 Valve 0 "Shut" 1 "Open";
VAL_ 642 SetValve 0 "Shut" 1 "Open";
VAL_ 1680 FanStopped 0 "Normal" 1 "Active" 2 "Repairing" 3 "LockedOut";
VAL_ 1680 ValveStuck 0 "Normal" 1 "Active" 2 "Repairing" 3 "LockedOut";
"""
COMMANDS = {"FanStopped": "t281", "ValveStuck": "t282"}
"""Alarm -> how the line of its repair's frame begins, as the adapter gets it."""
BUDGET = 3
START_S = 60.0
EVENT = re.compile(r"\S+Z  (FanStopped|ValveStuck) .*")


class Outcome(NamedTuple):
    """What came of it. told: lines; sent: commands by alarm; problems: what is not as it has to be."""

    kills: int
    told: int
    sent: Counter[str]
    problems: list[str]


def kill(kills: int, dice: random.Random) -> Outcome:
    """Kill a unit so many times. Raises RuntimeError where it does not start."""
    told: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="kills-") as name:
        folder = Path(name)
        drill = _Drill(folder / "ttyCAN", dice)
        (folder / "drill.dbc").write_text(DBC)
        (folder / "unit.toml").write_text(unit_toml(
            "drill.dbc", armed=[*COMMANDS], interface="slcan", channel=str(folder / "ttyCAN"),
            more="options = { sleep_after_open = 0.0 }"))
        try:
            for _ in range(kills):
                told.update(line for line in _run_until_killed(folder / "unit.toml", dice.uniform(0, 1)) if EVENT.fullmatch(line))
        finally:
            drill.stop()
        events = read_events(folder / "journal.db", limit=10**6)
        boots = sorted({event.boot for event in events})
    sent = Counter(alarm for line in drill.adapter.sent for alarm, begin in COMMANDS.items() if line.startswith(begin))
    return Outcome(kills, told.total(), sent, [*_compare(told, sent, events), *_gaps(events, boots)])


def _run_until_killed(unit: Path, after_s: float) -> list[str]:
    """What it wrote on the terminal."""
    lines: list[str] = []
    with subprocess.Popen([sys.executable, "-m", "ucs", "run", str(unit)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          text=True) as process:
        assert process.stdout is not None
        watch = threading.Timer(START_S, process.kill)
        watch.start()
        try:
            for line in process.stdout:
                lines.append(line.rstrip("\n"))
                if "supervising" in line:
                    break
            else:
                raise RuntimeError("`ucs run` does not start:\n" + "\n".join(lines))
            time.sleep(after_s)
        finally:
            watch.cancel()
            process.kill()
        whole = process.stdout.read().rpartition("\n")[0]  # the last line may have been cut off
    return lines + whole.split("\n")


def _compare(told: Counter[str], sent: Counter[str], events: Iterable[Event]) -> list[str]:
    kept = Counter(event_line(event, clock(event)) for event in events)
    begun = Counter(event.alarm for event in events if event.event == "repair_started")
    problems = [f"told and not in the journal: {line}" for line in (told - kept)]
    problems += [f"{sent[alarm]} commands of {alarm} for {begun[alarm]} attempts in the journal"
                 for alarm in COMMANDS if sent[alarm] > begun[alarm]]
    if begun["ValveStuck"] > BUDGET:
        problems.append(f"{begun['ValveStuck']} attempts of a budget of {BUDGET}")
    return problems


def _gaps(events: Iterable[Event], boots: Iterable[int]) -> list[str]:
    seqs = {boot: [event.seq for event in events if event.boot == boot] for boot in boots}
    return [f"boot {boot} holds the seqs {found}" for boot, found in seqs.items() if found != [*range(1, len(found) + 1)]]


class _Drill:
    """Says how it is fifty times a second; its fan stops a moment after it was started."""

    def __init__(self, path: Path, dice: random.Random):
        self.adapter = Adapter(path)
        self._dice = dice
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        """End it."""
        self._ended.set()
        self._thread.join()
        with suppress(OSError):
            self.adapter.stop()

    def _run(self) -> None:
        heard, stops_s = 0, 0.0
        while not self._ended.wait(0.02):
            new, heard = self.adapter.sent[heard:], len(self.adapter.sent)
            if any(line.startswith(COMMANDS["FanStopped"]) for line in new):
                stops_s = time.monotonic() + self._dice.uniform(0.05, 0.2)
            self.adapter.hear(0x280, bytes([time.monotonic() < stops_s]))
