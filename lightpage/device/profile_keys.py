"""Keys of a profile, read off the classes that check it: a table of all of them, and a file to fill in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from lightpage.device.problems import tables_in, unit_of
from lightpage.device.profile import Profile, toml_value

_BOUNDS = {"gt": "above", "ge": "from", "lt": "below", "le": "up to"}
_KINDS = {bool: "true or false", int: "whole number", float: "number", Path: "path", dict: "a table"}
_WIDTH = 44


@dataclass(frozen=True)
class Key:
    """A key of a profile.

    Attributes:
        table: table that it stands in; empty for one of the document itself.
        name: name of the key, with its unit.
        wanted: type and bounds of its value.
        default: value where it is left out, as TOML writes it; empty where it must be given, or means none.
        required: whether it must be given.
        meaning: meaning in a few words.
    """

    table: str
    name: str
    wanted: str
    default: str
    required: bool
    meaning: str


def keys() -> Iterator[Key]:
    """Yield every key of a profile, in the order of the file."""
    for name, field in Profile.model_fields.items():
        if found := tables_in(field.annotation):
            for inner, part in found[0].model_fields.items():
                yield _key(name, inner, part)
        else:
            yield _key("", name, field)


def key_table() -> str:
    """Return all keys as a table in Markdown."""
    rows = ["| key | value | if left out | meaning |", "|---|---|---|---|"]
    for key in keys():
        absent = "refused" if key.required else key.default or "none"
        rows.append(f"| `{f'{key.table}.' if key.table else ''}{key.name}` | {key.wanted} | {absent} | {key.meaning} |")
    return "\n".join(rows) + "\n"


def commented_toml(profile: Profile) -> str:
    """Return a profile as TOML with every key and its meaning; keys without a value are comments."""
    lines = [f"# {_first_line(Profile)}"]
    table = ""
    for key in keys():
        if key.table != table:
            table = key.table
            lines += ["", f"[{table}]  # {_first_line(type(getattr(profile, table)))}"]
        value = getattr(getattr(profile, table) if table else profile, key.name)
        stated = f"{key.name} = {toml_value(value)}" if value is not None else f"# {key.name} ="
        lines.append(f"{stated:<{_WIDTH}}# {key.wanted}: {key.meaning}")
    return "\n".join(lines) + "\n"


def _key(table: str, name: str, field: FieldInfo) -> Key:
    return Key(
        table,
        name,
        told if "," not in (told := wanted(field.annotation, list(field.metadata))) else told + unit_of(name),
        default_of(field),
        field.is_required(),
        field.description or "",
    )


def default_of(field: FieldInfo) -> str:
    """Return the value of a key that is left out, as TOML writes it; empty where it must be given, or means none."""
    default = field.default
    if isinstance(default, BaseModel):
        return "its defaults"
    return "" if default is None or default is PydanticUndefined else toml_value(default)


def wanted(annotation: Any, metadata: list[Any]) -> str:
    """Return type and bounds of a key in words.

    Args:
        annotation: type of the key's field.
        metadata: what pydantic knows of it beside the type.
    """
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        inner = [one for more in parts[1:] for one in (more.metadata if isinstance(more, FieldInfo) else [more])]
        return wanted(parts[0], [*metadata, *inner])
    if origin is Literal:
        return " or ".join(toml_value(part) for part in parts)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(wanted(part, metadata) for part in parts if part is not NoneType))
    if origin is tuple:
        return f"list of {wanted(parts[0], metadata)}"
    bounds = [
        f"{word} {_number(getattr(one, name))}"
        for name, word in _BOUNDS.items()
        for one in metadata
        if hasattr(one, name)
    ]
    return ", ".join((_KINDS.get(annotation, "text"), *bounds))


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _first_line(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().partition("\n")[0]
