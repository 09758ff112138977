"""`ucs journal --monitor`: the monitoring history of a unit."""
from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from level1.event import Monitor, encode
from level1.io.error import OutsideError, did_you_mean
from level1.io.journal_monitor import HistoryReader

if TYPE_CHECKING:
    from ucs.journal import Query

CSV_COLUMNS = ("unit", "boot", "t", "utc", "utc_trusted", "message", "values", "age_s", "quality")
GOOD = "good"
LATEST = 10
"""Batches that are looked through for the names there are."""
_json = msgspec.json.Encoder(decimal_format="number")


def show(path: Path, message: str, query: Query, last: int | None, form: str, values: bool) -> int:
    """Print the samples that were asked for, oldest first. path: of the journal; message: "" for all. Raises OutsideError."""
    with HistoryReader(path) as reader:
        found = _samples(reader, message or None, query)
        if last is not None:
            backwards = _samples(reader, message or None, query, backwards=True)
            found = iter(list(islice(backwards, last))[::-1])
        write = {"text": _text_writer(values), "jsonl": _write_json, "csv": _csv_writer()}[form]
        count = 0
        for sample in found:
            write(sample)
            count += 1
        if not count:
            _tell_why(reader, message)
        if reader.unreadable:
            print(f"ucs journal: {reader.unreadable} batches can't be read", file=sys.stderr)
    return 0


def _samples(reader: HistoryReader, message: str | None, query: Query, backwards: bool = False) -> Iterator[Monitor]:
    step = -1 if backwards else 1
    for number in reader.batches(query.boot, query.since, query.until)[::step]:
        yield from filter(query.in_time, reader.samples(number, message)[::step])


def _tell_why(reader: HistoryReader, message: str) -> None:
    """Nothing was found: perhaps for a name that nobody has."""
    numbers = reader.batches()
    names = {sample.message for number in numbers[-LATEST:] for sample in reader.samples(number)} if message else set()
    if message and names and message not in names:
        raise OutsideError(f'--monitor "{message}": no such monitoring message{did_you_mean(message, names)}')
    print("ucs journal: nothing of the kind" if numbers else "ucs journal: nothing yet", file=sys.stderr)


def _text_writer(values: bool) -> Callable[[Monitor], None]:
    """A line a sample, `Speed=1.5`, what is not good as `Speed=(stale)`. values: a line a signal, with age and quality."""
    def write(sample: Monitor) -> None:
        unsure = " (clock not synchronised)" * (sample.utc is not None and not sample.utc_trusted)
        quality = sample.quality
        told = "" if values else "".join(f" {name}={value if quality[name] == GOOD else f'({quality[name]})'}"
                                         for name, value in sample.values.items())
        print(f"{sample.utc or f'{sample.t:.3f} s'}  {sample.boot}  {sample.message}{' ' * bool(told)}{told}{unsure}")
        for name, value in sample.values.items() if values else ():
            age_s = sample.age_s[name]
            age = "never received" if age_s is None else f"{age_s:.3f} s old"
            print(f"    {name} = {value if quality[name] == GOOD else '-'} ({quality[name]}, {age})")
    return write


def _write_json(sample: Monitor) -> None:
    print(encode(sample).decode())


def _csv_writer() -> Callable[[Monitor], None]:
    """Columns as the keys of a monitoring message; values, ages and qualities as JSON in one cell each."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    started = False

    def write(sample: Monitor) -> None:
        nonlocal started
        if not started:
            writer.writerow(CSV_COLUMNS)
            started = True
        cells = {name: getattr(sample, name) for name in CSV_COLUMNS}
        writer.writerow((cells | {name: _json.encode(cells[name]).decode() for name in CSV_COLUMNS[-3:]}).values())
    return write
