"""The device as the waves of one known page show it: least squares of both raw frames against the fitted wave model.

Once rays have found the device to a fraction of a speckle, the wave model says what each camera should have seen of a
known page, the signal's own power included. All pixels together then say how the cameras lie, what the angle between
the arms is, and what pipe and lenses are: more than patches of symbols do, since the light of every path counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import NAMES, PARAMETERS, PRIORS, SEEN_BY_CAMERAS, STEPS, indices
from lightpage.calibration.samplers import smooth_reference
from lightpage.calibration.waves.wave_model import (
    ILLUMINATIONS,
    FittedWaves,
    LaunchConditions,
    illumination_terms,
    on_modulator,
)
from lightpage.device.profile import Profile
from lightpage.page import modulation as modulations
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.grid import field_grid, symbol_samples
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]
Effort = Literal["full", "once", "rough"]
"""Care that a fit takes, see `WaveFit.fit`."""


class _Sampling(NamedTuple):
    """Sampling with which the light, or its derivative, is computed.

    Attributes:
        samples: samples a symbol and axis, at most.
        accuracy: share of the splitting steps.
    """

    samples: int
    accuracy: float


_FAR = _Sampling(1, 1 / 8)
"""Sampling of the first derivative, which costs less. The next one undoes its error."""
_NEAR = _Sampling(2, 3 / 8)
"""Sampling of the others, and of a rough fit's light: an error of a percent costs no round, and half of the usual
samples leave one of 0.3%."""
_EXACT = _Sampling(4, 1.0)
"""Sampling of the light of all other fits: that of a simulation."""
READ_NOISE = 0.3
"""Variance of an equation that does not grow with the light, over the shot noise of the reference alone."""
ROUNDS = 9
_STALE = 0.2
"""Relative fall of the residual, since the derivative of the light was taken, beyond which it is taken anew. That costs
as much as several rounds; what a smaller fall leaves, the likelihood of all known pages settles."""
_CONVERGED = 1e-3
"""Relative fall of the residual, found or expected, below which another round does not pay."""
_LEAST_OFF = 2.0
"""Mean square of the distances of a modulation's coefficients from the usual ones, over their deviations, from which on
it is another one: a nominal device has 1 or less, and more than 2 in one of seventy fits."""
_LEAST_STROKE = 2.0
"""Deviations of the stroke alone from which on a modulation that was known is another one too: a stroke drifts by
itself, and on the bench device three of them cost a twentieth of a bit."""
_LARGEST_MOVE_PX = 1.5
"""A round's largest step: the model is linear in the displacement over about a speckle."""
_EQUATIONS = 100_000
"""Approximate limit of equations for each camera: more say nothing new of a few dozen unknowns."""
_LEAST_STRIDE = 2
"""Grid samples from one equation to the next: the grid has twice the rate that the light needs."""
_INSIDE = 0.98
"""Share of the page's image that is compared, to either side."""
_USUAL_BLUR, _BLUR_PRIOR, _BLUR_STEP = 0.1, 0.5, 0.01
"""Variance of the modulator's blur to start from, its standard deviation about 0, and its finite difference."""
_CAMERAS = ("in_phase", "quadrature")
_OF_REAL_LENSES = (NAMES.index("lens_path_relative"),)
"""Parameters that do nothing where the profile's lenses are ideal."""


@dataclass(frozen=True)
class WaveFitted:
    """Outcome of a fit.

    Attributes:
        parameters: [P] fitted vector; held parameters keep their value.
        deviations: [P] standard deviations, zero where held. What the model leaves unexplained counts as noise that
            differs from symbol to symbol.
        quadrature_phase: angle between the homodyne arms, radians.
        residual: root mean square of what is left of the equations, in standard deviations of the reference's noise
            times an unknown factor: it says which of two fits is better.
        conditions: the page's illumination and blur.
        modulation: light that the modulator makes of its levels; the prior's centre where a page does not tell it from
            that.
        modulation_deviations: standard deviations of its coefficients, zero where held.
        quadrature_deviation: standard deviation of the angle between the arms, radians.
    """

    parameters: Real
    deviations: Real
    quadrature_phase: float
    residual: float
    conditions: LaunchConditions
    modulation: Modulation = NOMINAL
    modulation_deviations: tuple[float, ...] = (0.0,) * len(modulations.NAMES)
    quadrature_deviation: float | None = None


class LevelPrior(NamedTuple):
    """Prior of a modulation: its distribution before a page is seen.

    Attributes:
        centre: most likely one.
        deviations: standard deviations of its coefficients about it.
    """

    centre: Modulation = NOMINAL
    deviations: Real = modulations.PRIORS


class _State(NamedTuple):
    """State of the fit: every quantity that is fitted.

    Attributes:
        parameters: [P].
        quadrature_phase: angle between the arms, radians.
        light: coefficients [T] of the illumination's terms.
        levels: coefficients of the modulation.
        blur: of the modulator, as for `FittedWaves`.
    """

    parameters: Real
    quadrature_phase: float
    light: Complex
    levels: Real
    blur: float


class _Slopes(NamedTuple):
    """Derivatives at the places of the equations [...], of the light that each of both cameras sees.

    Attributes:
        by_term: derivatives of the light by the illumination's terms, [T, 2, ...].
        by_blur: derivative of the light by the blur, [2, ...].
        by_level: derivatives of the light by the terms of the modulation's logarithm, [K, 2, ...], the last two of
            crosstalk; none where it is held.
        of_light: derivatives of the light by parameters that change it, [2, ...] each.
        of_cameras: derivatives of the places (x, y), grid samples, by parameters that move the cameras, [2, ..., 2]
            each.
    """

    by_term: Complex
    by_blur: Complex
    by_level: list[Complex]
    of_light: list[Complex]
    of_cameras: list[Real]


class WaveFit:
    """Least squares of two frames against the waves of the page that they show.

    Unknown are, beside the parameters asked for, the page's illumination (a quadratic over the page), the modulator's
    blur, and the angle between the arms. Without blur, light that is even over the page would seem too bright.

    Args:
        twin: ray tracer of the nominal device, for the cameras' poses.
        profile: the nominal device.
        pair, references: frames of a known page, and reference-only frames.
        symbols: unit phasors of the page's symbols, complex [ny, nx].
        changed: fields of the geometry that are not as fitted, see `FittedWaves`.
    """

    def __init__(
        self,
        twin: Twin,
        profile: Profile,
        pair: FramePair,
        references: FramePair,
        symbols: NDArray[np.complex128],
        changed: Mapping[str, float] | None = None,
    ) -> None:
        self._changed = changed
        self._twin, self._profile, self._symbols = twin, profile, symbols.size
        self._samples = symbol_samples(profile)
        self._phases = np.mod(np.angle(symbols), 2 * np.pi)
        grid = field_grid(profile)
        self._beside = grid.pitch_m * np.array([[0, 0], [1, 0], [0, 1]])
        self._stride = max(_LEAST_STRIDE, int(np.sqrt(np.prod(grid.shape) / _EQUATIONS)))
        self._every = (slice(None, None, self._stride), slice(None, None, self._stride))
        self._places = np.stack(np.meshgrid(grid.x_m, grid.y_m), axis=-1)[self._every]
        half = _INSIDE * np.array([profile.page_width_m, profile.page_height_m]) / 2
        self._inside = np.all(np.abs(self._places) < half, axis=-1)
        self._levels = [smooth_reference(frame) for frame in (references.in_phase, references.quadrature)]
        self._images = [
            scipy.ndimage.spline_filter((frame.astype(np.float32) - level) / (2 * level), order=3, output=np.float32)
            for frame, level in zip((pair.in_phase, pair.quadrature), self._levels, strict=True)
        ]

    def fit(
        self,
        start: Real,
        quadrature_phase: float,
        groups: tuple[str, ...],
        centre: Real | None = None,
        prior_scale: float | Real = 1.0,
        progress: Callable[[float], None] = lambda share: None,
        modulation: Modulation = NOMINAL,
        levels: LevelPrior | None = None,
        effort: Effort = "full",
    ) -> WaveFitted:
        """Fit the parameters of `groups` and the angle between the arms.

        Args:
            start: [P], right to within about a speckle and a radian.
            quadrature_phase: angle between the arms to start from, good to some tens of degrees.
            groups: groups of `lightpage.calibration.parameters`. Without ``launch``, the illumination may bend the
                page's phases instead.
            centre: [P] centre of the priors, nominal (zero) if None.
            prior_scale: factor on the priors' standard deviations, one for all or [P].
            progress: told of every round and of every derivative, with the share of the most rounds that is behind,
                0 to 1. It may raise to stop the work.
            modulation: light that the modulator makes of its levels, to start from.
            levels: prior of the modulation where it is fitted too, None where it is held.
            effort: ``once`` takes the derivative of the light but once, coarsely: what the light tells least, such as a
                launched defocus, may come out some deviations away. ``rough`` takes the light itself coarsely, too.
        """
        without_effect = _OF_REAL_LENSES if self._profile.ideal_lenses else ()
        of_light = [index for index in indices(*groups) if index not in (*SEEN_BY_CAMERAS, *without_effect)]
        of_cameras = [index for index in indices(*groups) if index in SEEN_BY_CAMERAS]
        free = of_light + of_cameras
        bends = "launch" not in groups
        precision = 1 / (PRIORS * prior_scale)[free] ** 2
        centre = np.zeros(len(PARAMETERS)) if centre is None else centre
        state = self._start(start, quadrature_phase, modulation)
        nothing, first = np.zeros(len(PARAMETERS)), LaunchConditions(state.light, state.blur)
        best = WaveFitted(start, nothing, quadrature_phase, np.inf, first, modulation)
        slopes, taken_at, sampling, once = None, np.inf, _FAR, effort != "full"
        for number in range(ROUNDS):
            progress(number / ROUNDS)
            fields, left = self._left(state, _NEAR if effort == "rough" else _EXACT)
            residual = float(np.sqrt(np.mean(left**2)))
            if (once or sampling is _NEAR) and not residual < (1 - _CONVERGED) * best.residual:
                if residual < best.residual:
                    best = replace(best, residual=residual, **_found(state))
                break
            fresh = sampling is not _FAR and residual >= (1 - _STALE) * taken_at
            if slopes is None or not (fresh or once):
                told, taken_at = partial(_within_round, progress, number), residual
                sampling = _FAR if slopes is None else _NEAR
                slopes = self._slopes(state, of_light, of_cameras, sampling, told, levels=levels is not None)
            directions = _directions(state.light, bends=bends)
            columns = self._columns(state, fields, slopes, directions)
            # What is unexplained differs from symbol to symbol, so equations tell no more than symbols do.
            variance = residual**2 * max(1.0, len(left) / (2 * self._symbols))
            others = columns.shape[1] - len(free)
            fitted_levels = slice(others - (len(modulations.NAMES) if levels else 0), others)
            prior = np.zeros(columns.shape[1])
            prior[others:], prior[len(directions) + 1] = precision, 1 / _BLUR_PRIOR**2
            if levels:
                prior[fitted_levels] = 1 / levels.deviations**2
            information = columns.T @ columns / variance + np.diag(prior)
            pull = columns.T @ left / variance
            pull[others:] -= precision * (state.parameters[free] - centre[free])
            pull[len(directions) + 1] -= state.blur / _BLUR_PRIOR**2
            if levels:
                pull[fitted_levels] -= prior[fitted_levels] * (state.levels - levels.centre.coefficients)
            covariance = inverse_of_information(information)
            known = np.sqrt(np.diag(covariance))
            deviations = np.zeros(len(PARAMETERS))
            deviations[free] = known[others:]
            best = WaveFitted(
                deviations=deviations,
                residual=residual,
                modulation_deviations=tuple(known[fitted_levels].tolist()) if levels else best.modulation_deviations,
                quadrature_deviation=float(known[len(directions)]),
                **_found(state),
            )
            step = covariance @ pull
            state = self._moved(state, step, directions, fitted_levels, free, bends=bends)
            settled = once or sampling is _NEAR
            if settled and variance * float(pull @ step) < 2 * _CONVERGED * residual**2 * len(left):
                best = replace(best, **_found(state))
                break
        return best if levels is None else _told_apart(best, levels.centre)

    def _page(self, levels: Real, samples: int) -> Complex:
        """Return the light on the modulator under even illumination, complex [ny samples, nx samples].

        It is as bright as with the usual samples: fewer stand for more light each.
        """
        light = Modulation(tuple(levels.tolist())).page_light(self._phases)
        return on_modulator(light * (self._samples / samples), samples)

    def _light(self, state: _State, sampling: _Sampling) -> Complex:
        """The page's light on the common grid, as either camera sees it, [2, Gy, Gx]."""
        waves = self._waves(state.parameters, state.blur, sampling)
        terms = np.stack(illumination_terms(waves.x, waves.y))
        return waves.to_cameras(self._page(state.levels, waves.samples) * np.tensordot(state.light, terms, 1))

    def _start(self, parameters: Real, quadrature_phase: float, modulation: Modulation) -> _State:
        """Return the state to start from: the given values, and the even illumination that fits best."""
        chosen, counts, amplitude = self._look(parameters)
        even = np.eye(1, ILLUMINATIONS, dtype=np.complex128)[0]
        state = _State(parameters, quadrature_phase, even, np.array(modulation.coefficients), _USUAL_BLUR)
        waves = self._waves(parameters, state.blur, _FAR, self._stride)
        lit = waves.to_cameras(self._page(state.levels, waves.samples))
        here = [field[chosen] / amplitude for field in lit]
        arms = (0.0, quadrature_phase)
        columns = np.concatenate([field * np.exp(-1j * arm) for field, arm in zip(here, arms, strict=True)])
        found = np.linalg.lstsq(np.stack([columns.real, -columns.imag], axis=1), counts.ravel(), rcond=None)[0]
        return state._replace(light=even * complex(*found))

    def _waves(
        self, parameters: Real, blur: float, sampling: _Sampling, stride: int = 1, like: FittedWaves | None = None
    ) -> FittedWaves:
        """Return the waves on every so many samples of the common grid; `like` as for `FittedWaves`."""
        how: dict[str, Any] = {
            "stride": stride,
            "accuracy": sampling.accuracy,
            "like": like,
            "blur": blur,
            "changed": self._changed,
        }
        samples = min(sampling.samples, self._samples)
        return FittedWaves(self._profile, parameters, samples, filled=True, **how)

    def _slopes(
        self,
        state: _State,
        of_light: list[int],
        of_cameras: list[int],
        sampling: _Sampling,
        progress: Callable[[float], None],
        *,
        levels: bool,
    ) -> _Slopes:
        def stepped(index: int) -> tuple[Real, float]:
            there = state.parameters.copy()
            there[index] += STEPS[index]
            return there, STEPS[index]

        here = self._waves(state.parameters, state.blur, sampling, self._stride)
        samples = here.samples
        even, terms = self._page(state.levels, samples), np.stack(illumination_terms(here.x, here.y))
        first = here.to_cameras(even * terms[0])  # lenses and pipe are made before threads ask for them
        by_term = np.stack([first, *in_parallel(lambda term: here.to_cameras(even * term), list(terms[1:]))])
        page, field = even * np.tensordot(state.light, terms, 1), np.tensordot(state.light, by_term, 1)
        leaving = here.to_exit(page)
        blurred = self._waves(state.parameters, state.blur + _BLUR_STEP, sampling, self._stride, here)
        by_blur = (blurred.to_cameras(page) - field) / _BLUR_STEP
        functions = [on_modulator(one, samples) for one in modulations.page_basis(self._phases)] if levels else []
        by_level = list(in_parallel(lambda one: here.to_cameras(page * one), functions))

        def by_parameter(index: int) -> Complex:
            there, step = stepped(index)
            waves = self._waves(there, state.blur, sampling, self._stride, here)
            return np.asarray((here.moved(index, waves, page, leaving, field) - field) / step)

        light, places = list[Complex](), list[Real]()
        for number, column in enumerate(in_parallel(by_parameter, of_light)):
            progress(number / len(of_light))
            light.append(column)
        for there, step in map(stepped, of_cameras):
            moved_px = (self._pixels(there) - self._pixels(state.parameters)) / step
            places.append(moved_px @ self._samples_per_pixel(state.parameters)[:, None])
        return _Slopes(by_term, by_blur, by_level, light, places)

    def _samples_per_pixel(self, parameters: Real) -> Real:
        """Grid samples (x, y) for a pixel along (column, row) of either camera, [2, 2, 2]."""
        middle, right, below = np.moveaxis(self._twin.pixels(parameters, self._beside), 1, 0)
        return np.asarray(np.linalg.inv(np.stack([right - middle, below - middle], axis=1)))

    def _pixels(self, parameters: Real) -> Real:
        """Return the pixels at which the cameras see the grid's places [...], [2, ..., 2] as (column, row)."""
        return self._twin.pixels(parameters, self._places.reshape(-1, 2)).reshape(2, *self._places.shape)

    def _look(self, parameters: Real) -> tuple[NDArray[np.bool_], Real, Real]:
        """The frames where the cameras see the places: which of them both see, counts [2, N], amplitude [N].

        Counts are over twice the reference's, less one half; the amplitude is the reference's over its mean.
        """
        pixels = self._pixels(parameters)
        last = np.array(self._images[0].shape[::-1]) - 3
        chosen = self._inside & np.all((pixels > 2) & (pixels < last), axis=(0, 3))
        counts = [_at(image, at[chosen], order=3) for image, at in zip(self._images, pixels, strict=True)]
        amplitude = np.sqrt(_at(self._levels[0], pixels[0][chosen], order=1))
        return chosen, np.stack(counts), amplitude / amplitude.mean()

    def _left(self, state: _State, sampling: _Sampling) -> tuple[Complex, Real]:
        """The light of both cameras [2, Gy, Gx], and what is left of the equations, [2 N], over each one's noise.

        A count says Re(e exp(-i arm)) + |e|^2 / 2 of the field e over the reference.
        """
        fields, (chosen, counts, amplitude) = self._light(state, sampling), self._look(state.parameters)
        left = []
        for camera, arm in enumerate((0.0, state.quadrature_phase)):
            phasor, here = np.exp(-1j * arm), fields[camera][self._every][chosen] / amplitude
            left.append((counts[camera] - (here * phasor).real - np.abs(here) ** 2 / 2) * _weight(here, phasor))
        return fields, np.concatenate(left)

    def _columns(self, state: _State, fields: Complex, slopes: _Slopes, directions: Complex) -> Real:
        """Derivatives of the equations of `_left`, [2 N, K].

        Columns are those of the illumination's `directions`, the turn, the blur, the modulation's coefficients, and the
        parameters of `slopes`.
        """
        chosen, _, amplitude = self._look(state.parameters)

        def seen(field: Complex) -> Complex:
            return np.asarray(field[chosen] / amplitude)

        of_levels, of_neighbours = slopes.by_level[:-2], slopes.by_level[-2:]
        of_phase, of_crosstalk = ([1j * each for each in some] for some in (of_levels, of_neighbours))
        by_light = *np.tensordot(directions, slopes.by_term, 1), slopes.by_blur
        changes = [*by_light, *of_phase, *of_levels[1:], *of_crosstalk, *slopes.of_light]
        moves = [places[:, chosen] for places in slopes.of_cameras]
        columns = []
        for camera, arm in enumerate((0.0, state.quadrature_phase)):
            phasor, field = np.exp(-1j * arm), fields[camera]
            here, down, across = (seen(part[self._every]) for part in (field, *np.gradient(field)))
            weight = _weight(here, phasor)
            along = (phasor + here.conj()) * weight  # derivative of the count by e
            mine = [(along * seen(change[camera])).real for change in changes]
            mine.insert(len(directions), (here * phasor * -1j).real * weight * camera)
            slope = np.stack([(along * part).real for part in (across, down)])
            mine += [-(slope * move[camera].T).sum(axis=0) for move in moves]
            columns.append(np.stack(mine, axis=1))
        return np.concatenate(columns)

    def _moved(
        self, state: _State, step: Real, directions: Complex, levels: slice, free: list[int], *, bends: bool
    ) -> _State:
        """The state after a step, shortened where it would move a camera too far; `bends` as for `_directions`."""
        change = np.zeros(len(PARAMETERS))
        change[free] = step[levels.stop :]
        by_level = step[levels] if levels.start < levels.stop else 0.0
        few = self._places[self._inside][:: 1 + len(self._places)]
        seen = [self._twin.pixels(at, few) for at in (state.parameters, state.parameters + change)]
        furthest = float(np.sqrt(np.mean(np.sum((seen[1] - seen[0]) ** 2, axis=-1), axis=-1)).max())
        share = min(1.0, _LARGEST_MOVE_PX / max(furthest, 1e-9))
        light = state.light + share * step[: len(directions)] @ directions
        return _State(
            state.parameters + share * change,
            state.quadrature_phase + share * float(step[len(directions)]),
            light if bends else _of_one_phase(light),
            state.levels + share * by_level,
            max(0.0, state.blur + share * float(step[len(directions) + 1])),
        )


def _found(state: _State) -> dict[str, Any]:
    """Return what a fit finds, as attributes of `WaveFitted`."""
    return {
        "parameters": state.parameters,
        "quadrature_phase": state.quadrature_phase,
        "conditions": LaunchConditions(state.light, state.blur),
        "modulation": Modulation(tuple(state.levels.tolist())),
    }


def _within_round(progress: Callable[[float], None], number: int, share: float) -> None:
    """Tell of a share of round `number`."""
    progress((number + share) / ROUNDS)


def _directions(light: Complex, *, bends: bool) -> Complex:
    """Ways in which an illumination may change, as rows of coefficients: brightness, one phase for all, or any."""
    terms = np.eye(len(light))
    if bends:
        return np.concatenate([terms, 1j * terms])
    return np.concatenate([light[0] / abs(light[0]) * terms, 1j * light[None]])


def _of_one_phase(light: Complex) -> Complex:
    """An illumination without what bends the page's phases: a long step turns its even term away from the others."""
    phasor = light[0] / abs(light[0])
    return np.asarray(phasor * (light / phasor).real)


def _told_apart(found: WaveFitted, usual: Modulation) -> WaveFitted:
    """A fit whose modulation is the usual one unless it differs from that by more than its deviations."""
    away = np.subtract(found.modulation.coefficients, usual.coefficients) / found.modulation_deviations
    same = np.mean(away**2) < _LEAST_OFF and (usual.is_nominal or abs(away[0]) < _LEAST_STROKE)
    return replace(found, modulation=usual) if same else found


def _weight(here: Complex, phasor: complex) -> Real:
    """Return 1 over the standard deviation of the equations' noise, where the light is `here`."""
    return np.asarray(1 / np.sqrt(np.abs(1 / phasor + here) ** 2 + READ_NOISE))


def inverse_of_information(information: Real) -> Real:
    """Invert a symmetric matrix whose rows have units of very different size."""
    unit = 1 / np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information * unit * unit[:, None], hermitian=True)
    return np.asarray(inverse * unit * unit[:, None])


def _at(image: NDArray[np.float32], pixels: Real, order: Literal[1, 3]) -> Real:
    """Values at pixels [N, 2] (column, row)."""
    values = scipy.ndimage.map_coordinates(image, [pixels[:, 1], pixels[:, 0]], order=order, prefilter=False)
    return np.asarray(values, dtype=np.float64)
