"""Folders of grey pictures, one a frame, in the natural order of their names: 2 before 10."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lightpage.errors import InvalidInputError
from lightpage.foreign.array import ForeignArray, readable
from lightpage.words import sides

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
        InvalidInputError: no picture, or one that is in colour, of another size or type, or whose header is damaged.
    """

    of_pictures = True

    def __init__(self, subject: str, paths: Sequence[Path]) -> None:
        self.subject, self.files = subject, paths
        if not paths:
            raise InvalidInputError(subject, "no picture", f"pictures ({', '.join(sorted(SUFFIXES))})")
        size, self.dtype = _header(paths[0])
        self.shape = len(paths), *size
        for path in paths[1:]:
            if (found := _header(path)) != (size, self.dtype):
                got, expected = (f"a picture of {sides(shape)}, {kind}" for shape, kind in (found, (size, self.dtype)))
                raise InvalidInputError(f"file {path}", got, f"{expected}, as {paths[0].name} has")

    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """See `ForeignArray`; the axis is that of the pictures."""
        assert axis == 0, "a picture is read whole"
        pictures = []
        with readable(self.subject, _EXPECTED):
            for path in self.files[start:stop]:
                with _opened(path) as picture:
                    pictures.append(np.asarray(picture).astype(self.dtype, copy=False))
            return np.stack(pictures)


def _header(path: Path) -> tuple[tuple[int, int], np.dtype[Any]]:
    """Return rows and columns of a grey picture, and the type of its counts, without decoding it."""
    with _opened(path) as picture:
        return (picture.height, picture.width), np.dtype(_GREY[picture.mode])


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open a grey picture; what is wrong with it is told of the file.

    Raises:
        InvalidInputError: damaged, or in colour.
    """
    subject = f"file {path}"
    with readable(subject, _EXPECTED), warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(path) as picture:
            if picture.mode not in _GREY:
                raise InvalidInputError(subject, f"a picture of mode {picture.mode}", "grey, 8 or 16 bits")
            if (pictures := getattr(picture, "n_frames", 1)) != 1:
                raise InvalidInputError(subject, f"{pictures} pictures", "one, or the file itself as a stack")
            yield picture


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
