"""The tables of a report, as rows of text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.parameters import PARAMETERS, Parameter
from lightpage.report.contents.data import Real, ReportData
from lightpage.report.words import number, signed

GROUPS = {
    "angle": "Pipe angle",
    "lengths": "Lengths",
    "centre": "Centre of the page",
    "roll": "Roll of the pipe",
    "walls": "Centre of the pipe",
    "launch": "Phase over the page, at its corner",
    "camera_phase": "Phase against the reference over the cameras",
    "distortion": "Distortion, at the corner",
    "in_phase": "In-phase camera",
    "quadrature": "Quadrature camera",
    "axial": "Axial places, as phases at the pipe's wall",
    "keystone": "Keystone, at the page's edges",
    "tilt": "Tilts of modulator and cameras",
    "tilt_apart": "Half of what the cameras' tilts differ in",
}
"""Headings of the groups of `lightpage.calibration.parameters`."""

_SUFFIXES = {
    "_rad": ("rad", 1.0),
    "_m": ("µm", 1e6),
    "_px": ("px", 1.0),
    "_relative": ("%", 100.0),
    "_slope": ("mrad", 1e3),
}
"""Shown unit and what a value is multiplied by, by the end of a parameter's name; small slopes are angles."""

WORST_SHARE = 0.1


@dataclass(frozen=True)
class Fitted:
    """A fitted number with its standard deviation, as shown."""

    name: str
    value: str
    deviation: str
    unit: str


@dataclass(frozen=True)
class Zone:
    """Data symbols that meet the walls equally often, on the same side.

    Attributes:
        name: signed reflections at the walls x and y'.
        reflections: how many these are.
        symbols: data symbols on a page.
        air, own_mi, over_claim: mean, bits per symbol.
        error_deg: mean of the phase error's magnitude, degrees.
        worst_air: AIR that a tenth of the symbols' places do not exceed, mean over the pages.
    """

    name: str
    reflections: tuple[int, int]
    symbols: int
    air: float
    own_mi: float
    over_claim: float
    error_deg: float
    worst_air: float


def geometry(data: ReportData) -> list[tuple[str, list[Fitted]]]:
    """Fitted parameters by group, with heading."""
    groups: dict[str, list[Fitted]] = {}
    for parameter in PARAMETERS:
        if parameter.name not in data.calibration.fitted:
            continue
        groups.setdefault(parameter.group, []).append(_fitted(parameter, data))
    return [(GROUPS[group], rows) for group, rows in groups.items()]


def _fitted(parameter: Parameter, data: ReportData) -> Fitted:
    name, profile = parameter.name, data.profile
    value, deviation = data.calibration.parameters[name], data.calibration.deviations[name]
    nominal = {
        "focal_length_relative": 1e3 * profile.lens.focal_length_m,
        "pipe_length_relative": 1e3 * profile.pipe.length_m,
        "pipe_width_relative": 1e3 * profile.pipe.width_m,
    }
    if name == "pipe_angle_rad":
        angle = data.calibration.angle_deg(profile)
        return Fitted("pipe angle, nominal included", *_with_deviation(angle, float(np.rad2deg(deviation))), "degree")
    if name == "pipe_roll_rad":
        return Fitted("pipe roll", *_with_deviation(float(np.rad2deg(value)), float(np.rad2deg(deviation))), "degree")
    if name in nominal:
        shown = _with_deviation(nominal[name] * (1 + value), nominal[name] * deviation)
        return Fitted(f"{_words(name, '_relative')} (nominal {nominal[name]:g})", *shown, "mm")
    suffix = next(end for end in _SUFFIXES if name.endswith(end))
    unit, factor = _SUFFIXES[suffix]
    return Fitted(_words(name, suffix), *_with_deviation(factor * value, factor * deviation), unit)


def _words(name: str, suffix: str) -> str:
    return name.removesuffix(suffix).replace("in_phase", "in-phase").replace("_", " ")


def _with_deviation(value: float, deviation: float) -> tuple[str, str]:
    """Format a value and its deviation, both to the second digit of the deviation."""
    digits = 6 if deviation <= 0 else min(9, max(0, 1 - int(np.floor(np.log10(deviation)))))
    return number(value, digits), number(deviation, digits)


def zones(data: ReportData, centroids: Real) -> list[Zone]:
    """Return a row for each zone, from top left to bottom right.

    Args:
        data: data of the report.
        centroids: exit centroids over the pipe's width, [2, ny, nx].
    """
    cells = np.rint(centroids).astype(int)
    # the lens turns the page round: what lies to its left and top leaves on the positive sides
    found = sorted({(y, x) for x, y in cells[:, data.data].T.tolist()}, reverse=True)
    return [
        _zone(f"{signed(x)}, {signed(y)}", (abs(x), abs(y)), data, data.data & (cells[0] == x) & (cells[1] == y))
        for y, x in found
    ]


def _zone(name: str, reflections: tuple[int, int], data: ReportData, where: NDArray[np.bool_]) -> Zone:
    air, own = data.maps.air[where], data.maps.own_mi[where]
    return Zone(
        name=name,
        reflections=reflections,
        symbols=int(np.count_nonzero(where)),
        air=float(air.mean()),
        own_mi=float(own.mean()),
        over_claim=float((own - air).mean()),
        error_deg=float(np.rad2deg(data.maps.error_rad[where].mean())),
        worst_air=float(np.quantile(air, WORST_SHARE)),
    )
