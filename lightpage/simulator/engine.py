"""Engines of the simulator: an array library, its random numbers and its splines."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Any, Protocol, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.recording.layout import frame_type
from lightpage.waves.arrays import Arrays, NumpyArrays

CPU = "cpu"
_GROUP = "lightpage.engines"


class Engine(Arrays, Protocol):
    """An array library with what simulated cameras need beyond `Arrays`."""

    def generator(self, seed: Sequence[int]) -> Any:
        """A stream of random numbers with numpy's methods `standard_normal(shape, dtype)` and `poisson(expected)`."""

    def spline(self, image: Any, rows: Any, columns: Any) -> Any:
        """Cubic-spline values of an image at places in samples, float32; those beyond its edge are the edge's."""

    def counts(self, values: Any, bit_depth: int) -> Any:
        """Whole numbers in the type that frames of so many bits have."""

    def to_numpy(self, values: Any) -> NDArray[Any]:
        """Bring an array back to numpy."""


class NumpyEngine(NumpyArrays):
    """See `Engine`: numpy and scipy."""

    def generator(self, seed: Sequence[int]) -> np.random.Generator:
        """See `Engine`."""
        return np.random.default_rng(seed)

    def spline(self, image: Any, rows: Any, columns: Any) -> Any:
        """See `Engine`."""
        return scipy.ndimage.map_coordinates(
            image.astype(np.float32), [rows, columns], order=3, mode="nearest", prefilter=True
        )

    def counts(self, values: Any, bit_depth: int) -> Any:
        """See `Engine`."""
        return values.astype(frame_type(bit_depth))

    def to_numpy(self, values: Any) -> NDArray[Any]:
        """See `Engine`."""
        return np.asarray(values)


NUMPY = NumpyEngine()


_TORCH = "pip install 'lightpage[train]'"
_COMPUTE = re.compile(r"cuda(:\d+)?")


def engine_on(compute: str) -> Engine:
    """The engine of a device: numpy's on `cpu`, that of an installed entry point on `cuda` or `cuda:N`.

    Raises:
        InvalidInputError: no engine is installed that knows others than the CPU, or it refuses.
    """
    if compute == CPU:
        return NUMPY
    if not _COMPUTE.fullmatch(compute):
        raise InvalidInputError("--compute", compute, f"{CPU}, cuda or cuda:N")
    found = next(iter(entry_points(group=_GROUP)), None)
    if found is None:
        raise InvalidInputError("--compute", compute, f"{CPU}, or torch: {_TORCH}")
    try:
        make = found.load()
    except ImportError as error:
        raise InvalidInputError("--compute", f"{compute} without {error.name}", _TORCH) from error
    return cast(Engine, make(compute))
