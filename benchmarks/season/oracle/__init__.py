"""What a fault must be reported as, what it may bring about, and what needs no fault at all: a table, from the physics alone.

Theory of operation. A *symptom* is a state of the machine that an alarm stands for, as the plants and programs of the nodes know it
(`World`), not as the bus tells it. When a fault is active and one of its symptoms has lasted for the alarm's delay and the time its
message takes, the alarm must be there. A symptom that never lasts so long makes the fault unobservable: a valve that is stuck
closed while nobody wants it open. *May* names what the fault can bring about besides, at once or up to `tail_s` after its end: a
vehicle without signs of life pauses, a repair that a second fault disturbs fails. An alarm that no active or recent fault explains
so, and that is not true without one (`NATURAL`), is a false one; what an earlier fault has left behind still explains it as long as
its symptom can be seen: a valve that did not obey stands wrong until it is told once more.

Times are on-delays of the definitions plus what the messages need: a cycle, and one of level 1's looks at silence.
"""
from __future__ import annotations

from collections.abc import Mapping

from benchmarks.season.oracle import airblast_sprayer, computer, flaming_tool, sprayer_boom, vehicle
from benchmarks.season.oracle.table import Row, State

PARTS = (flaming_tool, sprayer_boom, vehicle, airblast_sprayer, computer)
TABLE: Mapping[str, Mapping[str, Row]] = {program: rows for part in PARTS for program, rows in part.ROWS.items()}
"""Program -> fault, as `device action` -> what is known of it."""

NATURAL: Mapping[str, State] = {alarm: state for part in PARTS for alarm, state in part.NATURAL.items()}
"""Alarm -> whether it is true now without any fault: wind, what was used up, what was ordered. Limits are those at which it is
raised, and what sloshes (1 L either way and half a second old, or 0.4 %) or is rounded. A difference between
meter and level is what an earlier leak has left."""

LINGERS: Mapping[str, State] = {alarm: state for part in PARTS for alarm, state in part.LINGERS.items()}
"""Alarm -> whether, once raised, it may stand at the end of the day: it clears at another limit (AlarmUntil) than it is raised
at, and only when its sensor has been beyond that for a while, although the tank sloshes (1 L, or 0.4 %, either way)."""
