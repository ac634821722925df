"""The parameters of a page's code, which writer and reader share."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lightpage.codec.checksum import crc16
from lightpage.codec.mapping import level_bits
from lightpage.device.problems import mistakes
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.files import read_text, replace_text


class Code(BaseModel):
    """Code of a page: how its user bytes are protected.

    Attributes:
        levels: M, a power of two.
        coded_bits: b, label bits of each symbol that the LDPC code protects.
        rate_per_mille: information bits of an LDPC block over its sent bits, thousandths.
        corrections: t, symbols of each Reed-Solomon word that can be mended; 0 for none.
        needed_information: information per coded bit from which blocks of this code decode, measured when the code was
            chosen; only the margin depends on it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    levels: Annotated[int, Field(ge=2, le=256)]
    coded_bits: Annotated[int, Field(ge=1, le=8)]
    rate_per_mille: Annotated[int, Field(ge=340, le=960)]
    corrections: Annotated[int, Field(ge=0, le=32)] = 0
    needed_information: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 1.0

    @model_validator(mode="after")
    def _check_levels(self) -> Self:
        try:
            bits = level_bits(self.levels)
        except LightpageError as error:
            raise ValueError(f"{self.levels} levels are not {error.expected}") from None
        if self.coded_bits > bits:
            raise ValueError(f"{self.coded_bits} coded bits are more than the {bits} of {self.levels} levels")
        return self

    @property
    def level_bits(self) -> int:
        """m of M = 2^m."""
        return level_bits(self.levels)

    @property
    def id(self) -> int:
        """16 bits that stand in every page's header: CRC-16 of the text "M b rate t" in decimal numbers."""
        return crc16(f"{self.levels} {self.coded_bits} {self.rate_per_mille} {self.corrections}".encode())

    def describe(self) -> str:
        """The code for people."""
        return (
            f"{self.levels} levels, {self.coded_bits} of {self.level_bits} bits coded at rate "
            f"{self.rate_per_mille / 1000:.3f}, {self.corrections} corrections a word"
        )

    def to_toml(self) -> str:
        """The code as a TOML document."""
        return "".join(f"{name} = {value}\n" for name, value in self.model_dump().items())

    def save(self, path: Path) -> None:
        """Write the code to a TOML file, whole or not at all.

        Raises:
            InvalidInputError: the path cannot be written.
        """
        replace_text(path, self.to_toml(), "code")


def parse_code(text: str, subject: str) -> Code:
    """Read a code from TOML.

    Raises:
        InvalidInputError: no TOML, an unknown key, or a value that is not allowed.
    """
    try:
        return Code.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(subject, f"text that is not TOML ({error})", "the parameters of a code") from None
    except ValidationError as error:
        raise InvalidInputError(subject, mistakes(Code, error), "the parameters of a code") from None


def load_code(path: str | Path) -> Code:
    """Read a code from a TOML file.

    Raises:
        InvalidInputError: the file cannot be read, or see `parse_code`.
    """
    text = read_text(path, f"code {path}", "a TOML file with the parameters of a code")
    return parse_code(text, f"code {path}")
