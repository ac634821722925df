"""The table of all keys in the documents is that of the program: table, key, default and range of each."""

from __future__ import annotations

import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lightpage.device.problems import tables_in, tag_of
from runtime.acquisition.camera_config import KEYS, DeviceTable

PAGE = Path(__file__).parents[3] / "docs" / "cameras.md"
Row = tuple[str, str, str, str]


def rows() -> list[Row]:
    """Those of the whole file; both cameras have the same."""
    found: list[Row] = []
    for name, field in DeviceTable.model_fields.items():
        tables = tables_in(field.annotation)
        if name == "quadrature":
            continue
        if not tables:
            found.append(("", f"`{name}`", default_of(field), range_of(field)))
        for table in tables:
            shown = "`in_phase`, `quadrature`" if name == "in_phase" else f"`{name}`"
            if tag := tag_of(table):
                shown += f" {tag}"
            found += list(of_table(shown, table))
    return found


def of_table(shown: str, table: type[BaseModel]) -> Iterator[Row]:
    for key, field in table.model_fields.items():
        inner = tables_in(field.annotation)
        if inner:
            for name, part in inner[0].model_fields.items():
                yield shown, f"`{key}.{name}`", default_of(part), range_of(part)
        else:
            yield shown, f"`{key}`", default_of(field), range_of(field)


def default_of(field: FieldInfo) -> str:
    if field.is_required():
        return "needed"
    value = field.default
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return str(value) if isinstance(value, str) else f"{value:g}"


def range_of(field: FieldInfo) -> str:
    kind, metadata = bare(field.annotation, list(field.metadata))
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    if kind is bool:
        return "true, false"
    if kind is str:
        return "text"
    if get_origin(kind) is tuple:
        return f"list of {limits(*bare(get_args(kind)[0], []))}"
    return limits(kind, metadata)


def limits(kind: Any, metadata: list[Any]) -> str:
    words = []
    for bound, word in ((Gt, "above {}"), (Ge, "from {}"), (Lt, "below {}"), (Le, "to {}")):
        words += [
            word.format(f"{getattr(one, bound.__name__.lower()):.10g}") for one in metadata if isinstance(one, bound)
        ]
    return " ".join([*(["whole"] if kind is int else []), *words]) or "any"


def bare(kind: Any, metadata: list[Any]) -> tuple[Any, list[Any]]:
    """A type without None and what is annotated, and all of its bounds."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(one for one in get_args(kind) if one is not type(None))
    if hasattr(kind, "__metadata__"):
        inner = kind.__metadata__
        metadata = [*metadata, *(m for one in inner for m in (one.metadata if isinstance(one, FieldInfo) else [one]))]
        return bare(kind.__origin__, metadata)
    return kind, metadata


def test_no_key_is_missing_from_the_table_and_none_is_wrong() -> None:
    text = PAGE.read_text("utf-8")
    title = KEYS.partition(", ")[2].capitalize()
    part = text.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")][2:]
    written = [tuple(cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:6]) for line in lines]
    assert [row[:4] for row in written] == rows()
    assert all(row[4] for row in written), "a meaning is missing"
