"""The exported twin: the device's geometry as an ONNX function from parameters to places, phases and pixels."""

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.interfaces import Rays
from lightpage.calibration.parameters import KNOWN, NAMES
from lightpage.errors import BundleError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import TWIN
from lightpage.runtime.model.execution.session import open_session, running
from lightpage.waves.parallel import in_parallel, threads_beside

Real = NDArray[np.float64]

INPUTS = {"parameters": 1, "points": 2, "anchors": 2, "camera_places": 2}
"""Inputs of the graph, all float64, with their number of axes."""
_THREADS = 1
"""For few points at a time, where a second thread would only spin."""
_MANY = 20_000
"""Points that are divided among threads."""
OUTPUTS = ("places", "phases", "positions", "pixels")


class OnnxTwin:
    """twin.onnx of a bundle behind the interface that registration takes (`lightpage.calibration.interfaces.Twin`).

    Args:
        bundle: an opened bundle.

    Attributes:
        known: how many of the parameters it knows, the first ones; see `KNOWN`.

    Raises:
        BundleError: the graph is no twin with the parameters of `lightpage.calibration.parameters`.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._subject = subject = f"{bundle.subject}: {TWIN}"
        self._session = open_session(bundle.files[TWIN], subject, _THREADS)
        inputs = self._session.get_inputs()
        found = {node.name: (node.type, len(node.shape)) for node in inputs}
        if found != (expected := {name: ("tensor(double)", axes) for name, axes in INPUTS.items()}):
            raise BundleError(f"{subject}: inputs", found, expected)
        size = next(node.shape for node in inputs if node.name == "parameters")[0]
        if isinstance(size, int) and size not in KNOWN:
            raise BundleError(f"{subject}: parameters", size, f"{len(NAMES)}: {', '.join(NAMES)}")
        self.known = size if isinstance(size, int) else len(NAMES)
        if missing := set(OUTPUTS) - {node.name for node in self._session.get_outputs()}:
            raise BundleError(f"{subject}: outputs", f"no {', '.join(sorted(missing))}", ", ".join(OUTPUTS))

    def trace(self, parameters: Real, points: Real, anchors: Real | None = None) -> Rays:
        """See `lightpage.calibration.interfaces.Twin`."""
        if parameters.ndim == 2:
            rays = list(in_parallel(lambda one: self.trace(one, points, anchors), list(parameters)))
            return Rays(*(np.stack(part) for part in zip(*rays, strict=True)))
        known, one = _doubles(parameters[: self.known]), _doubles(points[:1])

        def traced(both: tuple[Real, Real]) -> list[Real]:
            own = dict(zip(("points", "anchors"), map(_doubles, both), strict=True))
            rays: list[Real] = self._session.run(OUTPUTS[:3], {"parameters": known, "camera_places": one, **own})
            return rays

        count = threads_beside() if len(points) >= _MANY else 1
        both = (np.array_split(each, count) for each in (points, points if anchors is None else anchors))
        parts = list(zip(*both, strict=True))
        with running(self._subject):
            places, phases, positions = zip(*in_parallel(traced, parts), strict=True)
        return Rays(np.concatenate(places, axis=1), np.concatenate(phases, axis=1), np.concatenate(positions))

    def pixels(self, parameters: Real, places: Real) -> Real:
        """See `lightpage.calibration.interfaces.Twin`."""
        if parameters.ndim == 2:
            return np.stack([self.pixels(one, places) for one in parameters])
        one = _doubles(places[:1])
        known = _doubles(parameters[: self.known])
        feeds = {"parameters": known, "points": one, "anchors": one, "camera_places": _doubles(places)}
        with running(self._subject):
            pixels: Real = self._session.run(OUTPUTS[3:], feeds)[0]
        return pixels


def _doubles(values: Real) -> Real:
    return np.ascontiguousarray(values, np.float64)
