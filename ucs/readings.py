"""What `ucs run` measures itself: the computer, the GNSS receiver, the recorder of the traffic; only what the unit has."""
from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from level1.catalog import Catalog
from level1.health import GNSS_MESSAGES, HOST_MESSAGES, readings_of
from level1.io.can import Port
from level1.io.config import Config, ConfigError
from level1.io.host import HostWatch, Places, measure
from level1.io.housekeeping import Housekeeping
from level1.io.inbox import Inbox
from level1.io.journal import Journal

if TYPE_CHECKING:
    from level1.io.gnss import GnssReceiver
    from level1.io.recorder import Recorder


class Sources(NamedTuple):
    """Sources of readings, running. None: the unit has no such thing."""

    house: Housekeeping | None
    gnss: GnssReceiver | None
    recorder: Recorder | None


def messages(settings: Config, catalog: Catalog) -> frozenset[str]:
    """The messages of readings that this unit gives. Raises ConfigError where the definitions lack those of its receiver."""
    names = readings_of(catalog, HOST_MESSAGES)
    if settings.gnss is None:
        return names
    found = readings_of(catalog, GNSS_MESSAGES.values())
    if missing := sorted(set(GNSS_MESSAGES.values()) - found):
        raise ConfigError(f'{settings.path}: gnss: no definition of {", ".join(missing)}; add "ucs.dbc" to the dbc of a [[bus]]')
    return names if settings.gnss.bus else names | found


def quiet(settings: Config) -> frozenset[str]:
    """Those of them that are not sent on the buses."""
    host = () if settings.health.broadcast else HOST_MESSAGES
    gnss = () if settings.gnss is not None and settings.gnss.broadcast else GNSS_MESSAGES.values()
    return frozenset((*host, *gnss))


def start(settings: Config, catalog: Catalog, ports: Sequence[Port], journal: Journal, inbox: Inbox, stack: ExitStack) -> Sources:
    """Start what the unit has; `stack` stops it."""
    gnss = _gnss(settings, inbox, stack)
    recorder = _recorder(settings, inbox, stack)
    if not readings_of(catalog, HOST_MESSAGES):
        return Sources(None, gnss, recorder)
    places = Places(storage=journal.path.parent)
    watch = HostWatch(settings.health.period_ns, lambda: measure(places), time.monotonic_ns, inbox.wake)
    watch.start()
    stack.callback(watch.stop)
    return Sources(Housekeeping(watch, ports, journal, recorder, gnss), gnss, recorder)


def _gnss(settings: Config, inbox: Inbox, stack: ExitStack) -> GnssReceiver | None:
    if settings.gnss is None or not settings.gnss.port:
        return None
    # Not on the path of a unit without one: it costs 5 MB.
    from level1.io.gnss import GnssReceiver
    receiver = GnssReceiver(settings.gnss, clock=time.monotonic_ns, wall=time.time_ns, told=inbox.wake, notice=inbox.notice)
    receiver.start()
    stack.callback(receiver.stop)
    return receiver


def _recorder(settings: Config, inbox: Inbox, stack: ExitStack) -> Recorder | None:
    if settings.recorder is None:
        return None
    from level1.io.recorder import Recorder
    recorder = Recorder(Path(settings.recorder.path), settings.recorder.max_mb * 1_000_000, clock=time.monotonic_ns,
                        wall=time.time_ns, notice=inbox.notice)
    recorder.start()
    stack.callback(recorder.stop)
    return recorder
