"""The sprayer boom: the node SPRAYER of `sprayer_boom.dbc` with its plant: 12 sections, folding, two tanks, two lines.

Every tick of 50 ms: commands → boom, pumps, set points, section valves → plant. Commands are cyclic; 400 ms after the last one all
sections close and the pumps stop. Drivers are energised once a command: a part that did not obey tries again on Retry only.
Someone at the hand panel (Control Manual) is safe: nothing is sprayed, nothing moves, whatever comes over the bus; and when the
panel is left, still nothing does until Off and Stop were commanded once.
"""
from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import ClassVar

from firmware_py.actuator import Actuator
from firmware_py.codec import Codec, Value
from firmware_py.fault import WORKS, Phrase, Statement
from firmware_py.node import COMMON_FAULTS, Node
from firmware_py.participant import BusFrame
from firmware_py.quantity import Setting
from firmware_py.sprayer_plant import DRIFT_L_S, SECTIONS, Boom, Demand, SprayerPlant

COMMAND_TIMEOUT_NS = 400_000_000
BOOM_TIMEOUT_NS = 800_000_000
"""Four cycles of SPRAYER_BOOM_CMD: without it nothing moves."""
ORDER_TIMEOUT_NS = 1_500_000_000
"""After such a pause in SPRAYER_SECTION_n a Retry is a new one."""
MODE_NS = 500_000_000
"""Pumps to start and to stop."""
VALVE_RESPONSE_S = (0.3, 2.0)
"""Response time of a section's valve, either way; each has its own."""
SLOW = 3
"""A slow valve needs so many times as long."""
BABBLED = 25
"""Frames a tick of a node that sends without end: a fifth of the bus."""
COUNTER_LIMIT = 16
HIGHEST_L_MIN, HIGHEST_ML_MIN = 30.0, 400.0
"""Set points above are taken for these."""
SECTION_ORDERS = {f"SPRAYER_SECTION_{n}": n for n in range(1, SECTIONS + 1)}


def crc8(data: bytes) -> int:
    """CRC-8 SAE J1850: polynomial 0x1D, initial value and final XOR 0xFF."""
    crc = 0xFF
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc ^ 0xFF


def _crc_entry(crc: int) -> int:
    for _ in range(8):
        crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc


_CRC = bytes(map(_crc_entry, range(256)))


class SprayerBoom(Node):
    """The node. settings: by the names of `SETTINGS`, those not given are at their defaults. random: all its chance."""

    TICK_NS: ClassVar[int] = 50_000_000
    DBC: ClassVar[str] = "sprayer_boom.dbc"
    DBC_NODE: ClassVar[str] = "SPRAYER"
    HEARS: ClassVar[tuple[str, ...]] = ("SPRAYER_CMD", "SPRAYER_BOOM_CMD", "SPRAYER_MAIN_CMD", "SPRAYER_DIS_CMD",
                                        "SPRAYER_NOZZLES_CMD", *SECTION_ORDERS)
    SENDS: ClassVar[tuple[str, ...]] = ("SPRAYER_STATUS", "SPRAYER_NOZZLES", "SPRAYER_MAIN", "SPRAYER_DIS", "SPRAYER_TANKS")
    FAULTS: ClassVar[tuple[Phrase, ...]] = (
        Phrase("valve", "stuck closed", "falls closed, or stays closed", count=SECTIONS, counted=True),
        Phrase("valve", "stuck open", "does not close, once it is open", count=SECTIONS, counted=True),
        Phrase("valve", "slow", f"needs {SLOW} times as long", count=SECTIONS),
        Phrase("valve", WORKS, "moves again", count=SECTIONS, lasts=False),
        Phrase("", "refuses start", "its pumps do not start", counted=True),
        Phrase("", "refuses stop", "its pumps do not stop", counted=True),
        Phrase("main_flow", "refuses", "takes over no set point", counted=True),
        Phrase("main_flow", WORKS, "takes set points again", lasts=False),
        Phrase("dis_flow", "refuses", "takes over no set point", counted=True),
        Phrase("dis_flow", WORKS, "takes set points again", lasts=False),
        Phrase("regulator", "stuck", "the regulating valve stays where it is", counted=True),
        Phrase("regulator", WORKS, "moves again", lasts=False),
        Phrase("pump", "weak", "the main pump gives hardly anything"),
        Phrase("pump", WORKS, "gives its full flow", lasts=False),
        Phrase("dis_pump", "weak", "gives a third of what it should"),
        Phrase("dis_pump", WORKS, "doses right", lasts=False),
        Phrase("line", "blocked", "the herbicide line is blocked; for N commands: until the N-th flush", counted=True),
        Phrase("line", WORKS, "is free", lasts=False),
        Phrase("boom", "blocked", "a resistance where it is; for N commands: until the N-th new try", counted=True),
        Phrase("boom", "refuses", "does not begin to move", counted=True),
        Phrase("boom", "slow", "takes three times as long"),
        Phrase("boom", WORKS, "moves again", lasts=False),
        Phrase("main_tank", "leaks", "20 L/min run out"),
        Phrase("main_tank", "empty", "all water is gone", lasts=False),
        Phrase("main_tank", "filled", "someone fills it up to 200 L", lasts=False),
        Phrase("main_tank", WORKS, "is tight", lasts=False),
        Phrase("dis_tank", "empty", "all herbicide is gone", lasts=False),
        Phrase("dis_tank", "filled", "someone fills it up to 10 L", lasts=False),
        Phrase("level_sensor", "drifts up", "reads 20 L more each minute"),
        Phrase("level_sensor", "drifts down", "reads 20 L less each minute"),
        Phrase("level_sensor", WORKS, "drifts no further", lasts=False),
        Phrase("", "manual", "someone takes the hand panel"),
        Phrase("", "wrong counter", "the counter of its status runs backwards"),
        Phrase("", "wrong checksum", "the checksum of its status is wrong"),
        Phrase("", "babbling", "its program stands and sends the same status without end"),
        *COMMON_FAULTS,
    )
    SETTINGS: ClassVar[tuple[Setting, ...]] = (
        Setting("main_tank", "L", 150, 0, 200, "water in the main tank"),
        Setting("dis_tank", "L", 8, 0, 10, "herbicide in its tank"),
        Setting("boom_open", "", 0, 0, 1, "whether the boom is unfolded at the start"),
        Setting("boom_time", "s", 10, 1, 60, "unfolding or folding"),
    )

    def __init__(self, name: str, codec: Codec, settings: Mapping[str, float], random: Random, *, start_ns: int = 0):
        super().__init__(name, codec, start_ns=start_ns)
        chosen = {setting.name: setting.default for setting in self.SETTINGS} | dict(settings)
        self.plant = SprayerPlant(random, self.TICK_NS / 1e9, chosen["main_tank"], chosen["dis_tank"])
        self.boom = Boom(chosen["boom_open"], chosen["boom_time"])
        self._responses_ns = tuple(round(random.uniform(*VALVE_RESPONSE_S) * 1e9) for _ in range(SECTIONS))
        self.valves = tuple(Actuator("Off", response_ns, retry_ns=None) for response_ns in self._responses_ns)
        self.locked: set[int] = set()
        self._again: set[int] = set()
        self._mode = Actuator("Off", MODE_NS, retry_ns=None)
        self._main_set = Actuator(0.0, 0, retry_ns=None)
        self._dis_set = Actuator(0.0, 0, retry_ns=None)
        self._heard_as: dict[str, tuple[int, Mapping[str, Value]]] = {}
        self._manual = False
        self._gated: set[str] = set()
        self._lost = False
        self._counter = 0
        self._wrong = ""
        self._babbles = False
        self._told = self._look()

    @property
    def sections_open(self) -> tuple[bool, ...]:
        """Which valves are open, section 1 first."""
        return tuple([valve.position == "On" for valve in self.valves])

    @property
    def spraying(self) -> bool:
        """Whether the pumps run."""
        return self._mode.position == "On"

    @property
    def is_believed(self) -> bool:
        """Its status has a checksum, too."""
        return self.talks and not self._wrong

    @property
    def set_points(self) -> tuple[float, float]:
        """Taken over: main flow in L/min, herbicide in mL/min, for all sections open."""
        return self._main_set.position, self._dis_set.position

    @property
    def control(self) -> str:
        """Who is in command: Remote, Manual or CommandsLost."""
        return "Manual" if self._manual else "CommandsLost" if self._lost else "Remote"

    # --- protocol ---------------------------------------------------------------------------------------------------------

    def hear(self, t_ns: int, message: str, values: Mapping[str, Value]) -> None:
        """A command. A Retry counts once, when it follows something else."""
        before_ns, before = self._heard_as.get(message, (t_ns, {}))
        self._heard_as[message] = (t_ns, values)
        if message in SECTION_ORDERS:
            is_new = values != before or t_ns - before_ns >= ORDER_TIMEOUT_NS
            self._order(t_ns, SECTION_ORDERS[message], values["Order"], is_new)
            return
        if values.get("SprayingWanted") == "Off" or values.get("BoomWanted") == "Stop":
            self._gated.discard(message)
        if values.get("Retry") == "On" and before.get("Retry") != "On" and not self._manual:
            self._retry(t_ns, message)

    def _order(self, t_ns: int, section: int, order: Value, is_new: bool) -> None:
        valve = self.valves[section - 1]
        if order == "Close":
            self.locked.add(section)
            if is_new:
                valve.advance(t_ns, "Off")
                valve.again(t_ns)
        elif order == "Retry" and is_new and not self._manual:
            self.locked.discard(section)
            self._again.add(section)
        elif order == "Follow":
            self.locked.discard(section)

    def _retry(self, t_ns: int, message: str) -> None:
        match message:
            case "SPRAYER_CMD":
                self._mode.again(t_ns)
            case "SPRAYER_BOOM_CMD":
                self.boom.again(t_ns)
            case "SPRAYER_MAIN_CMD":
                self._main_set.again(t_ns)
                self.plant.water.regulator.again(t_ns)
            case _:
                self._dis_set.again(t_ns)
                self.plant.herbicide.flush()

    def _last(self, message: str, signal: str, t_ns: int, timeout_ns: int | None = None) -> Value | None:
        """What was commanded last; None when nothing was, or not lately."""
        heard = self._heard_as.get(message)
        if heard is None or (timeout_ns is not None and t_ns - heard[0] >= timeout_ns):
            return None
        return heard[1][signal]

    def tick(self, t_ns: int) -> None:
        """One tick of 50 ms."""
        wanted = self._last("SPRAYER_CMD", "SprayingWanted", t_ns, COMMAND_TIMEOUT_NS)
        if self.powered:
            self._lost = wanted is None and (self._lost or self.spraying)
        remote = self.powered and not self._manual
        self._fold(t_ns, remote)
        works = remote and wanted == "On" and "SPRAYER_CMD" not in self._gated and self.boom.state == "Open"
        if not self.powered:
            self._mode.force("Off")
        sprayed = self.spraying
        self._mode.advance(t_ns, "On" if works else "Off")
        if sprayed and not self.spraying:  # the supply of all drivers falls off: one more try to close for each valve
            self._again.update(range(1, SECTIONS + 1))
        if remote:
            self._take_over(t_ns)
        self._switch(t_ns, works and self.spraying)
        demand = Demand(self.spraying, self._main_set.position, self._dis_set.position)
        self.plant.advance(t_ns, demand, sum(self.sections_open))
        seen = self._look()
        if seen != self._told:
            self._tell_changes(t_ns, seen)

    def _fold(self, t_ns: int, remote: bool) -> None:
        """The boom moves while it is commanded to, by nobody else, and nothing is sprayed."""
        wanted = self._last("SPRAYER_BOOM_CMD", "BoomWanted", t_ns, BOOM_TIMEOUT_NS)
        moves = remote and not self.spraying and "SPRAYER_BOOM_CMD" not in self._gated and wanted in ("Open", "Close")
        held = self._last("SPRAYER_BOOM_CMD", "Retry", t_ns, BOOM_TIMEOUT_NS) == "On"
        self.boom.advance(t_ns, str(wanted) if moves else "Stop", self.TICK_NS / 1e9, held=held)

    def _take_over(self, t_ns: int) -> None:
        """Set points."""
        for message, signal, part, most in (("SPRAYER_MAIN_CMD", "MainFlowWanted", self._main_set, HIGHEST_L_MIN),
                                            ("SPRAYER_DIS_CMD", "DisFlowWanted", self._dis_set, HIGHEST_ML_MIN)):
            wanted = self._last(message, signal, t_ns)
            if isinstance(wanted, int | float):
                part.advance(t_ns, min(float(wanted), most))

    def _switch(self, t_ns: int, works: bool) -> None:
        """Section valves follow the pattern; without power they fall closed as far as they can."""
        heard = self._heard_as.get("SPRAYER_NOZZLES_CMD")
        pattern = heard[1] if works and heard is not None and t_ns - heard[0] < COMMAND_TIMEOUT_NS else None
        for number, valve in enumerate(self.valves, 1):
            opens = pattern is not None and pattern[_WANTED[number - 1]] == "On" and number not in self.locked
            valve.advance(t_ns, "On" if opens else "Off")
            if number in self._again:
                valve.again(t_ns)
        self._again.clear()

    def step(self, now_ns: int) -> list[BusFrame]:
        """All ticks up to now, and the frames that are due, or far more when it babbles."""
        frames = super().step(now_ns)
        if self._babbles and not self._silent and self.powered and (status := self._sent.get("SPRAYER_STATUS")) is not None:
            frames += [status] * BABBLED
        return frames

    # --- what it says -----------------------------------------------------------------------------------------------------

    def values(self, message: str) -> Mapping[str, Value]:
        """What the sensors say now."""
        plant = self.plant
        share = sum(self.sections_open) / SECTIONS if self.spraying else 0.0
        match message:
            case "SPRAYER_STATUS":
                return self._status()
            case "SPRAYER_NOZZLES":
                return {name: valve.position for name, valve in zip(_VALVES, self.valves, strict=True)}
            case "SPRAYER_MAIN":
                return {"MainFlowSet": self._main_set.position, "MainFlowTarget": round(self._main_set.position * share, 2),
                        "MainFlow": round(plant.water.flow_l_min, 2), "MainPressure": round(plant.water.bar, 1)}
            case "SPRAYER_DIS":
                return {"DisFlowSet": self._dis_set.position, "DisFlowTarget": round(self._dis_set.position * share, 1),
                        "DisFlow": round(plant.herbicide.flow_ml_min, 1), "DisPressure": round(plant.herbicide.bar, 1)}
            case _:
                tank = plant.tank
                return {"MainTankLevel": round(tank.level_l(self._next_tick_ns), 1), "MainTankFilled": round(tank.filled_l, 1),
                        "MainTankUsed": round(tank.used_l, 1), "DisTankLevel": round(plant.dis_l, 2)}

    def _status(self) -> Mapping[str, Value]:
        self._counter = (self._counter + (-1 if self._wrong == "wrong counter" else 1)) % COUNTER_LIMIT
        values: dict[str, Value] = {
            "Spraying": self._mode.position, "Control": self.control, "BoomState": self.boom.state,
            "BoomOpening": round(self.boom.opening * 200) / 2,
            "SectionsOpen": sum(1 << n for n, is_open in enumerate(self.sections_open) if is_open),
            "SectionsLocked": sum(1 << n - 1 for n in self.locked), "StatusCounter": self._counter, "StatusChecksum": 0}
        checksum = crc8(self.codec.encode("SPRAYER_STATUS", values)[:-1])
        values["StatusChecksum"] = checksum ^ 0xFF if self._wrong == "wrong checksum" else checksum
        return values

    def restart(self, t_ns: int) -> None:
        """Protocol begins anew; boom and tanks are where they were."""
        self._heard_as.clear()
        self.locked.clear()
        self._main_set = Actuator(0.0, 0, retry_ns=None)
        self._dis_set = Actuator(0.0, 0, retry_ns=None)
        self._lost = self._manual = self._babbles = False
        self._gated.clear()
        self._wrong = ""
        self._counter = 0

    # --- faults -----------------------------------------------------------------------------------------------------------

    def fault(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`."""
        match statement.device, statement.action:
            case "valve", action:
                for section in range(SECTIONS) if statement.index is None else (statement.index - 1,):
                    self._valve_fault(section, action, statement.commands)
            case "", "refuses start":
                self._mode.jam(("On",), statement.commands)
            case "", "refuses stop":
                self._mode.jam(("Off",), statement.commands)
            case "", "manual":
                self._manual = True
                self._gated = {"SPRAYER_CMD", "SPRAYER_BOOM_CMD"}
            case "", "wrong counter" | "wrong checksum":
                self._wrong = statement.action
            case "", "babbling":
                self._babbles = self._frozen = True
            case "main_flow" | "dis_flow" | "regulator" as device, action:
                part = {"main_flow": self._main_set, "dis_flow": self._dis_set}.get(device, self.plant.water.regulator)
                if action == WORKS:
                    part.release()
                else:
                    part.jam(None, statement.commands)
            case "boom", action:
                self._boom_fault(action, statement.commands)
            case _:
                self._plant_fault(now_ns, statement)

    def inject(self, now_ns: int, statement: Statement) -> None:
        """One of `FAULTS`; `works` without a device also ends refusals, hand operation and false frames."""
        super().inject(now_ns, statement)
        if statement == Statement("", None, WORKS):
            self._mode.release()
            self._manual = self._babbles = False
            self._wrong = ""

    def _valve_fault(self, section: int, action: str, commands: int | None) -> None:
        valve = self.valves[section]
        match action:
            case "stuck closed":
                valve.jam(("On",), commands)
                valve.force("Off")
            case "stuck open":
                valve.jam(("Off",), commands)
            case "slow":
                valve.response_ns = SLOW * self._responses_ns[section]
            case _:
                valve.release()
                valve.response_ns = self._responses_ns[section]

    def _boom_fault(self, action: str, commands: int | None) -> None:
        match action:
            case "blocked":
                self.boom.block(commands)
            case "refuses":
                self.boom.drive.jam(("Open", "Close"), commands)
            case "slow":
                self.boom.slow = True
            case _:
                self.boom.release()

    def _plant_fault(self, now_ns: int, statement: Statement) -> None:
        plant = self.plant
        match statement.device, statement.action:
            case "pump", action:
                plant.water.weak = action == "weak"
            case "dis_pump", action:
                plant.herbicide.weak = action == "weak"
            case "line", "blocked":
                plant.herbicide.block(statement.commands)
            case "line", _:
                plant.herbicide.release()
            case "main_tank", "empty":
                plant.tank.litres = 0.0
            case "main_tank", "filled":
                plant.tank.fill(200.0)
            case "main_tank", action:
                plant.tank.leaks = action == "leaks"
            case "dis_tank", action:
                plant.dis_l = 10.0 if action == "filled" else 0.0
            case "level_sensor", action:
                plant.tank.drift_l_s = {"drifts up": DRIFT_L_S, "drifts down": -DRIFT_L_S}.get(action, 0.0)
            case _:
                super().fault(now_ns, statement)

    # --- story ------------------------------------------------------------------------------------------------------------

    def _look(self) -> tuple[object, ...]:
        """What a bystander sees; in the order of `_tell_changes`."""
        return self._mode.position, self.control, self.boom.state, frozenset(self.locked)

    def _tell_changes(self, t_ns: int, seen: tuple[object, ...]) -> None:
        mode, control, boom, locked = zip(self._told, seen, strict=True)
        self._told = seen
        if boom[0] != boom[1]:
            self.tell(t_ns, f"boom {str(boom[1]).lower()}")
        if control[0] != control[1]:
            self.tell(t_ns, {"Manual": "someone has the hand panel", "CommandsLost": "commands stopped: sections close, pumps stop"}
                      .get(str(control[1]), "obeys commands"))
        if mode[0] != mode[1]:
            self.tell(t_ns, f"spraying {str(mode[1]).lower()}")
        if locked[0] != locked[1]:
            sections = " ".join(map(str, sorted(self.locked)))
            self.tell(t_ns, f"sections locked closed: {sections or 'none'}")


_VALVES = tuple(f"Valve{n}" for n in range(1, SECTIONS + 1))
_WANTED = tuple(f"Valve{n}Wanted" for n in range(1, SECTIONS + 1))
