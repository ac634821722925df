"""Base class of the service's settings tables: checked TOML, with rules among its keys."""

from collections.abc import Callable, Iterator
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, WithJsonSchema, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from lightpage.device.profile import TomlTable
from lightpage.errors import InvalidInputError

Rule = tuple[bool, str, str]
"""Whether it holds; the key, with dots, that is wrong where it does not; and what is wanted of that key."""


def _not_empty(value: Any) -> Any:
    if value == "":
        raise ValueError("a path that is not empty")
    return value


Text = Annotated[str, Field(min_length=1)]
File = Annotated[Path, Field(strict=False), BeforeValidator(_not_empty)]
Folder = Annotated[File, WithJsonSchema({"type": "string", "format": "directory-path"})]
Seconds = Annotated[float, Field(gt=0, le=31e6, allow_inf_nan=False)]


class SettingsTable(TomlTable):
    """A table of the service's settings, or all of them."""

    def rules(self) -> Iterator[Rule]:
        """Yield the rules among keys."""
        yield from ()

    @model_validator(mode="after")
    def _keeps_rules(self) -> Self:
        told = self.model_dump(mode="json")
        broken = [
            InitErrorDetails(
                type=PydanticCustomError("rule", "{wanted}", {"wanted": wanted}),
                loc=tuple(key.split(".")),
                input=reduce(getitem, key.split("."), told),
            )
            for holds, key, wanted in self.rules()
            if not holds
        ]
        if broken:
            raise ValidationError.from_exception_data(type(self).__name__, broken)
        return self


def checked(check: Callable[[str], object]) -> AfterValidator:
    """Return a validator of texts that a function checks which raises `InvalidInputError`."""

    def checked_text(text: str) -> str:
        try:
            check(text)
        except InvalidInputError as error:
            raise ValueError(error.expected) from None
        return text

    return AfterValidator(checked_text)
