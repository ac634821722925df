"""Relation of cameras that stand apart along the optical axis, where a fit has not explained the light.

Through an astigmatic launch a camera off its plane sees the page stretched along one axis. A fit by places takes that
for two scales of one camera, and the fit by waves does not find back from there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.parameters import NAMES
from lightpage.calibration.waves.wave_fit import WaveFit, WaveFitted
from lightpage.page.modulation import Modulation

Real = NDArray[np.float64]

_APART_RAD = (-2.2, -1.1, 0.0, 1.1, 2.2)
"""Changes of the difference of the cameras' axial places that a fit begins at: their capture range, in steps of half a
basin."""
_ONE_SCALE = 0.03
"""Share of the prior about a camera's scale that holds it while its place is found."""
_TO_PIXELS = ("scale_x_relative", "turn_xy_slope", "turn_yx_slope", "scale_y_relative")
"""Names of a camera's map from the page to pixels, less the identity, row by row."""
_CAMERAS = ("in_phase", "quadrature")


def related_apart(
    fit: WaveFit,
    parameters: Real,
    quadrature_phase: float,
    modulation: Modulation,
    axis: int,
    progress: Callable[[float], None],
) -> WaveFitted:
    """Relate both cameras as ones with a single scale each, and return the best fit of several axial differences.

    Args:
        fit: of a known page.
        parameters: [P] to start from.
        quadrature_phase: angle between the arms, radians.
        modulation: light that the modulator makes of its levels.
        axis: the page's axis, 0 or 1, whose scale is taken for both.
        progress: told of the share that is behind, 0 to 1. It may raise to stop the work.
    """
    held = np.ones_like(parameters)
    held[[NAMES.index(f"{camera}_scale_{name}_relative") for camera in _CAMERAS for name in "xy"]] = _ONE_SCALE
    found = list[WaveFitted]()
    for number, difference in enumerate(_APART_RAD):

        def told(share: float, number: int = number) -> None:
            progress((number + share) / len(_APART_RAD))

        start = _apart(parameters, difference, axis)
        found.append(fit.fit(start, quadrature_phase, _CAMERAS, start, held, told, modulation, effort="once"))
    return min(found, key=lambda one: one.residual)


def _apart(parameters: Real, difference_rad: float, axis: int) -> Real:
    """Return the parameters with the cameras' axial places moved apart and the scale of one axis for both."""
    moved = parameters.copy()
    for camera, share in zip(_CAMERAS, (0.5, -0.5), strict=True):
        moved[NAMES.index(f"{camera}_axial_rad")] += share * difference_rad
        places = [NAMES.index(f"{camera}_{name}") for name in _TO_PIXELS]
        matrix = np.eye(2) + moved[places].reshape(2, 2)
        lengths = np.linalg.norm(matrix, axis=0)
        matrix[:, 1 - axis] *= lengths[axis] / lengths[1 - axis]
        moved[places] = (matrix - np.eye(2)).ravel()
    return moved
