"""Broken DBC texts, made from good ones: the same number gives the same text."""
from __future__ import annotations

import random
import re

NUMBERS = (*"0 1 -1 2 7 8 63 64 65 255 256 2047 2048 65536 1e9 1e400 -1e400 0.1 .5 4294967295 2147483648 2684354559".split(),
           *"99999999999999999999 1e99999 0x10 m0 nan inf".split(), "9" * 500)
WORDS = (*"BO_ SG_ BA_ BA_DEF_ BA_DEF_DEF_ VAL_ CM_ SG_MUL_VAL_ SIG_VALTYPE_ BU_ NS_ BS_ VERSION M m0 m1M UCS Vector__XXX".split(),
         *"INT ENUM STRING HEX FLOAT and not within silent $value BO_TX_BU_ VAL_TABLE_ EV_ SIG_GROUP_ BA_REL_".split(),
         *"VECTOR__INDEPENDENT_SIG_MSG SystemSignalLongSymbol GenSigStartValue".split(),
         *"\"';:|@()[],+-\\\n\x00é", '""', "//")
_TOKEN = re.compile(r'\s+|\w+|.', re.DOTALL)


def mutated(text: str, number: int) -> str:
    """The text with one to six changes: tokens replaced, dropped, doubled, swapped; lines dropped, doubled; cut off; junk."""
    chance = random.Random(number)
    tokens = _TOKEN.findall(text)
    for _ in range(chance.randint(1, 6)):
        tokens = _changed(tokens, chance)
    return "".join(tokens)


def _changed(tokens: list[str], chance: random.Random) -> list[str]:
    if not tokens:
        return list(WORDS)
    at = chance.randrange(len(tokens))
    kind = chance.randrange(10)
    if kind < 4:
        numbers = [index for index, token in enumerate(tokens) if token.isdigit()] or [at]
        tokens[chance.choice(numbers)] = chance.choice(NUMBERS)
    elif kind == 4:
        tokens[at] = chance.choice(WORDS)
    elif kind == 5:
        tokens.insert(at, f" {chance.choice(WORDS)} ")
    elif kind == 6:
        del tokens[at:at + chance.randint(1, 4)]
    elif kind == 7:
        other = chance.randrange(len(tokens))
        tokens[at], tokens[other] = tokens[other], tokens[at]
    elif kind == 8:
        length = chance.randint(1, 60)
        tokens[at:at] = tokens[at:at + length]
    else:
        tokens = tokens[:at] if chance.random() < 0.3 else tokens[:at] + tokens[at + chance.randint(5, 80):]
    return tokens
