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

    of_pictures = True

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
        found = self._file.series
        if name is None and len({(each.shape, each.dtype) for each in found}) == 1:
            self._series = list(found)  # whoever writes picture by picture may have made a series of each
        else:
            shapes = {str(number): each.shape for number, each in enumerate(found)}
            self._series = [found[int(chosen(self.subject, name, shapes))]]
        series = self._series[0]
        page = series.keyframe
        photometric = getattr(page.photometric, "name", str(page.photometric))
        if photometric != "MINISBLACK" or page.samplesperpixel != 1:
            got = f"pictures of {page.samplesperpixel} samples a pixel, {photometric}"
            raise InvalidInputError(self.subject, got, "grey ones, where 0 is black (photometric='minisblack')")
        if series.dtype is None or series.shape[-2:] != page.shape:
            raise InvalidInputError(self.subject, f"shape {series.shape}", "pictures along the last two axes")
        self._each = math.prod(series.shape[:-2])
        many = len(self._series)
        self.shape = tuple(series.shape) if many == 1 else (many * self._each, *series.shape[-2:])
        self.dtype = np.dtype(series.dtype)

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
        for row, number in enumerate(map(int, numbers)):
            with readable(f"{self.subject}: picture {number}", _EXPECTED):
                pictures[row] = self._picture(*divmod(number, self._each))
        return pictures

    def _picture(self, series: int, number: int) -> NDArray[Any]:
        found, size = self._series[series], math.prod(self.shape[-2:]) * self.dtype.itemsize
        if found.dataoffset is None:
            page = found.pages[number]
            assert page is not None  # those of a series that is not in one piece are all there
            return np.asarray(page.asarray())
        self._file.filehandle.seek(found.dataoffset + number * size)
        data = self._file.filehandle.read(size)
        return np.frombuffer(data, self.dtype.newbyteorder(self._file.byteorder)).reshape(self.shape[-2:])

    def close(self) -> None:
        """See `ForeignArray`."""
        self._file.close()
