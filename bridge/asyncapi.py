"""The AsyncAPI 3.0 description of what goes over MQTT: `bridge/schema/asyncapi.json`, written by `python -m bridge.contract`."""
from __future__ import annotations

import inspect
from typing import Any, NamedTuple

from bridge import wire


class Channel(NamedTuple):
    """How a kind of message is published, and by whom."""

    up: bool
    qos: int
    retain: bool
    summary: str


CHANNELS = {
    "connection": Channel(True, 1, True, "State of the unit's bridge; also its last will"),
    "monitor": Channel(True, 0, False, "Monitoring messages, every 250 ms, only the latest"),
    "alarm": Channel(True, 1, False, "Events; each comes again until it is acknowledged"),
    "result": Channel(True, 1, False, "Answers to commands"),
    "ack": Channel(False, 1, False, "Acknowledgements of events, after level 2's own commit"),
    "command": Channel(False, 1, False, "Signed commands; never retained"),
}


def describe() -> dict[str, Any]:
    """The description, seen from level 2: it receives what goes up and sends what goes down."""
    return {
        "asyncapi": "3.0.0",
        "info": {"title": "Level 1 to level 2", "version": str(wire.SCHEMA), "description": inspect.getdoc(wire)},
        "defaultContentType": "application/json",
        "channels": {kind: _channel(kind) for kind in CHANNELS},
        "operations": {kind: _operation(kind, channel) for kind, channel in CHANNELS.items()},
    }


def _channel(kind: str) -> dict[str, Any]:
    levels = [*wire.PREFIX, "{fleet}", "{unit}", kind, *(["{message}"] if kind == "monitor" else [])]
    names = {"fleet": "Name of the fleet", "unit": "Name of the unit", "message": "Name of the monitoring message"}
    return {
        "address": "/".join(levels),
        "parameters": {name: {"description": text} for name, text in names.items() if f"{{{name}}}" in levels},
        "messages": {kind: {"name": wire.KINDS[kind].__name__, "payload": {"$ref": f"./{kind}.json"}}},
    }


def _operation(kind: str, channel: Channel) -> dict[str, Any]:
    return {
        "action": "receive" if channel.up else "send",
        "channel": {"$ref": f"#/channels/{kind}"},
        "summary": channel.summary,
        "bindings": {"mqtt": {"qos": channel.qos, "retain": channel.retain}},
    }
