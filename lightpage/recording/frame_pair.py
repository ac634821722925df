"""The pair of frames that a page is read from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FramePair:
    """The two frames of one page, camera counts [row, column]."""

    in_phase: NDArray[np.integer[Any]]
    quadrature: NDArray[np.integer[Any]]
