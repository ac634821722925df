"""Measure how well a fitted device explains the light of a known page: in bits, by place, and the likeliest cause.

What the cameras should have seen of the page, by the fitted waves, is taken off what they saw. The rest is sent back to
the modulator. There it is an error of each symbol, as a decoder meets it that knows all others. The mean count over the
expected count is measured, and is part of what the cameras should have seen. The variance of the frames' noise over the
expected count is measured at frequencies above those of the light, and noise like it is sent the same way. Noise of the
modulator makes errors of phase, and few of amplitude. Light that the model puts in another place makes as much of
either. So errors of amplitude, beyond those of noise, are errors that a better model would not make.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.light import SeenLight
from lightpage.calibration.goodness.suspects import LEVELS, NEIGHBOURS, likeliest, unlike_profile
from lightpage.calibration.goodness.verdict import GOOD, USABLE, Goodness, Map
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.errors import CalibrationError
from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_OWN_ERROR_RAD = 0.02
"""Error of phase of a symbol that the standard decoder adds to that of noise, about: so bits that are lost come out as
measured where light passes the pipe three times, or planes or tilts were not fitted."""
_MOST_MODULATOR_NOISE_RAD2 = 1.0
"""Variance of a sample's phase that a modulator's noise may have; no light is left to read where it has more."""
_SMOOTHED = 9
"""Symbols, side of the squares over whose mean a symbol's error does not count: a network learns what is smooth."""
_EDGE = 2
"""Symbols along the page's edges that are left out: part of their light may miss the cameras."""
_SEEN = 0.5
"""Share of the usual gain from which on the cameras see a symbol."""
_NOTHING = 1e-30
_BLOCKS = (6, 8)
"""Rows and columns of the maps, at most."""
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
        device: device as it was fitted.
        conditions: the page's illumination and blur.
        pair: frames of the page.
        symbols: unit phasors of the page's symbols [ny, nx].
        progress: told of the share that is behind.
    """
    light = SeenLight(twin, device, conditions, pair, symbols)
    progress(0.2)
    light.correct_amplitude()
    light.correct_counts()
    progress(0.4)
    back = light.waves.back_to_exit
    at_exit = [back(each) for each in (light.left, light.noise_of_frames(), light.noise_of_modulator())]
    progress(0.6)
    gain = _smooth(light.errors(back(light.seen_of(light.fields))).real)
    seen = gain > _SEEN * max(float(np.median(gain)), _NOTHING)
    if not seen.any():
        raise CalibrationError("calibration, verdict", "no symbol whose light both cameras see", "some")
    errors, of_frames, of_modulator = (_rough(light.errors(each), gain, seen) for each in at_exit)
    phases = np.mod(np.angle(symbols), 2 * np.pi)
    errors, by_neighbours = _without_neighbours(errors, phases)
    errors, by_level = _without_levels(errors, phases)
    progress(0.8)
    # Of errors of amplitude and of phase: what a better model explains is in both, noise of the modulator in phase.
    here, frames, modulator = (_powers(each) for each in (errors, of_frames, of_modulator))
    amplitude, phase = np.maximum(here - frames, 0)
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
        told = max(shares, key=lambda words: shares[words])
        cause = told if shares[told] > wrong / 2 else likeliest(light, errors)
    return Goodness(
        verdict="good" if good else "usable" if lost < USABLE else "wrong",
        bits_lost=lost,
        unexplained_relative=2 * unexplained + by_level + by_neighbours,
        noise_relative=float(noise.sum()),
        modulator_noise_rad=float(np.sqrt(amount)),
        by_page=_map(errors, of_frames, amount, of_modulator),
        by_facet=_map(at_exit[0], at_exit[1], amount, at_exit[2]),
        cause=cause,
    )


def _smooth(errors: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.asarray(scipy.ndimage.uniform_filter(errors, _SMOOTHED))


def _rough(errors: Complex, gain: NDArray[np.floating], seen: NDArray[np.bool_]) -> Complex:
    """Errors over their gain less what is smooth in them, the page's edges left out.

    Symbols whose light the cameras do not see have none, and the others stand for them.
    """
    relative = np.where(seen, errors, 0) / np.where(seen, gain, 1)
    rough = (relative - _smooth(relative.real) - 1j * _smooth(relative.imag)) * seen / np.sqrt(seen.mean())
    return np.asarray(rough[_EDGE:-_EDGE, _EDGE:-_EDGE])


def _without_levels(errors: Complex, phases: Real) -> tuple[Complex, float]:
    """Errors less the mean of their level, and the variance of phase of what those means are beyond chance."""
    _, level = np.unique(np.round(phases[_EDGE:-_EDGE, _EDGE:-_EDGE].ravel(), 6), return_inverse=True)
    count = np.bincount(level)
    flat = errors.ravel()
    mean = (np.bincount(level, flat.real) + 1j * np.bincount(level, flat.imag)) / count
    several = count[level] > 1
    left = np.where(several, (flat - mean[level]) * np.sqrt(count[level] / np.maximum(count[level] - 1, 1)), flat)
    chance = np.mean(left.imag**2) * len(count) / len(flat)
    return left.reshape(errors.shape), max(0.0, float(np.mean(mean.imag[level] ** 2) - chance))


def _without_neighbours(errors: Complex, phases: Real) -> tuple[Complex, float]:
    """Errors less phases that go with the steps to the neighbouring symbols, and the variance of these beyond chance.

    Fringing fields between the modulator's pixels make them. What such a step has of the symbol's own level is stroke
    to the fit, which leaves the neighbours' phases.
    """
    columns = []
    for axis in (0, 1):
        beside = [np.roll(phases, shift, axis) for shift in (1, -1)]
        columns += [beside[0] + beside[1] - 2 * np.pi, np.sin(beside[0] - phases) + np.sin(beside[1] - phases)]
    matrix = np.stack([column[_EDGE:-_EDGE, _EDGE:-_EDGE].ravel() for column in columns], axis=1)
    explained = matrix @ np.linalg.lstsq(matrix, errors.imag.ravel(), rcond=None)[0]
    left = errors - 1j * explained.reshape(errors.shape)
    chance = len(columns) * np.mean(left.imag**2) / left.size
    return left, max(0.0, float(np.mean(explained**2) - chance))


def _powers(errors: Complex) -> Real:
    """Mean square of the errors of amplitude and of phase, [2]."""
    return np.array([np.mean(errors.real**2), np.mean(errors.imag**2)])


def _map(here: Complex, frames: Complex, amount: float, modulator: Complex) -> Map:
    """Power of what is left over that of noise, in blocks."""

    def blocks(light: Complex) -> Real:
        down, across = (min(most, size) for most, size in zip(_BLOCKS, light.shape, strict=True))
        rows = np.array_split(np.abs(light) ** 2, down, axis=0)
        return np.array([[part.mean() for part in np.array_split(row, across, axis=1)] for row in rows])

    light, noise = blocks(here), blocks(frames) + amount * blocks(modulator)
    ratio = light / np.maximum(noise, np.maximum(light / _MOST_RATIO, _NOTHING))
    return [[round(float(one), 3) for one in row] for row in ratio]
