"""Stacks of pictures in TIFF files, read picture by picture; tifffile, of the extra `import`, reads them."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.foreign.array import ForeignArray, chosen, readable

_EXPECTED = "a TIFF of grey pictures"


class TiffArray(ForeignArray):
    """A series of equal pictures in a TIFF file.

    Args:
        path: of the file.
        name: number of the series, or None for the only one.

    Raises:
        InvalidInputError: damaged, in colour, or several series and none named.
        ModuleNotFoundError: tifffile is not installed.
    """

    def __init__(self, path: Path, name: str | None) -> None:
        import tifffile

        logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what matters comes as an error
        self.subject = f"file {path}"
        with readable(self.subject, _EXPECTED):
            self._file = tifffile.TiffFile(path)
        try:
            with readable(self.subject, _EXPECTED):
                self._choose(name)
        except BaseException:
            self.close()
            raise

    def _choose(self, name: str | None) -> None:
        series = {str(number): each for number, each in enumerate(self._file.series)}
        number = chosen(self.subject, name, {key: each.shape for key, each in series.items()})
        self._series = series[number]
        page = self._series.keyframe
        photometric = getattr(page.photometric, "name", str(page.photometric))
        if photometric != "MINISBLACK" or page.samplesperpixel != 1:
            got = f"pictures of {page.samplesperpixel} samples a pixel, {photometric}"
            raise InvalidInputError(self.subject, got, "grey ones, where 0 is black")
        if self._series.dtype is None or self._series.shape[-2:] != page.shape:
            raise InvalidInputError(self.subject, f"shape {self._series.shape}", "pictures along the last two axes")
        self.shape, self.dtype = tuple(self._series.shape), np.dtype(self._series.dtype)

    @property
    def declared_bits(self) -> int | None:
        """Bits of a count where the file says that they are fewer than its type has; else None."""
        bits = self._series.keyframe.bitspersample
        return bits if isinstance(bits, int) and bits < 8 * self.dtype.itemsize else None

    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """See `ForeignArray`; the axis is none of a picture's own, but where there is one picture alone."""
        leading = self.shape[:-2]
        if axis >= len(leading):
            whole = self._pictures(np.arange(math.prod(leading))).reshape(self.shape)
            return whole[(slice(None),) * axis + (slice(start, stop),)]
        numbers = np.arange(math.prod(leading)).reshape(leading)
        taken = numbers[(slice(None),) * axis + (slice(start, stop),)]
        return self._pictures(taken.ravel()).reshape(*taken.shape, *self.shape[-2:])

    def _pictures(self, numbers: NDArray[np.intp]) -> NDArray[Any]:
        pictures = np.empty((len(numbers), *self.shape[-2:]), self.dtype)
        offset, size = self._series.dataoffset, math.prod(self.shape[-2:]) * self.dtype.itemsize
        kind = self.dtype.newbyteorder(self._file.byteorder)
        for row, number in enumerate(map(int, numbers)):
            with readable(f"{self.subject}: picture {number}", _EXPECTED):
                if offset is None:
                    page = self._series.pages[number]
                    assert page is not None  # those of a series that is not in one piece are all there
                    pictures[row] = page.asarray()
                    continue
                self._file.filehandle.seek(offset + number * size)
                data = self._file.filehandle.read(size)
                pictures[row] = np.frombuffer(data, kind).reshape(self.shape[-2:])
        return pictures

    def close(self) -> None:
        """See `ForeignArray`."""
        self._file.close()
