"""The codec does what cantools does, only faster: for every message of the shipped definitions, values good and bad."""
from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import cantools.database
import pytest

import dbc
from firmware_py.codec import Codec, Value

FILES = sorted(path.name for path in dbc.path("ucs.dbc").parent.glob("*.dbc"))
TRIES = 15


def a_value(dice: random.Random, signal: Any) -> Value:
    """Mostly one that fits; sometimes one at or beyond a limit, or between two steps."""
    if signal.choices and dice.random() < 0.6:
        return str(dice.choice(list(signal.choices.values())))
    top: int = (1 << signal.length) - 1
    raw = dice.choice([0, top, top >> 1, dice.randint(0, top), -1, top + 1])
    exact: float = raw * signal.scale + signal.offset
    chosen: float = dice.choice([float(exact), exact + signal.scale * dice.uniform(-0.6, 0.6), round(exact)])
    return chosen


def outcome(do: Callable[[], Any]) -> Any:
    """What it gives, or the kind of error it raises."""
    try:
        return do()
    except Exception as error:
        return type(error)


def names_of(message: Any, data: bytes) -> list[tuple[str, Value]]:
    """Signals as cantools decodes them, names as texts."""
    return [(name, value if isinstance(value, int | float) else str(value)) for name, value in message.decode(data).items()]


@pytest.mark.parametrize("file", FILES)
def test_packs_and_unpacks_as_cantools_does(file: str) -> None:
    codec, dice, good = Codec.shipped(file), random.Random(file), 0
    peer: Any = cantools.database.can.Database(strict=True)
    peer.add_dbc_string(dbc.path(file).read_text("cp1252"))
    for message in peer.messages:
        for _ in range(TRIES):
            values = {signal.name: a_value(dice, signal) for signal in message.signals}
            encode = partial(message.encode, values, padding=message.is_extended_frame, strict=True)
            found = outcome(partial(codec.encode, message.name, values))
            assert found == outcome(encode), (message.name, values)
            good += isinstance(found, bytes)
            data = dice.randbytes(message.length)
            decoded = outcome(partial(codec.decode, message.name, data))
            shown = [*decoded.items()] if isinstance(decoded, Mapping) else decoded
            assert shown == outcome(partial(names_of, message, data)), message.name
    assert good


def test_a_missing_or_foreign_signal_is_an_error_of_cantools() -> None:
    codec = Codec.shipped("flaming_tool.dbc")
    burners: dict[str, Value] = dict.fromkeys(("Burner1", "Burner2", "Burner3", "Burner4"), "Low")
    for wrong in ({**burners, "Burner5": "Low"}, {"Burner1": "Low"}, {**burners, "Burner1": "Lower"}):
        with pytest.raises((cantools.database.EncodeError, KeyError)):
            codec.encode("FLAMER_BURNERS", wrong)
