"""The alarm handbook: for each alarm a page that can be handed to a driver (IEC 62682 rationalisation), made from the DBC.

HTML that prints, with its drawings inside and nothing fetched from outside; or Markdown, the same without drawings.
"""
from __future__ import annotations

from collections.abc import Iterator
from html import escape
from importlib import resources

from level1.catalog import Alarm, Catalog
from level1.condition import walk
from level1.decode import raw_range
from level1.event import PRIORITIES
from level1.expression import Boolean, ExpectStep, ResendStep, SendStep, SignalValue, WaitStep
from ucs.words import Words, abbreviated, duration, spaced

MEANINGS = {
    "Critical": "Stop and act at once.", "High": "Act now.", "Medium": "Act soon.", "Low": "Take note; act when convenient.",
    "Event": "For information: nothing is wrong.",
}
COLOURS = {"Critical": "#b3001b", "High": "#d9480f", "Medium": "#b08900", "Low": "#1864ab", "Event": "#495057"}
def alarms_by_priority(catalog: Catalog) -> list[Alarm]:
    """The worst first, then by code."""
    return sorted(catalog.alarms.values(), key=lambda alarm: (-PRIORITIES.index(alarm.priority), alarm.code))


# --- HTML ---------------------------------------------------------------------------------------------------------------------


def html(catalog: Catalog, title: str = "Alarm handbook") -> str:
    """The handbook as one HTML file."""
    words = Words(catalog)
    alarms = alarms_by_priority(catalog)
    style = resources.files("ucs").joinpath("handbook.css").read_text(encoding="utf-8")
    rows = "".join(
        f'<tr style="--c:{COLOURS[alarm.priority]}"><td>{alarm.code}</td>'
        f'<td><a href="#a{alarm.code}"><b>{escape(_title(alarm))}</b></a></td>'
        f'<td><span class="badge">{alarm.priority}</span></td><td>{escape(alarm.action or "-")}</td></tr>' for alarm in alarms)
    legend = "".join(f'<p><span class="badge" style="--c:{COLOURS[word]}">{word}</span> {MEANINGS[word]}</p>'
                     for word in reversed(PRIORITIES))
    files = ", ".join(escape(file.rsplit("/", 1)[-1]) for file in catalog.files)
    pages = "".join(_page(alarm, catalog, words) for alarm in alarms)
    return (f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title><style>{style}</style><body>'
            f"<h1>{escape(title)}</h1><p class=small>{len(alarms)} alarms, defined by {files}</p>{legend}"
            f"<h3>All alarms</h3><table><tr><th>Code</th><th>Alarm</th><th>Priority</th><th>What to do</th></tr>{rows}</table>"
            f"{pages}</body></html>")


def _title(alarm: Alarm) -> str:
    text = spaced(alarm.name)
    return text[0].upper() + text[1:]


def _page(alarm: Alarm, catalog: Catalog, words: Words) -> str:
    parts = [f'<section class="alarm" id="a{alarm.code}" style="--c:{COLOURS[alarm.priority]}"><div class="head">'
             f'<h2>{escape(_title(alarm))}</h2><span class="badge">{alarm.priority}</span> '
             f'<span class="code">alarm {alarm.code} · {escape(alarm.name)} · {MEANINGS[alarm.priority]}</span></div>']
    if alarm.action:
        parts.append(f'<h3>What to do</h3><div class="do">{escape(alarm.action)}</div>')
    for heading, text in (("What it means", alarm.cause or alarm.comment), ("What happens if nothing is done", alarm.consequence)):
        if text:
            parts.append(f"<h3>{heading}</h3><p>{escape(text)}</p>")
    parts.append(f"<h3>When</h3><p>{escape(words.raised(alarm))}</p>")
    if alarm.enabled is not None:
        parts.append(f"<p>Only while {escape(words.condition(alarm.enabled))}.</p>")
    parts.append(f"<p>{escape(words.cleared(alarm))}</p>")
    if alarm.repair is not None:
        parts.append(_repair(alarm, words))
    parts += [f"<figure><h3>Its states</h3>{states_svg(alarm)}</figure>", _inputs(alarm, catalog),
              f'<p class="small">Defined in {escape(alarm.file.rsplit("/", 1)[-1])}, line {alarm.line}: '
              f"<code>{escape(alarm.when_text)}</code></p></section>"]
    return "".join(parts)


def _repair(alarm: Alarm, words: Words) -> str:
    assert alarm.repair is not None
    repair = alarm.repair
    steps = "".join(f"<li>{escape(words.step(step))}.</li>" for step in repair.steps)
    give_up = "; ".join(words.step(step) for step in repair.give_up)
    where = " at the machine" if repair.local_reset else ""
    end = f" Then: {escape(give_up)}, held until someone resets the alarm{where}." if give_up else ""
    stopped = "The repair does not start while the unit is stopped or paused from above." if repair.moves else ""
    good = "" if repair.counts_good else ", not counting those that were good,"
    times = "once" if repair.attempts == 1 else f"{repair.attempts} times"
    return (f"<h3>What the tractor tries by itself</h3><ol>{steps}</ol>"
            f"<p>At most {times}{good} within {duration(repair.window_ns)}.{end} A failed attempt goes to the safe state at once. "
            f"{stopped}</p>{repair_svg(alarm)}")


def _inputs(alarm: Alarm, catalog: Catalog) -> str:
    rows = []
    for message_name, name in dict.fromkeys(
            (node.message, node.signal) for part in (alarm.when, alarm.until, alarm.enabled) for node in walk(part)
            if isinstance(node, SignalValue)):
        message = catalog.messages[message_name]
        signal = message.signal(name)
        low, high = (signal.minimum, signal.maximum) if signal.minimum is not None else \
            (raw * signal.factor + signal.offset for raw in raw_range(signal))
        values = ", ".join(signal.choices.values()) or f"{low:f} … {high:f} {signal.unit}"
        cycle = f"every {duration(message.cycle_ns)}" if message.cycle_ns else "when it changes"
        rows.append(f"<tr><td>{escape(name)}</td><td>{escape(message_name)}, {cycle}</td><td>{escape(values)}</td></tr>")
    if not rows:
        return ""
    return f"<h3>What it looks at</h3><table><tr><th>Signal</th><th>Message</th><th>Values</th></tr>{''.join(rows)}</table>"


# --- drawings -----------------------------------------------------------------------------------------------------------------

_BOX = '<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="8" fill="{fill}" stroke="{stroke}" stroke-width="1.6"/>'
_TEXT = ('<text x="{x}" y="{y}" font-size="{size}" text-anchor="{anchor}" fill="{fill}" '
         'font-family="DejaVu Sans, Arial, sans-serif">{text}</text>')


def _text(x: float, y: float, text: str, size: float = 13, anchor: str = "middle", fill: str = "#1b1e21") -> str:
    return _TEXT.format(x=x, y=y, text=escape(text), size=size, anchor=anchor, fill=fill)


def _box(x: float, y: float, text: str, colour: str, w: float = 118) -> str:
    return _BOX.format(x=x, y=y, w=w, h=40, fill="#fff", stroke=colour) + _text(x + w / 2, y + 25, text, 14, fill=colour)


def _arrow(x1: float, y1: float, x2: float, y2: float, *labels: str, above: bool = True, dash: bool = False) -> str:
    style = ' stroke-dasharray="5 4"' if dash else ""
    line = f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" stroke="#495057" stroke-width="1.4" marker-end="url(#tip)"{style}/>'
    middle, base = (x1 + x2) / 2, min(y1, y2) - 7 - 13 * (len(labels) - 1) if above else max(y1, y2) + 15
    return line + "".join(_text(middle, base + 13 * n, label, 11, fill="#495057") for n, label in enumerate(labels))


_TIP = ('<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#495057"/></marker></defs>')


def states_svg(alarm: Alarm) -> str:
    """The states an alarm can be in, and what leads from one to the next."""
    colour = COLOURS[alarm.priority]
    held = f"held {abbreviated(alarm.on_delay_ns)}" if alarm.on_delay_ns else "at once"
    calm = f"calm for {abbreviated(alarm.off_delay_ns)}" if alarm.off_delay_ns else "condition over"
    last = ("and acknowledged on board" if alarm.local_latch else "and acknowledged",) if alarm.latch else ()
    height = 84 if alarm.repair is None else 196
    parts = [f'<svg viewBox="0 0 680 {height}" role="img" aria-label="states">', _TIP, _box(6, 26, "Normal", "#2b8a3e"),
             _box(300, 26, "Active", colour), _arrow(124, 38, 300, 38, f"condition {held}"),
             _arrow(300, 56, 124, 56, calm, *last, above=False)]
    if alarm.repair is not None:
        attempts = f"{alarm.repair.attempts} attempt{'' if alarm.repair.attempts == 1 else 's'}"
        where = " at the machine" if alarm.repair.local_reset else ""
        parts += [_box(556, 26, "Repairing", "#1864ab"), _arrow(418, 38, 556, 38, "repair starts"),
                  _arrow(556, 56, 418, 56, "repaired", above=False), _box(556, 140, "Locked out", "#b3001b"),
                  _arrow(615, 66, 615, 140), _text(607, 98, f"{attempts} failed:", 11, "end", "#495057"),
                  _text(607, 112, "safe state", 11, "end", "#495057"),
                  _arrow(556, 166, 66, 166, f"reset{where}, condition over"),
                  _arrow(66, 166, 66, 66)]
    return "".join(parts) + "</svg>"


def repair_svg(alarm: Alarm) -> str:
    """The steps of a repair along time, each as wide as its share, the short ones legible."""
    assert alarm.repair is not None
    steps = alarm.repair.steps
    x, y, parts = 8.0, 34, []
    room = 664 - 92 * len(steps)
    lengths = [step.duration_ns if isinstance(step, WaitStep) else step.within_ns if isinstance(step, ExpectStep) else 0
               for step in steps]
    total = sum(lengths) or 1
    for number, (step, length) in enumerate(zip(steps, lengths, strict=True), 1):
        kind, fill = {SendStep: ("send", "#d0ebff"), ResendStep: ("send again", "#d0ebff"), WaitStep: ("wait", "#f1f3f5"),
                      ExpectStep: ("check", "#d3f9d8")}[type(step)]
        width = 86 + max(0, room) * length / total
        parts.append(f'<rect x="{x:.1f}" y="{y - 24}" width="{width:.1f}" height="38" rx="5" fill="{fill}" stroke="#adb5bd"/>'
                     + _text(x + width / 2, y - 8, f"{number} {kind}", 12)
                     + _text(x + width / 2, y + 7, _short(length, isinstance(step, ExpectStep)), 10, fill="#5c636a"))
        x += width + 6
    scale = 680 / max(680, x)
    return (f'<svg viewBox="0 0 680 {58 * scale:.0f}" role="img" aria-label="repair sequence"><g transform="scale({scale:.3f})">'
            f'{"".join(parts)}</g></svg>')


def _short(length_ns: int, limit: bool) -> str:
    return ("≤ " if limit else "") + abbreviated(length_ns) if length_ns else "at once"


# --- Markdown -----------------------------------------------------------------------------------------------------------------


def markdown(catalog: Catalog, title: str = "Alarm handbook") -> str:
    """The handbook as Markdown, without drawings."""
    return "\n".join(_markdown_lines(catalog, title)) + "\n"


def _markdown_lines(catalog: Catalog, title: str) -> Iterator[str]:
    words = Words(catalog)
    alarms = alarms_by_priority(catalog)
    yield f"# {title}\n\n| code | alarm | priority | what to do |\n|---|---|---|---|"
    for alarm in alarms:
        yield f"| {alarm.code} | {_title(alarm)} | {alarm.priority} | {alarm.action or '-'} |"
    for alarm in alarms:
        yield f"\n## {alarm.code} {_title(alarm)}\n\n**{alarm.priority}.** {MEANINGS[alarm.priority]}\n"
        for heading, text in (("What to do", alarm.action), ("What it means", alarm.cause or alarm.comment),
                              ("What happens if nothing is done", alarm.consequence)):
            if text:
                yield f"**{heading}.** {text}\n"
        enabled = f" Only while {words.condition(alarm.enabled)}." if alarm.enabled is not None else ""
        yield f"**When.** {words.raised(alarm)}{enabled} {words.cleared(alarm)}\n"
        if alarm.repair is not None:
            yield "**What the tractor tries by itself.**\n"
            yield from (f"{number}. {words.step(step)}." for number, step in enumerate(alarm.repair.steps, 1))
            good = "" if alarm.repair.counts_good else ", not counting those that were good,"
            yield f"\nAt most {alarm.repair.attempts} ×{good} within {duration(alarm.repair.window_ns)}; then the safe state.\n"
        if alarm.when != Boolean(False):
            yield f"`{alarm.when_text}`"
