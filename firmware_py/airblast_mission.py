"""The mission controller of the air-blast sprayer: the other program of the UCS, which starts its devices and commands it.

Theory of operation. It is told what to do (`spraying on`) and sends AIRBLAST_CMD every 100 ms. As NMT master it starts a device
that has booted, or that waits when it is heard for the first time; one that somebody has stopped it leaves alone.

The rule of the two senders: while an alarm in AIRBLAST_ALARMS reads Repairing, it does not send what this alarm's repair holds;
AIRBLAST_CMD it doesn't send while one that holds it reads LockedOut either. Such a lock-out withdraws the order to spray: somebody
has to order it anew.
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.quantity import Setting

COMMANDING = ("NoMainFlow", "AirblastStartStopFailure")
"""Alarms whose repair holds AIRBLAST_CMD; those of all others hold NMT."""
HEARTBEATS: Mapping[str, tuple[str, str]] = {"AIRBLAST_HEARTBEAT": ("AirblastNmtState", "Sprayer"),
                                             "US_HEARTBEAT": ("UsNmtState", "Ultrasonic")}
NOZZLE_MODES, TURN_MODES = ("automatic", "open", "closed"), ("automatic", "level")


class AirblastMission(Node):
    """The node. Takes `ORDERS` by `order`; hears heartbeats and alarms. held: commands that level 1 holds."""

    TICK_NS: ClassVar[int] = 50_000_000
    DBC: ClassVar[str] = "airblast_sprayer.dbc"
    DBC_NODE: ClassVar[str] = "MISSION"
    HEARS: ClassVar[tuple[str, ...]] = (*HEARTBEATS, "AIRBLAST_ALARMS")
    SENDS: ClassVar[tuple[str, ...]] = ("AIRBLAST_CMD", "NMT")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("", "ignores repairs", "goes on sending what level 1 holds"),
        *COMMON_FAULTS,
    )
    ORDERS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("spraying", "on", "start the sprayer", lasts=False),
        Phrase("spraying", "off", "stop it", lasts=False),
        *(Phrase("nozzles", mode, "when their sensors see leaves" if mode == "automatic" else f"all {mode}", lasts=False)
          for mode in NOZZLE_MODES),
        *(Phrase("turning", mode, "to where the leaves are" if mode == "automatic" else "straight", lasts=False)
          for mode in TURN_MODES),
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (Setting("flow", "L/min", 24, 5, 60, "in the main line"),)

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self._flow = round(2 * chosen["flow"]) / 2
        self._obedient = True
        self._spraying = False
        self._nozzles = self._turning = "Automatic"
        self.held: dict[str, str] = {}
        self._nmt_states: dict[str, str] = {}
        self._starts: dict[str, None] = {}

    def order(self, now_ns: int, statement: Statement) -> None:
        """One of `ORDERS`. Raises ValueError for another."""
        self.tell(now_ns, f"order: {statement}")
        match statement.device, statement.action:
            case "spraying", action:
                self._spraying = action == "on"
            case "nozzles", mode if mode in NOZZLE_MODES:
                self._nozzles = mode.capitalize()
            case "turning", mode if mode in TURN_MODES:
                self._turning = mode.capitalize()
            case _:
                raise ValueError(f"{self.name} knows no order {statement}")

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """A heartbeat, or the alarms."""
        if message in HEARTBEATS:
            signal, device = HEARTBEATS[message]
            state, before = str(values[signal]), self._nmt_states.get(device)
            self._nmt_states[device] = state
            if state == "BootUp" or state == "PreOperational" and before in (None, "BootUp"):
                self._starts[device] = None
            return
        holding = {alarm: state for alarm, state in values.items() if state in ("Repairing", "LockedOut")}
        held = {"AIRBLAST_CMD" if alarm in COMMANDING else "NMT": alarm for alarm, state in holding.items()
                if alarm in COMMANDING or state == "Repairing"}
        if any(holding.get(alarm) == "LockedOut" for alarm in COMMANDING) and self._spraying:
            self._spraying = False
            self.tell(t_ns, "locked out: spraying has to be ordered anew")
        for name in held.keys() - self.held.keys():
            leaves = f"leaves {name} to level 1" if self._obedient else f"goes on sending although level 1 holds {name}"
            self.tell(t_ns, f"{leaves} ({held[name]})")
        if "AIRBLAST_CMD" in self.held and "AIRBLAST_CMD" not in held:
            self.tell(t_ns, "commands again")
        self.held = held

    def tick(self, t_ns: int) -> None:
        """There is nothing to compute."""

    def values(self, message: str) -> Mapping[str, Value] | None:
        """The present command; None while level 1 holds it, or while there is nothing to start."""
        if self._obedient and message in self.held:
            return None
        if message == "AIRBLAST_CMD":
            return {"AirblastWanted": "On" if self._spraying else "Off", "NozzleMode": self._nozzles, "TurnMode": self._turning,
                    "Retry": "Off", "AirblastFlowWanted": self._flow}
        if not self._starts:
            return None
        device = next(iter(self._starts))
        del self._starts[device]
        return {"Command": "Start", "Node": device}

    def restart(self, t_ns: int) -> None:
        """After a reset nothing is ordered."""
        self._spraying = False
        self._nozzles = self._turning = "Automatic"
        self.held = {}
        self._nmt_states = {}
        self._starts = {}

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        if statement.device or statement.action != "ignores repairs":
            super().fault(now_ns, statement)
        self._obedient = False

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` also makes it obey again."""
        super().inject(now_ns, statement)
        if statement.action == WORKS:
            self._obedient = True
