"""The published contract, `bridge/schema/`: written by `python -m bridge.contract`, held against the types by a test."""
from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from bridge import wire
from bridge.asyncapi import describe


def schemas() -> dict[str, str]:
    """JSON Schema (draft 2020-12) of every message and the AsyncAPI description of all, by the name of its file."""
    found = {f"{name}.json": _schema(name, kind) for name, kind in wire.SCHEMAS.items()}
    return found | {"asyncapi.json": msgspec.json.format(msgspec.json.encode(describe()), indent=2).decode() + "\n"}


def _schema(name: str, kind: type[msgspec.Struct]) -> str:
    generated = _readable(msgspec.json.schema(kind))
    own = generated["$defs"].pop(kind.__name__)
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"urn:ucs:v{wire.SCHEMA}:{name}"}
    text = msgspec.json.encode({**head, **own, **({"$defs": generated["$defs"]} if generated["$defs"] else {})})
    return msgspec.json.format(text, indent=2).decode() + "\n"


def _readable(schema: Any) -> Any:
    """The schema with decimals as the JSON numbers they are sent as, and docstrings without their indentation."""
    if isinstance(schema, list):
        return [_readable(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("format") == "decimal":
        return {"type": "number"} | {key: schema[key] for key in schema.keys() - {"type", "format"}}
    return {key: inspect.cleandoc(item) if key == "description" and isinstance(item, str) else _readable(item)
            for key, item in schema.items()}


def main(arguments: Sequence[str]) -> int:
    """Write the files into the folder given, or beside this module."""
    folder = Path(arguments[0]) if arguments else Path(__file__).parent / "schema"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in schemas().items():
        (folder / name).write_text(text, encoding="utf-8")
        print(folder / name)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
