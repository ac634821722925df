"""Measure how well a fitted device explains the light of a known page: in bits, by place, and the likeliest cause.

The fitted waves predict the counts of a known page. The adjoint waves take the residual back to the modulator. There it
is an error of each symbol, as it remains when all other symbols are known. The prediction includes the mean count as a
function of the expected count, which is measured on the page. The variance of the frames' noise is measured over the
expected count, at frequencies above those of the light. Noise of this variance takes the same way back. Noise of the
modulator causes errors of phase, and few of amplitude. Light that the model misplaces causes as many of either. So
errors of amplitude, beyond those of noise, are errors that a better model would not make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.camera_faults import (
    CountTerms,
    contrast_bits,
    count_terms,
    named_contrast,
    named_exposures,
    named_shadows,
    passed_light,
)
from lightpage.calibration.goodness.causes import shares_of, unlike_profile
from lightpage.calibration.goodness.equations import equations_near, noise_equations
from lightpage.calibration.goodness.ghost import ghost_amplitude
from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.goodness.page_errors import (
    Explained,
    flicker_variance,
    lost_bits,
    named_outliers,
    outlier_bits,
    outliers,
    steps_to_neighbours,
    without_levels,
    without_neighbours,
)
from lightpage.calibration.goodness.remedies import (
    CAMERA_PIXELS,
    CONTRAST,
    DEAD_PIXELS,
    DUST,
    FLICKER,
    GHOST,
    LEVELS,
    NEIGHBOURS,
    OTHER_SYMBOLS,
    REFERENCE_EXPOSURE,
    UNKNOWN,
    VIBRATION,
    WALLS,
    cause_of,
    largest,
)
from lightpage.calibration.goodness.verdict import GOOD, USABLE, Cause, Goodness, Map
from lightpage.calibration.goodness.walls import wall_difference
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.waves.wave_model import LaunchConditions, on_modulator
from lightpage.errors import CalibrationError
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_OWN_ERROR_RAD = 0.02
"""Approximate phase error that the standard decoder adds to that of noise. With it, the estimated loss agrees with the
measured one where light passes the pipe three times, or where planes or tilts were not fitted."""
_MOST_MODULATOR_NOISE_RAD2 = 1.0
"""Largest variance of the modulator's phase noise, a sample. A page with more has no signal."""
_SMOOTHED = 9
"""Side, symbols, of the squares whose mean error is not counted: a network learns smooth errors."""
_EDGE = 2
"""Width, symbols, of the margin that is excluded: part of its light may miss the cameras."""
_LEAST_GAIN = 0.5
"""Least gain of a visible symbol, over the median gain."""
_TINY = 1e-30
_BLOCKS = (6, 8)
"""Largest numbers of rows and columns of the maps."""
_MOST_RATIO = 1e6
"""Largest ratio in the maps."""
_FOREIGN = 0.1
"""Least mean square of the symbols' relative errors that shows the light of other symbols."""
_LEAST_MEASURED = 0.03
"""Least information that a cause costs by its estimate, bits a symbol, for its size to be measured."""
_LEAST_BITS = 0.005
"""Least information that a named cause costs, bits a symbol."""


class ShownPage(NamedTuple):
    """Known page as a fitted device shows it.

    Attributes:
        device: fitted device, with the page's own tilt and shift.
        conditions: the page's illumination and blur.
        pair: frames of the page.
        symbols: unit phasors of the page's symbols [ny, nx].
    """

    device: CalibratedDevice
    conditions: LaunchConditions
    pair: FramePair
    symbols: NDArray[np.complex128]


class _PageErrors(NamedTuple):
    """Light of a page, and the errors of its symbols.

    Attributes:
        light: light of the page, after its corrections.
        terms: terms of both cameras' counts.
        residual: residual of the model on the exit facet.
        gain: gain of each symbol, [ny, nx].
        visible: symbols whose light both cameras see, [ny, nx].
        errors: relative errors without their smooth part and without the page's edges.
        phases: phases of the levels, without the page's edges.
        neighbourhood: see `steps_to_neighbours`, without the page's edges.
    """

    light: PageLight
    terms: list[CountTerms]
    residual: Complex
    gain: NDArray[np.floating]
    visible: NDArray[np.bool_]
    errors: Complex
    phases: Real
    neighbourhood: Real

    def errors_by_camera(self) -> Complex:
        """Errors of the symbols as either camera alone shows them, [2, ny, nx]."""
        residual = 2 * self.light.residual  # one camera's light is half of it
        by_camera = [residual * chosen for chosen in np.eye(2)[:, :, None, None]]
        return np.stack([self.rough(self.light.waves.back_to_exit(each)) for each in by_camera])

    def without(self, outlying: NDArray[np.bool_] | np.bool_) -> _PageErrors:
        """Return the page without errors of outlying symbols, [ny, nx], whose light is then as measured."""
        light = self.light
        if outlying.any():
            wrong = self.on_modulator(np.where(outlying, self.errors, 0))
            light.fields = light.fields + light.waves.to_cameras(wrong * light.page)
        return self._replace(errors=np.where(outlying, 0, self.errors))

    def on_modulator(self, errors: Complex) -> Complex:
        """Errors of the modulator's samples by those of symbols, without the page's edges."""
        return on_modulator(np.pad(errors, _EDGE), self.light.waves.samples)

    def rough(self, leaving: Complex) -> Complex:
        """Errors of symbols by light on the exit facet, see `errors`."""
        return _rough(self.light.errors(leaving), self.gain, self.visible)


class _Noise(NamedTuple):
    """Noise of a page's frames, and of the modulator with 1 rad a sample.

    Attributes:
        frames, modulator: on the exit facet.
        frame_errors, modulator_errors: errors of symbols by it, see `_PageErrors`.
    """

    frames: Complex
    modulator: Complex
    frame_errors: Complex
    modulator_errors: Complex

    @classmethod
    def drawn(cls, page: _PageErrors) -> _Noise:
        """Draw the noise of a page."""
        frames = page.light.waves.back_to_exit(page.light.frame_noise())
        modulator = page.light.waves.back_to_exit(page.light.modulator_noise())
        return cls(frames, modulator, page.rough(frames), page.rough(modulator))


class _Split(NamedTuple):
    """Errors of a page's symbols, split into noise and what a better model would explain.

    Attributes:
        errors: errors without those of levels and neighbours, [ny, nx].
        by_symbols: what levels and neighbours explain, by the name of the cause.
        unexplained: phase variance that a better model would explain.
        amount: variance of the modulator's phase noise, a sample.
        noise: variance of amplitude and phase by noise, [2].
    """

    errors: Complex
    by_symbols: dict[str, Explained]
    unexplained: float
    amount: float
    noise: Real

    @classmethod
    def of(cls, page: _PageErrors, noise: _Noise) -> _Split:
        """Split the errors of a page's symbols."""
        by_neighbours = without_neighbours(page.errors, page.neighbourhood)
        by_level = without_levels(by_neighbours.residual, page.phases)
        # a better model would explain errors of amplitude and phase alike; noise of the modulator is mostly of phase
        every = by_level.residual, noise.frame_errors, noise.modulator_errors
        total, frames, modulator = (_powers(each) for each in every)
        amplitude, phase = np.maximum(total - frames, 0)
        leak = modulator[0] / modulator[1]
        unexplained = max(0.0, float((amplitude - leak * phase) / (1 - leak)))
        beyond = max(0.0, float(phase - unexplained))
        amount = min(beyond / modulator[1], _MOST_MODULATOR_NOISE_RAD2)
        unexplained += beyond - amount * modulator[1]
        by_symbols = {LEVELS: by_level, NEIGHBOURS: by_neighbours}
        return cls(by_level.residual, by_symbols, unexplained, amount, frames + amount * modulator)

    @property
    def by_symbols_variance(self) -> float:
        """Phase variance that levels and neighbours explain."""
        return sum(each.variance for each in self.by_symbols.values())

    @property
    def bits_lost(self) -> float:
        """Estimate of the information that is lost to what a better model would explain, bits a symbol."""
        wrong = self.unexplained + self.by_symbols_variance
        return float(np.log2(1 + wrong / (self.noise[1] + _OWN_ERROR_RAD**2))) / 2


def measure_goodness(
    twin: Twin,
    pages: Iterable[ShownPage],
    progress: Callable[[float], None] = lambda share: None,
    *,
    gains: NDArray[np.uint8] | None = None,
    explained_from: float = GOOD,
    values: bool = False,
) -> Goodness:
    """Measure how well a fitted device explains the light of a known page, and what causes the rest.

    Args:
        twin: ray tracer of the nominal device.
        pages: page that is measured, and others of the same device, which are asked for if causes are searched. They
            tell what changes from page to page, and what stays.
        progress: called with the finished share of the work.
        gains: gains of the cameras' pixels, which are 0 where they have no signal, [2, H, W]; None if unknown.
        explained_from: loss, bits a symbol, from which on its causes are searched.
        values: whether the sizes of causes are measured too, as far as that is known. It takes longer than the fit.

    Raises:
        CalibrationError: the cameras see the light of no symbol.
    """
    shown = iter(pages)
    first = next(shown)
    page = _page_errors(twin, first, progress)
    noise = _Noise.drawn(page)
    split = _Split.of(page, noise)
    progress(0.8)
    causes: tuple[Cause, ...] = ()
    if max(split.bits_lost, contrast_bits(page.terms)) >= explained_from:
        every = [page, *in_parallel(lambda other: _page_errors(twin, other), list(shown))]
        outlying = outliers([each.errors_by_camera() for each in every]) if len(every) > 1 else np.bool_(False)
        wrong_symbols = np.where(outlying, page.errors, 0)
        every = [each.without(outlying) for each in every]
        split = _Split.of(every[0], noise)
        drawn = noise.frame_errors + np.sqrt(split.amount) * noise.modulator_errors
        causes = _causes(every, split, wrong_symbols, drawn, gains, values=values)
    lost = split.bits_lost
    if lost >= GOOD and not causes:
        causes = (cause_of(UNKNOWN, lost),)
    cause = unlike_profile(first.device.parameters) or (largest(causes) if lost >= GOOD else "")
    modulator_variance = float(split.amount * np.mean(noise.modulator_errors.imag**2))
    return Goodness(
        verdict="good" if lost < GOOD and not cause else "usable" if lost < USABLE else "wrong",
        bits_lost=lost,
        unexplained_relative=2 * split.unexplained + split.by_symbols_variance,
        noise_relative=float(split.noise.sum()),
        modulator_noise_rad=float(np.sqrt(split.amount)),
        by_page=_map(split.errors, noise.frame_errors, split.amount, noise.modulator_errors),
        by_facet=_map(page.residual, noise.frames, split.amount, noise.modulator),
        cause=cause,
        frame_error_rad=float(np.sqrt(np.mean(noise.frame_errors.imag**2))),
        modulator_error_rad=float(np.sqrt(modulator_variance)),
        causes=causes,
    )


def _page_errors(twin: Twin, page: ShownPage, progress: Callable[[float], None] = lambda share: None) -> _PageErrors:
    """Project the residual of a page to errors of its symbols.

    Raises:
        CalibrationError: the cameras see the light of no symbol.
    """
    light = PageLight(twin, *page)
    progress(0.2)
    light.correct_amplitude()
    terms = count_terms(light)
    light.correct_counts()
    progress(0.4)
    back = light.waves.back_to_exit
    residual = back(light.residual)
    gain = _smooth(light.errors(back(light.observed_change(light.fields))).real)
    visible = gain > _LEAST_GAIN * max(float(np.median(gain)), _TINY)
    if not visible.any():
        raise CalibrationError("calibration, verdict", "no symbol whose light both cameras see", "some")
    errors = _rough(light.errors(residual), gain, visible)
    phases = np.mod(np.angle(page.symbols), 2 * np.pi)
    inside = slice(_EDGE, -_EDGE), slice(_EDGE, -_EDGE)
    neighbourhood = steps_to_neighbours(phases)[:, *inside]
    progress(0.6)
    return _PageErrors(light, terms, residual, gain, visible, errors, phases[inside], neighbourhood)


def _causes(
    pages: Sequence[_PageErrors],
    split: _Split,
    wrong_symbols: Complex,
    drawn: Complex,
    gains: NDArray[np.uint8] | None,
    *,
    values: bool,
) -> tuple[Cause, ...]:
    """Split what is lost among its causes, the largest first.

    Args:
        pages: known pages without the errors of outliers.
        split: split of the first one's errors.
        wrong_symbols: errors of its outliers, zero elsewhere.
        drawn: errors as noise alone makes them. An estimator by the fitted waves adds no errors of its own.
        gains: gains of the cameras' pixels, [2, H, W]; None if unknown.
        values: whether the sizes of causes are measured too.
    """
    by_symbols = split.by_symbols
    unexplained = split.unexplained
    page = pages[0]
    flicker = flicker_variance([each.errors for each in pages], [each.phases for each in pages])
    variance = max(float(np.mean(drawn.imag**2)), _TINY)
    variances = {name: each.variance for name, each in by_symbols.items()}
    variances |= {FLICKER: flicker, LEVELS: max(0.0, variances[LEVELS] - flicker)}
    light = page.light
    known = page.on_modulator(by_symbols[LEVELS].part + by_symbols[NEIGHBOURS].part)
    dark = np.stack([passed_light(*_frames_of(pages, camera)) < 1 for camera in range(2)])
    places = {DUST: equations_near(light, dark)}
    if gains is not None:
        places[CAMERA_PIXELS] = equations_near(light, gains == 0)
    noise = noise_equations(light, split.amount)
    shares = shares_of(light, noise, known, places)
    contrast = named_contrast(page.terms)
    for name, share in shares.items():
        variances[contrast or CONTRAST if name == CONTRAST else name] = share * unexplained
    wrong = sum(variances.values()) + max(0.0, unexplained * (1 - sum(shares.values())))
    lost = max(0.0, lost_bits(page.errors, variance) - lost_bits(drawn, variance))
    bits = {name: lost * each / max(wrong, _TINY) for name, each in variances.items()}
    bits[DEAD_PIXELS] = outlier_bits(wrong_symbols, variance)
    if contrast == VIBRATION:
        bits[VIBRATION] = bits.get(VIBRATION, 0.0) + contrast_bits(page.terms)
    unknown = lost * max(0.0, 1 - sum(variances.values()) / max(wrong, _TINY))
    foreign = np.mean(np.abs(split.errors) ** 2) > _FOREIGN
    bits[OTHER_SYMBOLS if foreign else UNKNOWN] = unknown
    details = {
        DEAD_PIXELS: named_outliers(wrong_symbols != 0),
        DUST: named_shadows(dark),
        REFERENCE_EXPOSURE: named_exposures(page.terms),
    }
    if values and bits.get(WALLS, 0.0) >= _LEAST_MEASURED:
        details[WALLS] = str(wall_difference(light) or "")
    if values and bits.get(GHOST, 0.0) >= _LEAST_MEASURED:
        details[GHOST] = str(ghost_amplitude(light))
    causes = [cause_of(name, each, details.get(name, "")) for name, each in bits.items() if each >= _LEAST_BITS]
    if lost < GOOD and all(cause.name == UNKNOWN for cause in causes):
        return ()
    return tuple(sorted(causes, key=lambda cause: (cause.name == UNKNOWN, -cause.bits)))


def _frames_of(
    pages: Sequence[_PageErrors], camera: int
) -> tuple[list[NDArray[np.integer]], list[NDArray[np.float32]]]:
    """Frames of one camera, and the counts that the model expects of them."""
    frames = [(page.light.pair.in_phase, page.light.pair.quadrature)[camera] for page in pages]
    return frames, [page.light.expected_frames()[camera] for page in pages]


def _smooth(errors: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.asarray(scipy.ndimage.uniform_filter(errors, _SMOOTHED))


def _rough(errors: Complex, gain: NDArray[np.floating], visible: NDArray[np.bool_]) -> Complex:
    """Errors over their gain, minus their smooth part and without the page's edges.

    Invisible symbols get no error. The others are scaled so that the page's mean power is that of visible symbols.
    """
    relative = np.where(visible, errors, 0) / np.where(visible, gain, 1)
    rough = (relative - _smooth(relative.real) - 1j * _smooth(relative.imag)) * visible / np.sqrt(visible.mean())
    return np.asarray(rough[_EDGE:-_EDGE, _EDGE:-_EDGE])


def _powers(errors: Complex) -> Real:
    """Mean square of the errors of amplitude and of phase, [2]."""
    return np.array([np.mean(errors.real**2), np.mean(errors.imag**2)])


def _map(residual: Complex, frames: Complex, amount: float, modulator: Complex) -> Map:
    """Power of the residual over that of noise, in blocks."""

    def blocks(light: Complex) -> Real:
        down, across = (min(most, size) for most, size in zip(_BLOCKS, light.shape, strict=True))
        rows = np.array_split(np.abs(light) ** 2, down, axis=0)
        return np.array([[part.mean() for part in np.array_split(row, across, axis=1)] for row in rows])

    power = blocks(residual)
    noise = blocks(frames) + amount * blocks(modulator)
    ratio = power / np.maximum(noise, np.maximum(power / _MOST_RATIO, _TINY))
    return [[round(float(one), 3) for one in row] for row in ratio]
