"""Robust least squares: the twin's parameters from local measurements, with weak priors about nominal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from optics.profile import Profile
from optics.registration.parameters import PRIORS
from optics.registration.patches import Measurement
from optics.registration.twin import BRANCHES, Twin

Real = NDArray[np.float64]

_PLACE_FLOOR_PX = 0.15
_SLOPE_FLOOR = 0.02
"""Least error of a slope, radians a symbol."""
_PHASE_FLOOR = 0.05
"""Least error of a phase, radians: the twin's own limit where branches mix."""
_STENCIL = 0.5
"""Reach of the finite difference that gives the model's slope, symbols."""
_SHIFT_PRIOR_PX = 1.0
"""How far the image may have moved between the pages of one calibration."""


@dataclass(frozen=True)
class Fit:
    """Outcome of a least-squares fit.

    Attributes:
        parameters: [P] fitted vector; held parameters keep their value.
        deviations: [P] standard deviations, the prior's where held.
        pistons: phase of each page, radians.
        shifts_px: image shift (x, y) of each page against the first, [pages, 2].
        cost: mean squared normalised residual of the data (about 1 when the twin explains them).
    """

    parameters: Real
    deviations: Real
    pistons: Real
    shifts_px: Real
    cost: float


def fit_parameters(
    twin: Twin,
    profile: Profile,
    measurements: list[Measurement],
    start: Real,
    free: list[int],
    *,
    use_phase: bool,
    centre: Real | None = None,
    prior_scale: float = 1.0,
    evaluations: int = 12,
) -> Fit:
    """Fit the free parameters to measurements.

    Args:
        twin: the ray tracer.
        profile: the nominal device.
        measurements: from any branches, cameras and pages.
        start: [P] start vector.
        free: indices of the parameters to fit.
        use_phase: whether the patches' phases count, beside places and slopes; needs a start whose phases are right
            to within about a radian.
        centre: [P] centre of the priors, nominal (zero) if None.
        prior_scale: factor on the priors' standard deviations.
        evaluations: bound on the solver's steps.
    """
    pages = 1 + max(m.page for m in measurements)
    centre = np.zeros_like(start) if centre is None else centre
    design = _Design(twin, profile, measurements)
    scale = PRIORS * prior_scale

    def unpack(vector: Real) -> tuple[Real, Real, Real]:
        parameters = start.copy()
        parameters[free] = centre[free] + vector[: len(free)] * scale[free]
        pistons = vector[len(free) : len(free) + pages]
        shifts = np.vstack([np.zeros(2), vector[len(free) + pages :].reshape(pages - 1, 2) * _SHIFT_PRIOR_PX])
        return parameters, pistons, shifts

    def residuals(vector: Real) -> Real:
        parameters, pistons, shifts = unpack(vector)
        data = design.residuals(parameters, pistons, shifts, use_phase=use_phase)
        # pistons are free; everything else has a prior
        return np.concatenate([data, vector[: len(free)], vector[len(free) + pages :]])

    parameter_start = (start[free] - centre[free]) / scale[free]
    pistons = design.pistons(start, pages)
    solved = optimize.least_squares(
        residuals,
        np.concatenate([parameter_start, pistons, np.zeros(2 * (pages - 1))]),
        loss="soft_l1",
        f_scale=2.0,
        diff_step=1e-4,
        x_scale=1.0,
        max_nfev=evaluations,
    )
    parameters, pistons, shifts = unpack(solved.x)
    data = design.residuals(parameters, pistons, shifts, use_phase=use_phase)
    deviations = scale.copy()
    covariance = np.linalg.pinv(solved.jac.T @ solved.jac)
    deviations[free] = np.sqrt(np.clip(np.diag(covariance)[: len(free)], 0, None)) * scale[free]
    return Fit(parameters, deviations, pistons, shifts, float(np.mean(np.minimum(data**2, 25.0))))


class _Design:
    """The measurements as arrays, against what the twin predicts for them."""

    def __init__(self, twin: Twin, profile: Profile, measurements: list[Measurement]) -> None:
        self._twin = twin
        self._branch = np.array([BRANCHES.index(m.branch) for m in measurements])
        self._page = np.array([m.page for m in measurements])
        self._phase = np.array([m.phase for m in measurements])
        self._slope = np.stack([m.slope for m in measurements])
        self._pixels = np.stack([m.pixels for m in measurements])
        self._step = profile.symbol_pitch_m * _STENCIL
        centres = np.stack([m.centre_m for m in measurements])
        step = self._step
        stencil = np.array([[0, 0], [step, 0], [-step, 0], [0, step], [0, -step]])
        self._points = (centres[None] + stencil[:, None]).reshape(-1, 2)
        self._anchors = np.tile(centres, (5, 1))
        significance = np.array([m.significance for m in measurements])
        symbols = np.array([m.symbols for m in measurements], dtype=float)
        # relative error of the coherent sum, from the share of power that it does not explain
        noise = np.sqrt(np.clip(1 / significance - 1 / symbols, 1e-4, None) + 1 / symbols / significance)
        pitch_px = profile.symbol_pitch_m / profile.camera.pitch_m
        across = np.sqrt(symbols)
        self._place_error = _PLACE_FLOOR_PX + 0.35 * pitch_px * noise
        self._phase_error = np.hypot(_PHASE_FLOOR, noise)
        self._slope_error = (_SLOPE_FLOOR + 3.5 * noise / across) / profile.symbol_pitch_m
        self._seen = np.zeros((len(measurements), 2))
        for row, m in enumerate(measurements):
            self._seen[row, list(m.cameras)] = 1 / np.sqrt(len(m.cameras))
        self._has_phase = np.array([len(m.cameras) == 2 for m in measurements], dtype=float)

    def _predict(self, parameters: Real) -> tuple[Real, Real, Real]:
        """Pixels [M, 2, 2], phases [M], slopes [M, 2]."""
        rays = self._twin.trace(parameters, self._points, self._anchors)
        count = len(self._branch)
        index = np.arange(count)
        phases = rays.phases.reshape(-1, 5, count)[self._branch, :, index]
        places = rays.places.reshape(-1, 5, count, 2)[self._branch, 0, index]
        slopes = np.stack([phases[:, 1] - phases[:, 2], phases[:, 3] - phases[:, 4]], axis=-1) / (2 * self._step)
        pixels = np.moveaxis(self._twin.pixels(parameters, places), 0, 1)
        return pixels, phases[:, 0], slopes

    def pistons(self, parameters: Real, pages: int) -> Real:
        """Weighted mean phase of each page against the twin's, radians."""
        _, phases, _ = self._predict(parameters)
        turn = np.exp(1j * (self._phase - phases)) * self._has_phase / self._phase_error**2
        return np.array([np.angle(np.sum(turn[self._page == page])) for page in range(pages)])

    def residuals(self, parameters: Real, pistons: Real, shifts: Real, *, use_phase: bool) -> Real:
        """All residuals over their errors, flat."""
        pixels, phases, slopes = self._predict(parameters)
        off = pixels + shifts[self._page][:, None, :] - self._pixels
        parts = [
            (off * (self._seen / self._place_error[:, None])[..., None]).ravel(),
            ((slopes - self._slope) / self._slope_error[:, None]).ravel(),
        ]
        if use_phase:
            turned = np.angle(np.exp(1j * (phases + pistons[self._page] - self._phase)))
            parts.append(turned / self._phase_error * self._has_phase)
        return np.concatenate(parts)
