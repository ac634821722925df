"""Split of what a fit leaves unexplained among causes for which there is a remedy.

Each cause changes the equations of the cameras' counts by known columns, or at known places. The residual is split by
matching pursuit: the cause that explains most of the power beyond that of noise is taken off, and the search begins
again. Columns of the fitted parameters are taken off first, since a new fit would explain their part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.goodness.equations import coarse_places, equations_of_contrast, equations_of_fit
from lightpage.calibration.goodness.ghost import changes_by_ghost
from lightpage.calibration.goodness.light import PageLight, coarse_page, places_on_facet, radius2
from lightpage.calibration.goodness.remedies import CAMERA_TILT, CONTRAST, GHOST, NEIGHBOURS, UNKNOWN, WALLS, cause_of
from lightpage.calibration.goodness.verdict import Cause, Reading
from lightpage.calibration.parameters import NAMES, PRIORS, as_dict, indices
from lightpage.calibration.waves.wave_model import tilts_of_cameras_apart
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_BENDS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of (x, y) of phases over the page."""
_STEPS = (1e-4, -5e-4, 5e-4, -2e-3, 2e-3)
"""Changes of the pipe's widths. The light bends away from its tangent at some of them."""
_RANK = 1e-4
"""Singular values are dropped below this share of the largest."""
_LEAST_SHARE = 0.01
"""Least share of a residual's power that a cause explains to be named."""
_CHANCE = 4.0
"""Least ratio of the power that a cause explains to the power of noise that its columns explain by chance."""
_MOST_CAUSES = 6
"""Largest number of causes that are taken off."""
_USUALLY_READ = 0.97
"""Share of the light's information that a decoder reads of a usual device."""
_LEAST_UNREAD = 0.05
"""Least information that a reading lacks beyond what causes cost, for it to have a cause, bits a symbol."""
_TILTED_RAD = 0.1
"""Tilt of the cameras apart from which on a decoder reads less, radians."""
_UNLIKELY = 8.0
"""Least deviation of a length that shows another device than the profile's, in standard deviations of the prior."""


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


def with_unread(causes: tuple[Cause, ...], reading: Reading, parameters: Real) -> tuple[Cause, ...]:
    """Add to the causes what pages lose that the fit explains: their decoder predicts light less exactly.

    Decoders follow cameras that are tilted otherwise than each other only roughly.

    Args:
        causes: causes of what the fit does not explain, the largest first, and what is unknown last.
        reading: reading of known pages.
        parameters: of the device, [P].
    """
    expected = _USUALLY_READ * reading.light_bits - sum(cause.bits for cause in causes)
    unread = expected - reading.air_bits
    if unread < _LEAST_UNREAD:
        return causes
    tilted = np.hypot(*tilts_of_cameras_apart(as_dict(parameters))) > _TILTED_RAD
    name = CAMERA_TILT if tilted else UNKNOWN
    known = sum(cause.bits for cause in causes if cause.name == name)
    added = [*(cause for cause in causes if cause.name != name), cause_of(name, known + unread)]
    return tuple(sorted(added, key=lambda cause: (cause.name == UNKNOWN, -cause.bits)))


def shares_of(
    light: PageLight, noise: Real, known: Complex, places: Mapping[str, NDArray[np.bool_]]
) -> dict[str, float]:
    """Split the unexplained power of a page's equations among causes.

    Args:
        light: light of a known page, after its corrections.
        noise: noise of the equations, as drawn from that of frames and modulator, [N].
        known: relative errors of the modulator's samples that are explained already, [ny samples, nx samples].
        places: equations that each local cause spoils, by its name, [N] each.

    Returns:
        Share of the power beyond that of noise that each cause explains, by name, the largest first.
    """
    fitted = scipy.linalg.orth(_of_unit_length(list(equations_of_fit(light))), rcond=_RANK)
    explained = light.equations_of(light.waves.to_cameras(known * light.page)[:, *light.every])
    residual = _orthogonal_part(fitted, light.equation_residual - explained)
    chance = _orthogonal_part(fitted, noise)
    power = float(residual @ residual)
    excess = power - float(chance @ chance)
    bases = {name: _orthonormal(fitted, columns) for name, columns in _suspects(light)}
    local = {name: where for name, where in places.items() if where.any() and not where.all()}
    shares: dict[str, float] = {}
    while len(shares) < _MOST_CAUSES:
        bases = {name: basis for name, basis in bases.items() if basis.shape[1]}
        gains = {name: _gain(basis, residual, chance) for name, basis in bases.items()}
        gains |= {name: _local_gain(where, residual) for name, where in local.items()}
        best = max(gains, key=lambda name: gains[name], default="")
        if not best or gains[best] < _LEAST_SHARE * power:
            break
        shares[best] = gains[best]
        if best in local:
            where = local.pop(best)
            residual = np.where(where, 0, residual)
            chance = np.where(where, 0, chance)
            bases = {name: basis * ~where[:, None] for name, basis in bases.items()}
            fitted = np.asarray(scipy.linalg.orth(fitted * ~where[:, None], rcond=_RANK))
            residual, chance = (_orthogonal_part(fitted, each) for each in (residual, chance))
            bases = {name: _orthonormal(fitted, list(basis.T)) for name, basis in bases.items()}
        else:
            basis = bases.pop(best)
            residual = _orthogonal_part(basis, residual)
            chance = _orthogonal_part(basis, chance)
            bases = {name: _orthonormal(basis, list(other.T)) for name, other in bases.items()}
    total = max(excess, sum(shares.values()))  # the noise of the modulator may be estimated too high
    return {name: gain / total for name, gain in shares.items()}


def _gain(basis: Real, residual: Real, chance: Real) -> float:
    """Power of a residual that a basis explains beyond that of chance; 0 where chance explains about as much."""
    explained = float(np.sum((basis.T @ residual) ** 2))
    by_chance = float(np.sum((basis.T @ chance) ** 2))
    return explained - by_chance if explained > _CHANCE * by_chance else 0.0


def _local_gain(where: NDArray[np.bool_], residual: Real) -> float:
    """Power of a residual at some equations beyond that of as many others."""
    return float(np.sum(residual[where] ** 2) - np.mean(residual[~where] ** 2) * np.count_nonzero(where))


def _orthonormal(fitted: Real, columns: list[Real]) -> Real:
    """Orthonormal basis of the part of columns that is orthogonal to `fitted`, whose columns are orthonormal."""
    matrix = _of_unit_length(columns)
    beyond = matrix - fitted @ (fitted.T @ matrix)
    return np.asarray(scipy.linalg.orth(beyond, rcond=_RANK)) if np.linalg.norm(beyond) > _RANK else beyond[:, :0]


def _of_unit_length(columns: list[Real]) -> Real:
    """Matrix of the columns that are not zero, each divided by its length."""
    lengths = [float(np.linalg.norm(column)) for column in columns]
    units = [column / length for column, length in zip(columns, lengths, strict=True) if length > 0]
    return np.stack(units, axis=1) if units else np.zeros((len(columns[0]) if columns else 0, 0))


def _orthogonal_part(fitted: Real, column: Real) -> Real:
    """Part of a column that is orthogonal to `fitted`, whose columns are orthonormal."""
    return np.asarray(column - fitted @ (fitted.T @ column))


def _suspects(light: PageLight) -> Iterator[tuple[str, list[Real]]]:
    """Yield each possible cause with the columns by which it would change the equations."""
    coarse = light.coarse
    page = coarse_page(light)
    leaving = coarse.to_exit(page)  # lenses and pipe are made before threads ask for them
    here = coarse.from_exit(leaving)
    across, up = places_on_facet(coarse)
    squares = radius2(coarse)
    x = coarse.x[None, :]
    y = coarse.y[:, None]
    one = np.array([1, 0])[:, None, None]

    def at_exit(*factors: Real) -> list[Complex]:
        """Phases over the exit facet, seen by either camera alone."""
        changes = [coarse.from_exit(1j * leaving * factor) for factor in factors]
        return [change * chosen for change in changes for chosen in (one, 1 - one)]

    def at_entrance(*factors: Real) -> list[Complex]:
        """Phases over the entrance facet that vary over the page."""
        return [coarse.from_exit(coarse.to_exit(np.asarray(page * factor), 1j * squares)) for factor in factors]

    def tilted() -> list[Complex]:
        curved = coarse.from_exit(1j * leaving * squares)
        return [curved * place * chosen for place in coarse_places(light) for chosen in (one, 1 - one)]

    def by_geometry(name: str) -> list[Complex]:
        return [light.changed(None, **{name: step}).to_cameras(page) - here for step in _STEPS]

    def mixed() -> list[Complex]:
        pages = [factor * light.page * step**power for power, factor in ((1, 1j), (2, 1)) for step in light.steps]
        return [light.waves.to_cameras(each)[:, *light.every] for each in pages]

    suspects: dict[str, Callable[[], list[Complex]]] = {
        "camera focus": lambda: at_exit(squares),
        "image moved": lambda: at_exit(across, up),
        "lens askew": lambda: at_exit(across**2 - up**2, across * up),
        "modulator focus": lambda: at_entrance(np.ones_like(x)),
        "modulator bent": lambda: [coarse.to_cameras(1j * page * x**i * y**j) for i, j in _BENDS],
        CAMERA_TILT: tilted,
        "modulator tilt": lambda: at_entrance(x, y),
        WALLS: lambda: by_geometry("pipe_height_relative"),
        "taper": lambda: by_geometry("pipe_taper"),
        GHOST: lambda: changes_by_ghost(light),
        NEIGHBOURS: mixed,
    }
    changes = in_parallel(lambda name: [light.equations_of(each) for each in suspects[name]()], [*suspects])
    yield from zip(suspects, changes, strict=True)
    yield CONTRAST, equations_of_contrast(light)
