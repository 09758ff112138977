"""What there is, whoever says what: the nodes of a day with their plants, and the commands that the bus has carried last."""
from __future__ import annotations

from collections.abc import Mapping
from typing import cast

from firmware_py.airblast_sprayer import AirblastSprayer
from firmware_py.codec import Codec, Value
from firmware_py.computer import Computer
from firmware_py.flaming_tool import FlamingTool
from firmware_py.node import Node
from firmware_py.sprayer_boom import SprayerBoom
from firmware_py.ultrasonic_sensors import UltrasonicSensors
from firmware_py.vehicle import Vehicle

STALE_CYCLES = 3
COMMANDS = ("FLAMER_CMD", "SPRAYER_CMD", "SPRAYER_BOOM_CMD", "SPRAYER_MAIN_CMD", "SPRAYER_DIS_CMD", "SPRAYER_NOZZLES_CMD",
            "VEHICLE_PTO_CMD", "VEHICLE_HITCH_CMD", "VEHICLE_IMPLEMENT_CMD", "VEHICLE_GUIDE", "AIRBLAST_CMD")


class World:
    """The truth. nodes: by their names in the day. now_ns: when it is looked at."""

    def __init__(self, nodes: Mapping[str, Node], codec: Codec):
        self.nodes = nodes
        self.now_ns = 0
        self._codec = codec
        names = [name for name in COMMANDS if name in codec.names]
        self._cycles_ns = {name: codec.cycle_ns(name) for name in names}
        self._names = {codec.identifier(name): name for name in names}
        self._heard: dict[str, tuple[int, bytes]] = {}

    def hears(self, can_id: int, extended: bool) -> bool:
        """Whether it is a command."""
        return (can_id, extended) in self._names

    def hear(self, t_ns: int, can_id: int, extended: bool, data: bytes) -> None:
        """The bus has carried a command."""
        self._heard[self._names[can_id, extended]] = (t_ns, data)

    def command(self, name: str) -> Mapping[str, Value]:
        """The last command of that name; empty when none was carried lately."""
        heard = self._heard.get(name)
        if heard is None or self.now_ns - heard[0] > STALE_CYCLES * self._cycles_ns[name]:
            return {}
        return self._codec.decode(name, heard[1]) or {}

    # The machines; each is there on days that have it.

    @property
    def flamer(self) -> FlamingTool:
        """The flaming tool."""
        return cast(FlamingTool, self.nodes["flamer"])

    @property
    def sprayer(self) -> SprayerBoom:
        """The sprayer boom."""
        return cast(SprayerBoom, self.nodes["sprayer"])

    @property
    def tractor(self) -> Vehicle:
        """The vehicle."""
        return cast(Vehicle, self.nodes["tractor"])

    @property
    def computer(self) -> Computer:
        """The computer of the UCS."""
        return cast(Computer, self.nodes["computer"])

    @property
    def airblast(self) -> AirblastSprayer:
        """The air-blast sprayer."""
        return cast(AirblastSprayer, self.nodes["airblast"])

    @property
    def ultrasonic(self) -> UltrasonicSensors:
        """Its sensors."""
        return cast(UltrasonicSensors, self.nodes["ultrasonic"])
