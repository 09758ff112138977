"""Signals as columns: raw values, classes and values of a whole block of frames at once, and where they change.

The counterpart of `decode`'s handlers and of `Board.touch` for recordings. What a class is, and what it means, stands in
`decode.Classes` alone; here raw values are only compared with its cuts.
"""
from __future__ import annotations

import math
from decimal import Decimal
from typing import Any

import numpy as np
import numpy.typing as npt

from level1.block import Block, Ints, Words
from level1.board import BAD, Cell
from level1.catalog import Signal
from level1.decode import ERROR, GOOD, SHORT, first_bit, last_byte, raw_range

EXACT_BITS = 53
"""Integers up to 2**53 are exact as binary64 too: within them, columns compute what Python's integers do."""
FEW_CUTS = 6
"""Up to so many cuts, comparing with each is faster than a binary search for each raw value."""

_BAD = np.array(BAD, np.uint8)
_FLOATS = {16: "<f2", 32: "<f4", 64: "<f8"}

Numbers = npt.NDArray[Any]
"""Numbers of classes: bytes where they fit."""


class Column:
    """What a cell (a signal, or the silence of a message) was over a block.

    slots: where it changed, rising; the other arrays have one element more, the first for what it was before. k: class.
    value, bad: for arithmetic, of exact cells alone; None where columns can't hold the values exactly (`numeric`).
    The same names without `s` are what a compiled condition reads (`column_condition`).
    """

    __slots__ = ("bad", "bads", "cell", "k", "ks", "numeric", "slots", "value", "values")

    def __init__(self, cell: Cell, numeric: bool):
        self.cell = cell
        self.numeric = numeric
        self.slots: Ints = _NO_SLOTS
        self.ks: npt.NDArray[Any] = _NO_SLOTS
        self.bads: npt.NDArray[Any] = _NO_SLOTS
        self.values: npt.NDArray[Any] = _NO_SLOTS
        self.k: Any = 0
        self.bad: Any = 0
        self.value: Any = 0

    def rest(self) -> None:
        """Nothing has changed: the cell is as it is."""
        self.slots = _NO_SLOTS
        cell = self.cell
        self.ks = np.array([cell.k])
        if self.numeric:
            self.bads = np.array([cell.bad], np.uint8)
            self.values = np.array([cell.value])

    def at(self, counts: Ints) -> None:
        """Set what conditions read to what it was after so many of its changes."""
        self.k = self.ks[counts]
        if self.numeric:
            self.bad = self.bads[counts]
            self.value = self.values[counts]


_NO_SLOTS: Ints = np.zeros(0, np.int64)


class Bits:
    """Where a signal lies. window: first byte of the eight payload bytes that hold it; need: bytes a payload must have for it.

    Raises Unsupported for a signal that no eight bytes hold.
    """

    __slots__ = ("_big", "_mask", "_shift", "_sign", "need", "window")

    def __init__(self, signal: Signal):
        self.window, self._shift = _place(signal)
        self.need = last_byte(signal) + 1
        self._big = signal.big_endian
        self._mask = np.uint64((1 << signal.length) - 1)
        self._sign = np.uint64(1 << signal.length - 1) if signal.signed else np.uint64(0)

    def of(self, words: Words) -> Words:
        """Raw values out of the payload words of its window: the bits of a float, else how far it is above the lowest one."""
        if self._big:
            words = words.byteswap()
        raws: Words = words >> np.uint64(self._shift) if self._shift else words
        raws = raws & self._mask
        return raws ^ self._sign if self._sign else raws


class SignalColumn(Column):
    """The column of a signal. Raises Unsupported as `Bits` does."""

    __slots__ = ("_cuts", "_float", "_limits", "_qualities", "bits")

    def __init__(self, cell: Cell):
        signal = cell.signal
        super().__init__(cell, cell.exact and _is_numeric(cell))
        self.bits = Bits(signal)
        self._float = _FLOATS[signal.length] if signal.is_float else ""
        self._limits = _float_limits(signal)
        bottom = raw_range(signal)[0]
        self._cuts = np.array([cut - bottom for cut in cell.classes.cuts] if not signal.is_float else [], np.uint64)
        self._qualities = np.array((GOOD, ERROR) if signal.is_float else cell.classes.quality, np.uint8)

    def stays(self, words: Words) -> bool:
        """Whether the signal stays in its present class through all these frames; a quick look that most signals need."""
        cell = self.cell
        if cell.exact or cell.k >= cell.base:
            return False
        raws = self.bits.of(words)
        k, cuts = cell.k, self._cuts
        return bool((not k or raws.min() >= cuts[k - 1]) and (k == len(cuts) or raws.max() < cuts[k]))

    def follow(self, words: Words, short: npt.NDArray[np.bool_] | None, losses: Ints, old: int) -> tuple[Ints, Ints]:
        """Take in the frames of a block whose payload has changed, the first after each loss among them.

        words: of its window; short: which payloads end before the signal, None for none. losses: places among these frames
        before which the signal was lost; old: its class then. Gives the places at which it changes, and where among them the
        losses belong; `slots` is to be set from these.
        """
        cell = self.cell
        raws = self.bits.of(words)
        ks = self._classes(raws)
        if short is not None:
            ks[short] = cell.base + SHORT
        changed = np.empty(len(raws), bool)
        np.not_equal(ks[1:], ks[:-1], out=changed[1:])
        changed[:1] = cell.exact or ks[:1] != cell.k
        if cell.exact:
            changed[1:] |= raws[1:] != raws[:-1]
        changed[losses[losses < len(raws)]] = True
        keep = np.flatnonzero(changed)
        ks, raws = ks[keep], raws[keep]
        at = keep.searchsorted(losses)
        if len(losses):
            ks = np.insert(ks, at, old)
            raws = np.insert(raws, at, 0)
        self.ks = np.concatenate((np.array([cell.k], ks.dtype), ks))
        if self.numeric:
            self._fill(raws, ks)
        return keep, at

    def _classes(self, raws: Words) -> Numbers:
        if self._float:
            return self._float_classes(raws)
        cuts = self._cuts
        if len(cuts) > FEW_CUTS:
            return cuts.searchsorted(raws, "right").astype(np.uint8 if len(cuts) < 240 else np.uint16)
        ks = np.zeros(len(raws), np.uint8)
        for cut in cuts:
            ks += (raws >= cut).view(np.uint8)
        return ks

    def _floats(self, raws: Words) -> npt.NDArray[np.float64]:
        size = self.cell.signal.length // 8
        with np.errstate(invalid="ignore"):
            return raws.astype(f"<u{size}").view(self._float).astype(np.float64)

    def _float_classes(self, raws: Words) -> Numbers:
        values = self._floats(raws)
        signal = self.cell.signal
        with np.errstate(invalid="ignore", over="ignore"):
            physical = values * float(signal.factor) + float(signal.offset)
            good = np.isfinite(values) & ~(physical < self._limits[0]) & ~(physical > self._limits[1])
        return (~good).view(np.uint8)

    def _fill(self, raws: Words, ks: Numbers) -> None:
        """Values and badness of the changes."""
        cell, scale = self.cell, self.cell.scale
        without = ks >= cell.base
        qualities = np.where(without, ks.astype(np.int64) - cell.base, self._qualities[np.where(without, 0, ks)])
        bads = _BAD[qualities]
        values: npt.NDArray[Any]
        if self._float:
            with np.errstate(invalid="ignore", over="ignore"):
                values = self._floats(raws) * scale.numerator + scale.shift
        else:
            values = (raws.astype(np.int64) + raw_range(cell.signal)[0]) * scale.numerator + scale.shift
        if scale.denominator != 1:
            values = values / scale.denominator
        values[bads != 0] = 0
        self.bads = np.concatenate((np.array([cell.bad], np.uint8), bads))
        self.values = np.concatenate((np.array([cell.value], values.dtype), values))


class Unsupported(Exception):
    """Columns can't hold or compute this exactly; it is left to the closures."""


def _place(signal: Signal) -> tuple[int, int]:
    """First byte of the window a signal lies in, and the shift to its lowest bit there."""
    first = first_bit(signal)
    if first + signal.length <= 64:
        window = 0
    elif first % 8 + signal.length <= 64:
        window = first // 8
    else:
        raise Unsupported(f"{signal.name} touches nine bytes")
    inside = first - 8 * window
    return window, 64 - inside - signal.length if signal.big_endian else inside


def _is_numeric(cell: Cell) -> bool:
    """Whether all its values, and all steps to them, are exact."""
    signal, scale = cell.signal, cell.scale
    largest = 1 << EXACT_BITS
    if scale.denominator > largest or abs(scale.numerator) > largest or abs(scale.shift) > largest:
        return False
    if signal.is_float:
        return True
    farthest = max(map(abs, raw_range(signal)))
    return signal.length <= EXACT_BITS and farthest * abs(scale.numerator) + abs(scale.shift) <= largest


def _float_limits(signal: Signal) -> tuple[float, float]:
    """Lowest and highest floats within the exact decimal limits of a float signal."""
    low, high = -math.inf, math.inf
    if signal.minimum is not None:
        low = float(signal.minimum)
        if Decimal(low) < signal.minimum:
            low = math.nextafter(low, math.inf)
    if signal.maximum is not None:
        high = float(signal.maximum)
        if Decimal(high) > signal.maximum:
            high = math.nextafter(high, -math.inf)
    return low, high


def changed_payloads(block: Block, rows: Ints, windows: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """For all rows but the first, whether the payload differs from that of the row before, as far as these windows show."""
    lengths = block.length[rows]
    changed: npt.NDArray[np.bool_] = lengths[1:] != lengths[:-1]
    for words in block.windows(rows, windows).values():
        changed |= words[1:] != words[:-1]
    return changed
