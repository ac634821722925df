"""Finds a device from nominal geometry: coarse-to-fine registration of a known page by rays, then a fit by waves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.coherence import COHERENT_BRANCHES, page_coherence
from lightpage.calibration.goodness.measure import ShownPage, measure_goodness
from lightpage.calibration.goodness.remedies import LEVELS, NEIGHBOURS
from lightpage.calibration.goodness.verdict import USABLE, Goodness
from lightpage.calibration.interfaces import FieldSolver, RememberingTwin, Twin
from lightpage.calibration.parameters import GROUPS, NAMES, PARAMETERS, PRIORS, Prior, indices, nominal
from lightpage.calibration.patch_fit import PatchFit, fit_parameters
from lightpage.calibration.patches import (
    Measurement,
    Patch,
    measure,
    middle_patches,
    patch_edge,
    patches,
    search_window,
)
from lightpage.calibration.samplers import FieldSampler, FrameSampler
from lightpage.calibration.sampling_table import needed_apart, registration_coefficients
from lightpage.calibration.waves.cameras_apart import related_apart
from lightpage.calibration.waves.wave_fit import Effort, LevelPrior, WaveFit
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError
from lightpage.page.modulation import DRIFTS, NOMINAL, Modulation
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.grid import field_grid, symbol_samples
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
SIGNIFICANT = 16.0
"""A patch counts from here: unrelated light reaches it in fewer than one search in a hundred, the widest included."""
_MOST_PATCHES = 250
"""Patches, at most, that a stage measures: the bench device, which has 54, is found by them as well."""
_FEWEST = 5
"""Patches that must be looked for, and measurements that must be found, to fit anything."""
_CAMERA_GROUPS = ("in_phase", "quadrature", "centre", "camera_phase")
_SHAPE_GROUPS = (*_CAMERA_GROUPS, "lengths", "distortion", "keystone", "launch")
_LEAST_OVER_CHANCE = 8.0
"""Coherence that a calibration must reach, in units of 1/sqrt(symbols of a page), what chance gives. Measured on the
bench device: 34 or more where it was found, 18 with half of the symbols wrong; at most 2.3 for the right symbols at
nominal geometry and 1.2 for unrelated symbols at the right one."""
LEAST_KEPT = 0.9
"""Share of a calibration's coherence that other pages of its device show, drifted a little or not: its own pages are
alike to 0.01; on the bench device a pipe angle that is a degree off leaves 0.87."""
_LEAST_SIGNIFICANT = 0.1
"""Share of the searched patches that must be found in the end: half are where the device was found, a quarter with half
of the symbols wrong (no branch carries light from all of the page)."""
_REFLECTED = ("x", "y")
"""Branches without which a device is not known: the direct image says nothing of the pipe's angle, x hardly more."""
_LEAST_REFLECTED = 0.05
"""Share of the patches of either reflected branch that must be found in the end: a third of y's are where the device
was found, unrelated light makes less than one in a hundred."""
_WANTED = "right symbols and profile, a device in the capture range"
_WANTED_REFLECTIONS = f"{_WANTED}, a page wide enough for its light to meet the pipe's walls"
_LEAST_QUADRATURE = 0.5
"""Sine of the angle between the arms below which the two frames hardly differ."""
_LARGEST_QUADRATURE_ERROR_DEG = 20.0
"""Distance of the fitted angle between the arms from +90 or -90 degrees beyond which the cameras see different images;
a device in the capture range is within 6."""
_ALONE = 0.2
"""Share of the patches that one camera has found below which the other one does not see the same image."""
AS_IT_IS = "as it is"
ORIENTATIONS: Mapping[str, tuple[tuple[int, int], tuple[int, int]]] = {
    AS_IT_IS: ((1, 0), (0, 1)),
    "mirrored left to right": ((-1, 0), (0, 1)),
    "mirrored top to bottom": ((1, 0), (0, -1)),
    "turned by 180 degrees": ((-1, 0), (0, -1)),
    "turned by 90 degrees to the right": ((0, -1), (1, 0)),
    "turned by 90 degrees to the left": ((0, 1), (-1, 0)),
    "mirrored along the falling diagonal": ((0, 1), (1, 0)),
    "mirrored along the rising diagonal": ((0, -1), (-1, 0)),
}
"""Orientations in which a camera may show an image, by name: matrices from (x, y) to (column, row)."""
UPRIGHT: Mapping[str, str] = {
    "mirrored left to right": "--flip-{0} x",
    "mirrored top to bottom": "--flip-{0} y",
    "turned by 180 degrees": "--turn-{0} 180",
    "turned by 90 degrees to the right": "--turn-{0} 270",
    "turned by 90 degrees to the left": "--turn-{0} 90",
    "mirrored along the falling diagonal": "--flip-{0} x --turn-{0} 270",
    "mirrored along the rising diagonal": "--flip-{0} x --turn-{0} 90",
}
"""Options of `lightpage import` that set the frames of a camera upright."""
_SHOWS = 0.5
"""Share of the patches in the middle that a camera finds which shows the image as it is looked for; another way of
showing it is looked for where fewer are found."""
_CAMERAS = ("in-phase camera", "quadrature camera")
_OTHER_LEVELS = (2, 4, 8, 16, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
"""Level counts that are tried where known symbols are not found, over the recording's."""


class OtherFramesError(CalibrationError):
    """The frames show something else than they should, which no other way of fitting changes."""


@dataclass(frozen=True)
class KnownPage:
    """A frame pair with the symbols that were written: phasors exp(i theta), [ny, nx]."""

    pair: FramePair
    symbols: NDArray[np.complex128]

    def light(self, modulation: Modulation) -> NDArray[np.complex128]:
        """Light that a modulator makes of the symbols, complex [ny, nx]."""
        return modulation.page_light(np.angle(self.symbols))


@dataclass(frozen=True)
class Registered:
    """Outcome of a registration.

    Attributes:
        parameters: [P] fitted vector.
        deviations: [P] standard deviations.
        quadrature_phase: angle between the homodyne arms, radians.
        coherence_before, coherence_after: mean over the pages, at the start's geometry and at the fitted one.
        cost: mean squared normalised residual of the last fit of patches.
        significant: share of the measured patches that were found, in the last stage.
        modulation: light that the modulator makes of its levels.
        modulation_deviations: standard deviations of its coefficients.
        goodness: how well all that explains the first page's light; None where that was not measured.
        quadrature_deviation: standard deviation of the angle between the arms, radians; None where it was not fitted.
        coherences: of each page, at the fitted geometry.
        conditions: illumination and blur of the first page; None where its waves were not fitted.
        prior: prior of the parameters in the last fit.
    """

    parameters: Real
    deviations: Real
    quadrature_phase: float
    coherence_before: float
    coherence_after: float
    cost: float
    significant: float
    modulation: Modulation = NOMINAL
    modulation_deviations: tuple[float, ...] = NOMINAL.coefficients
    goodness: Goodness | None = None
    quadrature_deviation: float | None = None
    coherences: tuple[float, ...] = ()
    conditions: LaunchConditions | None = None
    prior: Prior = field(default_factory=lambda: Prior(nominal(), PRIORS))


@dataclass(frozen=True)
class _Stage:
    """Settings of a round of measuring and fitting, distances in camera pixels."""

    name: str
    reach_px: float
    step_px: float
    groups: tuple[str, ...]
    branches: tuple[str, ...] = ("direct",)
    middle_only: bool = False
    use_phase: bool = False
    half_rate: bool = False
    expected: str = _WANTED


_SINGLE_CAMERA = (
    _Stage("find the direct image", 50, 4, _CAMERA_GROUPS, middle_only=True, half_rate=True),
    _Stage("follow it outwards", 24, 4, _SHAPE_GROUPS, half_rate=True),
    _Stage("settle the cameras", 6, 2, _SHAPE_GROUPS),
)
_COMPLEX = (
    _Stage("find the reflections", 32, 4, GROUPS, _REFLECTED, half_rate=True, expected=_WANTED_REFLECTIONS),
    _Stage("all branches, coarse", 8, 2, GROUPS, COHERENT_BRANCHES),
    _Stage("all branches, fine", 3, 1, GROUPS, COHERENT_BRANCHES),
)
_PHASES = (_Stage("phases", 2, 1, GROUPS, COHERENT_BRANCHES, use_phase=True),) * 2
"""Each round halves what is left of the error, since patches are measured about the current geometry; two bring it
within reach of the waves. On a small page they may take a phase for another a turn away: where the light is not
explained, the waves begin anew without them."""
_DRIFTED = (_Stage("follow the drift", 6, 2, GROUPS, COHERENT_BRANCHES, half_rate=True),)
"""Stages from an earlier calibration: the complex field is right from the start, so no camera is searched alone."""
_DRIFT_SHARES = {"angle": 1.0, "lengths": 0.2, "in_phase": 0.3, "quadrature": 0.3, "axial": 0.2}
_DRIFT_SCALE: Real = np.array([_DRIFT_SHARES.get(parameter.group, 0.05) for parameter in PARAMETERS])
"""Drift of a device, as a share of the prior about nominal. What a fit cannot tell well stays as it was: a decoder
has learned the earlier calibration's errors, and loses 0.1 bit a symbol where a re-fit draws others."""

_LEAST_OF_BEST = 0.8
"""Share of the best page's coherence that every page must have: a fifth of its symbols may be others."""

_APART = "waves of cameras apart"
_STATE = ("parameters", "deviations", "quadrature_phase", "modulation", "conditions", "fit", "_looked", "_found")
_HELD = 1e-6
"""Share of a prior that leaves a parameter where it is."""


def calibrate(
    twin: Twin,
    solve_field: FieldSolver,
    profile: Profile,
    references: FramePair,
    pages: Sequence[KnownPage],
    progress: Progress = lambda what, share: None,
    *,
    any_orientation: bool = False,
) -> Registered:
    """Register known pages from nominal geometry.

    Args:
        twin: ray tracer of the nominal device.
        solve_field: recovers the complex field from registered frames.
        profile: the nominal device.
        references: reference-only frames.
        pages: one known page, or a few; the first is fitted, and all judge the fit.
        progress: told of every stage, and within it of every patch or derivative, so that it may stop the work soon.
        any_orientation: whether cameras that show the image mirrored or turned are taken.

    Raises:
        CalibrationError: nothing within the capture range explains the frames, or the page is too small to tell.
    """
    work = _Registration(twin, solve_field, profile, references, list(pages), progress)
    work.total = len(_SINGLE_CAMERA) + len(_COMPLEX) + len(_PHASES) + 6
    work.any_orientation = any_orientation
    for stage in _SINGLE_CAMERA:
        work.single_camera(stage)
    work.estimate_turn()
    for stage in _COMPLEX:
        work.complex_field(stage)
    work.estimate_turn()
    work.waves("relation of the cameras", ("in_phase", "quadrature"), effort="rough")
    best = _best_of_starts(work)
    check_agreement(best.coherences)
    return best


def _best_of_starts(work: _Registration) -> Registered:
    """Fit the waves from where the phases of patches lead, and from other starts until one explains the light.

    Raises:
        CalibrationError: no start leads to a device.
    """
    related, found, failures = _state(work), list[tuple[float, Registered, dict[str, Any]]](), list[CalibrationError]()
    for what, axis in (("waves", None), ("waves without phases", None), *((_APART, axis) for axis in (0, 1))):
        lost, best, start = min(found, key=lambda one: one[0], default=(math.inf, None, related))
        if lost <= USABLE or (axis is not None and best is not None and _by_modulator(best)):
            break
        vars(work).update(start if what == _APART else related)
        work.total += {"waves": 0, _APART: 4}.get(what, 3)
        try:
            for stage in _PHASES if what == "waves" else ():
                work.complex_field(stage)
            start = _state(work)
            if axis is not None:
                _relate_apart(work, axis)
            work.waves(what, GROUPS)
            outcome = work.result()
            found.append((_bits_lost(outcome), outcome, start))
        except CalibrationError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    return min(found, key=lambda one: one[0])[1]


def _state(work: _Registration) -> dict[str, Any]:
    """Return what the stages of a registration change, by name."""
    return {name: vars(work)[name] for name in _STATE}


def _relate_apart(work: _Registration, axis: int) -> None:
    """Begin anew with cameras that stand apart, see `related_apart`."""
    work.begin("relation of cameras apart")
    found = related_apart(work.wave_fit(), work.parameters, work.quadrature_phase, work.modulation, axis, work.tell)
    work.parameters, work.quadrature_phase = found.parameters, found.quadrature_phase


def check_agreement(coherences: Sequence[float]) -> None:
    """Check that every page shows what the others show of the device.

    Raises:
        CalibrationError: a page whose coherence is far below the best one's.
    """
    for number, coherence in enumerate(coherences):
        if not coherence >= _LEAST_OF_BEST * max(coherences):
            raise CalibrationError(
                f"calibration, known page {number}",
                f"a coherence of {coherence:.3f} where another has {max(coherences):.3f}",
                f"at least {_LEAST_OF_BEST:.0%} of that: its frames, and the symbols that they show",
            )


def _by_modulator(found: Registered) -> bool:
    """Return whether bits are lost by what the modulator shows: no other place of the cameras explains that."""
    causes = found.goodness.causes if found.goodness is not None else ()
    by_modulator = sum(cause.bits for cause in causes if cause.name in (LEVELS, NEIGHBOURS))
    return by_modulator > sum(cause.bits for cause in causes) / 2


def _bits_lost(found: Registered) -> float:
    return math.inf if found.goodness is None else found.goodness.bits_lost


def refine(
    twin: Twin,
    solve_field: FieldSolver,
    profile: Profile,
    references: FramePair,
    pages: Sequence[KnownPage],
    start: Real,
    quadrature_phase: float,
    progress: Progress = lambda what, share: None,
    modulation: Modulation = NOMINAL,
    near: CalibratedDevice | None = None,
    *,
    rough: bool = False,
    judged: bool = True,
) -> Registered:
    """Register known pages from an earlier calibration that has drifted: the reflections need no search from nominal.

    Args:
        start: [P] earlier parameters.
        quadrature_phase: earlier angle between the homodyne arms.
        modulation: earlier one, which is fitted again, see `DRIFTS`.
        near: device at which the fit begins, if not at the earlier calibration. The priors stay about that one. Such a
            fit takes the derivative of the light once.
        rough: whether the fit may end before its optimum, in half of the time. Its `goodness` is not measured then.
        judged: whether the `goodness` of other fits is measured.
        twin, solve_field, profile, references, pages, progress: see `calibrate`.

    Raises:
        CalibrationError: the pages do not fit near the earlier calibration.
    """
    work = _Registration(twin, solve_field, profile, references, list(pages), progress)
    work.parameters, work.centre, work.quadrature_phase = start.copy(), start, quadrature_phase
    work.modulation, work.levels = modulation, LevelPrior(modulation, DRIFTS)
    work.effort = "rough" if rough else "full" if near is None else "once"
    if near is not None:
        work.parameters, work.quadrature_phase = near.parameters.copy(), near.quadrature_phase_rad
        work.modulation = near.modulation
    work.judged = judged and not rough
    work.total = len(_DRIFTED) + (3 if work.judged else 2)
    known = tuple(group for group in GROUPS if max(indices(group)) < twin.known)
    for stage in _DRIFTED:
        work.complex_field(replace(stage, groups=known), _DRIFT_SCALE)
    work.waves("waves", known, _DRIFT_SCALE)
    return work.result()


def goodness_of(
    twin: Twin, device: CalibratedDevice, page: KnownPage, progress: Callable[[float], None] = lambda share: None
) -> Goodness:
    """Verdict on a device that is held as it is, by the light of a known page.

    Args:
        twin: of the nominal device.
        device: that is judged.
        page: that it shows.
        progress: told of each of two steps, 0 to 1. It may raise to stop the work.

    Raises:
        CalibrationError: the cameras see no symbol.
    """
    start, group = device.parameters, ("launch",)  # with it the illumination does not bend the page's phases
    fit = WaveFit(twin, device.profile, page.pair, device.references, page.symbols)
    turn, levels = device.quadrature_phase_rad, device.modulation
    found = fit.fit(start, turn, group, start, _HELD, progress, levels, effort="once")
    if not np.isfinite(found.residual):
        raise CalibrationError("calibration, verdict", "no light of a page", "some")
    return measure_goodness(twin, [ShownPage(device, found.conditions, page.pair, page.symbols)], progress)


def least_coherence(symbols: int) -> float:
    """Coherence of a page of so many symbols above which a geometry is that of the device."""
    return _LEAST_OVER_CHANCE / math.sqrt(symbols)


def check_found(coherence: float, significant: float, symbols: int, reflected: Mapping[str, float]) -> None:
    """Check that a registration ended at the device and not at a guess.

    Args:
        coherence: coherence of the known pages with the fitted geometry.
        significant: share of the patches that were found in the last stage.
        symbols: number of symbols on a page.
        reflected: the same share for each reflected branch.

    Raises:
        CalibrationError: unrelated light would do nearly as well.
    """
    least = least_coherence(symbols)
    if not (coherence >= least and significant >= _LEAST_SIGNIFICANT):
        raise CalibrationError(
            "calibration, outcome",
            f"a coherence of {coherence:.3f} and {significant:.0%} of the patches found",
            f"at least {least:.3f} and {_LEAST_SIGNIFICANT:.0%}: {_WANTED}",
        )
    for branch, share in reflected.items():
        if not share >= _LEAST_REFLECTED:
            raise CalibrationError(
                f"calibration, light that the pipe reflects along {branch}",
                f"{share:.0%} of the patches found",
                f"at least {_LEAST_REFLECTED:.0%}: {_WANTED_REFLECTIONS}",
            )


def _significant(found: Sequence[Measurement]) -> int:
    """Count the patches that were found."""
    return sum(each.significance > SIGNIFICANT for each in found)


def _check_symbols(work: _Registration, stage: _Stage, found: list[Measurement]) -> None:
    """Search other symbols than the known ones where these were not found.

    Raises:
        OtherFramesError: the frames show others.
    """
    if _significant(found) >= _FEWEST:
        return
    pages = work.pages
    best = ""
    most = float(_FEWEST * SIGNIFICANT)
    for what, page in _other_symbols(pages):
        work.pages = [page]
        in_phase, quadrature = work.on_each_camera(stage)
        clear = sum(each.significance for each in in_phase + quadrature if each.significance > SIGNIFICANT)
        if clear > most:
            best = what
            most = clear
    work.pages = pages
    if best:
        raise OtherFramesError("calibration, symbols", best, "those that the frames show, page by page")


def _other_symbols(pages: Sequence[KnownPage]) -> Iterator[tuple[str, KnownPage]]:
    """Yield frames with symbols that may be theirs by mistake, with words for that."""
    first = pages[0]
    for number, page in enumerate(pages[1:], 1):
        yield f"the frames of known page {number} show those of page 0", KnownPage(page.pair, first.symbols)
        yield f"the frames of known page 0 show those of page {number}", KnownPage(first.pair, page.symbols)
    yield "the frames show the inverse levels, M - 1 - s for s", KnownPage(first.pair, first.symbols.conj())
    by_columns = first.symbols.ravel().reshape(first.symbols.shape, order="F")
    yield "the frames show symbols that run down the columns (transposed)", KnownPage(first.pair, by_columns)
    by_rows = first.symbols.ravel(order="F").reshape(first.symbols.shape)
    yield "the frames show symbols that run along the rows (transposed)", KnownPage(first.pair, by_rows)
    phases = np.mod(np.angle(first.symbols), 2 * np.pi)
    for factor in _OTHER_LEVELS:
        levels = f"{factor} times as many levels" if factor > 1 else f"1/{round(1 / factor)} of the levels"
        yield f"the frames show symbols of {levels} (--levels)", KnownPage(first.pair, np.exp(1j * phases / factor))


class _Registration:
    """The state that the stages pass on."""

    def __init__(
        self,
        twin: Twin,
        solve_field: FieldSolver,
        profile: Profile,
        references: FramePair,
        pages: list[KnownPage],
        progress: Progress,
    ) -> None:
        if not pages:
            raise CalibrationError("calibration", "no known page", "at least one page with known symbols")
        self.twin, self.solve_field, self.profile = twin, solve_field, profile
        self.references, self.pages, self.progress = references, pages, progress
        self.patches = patches(profile)
        self._samples = symbol_samples(profile)
        if len(self.patches) < _FEWEST:
            rows, columns = profile.page_shape
            raise CalibrationError(
                f"calibration, profile {profile.name}",
                f"a page of {columns} x {rows} symbols, which makes {len(self.patches)} patches to look for",
                f"at least {_FEWEST} patches of about {patch_edge(profile)} x {patch_edge(profile)} symbols",
            )
        self.grid = field_grid(profile)
        self.parameters, self.centre = nominal(), nominal()
        self.any_orientation, self.orientations = False, tuple[str, ...]()
        self.effort: Effort = "full"
        self.judged = True
        self.prior = Prior(self.centre, PRIORS)
        self.deviations = np.zeros_like(self.parameters)
        self.quadrature_phase = np.pi / 2
        self.quadrature_deviation: float | None = None
        self.levels = LevelPrior()
        self.modulation, self.modulation_deviations = NOMINAL, NOMINAL.coefficients
        self.fit: PatchFit | None = None
        self.conditions: LaunchConditions | None = None
        self.total = 1
        self._stage, self._done, self._behind = "", 0, 0.0
        self._pixel = profile.image_pixel_m
        self._looked: list[Measurement] = []
        self._found: list[Measurement] = []

    def begin(self, what: str) -> None:
        """Begin the next stage, and report it."""
        self._stage, self._done = what, self._done + 1
        self.tell(0.0)

    def tell(self, share: float) -> None:
        """Report progress: the share of the present stage that is done. Where stages were added, it stands still."""
        self._behind = max(self._behind, (self._done - 1 + share) / self.total)
        self.progress(self._stage, self._behind)

    def single_camera(self, stage: _Stage) -> None:
        """Measure the direct branch on each camera by itself and fit places and slopes."""
        self.begin(stage.name)
        found = self.on_each_camera(stage)
        if stage.middle_only:
            found = self._orient(stage, found)
            _check_symbols(self, stage, found[0] + found[1])
        self._fit(stage, found[0] + found[1])

    def _orient(self, stage: _Stage, found: list[list[Measurement]]) -> list[list[Measurement]]:
        """Search the other orientations of a camera that has not found the image in its own.

        Args:
            stage: stage of the search.
            found: measurements of either camera.

        Returns:
            Measurements of either camera as it shows the image.

        Raises:
            OtherFramesError: a camera shows the image otherwise and that is not to be taken, or it alone does not
                show it.
        """
        told: list[str] = []
        upright: list[str] = []
        for camera, own in enumerate(found):
            if _significant(own) >= _SHOWS * len(own):
                continue
            best, most = AS_IT_IS, max(_FEWEST - 1, 2 * _significant(own))
            for how in list(ORIENTATIONS)[1:]:
                self._set_orientation(camera, how)
                sampler = self._frame_samplers(self.pages[0])[camera]
                (seen,) = self._measure(stage, {(camera,): sampler})
                if _significant(seen) > most:
                    best, most, found[camera] = how, _significant(seen), seen
            self._set_orientation(camera, best)
            if best != AS_IT_IS:
                told.append(f"{_CAMERAS[camera]} {best}")
                upright.append(UPRIGHT[best].format(_CAMERAS[camera].removesuffix(" camera")))
        self.orientations = tuple(told)
        if told and not self.any_orientation:
            options = " ".join(upright)
            wanted = f"frames as the profile has them (lightpage import {options}), or --orientation any"
            raise OtherFramesError("calibration, cameras", " and ".join(told), wanted)
        counts = [_significant(own) for own in found]
        for camera, (mine, other) in enumerate(zip(counts, counts[::-1], strict=True)):
            if other >= _FEWEST and mine < _ALONE * other:
                got = f"{mine} patches of known symbols where the {_CAMERAS[1 - camera]} has found {other}"
                raise OtherFramesError(f"calibration, {_CAMERAS[camera]}", got, "the same image on both cameras")
        return found

    def _set_orientation(self, camera: int, how: str) -> None:
        """Start the parameters of a camera, and the centres of their priors, from an orientation."""
        (xx, xy), (yx, yy) = ORIENTATIONS[how]
        name = ("in_phase", "quadrature")[camera]
        values = {"scale_x_relative": xx - 1, "turn_xy_slope": xy, "turn_yx_slope": yx, "scale_y_relative": yy - 1}
        for parameter, value in values.items():
            self.parameters[NAMES.index(f"{name}_{parameter}")] = value
            self.centre[NAMES.index(f"{name}_{parameter}")] = value

    def complex_field(self, stage: _Stage, prior_scale: float | Real = 1.0) -> None:
        """Measure branches on the recovered field and fit."""
        self.begin(stage.name)
        sampler = FieldSampler(self._field(self.pages[0])[0], self.grid)
        (found,) = self._measure(stage, {(0, 1): sampler})
        self._fit(stage, found, prior_scale)

    def estimate_turn(self) -> None:
        """The angle between the arms, from the phases that the same known symbols show on either camera."""
        stage = _Stage("angle between the arms", 0, 1, (), COHERENT_BRANCHES)
        self.begin(stage.name)
        total = 0j
        for one, other in zip(*self.on_each_camera(stage), strict=True):
            if min(one.significance, other.significance) > SIGNIFICANT:
                weight = 1 / (1 / one.significance + 1 / other.significance)
                total += weight * np.exp(1j * (one.phase - other.phase))
        self.quadrature_phase = float(np.angle(total))
        if abs(np.sin(self.quadrature_phase)) < _LEAST_QUADRATURE:
            raise CalibrationError(
                "angle between the homodyne arms",
                f"{np.rad2deg(self.quadrature_phase):.0f} degrees",
                "about +90 or -90 degrees",
            )

    def wave_fit(self) -> WaveFit:
        """Return a fit to the waves of the first page."""
        page = self.pages[0]
        return WaveFit(self.twin, self.profile, page.pair, self.references, page.symbols)

    def waves(
        self, what: str, groups: tuple[str, ...], prior_scale: float | Real = 1.0, effort: Effort | None = None
    ) -> None:
        """Fit `groups` and the angle between the arms to the waves of the first page."""
        self.begin(what)
        found = self.wave_fit().fit(
            self.parameters,
            self.quadrature_phase,
            groups,
            self.centre,
            prior_scale,
            self.tell,
            self.modulation,
            self.levels,
            effort or self.effort,
        )
        self.parameters, self.deviations = found.parameters, found.deviations
        self.quadrature_phase, self.quadrature_deviation = found.quadrature_phase, found.quadrature_deviation
        self.modulation, self.modulation_deviations = found.modulation, found.modulation_deviations
        self.conditions = found.conditions
        self.prior = Prior(self.centre, PRIORS * prior_scale)

    def result(self) -> Registered:
        """Judge the outcome."""
        if self.fit is None:
            raise CalibrationError("calibration", "no fit", "at least one stage")
        self.begin("coherence")
        coherences = self._coherences(self.parameters, self.modulation)
        after = float(np.mean(coherences))
        significant = len(self._found) / len(self._looked)
        reflected = {branch: self._share(branch) for branch in _REFLECTED}
        check_found(after, significant, self.pages[0].symbols.size, reflected)
        angle_deg = float(np.rad2deg(self.quadrature_phase))
        if abs(abs(angle_deg) - 90) > _LARGEST_QUADRATURE_ERROR_DEG:
            raise CalibrationError(
                "angle between the homodyne arms",
                f"{angle_deg:.0f} degrees",
                f"+90 or -90 within {_LARGEST_QUADRATURE_ERROR_DEG:g}: two cameras that show the same image",
            )
        return Registered(
            parameters=self.parameters,
            deviations=self.deviations,
            quadrature_phase=self.quadrature_phase,
            coherence_before=float(np.mean(self._coherences(self.centre, self.levels.centre, 0.5))),
            coherence_after=after,
            cost=self.fit.cost,
            significant=significant,
            modulation=self.modulation,
            modulation_deviations=self.modulation_deviations,
            goodness=self._goodness(),
            quadrature_deviation=self.quadrature_deviation,
            coherences=tuple(coherences),
            conditions=self.conditions,
            prior=self.prior,
        )

    def _goodness(self) -> Goodness | None:
        """Verdict on the fit, by the light of the first page."""
        if self.conditions is None or not self.judged:
            return None
        self.begin("unexplained light")
        device = CalibratedDevice(
            self.profile, self.parameters, self.quadrature_phase, self.references, self.modulation
        )
        page = self.pages[0]
        shown = ShownPage(device, self.conditions, page.pair, page.symbols)
        return measure_goodness(self.twin, [shown], self.tell)

    def _share(self, branch: str) -> float:
        """Share of the patches of a branch that the last stage found."""
        looked, found = (sum(m.branch == branch for m in part) for part in (self._looked, self._found))
        return found / looked if looked else 0.0

    def _coherences(self, parameters: Real, modulation: Modulation, begun: float = 0.0) -> list[float]:
        """Coherence of each page; takes half of the stage, of which the share `begun` is behind."""
        found = []
        for number, page in enumerate(self.pages):
            self.tell(begun + number / len(self.pages) / 2)
            sampler = FieldSampler(self._field(page, parameters)[0], self.grid)
            light = page.light(modulation)
            found.append(page_coherence(sampler, self.twin, parameters, self.profile, light))
        return found

    def _field(
        self, page: KnownPage, parameters: Real | None = None, quadrature_phase: float | None = None
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        parameters = self.parameters if parameters is None else parameters
        registration = registration_coefficients(self.twin, parameters, self.profile)
        quadrature_phase = self.quadrature_phase if quadrature_phase is None else quadrature_phase
        homodyne = np.array([np.cos(quadrature_phase), np.sin(quadrature_phase)], dtype=np.float32)
        apart = needed_apart(parameters, self.profile)
        return self.solve_field(page.pair, self.references, registration, homodyne, apart)

    def _frame_samplers(self, page: KnownPage) -> list[FrameSampler]:
        frames = (page.pair.in_phase, page.pair.quadrature)
        references = (self.references.in_phase, self.references.quadrature)
        return [
            FrameSampler(frame, reference, camera, self.twin, self.parameters)
            for camera, (frame, reference) in enumerate(zip(frames, references, strict=True))
        ]

    def _where(self, stage: _Stage) -> list[Patch]:
        if not stage.middle_only:
            return self.patches[:: math.ceil(len(self.patches) / _MOST_PATCHES)]
        return middle_patches(self.profile, self.patches, _FEWEST)

    def on_each_camera(self, stage: _Stage) -> list[list[Measurement]]:
        """The first page's patches as either camera sees them by itself."""
        return self._measure(stage, {(camera,): one for camera, one in enumerate(self._frame_samplers(self.pages[0]))})

    def _measure(
        self, stage: _Stage, samplers: Mapping[tuple[int, ...], FrameSampler | FieldSampler]
    ) -> list[list[Measurement]]:
        """The first page's patches as each of `samplers` sees them.

        Args:
            stage: patches, branches and ranges to measure.
            samplers: the field, or one camera's light, by the cameras that it is seen through.
        """
        window = search_window(stage.reach_px * self._pixel, stage.step_px * self._pixel)
        where, light = self._where(stage), self.pages[0].light(self.modulation)
        samples = max(1, self._samples // 2) if stage.half_rate else self._samples

        def measured(patch: Patch) -> list[list[Measurement]]:
            twin = RememberingTwin(self.twin)
            device = self.parameters, self.profile, patch, light, stage.branches, window, samples
            return [measure(sampler, twin, *device, cameras=cameras) for cameras, sampler in samplers.items()]

        found: list[list[Measurement]] = [[] for _ in samplers]
        for number, of_patch in enumerate(in_parallel(measured, where)):
            self.tell(number / len(where))
            for own, measurements in zip(found, of_patch, strict=True):
                own += measurements
        return found

    def _fit(self, stage: _Stage, found: list[Measurement], prior_scale: float | Real = 1.0) -> None:
        good = [m for m in found if m.significance > SIGNIFICANT]
        self._looked, self._found = found, good
        if len(good) < _FEWEST:
            best = max((m.significance for m in found), default=0.0)
            raise CalibrationError(
                f"calibration, stage '{stage.name}'",
                f"{len(good)} of {len(found)} patches of known symbols found (best significance {best:.1f})",
                f"at least {_FEWEST} above {SIGNIFICANT:.0f}: {stage.expected}",
            )
        self.fit = fit_parameters(
            self.twin,
            self.profile,
            good,
            self.parameters,
            indices(*stage.groups),
            use_phase=stage.use_phase,
            centre=self.centre,
            prior_scale=prior_scale,
        )
        self.parameters = self.fit.parameters
