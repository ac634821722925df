"""Folders of grey pictures, one a frame, in the natural order of their names: 2 before 10."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lightpage.errors import InvalidInputError
from lightpage.foreign.array import ForeignArray, readable

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".pgm"})
"""Endings of pictures that lose nothing."""
_GREY = {"L": np.uint8, "I;16": np.uint16, "I;16L": np.uint16, "I;16B": np.uint16, "I": np.int32}
_EXPECTED = f"a grey picture ({', '.join(sorted(SUFFIXES))})"


class Pictures(ForeignArray):
    """Pictures of one size, [picture, row, column].

    Args:
        subject: the folder or the pattern, for errors.
        paths: of the pictures, in order.

    Raises:
        InvalidInputError: no picture, or a first one that is in colour or damaged.
    """

    of_pictures = True

    def __init__(self, subject: str, paths: Sequence[Path]) -> None:
        self.subject, self.files = subject, paths
        if not paths:
            raise InvalidInputError(subject, "no picture", f"pictures ({', '.join(sorted(SUFFIXES))})")
        first = read_picture(paths[0])
        self.shape, self.dtype = (len(paths), *first.shape), first.dtype

    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """See `ForeignArray`; the axis is that of the pictures."""
        assert axis == 0, "a picture is read whole"
        return np.stack([self._picture(path) for path in self.files[start:stop]])

    def _picture(self, path: Path) -> NDArray[Any]:
        data = read_picture(path, (self.shape[1], self.shape[2]))
        if data.dtype != self.dtype:
            got, expected = f"a picture of type {data.dtype}", f"{self.dtype}, as {self.files[0].name} has"
            raise InvalidInputError(f"file {path}", got, expected)
        return data


def read_picture(path: Path, expected: tuple[int, int] | None = None) -> NDArray[Any]:
    """Return a grey picture [row, column].

    Args:
        path: of the picture.
        expected: its rows and columns, looked at before it is decoded; any if left out.

    Raises:
        InvalidInputError: damaged, in colour, or of another size.
    """
    subject = f"file {path}"
    with readable(subject, _EXPECTED), warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(path) as picture:
            size = picture.height, picture.width
            if picture.mode not in _GREY:
                raise InvalidInputError(subject, f"a picture of mode {picture.mode}", "grey, 8 or 16 bits")
            if (pictures := getattr(picture, "n_frames", 1)) != 1:
                raise InvalidInputError(subject, f"{pictures} pictures", "one, or the file itself as a stack")
            if expected is not None and size != expected:
                raise InvalidInputError(
                    subject, f"a picture of {size[0]} x {size[1]}", f"{expected[0]} x {expected[1]}"
                )
            return np.asarray(picture).astype(_GREY[picture.mode], copy=False)


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures of a folder, in natural order.

    Raises:
        InvalidInputError: the folder cannot be read, or has pictures of several kinds.
    """
    with readable(f"folder {folder}", "a folder that can be read"):
        found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
    kinds = sorted({path.suffix.lower() for path in found})
    if len(kinds) > 1:
        raise InvalidInputError(f"folder {folder}", f"pictures of {', '.join(kinds)}", "of one kind, or FOLDER/*.png")
    return sorted(found, key=natural)


def natural(path: Path) -> list[tuple[int, str]]:
    """Return what a name is sorted by, so that 2 comes before 10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
