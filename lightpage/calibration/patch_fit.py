"""Robust least squares: the twin's parameters from local measurements, with weak priors about nominal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.interfaces import BRANCHES, Twin
from lightpage.calibration.parameters import PRIORS
from lightpage.calibration.patches import Measurement
from lightpage.device.profile import Profile

Real = NDArray[np.float64]

_PLACE_ERROR, _SLOPE_ERROR, _PHASE_ERROR = (0.005, 0.06), (0.002, 0.02), (0.008, 0.08)
"""(floor, scale) of a measurement's standard deviation: place in symbols, slope in radians a symbol, phase in radians,
for a patch of 100 symbols. The scale is multiplied by (1/share - 1)^(3/4), `share` being the share of the symbols'
power that the coherent sum explains. Measured on simulated devices against their true geometry; what is not explained
is light of other branches, so patches that a wall cuts count little."""
_SLOPE_DISTRUST = 20.0
"""Factor on the slopes' errors once phases count. A slope is read around the twin's place and, unlike the phase, is not
carried to the true one; neighbouring patches' phases say the same without that bias."""
_STENCIL = 0.5
"""Reach of the finite difference that gives the model's slope, symbols."""
_DIFFERENCE = 1e-3
"""Finite difference of the Jacobian, in standard deviations of the priors."""


@dataclass(frozen=True)
class PatchFit:
    """Outcome of a least-squares fit.

    Attributes:
        parameters: [P] fitted vector; held parameters keep their value.
        deviations: [P] standard deviations, the prior's where held.
        piston: phase of the page, radians.
        cost: mean squared normalised residual of the data (about 1 when the twin explains them).
    """

    parameters: Real
    deviations: Real
    piston: float
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
    prior_scale: float | Real = 1.0,
    evaluations: int = 12,
) -> PatchFit:
    """Fit the free parameters to measurements.

    Args:
        twin: the ray tracer.
        profile: the nominal device.
        measurements: measurements of one page, from any branches and cameras.
        start: [P] start vector.
        free: indices of the parameters to fit.
        use_phase: whether the patches' phases count, beside places and slopes; needs a start whose phases are right
            to within about a radian.
        centre: [P] centre of the priors, nominal (zero) if None.
        prior_scale: factor on the priors' standard deviations, one for all or [P].
        evaluations: bound on the solver's steps.
    """
    centre = np.zeros_like(start) if centre is None else centre
    design = Design(twin, profile, measurements)
    scale = PRIORS * prior_scale

    def unpack(vector: Real) -> tuple[Real, float]:
        parameters = start.copy()
        parameters[free] = centre[free] + vector[:-1] * scale[free]
        return parameters, float(vector[-1])

    def residuals(vector: Real) -> Real:
        # the piston is free; everything else has a prior
        return np.concatenate([design.residuals(*unpack(vector), use_phase=use_phase), vector[:-1]])

    def jacobian(vector: Real) -> Real:
        return design.jacobian(unpack(vector)[0], free, scale, use_phase=use_phase)

    solved = scipy.optimize.least_squares(
        residuals,
        np.append((start[free] - centre[free]) / scale[free], design.piston(start)),
        loss="soft_l1",
        f_scale=2.0,
        jac=jacobian,
        max_nfev=evaluations,
    )
    parameters, piston = unpack(solved.x)
    data = design.residuals(parameters, piston, use_phase=use_phase)
    deviations = scale.copy()
    slopes = np.asarray(solved.jac, dtype=np.float64)
    covariance = np.linalg.pinv(slopes.T @ slopes)
    deviations[free] = np.sqrt(np.clip(np.diag(covariance)[:-1], 0, None)) * scale[free]
    return PatchFit(parameters, deviations, piston, float(np.mean(np.minimum(data**2, 25.0))))


class Design:
    """The measurements as arrays, against what the twin predicts for them."""

    def __init__(self, twin: Twin, profile: Profile, measurements: list[Measurement]) -> None:
        self._twin = twin
        self._branch = np.array([BRANCHES.index(m.branch) for m in measurements])
        self._phase = np.array([m.phase for m in measurements])
        self._slope = np.stack([m.slope for m in measurements])
        self._read_at = np.stack([m.read_at for m in measurements])
        self._carrier = np.stack([m.carrier for m in measurements])
        self._pixels = np.stack([m.pixels for m in measurements])
        self._step = profile.symbol_pitch_m * _STENCIL
        centres = np.stack([m.centre_m for m in measurements])
        step = self._step
        stencil = np.array([[0, 0], [step, 0], [-step, 0], [0, step], [0, -step]])
        self._points = (centres[None] + stencil[:, None]).reshape(-1, 2)
        self._anchors = np.tile(centres, (5, 1))
        significance = np.array([m.significance for m in measurements])
        symbols = np.array([m.symbols for m in measurements], dtype=float)
        unexplained = np.clip(symbols / np.minimum(significance, symbols) - 1, 0, None) ** 0.75

        def error(law: tuple[float, float]) -> Real:
            return np.asarray((law[0] + law[1] * unexplained) * np.sqrt(100 / symbols))

        place_error = error(_PLACE_ERROR) * profile.symbol_pitch_m / profile.image_pixel_m
        self._phase_error = error(_PHASE_ERROR)
        self._slope_error = error(_SLOPE_ERROR) / profile.symbol_pitch_m
        seen = np.zeros((len(measurements), 2))
        for row, m in enumerate(measurements):
            seen[row, list(m.cameras)] = 1 / np.sqrt(len(m.cameras))
        self._place_weight = (seen / place_error[:, None])[..., None]
        self._has_phase = np.array([len(m.cameras) == 2 for m in measurements], dtype=float)
        self._phase_weight = self._has_phase / self._phase_error

    def _predict(self, parameters: Real) -> tuple[Real, Real, Real]:
        """Pixels [M, 2, 2], phases [M], slopes [M, 2]; parameters [K, P] give a leading axis K."""
        rays = self._twin.trace(parameters, self._points, self._anchors)
        lead, count = parameters.shape[:-1], len(self._branch)
        index = np.arange(count)
        branches = rays.phases.shape[-2]
        phases = rays.phases.reshape(*lead, branches, 5, count)[..., self._branch, :, index]
        places = rays.places.reshape(*lead, branches, 5, count, 2)[..., self._branch, 0, index, :]
        phases = np.moveaxis(phases, 0, -2)  # numpy puts the axis of index arrays that stand apart first
        slopes = np.stack([phases[..., 1] - phases[..., 2], phases[..., 3] - phases[..., 4]], axis=-1)
        if lead:
            pixels = np.stack([self._twin.pixels(p, at) for p, at in zip(parameters, places, strict=True)])
        else:
            pixels = self._twin.pixels(parameters, places)
        pixels = np.moveaxis(pixels, -3, -2)
        read = phases[..., 0] + ((self._read_at - pixels) * self._carrier).sum((-2, -1))
        return pixels, read, slopes / (2 * self._step)

    def _slope_weight(self, use_phase: bool) -> Real:
        return np.asarray(1 / self._slope_error[:, None] / (_SLOPE_DISTRUST if use_phase else 1.0))

    def piston(self, parameters: Real) -> float:
        """Weighted mean phase of the page against the twin's, radians."""
        _, phases, _ = self._predict(parameters)
        return float(np.angle(np.sum(np.exp(1j * (self._phase - phases)) * self._has_phase / self._phase_error**2)))

    def residuals(self, parameters: Real, piston: float, *, use_phase: bool) -> Real:
        """All residuals over their errors, flat."""
        pixels, phases, slopes = self._predict(parameters)
        parts = [
            ((pixels - self._pixels) * self._place_weight).ravel(),
            ((slopes - self._slope) * self._slope_weight(use_phase)).ravel(),
        ]
        if use_phase:
            turned = np.angle(np.exp(1j * (phases + piston - self._phase)))
            parts.append(turned * self._phase_weight)
        return np.concatenate(parts)

    def jacobian(self, parameters: Real, free: list[int], scale: Real, *, use_phase: bool) -> Real:
        """Derivative of `residuals` and of the priors' terms by (free parameters / scale, piston)."""
        steps = np.zeros((len(free), len(parameters)))
        steps[np.arange(len(free)), free] = _DIFFERENCE * scale[free]
        here = self._predict(parameters)
        there = self._predict(parameters + steps)
        pixels, phases, slopes = ((t - h) / _DIFFERENCE for t, h in zip(there, here, strict=True))
        by_parameter = [
            (pixels * self._place_weight).reshape(len(free), -1),
            (slopes * self._slope_weight(use_phase)).reshape(len(free), -1),
        ]
        if use_phase:
            by_parameter.append(phases * self._phase_weight)
        data = np.concatenate(by_parameter, axis=1).T
        full = np.zeros((len(data) + len(free), len(free) + 1))
        full[: len(data), :-1] = data
        if use_phase:
            full[len(data) - len(self._phase) : len(data), -1] = self._phase_weight
        full[len(data) :, :-1] = np.eye(len(free))
        return full
