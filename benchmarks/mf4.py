"""Writes a BLF recording again as MF4, in the layout of python-can's `MF4Writer` but thousands of frames at a time.

A program of its own, because it needs asammdf: `python -m benchmarks.mf4 drive.blf drive.mf4`.
"""
from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Any

import can
import numpy as np
from asammdf import MDF, Signal
from asammdf.blocks.source_utils import Source
from can.io.mf4 import STD_DTYPE

ROWS = 100_000


def main(source: str, target: str) -> None:
    """Copy all data frames."""
    with can.LogReader(source) as reader:
        messages: Iterator[can.Message] = iter(reader)
        mdf: Any = MDF(version="4.10")
        start_s = None
        while rows := list(itertools.islice(messages, ROWS)):
            if start_s is None:
                start_s = rows[0].timestamp // 1
                mdf.header.start_time = datetime.fromtimestamp(start_s, UTC)
                mdf.append(Signal(name="CAN_DataFrame", samples=_samples(rows), timestamps=_stamps(rows, start_s),
                                  source=Source("CAN", "", "", Source.SOURCE_BUS, Source.BUS_TYPE_CAN)))
            else:
                mdf.extend(0, [(_stamps(rows, start_s), None), (_samples(rows), None)])
    mdf.save(target, compression=2, overwrite=True)
    mdf.close()


def _stamps(rows: Sequence[can.Message], start_s: float) -> Any:
    return np.round(np.array([row.timestamp for row in rows]) - start_s, 6)


def _samples(rows: Sequence[can.Message]) -> Any:
    samples = np.zeros(len(rows), STD_DTYPE)
    for name, values in {"ID": [row.arbitration_id for row in rows], "IDE": [row.is_extended_id for row in rows],
                         "DLC": [can.util.len2dlc(row.dlc) for row in rows], "DataLength": [len(row.data) for row in rows],
                         "EDL": [row.is_fd for row in rows]}.items():
        samples[f"CAN_DataFrame.{name}"] = values
    data = np.frombuffer(b"".join(bytes(row.data).ljust(64, b"\0") for row in rows), np.uint8)
    samples["CAN_DataFrame.DataBytes"] = data.reshape(-1, 64)
    return samples


if __name__ == "__main__":
    main(*sys.argv[1:])
