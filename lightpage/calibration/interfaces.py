"""Interfaces that registration needs of a ray twin, computed by torch in training and by ONNX in the runtime."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]

BRANCHES: tuple[str, ...] = ("direct", "x", "y", "xy", "yx")
"""Families of light paths, by the parity of the unfolded pipe's cell that they leave through: even in both axes, odd
in x, odd in y', odd in both. In a sheared pipe the last splits by which wall is met first."""


class Rays(NamedTuple):
    """Rays of points on the page, as the twin traces them.

    Attributes:
        places: points where each branch lands on the camera plane, [B, N, 2] as (x, y), metres from the optical axis.
        phases: phase that the branch's path adds to the symbol's, against the reference, [B, N] radians, unwrapped.
        positions: exit centroid of the beam over the pipe's width, (x, y'), [N, 2], dimensionless.
    """

    places: Real
    phases: Real
    positions: Real


class Twin(Protocol):
    """A ray tracer of the device with the parameters of `lightpage.calibration.parameters`.

    Attributes:
        known: how many of them it knows, the first ones; see `KNOWN` there. The others do nothing.
    """

    known: int

    def trace(self, parameters: Real, points: Real, anchors: Real | None = None) -> Rays:
        """Trace page points.

        Args:
            parameters: [P], or [K, P] for K devices at once; the results then have a leading axis K.
            points: [N, 2] as (x, y), metres from the page's centre.
            anchors: [N, 2], points whose cells decide the paths (a symbol's centre for all of its samples); the
                points themselves if None.
        """
        ...

    def pixels(self, parameters: Real, places: Real) -> Real:
        """Camera-plane points [N, 2] (metres) to pixels (column, row) of both cameras, [2, N, 2].

        Parameters [K, P] give [K, 2, N, 2].
        """
        ...


class RememberingTwin:
    """A twin that remembers its last trace: either camera is looked at for the same one.

    Args:
        twin: ray tracer.
    """

    def __init__(self, twin: Twin) -> None:
        self.known, self.pixels = twin.known, twin.pixels
        self._twin, self._asked, self._rays = twin, tuple[Real, ...](), Rays(*[np.zeros(0)] * 3)

    def trace(self, parameters: Real, points: Real, anchors: Real | None = None) -> Rays:
        """See `Twin`."""
        asked = parameters, points, points if anchors is None else anchors
        if not (self._asked and all(map(np.array_equal, asked, self._asked))):
            self._asked, self._rays = asked, self._twin.trace(*asked)
        return self._rays


class FieldSolver(Protocol):
    """Turns a frame pair into the signal field on the common grid of `lightpage.waves.grid`."""

    def __call__(
        self,
        pair: FramePair,
        references: FramePair,
        registration: NDArray[np.float32],
        homodyne: NDArray[np.float32],
        apart: Mapping[str, NDArray[np.float32]],
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        """Field [ny, nx] over the mean reference amplitude, and what is left of the homodyne equations, [2, ny, nx].

        Args:
            pair, references: frames [H, W].
            registration: [2, 2, 10], see `lightpage.calibration.sampling_table`.
            homodyne: [2], cosine and sine of the turn between the arms.
            apart: see `lightpage.calibration.sampling_table.needed_apart`.
        """
        ...
