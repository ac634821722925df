"""Samplers: the measured light at any point of the camera plane, from one camera alone or from the recovered field."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.interfaces import Twin
from lightpage.waves.grid import FieldGrid

Real = NDArray[np.float64]

_REFERENCE_SMOOTHING_PX = 3.0
_FRAME_SMOOTHING_PX = 1.2


def smooth_reference(reference: NDArray[np.integer]) -> NDArray[np.float32]:
    """Counts of a reference-only frame [H, W] without its noise, nowhere zero."""
    level = scipy.ndimage.gaussian_filter(reference.astype(np.float32), _REFERENCE_SMOOTHING_PX)
    return np.asarray(np.maximum(level, max(1e-3 * float(level.mean()), 1e-6)), dtype=np.float32)


def linear_light(frame: NDArray[np.integer], reference: NDArray[np.integer]) -> NDArray[np.float32]:
    """A frame [H, W] as a linear estimate of the field's projection on its reference, smoothed, |E|^2 left in."""
    level = smooth_reference(reference)
    linear = (frame.astype(np.float32) - level) / np.sqrt(level)
    return np.asarray(scipy.ndimage.gaussian_filter(linear, _FRAME_SMOOTHING_PX), np.float32)


class FrameSampler:
    """Sampler of one camera's frame: a linear estimate of the field's projection on its reference, |E|^2 not removed.

    Args:
        frame, reference: counts [H, W].
        camera: 0 in-phase, 1 quadrature.
        twin, parameters: registration of the camera plane on the camera.
    """

    def __init__(
        self, frame: NDArray[np.integer], reference: NDArray[np.integer], camera: int, twin: Twin, parameters: Real
    ) -> None:
        self._image = linear_light(frame, reference)
        self._camera, self._twin, self._parameters = camera, twin, parameters

    def __call__(self, places: Real) -> NDArray[np.float32]:
        """Values at camera-plane points [..., 2]."""
        pixels = self._twin.pixels(self._parameters, places.reshape(-1, 2))[self._camera]
        values = scipy.ndimage.map_coordinates(self._image, [pixels[:, 1], pixels[:, 0]], order=1)
        return np.asarray(values, dtype=np.float32).reshape(places.shape[:-1])


class FieldSampler:
    """The recovered complex field."""

    def __init__(self, field: NDArray[np.complex64], grid: FieldGrid) -> None:
        self._parts = [
            scipy.ndimage.spline_filter(part, order=3, output=np.float32) for part in (field.real, field.imag)
        ]
        self._origin = np.array([grid.x_m[0], grid.y_m[0]])
        self._pitch = grid.pitch_m

    def __call__(self, places: Real) -> NDArray[np.complex64]:
        """Values at camera-plane points [..., 2]."""
        column, row = ((places.reshape(-1, 2) - self._origin) / self._pitch).T
        real, imaginary = (
            scipy.ndimage.map_coordinates(p, [row, column], order=3, prefilter=False) for p in self._parts
        )
        return np.asarray(real + 1j * imaginary, dtype=np.complex64).reshape(places.shape[:-1])
