"""The alarms of `isobus_tractor.dbc`, in virtual time: a tractor's bus with one thing wrong for a while raises its alarm, and
clears it; what the recordings of a real tractor raise is in `level1/tests/test_recordings.py`."""
from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest

from level1.catalog import Catalog
from level1.decode import encode
from level1.frame import EXTENDED, Frame
from level1.io import definitions
from level1.supervisor import Supervisor
from ucs.tests.proof import lives, proves

S = 1_000_000_000
BEGIN, END, LATEST = 20, 100, 140
"""Seconds: the fault is there from the first to the second; the last is when all must be over."""
PASSED = ["raised", "cleared"]
Raws = Mapping[str, int]
HEALTHY: Mapping[str, tuple[int, Raws]] = {
    "EEC1": (0x00, {"EngineSpeed": 1500 * 8}),
    "ET1": (0x00, {"CoolantTemperature": 85 + 40}),
    "EFL_P1": (0x00, {"EngineOilPressure": 300 // 4}),
    "VEP1": (0x00, {"KeySwitchVoltage": 14 * 20}),
    "DM1_ENGINE": (0x00, {}),
    "ETC2": (0x03, {"CurrentGear": 4 + 125}),
    "DM1_TRANSMISSION": (0x03, {}),
    "DM1_TRANSMISSION_2": (0x06, {}),
    "GROUND_SPEED": (0x47, {"GroundSpeed": 2000}),
    "DD": (0x47, {"FuelLevel": 125}),
    "REAR_PTO": (0x47, {}),
    "DM1_TRACTOR_ECU": (0x47, {}),
    "VP": (0x1C, {"Latitude": 2_581_173_000, "Longitude": 2_215_167_000}),
    "STOP_ALL_IMPLEMENTS": (0x26, {"ImplementOperations": 1}),
}
"""Source address and raw values of each message; the engine runs, the shaft stands."""
ENGINE, TRANSMISSION, TRACTOR, RECEIVER = ({name: None for name, (source, _) in HEALTHY.items() if source == wanted}
                                           for wanted in (0x00, 0x03, 0x47, 0x1C))
"""A controller that says nothing."""
FAULTS: list[tuple[Mapping[str, Raws | None], set[str]]] = [
    ({"EFL_P1": {"EngineOilPressure": 60 // 4}}, {"EngineOilPressureLow"}),
    ({"EFL_P1": {"EngineOilPressure": 0xFE}}, {"OilPressureSensorFault"}),
    ({"ET1": {"CoolantTemperature": 106 + 40}}, {"CoolantHot"}),
    ({"ET1": {"CoolantTemperature": 113 + 40}}, {"CoolantHot", "CoolantCritical"}),
    ({"ET1": {"CoolantTemperature": 0xFE}}, {"CoolantSensorFault"}),
    ({"VEP1": {"KeySwitchVoltage": 12 * 20}}, {"ChargingVoltageLow"}),
    ({"VEP1": {"KeySwitchVoltage": 16 * 20}}, {"ChargingVoltageHigh"}),
    ({"EEC1": {"EngineSpeed": 0}, "VEP1": {"KeySwitchVoltage": 11 * 20}}, {"BatteryLow"}),
    ({"EEC1": {"EngineSpeed": 3100 * 8}}, {"EngineOverspeed"}),
    ({"DD": {"FuelLevel": 22}}, {"FuelLow"}),
    (ENGINE, {"EngineEcuSilent"}),
    (TRANSMISSION, {"TransmissionEcuSilent"}),
    (TRACTOR, {"TractorEcuSilent"}),
    (RECEIVER, {"PositionSilent"}),
    ({"VP": {"Latitude": 0xFFFF_FFFF, "Longitude": 0xFFFF_FFFF}}, {"PositionMissing"}),
    ({"DM1_ENGINE": {"EngineRedLamp": 1}}, {"EngineStopLamp"}),
    ({"DM1_ENGINE": {"EngineAmberLamp": 1}}, {"EngineWarningLamp"}),
    ({"DM1_TRANSMISSION": {"TransmissionProtectLamp": 1}}, {"TransmissionFault"}),
    ({"DM1_TRANSMISSION_2": {"Transmission2AmberLamp": 1}}, {"Transmission2Fault"}),
    ({"DM1_TRACTOR_ECU": {"TractorEcuRedLamp": 1}}, {"TractorEcuFault"}),
    ({"REAR_PTO": {"RearPtoEngageRequest": 1}}, {"RearPtoNotEngaging"}),
    ({"REAR_PTO": {"RearPtoSpeed": 400 * 8}}, {"RearPtoStillTurning"}),
    ({"REAR_PTO": {"RearPtoSpeed": 700 * 8, "RearPtoEngaged": 1}}, {"RearPtoOverspeed"}),
    ({"STOP_ALL_IMPLEMENTS": {"ImplementOperations": 0}}, {"ImplementsStopped"}),
]
"""What messages say from `BEGIN` to `END` (nothing: None), and the alarms that it raises."""


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return definitions.load(["isobus_tractor.dbc"])


def traffic(catalog: Catalog, fault: Mapping[str, Raws | None]) -> Iterator[Frame]:
    """Each message at its cycle time."""
    for name, (source, healthy) in HEALTHY.items():
        message = catalog.messages[name]
        assert message.cycle_ns
        wrong = fault.get(name, {})
        for t_ns in range(0, LATEST * S, message.cycle_ns):
            raws = wrong if BEGIN * S <= t_ns < END * S else {}
            if raws is not None:
                yield Frame(t_ns, message.can_id & ~0xFF | source | EXTENDED, encode(message, {**healthy, **raws}))


@pytest.mark.parametrize(("fault", "alarms"), [
    proves(dict.fromkeys(sorted(alarms), PASSED), fault, alarms) for fault, alarms in FAULTS],
    ids=[", ".join(sorted(alarms)) for _, alarms in FAULTS])
def test_each_fault_raises_its_alarms_and_no_others_and_clears_them(
        catalog: Catalog, fault: Mapping[str, Raws | None], alarms: set[str]) -> None:
    tractor = Supervisor(catalog, unit="tractor-7", start_ns=0, broadcast=False)
    assert lives(tractor.receive_many(sorted(traffic(catalog, fault)))) == dict.fromkeys(alarms, PASSED)


def test_every_alarm_of_the_definition_is_raised_by_some_fault(catalog: Catalog) -> None:
    assert {alarm for _, alarms in FAULTS for alarm in alarms} == set(catalog.alarms)
