"""The parameters of a ray twin: names, units, and how far each may lie from nominal before data are seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """Parameter that calibration may fit; its nominal value is zero.

    Attributes:
        name: name with the unit as its suffix; `relative` and `slope` are dimensionless.
        prior: standard deviation about nominal, in the parameter's unit.
        group: the part of the device that it describes; stages of a fit free whole groups.
    """

    name: str
    prior: float
    group: str


PARAMETERS: tuple[Parameter, ...] = (
    Parameter("pipe_angle_rad", 0.012, "angle"),
    Parameter("focal_length_relative", 0.002, "lengths"),
    Parameter("pipe_length_relative", 0.003, "lengths"),
    Parameter("pipe_width_relative", 0.0004, "lengths"),
    Parameter("page_centre_x_m", 40e-6, "centre"),
    Parameter("page_centre_y_m", 40e-6, "centre"),
    Parameter("pipe_roll_rad", 0.005, "roll"),
    Parameter("pipe_centre_x_m", 1e-6, "walls"),
    Parameter("pipe_centre_y_m", 1e-6, "walls"),
    # phase over the page at the launch side, radians at the page's corner
    Parameter("launch_defocus_rad", 1.5, "launch"),
    Parameter("launch_astigmatism_0_rad", 1.5, "launch"),
    Parameter("launch_astigmatism_45_rad", 1.0, "launch"),
    Parameter("launch_coma_x_rad", 1.5, "launch"),
    Parameter("launch_coma_y_rad", 1.0, "launch"),
    # of the lenses' path beyond the ideal one, which the profile states; a device whose lenses are ideal lies at -1
    Parameter("lens_path_relative", 0.5, "launch"),
    # phase of the signal against the reference over the camera plane; tilts at the edges, the rest at the corner
    Parameter("camera_tilt_x_rad", 3.0, "camera_phase"),
    Parameter("camera_tilt_y_rad", 3.0, "camera_phase"),
    Parameter("camera_curvature_rad", 2.0, "camera_phase"),
    Parameter("camera_astigmatism_0_rad", 0.1, "camera_phase"),
    Parameter("camera_astigmatism_45_rad", 0.1, "camera_phase"),
    Parameter("distortion_relative", 0.002, "distortion"),
    *(
        Parameter(f"{camera}_{name}", prior, camera)
        for camera in ("in_phase", "quadrature")
        for name, prior in (
            ("shift_x_px", 10.0),
            ("shift_y_px", 10.0),
            ("scale_x_relative", 0.008),
            ("scale_y_relative", 0.008),
            ("turn_xy_slope", 0.005),
            ("turn_yx_slope", 0.005),
        )
    ),
    # defocus: phase on the facet that a plane off its focal plane makes, radians at the middle of the facet's wall
    Parameter("modulator_axial_rad", 0.5, "axial"),
    Parameter("in_phase_axial_rad", 0.5, "axial"),
    Parameter("quadrature_axial_rad", 0.5, "axial"),
    # change of a camera's scale from the page's centre to its edge, as a tilted sensor has
    *(
        Parameter(f"{camera}_keystone_{axis}_relative", 0.001, "keystone")
        for camera in ("in_phase", "quadrature")
        for axis in "xy"
    ),
    # how much larger that defocus is at the right and at the lower edge of the page than in its middle, as a tilted
    # plane has it: the modulator's, and both cameras' on average
    *(Parameter(f"{plane}_axial_{axis}_rad", 0.2, "tilt") for plane in ("modulator", "cameras") for axis in "xy"),
    # half of what that is for the in-phase camera beyond the quadrature one
    *(Parameter(f"cameras_apart_{axis}_rad", 0.2, "tilt_apart") for axis in "xy"),
)

GROUPS: tuple[str, ...] = tuple(dict.fromkeys(p.group for p in PARAMETERS))
"""Groups of all parameters."""
NAMES: tuple[str, ...] = tuple(p.name for p in PARAMETERS)
_FIRST_UNKNOWN = ("modulator_axial_rad", "modulator_axial_x_rad", "cameras_apart_x_rad")
KNOWN = (*map(NAMES.index, _FIRST_UNKNOWN), len(NAMES))
"""Counts of parameters that twins know: those of bundles of before, which took planes for those of the profile, knew
their axial places alone, or one tilt for both cameras; all."""
PRIORS: Real = np.array([p.prior for p in PARAMETERS])
_STEPS = {"axial": 1e-2, "tilt": 0.1, "tilt_apart": 0.1}
STEPS: Real = PRIORS * [_STEPS.get(p.group, 3e-3) for p in PARAMETERS]
"""Steps of finite differences of the light: long enough for what rounding adds, though a plane's tilt changes little,
and short enough for the light to be straight along them."""


class Prior(NamedTuple):
    """Normal distribution of a device's parameters before data are seen.

    Attributes:
        centre: mean, [P].
        deviations: standard deviations, [P].
    """

    centre: Real
    deviations: Real


def nominal() -> Real:
    """The nominal parameter vector [P]."""
    return np.zeros(len(PARAMETERS))


def indices(*groups: str) -> list[int]:
    """Positions of all parameters of the given groups, in vector order."""
    known = {p.group for p in PARAMETERS}
    unknown = set(groups) - known
    if unknown:
        raise KeyError(f"parameter groups: got {sorted(unknown)}, wanted some of {sorted(known)}")
    return [i for i, p in enumerate(PARAMETERS) if p.group in groups]


SEEN_BY_CAMERAS = frozenset(indices("in_phase", "quadrature", "distortion", "keystone"))
"""Parameters that say where the cameras see a place; all others change the light itself."""


def as_dict(parameters: Real) -> dict[str, float]:
    """A vector [P] as name -> value."""
    return {name: float(value) for name, value in zip(NAMES, parameters, strict=True)}


def as_vector(values: dict[str, float]) -> Real:
    """Name -> value as a vector [P]; every name must be there and no other."""
    if set(values) != set(NAMES):
        raise KeyError(f"parameters: got {sorted(set(values) ^ set(NAMES))} missing or extra, wanted exactly {NAMES}")
    return np.array([values[name] for name in NAMES], dtype=np.float64)
