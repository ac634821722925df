"""Mistakes in a TOML table, told by the names in the file and not by those of the library that checks it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

WANTED = ", wanted "
"""A `ValueError` of a validator says what came and what was wanted, with this in between."""
_ONE_OF = "one of "
_LONGEST = 60
"""Characters of a value that are told."""

_MARKS = {
    "a profile": {"light", "lens", "pipe"},
    "a calibration": {"calibrated_pages", "turn_rad"},
    "a code": {"coded_bits", "rate_per_mille"},
    "cameras of a device": {"in_phase", "quadrature", "trigger"},
    "state of a simulated device": {"geometry", "sensor", "homodyne", "in_phase_camera", "quadrature_camera"},
}
"""Keys that documents of one kind alone have. Two make a file one of that kind: a single one may be a slip."""

_TYPES = {
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "text in quotes",
    "string_too_short": "at least one character",
    "tuple_type": "a list",
    "list_type": "a list",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
}
_BOUNDS = {"greater_than": "gt", "greater_than_equal": "ge", "less_than": "lt", "less_than_equal": "le"}
_UNITS = {"m": "m", "deg": "degree", "rad": "rad", "px": "px", "s": "s"}
_SIDES = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}


@dataclass(frozen=True)
class Problem:
    """A mistake in a table.

    Attributes:
        place: the key, or the table, with dots; empty for the whole document.
        got: value, or words about it, that the table has.
        expected: words about a right value.
        kind: ``missing``, ``unknown``, ``value`` where `got` is what the key has, ``document`` where the whole is of
            another kind, or else ``wrong``.
    """

    place: str
    got: str
    expected: str
    kind: str = "wrong"

    def __str__(self) -> str:
        """Return the short form of the mistake."""
        if self.kind == "document":
            return self.got
        if self.kind == "missing":
            return f"no {self.place}"
        if self.kind == "unknown":
            close = not self.expected.startswith(_ONE_OF)
            return f"unknown {self.place} ({f'did you mean {self.expected}?' if close else f'wanted {self.expected}'})"
        if self.kind == "value":
            return f"{self.place} = {self.got} (wanted {self.expected})"
        return f"{self.place}: {self.got}{WANTED}{self.expected}".removeprefix(": ")

    def parted(self) -> tuple[str, str, str]:
        """Return place, `got` and `expected` as an error has them."""
        table, _, key = self.place.rpartition(".")
        if self.kind == "missing":
            return table, f"no {key}", self.expected
        return self.place, "an unknown key" if self.kind == "unknown" else self.got, self.expected


def problems_of(model: type[BaseModel], error: ValidationError) -> list[Problem]:
    """Every mistake in a table that does not validate against `model`; a document of another kind is one alone."""
    if kind := other_kind(error):
        return [Problem("", kind, "a file with other keys", "document")]
    return [problem_of(model, one) for one in error.errors()]


def mistakes(model: type[BaseModel], error: ValidationError) -> str:
    """Return `problems_of` in one line."""
    return "; ".join(map(str, problems_of(model, error)))


def other_kind(error: ValidationError) -> str:
    """Return the kind of document that the keys are of, in words; empty where they are of the right one, or of none."""
    unknown = {one["loc"][0] for one in error.errors() if one["type"] == "extra_forbidden" and len(one["loc"]) == 1}
    return next((kind for kind, marks in _MARKS.items() if len(marks & unknown) > 1), "")


def keys_of(model: type[BaseModel]) -> list[str]:
    """The keys that a table may have."""
    return list(model.model_fields)


def tables_in(annotation: Any) -> list[type[BaseModel]]:
    """The kinds of tables that a key may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in tables_in(part)]


def tag_of(model: type[BaseModel]) -> str:
    """Return the value of the key `kind` of a table that is one of several."""
    field = model.model_fields.get("kind")
    return "" if field is None else str(get_args(field.annotation)[0])


def problem_of(model: type[BaseModel], error: ErrorDetails) -> Problem:
    """Return the mistake that an entry of a `ValidationError` tells."""
    place, owners, within = _walk(model, error["loc"])
    kind, context = error["type"], error.get("ctx", {})
    key = place.rpartition(".")[2]
    if kind == "missing":
        return Problem(place, f"no {key}", "one", "missing")
    if kind == "extra_forbidden":
        known = [name for owner in owners for name in keys_of(owner)]
        close = get_close_matches(key, known, 1)
        return Problem(place, "an unknown key", close[0] if close else f"{_ONE_OF}{', '.join(known)}", "unknown")
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        tags = " or ".join(tag_of(one) for one in within)
        if kind == "union_tag_not_found":
            return Problem(place, "no kind", tags)
        return Problem(f"{place}.kind".removeprefix("."), repr(context["tag"]), tags, "value")
    if kind == "value_error":
        got, wanted, expected = str(context["error"]).rpartition(WANTED)
        if wanted:
            return Problem(place, got, expected)
        return Problem(place, _short(error["input"]), expected, "value" if place else "wrong")
    unit = unit_of(key) if kind in _BOUNDS else ""
    return Problem(place or "document", _short(error["input"]), f"{expected_of(error)}{unit}", "value")


def expected_of(error: ErrorDetails) -> str:
    """Return a few words on what would have been right in place of a single value."""
    kind, context = error["type"], error.get("ctx", {})
    if kind in _BOUNDS:
        bound = _BOUNDS[kind]
        return f"{_SIDES[bound]} {_number(context[bound])}"
    if kind == "too_short":
        least = context["min_length"]
        return "at least one entry" if least == 1 else f"at least {least} entries"
    if kind == "literal_error":
        return str(context["expected"]).replace("'", "")
    return _TYPES.get(kind, error["msg"])


def unit_of(key: str) -> str:
    """Return the unit that the name of a key ends with, behind a blank; empty where it names none."""
    return next((f" {unit}" for end, unit in _UNITS.items() if key.endswith(f"_{end}")), "")


def _number(value: float) -> str:
    return f"{int(value)}" if value == int(value) else f"{value:g}"


def _walk(
    model: type[BaseModel], parts: Sequence[int | str]
) -> tuple[str, list[type[BaseModel]], list[type[BaseModel]]]:
    """Return the place as it is in the file, the kinds of tables around it, and those that it may hold.

    The tag of a table that is one of several is among the parts, and not in the file.
    """
    names: list[str] = []
    owners: list[type[BaseModel]] = []
    within = [model]
    for part in parts:
        if len(within) > 1 and (tagged := [one for one in within if tag_of(one) == part]):
            within = tagged
            continue
        names.append(str(part))
        if isinstance(part, int):
            continue
        owners = within
        field = next((one.model_fields[part] for one in within if part in one.model_fields), None)
        within = [] if field is None else tables_in(field.annotation)
    return ".".join(names), owners, within


def _short(value: object) -> str:
    if isinstance(value, dict):
        return "a table"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
