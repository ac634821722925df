"""The table of all keys in the documents is that of the program: table, key, default and range of each."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from lightpage.device.problems import tables_in, tag_of
from runtime.acquisition.camera_config import KEYS, DeviceTable

PAGE = Path(__file__).parents[3] / "docs" / "cameras.md"
Row = tuple[str, str, str, str]
BOUNDS = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}


def rows(table: type[BaseModel], shown: str = "", prefix: str = "") -> Iterator[Row]:
    """Those of a table, and of the tables in it; both cameras have the same."""
    schema = table.model_json_schema()
    for name, field in table.model_fields.items():
        inner = tables_in(field.annotation)
        if shown and inner:
            yield from rows(inner[0], shown, f"{name}.")
        elif not inner:
            default = "needed" if field.is_required() else default_of(field.default)
            yield shown, f"`{prefix}{name}`", default, range_of(schema["properties"][name])
        elif name != "quadrature":
            for one in inner:
                named = "`in_phase`, `quadrature`" if name == "in_phase" else f"`{name}`"
                yield from rows(one, f"{named} {tag_of(one)}".strip())


def default_of(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def range_of(schema: dict[str, Any]) -> str:
    schema = next((one for one in schema.get("anyOf", []) if one["type"] != "null"), schema)
    if choices := schema.get("enum", [schema[key] for key in ("const",) if key in schema]):
        return ", ".join(f"`{choice}`" for choice in choices)
    if schema["type"] == "array":
        return f"list of {range_of(schema['items'])}"
    if schema["type"] in ("boolean", "string"):
        return "text" if schema["type"] == "string" else "true, false"
    words = [f"{word} {schema[key]:.10g}" for key, word in BOUNDS.items() if key in schema]
    return " ".join([*(["whole"] if schema["type"] == "integer" else []), *words]) or "any"


def test_no_key_is_missing_from_the_table_and_none_is_wrong() -> None:
    title = KEYS.partition(", ")[2].capitalize()
    part = PAGE.read_text("utf-8").partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")][2:]
    written = [tuple(cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:6]) for line in lines]
    assert [row[:4] for row in written] == list(rows(DeviceTable))
    assert all(row[4] for row in written), "a meaning is missing"
