"""Distance of the pipe's walls along y' against that along x, fitted to a known page with the other parameters.

Calibration takes both distances for one. Where they differ, its other parameters have taken up part of the difference,
so all are fitted anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.goodness.equations import equations_of_fit
from lightpage.calibration.goodness.frame_noise import CountCurve
from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.parameters import PARAMETERS, PRIORS, SEEN_BY_CAMERAS, STEPS
from lightpage.calibration.waves.wave_fit import inverse_of_information
from lightpage.calibration.waves.wave_model import illumination_terms

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_STEP = 1e-4
"""Finite difference of the relative height."""
_ROUNDS = 5
"""Steps, of which some may be refused."""
_DAMPING = 1e-3
"""First damping of the steps (Levenberg-Marquardt)."""


class RelativeHeight(NamedTuple):
    """Distance of the walls along y' over that along x, less one.

    Attributes:
        value: the fitted value.
        deviation: its standard deviation.
    """

    value: float
    deviation: float


def relative_height(light: PageLight) -> RelativeHeight:
    """Fit the relative height of the pipe to the light of a known page."""
    page = light.page
    here = light.coarse.to_cameras(page)
    of_light = [index for index in range(min(light.twin.known, len(PARAMETERS))) if index not in SEEN_BY_CAMERAS]
    by_cameras = [column for index, column in enumerate(equations_of_fit(light)) if index in SEEN_BY_CAMERAS]
    offset = light.fields[:, *light.every] - here
    lit = [light.coarse.to_cameras(page * term) for term in illumination_terms(light.waves.x, light.waves.y)]
    by_illumination = [light.equations_of(factor * each) for each in lit for factor in (1, 1j)]
    best = np.append(light.device.parameters, 0.0)
    fewest = float(np.mean(_residual(light, light.fields[:, *light.every]) ** 2))
    damping = _DAMPING
    deviation = 0.0
    for _ in range(_ROUNDS):
        fields = _fields(light, best)
        columns = [(_fields(light, moved) - fields) / step for moved, step in _steps(best, of_light)]
        matrix = np.stack([*map(light.equations_of, columns), *by_illumination, *by_cameras], axis=1)
        right = _residual(light, offset + fields)
        precision = np.zeros(matrix.shape[1])
        precision[: len(of_light)] = fewest / PRIORS[of_light] ** 2
        gradient = matrix.T @ right
        gradient[: len(of_light)] -= precision[: len(of_light)] * best[of_light]
        normal = matrix.T @ matrix + np.diag(precision)
        deviation = float(np.sqrt(inverse_of_information(normal)[len(of_light), len(of_light)] * fewest))
        step = inverse_of_information(normal + damping * np.diag(np.diag(normal))) @ gradient
        moved = best.copy()
        moved[[*of_light, -1]] += step[: len(of_light) + 1]
        noise = float(np.mean(_residual(light, offset + _fields(light, moved)) ** 2))
        if noise < fewest:
            best, fewest, damping = moved, noise, damping / 10
        else:
            damping *= 10
    return RelativeHeight(float(best[-1]), deviation)


def _residual(light: PageLight, fields: Complex) -> Real:
    """Residual of the equations on the coarse grid, flat, if the cameras' light were `fields` there.

    The mean counts are corrected as by `PageLight.correct_counts`.
    """
    field = fields / light.amplitude[light.every]
    brightness = np.abs(light.arms + field) ** 2
    visible = light.visible[light.every]
    counts = light.counts[:, *light.every] - (brightness - 1) / 2
    for camera, level in enumerate(light.references[:, *light.every]):
        expected = level * brightness[camera]
        curve = CountCurve.measured(expected[visible], counts[camera][visible])
        counts[camera] -= curve.at(expected)
    return light.equations(counts)


def _fields(light: PageLight, parameters: Real) -> Complex:
    """Light of both cameras on the coarse grid by parameters of the device, and the relative height, [P + 1]."""
    return light.changed(parameters[:-1], None, pipe_height_relative=float(parameters[-1])).to_cameras(light.page)


def _steps(parameters: Real, chosen: list[int]) -> Iterator[tuple[Real, float]]:
    """Yield parameters [P + 1] after a step along each chosen one, and along the height, with the step."""
    for index, step in (*((index, float(STEPS[index])) for index in chosen), (-1, _STEP)):
        moved = parameters.copy()
        moved[index] += step
        yield moved, step
