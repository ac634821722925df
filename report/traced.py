"""Rays that a report traces through the device, in torch."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from lightpage.calibration.document import Calibration
from lightpage.calibration.sampling_table import symbol_centres
from lightpage.device.profile import Profile
from lightpage.report.contents.data import Real, ReportData
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.published.rays import RayTracer

_RAYS = 15


def exit_centroids(profile: Profile, calibration: Calibration) -> Real:
    """Return the exit centroid of each symbol in a pipe without walls, over its width, (x, y') [2, ny, nx].

    Rounded, these are the symbol's zone: how often it meets the walls x and y', with the sign of the side.
    """
    positions = TorchTwin(RayTwin(profile)).trace(calibration.vector, symbol_centres(profile)).positions
    return np.ascontiguousarray(positions.T.reshape(2, *profile.page_shape))


def ray_paths(data: ReportData) -> list[tuple[Real, NDArray[np.int64]]]:
    """Return rays of a row and of a column: paths [K, N, 3] in millimetres, and reflections [N] at their walls."""
    tracer = RayTracer(data.profile, data.rays.lens)
    angle = torch.tensor(math.radians(data.rays.angle_deg), dtype=torch.float64)
    found = []
    for axis, extent in enumerate((data.profile.page_width_m, data.profile.page_height_m)):
        points = torch.zeros(_RAYS, 2, dtype=torch.float64)
        points[:, axis] = torch.linspace(-0.49, 0.49, _RAYS, dtype=torch.float64) * extent
        with torch.no_grad():
            path, met = 1e3 * tracer.path(points, angle).numpy(), tracer(points, angle).reflections[:, axis].numpy()
        found.append((path, met))
    return found
