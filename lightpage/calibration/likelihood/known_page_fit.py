"""Fit of known pages' nuisance parameters, and of the statistics of their counts, by finite differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.likelihood.counts import KNOTS, CountStatistics
from lightpage.calibration.likelihood.interfaces import Derivatives, PageLikelihood, ProgressCallback
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import count_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.errors import CalibrationError
from lightpage.page.modulation import Modulation
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]

GAIN = slice(0, 2)
"""Real and imaginary part of the gain within a nuisance vector."""
TILT = slice(2, 4)
"""Tilt (x, y) within a nuisance vector."""
SHIFT = slice(4, 6)
"""Shift (x, y) within a nuisance vector."""
PRIOR_DEVIATIONS = np.array([0.1, 0.1, 0.15, 0.15])
"""Standard deviations of a page's tilt, radians, and of its shift from where the tracker expects it, camera pixels."""
NUISANCES = 6
"""Number of nuisance parameters."""
_UNIT_GAIN = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
"""Nuisance parameters of a page of unit gain."""
_STEPS = np.array([0.01, 0.01, 0.005, 0.005, 0.01, 0.01])
"""Finite differences of the nuisance parameters: gain (relative change, and phase in radians), tilt and shift."""
_PHASE_STEP_RAD = 0.02
"""Finite difference of the phases, root mean square."""
_ROUNDS = 3
"""Gauss-Newton steps of a page's nuisance parameters."""
_GAIN_SAMPLES = 20_000
"""Samples of each camera from which a page's first gain is fitted."""
_GAIN_STARTS = 8
"""Phases from which that fit may start."""
_BLOCK = 4096
"""Samples of each camera whose equations are summed at a time."""
_LEAST_COUNT = 1e-3
"""Least count of a reference in the weights of that fit."""


@dataclass
class FittedPage:
    """Known page and the nuisance parameters that fit it.

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


class KnownPageFit:
    """Fit of known pages of a device whose geometry is held.

    Args:
        likelihood: likelihood of the device's pages.
        table: tensors of the device's geometry and of the launched light.
        pages: known pages.
        modulation: light of the modulator at its levels.
        nuisances: nuisance parameters of the pages, [6] each, where they are known.

    Attributes:
        likelihood: as given.
        table: tensors that the likelihood is evaluated with. A fit adds those of the counts' statistics.
        pages: known pages with their nuisance parameters.
        evaluations: evaluations of the pages with the statistics that were measured last.
    """

    def __init__(
        self,
        likelihood: PageLikelihood,
        table: SamplingTable,
        pages: Sequence[KnownPage],
        modulation: Modulation,
        nuisances: Sequence[Real] | None = None,
    ) -> None:
        self.likelihood = likelihood
        self.table: SamplingTable = dict(table) | _neutral_count_tensors()
        self._known = nuisances is not None
        self.evaluations: list[Derivatives] = []
        self.pages = [
            FittedPage(page.pair, np.angle(page.light(modulation)), nuisance)
            for page, nuisance in zip(pages, nuisances or [np.array(_UNIT_GAIN)] * len(pages), strict=True)
        ]

    def statistics(self, conditions: LaunchConditions, progress: ProgressCallback = lambda share: None) -> Statistics:
        """Fit the nuisance parameters unless they are known, and measure the statistics of the pages' counts.

        Args:
            conditions: illumination and blur of the pages.
            progress: called with the finished share of the work.

        Raises:
            CalibrationError: the pages' light does not agree with the device.
        """
        evaluations = [self.evaluate(page) if self._known else self._fit_gain(page) for page in self.pages]
        if not self._known:
            jacobians = [self.by_nuisance(page, here) for page, here in zip(self.pages, evaluations, strict=True)]
            for number in range(_ROUNDS):
                progress(number / (_ROUNDS + 1))
                self.table |= count_tensors(_camera_statistics(evaluations), 1.0)
                evaluations = [*map(self._moved, self.pages, evaluations, jacobians)]
        cameras = _camera_statistics(evaluations)
        self.table |= count_tensors(cameras, 1.0)
        score_powers: list[float] = []
        curvatures: list[float] = []
        self.evaluations = [self.evaluate(page) for page in self.pages]
        for page, current in zip(self.pages, self.evaluations, strict=True):
            score_powers.append(float(np.mean(current.by_phase**2)))
            probe = np.random.default_rng(0).choice([-1.0, 1.0], page.phases.shape)
            curvatures.append(float(np.mean(probe * self.hessian_product(page, current, probe))))
        progress(1.0)
        correlation = float(np.mean(score_powers) / max(float(np.mean(curvatures)), 1e-30))
        if not np.isfinite(correlation) or correlation <= 0:
            raise CalibrationError("calibration, statistics of the counts", "light that no page shows", "known pages")
        return Statistics.of(conditions, cameras, correlation)

    def fit_gains(self, statistics: Statistics) -> None:
        """Fit the pages' gains, and set the table's tensors of the counts to given statistics."""
        for page in self.pages:
            self._fit_gain(page)
        self.table |= count_tensors(statistics.cameras, statistics.correlation)

    def fit_nuisance(self, page: FittedPage) -> None:
        """Fit a page's nuisance parameters with the statistics of the table.

        Raises:
            CalibrationError: the page's counts do not depend on them.
        """
        current = self.evaluate(page)
        jacobian = self.by_nuisance(page, current)
        for _ in range(_ROUNDS):
            current = self._moved(page, current, jacobian)

    def evaluate(self, page: FittedPage, nuisance: Real | None = None, phases: Real | None = None) -> Derivatives:
        """Evaluate the likelihood of a page at its own phases and nuisance parameters, or at those given."""
        return self.likelihood(
            page.pair,
            self.table,
            page.phases if phases is None else phases,
            page.nuisance if nuisance is None else nuisance,
        )

    def hessian_product(self, page: FittedPage, current: Derivatives, direction: Real) -> Real:
        """Product of the negative Hessian by the phases and a direction, [ny, nx], by a finite difference."""
        changed = self.evaluate(page, phases=page.phases + _PHASE_STEP_RAD * direction)
        return np.asarray((current.by_phase - changed.by_phase) / _PHASE_STEP_RAD)

    def by_nuisance(self, page: FittedPage, current: Derivatives) -> Real:
        """Jacobian [6, 2, N] of the expected counts by the nuisance parameters, by finite differences.

        Those by the gain are by its relative change, and by its phase.
        """
        moved = [self._expected(page, nuisance, current.places) for nuisance in _nuisance_steps(page)]
        return np.stack([(there - current.expected) / step for there, step in zip(moved, _STEPS, strict=True)])

    def couplings(self, page: FittedPage, current: Derivatives) -> Real:
        """Negative mixed second derivatives of the log-likelihood by nuisance parameters and phases, [6, ny, nx]."""
        moved = [self.evaluate(page, nuisance).by_phase for nuisance in _nuisance_steps(page)]
        return np.stack([(current.by_phase - there) / step for there, step in zip(moved, _STEPS, strict=True)])

    def normal_equations(self, jacobian: Sequence[Real], current: Derivatives) -> tuple[Real, Real]:
        """Gradient and Fisher information of the log-likelihood by some parameters.

        Args:
            jacobian: derivatives of the expected counts by each of K parameters, [2, N] each.
            current: evaluation of the page.

        Returns:
            The gradient [K], and the information [K, K].
        """
        count = current.places.size
        parts = [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]

        def of_part(part: slice) -> tuple[Real, Real]:
            """Sums over some samples, whose columns stay in the processor's cache."""
            expected = current.expected[:, part]
            weights = _count_weights(self.table, expected)
            score = current.counts[:, part] * weights[:, 0] - weights[:, 1]
            columns = np.stack([derivative[:, part] for derivative in jacobian])
            weighted = (columns * weights[:, 2]).reshape(len(columns), -1)
            columns = columns.reshape(len(columns), -1)
            return columns @ score.ravel(), weighted @ columns.T

        gradient = np.zeros(len(jacobian))
        information = np.zeros((len(jacobian), len(jacobian)))
        for of_gradient, of_information in in_parallel(of_part, parts):
            gradient += of_gradient
            information += of_information
        return current.stride * gradient, current.stride * information

    def deviance(self, statistics: Statistics) -> float:
        """Mean of -2 times the log-likelihood of the pages' counts with given statistics, up to a constant.

        The counts are those of `evaluations`.
        """
        tensors = count_tensors(statistics.cameras, 1.0)
        total = 0.0
        for current in self.evaluations:
            weights = _count_weights(tensors, current.expected)
            by_score, offset, information, score_power = np.moveaxis(weights, 1, 0)
            score = current.counts * by_score - offset
            total += float(np.mean(score**2 / score_power + np.log(information / by_score**2)))
        return total / len(self.pages)

    def _moved(self, page: FittedPage, current: Derivatives, jacobian: Real) -> Derivatives:
        """Change a page's nuisance parameters by a Gauss-Newton step.

        Args:
            page: the page.
            current: its evaluation.
            jacobian: Jacobian [6, 2, N] of the expected counts; it hardly changes within the range of the fit.

        Returns:
            The evaluation with the counts that are expected after the step.
        """
        precision = nuisance_precision()
        gradient, information = self.normal_equations([*jacobian], current)
        try:
            step = np.linalg.solve(information + np.diag(precision), gradient - precision * page.nuisance)
        except np.linalg.LinAlgError:
            got = "counts that do not change with the brightness of their page"
            raise CalibrationError("calibration, known pages", got, "the light of known pages") from None
        page.nuisance = moved_nuisance(page, np.asarray(step, np.float64))
        return replace(current, expected=self._expected(page, page.nuisance, current.places))

    def _fit_gain(self, page: FittedPage) -> Derivatives:
        """Fit a page's gain without statistics, set its nuisance parameters to it, and evaluate the page there.

        The expected counts are a quadratic in the gain, which four evaluations determine.
        """
        current = self.evaluate(page, np.array(_UNIT_GAIN))
        stride = slice(None, None, max(1, current.places.size // _GAIN_SAMPLES))
        counts = current.counts[:, stride]
        plus = current.expected[:, stride]
        reference, minus, quadrature = (
            self._expected(page, np.array([real, imaginary, 0, 0, 0, 0]), current.places[stride])
            for real, imaginary in ((0, 0), (-1, 0), (0, 1))
        )
        power = (plus + minus) / 2 - reference
        by_real = (plus - minus) / 2
        by_imaginary = quadrature - reference - power
        weight = 1 / np.sqrt(np.maximum(reference, _LEAST_COUNT))

        def residual(gain: Real) -> Real:
            expected = reference + gain[0] * by_real + gain[1] * by_imaginary + np.sum(gain**2) * power
            return np.asarray(((counts - expected) * weight).ravel())

        angles = 2 * np.pi * np.arange(_GAIN_STARTS) / _GAIN_STARTS
        starts = [np.array([np.cos(angle), np.sin(angle)]) for angle in angles]
        best = min(starts, key=lambda gain: float(np.sum(residual(gain) ** 2)))
        gain = scipy.optimize.least_squares(residual, best).x
        page.nuisance = np.array([*gain, 0, 0, 0, 0])
        return self.evaluate(page)

    def _expected(self, page: FittedPage, nuisance: Real, places: NDArray[np.intp]) -> Real:
        """Expected counts of a page with other nuisance parameters, [2, N]."""
        return self.likelihood.expected(page.pair, self.table, page.phases, nuisance, places)


def moved_nuisance(page: FittedPage, step: Real) -> Real:
    """Nuisance parameters [6] of a page after a step: relative gain, its phase, tilt and shift, [6]."""
    gain = page.gain * (1 + step[0]) * np.exp(1j * step[1])
    return np.array([gain.real, gain.imag, *(page.nuisance[2:] + step[2:])])


def _nuisance_steps(page: FittedPage) -> list[Real]:
    """Nuisance parameters of a page after a step along each of them."""
    changed: list[Real] = []
    for index, step in enumerate(_STEPS):
        nuisance = page.nuisance.copy()
        if index < 2:
            gain = page.gain * (1 + step) if index == 0 else page.gain * np.exp(1j * step)
            nuisance[GAIN] = gain.real, gain.imag
        else:
            nuisance[index] += step
        changed.append(nuisance)
    return changed


def nuisance_precision() -> Real:
    """Inverse variances of a page's nuisance parameters before it is read, zero for the gain, [6]."""
    return np.array([0, 0, *1 / PRIOR_DEVIATIONS**2])


def _count_weights(table: SamplingTable, expected: Real) -> Real:
    """Look up the cameras' tables at expected counts [2, N], [2, 4, N]; see `CountStatistics.weights`."""
    roots = table["count_scale"][:, None] * np.sqrt(expected)
    places = np.minimum((roots + 0.5).astype(np.int64), KNOTS - 1)
    tables = table["count_weights"].astype(np.float64)
    return np.stack([weights[:, place] for weights, place in zip(tables, places, strict=True)])


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


def _neutral_count_tensors() -> SamplingTable:
    """Tensors of the counts for evaluations whose derivatives are not used."""
    line = (0.0, 1.0, 2.0, 3.0)
    camera = CountStatistics(expected=line, mean=line, variance=(1.0,) * len(line))
    return count_tensors((camera, camera), 1.0)
