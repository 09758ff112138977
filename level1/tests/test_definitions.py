"""From DBC texts to a catalog: what is in it, and that every mistake is told where it stands, all of them at once."""
from __future__ import annotations

from decimal import Decimal

import msgspec
import pytest

from level1.catalog import Catalog
from level1.definitions import Source, build, decode
from level1.expression import (
    AlarmState,
    And,
    Arithmetic,
    Boolean,
    Compare,
    Count,
    Elapsed,
    ExpectStep,
    Expression,
    Function,
    Not,
    Number,
    Or,
    Quality,
    Rate,
    ResendStep,
    SendStep,
    SignalValue,
    Silent,
    TroubleCode,
    WaitStep,
)
from level1.scaling import float_bits
from level1.tests.dbc_lines import ALARMS, alarm, alarm_lines, attribute, catalog, found, line_of, text

SECOND = 1_000_000_000
FLAME = SignalValue("STATUS", "Flame")
RUNNING = SignalValue("STATUS", "Running")
PRESSURE = SignalValue("STATUS", "Pressure")
MASK = SignalValue("STATUS", "Mask")


def number(value: str | int) -> Number:
    return Number(Decimal(value))


# -- conditions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("when", "node"), [
    ("Flame == Off", Compare("==", FLAME, number(0))),
    ("Off == Flame", Compare("==", number(0), FLAME)),
    ("STATUS.Flame != On", Compare("!=", FLAME, number(1))),
    ("STATUS.Valve == 'Open'", Compare("==", SignalValue("STATUS", "Valve"), number(1))),
    ("CMD.Mode == 'Turn Left'", Compare("==", SignalValue("CMD", "Mode"), number(2))),
    ("Pressure < 1.5", Compare("<", PRESSURE, number("1.5"))),
    ("Level < -15.5", Compare("<", SignalValue("STATUS", "Level"), number("-15.5"))),
    ("Pressure * 2 + 1 > 3", Compare(">", Arithmetic("+", Arithmetic("*", PRESSURE, number(2)), number(1)), number(3))),
    ("Pressure > 3 * 0.1", Compare(">", PRESSURE, number("0.3"))),
    ("Pressure > 10 / 4", Compare(">", PRESSURE, number("2.5"))),
    ("Pressure > 1 / 3", Compare(">", PRESSURE, Arithmetic("/", number(1), number(3)))),
    ("Mask & 0x0F | 1 == 1", Compare("==", Arithmetic("|", Arithmetic("&", MASK, number(15)), number(1)), number(1))),
    ("bits(Mask) >= 2", Compare(">=", Function("bits", (MASK,)), number(2))),
    ("abs(Flow) > 1", Compare(">", Function("abs", (SignalValue("STATUS", "Flow"),)), number(1))),
    ("max(Pressure, 1, 2) > 3", Compare(">", Function("max", (PRESSURE, number(1), number(2))), number(3))),
    ("-Flow > 1", Compare(">", Function("neg", (SignalValue("STATUS", "Flow"),)), number(1))),
    ("max(1, 2) + abs(-3) < Pressure", Compare("<", number(5), PRESSURE)),
    ("rate(Pressure) < -1", Compare("<", Rate("STATUS", "Pressure"), number(-1))),
    ("Running", Compare("!=", RUNNING, number(0))),
    ("not Running", Not(Compare("!=", RUNNING, number(0)))),
    ("Running == true", Compare("==", RUNNING, number(1))),
    ("false == Running", Compare("==", number(0), RUNNING)),
    ("Running or Flame == On and Pressure < 1",
     Or((Compare("!=", RUNNING, number(0)), And((Compare("==", FLAME, number(1)), Compare("<", PRESSURE, number(1))))))),
    ("age(Flame) > 500 ms", Elapsed("age", "STATUS", "Flame", ">", 500_000_000)),
    ("500 ms <= age(Flame)", Elapsed("age", "STATUS", "Flame", ">=", 500_000_000)),
    ("age(STATUS) < 2 s", Elapsed("age", "STATUS", "", "<", 2 * SECOND)),
    ("2 s > held(Flame)", Elapsed("held", "STATUS", "Flame", "<", 2 * SECOND)),
    ("silent(STATUS)", Silent("STATUS", 300_000_000)),
    ("silent(STATUS, 1 s)", Silent("STATUS", SECOND)),
    ("never(STATUS)", Quality("never", "STATUS", "")),
    ("never(Flame)", Quality("never", "STATUS", "Flame")),
    ("error(Flame) or unavailable(EEC1.Torque)",
     Or((Quality("error", "STATUS", "Flame"), Quality("unavailable", "EEC1", "Torque")))),
    ("dtc(100) or dtc(100, 4)", Or((TroubleCode(100, None), TroubleCode(100, 4)))),
    ("PressureLow == Active", Compare("==", AlarmState("PressureLow"), number(1))),
    ("ALARMS.PressureLow != Normal", Compare("!=", AlarmState("PressureLow"), number(0))),
    ("state(PressureLow) == LockedOut", Compare("==", AlarmState("PressureLow"), number(3))),
    ("Repairing == state(ALARMS.PressureLow)", Compare("==", number(2), AlarmState("PressureLow"))),
    ("count(PressureLow, 10 min) >= 3", Compare(">=", Count("PressureLow", 600 * SECOND), number(3))),
    ("false", Boolean(False)),
])
def test_a_condition_is_resolved(when: str, node: Expression) -> None:
    built = catalog(alarm_lines(when), alarm_lines("Pressure < 1", 2, "PressureLow"))
    assert built.alarms["FlameOut"].when == node
    assert built.alarms["FlameOut"].when_text == when


@pytest.mark.parametrize(("when", "column", "message", "hint"), [
    ("Flam == Off", 1, "no signal `Flam`", "did you mean `Flame`?"),
    ("pressure < 1", 1, "no signal `pressure`", "did you mean `Pressure`?"),
    ("Flame == Of", 10, "`Of` is no value of Flame", "did you mean `Off`? its values are Off, On, Error, 'Not available'"),
    ("'Onn' == Flame", 1, "`Onn` is no value of Flame", "did you mean `On`?"),
    ("Valve == Open", 1, "signal of 2 messages", "write STATUS.Valve or CMD.Valve"),
    ("STATU.Flame == On", 1, "no message `STATU`", "did you mean `STATUS`?"),
    ("STATUS.Flam == On", 1, "STATUS has no signal `Flam`", "did you mean `Flame`?"),
    ("STATUS == 1", 1, "`STATUS` is a message", "STATUS.SignalName"),
    ("CMD.Mode == Spare", 13, "names 2 different values", "number"),
    ("'Off' or Running", 1, "whose value 'Off' is", "compare a signal"),
    ("Flame", 1, "a number is no condition", "Flame == Off"),
    ("Pressure", 1, "a number is no condition", "Pressure != 0"),
    ("Pressure + 1", 1, "a number is no condition", ""),
    ("PressureLow", 1, "a number is no condition", "PressureLow == Active"),
    ("age(Flame)", 1, "age(…) is no condition", "500 ms"),
    ("500 ms", 1, "a duration is no condition", ""),
    ("Pressure < Running == true", 20, "can't be chained", "Pressure < Running and Running == true"),
    ("(Pressure < 1) == true", 2, "a condition can't be compared", "and/or/not"),
    ("Pressure > 2 s", 12, "a duration can't be compared", "age(x) and held(x)"),
    ("Pressure + 2 s > 1", 12, "a duration stands where a number belongs", "durations belong"),
    ("abs(Running == true) > 1", 5, "a condition stands where a number belongs", "and/or"),
    ("age(Flame) == 2 s", 1, "`==` never holds", "<"),
    ("age(Flame) > 2", 14, "compared with a number", "500 ms"),
    ("held(STATUS) > 2 s", 6, "`STATUS` is a message", ""),
    ("held(PressureLow) > 2 s", 6, "can't be asked of an alarm", "state(Alarm)"),
    ("silent(Flame)", 8, "silent takes a message, `Flame` is none", "silent(STATUS)"),
    ("silent(SLOW)", 1, "SLOW has no cycle time", "silent(SLOW, 1 s)"),
    ("silent(STATUS, 5)", 16, "takes a duration", "500 ms"),
    ("silent(STATUS, 50 ms)", 16, "every 100 ms", "300 ms"),
    ("error(STATUS)", 7, "error takes a signal, STATUS is a message", "error(STATUS.SignalName)"),
    ("count(Flame, 10 min) > 1", 7, "no alarm `Flame`", "did you mean `FlameOut`?"),
    ("count(PressureLow) > 1", 1, "given 1 arguments", "count(Alarm, 10 min)"),
    ("state(FlameOt) == Active", 7, "no alarm `FlameOt`", "did you mean `FlameOut`?"),
    ("state(PressureLow) == Activ", 23, "`Activ` is no state", "did you mean `Active`?"),
    ("dtc(600000)", 5, "takes a whole number", "0 to 524287"),
    ("dtc(100, 32)", 10, "takes a whole number", "0 to 31"),
    ("sqrt(Pressure) > 1", 1, "no function `sqrt`", ""),
    ("silnt(STATUS)", 1, "no function `silnt`", "did you mean `silent`?"),
    ("bits(Pressure) > 1", 6, "whole number", "factor"),
    ("Pressure & 1 == 1", 1, "`&` needs whole numbers", "factor"),
    ("Pressure / 0 > 1", 12, "division by zero", ""),
    ("Pressure > 1 / (2 - 2)", 17, "division by zero", ""),
    ("Pressure > 30", 1, "can never hold: Pressure is 0 to 25 bar", ""),
    ("Pressure == 1.55", 1, "can never hold", "steps of 0.1"),
    ("Flame == Error", 1, "can never hold: Flame is 0 to 1", "error(STATUS.Flame)"),
    ("EEC1.Lamp == NA", 1, "can never hold: Lamp is 0 to 1", "unavailable(EEC1.Lamp)"),
    ("EEC1.Lamp == Fault", 1, "can never hold: Lamp is 0 to 1", "error(EEC1.Lamp)"),
    ("bits(Mask) > 12", 1, "can never hold", ""),
    ("PressureLow == 4", 1, "can never hold", ""),
])
def test_a_mistake_is_told_with_its_column_and_what_to_write(when: str, column: int, message: str, hint: str) -> None:
    problems = found(alarm_lines(when), alarm_lines("Level < 1", 2, "PressureLow"))
    assert [problem.severity for problem in problems] == ["error"], "\n".join(map(str, problems))
    problem = problems[0]
    assert (problem.where, problem.attribute, problem.column) == ("ALARMS.FlameOut", "AlarmWhen", column)
    assert message in problem.message and hint in problem.hint and problem.text == when
    assert problem.line == line_of('BA_ "AlarmWhen" SG_ 1616 FlameOut', alarm_lines(when))


@pytest.mark.parametrize(("when", "message"), [
    ("Pressure >= 0 and Running", "always holds: Pressure is 0 to 25 bar"),
    ("Running and 1 < 2", "compares two constants: always true"),
    ("Pressure / Level > 1", "the divisor can become 0"),
    ("Pressure < Level", "units differ: bar and %"),
    ("Pressure + Level < 7", "units differ: bar and %"),
    ("silent(SLOW, 5 s)", "SLOW has no cycle time"),
])
def test_something_doubtful_is_a_warning(when: str, message: str) -> None:
    problems = found(alarm_lines(when))
    assert [problem.severity for problem in problems] == ["warning"], "\n".join(map(str, problems))
    assert message in problems[0].message


def test_every_mistake_of_a_condition_is_told() -> None:
    problems = found(alarm_lines("Flam == Off or STATUS.Valve == Opn or (silent(SLOW) and Pressure > 30)"))
    assert [problem.column for problem in problems] == [1, 32, 40, 57]


def test_a_long_condition_full_of_mistakes_tells_ten_and_how_many_more() -> None:
    problems = found(alarm_lines(" or ".join(["Flam == Off"] * 30)))
    assert len(problems) == 11 and problems[0].message == "and 20 more"


@pytest.mark.parametrize(("attributes", "attribute_name", "message"), [
    ({"AlarmWhen": "Pressure > 5 and Pressure < 3"}, "AlarmWhen", "can never be true"),
    ({"AlarmWhen": "Pressure > 5 and not Pressure > 3"}, "AlarmWhen", "can never be true"),
    ({"AlarmWhen": "Flame == On or Flame == Off"}, "AlarmWhen", "always true"),
    ({"AlarmWhen": "age(Flame) < 1 s and age(Flame) > 2 s"}, "AlarmWhen", "can never be true"),
    ({"AlarmWhen": "true"}, "AlarmWhen", "always true"),
    ({"AlarmWhen": "Pressure < 3", "AlarmUntil": "Level > 50 and not Level > 10"}, "AlarmUntil", "never clear"),
    ({"AlarmWhen": "Pressure < 3", "AlarmEnabledWhen": "Running and not Running"}, "AlarmEnabledWhen", "always suppressed"),
    ({"AlarmWhen": "Pressure < 3", "AlarmEnabledWhen": "Pressure > 4"}, "AlarmEnabledWhen", "never true together"),
])
def test_conditions_that_contradict_themselves_or_each_other(attributes: dict[str, str], attribute_name: str, message: str) -> None:
    problems = found(attribute("AlarmCode", 1), *(attribute(name, value) for name, value in attributes.items()))
    assert [(problem.severity, problem.attribute) for problem in problems] == [("error", attribute_name)]
    assert message in problems[0].message


def test_an_until_condition_that_overlaps_the_condition_is_told() -> None:
    problems = found(alarm_lines("Pressure < 3", AlarmUntil="Pressure > 2"))
    assert [(p.severity, p.attribute) for p in problems] == [("warning", "AlarmUntil")] and "true as well" in problems[0].message


@pytest.mark.parametrize(("when", "until"), [
    ("Pressure < 3", "Pressure > 4"),
    ("Pressure < 3", "Pressure >= 3"),
    ("Pressure < 3 and Running", "Pressure > 4 or not Running"),
    ("Pressure - Flow > 2", "Flow - Pressure < 1 and Pressure < 5"),
    ("count(PressureLow, 10 min) >= 3", "count(PressureLow, 10 min) < 2"),
])
def test_hysteresis_is_no_overlap(when: str, until: str) -> None:
    problems = found(alarm_lines(when, AlarmUntil=until), alarm_lines("Level < 1", 2, "PressureLow"))
    assert not [problem for problem in problems if "true as well" in problem.message]


def test_an_on_delay_shorter_than_the_cycle_is_told() -> None:
    problems = found(alarm_lines(AlarmOnDelay=50))
    assert [(p.severity, p.attribute) for p in problems] == [("warning", "AlarmOnDelay")]
    assert not found(alarm_lines(AlarmOnDelay=300)) and not found(alarm_lines(AlarmOnDelay=0))


# -- attributes ---------------------------------------------------------------------------------------------------------


def test_every_attribute_of_an_alarm_is_read() -> None:
    built = alarm(
        AlarmPriority=4, AlarmUntil="Flame == On", AlarmEnabledWhen="Running", AlarmOnDelay=300, AlarmOffDelay=1500, AlarmLatch=1,
        AlarmCause="wind", AlarmConsequence="weeds stay", AlarmAction="look", AlarmSpn=520192, AlarmFmi=31)
    assert (built.name, built.message, built.code, built.priority) == ("FlameOut", "ALARMS", 1, "Critical")
    assert built.until == Compare("==", FLAME, number(1)) and built.until_text == "Flame == On"
    assert built.enabled == Compare("!=", RUNNING, number(0)) and built.enabled_text == "Running"
    assert (built.on_delay_ns, built.off_delay_ns, built.latch) == (300_000_000, 1_500_000_000, True)
    assert (built.cause, built.consequence, built.action) == ("wind", "weeds stay", "look")
    assert (built.spn, built.fmi) == (520192, 31)
    assert (built.file, built.line) == ("tool.dbc", line_of("SG_ FlameOut"))


@pytest.mark.parametrize(("given", "latch", "local"), [(0, False, False), (1, True, False), (2, True, True), ("Local", True, True)])
def test_a_latch_is_lifted_by_anybody_or_at_the_machine(given: int | str, latch: bool, local: bool) -> None:
    built = alarm(AlarmLatch=given)
    assert (built.latch, built.local_latch) == (latch, local)


def test_what_is_not_given_has_its_default() -> None:
    built = alarm()
    assert (built.priority, built.until, built.enabled, built.on_delay_ns, built.off_delay_ns) == ("Medium", None, None, 0, 0)
    assert (built.latch, built.spn, built.fmi, built.repair) == (False, None, None, None)


def test_the_defaults_of_the_file_count() -> None:
    lines = text(alarm_lines()).replace('BA_DEF_DEF_ "AlarmOnDelay" 0;', 'BA_DEF_DEF_ "AlarmOnDelay" 700;')
    result, _ = build([Source("tool.dbc", lines)])
    assert result and result.alarms["FlameOut"].on_delay_ns == 700_000_000


def test_a_text_set_to_nothing_is_as_if_not_set() -> None:
    built = alarm(AlarmUntil="", AlarmEnabledWhen="", Repair="")
    assert (built.until, built.enabled, built.repair) == (None, None, None)
    assert not catalog(attribute("AlarmWhen", ""), attribute("AlarmCode", 0)).alarms


def test_the_words_of_an_enumeration_may_stand_in_any_order_in_the_file() -> None:
    lines = text(alarm_lines(AlarmPriority=0)).replace('"Event","Low","Medium","High","Critical"', '"High","Event"')
    result, _ = build([Source("tool.dbc", lines)])
    assert result and result.alarms["FlameOut"].priority == "High"


@pytest.mark.parametrize(("lines", "attribute_name", "message"), [
    (attribute("AlarmWhen", "Flame == Off"), "AlarmCode", "has no code"),
    (attribute("AlarmCode", 7), "AlarmWhen", "has no condition"),
    (alarm_lines(code=70000), "AlarmCode", "70000 is not possible"),
    (alarm_lines(AlarmPriority=9), "AlarmPriority", "9 is no value of it"),
    (alarm_lines(AlarmOnDelay=-5), "AlarmOnDelay", "-5 is not possible"),
    (alarm_lines(AlarmSpn=524288), "AlarmSpn", "not possible"),
    (alarm_lines(Repair="wait 1 s", RepairAttempts=0), "RepairAttempts", "0 is not possible"),
    (alarm_lines() + "\n" + alarm_lines("Level < 1", 1, "PressureLow"), "AlarmCode", "code 1 is used twice, first by FlameOut"),
])
def test_a_wrong_attribute_is_an_error_at_its_line(lines: str, attribute_name: str, message: str) -> None:
    errors = [problem for problem in found(lines) if problem.severity == "error"]
    assert [(problem.attribute, message in problem.message) for problem in errors] == [(attribute_name, True)]
    assert errors[0].line


def test_an_attribute_without_definition_is_an_error_with_the_line_to_add() -> None:
    problems = found('BA_ "AlarmWehn" SG_ 1616 FlameOut "Flame == Off";', alarm_lines())
    assert [problem.hint for problem in problems] == ["did you mean `AlarmWhen`?"]
    assert problems[0].line == line_of("AlarmWehn", 'BA_ "AlarmWehn" SG_ 1616 FlameOut "Flame == Off";')
    assert 'BA_DEF_ SG_ "Zebra" STRING ;' in found('BA_ "Zebra" SG_ 1616 FlameOut "x";')[0].hint


def test_an_attribute_defined_with_a_wrong_type_is_an_error_with_the_line_to_write() -> None:
    lines = text(alarm_lines()).replace('BA_DEF_ SG_ "AlarmWhen" STRING ;', 'BA_DEF_ BO_ "AlarmWhen" STRING ;')
    problems = build([Source("tool.dbc", lines)])[1]
    assert any('BA_DEF_ SG_ "AlarmWhen" STRING' in problem.hint for problem in problems)


def test_an_attribute_that_looks_like_one_of_ours_is_a_warning() -> None:
    problems = found('BA_DEF_ SG_ "AlarmOnDelayMs" INT 0 1;', alarm_lines())
    assert [(p.severity, p.hint) for p in problems] == [("warning", "did you mean `AlarmOnDelay`?")]


@pytest.mark.parametrize(("line", "severity", "message", "hint"), [
    ('BA_ "AlarmOnDelay" SG_ 1616 FlamOut 300;', "error", "message ALARMS has no signal `FlamOut`", "did you mean `FlameOut`?"),
    ('BA_ "AlarmOnDelay" SG_ 1661 FlameOut 300;', "error", "no message with the identifier 1661", "did you mean `1616`?"),
    ('BA_ "AlarmCause" BO_ 1616 "wind";', "error", "belongs to signals", "write SG_"),
    ('BA_ "AlarmCode" SG_ 1616 FlameOut 2;', "warning", "is set twice, first in line", "remove one"),
    ('BA_ "AlarmPriority" SG_ 1616 FlameOut "Hihg";', "error", "is no value of it", "did you mean `High`? its values are"),
    ('BA_ "AlarmPriority" SG_ 1616 FlameOut 7;', "error", "7 is no value of it", "write 0 to 4; its values are Event, Low"),
    ('BA_ "AlarmOnDelay" SG_ 1616 FlameOut "soon";', "error", "is no number", "without quotes"),
])
def test_an_attribute_that_would_be_passed_over_is_told(line: str, severity: str, message: str, hint: str) -> None:
    problems = found(alarm_lines(), line)
    told = [(problem.severity, message in problem.message, hint in problem.hint) for problem in problems]
    assert told == [(severity, True, True)], list(map(str, problems))
    assert problems[0].line == line_of(line, alarm_lines(), line)


def test_a_word_of_an_enumeration_may_be_written_out_and_a_number_in_quotes() -> None:
    built = alarm(AlarmPriority="High", AlarmLatch="Yes", AlarmOnDelay="300")
    assert (built.priority, built.latch, built.on_delay_ns) == ("High", True, 300_000_000)


def test_half_a_trouble_code_is_told() -> None:
    assert [p.attribute for p in found(alarm_lines(AlarmSpn=100))] == ["AlarmSpn"]
    assert [p.attribute for p in found(alarm_lines(AlarmFmi=4))] == ["AlarmFmi"]


def test_a_quote_that_is_missing_is_told_where_its_text_begins() -> None:
    unclosed = 'BA_ "AlarmCause" SG_ 1616 FlameOut "wind;'
    (problem,) = found(unclosed, alarm_lines())
    assert problem.line == line_of(unclosed, unclosed, alarm_lines())
    assert (problem.message, problem.hint) == (
        f"not a valid DBC file: a text that begins here ends in line {problem.line + 1} only", 'is its closing `"` missing?')


def test_a_message_without_cycle_time_is_doubted_once_where_it_would_look_healthy_for_ever() -> None:
    problems = found(alarm_lines("EngineSpeed > 100"), alarm_lines("EngineSpeed > 2000 and CMD.Valve == Open", 2, "PressureLow"))
    assert [(problem.where, problem.severity, problem.message.partition(":")[0], problem.hint) for problem in problems] == [
        ("ALARMS.FlameOut", "warning", "EEC1 has no cycle time", "set GenMsgCycleTime")]


@pytest.mark.parametrize(("first", "second", "circle"), [
    ("Running and FlameOut == Normal", "Level < 1", "FlameOut -> FlameOut"),
    ("PressureLow == Active", "Running and state(FlameOut) == Normal", "FlameOut -> PressureLow -> FlameOut"),
])
def test_alarms_that_ask_for_their_own_state_are_told(first: str, second: str, circle: str) -> None:
    problems = found(alarm_lines(first), alarm_lines(second, 2, "PressureLow"))
    assert [circle in problem.message for problem in problems] == [True]


def test_alarms_may_ask_for_others_and_count_themselves() -> None:
    assert not found(alarm_lines("PressureLow == Active", AlarmUntil="count(FlameOut, 1 min) < 2 and PressureLow == Normal"),
                     alarm_lines("Level < 1", 2, "PressureLow"))


def test_the_name_of_a_monitoring_message_can_be_a_topic() -> None:
    assert [p.attribute for p in found(attribute("MonitorAs", "burners/all", "", 256))] == ["MonitorAs"]


def test_attributes_on_a_signal_that_is_no_alarm_are_told() -> None:
    problems = found(attribute("AlarmOnDelay", 300, "Spare"))
    assert [(p.severity, p.attribute) for p in problems] == [("warning", "AlarmOnDelay")]


@pytest.mark.parametrize(("old", "new", "message"), [
    (f"BO_ {ALARMS} ALARMS: 8 UCS", f"BO_ {ALARMS} ALARMS: 8 TOOL", "a message that UCS sends"),
    ("SG_ FlameOut : 0|2@1+", "SG_ FlameOut : 0|1@1+", "states 0 to 3"),
    ("SG_ FlameOut : 0|2@1+ (1,0)", "SG_ FlameOut : 0|2@1+ (2,0)", "states 0 to 3"),
])
def test_an_alarm_needs_a_signal_that_can_carry_it(old: str, new: str, message: str) -> None:
    problems = build([Source("tool.dbc", text(alarm_lines()).replace(old, new))])[1]
    assert [message in problem.message for problem in problems if problem.severity == "error"] == [True]


# -- repairs and commands -----------------------------------------------------------------------------------------------


def test_a_repair_is_resolved_to_steps_of_raw_values() -> None:
    steps = ("send CMD(Valve=Closed, Igniter=1, Mode='Turn Left', SpeedLimit=2.5, Trim=-3); wait 30 s; "
             "expect Flame == Off within 1 s; resend CMD")
    repair = alarm(Repair=steps, RepairAttempts=3, RepairWindow=900, RepairPause=500, RepairGiveUp="send CMD(Valve=Closed)").repair
    assert repair is not None
    assert repair.steps == (
        SendStep("CMD", {"Valve": 0, "Igniter": 1, "Mode": 2, "SpeedLimit": 25, "Trim": -3}), WaitStep(30 * SECOND),
        ExpectStep(Compare("==", FLAME, number(0)), SECOND, "Flame == Off"), ResendStep("CMD"))
    assert repair.give_up == (SendStep("CMD", {"Valve": 0}),)
    assert (repair.attempts, repair.window_ns, repair.pause_ns) == (3, 900 * SECOND, SECOND // 2)
    assert (repair.moves, repair.local_reset, repair.text) == (True, True, steps)


def test_what_a_repair_expects_is_told_with_its_parentheses() -> None:
    said = "(Flame == Off or Pressure > 3) and (Flame == On or Pressure < 2)"
    repair = alarm(Repair=f"send CMD(Valve=Closed); expect  {said}  within 1 s").repair
    assert repair is not None and isinstance(repair.steps[1], ExpectStep)
    assert repair.steps[1].text == said


def test_a_repair_may_move_nothing_and_be_reset_from_above() -> None:
    repair = alarm(Repair="send CMD(Valve=Closed)", RepairMoves=0, RepairReset=1).repair
    assert repair and (repair.moves, repair.local_reset, repair.attempts) == (False, False, 1)


def test_a_float_is_sent_as_its_bits() -> None:
    repair = alarm(Repair="send CMD(Gain=-1.5)").repair
    assert repair and repair.steps == (SendStep("CMD", {"Gain": float_bits(-1.5, 32)}),)


@pytest.mark.parametrize(("steps", "column", "message"), [
    ("send CMDD(Valve=Open)", 6, "no message `CMDD`"),
    ("send STATUS(Flame=On)", 6, "UCS may not send STATUS: its sender is TOOL"),
    ("resend EEC1", 8, "UCS may not send EEC1: its sender is nobody"),
    ("send CMD(Valv=Open)", 10, "CMD has no signal `Valv`"),
    ("send CMD(Valve=Opn)", 16, "`Opn` is no value of Valve"),
    ("send CMD(Mode=Spare)", 15, "names 2 values"),
    ("send CMD(SpeedLimit=Fast)", 21, "has no value names"),
    ("send CMD(SpeedLimit=7)", 21, "above the maximum"),
    ("send CMD(Trim=-101)", 15, "below the minimum"),
    ("send CMD(SpeedLimit=2.55)", 21, "no step of SpeedLimit"),
    ("send CMD(Valve=Open, Valve=Closed)", 22, "set twice"),
    ("send CMD(SpeedLimit=$value)", 21, "Commands only"),
    ("send CMD(Gain=1e39)", 15, "doesn't fit the 32 bits"),
    ("send ALARMS(FlameOut=1)", 13, "is an alarm"),
    ("wait 5", 7, "unit"),
    ("expect Flam == On within 1 s", 8, "no signal `Flam`"),
])
def test_a_wrong_step_is_told_with_its_column(steps: str, column: int, message: str) -> None:
    problems = [problem for problem in found(alarm_lines(Repair=steps)) if problem.severity == "error"]
    assert [(p.attribute, p.column, message in p.message) for p in problems] == [("Repair", column, True)], list(map(str, problems))


@pytest.mark.parametrize(("lines", "severity", "attribute_name", "message"), [
    (alarm_lines(Repair="expect EEC1.Torque > 5 within 1 s"), "warning", "Repair", "nobody sends EEC1"),
    (alarm_lines(Repair="expect CMD.Valve == Open within 1 s"), "warning", "Repair", "only UCS sends CMD"),
    (alarm_lines(Repair="expect Level > 3 and Level < 2 within 1 s"), "error", "Repair", "can never succeed"),
    (alarm_lines(Repair="wait 30 s", RepairWindow=20), "error", "RepairWindow", "can't finish"),
    (alarm_lines(Repair="wait 30 s; expect Flame == On within 5 s", RepairAttempts=3, RepairWindow=60), "warning",
     "RepairWindow", "may never give up"),
    (alarm_lines(RepairAttempts=3), "warning", "RepairAttempts", "there is no Repair"),
])
def test_a_repair_that_cannot_work_is_told(lines: str, severity: str, attribute_name: str, message: str) -> None:
    problems = found(lines)
    assert [(p.severity, p.attribute, message in p.message) for p in problems] == [(severity, attribute_name, True)]


def test_commands_and_monitoring_messages() -> None:
    built = catalog(attribute("Commands", "pause: Mode=Stop; reduce_speed: SpeedLimit=$value, Mode=Work", "", 272),
                    attribute("MonitorAs", "implement", "", 256))
    assert built.commands["pause"].values == {"Mode": 0} and built.commands["pause"].message == "CMD"
    assert built.commands["reduce_speed"].values == {"SpeedLimit": None, "Mode": 1}
    assert built.messages["STATUS"].monitor_as == "implement" and built.messages["CMD"].monitor_as == ""


@pytest.mark.parametrize(("commands", "message_id", "message"), [
    ("pause: Mod=Stop", 272, "no signal `Mod`"), ("pause Mode=Stop", 272, "`:` is expected"),
    ("reset: Mode=Stop", 272, "of the UCS itself"), ("go: Mode=Work; go: Mode=Stop", 272, "defined twice"),
    ("pause: Flame=On", 256, "not sent by UCS"),
])
def test_a_wrong_command_is_told(commands: str, message_id: int, message: str) -> None:
    problems = found(attribute("Commands", commands, "", message_id))
    assert [(p.attribute, message in p.message) for p in problems] == [("Commands", True)], list(map(str, problems))


# -- messages and signals -----------------------------------------------------------------------------------------------


def test_numbers_of_a_signal_are_exactly_as_written() -> None:
    lines = text().replace("(0.1,0) [0|25]", "(0.10000000000000000001,-1E-3) [-0.001|25.5]")
    result, _ = build([Source("tool.dbc", lines)])
    assert result
    signal = result.messages["STATUS"].signal("Pressure")
    assert (signal.factor, signal.offset) == (Decimal("0.10000000000000000001"), Decimal("-0.001"))
    assert (signal.minimum, signal.maximum) == (Decimal("-0.001"), Decimal("25.5"))


def test_a_signal_carries_what_the_file_says() -> None:
    built = catalog(attribute("Role", 1, "Mask", 256), attribute("GenSigStartValue", 5, "SpeedLimit", 272),
                    attribute("GenSigStartValue", 1, "Gain", 272), 'CM_ SG_ 256 Flame "the pilot";')
    status, command = built.messages["STATUS"], built.messages["CMD"]
    flame, flow, ratio = status.signal("Flame"), status.signal("Flow"), built.messages["SLOW"].signal("Ratio")
    assert flame.choices == {0: "Off", 1: "On", 2: "Error", 3: "Not available"} and flame.comment == "the pilot"
    assert (flow.signed, flow.big_endian, flow.minimum, flow.unit) == (True, False, None, "L/min")
    assert ratio.is_float and ratio.length == 32
    assert status.signal("Mask").role == "Counter" and flame.role == "None"
    assert command.signal("SpeedLimit").initial_raw == 5 and command.signal("Gain").initial_raw == float_bits(1.0, 32)


def test_a_message_carries_what_the_file_says() -> None:
    built = catalog('CM_ BO_ 256 "what the tool says";', "BO_TX_BU_ 272 : UCS,DRIVER;")
    status, command, engine = (built.messages[name] for name in ("STATUS", "CMD", "EEC1"))
    assert (status.can_id, status.extended, status.length, status.cycle_ns) == (256, False, 8, 100_000_000)
    assert status.comment == "what the tool says" and (status.file, status.line) == ("tool.dbc", line_of("BO_ 256"))
    assert command.senders == ("UCS", "DRIVER") and command.sent_by_ucs and not status.sent_by_ucs
    assert (engine.extended, engine.j1939, engine.pgn, engine.source, engine.senders) == (True, True, 61444, None, ())
    assert built.messages["SLOW"].cycle_ns is None


def test_a_source_address_in_a_j1939_identifier_is_kept() -> None:
    result, _ = build([Source("tool.dbc", text().replace("2364540158", "2364539904"))])
    assert result and (result.messages["EEC1"].pgn, result.messages["EEC1"].source) == (61444, 0)


@pytest.mark.parametrize(("length", "told"), [(8, False), (12, False), (9, True), (64, False), (65, True)])
def test_what_ucs_sends_fits_one_frame(length: int, told: bool) -> None:
    result, problems = build([Source("tool.dbc", text().replace("CMD: 8 UCS", f"CMD: {length} UCS"))])
    assert ["in one frame" in problem.message for problem in problems] == [True] * told
    assert told or (result and result.messages["CMD"].is_fd == (length > 8))


def test_multiplexed_signals() -> None:
    extra = ("BO_ 300 MUX: 8 TOOL\n SG_ Page M : 0|8@1+ (1,0) [0|0] \"\" UCS\n SG_ Sub m1M : 8|8@1+ (1,0) [0|0] \"\" UCS\n"
             " SG_ A m0 : 8|8@1+ (1,0) [0|0] \"\" UCS\n SG_ B m2 : 16|8@1+ (1,0) [0|0] \"\" UCS\n"
             "SG_MUL_VAL_ 300 Sub Page 1-1;\nSG_MUL_VAL_ 300 A Page 0-0, 4-6;\nSG_MUL_VAL_ 300 B Sub 2-2;")
    mux = catalog(extra).messages["MUX"]
    page, sub, a, b = (mux.signal(name) for name in ("Page", "Sub", "A", "B"))
    assert page.is_multiplexer and page.multiplexer_ids is None
    assert sub.is_multiplexer and (sub.multiplexer_signal, sub.multiplexer_ids) == ("Page", (1,))
    assert (a.multiplexer_signal, a.multiplexer_ids) == ("Page", (0, 4, 5, 6))
    assert (b.multiplexer_signal, b.multiplexer_ids) == ("Sub", (2,))


def test_long_names_stand_in_for_short_ones() -> None:
    long = ("BO_ 300 MUX: 8 TOOL\n SG_ Pg M : 0|8@1+ (1,0) [0|0] \"\" UCS\n SG_ A m1 : 8|8@1+ (1,0) [0|0] \"\" UCS\n"
            'BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;\nBA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;\n'
            'BA_DEF_DEF_ "SystemSignalLongSymbol" "";\nBA_DEF_DEF_ "SystemMessageLongSymbol" "";\n'
            'BA_ "SystemSignalLongSymbol" SG_ 300 Pg "PageOfTheMessage";\nBA_ "SystemMessageLongSymbol" BO_ 300 "LONG_NAME";')
    mux = catalog(long, alarm_lines("LONG_NAME.PageOfTheMessage > 3")).messages["LONG_NAME"]
    assert mux.signal("A").multiplexer_signal == "PageOfTheMessage"


@pytest.mark.parametrize(("old", "new", "severity", "message"), [
    ("(0.1,0) [0|25]", "(0,0) [0|25]", "error", "factor 0"),
    ("40|12@1+", "60|12@1+", "error", "doesn't fit"),
    ("7|8@0+", "7|8@0+", "", ""),
    ("40|12@1+", "3|12@0+", "warning", "overlaps"),
    ("SG_ SpeedLimit : 8|", "SG_ SpeedLimit : 1|", "error", "overlaps"),
    ("32|32@1- (1,0) [0|0] \"\" UCS\nBO_ 272", "32|31@1- (1,0) [0|0] \"\" UCS\nBO_ 272", "error", "can't have 31 bits"),
    ("[-20|100]", "[100|-20]", "warning", "wrong way round"),
    ("SG_ Mask", "SG_ Flow", "error", "used twice in its message"),
    ("BO_ 257 SLOW", "BO_ 256 SLOW", "error", "identifier 0x100 is used twice, first by STATUS"),
    ("BO_ 257 SLOW", "BO_ 257 STATUS", "error", "message name is used twice"),
    ("8|8@1+ (0.1,0) [0|25]", "8|8@1+ (0.1,0 [0|25]", "error", "can't be read"),
    ("BU_: UCS", "BU_ UCS", "error", "not a valid DBC file"),
    ("VAL_ 256 Flame", "VAL_ 256 Flamme", "warning", "is not there"),
    ("BO_ 257 SLOW", "BO_ 4096 SLOW", "error", "more than 11 bits"),
])
def test_a_mistake_in_the_file_itself_is_told(old: str, new: str, severity: str, message: str) -> None:
    lines = text()
    problems = build([Source("tool.dbc", lines.replace(old, new, 1))])[1]
    matching = [problem for problem in problems if problem.severity == severity and message in problem.message]
    assert len(matching) == (1 if severity else 0), list(map(str, problems))
    assert all(problem.line for problem in matching)


# -- several files ------------------------------------------------------------------------------------------------------

OTHER = text(alarm_lines("Level < 3", 9, "Spare")).replace("256", "1256").replace("257", "1257").replace("272", "1272") \
    .replace("1616", "1617").replace("2364540158", "2365540158")
for name in ("STATUS", "SLOW", "CMD", "EEC1", "ALARMS"):
    OTHER = OTHER.replace(f" {name}:", f" OTHER_{name}:")
OTHER = OTHER.replace("Level < 3", "OTHER_STATUS.Level < 3")


def test_conditions_reach_over_files() -> None:
    first = text(alarm_lines("STATUS.Flame == Off and OTHER_STATUS.Flame == Off"))
    result, problems = build([Source("a.dbc", first), Source("b.dbc", OTHER)])
    assert result and not problems and set(result.alarms) == {"FlameOut", "Spare"} and result.files == ("a.dbc", "b.dbc")


def test_codes_names_and_identifiers_are_unique_over_all_files() -> None:
    clash = OTHER.replace('"AlarmCode" SG_ 1617 Spare 9', '"AlarmCode" SG_ 1617 Spare 1').replace("OTHER_SLOW", "SLOW") \
        .replace("BO_ 1272 ", "BO_ 272 ")
    result, problems = build([Source("a.dbc", text(alarm_lines("STATUS.Flame == Off"))), Source("b.dbc", clash)])
    messages = [f"{problem.file}: {problem.message}" for problem in problems if problem.severity == "error"]
    assert result is None
    assert any("b.dbc: code 1 is used twice, first by FlameOut in a.dbc" in message for message in messages)
    assert any("b.dbc: message name is used twice, first in a.dbc" in message for message in messages)
    assert any("b.dbc: identifier 0x110 is used twice, first by CMD in a.dbc" in message for message in messages)


def test_identifiers_may_repeat_on_different_buses() -> None:
    same = OTHER.replace("BO_ 1256 ", "BO_ 256 ").replace("SG_ 1256 ", "SG_ 256 ").replace("BO_ 1256", "BO_ 256") \
        .replace("VAL_ 1256 ", "VAL_ 256 ")
    sources = [Source("a.dbc", text(alarm_lines("STATUS.Flame == Off"))), Source("b.dbc", same)]
    assert build(sources)[0] is None
    result, problems = build(sources, {"a.dbc": (0,), "b.dbc": (1, 2)})
    assert result and not problems
    assert result.buses["STATUS"] == (0,) and result.buses["OTHER_STATUS"] == (1, 2)


def test_messages_of_unbound_files_belong_to_no_bus_in_particular() -> None:
    assert catalog().buses == {}


# -- all together -------------------------------------------------------------------------------------------------------


def test_ten_planted_mistakes_are_told_all_at_once() -> None:
    lines = [
        alarm_lines("Flam == Off and", 1),                                               # syntax
        alarm_lines("Flame == Of and Pressure > 99", 1, "PressureLow", AlarmOnDelay=20,  # value name, limit, code twice
                    Repair="send STATUS(Flame=On); send CMD(SpeedLimit=9); expect EEC1.Torque > 0 within 1 s; wait 10 s",
                    RepairWindow=5, AlarmUntil="silent(SLOW) or silent(STATUS, 10 ms)"),
        attribute("AlarmWehn", "x", "Spare"),
    ]
    problems = found(*lines)
    told = "\n".join(map(str, problems))
    for message in ("ends too early", "`Of` is no value of Flame", "can never hold: Pressure is 0 to 25 bar",
                    "code 1 is used twice", "UCS may not send STATUS", "9 is above the maximum of SpeedLimit",
                    "nobody sends EEC1", "SLOW has no cycle time", "STATUS comes every 100 ms", '"AlarmWehn" is not defined'):
        assert message in told


def test_a_problem_reads_as_file_line_subject_and_caret() -> None:
    problem = found(alarm_lines("Running and Flam == Off"))[0]
    line = line_of('BA_ "AlarmWhen" SG_ 1616 FlameOut', alarm_lines("Running and Flam == Off"))
    assert str(problem) == (f"tool.dbc:{line}: error: ALARMS.FlameOut AlarmWhen (column 13): there is no signal `Flam`; "
                            "did you mean `Flame`?\n    Running and Flam == Off\n                ^")


def test_a_catalog_survives_encoding() -> None:
    built = catalog(alarm_lines(Repair="send CMD(Gain=0.5); expect Flame == On within 1 s", AlarmUntil="Pressure > 1 / 3"))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(built), type=Catalog) == built


def test_the_same_texts_give_the_same_catalog() -> None:
    assert msgspec.json.encode(catalog(alarm_lines())) == msgspec.json.encode(catalog(alarm_lines()))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_files_in_the_encodings_of_the_field_are_read(encoding: str) -> None:
    assert decode('SG_ T : 0|8@1+ (1,0) [0|0] "°C"'.encode(encoding)) == 'SG_ T : 0|8@1+ (1,0) [0|0] "°C"'
