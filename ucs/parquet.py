"""Events as Parquet, a row each, for DuckDB, Polars and the like; needs the extra `parquet`."""
from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Any

import msgspec

from level1.event import Event
from level1.io.error import OutsideError

ROWS = 10_000
"""Rows that are held until they are written."""

_json = msgspec.json.Encoder(decimal_format="number")


class EventTable:
    """A file being written. Columns: recording, side (of a comparison), then the keys of an event in their order; `t` as a
    decimal with nine places, `utc` as a time stamp, `values` as JSON."""

    def __init__(self, pyarrow: Any, writer: Any):
        self._pyarrow, self._writer = pyarrow, writer
        self._rows: list[dict[str, Any]] = []

    def add(self, recording: str, events: Iterable[Event], side: str | None = None) -> None:
        """Events of a recording, in order."""
        for event in events:
            row = {name: getattr(event, name) for name in event.__struct_fields__}
            row |= {"recording": recording, "side": side, "values": _json.encode(event.values).decode(),
                    "utc": datetime.fromisoformat(event.utc) if event.utc else None,
                    "frames": [{"message": frame.message, "id": frame.id, "data": frame.data} for frame in event.frames]}
            self._rows.append(row)
        if len(self._rows) >= ROWS:
            self.flush()

    def flush(self) -> None:
        """Write what is held."""
        if self._rows:
            self._writer.write_table(self._pyarrow.Table.from_pylist(self._rows, schema=self._writer.schema))
            self._rows = []


@contextmanager
def table(path: str) -> Iterator[EventTable]:
    """The file, finished at the end. Raises OutsideError when it can't be written, or the package is missing."""
    try:
        pyarrow: Any = importlib.import_module("pyarrow")
        files: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise OutsideError("--parquet needs a package more: pip install 'tractor-ucs[parquet]'") from None
    try:
        writer = files.ParquetWriter(path, _schema(pyarrow), compression="zstd")
    except OSError as error:
        raise OutsideError(f"{path}: can't be written: {error.strerror or error}") from None
    with writer:
        events = EventTable(pyarrow, writer)
        yield events
        events.flush()


def _schema(pyarrow: Any) -> Any:
    text, number, truth = pyarrow.string(), pyarrow.int64(), pyarrow.bool_()
    frame = pyarrow.struct([("message", text), ("id", text), ("data", text)])
    return pyarrow.schema([
        ("recording", text), ("side", text), ("unit", text), ("boot", number), ("seq", number), ("t", pyarrow.decimal128(20, 9)),
        ("utc", pyarrow.timestamp("us", tz="UTC")), ("utc_trusted", truth), ("alarm", text), ("code", pyarrow.int32()),
        ("priority", text), ("event", text), ("instance", number), ("attempt", pyarrow.int32()), ("values", text), ("text", text),
        ("frames", pyarrow.list_(frame)), ("passive", truth)])
