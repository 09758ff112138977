"""What is timed: each contender takes the whole recording once and gives CPU seconds and alarms."""
from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import can

from benchmarks.peer import Monitor
from benchmarks.rules import Rule
from level1.catalog import Catalog
from level1.event import Event
from level1.frame import Frame
from level1.supervisor import Supervisor

AlarmLine = tuple[int, str, str]
"""Nanoseconds, name of the alarm, `raised` or `cleared`."""


def supervisor(catalog: Catalog) -> Supervisor:
    """A fresh core; it sends no alarm messages, because the peer has none to send."""
    return Supervisor(catalog, unit="benchmark", broadcast=False)


def alarms_of(outputs: Iterable[object]) -> list[AlarmLine]:
    """The alarms among the outputs of the core."""
    return [(int(output.t.scaleb(9)), output.alarm, output.event) for output in outputs if isinstance(output, Event)]


def receive_many(catalog: Catalog, frames: Sequence[Frame]) -> tuple[float, list[AlarmLine]]:
    """The core, all frames in one call."""
    core = supervisor(catalog)
    start = time.process_time()
    outputs = core.receive_many(frames)
    return time.process_time() - start, alarms_of(outputs)


def receive(catalog: Catalog, frames: Sequence[Frame]) -> tuple[float, list[AlarmLine]]:
    """The core, one call for each frame."""
    core = supervisor(catalog)
    outputs: list[object] = []
    start = time.process_time()
    for frame in frames:
        if output := core.receive(frame):
            outputs += output
    return time.process_time() - start, alarms_of(outputs)


def peer(database: Any, rules: Sequence[Rule], messages: Sequence[can.Message]) -> tuple[float, list[AlarmLine]]:
    """The peer, one call for each message."""
    monitor = Monitor(database, rules)
    start = time.process_time()
    for message in messages:
        monitor.receive(message)
    return time.process_time() - start, monitor.alarms


def decoding_alone(database: Any, messages: Sequence[can.Message]) -> float:
    """cantools, without any rule."""
    start = time.process_time()
    for message in messages:
        database.decode_message(message.arbitration_id, message.data, decode_choices=False)
    return time.process_time() - start
