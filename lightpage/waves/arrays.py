"""The array library that light is computed with: numpy, or one that computes elsewhere and is brought along."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import add
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.waves.parallel import in_parallel


class Arrays(Protocol):
    """An array library. What is written with operators, methods and functions of both computes in either.

    Attributes:
        xp: the library's functions, those of which take the same arguments as numpy's.
    """

    xp: ModuleType

    def array(self, values: NDArray[Any]) -> Any:
        """Take over an array of numpy's, in single precision where it need not be more."""

    def exact(self, values: NDArray[Any]) -> Any:
        """Take over an array of numpy's as it is."""

    def complex64(self, values: Any) -> Any:
        """An array of the library in single precision."""

    def sum(self, function: Callable[[slice], Any], count: int) -> Any:
        """Return the sum over so many items of what a function makes of them; it is called with slices of them."""


class NumpyArrays:
    """See `Arrays`: numpy, whose arrays stay as they are."""

    xp: ModuleType = np

    def array(self, values: NDArray[Any]) -> Any:
        """Return the array."""
        return values

    def exact(self, values: NDArray[Any]) -> Any:
        """Return the array."""
        return values

    def complex64(self, values: Any) -> Any:
        """Return the array in single precision."""
        return values.astype(np.complex64, copy=False)

    def sum(self, function: Callable[[slice], Any], count: int) -> Any:
        """Compute both halves beside each other, the same ones whatever the number of threads."""
        middle = (count + 1) // 2
        halves = [half for half in (slice(0, middle), slice(middle, count)) if half.start < half.stop]
        return reduce(add, in_parallel(function, halves))


NUMPY = NumpyArrays()
