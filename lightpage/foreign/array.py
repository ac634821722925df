"""An array in a file of another program, read in parts so that it may be larger than memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LightpageError, in_words
from lightpage.failures import os_failure, understood

SEPARATOR = "::"
"""Between a file and the array in it: `FILE::NAME`."""
MOST_BYTES = 1 << 30
"""Most bytes of an array that can be read as a whole alone."""


class ForeignArray(ABC):
    """An array of a file.

    Attributes:
        subject: the file, and the array where it has several, for errors.
        shape: of the array as its own program shows it: MATLAB's are not turned round.
        dtype: of an element.
        files: that hold its data.
        pages_last: whether its program counts axes from the inner one, so that pages lie along the last.
        of_pictures: whether it is read picture by picture, so that pages lie along the first axis alone.
        in_sequence: whether reading a part means to read all before it, as in a compressed archive.
    """

    in_sequence = False
    pages_last = False
    of_pictures = False
    subject: str
    files: Sequence[Path] = ()
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @abstractmethod
    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """Return the part from `start` to `stop` along an axis; of the other axes all.

        Raises:
            InvalidInputError: the data are damaged.
            StorageError, SurroundingsError: they cannot be read.
        """

    def close(self) -> None:  # noqa: B027  # not every array keeps a file open
        """Close the file."""


@contextmanager
def readable(subject: str, expected: str) -> Iterator[None]:
    """Have whatever a reader of files raises of a damaged one end as one error that names the file.

    Readers of other people raise errors of many classes for bytes that are not what they should be.

    Raises:
        InvalidInputError: the file is damaged, or of another kind.
        StorageError, SurroundingsError: it cannot be read, or a resource is short.
        ModuleNotFoundError: what reads it is not installed.
    """
    try:
        yield
    except (LightpageError, ModuleNotFoundError):
        raise
    except OSError as error:
        raise os_failure(subject, error, expected) from None
    except Exception as error:
        if (failure := understood(subject, error)) is not None:
            raise failure from None
        told = " ".join(str(error).split())[:200]
        if "imagecodecs" in told:
            expected = "one without compression, or the codecs: pip install imagecodecs"
        if (got := in_words(error)) == str(error):
            got = f"data that cannot be read ({told or 'damaged'})"
        raise InvalidInputError(subject, got, expected) from None


def chosen(subject: str, name: str | None, found: dict[str, tuple[int, ...]]) -> str:
    """Return the name of the array that is meant: the one that was named, or the only one.

    Args:
        subject: the file.
        name: that was given, or None.
        found: shapes of the arrays in the file, by name.

    Raises:
        InvalidInputError: there is no such array, there are several, or there is none.
    """
    told = ", ".join(f"{each} {shape}" for each, shape in list(found.items())[:20]) or "none"
    if name is not None:
        if name in found:
            return name
        if (bare := name.strip("/")) in found:
            return bare
        raise InvalidInputError(f"{subject}: array '{name}'", "none of this name", f"one of: {told}")
    if len(found) != 1:
        got = f"{len(found)} arrays: {told}" if found else "no array of numbers"
        raise InvalidInputError(subject, got, f"one, or FILE{SEPARATOR}NAME")
    return next(iter(found))


def spread(count: int, most: int) -> list[int]:
    """Return some of so many numbers, from first to last."""
    return [int(number) for number in np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))]
