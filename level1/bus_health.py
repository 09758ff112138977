"""The health of one bus: its interface, its controller's error state, babbling identifiers, frames lost on the way in or out.

Pure: it is told what happens and gives reports, causes of alarms of `ucs.dbc` that no condition raises (`Supervisor.report`).
Each cause carries what was lost so far in its values; all that was lost while its alarm stood stands in its `cleared` (`Tolls`).

Error message frames are those of Linux (linux/can/error.h). A controller that is bus-off takes no part in the traffic
(ISO 11898-1): a frame that comes after proves that it is back, whatever the driver says or not.

Babbling: an identifier comes far more often than it should. With a cycle time that is ten times as often, and 200 a second at
least, so that messages sent at every change don't count; without one, about half of what the bus can carry. The packets of
transport protocols may come as fast as the bus allows.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from level1.frame import EXTENDED, j1939_pgn

DOWN, OFF, ERRORS, BABBLING, LOST, UNSENT = "CanBusDown", "CanBusOff", "CanBusErrors", "Babbling", "FramesLost", "SendFailed"
ALARMS = (DOWN, OFF, ERRORS, BABBLING, LOST, UNSENT)
"""Alarms of `ucs.dbc` whose causes are reported here; each cause's key begins with the name of the bus."""

WINDOW_NS = 250_000_000
"""What is counted is judged so often."""
DEFAULT_BITRATE = 250_000
BITS_A_FRAME = 128
"""A 29-bit frame with eight data bytes, without stuff bits."""
BABBLE_FACTOR, BABBLE_LEAST = 10, 200
"""Times the nominal rate, and frames per second, from which on an identifier babbles."""
QUIET_WINDOWS = 2
"""An alarm's cause is over after so many windows without it."""
ERROR_BURST = 10
"""Error frames within a window that are a fault of the bus even before the controller is error-passive."""
PACKETS = (0xEB00, 0xC700)
"""Parameter groups of the packets of the transport protocols (SAE J1939-21, ISO 11783-3)."""

COSTS = ("Frames", "NotSent", "AwaySeconds")
"""Values that count up: frames lost, frames not sent by message, seconds."""

_BUS_OFF, _RESTARTED, _CONTROLLER, _NO_ACK = 0x40, 0x100, 0x4, 0x20
_WARNING, _PASSIVE, _ACTIVE = 0x0C, 0x30, 0x40


class Report(NamedTuple):
    """One cause of an alarm is there, or no more: what `Supervisor.report` is told."""

    t_ns: int
    alarm: str
    key: str
    present: bool
    detail: dict[str, Any]
    text: str


class Tolls:
    """What an alarm of a bus has cost: summed over all the time it stands, though its cause goes away and comes back within the
    delay of clearing. `AwaySeconds`, how long a bus was away, is measured by the times that its events bear: the figure and they
    can't differ, however late the report of a starved thread was heard."""

    def __init__(self) -> None:
        self._since_ns: dict[str, int] = {}
        self._before: dict[tuple[str, str], dict[str, Any]] = {}

    def summed(self, report: Report, *, stands: bool) -> Report:
        """The same report with all that was lost since the alarm was raised. Its t_ns: that of the event. stands: the alarm is
        there from before."""
        place = report.alarm, report.key
        if not stands:
            self._before.pop(place, None)
        detail = {**report.detail, **self._away(report)}
        for name, lost in self._before.get(place, {}).items():
            detail[name] = _sum(lost, detail[name]) if name in detail else lost
        if not report.present:
            self._before[place] = {name: detail[name] for name in COSTS if name in detail}
        return report._replace(detail=detail)

    def _away(self, report: Report) -> dict[str, float]:
        """To the millisecond, where a bus is back."""
        if report.alarm != DOWN:
            return {}
        if report.present:
            self._since_ns.setdefault(report.key, report.t_ns)
            return {}
        since_ns = self._since_ns.pop(report.key, None)
        if since_ns is None:  # lost in another boot, whose time line is over
            return {}
        return {"AwaySeconds": round((report.t_ns - since_ns) / 1e9, 3)}


def _sum(before: Any, lost: Any) -> Any:
    return dict(Counter(before) + Counter(lost)) if isinstance(before, dict) else round(before + lost, 3)


class Traffic(NamedTuple):
    """What was counted in a window. ids: frames by identifier with flags, among those received here; lost: dropped on the way
    to here; unsent: frames that could not be sent, by message; sent: the others. span_ns: time from the first frame to the last."""

    ids: Mapping[int, int]
    span_ns: int = WINDOW_NS
    lost: int = 0
    unsent: Mapping[str, int] = {}
    sent: int = 0


def _no_cycle(_: int) -> int | None:
    return None


class BusHealth:
    """name, channel: of the bus. bitrate: bit/s, None: not known. cycle_of: nominal cycle of an identifier with flags, ns.

    The times of its reports never run backwards, though an error frame may be heard after the end of a window that it came in.
    """

    def __init__(self, name: str, channel: str, bitrate: int | None = None):
        self.name, self.channel = name, channel
        self.cycle_of: Callable[[int], int | None] = _no_cycle
        self.most_a_second = (bitrate or DEFAULT_BITRATE) // (2 * BITS_A_FRAME)
        self._state = "BusActive"
        self._off_ns = self._told_ns = 0
        self._errors = 0
        self._quiet: dict[tuple[str, str], int] = {}
        self._detail: dict[tuple[str, str], dict[str, Any]] = {}
        self._text: dict[tuple[str, str], str] = {}

    @property
    def state(self) -> str:
        """A word of `health.BUS_STATES`."""
        return "BusDown" if self._is_down else self._state

    @property
    def _is_down(self) -> bool:
        return (DOWN, self.name) in self._detail

    @property
    def babbles(self) -> bool:
        """Whether an identifier babbles."""
        return any(alarm == BABBLING for alarm, _ in self._detail)

    # --- the interface ------------------------------------------------------------------------------------------------

    def down(self, t_ns: int, reason: str) -> list[Report]:
        """The interface is lost."""
        if self._is_down:
            return []
        return [self._there(t_ns, DOWN, "", {"Channel": self.channel, "Reason": reason}, f"bus {self.name} is lost: {reason}")]

    def up(self, t_ns: int) -> list[Report]:
        """The interface is open again; its controller begins anew."""
        self._state, self._errors = "BusActive", 0
        return [self._over(t_ns, alarm, key) for alarm, key in list(self._detail) if alarm in (OFF, ERRORS, DOWN)]

    # --- the controller -----------------------------------------------------------------------------------------------

    def error(self, t_ns: int, can_id: int, data: bytes) -> list[Report]:
        """An error message frame. can_id: its classes, flags left out."""
        self._errors += 1
        if can_id & _BUS_OFF:
            self._state, self._off_ns = "BusOff", t_ns
            return [self._there(t_ns, OFF, "", {"Channel": self.channel}, f"bus {self.name}: the controller is bus-off")]
        reports = self._back(t_ns) if can_id & _RESTARTED else []
        detail = data[1] if can_id & _CONTROLLER and len(data) > 1 else 0
        if detail & _PASSIVE:
            self._state = "BusPassive"
            reports.append(self._errors_there(t_ns, "error-passive"))
        elif detail & _WARNING:
            self._state = "BusWarning"
        elif detail & _ACTIVE:
            reports += self._back(t_ns)
            self._state = "BusActive"
        elif can_id & _NO_ACK and self._errors == ERROR_BURST:
            reports.append(self._errors_there(t_ns, "nobody acknowledges"))
        return reports

    def heard(self, t_ns: int) -> list[Report]:
        """A frame has come at t_ns."""
        return self._back(t_ns) if self._state == "BusOff" and t_ns > self._off_ns else []

    def _back(self, t_ns: int) -> list[Report]:
        if self._state != "BusOff":
            return []
        self._state = "BusActive"
        return [self._over(t_ns, OFF, self.name)]

    def _errors_there(self, t_ns: int, state: str) -> Report:
        return self._there(t_ns, ERRORS, "", {"Channel": self.channel, "State": state}, f"bus {self.name}: {state}")

    # --- what is counted ----------------------------------------------------------------------------------------------

    def window(self, t_ns: int, traffic: Traffic) -> list[Report]:
        """A window is over."""
        return [*self._judge_errors(t_ns), *self._judge_ids(t_ns, traffic.ids, max(traffic.span_ns, WINDOW_NS)),
                *self._judge_lost(t_ns, traffic.lost), *self._judge_unsent(t_ns, traffic.unsent, traffic.sent)]

    def _judge_errors(self, t_ns: int) -> Iterable[Report]:
        errors, self._errors = self._errors, 0
        if errors >= ERROR_BURST and self._state != "BusOff":
            yield self._errors_there(t_ns, "error-passive" if self._state == "BusPassive" else "many error frames")
        elif self._state != "BusPassive":
            yield from self._quieter(t_ns, ERRORS, self.name)

    def _judge_ids(self, t_ns: int, ids: Mapping[int, int], span_ns: int) -> Iterable[Report]:
        babbling = set()
        for can_id, count in ids.items():
            rate = count * 1_000_000_000 // span_ns
            if rate >= BABBLE_LEAST and rate >= self._limit(can_id):
                name = f"{can_id & 0x1FFF_FFFF:0{8 if can_id & EXTENDED else 3}X}"
                babbling.add(f"{self.name}/{name}")
                yield self._there(t_ns, BABBLING, f"/{name}", {"Id": name, "FramesPerSecond": rate},
                                  f"identifier {name} comes {rate} times a second on bus {self.name}")
        for alarm, key in list(self._detail):
            if alarm == BABBLING and key not in babbling:
                yield from self._quieter(t_ns, alarm, key)

    def _limit(self, can_id: int) -> int:
        """Frames a second from which on an identifier babbles."""
        if can_id & EXTENDED and j1939_pgn(can_id & 0x1FFF_FFFF) in PACKETS:
            return 1 << 31
        cycle_ns = self.cycle_of(can_id)
        return BABBLE_FACTOR * 1_000_000_000 // cycle_ns if cycle_ns else self.most_a_second

    def _judge_lost(self, t_ns: int, lost: int) -> Iterable[Report]:
        if lost:
            total = self._detail.get((LOST, self.name), {}).get("Frames", 0) + lost
            yield self._there(t_ns, LOST, "", {"Frames": total},
                              f"{total} frames of bus {self.name} were lost before they were read")
        else:
            yield from self._quieter(t_ns, LOST, self.name)

    def _judge_unsent(self, t_ns: int, unsent: Mapping[str, int], sent: int) -> Iterable[Report]:
        silenced = DOWN if self._is_down else OFF if self._state == "BusOff" else None
        if silenced is not None:  # one cause, one alarm: what could not be sent stands in its values
            if unsent:
                detail = {name: value for name, value in self._detail[silenced, self.name].items() if name != "Bus"}
                total = Counter(detail.get("NotSent", {}))
                total.update(unsent)
                yield self._there(t_ns, silenced, "", {**detail, "NotSent": dict(total)}, self._text[silenced, self.name])
        elif unsent:
            total = Counter(self._detail.get((UNSENT, self.name), {}).get("NotSent", {}))
            total.update(unsent)
            yield self._there(t_ns, UNSENT, "", {"NotSent": dict(total)}, f"bus {self.name} takes no frames")
        elif sent:
            yield from self._quieter(t_ns, UNSENT, self.name)

    # --- causes -------------------------------------------------------------------------------------------------------

    def _there(self, t_ns: int, alarm: str, suffix: str, detail: dict[str, Any], text: str) -> Report:
        key = self.name + suffix
        self._quiet[alarm, key] = 0
        self._text[alarm, key] = text
        self._detail[alarm, key] = {"Bus": self.name} | detail
        return Report(self._rising(t_ns), alarm, key, True, self._detail[alarm, key], text)

    def _quieter(self, t_ns: int, alarm: str, key: str) -> Iterable[Report]:
        if (alarm, key) not in self._detail:
            return
        self._quiet[alarm, key] += 1
        if self._quiet[alarm, key] > QUIET_WINDOWS:
            yield self._over(t_ns, alarm, key)

    def _over(self, t_ns: int, alarm: str, key: str) -> Report:
        del self._quiet[alarm, key]
        return Report(self._rising(t_ns), alarm, key, False, self._detail.pop((alarm, key)), self._text.pop((alarm, key)))

    def _rising(self, t_ns: int) -> int:
        self._told_ns = max(t_ns, self._told_ns)
        return self._told_ns
