"""Maximum likelihood of a device's geometry, registration and light by the counts of all of its known pages together.

The wave fit of one page weighs a share of its pixels by an approximate noise. Its result is refined here by Fisher
scoring. All samples of the common grid count, with their measured mean and variance. Each page has nuisance parameters
of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage, Registered
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.measure import ShownPage, measure_goodness
from lightpage.calibration.goodness.verdict import Goodness
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.interfaces import Derivatives, PageLikelihood, ProgressCallback
from lightpage.calibration.likelihood.known_page_fit import (
    GAIN,
    NUISANCES,
    SHIFT,
    TILT,
    FittedPage,
    KnownPageFit,
    moved_nuisance,
    nuisance_precision,
)
from lightpage.calibration.likelihood.measure import light_table
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import amplitude_tensors, count_tensors
from lightpage.calibration.parameters import NAMES, SEEN_BY_CAMERAS, STEPS
from lightpage.calibration.sampling_table import (
    SamplingTable,
    cameras_apart,
    cubic_terms,
    moved_cameras,
    registration_cubics,
    registration_orientations,
)
from lightpage.calibration.waves.wave_fit import inverse_of_information
from lightpage.calibration.waves.wave_model import ILLUMINATIONS, LaunchConditions
from lightpage.device.profile import Profile
from lightpage.page import modulation as modulations
from lightpage.page.correction import wrapped
from lightpage.page.modulation import Modulation
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.grid import field_grid

Real = NDArray[np.float64]
Indices = NDArray[np.intp]

_CAMERA_TILTS = [NAMES.index("camera_tilt_x_rad"), NAMES.index("camera_tilt_y_rad")]
"""Tilt of the light against the reference, as a page's tilt is."""
_ROUNDS = 3
"""Largest number of scoring steps."""
_LEAST_GAIN = 20.0
"""Expected gain of the log-likelihood by a step, nats an unknown, below which another one does not pay. At 32 electrons
the first step gains 11 on the bench device, and a second one 0.04."""
_SCORED_SYMBOLS = 20_000
"""Symbols from which on no more pages are scored. Two pages of the bench device have 9,744, one full-size page 78,750.
"""
_JUDGED = 2
"""Number of known pages that tell causes."""
_EXPLAINED_FROM = 0.03
"""Loss from which on its causes are searched, bits a symbol. A usual device loses 0.02. The search takes a tenth of a
calibration."""
_LINEARISED = 0.75
"""Share of a round's work after which the next device is known, and its statistics are measured."""
_TURN_STEP_RAD = 0.01
"""Finite difference of the angle between the arms."""
_BLUR_STEP = 0.02
"""Finite difference of the blur's variance."""
_BLUR_DEVIATION = 0.5
"""Standard deviation of the blur's variance about zero before a page is seen."""
_LEVEL_STEP = 0.02
"""Finite difference of the coefficients of the modulation."""
_EXCLUDED = 5.0
"""Standard deviations of a coefficient beyond which even levels are excluded."""
_ILLUMINATION_STEP = 0.02
"""Finite difference of an illumination's term, over the even one."""


AFTER_REGISTRATION = 0.6
"""Share of a calibration's time after which the likelihood of all pages is fitted, on the bench device."""


class _Solution(NamedTuple):
    """Scoring step.

    Attributes:
        step: changes of the unknowns, [K].
        deviations: their standard deviations, [K].
        gain: expected gain of the log-likelihood, nats.
    """

    step: Real
    deviations: Real
    gain: float


class DeviceFit:
    """Fisher scoring of a registered device.

    Unknowns are the parameters that the registration has fitted, the angle between the arms, the blur, the terms of the
    illumination over the even one, the modulation, and nuisance parameters of each page. Even levels stay even
    unless the counts exclude them.

    Args:
        likelihood: likelihood of the device's pages.
        twin: ray tracer of the nominal device.
        profile: nominal device.
        references: reference-only frames.
        pages: known pages.
        progress: called with the finished share of the work.
        gains: gains of the cameras' pixels, see `Blemishes`, [2, H, W].
    """

    def __init__(
        self,
        likelihood: PageLikelihood,
        twin: Twin,
        profile: Profile,
        references: FramePair,
        pages: Sequence[KnownPage],
        progress: ProgressCallback = lambda share: None,
        gains: NDArray[np.uint8] | None = None,
    ) -> None:
        self._likelihood = likelihood
        self._twin = twin
        self._profile = profile
        self._references = references
        self._pages = pages
        self._scored = pages[: -(-_SCORED_SYMBOLS // pages[0].symbols.size)]
        self._progress = progress
        self._gains = gains
        self._grid = field_grid(profile)

    def refined(self, registered: Registered, conditions: LaunchConditions) -> tuple[Registered, Statistics]:
        """Refine a registration.

        Args:
            registered: registration by the waves.
            conditions: illumination and blur of its pages.

        Returns:
            The registration with refined parameters and their verdict, and the statistics of the pages' counts. The
            parameters include the mean tilt and shift of the pages, whose likelihood is that of such parameters.

        Raises:
            CalibrationError: the pages' light does not agree with the device.
        """
        fitted = np.flatnonzero(registered.deviations)
        seen_by_cameras = np.isin(fitted, [*SEEN_BY_CAMERAS])
        of_light = fitted[~seen_by_cameras]
        of_cameras = fitted[seen_by_cameras]
        current = replace(registered, conditions=conditions)
        fit, statistics = self._measured(current, conditions, 0.0)
        for number in range(_ROUNDS):
            solution = self._solved(fit, current, conditions, of_light, of_cameras, number)
            moved, moved_conditions = _moved(
                current, abs(fit.pages[0].gain), conditions, np.append(of_light, of_cameras), solution
            )
            nuisances = _moved_nuisances(fit.pages, solution)
            moved_fit, moved_statistics = self._measured(moved, moved_conditions, number + _LINEARISED, nuisances)
            if not moved_fit.deviance(statistics) < fit.deviance(statistics):
                break
            current = moved
            conditions = moved_conditions
            fit = moved_fit
            statistics = moved_statistics
            if solution.gain < _LEAST_GAIN * len(solution.step):
                break
        goodness = self._goodness(current, conditions, fit, statistics)
        self._progress(1.0)
        at_mean = _at_page(current.parameters, np.mean([page.nuisance for page in fit.pages], axis=0))
        parameters = np.where(registered.deviations > 0, at_mean, current.parameters)
        return replace(current, parameters=parameters, goodness=goodness), statistics

    def _goodness(
        self, registered: Registered, conditions: LaunchConditions, fit: KnownPageFit, statistics: Statistics
    ) -> Goodness:
        """Judge a registration by the light of its first page; the next one tells causes that stay, and that change."""
        device = self._device(registered)

        def shown() -> Iterator[ShownPage]:
            yield from shown_pages(device, conditions, fit.pages[:_JUDGED], self._pages)
            known = self._pages[len(fit.pages) : _JUDGED]
            rest = KnownPageFit(self._likelihood, fit.table, known, registered.modulation)
            rest.fit_gains(statistics)
            for page in rest.pages:
                rest.fit_nuisance(page)
            yield from shown_pages(device, conditions, rest.pages, known)

        return measure_goodness(self._twin, shown(), gains=self._gains, explained_from=_EXPLAINED_FROM, values=True)

    def _device(self, registered: Registered) -> CalibratedDevice:
        return CalibratedDevice(
            self._profile,
            registered.parameters,
            registered.quadrature_phase,
            self._references,
            registered.modulation,
        )

    def _measured(
        self,
        registered: Registered,
        conditions: LaunchConditions,
        rounds: float,
        nuisances: list[Real] | None = None,
    ) -> tuple[KnownPageFit, Statistics]:
        """Measure the statistics of the pages' counts after so many finished `rounds`.

        The nuisance parameters of the pages are fitted if they are not given.
        """
        device = self._device(registered)
        table = light_table(self._twin, device, conditions, self._likelihood.apart_inputs(device))
        fit = KnownPageFit(self._likelihood, table, self._scored, registered.modulation, nuisances)
        share = 1 - _LINEARISED if rounds else 0.0
        statistics = fit.statistics(conditions, lambda done: self._progress((rounds + share * done) / _ROUNDS))
        fit.table |= count_tensors(statistics.cameras, statistics.correlation)
        return fit, statistics

    def _solved(
        self,
        fit: KnownPageFit,
        registered: Registered,
        conditions: LaunchConditions,
        of_light: Indices,
        of_cameras: Indices,
        round_number: int,
    ) -> _Solution:
        """Solve for the scoring step of parameters `of_light` and `of_cameras`, turn, blur, illumination, nuisances."""
        steps = [
            *(self._parameter_step(fit.table, registered.parameters, index) for index in of_light),
            *_other_steps(fit.table, registered.quadrature_phase, conditions.blur),
        ]
        evaluations = fit.evaluations
        columns = self._by_steps(fit, evaluations, steps, round_number)
        parameters = np.append(of_light, of_cameras)
        moved_levels = _moved_levels(registered.modulation)
        before_levels = len(columns) + len(of_cameras)
        common = before_levels + len(moved_levels)
        total = common + NUISANCES * len(fit.pages)
        gradient = np.zeros(total)
        information = np.zeros((total, total))
        for number, (page, here) in enumerate(zip(fit.pages, evaluations, strict=True)):
            by_nuisance = fit.by_nuisance(page, here)
            by_cameras = self._by_cameras(registered.parameters, of_cameras, here, by_nuisance[SHIFT], fit.table)
            by_unknown = [column[number] for column in columns]
            split = len(of_light)
            by_levels = self._by_levels(fit, number, here, moved_levels)
            jacobian = [*by_unknown[:split], *by_cameras, *by_unknown[split:], *by_levels, *by_nuisance]
            nuisances = common + NUISANCES * number + np.arange(NUISANCES)
            own = np.append(np.arange(common), nuisances)
            page_gradient, page_information = fit.normal_equations(jacobian, here)
            gradient[own] += page_gradient
            information[np.ix_(own, own)] += page_information
            gradient[nuisances] -= nuisance_precision() * page.nuisance
            information[nuisances, nuisances] += nuisance_precision()
        prior = registered.prior
        precision = 1 / prior.deviations[parameters] ** 2
        count = np.arange(len(parameters))
        gradient[count] -= precision * (registered.parameters - prior.centre)[parameters]
        information[count, count] += precision
        blur = len(parameters) + 1
        gradient[blur] -= conditions.blur / _BLUR_DEVIATION**2
        information[blur, blur] += 1 / _BLUR_DEVIATION**2
        levels = np.arange(before_levels, common)
        gradient[levels] -= np.array(registered.modulation.coefficients) / modulations.PRIORS**2
        information[levels, levels] += 1 / modulations.PRIORS**2
        solution = _solution(gradient, information)
        if registered.modulation.is_nominal and not _excluded(solution, levels):
            return _solution(gradient, information, held=levels)
        return solution

    def _by_levels(
        self, fit: KnownPageFit, number: int, here: Derivatives, moved: Sequence[tuple[Modulation, SamplingTable]]
    ) -> list[Real]:
        """Derivatives of a page's expected counts, [2, N] each, by the coefficients of the modulation.

        Args:
            fit: fit of the pages.
            number: number of the page.
            here: evaluation of the page.
            moved: modulation after a step along each coefficient, with its tensors.
        """
        page = fit.pages[number]
        known = self._pages[number]
        derivatives: list[Real] = []
        for modulation, tensors in moved:
            phases = page.phases + wrapped(np.angle(known.light(modulation)) - page.phases)
            there = self._likelihood.expected(page.pair, fit.table | tensors, phases, page.nuisance, here.places)
            derivatives.append((there - here.expected) / _LEVEL_STEP)
        return derivatives

    def _by_steps(
        self,
        fit: KnownPageFit,
        evaluations: Sequence[Derivatives],
        steps: Sequence[tuple[SamplingTable, float]],
        round_number: int,
    ) -> list[list[Real]]:
        """Derivatives of the expected counts, [2, N] each, by step and page, by finite differences.

        Args:
            fit: fit of the pages.
            evaluations: evaluations of the pages.
            steps: tensors that change, and the size of each step.
            round_number: number of finished rounds.
        """
        columns: list[list[Real]] = []
        for number, (tensors, step) in enumerate(steps):  # a step's operators are computed once for all pages
            self._progress((round_number + _LINEARISED * number / len(steps)) / _ROUNDS)
            moved = [
                self._likelihood.expected(page.pair, fit.table | tensors, page.phases, page.nuisance, here.places)
                for page, here in zip(fit.pages, evaluations, strict=True)
            ]
            columns.append([(there - here.expected) / step for there, here in zip(moved, evaluations, strict=True)])
        return columns

    def _parameter_step(self, table: SamplingTable, parameters: Real, index: int) -> tuple[SamplingTable, float]:
        """Tensors that change with a step along a parameter of the light, and the step."""
        moved = parameters.copy()
        moved[index] += STEPS[index]
        apart = cameras_apart(moved, self._profile)
        changed = {name: value for name, value in apart.items() if name in table}
        return {"parameters": moved.astype(np.float32), **changed}, float(STEPS[index])

    def _by_cameras(
        self, parameters: Real, of_cameras: Indices, here: Derivatives, by_shift: Real, table: SamplingTable
    ) -> list[Real]:
        """Derivatives of the expected counts, [2, N] each, by parameters that move the cameras.

        Counts that are measured elsewhere change as the expected counts do where the image is shifted the other way.

        Args:
            parameters: of the device, [P].
            of_cameras: indices of the parameters.
            here: evaluation of the page.
            by_shift: derivatives of the expected counts by a shift (x, y) of the image, [2, 2, N].
            table: table of the device.
        """
        rows, columns = np.unravel_index(here.places, self._grid.shape)
        points = np.stack([self._grid.x_m[columns], self._grid.y_m[rows]], axis=-1)
        terms = cubic_terms(points, self._profile)
        cubics = registration_cubics(self._twin, parameters, self._profile)
        to_image = registration_orientations(table["registration"])
        derivatives: list[Real] = []
        for index in of_cameras:
            moved = parameters.copy()
            moved[index] += STEPS[index]
            change = registration_cubics(self._twin, moved, self._profile) - cubics
            displacement = terms @ np.swapaxes(change, 1, 2) / STEPS[index]
            # the inverse of an orientation is its transpose
            derivatives.append(np.einsum("acn,cni,cia->cn", by_shift, displacement, to_image))
        return derivatives


def shown_pages(
    device: CalibratedDevice, conditions: LaunchConditions, fitted: Sequence[FittedPage], pages: Sequence[KnownPage]
) -> list[ShownPage]:
    """Return known pages as the device shows each, with the page's own tilt, shift and gain.

    Args:
        device: calibrated device.
        conditions: illumination and blur of its pages.
        fitted: the first of the pages with their nuisance parameters.
        pages: known pages.
    """
    illumination = conditions.illumination
    phase = abs(illumination[0]) / illumination[0]
    shown = []
    for page, known in zip(fitted, pages, strict=False):
        moved = replace(device, parameters=_at_page(device.parameters, page.nuisance))
        launched = conditions._replace(illumination=illumination * (page.gain * phase))
        shown.append(ShownPage(moved, launched, known.pair, known.symbols))
    return shown


def _at_page(parameters: Real, nuisance: Real) -> Real:
    """Parameters [P] of a device that sees its light where a page's tilt and shift, of `nuisance` [6], take it."""
    moved = moved_cameras(parameters, nuisance[SHIFT])
    moved[_CAMERA_TILTS] += nuisance[TILT]
    return moved


def _moved_levels(modulation: Modulation) -> list[tuple[Modulation, SamplingTable]]:
    """Modulation after a step along each of its coefficients, with the tensors that change."""
    moved = []
    for number in range(len(modulations.NAMES)):
        coefficients = np.array(modulation.coefficients)
        coefficients[number] += _LEVEL_STEP
        stepped = Modulation(tuple(coefficients.tolist()))
        moved.append((stepped, amplitude_tensors(stepped)))
    return moved


def _other_steps(table: SamplingTable, turn_rad: float, blur: float) -> list[tuple[SamplingTable, float]]:
    """Tensors that change with steps along turn, blur and the terms of the illumination, and the steps."""
    turned = turn_rad + _TURN_STEP_RAD
    steps: list[tuple[SamplingTable, float]] = [
        ({"homodyne": np.array([np.cos(turned), np.sin(turned)], np.float32)}, _TURN_STEP_RAD),
        ({"blur": np.array(blur + _BLUR_STEP, np.float32)}, _BLUR_STEP),
    ]
    for term in range(1, ILLUMINATIONS):
        illumination = table["illumination"].copy()
        illumination[0, term] += _ILLUMINATION_STEP * illumination[0, 0]
        steps.append(({"illumination": illumination}, _ILLUMINATION_STEP))
    return steps


def _solution(gradient: Real, information: Real, held: Indices | None = None) -> _Solution:
    """Solve the normal equations; unknowns that are `held` do not move."""
    free = np.setdiff1d(np.arange(len(gradient)), [] if held is None else held)
    covariance = np.zeros_like(information)
    covariance[np.ix_(free, free)] = inverse_of_information(information[np.ix_(free, free)])
    step = covariance @ gradient
    return _Solution(step, np.sqrt(np.diag(covariance)), float(step @ gradient) / 2)


def _excluded(solution: _Solution, levels: Indices) -> bool:
    """Return whether a scoring step from even levels, whose coefficients have these indices, excludes them."""
    return bool(np.max(np.abs(solution.step[levels]) / solution.deviations[levels]) > _EXCLUDED)


def _moved(
    registered: Registered, gain: float, conditions: LaunchConditions, parameters: Indices, solution: _Solution
) -> tuple[Registered, LaunchConditions]:
    """Registration and conditions after a scoring step.

    Args:
        registered: registration before it.
        gain: magnitude of the first page's gain, which the illumination then includes.
        conditions: illumination and blur before it.
        parameters: indices of the fitted parameters.
        solution: the step.
    """
    count = len(parameters)
    vector = registered.parameters.copy()
    vector[parameters] += solution.step[:count]
    deviations = registered.deviations.copy()
    deviations[parameters] = solution.deviations[:count]
    illumination = conditions.illumination * gain
    illumination[1:] += solution.step[count + 2 : count + 1 + ILLUMINATIONS] * illumination[0]
    moved = LaunchConditions(illumination, max(0.0, conditions.blur + float(solution.step[count + 1])))
    levels = slice(count + 1 + ILLUMINATIONS, count + 1 + ILLUMINATIONS + len(modulations.NAMES))
    coefficients = np.array(registered.modulation.coefficients) + solution.step[levels]
    fitted = solution.deviations[levels]
    level_deviations = np.where(fitted > 0, fitted, registered.modulation_deviations)
    refined = replace(
        registered,
        modulation=Modulation(tuple(coefficients.tolist())),
        modulation_deviations=tuple(level_deviations.tolist()),
        parameters=vector,
        deviations=deviations,
        quadrature_phase=registered.quadrature_phase + float(solution.step[count]),
        quadrature_deviation=float(solution.deviations[count]),
        conditions=moved,
    )
    return refined, moved


def _moved_nuisances(pages: Sequence[FittedPage], solution: _Solution) -> list[Real]:
    """Nuisance parameters of the pages after a scoring step; the illumination includes the first page's brightness."""
    steps = solution.step[-NUISANCES * len(pages) :].reshape(len(pages), NUISANCES)
    moved = [moved_nuisance(page, step) for page, step in zip(pages, steps, strict=True)]
    for nuisance in moved:
        nuisance[GAIN] /= abs(pages[0].gain)
    return moved
