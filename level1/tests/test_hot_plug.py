"""Implements that come and go while the supervision runs: one configuration, absent on purpose is no fault, lost is one."""
from __future__ import annotations

from collections.abc import Sequence

import pytest

from level1.catalog import Catalog
from level1.command import Order
from level1.decode import encode
from level1.definitions import Source, build
from level1.event import Event, Output, Result
from level1.frame import Frame, frame_key
from level1.memory import State
from level1.supervisor import Supervisor

MS, S = 1_000_000, 1_000_000_000
PRESENT = "never({0}Coupled) or {0}Coupled == Yes or not silent({1}_STATUS, 1 s)"
"""An implement is there unless someone has said that it is not, and it has fallen silent."""


def implement(name: str, base: int, code: int) -> Source:
    """The DBC file of an implement with a hopper: its presence is said by orders."""
    upper = name.upper()
    there = PRESENT.format(name, upper)
    return Source(f"{name.lower()}.dbc", f"""VERSION ""
NS_ :
BS_:
BU_: UCS {upper}
BO_ {base} {upper}_STATUS: 1 {upper}
 SG_ {name}Level : 0|8@1+ (0.5,0) [0|100] "%" UCS
BO_ {base + 1} {upper}_COUPLING: 1 UCS
 SG_ {name}Coupled : 0|2@1+ (1,0) [0|1] "" {upper}
BO_ {base + 2} {upper}_ALARMS: 1 UCS
 SG_ {name}Empty : 0|2@1+ (1,0) [0|3] "" {upper}
 SG_ {name}Silent : 2|2@1+ (1,0) [0|3] "" {upper}
 SG_ {name}NotExpected : 4|2@1+ (1,0) [0|3] "" {upper}
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "Commands" STRING;
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_ SG_ "AlarmEnabledWhen" STRING;
BA_DEF_ SG_ "AlarmOnDelay" INT 0 3600000;
BA_ "GenMsgCycleTime" BO_ {base} 100;
BA_ "GenMsgCycleTime" BO_ {base + 2} 1000;
BA_ "Commands" BO_ {base + 1} "couple_{name.lower()}: {name}Coupled=Yes; uncouple_{name.lower()}: {name}Coupled=No";
BA_ "AlarmCode" SG_ {base + 2} {name}Empty {code};
BA_ "AlarmWhen" SG_ {base + 2} {name}Empty "{name}Level < 5";
BA_ "AlarmEnabledWhen" SG_ {base + 2} {name}Empty "{there}";
BA_ "AlarmCode" SG_ {base + 2} {name}Silent {code + 1};
BA_ "AlarmWhen" SG_ {base + 2} {name}Silent "silent({upper}_STATUS, 1 s)";
BA_ "AlarmEnabledWhen" SG_ {base + 2} {name}Silent "{there}";
BA_ "AlarmOnDelay" SG_ {base + 2} {name}Silent 3000;
BA_ "AlarmCode" SG_ {base + 2} {name}NotExpected {code + 2};
BA_ "AlarmWhen" SG_ {base + 2} {name}NotExpected "{name}Coupled == No and not silent({upper}_STATUS, 1 s)";
BA_ "AlarmOnDelay" SG_ {base + 2} {name}NotExpected 60000;
VAL_ {base + 1} {name}Coupled 0 "No" 1 "Yes" ;
""")


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    found, problems = build([implement("Drill", 1280, 3901), implement("Mower", 1296, 3911)])
    assert found is not None and not problems, "\n".join(map(str, problems))
    return found


class Yard:
    """A tractor with its implements. `coupled`: those that talk, with their level in percent."""

    def __init__(self, catalog: Catalog, restored: State | None = None):
        self.catalog = catalog
        self.supervisor = Supervisor(catalog, unit="a", start_ns=0, restored=restored)
        self.coupled: dict[str, float] = {}
        self.now_ns = 0
        self.told: list[tuple[float, str, str]] = []
        self._seen = 0
        self.take(self.supervisor.tick(0))

    def take(self, outputs: object) -> None:
        assert isinstance(outputs, (list, tuple))
        self.told += [(float(output.t), output.alarm, output.event) for output in outputs if isinstance(output, Event)]

    def until(self, second: float) -> list[tuple[float, str, str]]:
        """What is told until then, since the last time."""
        while self.now_ns < second * S:
            for name, level in self.coupled.items():
                message = self.catalog.messages[f"{name.upper()}_STATUS"]
                payload = encode(message, {f"{name}Level": round(level * 2)})
                self.take(self.supervisor.receive(Frame(self.now_ns, frame_key(message.can_id, False), payload)))
            self.now_ns += 100 * MS
            self.take(self.supervisor.tick(self.now_ns))
        before, self._seen = self._seen, len(self.told)
        return self.told[before:]

    def order(self, name: str) -> None:
        outputs = self.supervisor.command(Order(name, name), self.now_ns)
        assert [output.outcome for output in outputs if isinstance(output, Result)] == ["done"]
        self.take(outputs)


def test_nothing_is_told_of_implements_that_were_never_there(catalog: Catalog) -> None:
    assert Yard(catalog).until(100) == []


def test_an_implement_arms_its_alarms_when_it_is_heard(catalog: Catalog) -> None:
    yard = Yard(catalog)
    yard.until(50)
    yard.coupled["Drill"] = 3
    assert yard.until(60) == [(50.0, "DrillEmpty", "raised")]
    del yard.coupled["Drill"]
    assert [event[1:] for event in yard.until(70)] == [("DrillSilent", "raised")]


def test_lost_without_a_word_is_a_fault_and_what_was_active_stays(catalog: Catalog) -> None:
    yard = Yard(catalog)
    yard.coupled["Drill"] = 3
    yard.until(10)
    yard.coupled.clear()
    assert yard.until(100) == [(13.9, "DrillSilent", "raised")]
    assert yard.supervisor.alarm_states()["DrillEmpty"] == 1


def test_uncoupled_on_purpose_clears_what_was_active_and_raises_nothing(catalog: Catalog) -> None:
    yard = Yard(catalog)
    yard.coupled["Drill"] = 3
    yard.until(10)
    yard.order("uncouple_drill")
    assert yard.until(20) == [], "as long as it talks it is supervised"
    yard.coupled.clear()
    assert yard.until(500) == [(20.9, "DrillEmpty", "cleared")]


def test_two_implements_are_swapped_and_swapped_back_while_it_runs(catalog: Catalog) -> None:
    yard = Yard(catalog)
    yard.coupled["Drill"] = 80
    yard.until(10)
    yard.order("uncouple_drill")
    yard.coupled.clear()
    yard.until(20)
    yard.coupled["Mower"] = 4
    assert yard.until(30) == [(20.0, "MowerEmpty", "raised")]
    yard.coupled["Mower"] = 90
    assert yard.until(40) == [(30.0, "MowerEmpty", "cleared")]
    del yard.coupled["Mower"]
    assert yard.until(50) == [(43.9, "MowerSilent", "raised")], "pulled out without a word"
    yard.coupled["Mower"] = 90
    assert yard.until(60) == [(50.0, "MowerSilent", "cleared")]
    yard.order("uncouple_mower")
    yard.order("couple_drill")
    yard.coupled.clear()
    assert yard.until(70) == [(63.0, "DrillSilent", "raised")], "said to be there, and not heard"
    yard.coupled["Drill"] = 3
    assert yard.until(80) == [(70.0, "DrillEmpty", "raised"), (70.0, "DrillSilent", "cleared")]


def test_an_implement_that_is_back_though_nobody_said_so_is_supervised_and_told(catalog: Catalog) -> None:
    yard = Yard(catalog)
    yard.coupled["Drill"] = 80
    yard.until(10)
    yard.order("uncouple_drill")
    yard.coupled.clear()
    yard.until(20)
    yard.coupled["Drill"] = 3
    assert yard.until(90) == [(20.0, "DrillEmpty", "raised"), (80.0, "DrillNotExpected", "raised")]
    yard.order("couple_drill")
    yard.coupled.clear()
    assert yard.until(100) == [(90.0, "DrillNotExpected", "cleared"), (93.9, "DrillSilent", "raised")]


def test_a_restart_forgets_what_was_said_and_waits_to_hear_the_implement(catalog: Catalog) -> None:
    yard = Yard(catalog)
    yard.coupled["Drill"] = 80
    yard.until(10)
    yard.order("uncouple_drill")
    yard.coupled.clear()
    yard.until(20)
    again = Yard(catalog, yard.supervisor.state())
    assert again.until(100) == []
    again.coupled["Drill"] = 3
    assert again.until(110) == [(100.0, "DrillEmpty", "raised")]


CLAIMING = Source("spreader.dbc", """VERSION ""
NS_ :
BS_:
BU_: UCS SPREADER
BO_ 2565799818 SPREADER_CLAIM: 8 SPREADER
 SG_ SpreaderFunction : 40|8@1+ (1,0) [0|250] "" UCS
BO_ 800 SPREADER_STATUS: 1 SPREADER
 SG_ SpreaderLevel : 0|8@1+ (0.5,0) [0|100] "%" UCS
BO_ 801 SPREADER_ALARMS: 1 UCS
 SG_ SpreaderSilent : 0|2@1+ (1,0) [0|3] "" SPREADER
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_ SG_ "AlarmCode" INT 0 65535;
BA_DEF_ SG_ "AlarmWhen" STRING;
BA_DEF_ SG_ "AlarmEnabledWhen" STRING;
BA_ "VFrameFormat" BO_ 2565799818 3;
BA_ "GenMsgCycleTime" BO_ 800 100;
BA_ "GenMsgCycleTime" BO_ 801 1000;
BA_ "AlarmCode" SG_ 801 SpreaderSilent 900;
BA_ "AlarmWhen" SG_ 801 SpreaderSilent "never(SPREADER_STATUS) or silent(SPREADER_STATUS, 1 s)";
BA_ "AlarmEnabledWhen" SG_ 801 SpreaderSilent "SpreaderFunction == Spreader";
VAL_ 2565799818 SpreaderFunction 130 "Spreader" ;
""")
"""A device that claims source address 0x8A; its alarms are armed by the function in its NAME (ISO 11783-5)."""


def test_an_implement_arms_its_alarms_when_it_claims_its_name() -> None:
    found, problems = build([CLAIMING])
    assert not problems and found is not None
    supervisor = Supervisor(found, unit="a", start_ns=0, broadcast=False, j1939={0: 0x80})

    def alarms(outputs: Sequence[Output]) -> list[str]:
        return [f"{output.alarm} {output.event}" for output in outputs if isinstance(output, Event)]
    other, spreader = (Frame(10 * S, frame_key(0x18EEFF00 | source, True), bytes([1, 0, 0, 0, 0, function, 0, 0xA0]))
                       for source, function in ((0x8B, 130), (0x8A, 130)))
    assert alarms(supervisor.receive(other)) == []
    assert alarms(supervisor.receive(spreader)) == ["SpreaderSilent raised"], "it claims, and says nothing"
    status = Frame(11 * S, frame_key(800, False), b"\x20")
    assert alarms(supervisor.receive(status)) == ["SpreaderSilent cleared"]
    assert alarms(supervisor.tick(13 * S)) == ["SpreaderSilent raised"]


def test_a_sensor_of_the_coupling_needs_no_order() -> None:
    """Where the vehicle senses what hangs on it, its signal is the presence: nothing to say, nothing to forget."""
    source = implement("Drill", 1280, 3901)
    text = source.text.replace("BU_: UCS DRILL", "BU_: UCS DRILL VEHICLE").replace(
        "BO_ 1281 DRILL_COUPLING: 1 UCS", "BO_ 1281 DRILL_COUPLING: 1 VEHICLE").replace(
        PRESENT.format("Drill", "DRILL"), "DrillCoupled == Yes")
    lines = [line for line in text.splitlines() if "NotExpected" not in line and '"Commands" BO_' not in line]
    sensed, problems = build([Source("drill.dbc", "\n".join([*lines, 'BA_ "GenMsgCycleTime" BO_ 1281 100;', ""]))])
    assert sensed is not None, "\n".join(map(str, problems))
    supervisor = Supervisor(sensed, unit="a", start_ns=0)
    told: list[tuple[float, str, str]] = []
    for tenth in range(900):
        coupled, talking = not 300 <= tenth < 600, tenth < 305 or 600 <= tenth < 700
        frames = [Frame(tenth * 100 * MS, 1281, bytes([coupled]))] + [Frame(tenth * 100 * MS, 1280, bytes([2]))] * talking
        told += [(float(output.t), output.alarm, output.event) for output in supervisor.receive_many(frames)
                 if isinstance(output, Event)]
    assert told == [(0.0, "DrillEmpty", "raised"), (30.0, "DrillEmpty", "cleared"), (60.0, "DrillEmpty", "raised"),
                    (73.9, "DrillSilent", "raised")]
