"""What faults of the air-blast sprayer, its ultrasonic sensors and their mission controller show as."""
from __future__ import annotations

from collections.abc import Mapping

from benchmarks.season.oracle.table import Row, State, symptom
from benchmarks.season.world import World

OPERATIONAL, STOPPED_STATE = 5, 4


def _tells(w: World) -> bool:
    return w.airblast.talks and w.airblast.nmt_state == OPERATIONAL


def _vouches(w: World) -> bool:
    """What a status with a wrong counter says counts for nothing: AirblastFrozen tells that."""
    return _tells(w) and w.airblast.is_believed


def _wrong_airblast(w: World, n: int) -> bool:
    wanted = w.command("AIRBLAST_CMD").get("AirblastWanted")
    return (_vouches(w) and wanted is not None and (wanted == "On") != w.airblast.works
            and w.airblast.state not in ("TankEmpty", "CommandsLost"))


def _airblast_told_percent(w: World) -> float:
    return w.airblast.plant.level_percent - w.airblast.drift_percent


AIRBLAST_EMPTY = symptom("AirblastTankCritical", 5.0, lambda w, n: _tells(w) and w.airblast.plant.level_percent < 4)
AIRBLAST_LOW = symptom("AirblastTankLow", 12.0, lambda w, n: _tells(w) and w.airblast.plant.level_percent < 14)
AIRBLAST_TOLD_EMPTY = symptom("AirblastTankCritical", 5.0, lambda w, n: _tells(w) and _airblast_told_percent(w) < 4)
AIRBLAST_TOLD_LOW = symptom("AirblastTankLow", 12.0, lambda w, n: _tells(w) and _airblast_told_percent(w) < 14)
AIRBLAST_MISCOUNTS = symptom("AirblastFrozen", 2.2, lambda w, n: _tells(w), remains=False)
NO_FLOW = symptom("NoMainFlow", 3.6, lambda w, n: _vouches(w) and w.airblast.works and _airblast_told_percent(w) >= 6
                   and w.airblast.plant.flow_l_min < 1.8)
"""A tank that is told to be empty, which AirblastTankCritical says, is reason enough for no flow."""
WRONG_AIRBLAST = symptom("AirblastStartStopFailure", 3.7, _wrong_airblast)
AIRBLAST_EMERGENCY = symptom("DeviceEmergency", 0.5, lambda w, n: w.airblast.talks and w.airblast.nmt_state != STOPPED_STATE
                              and any(w.airblast.errors.values()))
AIRBLAST_BABBLES = symptom("DeviceEmergency", 0.5, lambda w, n: w.airblast.talks and w.airblast.nmt_state != STOPPED_STATE,
                            remains=False)
AIRBLAST_NO_HEARTBEAT = symptom("AirblastHeartbeatLost", 3.0, lambda w, n: _tells(w) and not w.airblast.beats)
AIRBLAST_STOPPED = symptom("AirblastNotOperational", 3.0, lambda w, n: w.airblast.talks
                            and w.airblast.nmt_state == STOPPED_STATE)
AIRBLAST_QUIET = symptom("AirblastSilent", 1.4, lambda w, n: not w.airblast.sends or w.airblast.nmt_state != OPERATIONAL)
AIRBLAST_STANDS = symptom("AirblastFrozen", 2.2, lambda w, n: w.airblast.sends and not w.airblast.talks
                           and w.airblast.nmt_state == OPERATIONAL)
AIRBLAST_COMMANDS_LOST = symptom("AirblastCommandsLost", 0.5, lambda w, n: _vouches(w) and w.airblast.state == "CommandsLost")
DEVICE = ("DeviceSilent", "DeviceEmergency")
AIRBLAST_ALL = (*DEVICE, "AirblastSilent", "AirblastRestarted", "AirblastNotOperational", "AirblastHeartbeatLost",
                "AirblastCommandsLost", "AirblastStartStopFailure")

AIRBLAST: Mapping[str, Row] = {
    "tank empty": Row((AIRBLAST_EMPTY, AIRBLAST_LOW), ("DeviceEmergency",)),
    "tank low": Row((AIRBLAST_LOW,)),
    "line blocked": Row((NO_FLOW,)),
    "refuses start": Row((WRONG_AIRBLAST,)),
    "refuses stop": Row((WRONG_AIRBLAST,)),
    "slow": Row((WRONG_AIRBLAST,)),
    "level_sensor drifts down": Row((AIRBLAST_TOLD_EMPTY, AIRBLAST_TOLD_LOW)),
    "wrong counter": Row((AIRBLAST_MISCOUNTS,)),
    "emergency": Row((AIRBLAST_EMERGENCY,)),
    "babbling": Row((AIRBLAST_BABBLES,), ("AirblastFrozen",)),
    "heartbeat off": Row((AIRBLAST_NO_HEARTBEAT,), ("DeviceSilent",)),
    "stopped": Row((AIRBLAST_STOPPED, AIRBLAST_QUIET), AIRBLAST_ALL),
    "silent": Row((AIRBLAST_QUIET,), AIRBLAST_ALL),
    "frozen": Row((AIRBLAST_STANDS,), AIRBLAST_ALL),
    "reset": Row((AIRBLAST_QUIET,), AIRBLAST_ALL),
}


def _senses(w: World) -> bool:
    return w.ultrasonic.talks and w.ultrasonic.nmt_state == OPERATIONAL


SENSOR_DEAD = symptom("Ultrasonic{n}NotWorking", 3.2, lambda w, n: _senses(w) and w.ultrasonic.states[n - 1] == "Failed")
SENSOR_FROZEN = symptom("UltrasonicFrozen", 8.0, lambda w, n: _senses(w) and w.ultrasonic.states[n - 1] == "Working"
                         and w.ultrasonic.sensors[n - 1].frozen != 0)
ULTRASONIC_EMERGENCY = symptom("DeviceEmergency", 0.5, lambda w, n: w.ultrasonic.talks and w.ultrasonic.nmt_state != STOPPED_STATE
                                and any(w.ultrasonic.errors.values()))
"""An emergency is sent once: one that came up while the device was silent, or stopped, nobody has heard."""
ULTRASONIC_BABBLES = symptom("DeviceEmergency", 0.5, lambda w, n: w.ultrasonic.talks
                              and w.ultrasonic.nmt_state != STOPPED_STATE, remains=False)
ULTRASONIC_NO_HEARTBEAT = symptom("UltrasonicHeartbeatLost", 4.5, lambda w, n: _senses(w) and not w.ultrasonic.beats)
ULTRASONIC_STOPPED = symptom("UltrasonicNotOperational", 4.0, lambda w, n: w.ultrasonic.talks
                              and w.ultrasonic.nmt_state == STOPPED_STATE)
ULTRASONIC_QUIET = symptom("UltrasonicSilent", 5.3, lambda w, n: not w.ultrasonic.sends)
ULTRASONIC_STANDS = symptom("UltrasonicFrozen", 8.0, lambda w, n: w.ultrasonic.sends and not w.ultrasonic.talks
                             and w.ultrasonic.nmt_state == OPERATIONAL)
ULTRASONIC_ALL = (*DEVICE, "UltrasonicSilent", "UltrasonicNotOperational", "UltrasonicHeartbeatLost", "UltrasonicFrozen")

ULTRASONIC: Mapping[str, Row] = {
    "sensor dead": Row((SENSOR_DEAD, ULTRASONIC_EMERGENCY)),
    "sensor broken": Row((SENSOR_DEAD, ULTRASONIC_EMERGENCY)),
    "sensor frozen": Row((SENSOR_FROZEN,)),
    "emergency": Row((ULTRASONIC_EMERGENCY,)),
    "babbling": Row((ULTRASONIC_BABBLES,)),
    "heartbeat off": Row((ULTRASONIC_NO_HEARTBEAT,), ("DeviceSilent",)),
    "stopped": Row((ULTRASONIC_STOPPED,), ULTRASONIC_ALL),
    "silent": Row((ULTRASONIC_QUIET,), ULTRASONIC_ALL),
    "frozen": Row((ULTRASONIC_STANDS,), ULTRASONIC_ALL),
    "reset": Row((), ULTRASONIC_ALL),
}
AIRBLAST_MISSION: Mapping[str, Row] = {
    "silent": Row((AIRBLAST_COMMANDS_LOST,), ("DeviceEmergency",)),
    "frozen": Row((AIRBLAST_COMMANDS_LOST,), ("DeviceEmergency",)),
    "reset": Row((AIRBLAST_COMMANDS_LOST,), ("DeviceEmergency",)),
    "ignores repairs": Row(),
}

ROWS: Mapping[str, Mapping[str, Row]] = {
    "airblast_sprayer": AIRBLAST, "ultrasonic_sensors": ULTRASONIC, "airblast_mission": AIRBLAST_MISSION}
NATURAL: Mapping[str, State] = {
    "AirblastTankLow": lambda w: w.airblast.plant.level_percent < 15.6,
    "AirblastTankCritical": lambda w: w.airblast.plant.level_percent < 5.6,
}
LINGERS: Mapping[str, State] = {
    "AirblastTankLow": lambda w: w.airblast.plant.level_percent < 20.8,
    "AirblastTankCritical": lambda w: w.airblast.plant.level_percent < 10.8,
    "DeviceEmergency": lambda w: w.airblast.ended_unheard or w.ultrasonic.ended_unheard,
}
"""An emergency's end is sent once (CiA 301): after one that nobody heard, the error stands until a boot or another end."""
