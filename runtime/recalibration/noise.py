"""Noise of an estimator's phases after each step, and its flat field, measured on known pages."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood.flat_field import FlatField, flat_field
from lightpage.calibration.likelihood.known_page_fit import SHIFT
from lightpage.calibration.likelihood.noise import expected_bits, fitted_noise
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import FLAT_FIELD, pilot_tensors
from lightpage.calibration.sampling_table import SamplingTable, shifted
from lightpage.device.profile import Profile
from lightpage.page.correction import wrapped
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import (
    DEVIATION_PRECISION,
    NO_DEVIATIONS,
    NOISE,
    NUISANCE_COVARIANCE,
    EstimatorGraph,
)
from lightpage.runtime.model.execution.page_graph import REGISTRATION
from lightpage.waves.grid import symbol_samples

Real = NDArray[np.float64]

MOST_STEPS = 6
"""Largest number of Gauss-Newton steps."""
_LEAST_GAIN_BITS = 0.004
"""Least gain of information for another step, for a flat field, and for the estimation of deviations, bits a symbol."""
_PATIENCE = 2
"""Number of steps that gain no information together after which no more are made. One alone may gain little."""
_DAMPING = 0.2
"""Precision that damped steps of tilt and shift get beside their own, over what the phases take up of it."""
_LEAST_DIFFERENCE_RAD = 0.01
"""Least difference of two symbols' phases that is one."""
_PLACING_STEPS = 2
"""Steps, at most, that show where the image of a known page lies."""
UNIT_NOISE = np.array([1, 0], np.float32)
"""Noise with which concentrations are the Fisher information."""


class KnownPhases(NamedTuple):
    """Frames of a known page, and the phases of its light.

    Attributes:
        pair: frames of the page.
        phases: phases of the symbols' light, radians [ny, nx].
    """

    pair: FramePair
    phases: NDArray[np.float64]

    @classmethod
    def of(cls, page: KnownPage, device: CalibratedDevice) -> KnownPhases:
        """Compute the phases of a page's light with the device's modulation."""
        return cls(page.pair, np.angle(page.light(device.modulation)))

    def feeds(self, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.generic]]:
        """Return the tensors that a graph is fed with for this page: its frames, and its own pilots at `mask`."""
        frames = {"in_phase": self.pair.in_phase, "quadrature": self.pair.quadrature}
        return {**frames, **pilot_tensors(Pilots(mask, self.phases[mask]))}


def deviation_prior_scale(profile: Profile, statistics: Statistics) -> float:
    """Prior variance of a sample's deviation, over the variance of an estimated phase of a symbol.

    A symbol has so many samples; and the likelihood divides the information of the counts by the statistics'
    correlation.
    """
    return symbol_samples(profile) ** 2 * statistics.correlation


def measured_noise(
    graph: EstimatorGraph,
    pages: Sequence[KnownPhases],
    mask: NDArray[np.bool_],
    prior_scale: float,
    steps: int | None = None,
    earlier_flat_field: NDArray[np.floating] | None = None,
) -> SamplingTable:
    """Measure the noise of the first estimate and after each step, the flat field, and the prior of the deviations.

    Deviations of the modulator's samples are estimated only if known pages are read better with them. Steps of tilt and
    shift are damped only if known pages are read better so, as in dim light. There is a flat field only if known pages
    are read better with it: with the one from before, or each with that of the others.

    Args:
        graph: graph of the device, with at least `steps` steps, or `MOST_STEPS` if these are left out.
        pages: known pages.
        mask: positions of the pilots, bool [ny, nx].
        prior_scale: see `deviation_prior_scale`.
        steps: number of steps; if left out, as many as gain information.
        earlier_flat_field: flat field of the device before a re-fit, radians [ny, nx].

    Returns:
        `NOISE` [steps + 1, 2], `DEVIATION_PRECISION` [] and `NUISANCE_COVARIANCE` [5, 5]; `FLAT_FIELD` [ny, nx] where
        the graph takes one.
    """
    most = MOST_STEPS if steps is None else steps
    table = {NOISE: np.tile(UNIT_NOISE, (len(graph.value(NOISE)), 1))} | _without_flat_field(graph, mask)
    known = _KnownPages(graph.with_table(table), pages, mask, earlier_flat_field)
    fixed = known.measured(NO_DEVIATIONS, most, until_no_gain=steps is None)
    covariance = graph.value(NUISANCE_COVARIANCE)
    damped_covariance = _damped_covariance(graph)
    damped_graph = graph.with_table({**table, NUISANCE_COVARIANCE: damped_covariance})
    damped_pages = _KnownPages(damped_graph, pages, mask, earlier_flat_field)
    damped = damped_pages.measured(NO_DEVIATIONS, most, until_no_gain=steps is None)
    if damped.bits >= fixed.bits + _LEAST_GAIN_BITS:
        known = damped_pages
        fixed = damped
        covariance = damped_covariance
    precision = np.array(1 / (prior_scale * fixed.variance), np.float32)
    fitted = known.measured(precision, most, until_no_gain=steps is None)
    if fitted.bits < fixed.bits + _LEAST_GAIN_BITS:
        fitted = fixed
        precision = NO_DEVIATIONS
    flat = {name: fitted.flat_field.astype(np.float32) for name in _without_flat_field(graph, mask)}
    return {NOISE: fitted.noise, DEVIATION_PRECISION: precision, NUISANCE_COVARIANCE: covariance, **flat}


def _damped_covariance(graph: EstimatorGraph) -> NDArray[np.float32]:
    """Return the covariance of brightness, tilt and shift with damping (Levenberg), [5, 5].

    In dim light the true Hessian of the phases is less than their Fisher information. Then directions in which the
    phases take up most of the information would swing from step to step, and further each time.
    """
    precision = np.linalg.inv(graph.value(NUISANCE_COVARIANCE).astype(np.float64))
    responses = graph.value("responses").astype(np.float64)
    absorbed = np.einsum("kyx,yx->k", responses**2, graph.value("information").astype(np.float64))
    return np.linalg.inv(precision + np.diag(_DAMPING * absorbed)).astype(np.float32)


def _without_flat_field(graph: EstimatorGraph, mask: NDArray[np.bool_]) -> SamplingTable:
    """Return a flat field of zero, if the graph takes one."""
    return {FLAT_FIELD: np.zeros(mask.shape, np.float32)} if FLAT_FIELD in graph.ports else {}


class PhaseErrors(NamedTuple):
    """Errors of the pages' phases after a step.

    Attributes:
        phases: estimated phases minus known ones, radians [K, ny, nx].
        information: Fisher information of the phases, [K, ny, nx].
    """

    phases: Real
    information: Real

    @classmethod
    def of(
        cls, answers: Sequence[NDArray[np.float32]], pages: Sequence[KnownPhases], mask: NDArray[np.bool_]
    ) -> PhaseErrors:
        """Compare answers p of unit noise, [2, ny, nx] each, with the known phases up to the piston of the pilots."""
        phases: list[Real] = []
        for p, page in zip(answers, pages, strict=True):
            error = wrapped(np.arctan2(p[1], p[0]).astype(np.float64) - page.phases)
            piston = np.angle(np.mean(np.exp(1j * error[mask])))
            phases.append(np.asarray(wrapped(error - piston)))
        return cls(np.stack(phases), np.stack([np.hypot(*p).astype(np.float64) for p in answers]))

    @classmethod
    def together(cls, errors: Sequence[PhaseErrors]) -> PhaseErrors:
        """Join errors of several pages."""
        return cls(*(np.concatenate(part) for part in zip(*errors, strict=True)))

    def noise(self, flat_fields: Real, data: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Fit the noise of the data symbols, [2], where each page has a flat field, [K, ny, nx]."""
        return fitted_noise((self.phases - flat_fields)[:, data].ravel(), self.information[:, data].ravel())

    def bits(self, noise: NDArray[np.float32], data: NDArray[np.bool_]) -> float:
        """Expected information of the data symbols, bits a symbol."""
        return expected_bits(noise, self.information[:, data].ravel())


class _Step(NamedTuple):
    """Known pages after a step.

    Attributes:
        errors: errors of their phases.
        flat_field: flat field that helps most.
        noise: noise with it, [2].
        bits: expected information, bits a symbol.
    """

    errors: PhaseErrors
    flat_field: FlatField
    noise: NDArray[np.float32]
    bits: float


class _Measured(NamedTuple):
    """Measurements on known pages.

    Attributes:
        noise: noise after each step, [steps + 1, 2].
        flat_field: flat field after the last step, radians [ny, nx]; zero where it does not help.
        bits: expected information after the last step, bits a symbol.
        variance: median of the expected squares of the errors after the last step, rad^2.
    """

    noise: NDArray[np.float32]
    flat_field: Real
    bits: float
    variance: float


class _KnownPages:
    """Known pages that a graph reads step by step.

    An error is reduced by a flat field of other pages. That is what a graph with this flat field would give, to first
    order, and needs no further runs.

    Args:
        graph: graph of the device with unit noise and no flat field.
        pages: known pages.
        mask: positions of the pilots, bool [ny, nx].
        earlier_flat_field: see `measured_noise`.
    """

    def __init__(
        self,
        graph: EstimatorGraph,
        pages: Sequence[KnownPhases],
        mask: NDArray[np.bool_],
        earlier_flat_field: NDArray[np.floating] | None,
    ) -> None:
        self._graph = graph
        self._pages = pages
        self._feeds = [placed(graph, page.feeds(mask)) for page in pages]
        self._mask = mask
        self._data = ~mask
        self._earlier = earlier_flat_field
        self._takes_flat_field = FLAT_FIELD in graph.ports
        self._distinct = all(differ(one.phases, other.phases) for one, other in itertools.combinations(pages, 2))

    def measured(self, precision: NDArray[np.float32], most: int, *, until_no_gain: bool) -> _Measured:
        """Measure noise and flat field.

        Args:
            precision: inverse variance of the modulator's deviations.
            most: largest number of steps.
            until_no_gain: whether steps end where the next ones gain no information.
        """
        graph = self._graph.with_table({DEVIATION_PRECISION: precision})
        states = [graph.first_estimate(feeds) for feeds in self._feeds]
        steps: list[_Step] = []
        for number in range(most + 1):
            if number:
                states = [graph.step(*each, number) for each in zip(states, self._feeds, strict=True)]
            errors = PhaseErrors.of([state["p"] for state in states], self._pages, self._mask)
            flat = self._flat_field(errors)
            noise = errors.noise(flat.by_others, self._data)
            step = _Step(errors, flat, noise, errors.bits(noise, self._data))
            steps.append(step)
            if until_no_gain and number > _PATIENCE and step.bits < steps[-1 - _PATIENCE].bits + _LEAST_GAIN_BITS:
                break
            states = [{**state, "p": _with_noise(state["p"], noise)} for state in states]
        while until_no_gain and len(steps) > 2 and steps[-1].bits < steps[-2].bits + _LEAST_GAIN_BITS:
            steps.pop()
        last = steps[-1]
        rows = [*(step.errors.noise(last.flat_field.by_others, self._data) for step in steps[:-1]), last.noise]
        variance = float(np.median(last.noise[0] / last.errors.information[:, self._data] + last.noise[1]))
        return _Measured(np.stack(rows), last.flat_field.phases, last.bits, variance)

    def _flat_field(self, errors: PhaseErrors) -> FlatField:
        """Return the flat field that helps most."""
        if not self._takes_flat_field:
            return FlatField(np.zeros(self._mask.shape), np.zeros_like(errors.phases))
        return best_flat_field(errors, self._data, self._earlier, distinct=self._distinct)


def best_flat_field(
    errors: PhaseErrors,
    data: NDArray[np.bool_],
    earlier: NDArray[np.floating] | None = None,
    *,
    distinct: bool = True,
    judges: slice = slice(None),
) -> FlatField:
    """Choose the flat field with which pages are read best: none, the earlier one, or each page that of the others.

    Args:
        errors: errors of known pages.
        data: symbols that are no pilots, [ny, nx].
        earlier: earlier flat field, radians [ny, nx]; None if there is none.
        distinct: whether the pages show different symbols. Otherwise errors of one page look like a flat field.
        judges: pages that judge.
    """
    none = np.zeros_like(errors.phases)
    plain = errors.noise(none, data)
    candidates: list[FlatField] = []
    if distinct:
        candidates.append(flat_field(errors.phases, np.mean(plain[0] / errors.information + plain[1], axis=0)))
    if earlier is not None and earlier.any():
        candidates.append(FlatField(np.asarray(earlier, np.float64), none + earlier))

    def bits(flat: FlatField) -> float:
        judged = PhaseErrors(errors.phases[judges], errors.information[judges])
        return judged.bits(judged.noise(flat.by_others[judges], data), data)

    best = FlatField(none[0], none)
    most = bits(best) + _LEAST_GAIN_BITS
    for candidate in candidates:
        if (gained := bits(candidate)) >= most:
            best = candidate
            most = gained
    return best


def placed(graph: EstimatorGraph, feeds: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """Return what a page is fed with, and the registration where its image lies, as a tracker feeds it.

    Known pages of a device that walks lie off the calibration, which has their mean. Pages that are read do not.
    """
    state = graph.first_estimate(feeds)
    for number in range(1, min(_PLACING_STEPS, graph.most_steps) + 1):
        state = graph.step(state, feeds, number)
    return {**feeds, REGISTRATION: shifted(graph.value(REGISTRATION), state["nuisance"][SHIFT])}


def _with_noise(p: NDArray[np.float32], noise: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give an answer p [2, ny, nx] of unit noise the concentrations of other noise, [2]."""
    return np.asarray(p / (noise[0] + noise[1] * np.hypot(*p)), np.float32)


def differ(one: Real, other: Real) -> bool:
    """Return whether most phases of two pages differ. What a model lacks for one page repeats on the same page."""
    return bool(np.mean(np.abs(wrapped(one - other)) > _LEAST_DIFFERENCE_RAD) > 0.5)
