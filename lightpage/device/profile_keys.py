"""Keys of a profile, read off the classes that check it: a table of all of them, and a file to fill in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from lightpage.device.problems import tables_in
from lightpage.device.profile import Profile, toml_value

_BOUNDS = {"gt": "above", "ge": "from", "lt": "below", "le": "up to"}
_WIDTH = 44


@dataclass(frozen=True)
class Key:
    """A key of a profile.

    Attributes:
        table: that it stands in; empty for one of the document itself.
        name: of the key, with its unit.
        wanted: type and bounds of its value.
        default: value where it is left out, as TOML writes it; empty where it must be given, or means none.
        required: whether it must be given.
        meaning: in a few words.
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
    default = field.default
    return Key(
        table,
        name,
        _wanted(field.annotation, list(field.metadata)),
        "" if default is None or default is PydanticUndefined else toml_value(default),
        field.is_required(),
        field.description or "",
    )


def _wanted(annotation: Any, metadata: list[Any]) -> str:
    """Return type and bounds in words; what a union or an annotated type holds counts too."""
    kind = "text"
    for part in (annotation, *(inner for one in get_args(annotation) for inner in (one, *get_args(one)))):
        if part in (int, float):
            kind = "whole number" if part is int else "number"
        elif isinstance(part, FieldInfo):
            metadata = [*metadata, *part.metadata]
        elif type(part) is int:  # of a literal
            return toml_value(part)
    bounds = [
        f"{word} {getattr(one, name):g}" for name, word in _BOUNDS.items() for one in metadata if hasattr(one, name)
    ]
    return ", ".join((kind, *bounds))


def _first_line(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().partition("\n")[0]
