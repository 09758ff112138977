"""Pictures of a replay or a simulation: what was expected and what was, alarms as spans, repairs as marks, the path with alarms
on it. Needs the extra `plot`.

From top to bottom: a lane for each signal that the alarms shown look at (where one alarm compares two signals with each other,
both in one lane, the expected one dashed), the alarms, and below, where the recording says where the vehicle was, its path.
"""
from __future__ import annotations

import importlib
import math
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from level1.event import Event
from level1.io.error import OutsideError
from ucs import inputs, pairs
from ucs.inputs import Input
from ucs.trace import Line, Trace

MOST_ALARMS, MOST_LANES = 14, 18
"""Drawn at most; what is left out is said."""
WIDTH_IN, DPI = 12.0, 110
LANE_IN, STATE_IN, ALARM_IN, PATH_IN = 0.50, 0.17, 0.30, 5.6
ACTUAL, EXPECTED, GRID, INK = "#1864ab", "#868e96", "#e9ecef", "#212529"
PRIORITY_COLOURS = {"Event": "#74c0fc", "Low": "#ffd43b", "Medium": "#fd9f3c", "High": "#e8590c", "Critical": "#c2255c"}
PATH_COLOURS = ("#e8590c", "#2f9e44", "#862e9c", "#c2255c", "#0b7285", "#a67c00", "#5f3dc4", "#364fc7")
LOCKED = "#495057"
MARKS = {"repair_started": (">", "#1864ab", "repair started"), "repair_failed": ("X", "#c92a2a", "repair failed"),
         "repaired": ("o", "#2f9e44", "repaired"), "locked_out": ("s", "#212529", "locked out"),
         "acknowledged": ("D", "#862e9c", "acknowledged")}
MISSING_COLOURS = {"error": "#c92a2a"}
MARK_OFFSETS = {"repair_started": -0.2, "repair_failed": 0.2}
"""A failed attempt and the next one often have the same time."""
ACTUAL_STYLE: dict[str, Any] = {"color": ACTUAL, "linewidth": 1.4}
EXPECTED_STYLE: dict[str, Any] = {"color": EXPECTED, "linestyle": (0, (3, 1.5)), "linewidth": 1.3}
LEGEND_COLUMNS, TITLE_LETTERS = 9, 120
PATH_POINTS, PATH_STEP_POINTS, PATH_MOST_POINTS = 2.5, 2.8, 18.0
"""Line widths on the path: the alarm that stood shortest on top, each below it wider by a step, so that all can be seen."""
LEGEND_POINTS = 6.0
LONG_S = 600.0
"""Longer time axes are labelled in minutes."""


class Story(NamedTuple):
    """One alarm from raised to cleared, s since the beginning. end: of the picture where it still stood."""

    alarm: str
    priority: str
    start: float
    end: float
    locked: float | None
    marks: tuple[tuple[float, str], ...]


class Lane(NamedTuple):
    """What one lane shows: the actual signal, and the expected one if an alarm compares the two. alarms: that look at it."""

    actual: Line
    expected: Line | None
    alarms: frozenset[str]


def draw(trace: Trace, events: Sequence[Event], out: str | Path, title: str) -> None:
    """Write the picture, in the format of the name's suffix. Raises OutsideError."""
    figures = _matplotlib()
    origin_ns, length_s = trace.first_ns or 0, max((trace.last_ns - (trace.first_ns or 0)) / 1e9, 1e-3)
    told = stories(events, origin_ns, length_s)
    alarms = list(dict.fromkeys(story.alarm for story in told))
    shown = alarms[:MOST_ALARMS]
    found = lanes(trace, shown)
    drawn = found[:MOST_LANES]
    heights = [_lane_height(lane) for lane in drawn] + [max(ALARM_IN * len(shown), ALARM_IN) + 0.1]
    east_north = trace.path()
    has_path = _moved(*east_north[1:])
    gaps = 0.24 * len(heights)
    handles = _handles(told, drawn)
    head, foot = 0.65 + 0.2 * math.ceil(len(handles) / LEGEND_COLUMNS), 0.62
    chart_in = sum(heights) + gaps
    total = head + chart_in + foot + (PATH_IN + 0.75 if has_path else 0.0)
    figure = figures.Figure(figsize=(WIDTH_IN, total), dpi=DPI)
    top = 1 - head / total
    bottom = top - chart_in / total
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights, left=0.17, right=0.975, top=top, bottom=bottom,
                               hspace=0.24 / (sum(heights) / len(heights)))
    axes = [figure.add_subplot(grid[row]) for row in range(len(heights))]
    minutes = length_s > LONG_S
    scale = 60.0 if minutes else 1.0
    for lane, axis in zip(drawn, axes, strict=False):
        _draw_lane(axis, lane, origin_ns, length_s, scale)
        for story in told:
            if story.alarm in lane.alarms:
                axis.axvspan(story.start / scale, story.end / scale, color=PRIORITY_COLOURS[story.priority], alpha=0.13, lw=0)
    _draw_alarms(axes[-1], told, shown, length_s, scale)
    for axis in axes:
        _dress(axis, length_s / scale, last=axis is axes[-1])
    axes[-1].set_xlabel(f"{'min' if minutes else 's'} since the beginning", fontsize=9)
    figure.suptitle(textwrap.shorten(title, TITLE_LETTERS, placeholder=" …"), x=0.015, y=1 - 0.16 / total, ha="left", va="top",
                    fontsize=11, fontweight="bold", color=INK)
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.013, 1 - 0.42 / total), ncols=LEGEND_COLUMNS, fontsize=8,
                  frameon=False, handletextpad=0.5, columnspacing=1.4, borderaxespad=0)
    left_out = [f"{len(alarms) - len(shown)} more alarms"] * (len(alarms) > len(shown)) + [
        f"{len(found) - len(drawn)} more signals"] * (len(found) > len(drawn))
    if left_out:
        figure.text(0.975, bottom - 0.42 / total, " and ".join(left_out) + " are not drawn", ha="right", va="top", fontsize=8,
                    color=EXPECTED)
    if has_path:
        _draw_path(figure.add_axes((0.08, 0.55 / total, 0.62, PATH_IN / total)), east_north, told, shown, origin_ns)
    try:
        figure.savefig(out, facecolor="white")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
        raise OutsideError(f"{out}: the picture can't be written: {reason}") from None


def check(out: str | Path) -> None:
    """Whether a picture can be written there, before work is done for it. Raises OutsideError."""
    _matplotlib()
    formats = importlib.import_module("matplotlib.backend_bases").FigureCanvasBase.get_supported_filetypes()
    if Path(out).suffix.lower().removeprefix(".") not in formats:
        raise OutsideError(f"{out}: the picture can't be written: its name says no known format; end it in .png, .svg or .pdf")
    if not Path(out).absolute().parent.is_dir():
        raise OutsideError(f"{out}: the picture can't be written: there is no folder {Path(out).parent}")


def stories(events: Iterable[Event], origin_ns: int, length_s: float) -> list[Story]:
    """The alarms in the order in which they were raised."""
    by_instance: dict[tuple[str, int], list[Event]] = {}
    for event in events:
        by_instance.setdefault((event.alarm, event.instance), []).append(event)
    return sorted((_story(told, origin_ns, length_s) for told in by_instance.values() if told[0].event == "raised"),
                  key=lambda story: (story.start, story.alarm))


def _story(told: Sequence[Event], origin_ns: int, length_s: float) -> Story:
    times = [float(event.t) - origin_ns / 1e9 for event in told]
    end = times[-1] if told[-1].event == "cleared" else max(length_s, times[-1])
    locked = next((t for t, event in zip(times, told, strict=True) if event.event == "locked_out"), None)
    marks = tuple((t, event.event) for t, event in zip(times, told, strict=True) if event.event in MARKS)
    return Story(told[0].alarm, told[0].priority, times[0], end, locked, marks)


def lanes(trace: Trace, alarms: Sequence[str]) -> list[Lane]:
    """The lanes for these alarms. Where none of them is a fault, also what changed of the others' signals: first those that
    are compared with what was commanded."""
    catalog, lines = trace.catalog, trace.lines()
    chosen = [catalog.alarms[name] for name in alarms if name in catalog.alarms]
    own = [place for alarm in chosen for place in inputs.of_alarm(alarm, ages_expected=False)]
    others: list[Input] = []
    if not any(alarm.is_fault for alarm in chosen):
        chosen = list(catalog.alarms.values())
        others = [place for alarm in chosen for place in inputs.of_alarm(alarm) if place in lines and _changes(lines[place])]
    compared = [pair for alarm in catalog.alarms.values() for pair in sorted(pairs.of_alarm(alarm, catalog))]
    partner = {actual: expected for actual, expected in compared if actual in lines and expected in lines}
    others.sort(key=lambda place: place not in partner)
    found: dict[Input, Lane] = {}
    for place in (*own, *others):
        place = next((actual for actual, expected in partner.items() if expected == place), place)
        if place in lines:
            expected = partner.get(place)
            looking = frozenset(alarm.name for alarm in chosen if not {place, expected}.isdisjoint(inputs.of_alarm(alarm)))
            found.setdefault(place, Lane(lines[place], lines[expected] if expected else None, looking))
    return list(found.values())


def _changes(line: Line) -> bool:
    return len({value for value in line.values if not math.isnan(value)}) > 1


# --- drawing ------------------------------------------------------------------------------------------------------------------


def _states(lane: Lane) -> list[float] | None:
    """The raw values that occur, of a signal with names for them all; None for a number."""
    values = {value for line in (lane.actual, lane.expected) if line for value in _values(lane, line) if not math.isnan(value)}
    return sorted(values) if values and all(value in lane.actual.signal.choices for value in values) else None


def _values(lane: Lane, line: Line) -> list[float]:
    """The values of a line of a lane; words of the expected signal stand where those of the actual one do."""
    raws = pairs.translation(lane.actual.signal, line.signal) if line is lane.expected else {}
    return [raws.get(value, value) for value in line.values]


def _lane_height(lane: Lane) -> float:
    states = _states(lane)
    return LANE_IN if states is None else max(0.26, STATE_IN * len(states))


def _draw_lane(axis: Any, lane: Lane, origin_ns: int, length_s: float, scale: float) -> None:
    states = _states(lane)
    ranks = {value: rank for rank, value in enumerate(states)} if states is not None else None
    for line, style in ((lane.expected, EXPECTED_STYLE | {"zorder": 3}),
                        (lane.actual, (EXPECTED_STYLE if _is_command(lane) else ACTUAL_STYLE) | {"zorder": 2})):
        if line is None:
            continue
        times = [*((t_ns - origin_ns) / 1e9 / scale for t_ns in line.times_ns), length_s / scale]
        values = _values(lane, line)
        values.append(values[-1])
        if ranks is not None:
            values = [math.nan if math.isnan(value) else ranks[value] for value in values]
        axis.step(times, values, where="post", **style)
        _draw_missing(axis, line, times)
    signal = lane.actual.signal
    unit = f"  [{signal.unit}]" if signal.unit else ""
    name = f"{lane.actual.message.name}.{signal.name}{unit}"
    if lane.expected is not None:
        name += f"   and expected: {lane.expected.message.name}.{lane.expected.signal.name}"
    axis.set_title(name, loc="left", fontsize=8, pad=2.5, color=INK)
    if states is not None:
        axis.set_yticks(range(len(states)), [signal.choices[int(value)] for value in states], fontsize=7)
        axis.set_ylim(-0.4, max(len(states) - 1, 0) + 0.4)
    else:
        _number_ticks(axis, lane)


def _draw_missing(axis: Any, line: Line, times: Sequence[float]) -> None:
    """Where there was no value, and why."""
    for word, start, end in zip(line.words, times, times[1:], strict=False):
        if word:
            colour = MISSING_COLOURS.get(word, EXPECTED)
            axis.axvspan(start, end, ymin=0.32, ymax=0.68, facecolor="none", edgecolor=colour, hatch="////", linewidth=0, alpha=0.7)
            if end - start > times[-1] * 0.08:
                axis.text((start + end) / 2, 0.5, word, transform=axis.get_xaxis_transform(), ha="center", va="center", fontsize=7,
                          color=colour, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})


def _number_ticks(axis: Any, lane: Lane) -> None:
    values = [value for line in (lane.actual, lane.expected) if line for value in line.values if math.isfinite(value)]
    if not values:
        axis.set_yticks([])
        return
    low, high = min(values), max(values)
    room = (high - low) * 0.12 or max(abs(high), 1.0) * 0.1
    axis.set_ylim(low - room, high + room)
    axis.set_yticks([low, high] if high > low else [low], [f"{value:.5g}" for value in ([low, high] if high > low else [low])],
                    fontsize=7)


def _draw_alarms(axis: Any, told: Sequence[Story], shown: Sequence[str], length_s: float, scale: float) -> None:
    axis.set_title("Alarms", loc="left", fontsize=8, pad=2.5, color=INK)
    rows = {alarm: len(shown) - 1 - number for number, alarm in enumerate(shown)}
    least = length_s * 0.002
    for story in told:
        if story.alarm not in rows:
            continue
        row = rows[story.alarm]
        axis.broken_barh([(story.start / scale, max(story.end - story.start, least) / scale)], (row - 0.3, 0.6),
                         facecolors=PRIORITY_COLOURS[story.priority], zorder=2)
        if story.locked is not None:
            axis.broken_barh([(story.locked / scale, max(story.end - story.locked, least) / scale)], (row - 0.3, 0.6),
                             facecolors=LOCKED, zorder=3)
        for t, word in story.marks:
            marker, colour, _ = MARKS[word]
            axis.plot([t / scale], [row + MARK_OFFSETS.get(word, 0.0)], marker=marker, markersize=6, color=colour,
                      markeredgecolor="white", markeredgewidth=0.7, linestyle="none", zorder=4, clip_on=False)
    axis.set_yticks(list(rows.values()), list(rows), fontsize=8)
    axis.set_ylim(-0.6, max(len(shown), 1) - 0.4)
    if not told:
        axis.set_yticks([])
        axis.text(0.5, 0.5, "no alarm", transform=axis.transAxes, ha="center", va="center", fontsize=9, color="#2f9e44")


def _dress(axis: Any, length: float, *, last: bool) -> None:
    axis.set_xlim(0, length)
    axis.locator_params(axis="x", nbins=10, steps=[1, 2, 5, 10])
    axis.grid(axis="x", color=GRID, zorder=0)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axis.spines[side].set_color("#ced4da")
    axis.tick_params(length=2, color="#ced4da", labelsize=8 if last else 7, labelbottom=last)


def _is_command(lane: Lane) -> bool:
    return lane.actual.message.sent_by_ucs


def _handles(told: Sequence[Story], drawn: Sequence[Lane]) -> list[Any]:
    """What the legend says: only what the picture has."""
    lines, patches = (importlib.import_module(f"matplotlib.{name}") for name in ("lines", "patches"))
    handles = [lines.Line2D([], [], label="actual", **ACTUAL_STYLE)]
    if any(lane.expected or _is_command(lane) for lane in drawn):
        handles.append(lines.Line2D([], [], label="commanded", **EXPECTED_STYLE))
    priorities = {story.priority for story in told}
    handles += [patches.Patch(color=colour, label=f"alarm, {name.lower()}" if name != "Event" else "event, no fault")
                for name, colour in PRIORITY_COLOURS.items() if name in priorities]
    if any(story.locked is not None for story in told):
        handles.append(patches.Patch(color=LOCKED, label="locked out"))
    words = {word for story in told for _, word in story.marks}
    return handles + [lines.Line2D([], [], marker=marker, color=colour, linestyle="none", markersize=6.5, label=label)
                      for word, (marker, colour, label) in MARKS.items() if word in words and word != "locked_out"]


def _draw_path(axis: Any, path: tuple[list[int], list[float], list[float]], told: Sequence[Story], shown: Sequence[str],
               origin_ns: int) -> None:
    times = [(t_ns - origin_ns) / 1e9 for t_ns in path[0]]
    east, north = path[1], path[2]
    axis.plot(east, north, color="#adb5bd", linewidth=1.2, zorder=1, label="path")
    stood = {alarm: sum(story.end - story.start for story in told if story.alarm == alarm) for alarm in shown}
    for rank, alarm in enumerate(sorted(shown, key=lambda alarm: -stood[alarm])):
        width = min(PATH_POINTS + PATH_STEP_POINTS * (len(shown) - 1 - rank), PATH_MOST_POINTS)
        label: str | None = alarm
        for story in (story for story in told if story.alarm == alarm):
            _draw_story(axis, story, times, (east, north), PATH_COLOURS[rank % len(PATH_COLOURS)], width, label)
            label = None
    known = [place for place, value in enumerate(east) if not math.isnan(value)]
    for place, text in ((known[0], "start"), (known[-1], "end")):
        axis.plot(east[place], north[place], marker="o", markersize=7, color="white", markeredgecolor=INK, zorder=3)
        axis.annotate(text, (east[place], north[place]), xytext=(0, 8), textcoords="offset points", ha="center",
                      fontsize=8, color=INK)
    axis.set_title("Path, with the alarms where they stood (▼ raised)", loc="left", fontsize=9, color=INK)
    axis.set_aspect("equal", adjustable="box", anchor="NW")
    axis.set_xlabel("m to the east of the start", fontsize=9)
    axis.set_ylabel("m to the north", fontsize=9)
    axis.grid(color=GRID)
    axis.set_axisbelow(True)
    axis.tick_params(labelsize=8, length=2)
    axis.margins(0.08)
    legend = axis.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize=8, frameon=False, borderaxespad=0)
    for handle in legend.legend_handles:
        handle.set_linewidth(min(handle.get_linewidth(), LEGEND_POINTS))


def _draw_story(axis: Any, story: Story, times: Sequence[float], place: tuple[Sequence[float], Sequence[float]], colour: str,
                width: float, label: str | None) -> None:
    east, north = place
    inside = [number for number, t in enumerate(times) if story.start <= t <= story.end] or [_nearest(times, story.start)]
    axis.plot([east[number] for number in inside], [north[number] for number in inside], color=colour, zorder=2, linewidth=width,
              solid_capstyle="butt", label=label)
    axis.plot(east[inside[0]], north[inside[0]], marker="v", markersize=8, color=colour, markeredgecolor="white", zorder=4)
    for t, word in story.marks:
        if word in ("repaired", "locked_out"):
            marker, mark_colour, _ = MARKS[word]
            number = _nearest(times, t)
            axis.plot(east[number], north[number], marker=marker, markersize=6.5, color=mark_colour, markeredgecolor="white",
                      markeredgewidth=0.7, linestyle="none", zorder=5)


def _nearest(times: Sequence[float], t: float) -> int:
    return min(range(len(times)), key=lambda place: abs(times[place] - t))


def _moved(east: Sequence[float], north: Sequence[float]) -> bool:
    """Whether there is a path worth a picture: more than a metre."""
    spans = [max(known) - min(known) for values in (east, north) if (known := [value for value in values if not math.isnan(value)])]
    return max(spans, default=0.0) > 1.0


def _matplotlib() -> Any:
    try:
        return importlib.import_module("matplotlib.figure")
    except ImportError:
        raise OutsideError("--plot needs a package more: pip install 'tractor-ucs[plot]'") from None
