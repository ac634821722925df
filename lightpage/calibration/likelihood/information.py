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
from lightpage.calibration.likelihood.interfaces import Derivatives, PageLikelihood
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import count_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.errors import CalibrationError

Real = NDArray[np.float64]

GAIN = slice(0, 2)
"""Real and imaginary part of the gain within a nuisance vector."""
PRIOR_DEVIATIONS = np.array([0.1, 0.1, 0.15, 0.15])
"""Standard deviations of a page's tilt, radians, and of its shift from where the tracker expects it, camera pixels."""
_STEPS = np.array([0.01, 0.01, 0.005, 0.005, 0.01, 0.01])
"""Finite differences of the nuisance parameters."""
_PROBE_RAD = 0.02
_PROBES = 4
"""Random directions in which the curvature is probed, of each page."""
_SMOOTHED = 1.5
"""Standard deviation, symbols, over which the information is smoothed: it varies slowly but at the walls' shadows."""
_MEDIAN = 5
"""Side of the median filter of couplings and responses, symbols."""
_SOLVER_ROUNDS = 5
_FITTED = [0, 2, 3, 4, 5]
"""Nuisance parameters that steps fit: the phase of the gain, a page's piston, is taken off by pilots."""
_LEAST_INFORMATION = 1e-3
"""Least information over the page's median."""
_ROUNDS = 3
_SAMPLES = 20_000
"""Samples of each camera by which a page's gain is found."""
_LEAST_COUNT = 1e-3


@dataclass
class _Known:
    """A known page, and the nuisance parameters that fit it."""

    page: KnownPage
    phases: Real
    nuisance: Real


class InformationFit:
    """Measurement of a device's statistics and information.

    Args:
        likelihood: of its pages.
        table: tensors of its geometry and of the light that is launched.
        pages: known pages.
        device: calibrated device.
        progress: function that takes the share of the work that is done; it may raise to stop it.
    """

    def __init__(
        self,
        likelihood: PageLikelihood,
        table: SamplingTable,
        pages: Sequence[KnownPage],
        device: CalibratedDevice,
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        self._likelihood, self._progress = likelihood, progress
        self.table: SamplingTable = dict(table)
        self._pages = [_Known(page, np.angle(page.light(device.modulation)), np.eye(6)[0]) for page in pages]

    def statistics(self, conditions: LaunchConditions) -> Statistics:
        """Measure the statistics of light that was launched under `conditions`.

        Raises:
            CalibrationError: the pages' light does not agree with the device.
        """
        first = [self._first_counts(known) for known in self._pages]
        for number in range(_ROUNDS):
            self._progress(number / (_ROUNDS + 1))
            cameras = self._measured(first if number == 0 else None)
            self.table |= count_tensors(cameras, 1.0)
            for known in self._pages:
                known.nuisance = self._fitted(known)
        cameras = self._measured(None)
        self.table |= count_tensors(cameras, 1.0)
        powers, curvatures = [], []
        for known in self._pages:
            here = self._at(known)
            powers.append(float(np.mean(here.by_phase**2)))
            direction = np.random.default_rng(0).choice([-1.0, 1.0], known.phases.shape)
            curvatures.append(float(np.mean(direction * self._hessian(known, here, direction))))
        self._progress(1.0)
        correlation = float(np.mean(powers) / max(float(np.mean(curvatures)), 1e-30))
        if not np.isfinite(correlation) or correlation <= 0:
            raise CalibrationError("calibration, statistics of the counts", "light that no page shows", "known pages")
        return Statistics.of(conditions, cameras, correlation)

    def information(self, statistics: Statistics) -> SamplingTable:
        """Measure the Fisher information of the symbols, and how they couple with the nuisance parameters.

        Returns:
            `count_scale`, `count_weights`; information [ny, nx] of a page of unit gain; responses [5, ny, nx] of the
            phases to its relative gain, tilt and shift; nuisance_covariance [5, 5]; and nuisance_precision [4].
        """
        for known in self._pages:
            self._first_counts(known)
        self.table |= count_tensors(statistics.cameras, statistics.correlation)
        shape = self._pages[0].phases.shape
        curvature, couplings, normal = np.zeros(shape), np.zeros((6, *shape)), np.zeros((6, 6))
        rng = np.random.default_rng(0)
        for number, known in enumerate(self._pages):
            self._progress(number / (len(self._pages) + 1))
            for _ in range(_ROUNDS):
                known.nuisance = self._fitted(known)
            here, gain2 = self._at(known), float(np.sum(known.nuisance[GAIN] ** 2))
            for _ in range(_PROBES):
                direction = rng.choice([-1.0, 1.0], shape)
                curvature += direction * self._hessian(known, here, direction) / _PROBES / gain2
            columns, slopes = self._jacobian(known, here)
            couplings += slopes / gain2
            normal += self._normal(columns, here) / gain2
        count = len(self._pages)
        information = scipy.ndimage.gaussian_filter(curvature / count, _SMOOTHED)
        information = np.maximum(information, _LEAST_INFORMATION * np.median(information))
        couplings = np.stack([scipy.ndimage.median_filter(one, _MEDIAN) for one in couplings[_FITTED] / count])
        self._progress(count / (count + 1))
        responses = self._responses(information, couplings)
        precision = 1 / PRIOR_DEVIATIONS**2
        schur = (normal / count)[np.ix_(_FITTED, _FITTED)] - np.einsum("kyx,lyx->kl", couplings, responses)
        schur = (schur + schur.T) / 2 + np.diag([0.0, *precision])
        return {
            **{name: self.table[name] for name in ("count_scale", "count_weights")},
            "information": information.astype(np.float32),
            "responses": responses.astype(np.float32),
            "nuisance_covariance": np.linalg.inv(schur).astype(np.float32),
            "nuisance_precision": precision.astype(np.float32),
        }

    def _responses(self, information: Real, couplings: Real) -> Real:
        """Solve for the change of all phases by which the light says the least of a nuisance parameter, [K, ny, nx].

        Conjugate gradients, preconditioned by the diagonal.
        """
        known = self._pages[0]
        here, gain2 = self._at(known), float(np.sum(known.nuisance[GAIN] ** 2))
        solutions = []
        for coupling in couplings:
            solution, left = np.zeros_like(coupling), coupling
            along = scaled = left / information
            power = np.sum(left * scaled)
            for _ in range(_SOLVER_ROUNDS):
                size = float(np.sqrt(np.mean(along**2)))
                curved = self._hessian(known, here, along / size) * size / gain2
                length = power / np.sum(along * curved)
                solution, left = solution + length * along, left - length * curved
                scaled = left / information
                before, power = power, np.sum(left * scaled)
                along = scaled + power / before * along
            solutions.append(scipy.ndimage.median_filter(solution, _MEDIAN))
        return np.stack(solutions)

    def _at(self, known: _Known, nuisance: Real | None = None, phases: Real | None = None) -> Derivatives:
        return self._likelihood(
            known.page.pair,
            self.table,
            known.phases if phases is None else phases,
            known.nuisance if nuisance is None else nuisance,
        )

    def _first_counts(self, known: _Known) -> tuple[Real, Real]:
        """Counts of a page with the gain that fits it best, found without statistics; it becomes the page's gain.

        Counts are a quadratic in the gain, which four evaluations tell.
        """
        self.table |= _plain_tables()
        dark, plus, minus, turned = (
            self._at(known, np.array([real, imaginary, 0, 0, 0, 0]))
            for real, imaginary in ((0, 0), (1, 0), (-1, 0), (0, 1))
        )
        every = slice(None, None, max(1, plus.counts[0].size // _SAMPLES))
        level, counts = dark.expected[:, every], plus.counts[:, every]
        power = (plus.expected + minus.expected)[:, every] / 2 - level
        real, imaginary = (plus.expected - minus.expected)[:, every] / 2, turned.expected[:, every] - level - power
        weight = 1 / np.sqrt(np.maximum(level, _LEAST_COUNT))

        def residual(gain: Real) -> Real:
            expected = level + gain[0] * real + gain[1] * imaginary + np.sum(gain**2) * power
            return np.asarray(((counts - expected) * weight).ravel())

        starts = [np.array([np.cos(angle), np.sin(angle)]) for angle in np.arange(8) * np.pi / 4]
        best = min(starts, key=lambda gain: float(np.sum(residual(gain) ** 2)))
        gain = scipy.optimize.least_squares(residual, best).x
        known.nuisance = np.array([*gain, 0, 0, 0, 0])
        here = self._at(known)
        return here.expected, here.counts

    def _measured(self, samples: list[tuple[Real, Real]] | None) -> tuple[CountStatistics, CountStatistics]:
        """Statistics of both cameras by all pages."""
        if samples is None:
            samples = [(here.expected, here.counts) for here in map(self._at, self._pages)]
        both = [
            CountStatistics.measured(
                np.concatenate([expected[camera] for expected, _ in samples]),
                np.concatenate([counts[camera] for _, counts in samples]),
                f"known pages: counts of the {name} camera",
            )
            for camera, name in enumerate(("in-phase", "quadrature"))
        ]
        return both[0], both[1]

    def _looked_up(self, here: Derivatives) -> Real:
        """Values of the cameras' tables at the expected counts, [2, 4, N]."""
        roots = self.table["count_scale"][:, None] * np.sqrt(here.expected)
        places = np.minimum((roots + 0.5).astype(np.int64), KNOTS - 1)
        tables = self.table["count_weights"].astype(np.float64)
        return np.stack([table[:, place] for table, place in zip(tables, places, strict=True)])

    def _normal(self, columns: Real, here: Derivatives) -> Real:
        """Fisher information of the nuisance parameters, with derivatives [6, 2, N], of all samples, [6, 6]."""
        return np.asarray(here.every * np.einsum("knp,np,lnp->kl", columns, self._looked_up(here)[:, 2], columns))

    def _score(self, here: Derivatives) -> Real:
        """Derivative of the log-likelihood by the expected counts, [2, N]."""
        weights = self._looked_up(here)
        return np.asarray(here.counts * weights[:, 0] - weights[:, 1])

    def _jacobian(self, known: _Known, here: Derivatives) -> tuple[Real, Real]:
        """Derivatives of expected counts by the nuisance parameters [6, 2, N], and of the phases' gradient, less.

        The gain's are by its relative change, and by its phase.
        """
        columns, slopes = [], []
        gain = complex(*known.nuisance[GAIN])
        for index, step in enumerate(_STEPS):
            moved = known.nuisance.copy()
            if index < 2:
                there = gain * (1 + step) if index == 0 else gain * np.exp(1j * step)
                moved[GAIN] = there.real, there.imag
            else:
                moved[index] += step
            other = self._at(known, moved)
            columns.append((other.expected - here.expected) / step)
            slopes.append((here.by_phase - other.by_phase) / step)
        return np.stack(columns), np.stack(slopes)

    def _fitted(self, known: _Known) -> Real:
        """Nuisance parameters of a page by a Gauss-Newton step from those it has."""
        here = self._at(known)
        columns, _ = self._jacobian(known, here)
        precision = np.diag([0, 0, *1 / PRIOR_DEVIATIONS**2])
        normal = self._normal(columns, here) + precision
        pull = here.every * np.einsum("knp,np->k", columns, self._score(here)) - precision @ known.nuisance
        change = np.linalg.solve(normal, pull)
        gain = complex(*known.nuisance[GAIN]) * (1 + change[0]) * np.exp(1j * change[1])
        return np.array([gain.real, gain.imag, *(known.nuisance[2:] + change[2:])])

    def _hessian(self, known: _Known, here: Derivatives, direction: Real) -> Real:
        """Product of the Fisher information of the phases and a direction, [ny, nx], by finite differences."""
        other = self._at(known, phases=known.phases + _PROBE_RAD * direction)
        return np.asarray((here.by_phase - other.by_phase) / _PROBE_RAD)


def _plain_tables() -> SamplingTable:
    """Tables for evaluations whose derivatives are not looked at."""
    plain = CountStatistics(expected=(0.0, 1.0, 2.0, 3.0), mean=(0.0, 1.0, 2.0, 3.0), variance=(1.0,) * 4)
    return count_tensors((plain, plain), 1.0)
