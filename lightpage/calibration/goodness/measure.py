"""Measure how well a fitted device explains the light of a known page: in bits, by place, and the likeliest cause.

The fitted waves predict the counts of a known page. The adjoint waves take the residual back to the modulator. There it
is an error of each symbol, as it remains when all other symbols are known. The prediction includes the mean count as a
function of the expected count, which is measured on the page. The variance of the frames' noise is measured over the
expected count, at frequencies above those of the light. Noise of this variance takes the same way back. Noise of the
modulator causes errors of phase, and few of amplitude. Light that the model misplaces causes as many of either. So
errors of amplitude, beyond those of noise, are errors that a better model would not make.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.goodness.suspects import LEVELS, NEIGHBOURS, likeliest, unlike_profile
from lightpage.calibration.goodness.verdict import GOOD, USABLE, Goodness, Map
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.errors import CalibrationError
from lightpage.recording.frame_pair import FramePair

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


def measure_goodness(
    twin: Twin,
    device: CalibratedDevice,
    conditions: LaunchConditions,
    pair: FramePair,
    symbols: NDArray[np.complex128],
    progress: Callable[[float], None] = lambda share: None,
) -> Goodness:
    """Measure how well a fitted device explains the light of a known page.

    Args:
        twin: ray tracer of the nominal device.
        device: fitted device.
        conditions: the page's illumination and blur.
        pair: frames of the page.
        symbols: unit phasors of the page's symbols [ny, nx].
        progress: called with the finished share of the work.

    Raises:
        CalibrationError: the cameras see the light of no symbol.
    """
    light = PageLight(twin, device, conditions, pair, symbols)
    progress(0.2)
    light.correct_amplitude()
    light.correct_counts()
    progress(0.4)
    back = light.waves.back_to_exit
    residual = back(light.residual)
    frame_noise = back(light.frame_noise())
    modulator_noise = back(light.modulator_noise())
    progress(0.6)
    gain = _smooth(light.errors(back(light.observed_change(light.fields))).real)
    visible = gain > _LEAST_GAIN * max(float(np.median(gain)), _TINY)
    if not visible.any():
        raise CalibrationError("calibration, verdict", "no symbol whose light both cameras see", "some")
    errors, frame_errors, modulator_errors = (
        _rough(light.errors(each), gain, visible) for each in (residual, frame_noise, modulator_noise)
    )
    phases = np.mod(np.angle(symbols), 2 * np.pi)
    errors, by_neighbours = _without_neighbours(errors, phases)
    errors, by_level = _without_levels(errors, phases)
    progress(0.8)
    # A better model would explain errors of amplitude and of phase alike; noise of the modulator is mostly of phase.
    total, frames, modulator = (_powers(each) for each in (errors, frame_errors, modulator_errors))
    amplitude, phase = np.maximum(total - frames, 0)
    leak = modulator[0] / modulator[1]
    unexplained = max(0.0, float((amplitude - leak * phase) / (1 - leak)))
    beyond = max(0.0, float(phase - unexplained))
    amount = min(beyond / modulator[1], _MOST_MODULATOR_NOISE_RAD2)
    unexplained += beyond - amount * modulator[1]
    noise = frames + amount * modulator
    wrong = unexplained + by_level + by_neighbours
    lost = float(np.log2(1 + wrong / (noise[1] + _OWN_ERROR_RAD**2))) / 2
    cause = unlike_profile(device.parameters)
    good = lost < GOOD and not cause
    if lost >= GOOD and not cause:
        shares = {LEVELS: by_level, NEIGHBOURS: by_neighbours}
        largest = max(shares, key=lambda words: shares[words])
        cause = largest if shares[largest] > wrong / 2 else likeliest(light, errors)
    return Goodness(
        verdict="good" if good else "usable" if lost < USABLE else "wrong",
        bits_lost=lost,
        unexplained_relative=2 * unexplained + by_level + by_neighbours,
        noise_relative=float(noise.sum()),
        modulator_noise_rad=float(np.sqrt(amount)),
        by_page=_map(errors, frame_errors, amount, modulator_errors),
        by_facet=_map(residual, frame_noise, amount, modulator_noise),
        cause=cause,
        frame_error_rad=float(np.sqrt(frames[1])),
        modulator_error_rad=float(np.sqrt(amount * modulator[1])),
    )


def _smooth(errors: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.asarray(scipy.ndimage.uniform_filter(errors, _SMOOTHED))


def _rough(errors: Complex, gain: NDArray[np.floating], visible: NDArray[np.bool_]) -> Complex:
    """Errors over their gain, minus their smooth part and without the page's edges.

    Invisible symbols get no error. The others are scaled so that the page's mean power is that of visible symbols.
    """
    relative = np.where(visible, errors, 0) / np.where(visible, gain, 1)
    rough = (relative - _smooth(relative.real) - 1j * _smooth(relative.imag)) * visible / np.sqrt(visible.mean())
    return np.asarray(rough[_EDGE:-_EDGE, _EDGE:-_EDGE])


def _without_levels(errors: Complex, phases: Real) -> tuple[Complex, float]:
    """Errors minus the mean of their level, and the phase variance of these means beyond that of chance."""
    _, level = np.unique(np.round(phases[_EDGE:-_EDGE, _EDGE:-_EDGE].ravel(), 6), return_inverse=True)
    count = np.bincount(level)
    flat = errors.ravel()
    mean = (np.bincount(level, flat.real) + 1j * np.bincount(level, flat.imag)) / count
    several = count[level] > 1
    unbiased = np.sqrt(count[level] / np.maximum(count[level] - 1, 1))
    residual = np.where(several, (flat - mean[level]) * unbiased, flat)
    chance = np.mean(residual.imag**2) * len(count) / len(flat)
    return residual.reshape(errors.shape), max(0.0, float(np.mean(mean.imag[level] ** 2) - chance))


def _without_neighbours(errors: Complex, phases: Real) -> tuple[Complex, float]:
    """Errors minus phases that depend on the neighbouring symbols, and the variance of these beyond that of chance.

    Fringing fields between the modulator's pixels cause such phases, which follow the steps to the neighbours. The fit
    of the stroke already explains the part that depends on the symbol's own level.
    """
    columns = []
    for axis in (0, 1):
        beside = [np.roll(phases, shift, axis) for shift in (1, -1)]
        columns += [beside[0] + beside[1] - 2 * np.pi, np.sin(beside[0] - phases) + np.sin(beside[1] - phases)]
    matrix = np.stack([column[_EDGE:-_EDGE, _EDGE:-_EDGE].ravel() for column in columns], axis=1)
    explained = matrix @ np.linalg.lstsq(matrix, errors.imag.ravel(), rcond=None)[0]
    residual = errors - 1j * explained.reshape(errors.shape)
    chance = len(columns) * np.mean(residual.imag**2) / residual.size
    return residual, max(0.0, float(np.mean(explained**2) - chance))


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
