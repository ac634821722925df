"""Statistics and Fisher information of a device, measured on its known pages by finite differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood.counts import KNOTS, CountStatistics
from lightpage.calibration.likelihood.interfaces import Derivatives, PageLikelihood, ProgressCallback
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import count_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.errors import CalibrationError
from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]

GAIN = slice(0, 2)
"""Real and imaginary part of the gain within a nuisance vector."""
PRIOR_DEVIATIONS = np.array([0.1, 0.1, 0.15, 0.15])
"""Standard deviations of a page's tilt, radians, and of its shift from where the tracker expects it, camera pixels."""
_STEPS = np.array([0.01, 0.01, 0.005, 0.005, 0.01, 0.01])
"""Finite differences of the nuisance parameters: gain (relative change, and phase in radians), tilt and shift."""
_PHASE_STEP_RAD = 0.02
"""Finite difference of the phases, root mean square."""
_PROBES = 4
"""Random directions for each page in which the curvature is probed."""
_SMOOTHED = 1.5
"""Standard deviation, symbols, of the filter of the information, which varies slowly except at the walls' shadows."""
_MEDIAN = 5
"""Side of the median filter of couplings and responses, symbols."""
_SOLVER_ROUNDS = 5
"""Rounds of conjugate gradients for each response."""
_FITTED = [0, 2, 3, 4, 5]
"""Nuisance parameters that a step fits. The phase of the gain is the page's piston, which the pilots give."""
_LEAST_INFORMATION = 1e-3
"""Least information, over the page's median."""
_ROUNDS = 3
"""Gauss-Newton steps of a page's nuisance parameters."""
_GAIN_SAMPLES = 20_000
"""Samples of each camera from which a page's first gain is fitted."""
_GAIN_STARTS = 8
"""Phases from which that fit may start."""
_LEAST_COUNT = 1e-3
"""Least count of a reference in the weights of that fit."""


@dataclass
class _FittedPage:
    """A known page, and the nuisance parameters that fit it.

    Attributes:
        pair: frames of the page.
        phases: phases of the symbols' light, radians [ny, nx].
        nuisance: see `PageLikelihood`, [6].
    """

    pair: FramePair
    phases: Real
    nuisance: Real

    @property
    def gain(self) -> complex:
        """Complex gain of the page's light."""
        return complex(*self.nuisance[GAIN])

    @property
    def power_gain(self) -> float:
        """Square of the gain's magnitude, by which the information of all phases grows."""
        return float(np.sum(self.nuisance[GAIN] ** 2))


class InformationFit:
    """Measurement of a device's statistics and information.

    Args:
        likelihood: likelihood of the device's pages.
        table: tensors of the device's geometry and of the launched light.
        pages: known pages.
        device: calibrated device.
        progress: called with the finished share of the work.
    """

    def __init__(
        self,
        likelihood: PageLikelihood,
        table: SamplingTable,
        pages: Sequence[KnownPage],
        device: CalibratedDevice,
        progress: ProgressCallback = lambda share: None,
    ) -> None:
        self._likelihood = likelihood
        self._progress = progress
        self._table: SamplingTable = dict(table)
        self._pages = [
            _FittedPage(page.pair, np.angle(page.light(device.modulation)), np.array([1.0, 0, 0, 0, 0, 0]))
            for page in pages
        ]

    def statistics(self, conditions: LaunchConditions) -> Statistics:
        """Measure the statistics of the pages' counts.

        Args:
            conditions: illumination and blur of the pages.

        Raises:
            CalibrationError: the pages' light does not agree with the device.
        """
        evaluations = [self._fit_gain(page) for page in self._pages]
        for number in range(_ROUNDS):
            self._progress(number / (_ROUNDS + 1))
            self._table |= count_tensors(_camera_statistics(evaluations), 1.0)
            for page in self._pages:
                page.nuisance = self._gauss_newton_step(page)
            evaluations = [self._evaluate(page) for page in self._pages]
        cameras = _camera_statistics(evaluations)
        self._table |= count_tensors(cameras, 1.0)
        score_powers: list[float] = []
        curvatures: list[float] = []
        for page in self._pages:
            current = self._evaluate(page)
            score_powers.append(float(np.mean(current.by_phase**2)))
            probe = np.random.default_rng(0).choice([-1.0, 1.0], page.phases.shape)
            curvatures.append(float(np.mean(probe * self._hessian_product(page, current, probe))))
        self._progress(1.0)
        correlation = float(np.mean(score_powers) / max(float(np.mean(curvatures)), 1e-30))
        if not np.isfinite(correlation) or correlation <= 0:
            raise CalibrationError("calibration, statistics of the counts", "light that no page shows", "known pages")
        return Statistics.of(conditions, cameras, correlation)

    def information(self, statistics: Statistics) -> SamplingTable:
        """Measure the Fisher information of the symbols, and how they couple with the nuisance parameters.

        Args:
            statistics: statistics of the device's counts.

        Returns:
            `count_scale` and `count_weights`, see `count_tensors`; `information` [ny, nx] of the symbols of a page of
            unit gain; `responses` [5, ny, nx] of the phases to relative gain, tilt and shift; `nuisance_covariance`
            [5, 5] of these; and `nuisance_precision` [4] of tilt and shift before a page is read.
        """
        for page in self._pages:
            self._fit_gain(page)
        self._table |= count_tensors(statistics.cameras, statistics.correlation)
        shape = self._pages[0].phases.shape
        curvature = np.zeros(shape)
        couplings = np.zeros((len(_STEPS), *shape))
        normal = np.zeros((len(_STEPS), len(_STEPS)))
        rng = np.random.default_rng(0)
        for number, page in enumerate(self._pages):
            self._progress(number / (len(self._pages) + 1))
            for _ in range(_ROUNDS):
                page.nuisance = self._gauss_newton_step(page)
            current = self._evaluate(page)
            for _ in range(_PROBES):
                probe = rng.choice([-1.0, 1.0], shape)
                curvature += probe * self._hessian_product(page, current, probe) / _PROBES / page.power_gain
            jacobian, mixed = self._by_nuisance(page, current)
            couplings += mixed / page.power_gain
            normal += self._normal_matrix(jacobian, current) / page.power_gain
        count = len(self._pages)
        information = scipy.ndimage.gaussian_filter(curvature / count, _SMOOTHED)
        information = np.maximum(information, _LEAST_INFORMATION * np.median(information))
        couplings = np.stack([scipy.ndimage.median_filter(each, _MEDIAN) for each in couplings[_FITTED] / count])
        self._progress(count / (count + 1))
        responses = self._responses(information, couplings)
        precision = 1 / PRIOR_DEVIATIONS**2
        schur = (normal / count)[np.ix_(_FITTED, _FITTED)] - np.einsum("kyx,lyx->kl", couplings, responses)
        schur = (schur + schur.T) / 2 + np.diag([0.0, *precision])
        return {
            **{name: self._table[name] for name in ("count_scale", "count_weights")},
            "information": information.astype(np.float32),
            "responses": responses.astype(np.float32),
            "nuisance_covariance": np.linalg.inv(schur).astype(np.float32),
            "nuisance_precision": precision.astype(np.float32),
        }

    def _responses(self, information: Real, couplings: Real) -> Real:
        """Solve the Hessian of the phases for each coupling [K, ny, nx], at the first page.

        A response is the change of all phases that compensates a unit change of a nuisance parameter best.
        """
        page = self._pages[0]
        current = self._evaluate(page)

        def product(direction: Real) -> Real:
            size = float(np.sqrt(np.mean(direction**2)))
            return self._hessian_product(page, current, direction / size) * size / page.power_gain

        solutions = [_conjugate_gradients(product, coupling, information) for coupling in couplings]
        return np.stack([scipy.ndimage.median_filter(solution, _MEDIAN) for solution in solutions])

    def _evaluate(self, page: _FittedPage, nuisance: Real | None = None, phases: Real | None = None) -> Derivatives:
        """Evaluate the likelihood of a page at its own phases and nuisance parameters, or at those given."""
        return self._likelihood(
            page.pair,
            self._table,
            page.phases if phases is None else phases,
            page.nuisance if nuisance is None else nuisance,
        )

    def _fit_gain(self, page: _FittedPage) -> Derivatives:
        """Fit a page's gain without statistics, set its nuisance parameters to it, and evaluate the page there.

        The expected counts are a quadratic in the gain, which four evaluations determine.
        """
        self._table |= _neutral_count_tensors()
        dark, plus, minus, quadrature = (
            self._evaluate(page, np.array([real, imaginary, 0, 0, 0, 0]))
            for real, imaginary in ((0, 0), (1, 0), (-1, 0), (0, 1))
        )
        stride = slice(None, None, max(1, plus.counts[0].size // _GAIN_SAMPLES))
        counts = plus.counts[:, stride]
        reference = dark.expected[:, stride]
        power = (plus.expected + minus.expected)[:, stride] / 2 - reference
        by_real = (plus.expected - minus.expected)[:, stride] / 2
        by_imaginary = quadrature.expected[:, stride] - reference - power
        weight = 1 / np.sqrt(np.maximum(reference, _LEAST_COUNT))

        def residual(gain: Real) -> Real:
            expected = reference + gain[0] * by_real + gain[1] * by_imaginary + np.sum(gain**2) * power
            return np.asarray(((counts - expected) * weight).ravel())

        angles = 2 * np.pi * np.arange(_GAIN_STARTS) / _GAIN_STARTS
        starts = [np.array([np.cos(angle), np.sin(angle)]) for angle in angles]
        best = min(starts, key=lambda gain: float(np.sum(residual(gain) ** 2)))
        gain = scipy.optimize.least_squares(residual, best).x
        page.nuisance = np.array([*gain, 0, 0, 0, 0])
        return self._evaluate(page)

    def _count_weights_at(self, current: Derivatives) -> Real:
        """Look up the cameras' tables at the expected counts, [2, 4, N]."""
        roots = self._table["count_scale"][:, None] * np.sqrt(current.expected)
        places = np.minimum((roots + 0.5).astype(np.int64), KNOTS - 1)
        tables = self._table["count_weights"].astype(np.float64)
        return np.stack([table[:, place] for table, place in zip(tables, places, strict=True)])

    def _normal_matrix(self, jacobian: Real, current: Derivatives) -> Real:
        """Fisher information of the nuisance parameters, [6, 6], by the Jacobian [6, 2, N] of the expected counts."""
        information = self._count_weights_at(current)[:, 2]
        return np.asarray(current.stride * np.einsum("knp,np,lnp->kl", jacobian, information, jacobian))

    def _score(self, current: Derivatives) -> Real:
        """Derivative of the log-likelihood by the expected counts, [2, N]."""
        weights = self._count_weights_at(current)
        return np.asarray(current.counts * weights[:, 0] - weights[:, 1])

    def _by_nuisance(self, page: _FittedPage, current: Derivatives) -> tuple[Real, Real]:
        """Finite differences by the nuisance parameters, those of the gain by its relative change and by its phase.

        Returns:
            Jacobian of the expected counts, [6, 2, N]; and the negative mixed second derivatives of the log-likelihood
            by nuisance parameters and phases, [6, ny, nx].
        """
        jacobian: list[Real] = []
        mixed: list[Real] = []
        for index, step in enumerate(_STEPS):
            nuisance = page.nuisance.copy()
            if index < 2:
                gain = page.gain * (1 + step) if index == 0 else page.gain * np.exp(1j * step)
                nuisance[GAIN] = gain.real, gain.imag
            else:
                nuisance[index] += step
            changed = self._evaluate(page, nuisance)
            jacobian.append((changed.expected - current.expected) / step)
            mixed.append((current.by_phase - changed.by_phase) / step)
        return np.stack(jacobian), np.stack(mixed)

    def _gauss_newton_step(self, page: _FittedPage) -> Real:
        """Nuisance parameters of a page after one more Gauss-Newton step, [6]."""
        current = self._evaluate(page)
        jacobian, _ = self._by_nuisance(page, current)
        precision = np.diag([0, 0, *1 / PRIOR_DEVIATIONS**2])
        normal = self._normal_matrix(jacobian, current) + precision
        by_counts = current.stride * np.einsum("knp,np->k", jacobian, self._score(current))
        gradient = by_counts - precision @ page.nuisance
        step = np.linalg.solve(normal, gradient)
        gain = page.gain * (1 + step[0]) * np.exp(1j * step[1])
        return np.array([gain.real, gain.imag, *(page.nuisance[2:] + step[2:])])

    def _hessian_product(self, page: _FittedPage, current: Derivatives, direction: Real) -> Real:
        """Product of the negative Hessian by the phases and a direction, [ny, nx], by a finite difference."""
        changed = self._evaluate(page, phases=page.phases + _PHASE_STEP_RAD * direction)
        return np.asarray((current.by_phase - changed.by_phase) / _PHASE_STEP_RAD)


def _camera_statistics(evaluations: Sequence[Derivatives]) -> tuple[CountStatistics, CountStatistics]:
    """Statistics of the in-phase and of the quadrature camera's counts over all pages."""
    in_phase, quadrature = (
        CountStatistics.measured(
            np.concatenate([each.expected[camera] for each in evaluations]),
            np.concatenate([each.counts[camera] for each in evaluations]),
            f"known pages: counts of the {name} camera",
        )
        for camera, name in enumerate(("in-phase", "quadrature"))
    )
    return in_phase, quadrature


def _conjugate_gradients(product: Callable[[Real], Real], right: Real, diagonal: Real) -> Real:
    """Solve `product`(solution) = `right` by conjugate gradients, preconditioned by a diagonal, [ny, nx] each."""
    solution = np.zeros_like(right)
    residual = right
    preconditioned = residual / diagonal
    direction = preconditioned
    power = np.sum(residual * preconditioned)
    for _ in range(_SOLVER_ROUNDS):
        curved = product(direction)
        length = power / np.sum(direction * curved)
        solution = solution + length * direction
        residual = residual - length * curved
        preconditioned = residual / diagonal
        previous_power = power
        power = np.sum(residual * preconditioned)
        direction = preconditioned + power / previous_power * direction
    return solution


def _neutral_count_tensors() -> SamplingTable:
    """Tensors of the counts for evaluations whose derivatives are not used."""
    line = (0.0, 1.0, 2.0, 3.0)
    camera = CountStatistics(expected=line, mean=line, variance=(1.0,) * len(line))
    return count_tensors((camera, camera), 1.0)
