"""Reports of `ucs diff` as HTML: tables, and each recording with its alarms as bars along time. Nothing is fetched from outside."""
from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path

from ucs.comparison import Comparison, Recorded, rate_rows, span_text
from ucs.spans import Behaviour, Span

WIDTH, LABEL, ROW = 760, 190, 26
OLD, NEW = "#adb5bd", "#1864ab"
COLOURS = {"appeared": "#2b8a3e", "vanished": "#c92a2a"}
MOST_PICTURES = 200
"""Recordings drawn at most, those with differences first; the tables hold all."""


def comparison_html(compared: Comparison) -> str:
    """The report of a comparison."""
    total = sum(map(len, compared.changes.values()))
    body = [f"<h1>Alarms: {escape(compared.old.name)} against {escape(compared.new.name)}</h1>",
            f"<p>{_recordings(len(compared.recorded))}, {compared.hours:.2f} h. "
            f"<b>{total or 'No'} difference{'' if total == 1 else 's'}{_kinds(compared)}.</b></p>",
            *(f"<p class=small>{side.name}: {escape(', '.join(side.files))}</p>" for side in (compared.old, compared.new)),
            _alarm_table(compared), _rate_table(compared)]
    if total:
        body += ["<h3>Differences</h3>", _change_table(compared)]
    drawn = sorted(compared.recorded, key=lambda each: -len(compared.changes[each.path]))
    drawn = [each for each in drawn if compared.old.found[each.path] or compared.new.found[each.path]]
    if drawn:
        body.append(f'<h3>Recordings with alarms</h3><p class="small"><span style="color:{OLD}">■</span> old '
                    f'<span style="color:{NEW}">■</span> new; a bar without end stood when the recording ended.</p>')
    body += [_picture(compared, each) for each in drawn[:MOST_PICTURES]]
    if len(drawn) > MOST_PICTURES:
        body.append(f"<p>{len(drawn) - MOST_PICTURES} more recordings are in the tables only.</p>")
    return _page("ucs diff", body)


def _recordings(count: int) -> str:
    return f"{count} recording{'s' * (count != 1)}"


def sweep_html(alarm: str, attribute: str, rows: Sequence[tuple[str, Behaviour]], hours: float, recordings: int) -> str:
    """The report of a sweep: activations over the values tried."""
    most = max((found.raised for _, found in rows), default=0) or 1
    bars = []
    for place, (value, found) in enumerate(rows):
        y, width = 20 + ROW * place, 400 * found.raised / most
        bars.append(f'<text x="{LABEL - 8}" y="{y + 14}" text-anchor="end" font-size="12">{escape(value)}</text>'
                    f'<rect x="{LABEL}" y="{y}" width="{max(width, 1):.1f}" height="18" rx="3" fill="{NEW}"/>'
                    f'<text x="{LABEL + width + 8:.1f}" y="{y + 14}" font-size="12">{found.raised} '
                    f"({found.per_hour:.2f} per hour)</text>")
    cells = "".join(f"<tr><td>{escape(value)}</td><td>{found.raised}</td><td>{found.per_hour:.2f}</td>"
                    f"<td>{found.standing_s:.1f} s</td><td>{found.chatter}</td></tr>" for value, found in rows)
    return _page("ucs diff --sweep", [
        f"<h1>{escape(alarm)}: {escape(attribute)}</h1><p>{_recordings(recordings)}, {hours:.2f} h</p>",
        f'<figure><svg viewBox="0 0 {WIDTH} {30 + ROW * len(rows)}" font-family="sans-serif">{"".join(bars)}</svg></figure>',
        f"<table><tr><th>{escape(attribute)}</th><th>raised</th><th>per hour</th><th>standing</th><th>chattered</th></tr>{cells}"
        "</table>"])


def _page(title: str, body: Sequence[str]) -> str:
    style = resources.files("ucs").joinpath("handbook.css").read_text(encoding="utf-8")
    return (f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
            f"<style>{style}</style><body class=wide>{''.join(body)}</body></html>")


def _kinds(compared: Comparison) -> str:
    kinds = compared.kinds()
    return ": " + ", ".join(f"{count} {what}" for what, count in kinds.items()) if kinds else ""


def _rate_table(compared: Comparison) -> str:
    if not compared.alarms():
        return ""
    rows = "".join(f"<tr><td>{name}</td><td>{old}</td><td>{new}</td><td>{asked}</td></tr>"
                   for name, old, new, asked in rate_rows(compared))
    return ("<h3>For one operator</h3><table><tr><th></th><th>Old</th><th>New</th><th>IEC 62682 asks for</th></tr>"
            f"{rows}</table>")


def _where(compared: Comparison, place: tuple[str, float] | None) -> str:
    """A recording and the time in it."""
    if place is None:
        return ""
    start = next(each.start for each in compared.recorded if each.path == place[0])
    return f"{escape(Path(place[0]).name)} {place[1] - start:.1f} s"


def _alarm_table(compared: Comparison) -> str:
    rows = []
    for alarm in compared.alarms():
        old, new = (compared.behaviour(side, alarm) for side in (compared.old, compared.new))
        strong = "b" if old.raised != new.raised else "span"
        rows.append(f"<tr><td>{escape(alarm)}</td><td>{old.raised}</td><td><{strong}>{new.raised}</{strong}></td>"
                    f"<td>{old.per_hour:.2f} → {new.per_hour:.2f}</td><td>{old.standing_s:.0f} → {new.standing_s:.0f} s</td>"
                    f"<td>{old.chatter} → {new.chatter}</td><td>{old.stale} → {new.stale}</td>"
                    f"<td>{old.locked_out} → {new.locked_out}</td><td>{_where(compared, new.first or old.first)}</td>"
                    f"<td>{_where(compared, new.last or old.last)}</td></tr>")
    if not rows:
        return "<p>No alarm on either side.</p>"
    return ("<h3>Alarms</h3><table><tr><th>Alarm</th><th>Old</th><th>New</th><th>Per hour</th><th>Standing</th><th>Chattered</th>"
            f"<th>Stale</th><th>Locked out</th><th>First</th><th>Last</th></tr>{''.join(rows)}</table>")


def _change_table(compared: Comparison) -> str:
    rows = "".join(f"<tr><td>{escape(Path(each.path).name)}</td><td>{escape(change.alarm)}</td>"
                   f"<td style=\"color:{COLOURS.get(change.what, 'inherit')}\">{change.what}</td>"
                   f"<td>{escape(span_text(each, change))}</td></tr>"
                   for each in compared.recorded for change in compared.changes[each.path])
    return f"<table><tr><th>Recording</th><th>Alarm</th><th>What</th><th>Old → new</th></tr>{rows}</table>"


def _picture(compared: Comparison, each: Recorded) -> str:
    sides = [compared.old.found[each.path], compared.new.found[each.path]]
    alarms = sorted({span.alarm for found in sides for span in found})
    length = max(each.last - each.start, 1e-9)
    parts = []
    for row, alarm in enumerate(alarms):
        y = 24 + ROW * row
        parts.append(f'<text x="{LABEL - 8}" y="{y + 13}" text-anchor="end" font-size="11">{escape(alarm)}</text>'
                     f'<line x1="{LABEL}" x2="{WIDTH}" y1="{y + 20}" y2="{y + 20}" stroke="#e9ecef"/>')
        for found, colour, shift in zip(sides, (OLD, NEW), (0, 9), strict=True):
            parts += [_bar(span, each, length, y + shift, colour) for span in found if span.alarm == alarm]
    anchors = ("start", "middle", "middle", "middle", "end")
    ticks = "".join(f'<text x="{LABEL + (WIDTH - LABEL) * n / 4:.0f}" y="14" font-size="10" fill="#868e96" '
                    f'text-anchor="{anchor}">{length * n / 4:.1f} s</text>' for n, anchor in enumerate(anchors))
    return (f"<figure><p><b>{escape(Path(each.path).name)}</b></p>"
            f'<svg viewBox="0 0 {WIDTH} {30 + ROW * len(alarms)}" font-family="sans-serif">{ticks}{"".join(parts)}</svg></figure>')


def _bar(span: Span, each: Recorded, length: float, y: float, colour: str) -> str:
    scale = (WIDTH - LABEL) / length
    x, width = LABEL + (span.start - each.start) * scale, max(span.length(each.last) * scale, 2)
    return f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="8" rx="2" fill="{colour}"/>'
