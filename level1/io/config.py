"""`unit.toml`: what a unit is called, which buses it has, which repairs may act, where its journal and its level 2 are.

Every mistake is found at load, all of them at once, each one line: file, path of the key, what is wrong, what to do.
A key with a duration is written `period = "250 ms"` and held in nanoseconds as `period_ns`.
"""
from __future__ import annotations

import re
import tomllib
import types
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin
from urllib.parse import urlsplit

import msgspec

from level1.catalog import Catalog
from level1.io.error import OutsideError, did_you_mean

UNITS_NS = {"us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000, "h": 3_600_000_000_000}
SCHEMES = ("mqtt", "mqtts")
FASTEST_HEALTH_NS, SLOWEST_HEALTH_NS = 100_000_000, 1_000_000_000
"""UCS_HEALTH promises to come once a second (`ucs.dbc`)."""
SHORTEST_GUARD_NS, LONGEST_GUARD_NS = 20_000_000, 65_535_000_000
"""The gate lets 20 frames of one kind pass in 100 ms; object 0x100C holds no more."""
SHORTEST_PERIOD_NS, LONGEST_PERIOD_NS = 10_000_000, 60_000_000_000
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z]+)")
_TOPIC_LEVEL = re.compile(r"[^\s/+#$\x00-\x1f\x7f][^\s/+#\x00-\x1f\x7f]{0,63}")
_KINDS = {str: "a text", int: "a whole number", bool: "true or false", float: "a number", dict: "a table"}


class ConfigError(OutsideError):
    """A configuration that can't be used; `problems` holds every mistake found."""


class Unit(msgspec.Struct, frozen=True):
    """Who this is: a vehicle with its implement, in a fleet. Both names are levels of MQTT topics (DESIGN §6)."""

    name: str
    fleet: str = "fleet"


class CanopenDevice(msgspec.Struct, frozen=True):
    """A CANopen device on a bus. node: its id, 1 to 127. eds: its data sheet, a file beside the configuration or a shipped one.

    name, heartbeat: instead of what the data sheet says (heartbeat "0 s": it sends none). guard, life_factor: guard time and life
    time factor of a device without heartbeat, instead of what the data sheet says (guard "0 s": it is not asked). required: told as
    silent also when it was never heard; without that, an implement that is not coupled is no fault. history: read its last errors
    by SDO when it reports an emergency.
    """

    node: int
    eds: str | None = None
    name: str | None = None
    heartbeat_ns: int | None = None
    guard_ns: int | None = None
    life_factor: int | None = None
    required: bool = False
    history: bool = False


class Bus(msgspec.Struct, frozen=True):
    """A CAN bus. interface, channel, bitrate, fd: as python-can takes them; options: further arguments of it.

    dbc: files bound to this bus; a name that is no file beside the configuration is one of the shipped definitions.
    j1939: source address that the UCS claims on this bus (128 to 247 are for nodes that choose by themselves); without it the
    UCS claims none and reports no trouble codes of its own there. canopen: devices known beforehand; others are supervised from
    their first heartbeat on.
    """

    name: str
    channel: str
    dbc: tuple[str, ...] = ()
    interface: str = "socketcan"
    bitrate: int | None = None
    fd: bool = False
    j1939: int | None = None
    canopen: tuple[CanopenDevice, ...] = ()
    options: dict[str, Any] = {}


class Gnss(msgspec.Struct, frozen=True):
    """A GNSS receiver. port: of a serial line, best by its id (`/dev/serial/by-id/…`: others change at replugging), or an address
    on Ethernet, `socket://host:port`. baud in bit/s (NMEA 0183's own rate is 4800). broadcast: send what it says on the buses.
    bus, instead of a port: the name of the bus on which it speaks by J1939 or NMEA 2000."""

    port: str = ""
    baud: int = 115200
    broadcast: bool = False
    bus: str = ""


class Recording(msgspec.Struct, frozen=True):
    """The traffic recorder: folder of its files, and the megabytes they may take together."""

    path: str
    max_mb: int = 1000


class Health(msgspec.Struct, frozen=True):
    """The state of the computer: how often it is measured; broadcast: send it on the buses."""

    period_ns: int = 1_000_000_000
    broadcast: bool = True


class Repairs(msgspec.Struct, frozen=True):
    """Alarms whose repair may act; every other repair runs passive (DESIGN §5)."""

    armed: tuple[str, ...] = ()


class JournalFile(msgspec.Struct, frozen=True):
    """The journal's SQLite file; a relative path counts from the configuration's folder. monitor_mb: megabytes that the history of
    the monitoring messages may take beside it, the oldest go first; 0: none is kept."""

    path: str
    monitor_mb: int = 500


class BridgeSettings(msgspec.Struct, frozen=True):
    """The way to level 2: broker as `mqtt://host:1883` or `mqtts://host:8883`; period of the monitoring messages.

    ca, certificate, key: PEM files for mqtts. keys: file with the public keys of those who may command.
    """

    broker: str
    period_ns: int = 250_000_000
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    keys: str | None = None


class Config(msgspec.Struct, frozen=True):
    """A checked `unit.toml`; paths in it are resolved."""

    unit: Unit
    bus: tuple[Bus, ...]
    repairs: Repairs = Repairs()
    journal: JournalFile | None = None
    bridge: BridgeSettings | None = None
    gnss: Gnss | None = None
    recorder: Recording | None = None
    health: Health = Health()
    path: str = ""

    @property
    def j1939(self) -> dict[int, int]:
        """Index of each bus on which the UCS claims a J1939 address -> that address."""
        return {index: bus.j1939 for index, bus in enumerate(self.bus) if bus.j1939 is not None}

    @property
    def gnss_bus(self) -> int | None:
        """Index of the bus on which the GNSS receiver speaks, None: on none."""
        return self.bus_names.index(self.gnss.bus) if self.gnss is not None and self.gnss.bus else None

    @property
    def bus_names(self) -> tuple[str, ...]:
        """Names of the buses, by index."""
        return tuple(bus.name for bus in self.bus)

    @property
    def bus_files(self) -> dict[int, tuple[str, ...]]:
        """Index of each bus -> its DBC files, as `level1.io.definitions.load` takes them."""
        return {index: bus.dbc for index, bus in enumerate(self.bus)}


def load(path: str | Path) -> Config:
    """The configuration in a file. Raises ConfigError with every mistake found."""
    file = Path(path)
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file; give the path of a unit.toml") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text in UTF-8"
        raise ConfigError(f"{file}: can't be read: {reason}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{file}: not TOML: {error}") from None
    return parse(table, str(file))


def parse(table: Mapping[str, Any], path: str) -> Config:
    """The configuration in a TOML table read from `path`. Raises ConfigError with every mistake found."""
    found = [*_struct_problems(table, Config, ""), *_rule_problems(table)]
    if found:
        raise ConfigError(*(f"{path}: {problem}" for problem in found))
    return _resolved(msgspec.convert(_plain(table, Config), Config), path)


def check_armed(config: Config, catalog: Catalog) -> None:
    """Check that every armed name is an alarm with a repair. Raises ConfigError with every one that is not."""
    repairable = [name for name, alarm in catalog.alarms.items() if alarm.repair]
    repairable += [alarm.signal for alarm in catalog.alarms.values() if alarm.repair]
    problems = []
    for index, name in enumerate(config.repairs.armed):
        where = f"{config.path}: repairs.armed[{index}]"
        if name not in catalog.alarms and name not in repairable:
            problems.append(f'{where}: no alarm is called "{name}"{did_you_mean(name, repairable)}')
        elif name not in repairable:
            problems.append(f'{where}: the alarm "{name}" has no repair; take it out of the list')
    if problems:
        raise ConfigError(*problems)


def duration_ns(text: str) -> int:
    """Nanoseconds of a duration with its unit, such as `250 ms`. Raises ValueError with what to write instead."""
    match = _DURATION.fullmatch(text.strip())
    if not match or match[2] not in UNITS_NS:
        units = ", ".join(UNITS_NS)
        raise ValueError(f'"{text}" is no duration; write a number and a unit ({units}), such as "250 ms"')
    whole, _, fraction = match[1].partition(".")
    return int(whole + fraction) * UNITS_NS[match[2]] // int(10 ** len(fraction))


def _key(field: msgspec.structs.FieldInfo) -> str:
    """The name a field has in the file."""
    return field.name.removesuffix("_ns")


def _fields(struct: type[msgspec.Struct]) -> dict[str, msgspec.structs.FieldInfo]:
    """Fields of a table by the key in the file; `Config.path` is no key."""
    return {_key(field): field for field in msgspec.structs.fields(struct) if (struct, field.name) != (Config, "path")}


def _struct_problems(table: Any, struct: type[msgspec.Struct], where: str) -> Iterator[str]:
    """Unknown, missing and wrongly typed keys of a table."""
    if not isinstance(table, Mapping):
        yield f"{where}: expected a table, found {_kind(table)}"
        return
    fields = _fields(struct)
    for key in table:
        if key not in fields:
            yield f"{where}{'.' * bool(where)}{key}: unknown key{did_you_mean(key, fields)}"
    for key, field in fields.items():
        path = f"{where}{'.' * bool(where)}{key}"
        if key in table:
            yield from _value_problems(table[key], field, path)
        elif field.required:
            yield f"{path}: missing; add {_example(key, field.type)}"


def _example(key: str, kind: Any) -> str:
    """How a key is written."""
    if get_origin(kind) is tuple:
        return f"a [[{key}]] table"
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return f"a [{key}] table"
    return f"{key} = …" if kind is int else f'{key} = "…"'


def _value_problems(value: Any, field: msgspec.structs.FieldInfo, path: str) -> Iterator[str]:
    """What is wrong with the value of a key."""
    kind = _without_none(field.type)
    if field.name.endswith("_ns"):
        yield from _duration_problems(value, path)
    elif isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        yield from _struct_problems(value, kind, path)
    elif get_origin(kind) is tuple:
        yield from _list_problems(value, get_args(kind)[0], path)
    elif not _is(value, get_origin(kind) or kind):
        yield f"{path}: expected {_KINDS[get_origin(kind) or kind]}, found {_kind(value)}"


def _list_problems(value: Any, item: Any, path: str) -> Iterator[str]:
    if not isinstance(value, list):
        many = f"[[{path}]] tables" if item not in _KINDS else 'a list such as ["…", "…"]'
        yield f"{path}: expected {many}, found {_kind(value)}"
        return
    for index, element in enumerate(value):
        if item not in _KINDS:
            yield from _struct_problems(element, item, f"{path}[{index}]")
        elif not _is(element, item):
            yield f"{path}[{index}]: expected {_KINDS[item]}, found {_kind(element)}"


def _duration_problems(value: Any, path: str) -> Iterator[str]:
    if not isinstance(value, str):
        yield f'{path}: expected a duration with its unit, such as "250 ms", found {_kind(value)}'
        return
    try:
        duration_ns(value)
    except ValueError as error:
        yield f"{path}: {error}"


def _rule_problems(table: Mapping[str, Any]) -> Iterator[str]:
    """What types can't say. Looks only at values of the right type: the others are told already."""
    unit, bridge, gnss, recorder, health = (_sub(table, name) for name in ("unit", "bridge", "gnss", "recorder", "health"))
    for key in ("name", "fleet"):
        name = unit.get(key)
        if isinstance(name, str) and not _TOPIC_LEVEL.fullmatch(name):
            yield (f'unit.{key}: "{name}" can\'t stand in an MQTT topic; '
                   'leave out spaces, "/", "+", "#" and a "$" at the start, and take at most 64 letters')
    yield from _bus_problems(table.get("bus"))
    broker = bridge.get("broker")
    if isinstance(broker, str) and (problem := _broker_problem(broker)):
        yield f'bridge.broker: "{broker}" {problem}; write "mqtt://host:1883" or "mqtts://host:8883"'
    period = bridge.get("period")
    if (isinstance(period, str) and not list(_duration_problems(period, ""))
            and not SHORTEST_PERIOD_NS <= duration_ns(period) <= LONGEST_PERIOD_NS):
        yield f'bridge.period: "{period}" is outside 10 ms to 1 min'
    if "gnss" in table:
        yield from _gnss_problems(gnss, table.get("bus"))
    baud = gnss.get("baud")
    if isinstance(baud, int) and not 1200 <= baud <= 4_000_000:
        yield f"gnss.baud: {baud} is outside 1200 to 4000000 bit/s"
    max_mb = recorder.get("max_mb")
    if isinstance(max_mb, int) and not 2 <= max_mb <= 10_000_000:
        yield f"recorder.max_mb: {max_mb} is outside 2 to 10000000 megabytes"
    monitor_mb = _sub(table, "journal").get("monitor_mb")
    if isinstance(monitor_mb, int) and not 0 <= monitor_mb <= 10_000_000:
        yield f"journal.monitor_mb: {monitor_mb} is outside 0 to 10000000 megabytes"
    period = health.get("period")
    if (isinstance(period, str) and not list(_duration_problems(period, ""))
            and not FASTEST_HEALTH_NS <= duration_ns(period) <= SLOWEST_HEALTH_NS):
        yield f'health.period: "{period}" is outside 100 ms to 1 s'


def _gnss_problems(gnss: Mapping[str, Any], buses: Any) -> Iterator[str]:
    """Where a receiver speaks: on a line or on a bus of this unit."""
    name = gnss.get("bus")
    if bool(gnss.get("port")) == bool(name):
        yield 'gnss: a receiver speaks on a serial line or on a bus; give port = "/dev/…" or bus = "…"'
    names = [str(bus["name"]) for bus in buses if isinstance(bus, Mapping) and "name" in bus] if isinstance(buses, list) else []
    if isinstance(name, str) and name and name not in names:
        yield f'gnss.bus: no bus is called "{name}"{did_you_mean(name, names)}'


def _bus_problems(buses: Any) -> Iterator[str]:
    if not isinstance(buses, list):
        return
    for index, bus in enumerate(buses):
        address = bus.get("j1939") if isinstance(bus, dict) else None
        if isinstance(address, int) and not 0 <= address <= 253:
            yield f"bus[{index}].j1939: {address} is no source address; take one of 0 to 253, best of 128 to 247"
        yield from _canopen_problems(bus.get("canopen") if isinstance(bus, dict) else None, f"bus[{index}].canopen")
    if not buses:
        yield "bus: no bus; add a [[bus]] table with name, channel and dbc"
    tables = [bus if isinstance(bus, Mapping) else {} for bus in buses]
    for name, count in Counter(str(bus.get("name")) for bus in tables if "name" in bus).items():
        if count > 1:
            yield f'bus: {count} buses are called "{name}"; give each its own name'
    wires = Counter((bus.get("interface", "socketcan"), bus.get("channel")) for bus in tables if _hashable(bus))
    for (interface, channel), count in wires.items():
        if count > 1:
            yield f'bus: {count} buses use the {interface} channel "{channel}"; join their dbc lists'
    if buses and not any(bus.get("dbc") for bus in tables):
        yield 'bus[0].dbc: no bus has definitions; name the DBC files, such as dbc = ["flaming_tool.dbc"]'


def _canopen_problems(devices: Any, path: str) -> Iterator[str]:
    """Node ids that can't be, or that two devices share."""
    tables = [device for device in devices if isinstance(device, dict)] if isinstance(devices, list) else []
    nodes = Counter(device["node"] for device in tables if isinstance(device.get("node"), int))
    for node, count in nodes.items():
        if not 1 <= node <= 127:
            yield f"{path}: {node} is no node id; take one of 1 to 127"
        elif count > 1:
            yield f"{path}: {count} devices have the node id {node}; each on a bus has its own"
    for place, device in enumerate(tables):
        yield from _guarding_problems(device, f"{path}[{place}]")


def _guarding_problems(device: Mapping[str, Any], path: str) -> Iterator[str]:
    """A guard time or life time factor that can't be, or one beside a heartbeat."""
    factor = device.get("life_factor")
    if isinstance(factor, int) and not 1 <= factor <= 255:
        yield f"{path}.life_factor: {factor} is outside 1 to 255"
    times = {}
    for name in ("guard", "heartbeat"):
        text = device.get(name)
        if isinstance(text, str) and not list(_duration_problems(text, "")):
            times[name] = duration_ns(text)
    guard_ns = times.get("guard", 0)
    if guard_ns and not SHORTEST_GUARD_NS <= guard_ns <= LONGEST_GUARD_NS:
        yield f'{path}.guard: "{device["guard"]}" is outside 20 ms to 65.535 s'
    if guard_ns and times.get("heartbeat"):
        yield f"{path}: a device is watched by its heartbeat or by guarding; take one of the two out"


def _hashable(bus: Mapping[str, Any]) -> bool:
    """Whether its interface and channel are texts, so that buses can be compared."""
    return isinstance(bus.get("interface", ""), str) and isinstance(bus.get("channel"), str)


def _broker_problem(url: str) -> str:
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return "has a wrong port"
    if parts.scheme not in SCHEMES:
        return "is no MQTT address" + (did_you_mean(parts.scheme, SCHEMES) if parts.scheme else "")
    if not parts.hostname:
        return "names no host"
    return "has a wrong port" if port == 0 else ""


def _plain(value: Any, kind: Any) -> Any:
    """The table with durations in nanoseconds, as msgspec converts it; only called on tables without problems."""
    kind = _without_none(kind)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        fields = _fields(kind)
        return {name: duration_ns(item) if name.endswith("_ns") else _plain(item, fields[key].type)
                for key, item in value.items() for name in [fields[key].name]}
    if get_origin(kind) is tuple:
        return [_plain(item, get_args(kind)[0]) for item in value]
    return value


def _resolved(config: Config, path: str) -> Config:
    """The configuration with paths that count from its own folder made independent of the working directory."""
    folder = Path(path).parent

    def beside(name: str) -> str:
        return str(folder / name)

    def definitions(name: str) -> str:
        return beside(name) if (folder / name).exists() else name

    def device(one: CanopenDevice) -> CanopenDevice:
        return msgspec.structs.replace(one, eds=definitions(one.eds)) if one.eds else one

    buses = tuple(msgspec.structs.replace(bus, dbc=tuple(map(definitions, bus.dbc)), canopen=tuple(map(device, bus.canopen)))
                  for bus in config.bus)
    journal = config.journal and msgspec.structs.replace(config.journal, path=beside(config.journal.path))
    recorder = config.recorder and msgspec.structs.replace(config.recorder, path=beside(config.recorder.path))
    bridge = config.bridge
    if bridge:
        files = {key: beside(name) for key in ("ca", "certificate", "key", "keys") if (name := getattr(bridge, key))}
        bridge = msgspec.structs.replace(bridge, **files)
    return msgspec.structs.replace(config, bus=buses, journal=journal, bridge=bridge, recorder=recorder, path=path)


def _sub(table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = table.get(key)
    return value if isinstance(value, Mapping) else {}


def _without_none(kind: Any) -> Any:
    """`X` of `X | None`."""
    if get_origin(kind) in (Union, types.UnionType):
        return next(item for item in get_args(kind) if item is not type(None))
    return kind


def _is(value: Any, kind: type) -> bool:
    """isinstance, but `true` is no number."""
    return isinstance(value, kind) and not (isinstance(value, bool) and kind is not bool)


def _kind(value: Any) -> str:
    if isinstance(value, list):
        return "a list"
    if isinstance(value, Mapping):
        return "a table"
    return next((f"{name} ({value!r})" for kind, name in _KINDS.items() if _is(value, kind)), type(value).__name__)
