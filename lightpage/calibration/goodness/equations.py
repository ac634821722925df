"""Equations of a page's counts on the coarse grid, and how they change by parameters, noise, and faults of cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.goodness.frame_noise import CountCurve
from lightpage.calibration.goodness.light import PageLight, coarse_page, interpolated, rows_and_columns
from lightpage.calibration.parameters import PARAMETERS, SEEN_BY_CAMERAS, STEPS
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]


def equations_of_fit(light: PageLight) -> Iterator[Real]:
    """Yield the change of the equations, flat, by a small change of each parameter that the twin knows."""
    page = coarse_page(light)
    leaving = light.coarse.to_exit(page)
    fields = light.coarse.from_exit(leaving)
    places = np.stack(np.meshgrid(light.grid.x_m, light.grid.y_m), axis=-1)[light.every]

    def change_by(index: int) -> Real:
        moved = light.device.parameters.copy()
        moved[index] += STEPS[index]
        if index in SEEN_BY_CAMERAS:
            at = rows_and_columns(light.twin.pixels(moved, places.reshape(-1, 2)).reshape(2, *places.shape))
            counts = interpolated(light.images, at) / (2 * light.references[:, *light.every])
            return light.equations(counts - light.counts[:, *light.every])
        changed = light.coarse.moved(index, light.changed(moved), page, leaving, fields)
        return light.equations_of(changed - fields)

    yield from in_parallel(change_by, range(min(light.twin.known, len(PARAMETERS))))


def noise_equations(light: PageLight, modulator_variance_rad2: float) -> Real:
    """Draw noise of the equations on the coarse grid, over their noise, flat.

    Args:
        modulator_variance_rad2: variance of the modulator's phase, a sample.
    """
    deviation = np.sqrt(modulator_variance_rad2)
    noise = deviation * np.random.default_rng(1).standard_normal(light.page.shape)
    by_modulator = light.waves.to_cameras(1j * noise * light.page)[:, *light.every]
    return light.equations(light.drawn_counts) + light.equations_of(by_modulator)


def equations_of_contrast(light: PageLight) -> list[Real]:
    """Change of the equations, flat, by more signal with as much interference, and by more of both; each camera's.

    The part that depends on the expected count alone is taken off, as `correct_counts` takes it off the residual.
    """
    interference, power = light.interference_and_power()
    columns = []
    for camera, (level, brightness) in enumerate(zip(light.references, light.brightness, strict=True)):
        expected = level * brightness
        for term in (power[camera] / 2, interference[camera] / 2 + power[camera]):
            curve = CountCurve.measured(expected[light.visible], term[light.visible])
            change = np.zeros_like(light.counts)
            change[camera] = term - curve.at(expected)
            columns.append(light.equations(change))
    return columns


def equations_near(light: PageLight, pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which equations, flat, take in one of some pixels of either camera, [2, H, W]."""
    reach = len(light.grid.prefilter) // 2 + 1
    near = np.stack([scipy.ndimage.binary_dilation(each, iterations=reach) for each in pixels])
    chosen = [
        scipy.ndimage.map_coordinates(one.astype(np.uint8), at, order=0, mode="nearest")
        for one, at in zip(near, light.at, strict=True)
    ]
    return np.asarray(np.stack(chosen)[:, *light.every][:, light.visible[light.every]].ravel() > 0)


def coarse_places(light: PageLight) -> tuple[Real, Real]:
    """Coordinates x [1, nx] and y [ny, 1] of the coarse grid, over its half width and half height."""
    x = light.grid.x_m[:: light.stride]
    y = light.grid.y_m[:: light.stride]
    return (x / light.grid.x_m[-1])[None, :], (y / light.grid.y_m[-1])[:, None]
