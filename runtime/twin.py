"""The exported twin: the device's geometry as an ONNX function from parameters to places and phases."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from optics.errors import BundleError
from runtime.bundle import Bundle
from runtime.manifest import TWIN
from runtime.ort import open_session

INPUTS = {"parameters": 1, "points": 2}


class Twin:
    """twin.onnx of a bundle, run in float64.

    Raises:
        BundleError: the graph does not take `parameters` [P] and `points` [N, 2] in float64.
    """

    def __init__(self, bundle: Bundle, threads: int | None = None) -> None:
        thing = f"{bundle.thing}: {TWIN}"
        self._session = open_session(bundle.files[TWIN], thing, threads)
        found = {node.name: (node.type, len(node.shape)) for node in self._session.get_inputs()}
        wanted = {name: ("tensor(double)", rank) for name, rank in INPUTS.items()}
        if found != wanted:
            raise BundleError(f"{thing}: inputs", found, wanted)
        self.outputs: tuple[str, ...] = tuple(node.name for node in self._session.get_outputs())

    def __call__(self, parameters: NDArray[np.float64], points: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
        """Trace `points` [N, 2] (page coordinates x, y, metres) with `parameters` [P]; all outputs by name."""
        feeds = {"parameters": np.asarray(parameters, np.float64), "points": np.asarray(points, np.float64)}
        return dict(zip(self.outputs, self._session.run(list(self.outputs), feeds), strict=True))
