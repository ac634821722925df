"""JSON that a report is made of: which command wrote it, and what is in it, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from lightpage.errors import InvalidInputError
from lightpage.files import read_text
from lightpage.page.levels import MAX_LEVELS
from lightpage.run_files import EVALUATE, RECOVER, REPORT_MARKS

EXPECTED = (
    f"a finished training run, a bulk run, or the JSON that this version's `lightpage {EVALUATE}` or `{RECOVER}` writes"
)

Bits = Annotated[float, Field(le=math.log2(MAX_LEVELS) + 1e-6)]
"""An AIR may be as negative as a decoder is sure of what is wrong."""
Share = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(ge=0)]

_NAMED_KEYS, _LONGEST_KEY = 5, 30
_NAMED_PROBLEMS = 3


class Part(BaseModel):
    """An object in JSON: no type is converted, no number is infinite, and other keys do not matter."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Part)


@dataclass(frozen=True)
class JsonFile:
    """A file of JSON.

    Attributes:
        path: path of the file.
        text: all of it, JSON.
        command: command that wrote it, by its keys; None where that is not known.
        found: the same for people.
    """

    path: Path
    text: bytes
    command: str | None
    found: str

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file and see whose it is.

        Raises:
            InvalidInputError: it cannot be read, or is no JSON.
        """
        try:
            text = read_text(path, f"{path}", EXPECTED).encode()
            content = from_json(text)
        except ValueError as error:
            raise InvalidInputError(f"{path}", f"text that is no JSON ({error})", EXPECTED) from None
        if not isinstance(content, dict):
            return cls(path, text, None, "JSON that is no object")
        command = next((name for name, marks in REPORT_MARKS.items() if marks <= content.keys()), None)
        return cls(path, text, command, _keys(content) if command is None else f"the JSON of `lightpage {command}`")

    def checked(self, model: type[Model]) -> Model:
        """Parse the file as `model`.

        Raises:
            InvalidInputError: something is missing, of another type or out of range; the first problems are named.
        """
        try:
            return model.model_validate_json(self.text, strict=True)
        except ValidationError as error:
            problems = [f"{'.'.join(map(str, e['loc'])) or 'file'} ({e['msg']})" for e in error.errors()]
            more = f" and {len(problems) - _NAMED_PROBLEMS} more" if len(problems) > _NAMED_PROBLEMS else ""
            raise InvalidInputError(f"{self.path}", "; ".join(problems[:_NAMED_PROBLEMS]) + more, EXPECTED) from None


def _keys(content: dict[str, Any]) -> str:
    """The first keys of an object that nobody here knows; escaped, since anything may stand in them."""
    named = ", ".join(repr(key[:_LONGEST_KEY]) for key in list(content)[:_NAMED_KEYS])
    more = f" and {len(content) - _NAMED_KEYS} more" if len(content) > _NAMED_KEYS else ""
    return f"JSON with the keys {named}{more}" if content else "JSON without keys"
