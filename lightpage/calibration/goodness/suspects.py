"""Search for the likeliest cause of light that a fit leaves unexplained."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.goodness.light import PageLight, places_on_facet, radius2
from lightpage.calibration.parameters import NAMES, PRIORS, indices

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_BENDS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of (x, y) of phases over the page."""
_STEP = 1e-4
_RANK = 1e-4
"""Singular values are dropped below this share of the largest."""
_LOCAL = 0.3
"""Least share of the residual's power in a hundredth of the equations that shows a local fault; noise has 0.08."""
_FOREIGN = 0.1
"""Least mean square of the symbols' relative errors that shows the light of other symbols."""
_LEAST_SHARE = 0.2
"""Least share of the unexplained light that a correction of the model explains to be called the likeliest cause."""
_UNLIKELY = 8.0
"""Least deviation of a length that shows another device than the profile's, in standard deviations of the prior."""

LEVELS = "levels whose phases no smooth curve tells: is the modulator's lookup table right?"
NEIGHBOURS = "phases that go with those of the symbols beside: is there crosstalk between the modulator's pixels?"


def unlike_profile(parameters: Real) -> str:
    """Name the length of a fitted device [P] that shows that its profile is another device's, in words; empty if none.

    Light that such a fit explains may be read all the same.
    """
    off = {index: abs(parameters[index]) / PRIORS[index] for index in indices("lengths")}
    furthest = max(off, key=lambda index: off[index])
    if off[furthest] < _UNLIKELY:
        return ""
    name = NAMES[furthest].removesuffix("_relative").replace("_", " ")
    return f"a {name} {parameters[furthest]:+.1%} off the profile's: is this the device's profile?"


def likeliest(light: PageLight, errors: Complex) -> str:
    """Name the likeliest error of the model or of the page, in words.

    Args:
        light: light of a known page.
        errors: errors of its symbols, minus their smooth part.
    """
    fitted = scipy.linalg.orth(_of_unit_length(list(light.equations_of_fit())), rcond=_RANK)
    residual = _orthogonal_part(fitted, light.equation_residual[:, None])[:, 0]

    def share(columns: list[Real]) -> float:
        matrix = _orthogonal_part(fitted, _of_unit_length(columns))
        solution = np.linalg.lstsq(matrix, residual, rcond=_RANK)[0]
        return 1 - float(np.sum((residual - matrix @ solution) ** 2) / np.sum(residual**2))

    words, most = max(((words, share(columns)) for words, columns in _suspects(light)), key=lambda suspect: suspect[1])
    if most > _LEAST_SHARE:
        return f"{words} ({most:.0%} of what is left)"
    power = np.sort(residual**2)
    if power[-len(power) // 100 :].sum() > _LOCAL * power.sum():
        return "light in few places: is there dust, are there hot pixels?"
    if np.mean(np.abs(errors) ** 2) > _FOREIGN:
        return "light of other symbols: are these the pages that were written, and is this their profile?"
    return "nothing that the model knows: light comes by a way that it lacks, or not all symbols are as written"


def _of_unit_length(columns: list[Real]) -> Real:
    """Matrix of the columns that are not zero, each divided by its length."""
    lengths = [float(np.linalg.norm(column)) for column in columns]
    return np.stack([column / length for column, length in zip(columns, lengths, strict=True) if length > 0], axis=1)


def _orthogonal_part(fitted: Real, columns: Real) -> Real:
    """Part of the columns that is orthogonal to `fitted`, whose columns are orthonormal."""
    return np.asarray(columns - fitted @ (fitted.T @ columns))


def _suspects(light: PageLight) -> Iterator[tuple[str, list[Real]]]:
    """Yield each possible cause in words, with the columns by which it would change the equations."""
    coarse, page = light.coarse, light.page
    leaving, (across, up), squares = coarse.to_exit(page), places_on_facet(coarse), radius2(coarse)
    one = np.array([1, 0])[:, None, None]

    def at_exit(factor: Real) -> list[Real]:
        """A phase over the exit facet, seen by either camera alone."""
        change = coarse.from_exit(1j * leaving * factor)
        return [light.equations_of(change * chosen) for chosen in (one, 1 - one)]

    yield "a curvature over the exit facet: are the cameras in focus?", at_exit(squares)
    slopes = [*at_exit(across), *at_exit(up)]
    yield "a slope over the exit facet: do both cameras see the image where they did in the references?", slopes
    yield (
        "a saddle over the exit facet: is the second lens askew?",
        [*at_exit(across**2 - up**2), *at_exit(across * up)],
    )
    entering = coarse.from_exit(coarse.to_exit(page, 1j * squares))
    yield "a curvature over the entrance facet: is the modulator in focus?", [light.equations_of(entering)]
    x, y = light.waves.x[None, :], light.waves.y[:, None]
    bent = [light.equations_of(coarse.to_cameras(1j * page * x**i * y**j)) for i, j in _BENDS]
    yield "a phase over the page: is the modulator flat?", bent
    here = coarse.from_exit(leaving)
    curved = coarse.from_exit(1j * leaving * squares)
    tilted = [curved * place * chosen for place in light.coarse_places for chosen in (one, 1 - one)]
    yield "a focus that changes over the image: are the cameras tilted?", [*map(light.equations_of, tilted)]
    mixed = [factor * page * step**power for power, factor in ((1, 1j), (2, 1)) for step in light.steps]
    yield NEIGHBOURS, [light.equations_of(coarse.to_cameras(each)) for each in mixed]
    higher = light.changed(pipe_height_relative=_STEP).to_cameras(page) - here
    yield "walls of the pipe that are not equally far apart in x and y", [light.equations_of(higher)]
    length = light.waves.channel.geometry.pipe_length_m
    ghost = light.changed(pipe_length_m=3 * length).to_cameras(page)
    yield "light that passes the pipe three times", [light.equations_of(each) for each in (ghost, 1j * ghost)]
