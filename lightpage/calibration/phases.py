"""Smooth phases of a device that no ray explains: launch side over the page, camera side against the reference.

Written with arithmetic alone, so that the torch twin and the numpy wave localizer share them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def launch_phase(value: Mapping[str, Any], x: Any, y: Any) -> Any:
    """Aberrations of the launch side, radians.

    Args:
        value: parameters by name (`lightpage.calibration.parameters`).
        x, y: page points over the page's corner radius, arrays or tensors that broadcast.
    """
    radius2 = x * x + y * y
    return (
        value["launch_defocus_rad"] * radius2
        + value["launch_astigmatism_0_rad"] * (x * x - y * y)
        + value["launch_astigmatism_45_rad"] * 2 * x * y
        + value["launch_coma_x_rad"] * radius2 * x
        + value["launch_coma_y_rad"] * radius2 * y
    )


def camera_phase(value: Mapping[str, Any], x: Any, y: Any, edge_x: float, edge_y: float) -> Any:
    """Phase of the signal against the reference beam over the camera plane, radians.

    Args:
        value: parameters by name.
        x, y: camera-plane points over the page's corner radius, arrays or tensors that broadcast.
        edge_x, edge_y: half width and half height of the page over its corner radius, where the tilts are stated.
    """
    return (
        value["camera_tilt_x_rad"] * x / edge_x
        + value["camera_tilt_y_rad"] * y / edge_y
        + value["camera_curvature_rad"] * (x * x + y * y)
        + value["camera_astigmatism_0_rad"] * (x * x - y * y)
        + value["camera_astigmatism_45_rad"] * 2 * x * y
    )


def tilt_of_shift(
    value: Mapping[str, float], shift_m: NDArray[np.float64], half_width_m: float, half_height_m: float
) -> NDArray[np.float64]:
    """Return the tilt of `camera_phase` at the page's edges that a shift of the image over a fixed reference adds.

    The gradient of its quadratic terms times the shift; the constant that is left over is piston.

    Args:
        value: parameters by name.
        shift_m: (x, y) by which the image moves in the camera plane, metres.
        half_width_m, half_height_m: half sizes of the page.

    Returns:
        (camera_tilt_x_rad, camera_tilt_y_rad), [2].
    """
    curved, straight, diagonal = (
        value[f"camera_{name}_rad"] for name in ("curvature", "astigmatism_0", "astigmatism_45")
    )
    bend = np.array([[curved + straight, diagonal], [diagonal, curved - straight]])
    corner_squared = half_width_m**2 + half_height_m**2
    return np.asarray(2 * (bend @ shift_m) * [half_width_m, half_height_m] / corner_squared, np.float64)
