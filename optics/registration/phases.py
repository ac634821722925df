"""Smooth phases of a device that no ray explains: launch side over the page, camera side against the reference.

Written with arithmetic alone, so that the torch twin and the numpy wave localizer share them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def launch_phase(value: Mapping[str, Any], x: Any, y: Any) -> Any:
    """Aberrations of the launch side, radians.

    Args:
        value: parameters by name (`optics.registration.parameters`).
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
