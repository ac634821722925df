"""Resampling of a frame at places between its pixels: linear interpolation with a correction of its curvature.

Between two pixels, linear interpolation at a share t of the way weakens the frequency w by about t (1 - t) w^2 / 2. A
prefilter alone can make that good on average over t, and leaves 1.4% of a field's light in error. Here the samples are
corrected by t (1 - t) times a filter along each axis of the grid on which they lie.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_PREFILTER_TAPS = 11
_CORRECTION_TAPS = 5
_STOP = 0.36
"""Beginning of the prefilter's stop band, cycles per pixel: so few taps stop nothing below it."""
_FIELD_SHARE = 0.7
"""Weight of the band of the field itself; the rest is that of its power, which falls off to twice the band's edge."""
_STOP_WEIGHT = 0.02
_FREQUENCIES = 81
_PLACES = 16
_ROUNDS = 20
"""Rounds in which either filter is fitted with the other one fixed."""


class CorrectedInterpolation(NamedTuple):
    """Filters around a linear interpolation.

    Attributes:
        prefilter: taps along each axis of the frame, [11].
        correction: taps along each axis of the grid; their outcome times t (1 - t) is added, [5].
    """

    prefilter: Real
    correction: Real


def corrected_interpolation(edge: float, step_px: int) -> CorrectedInterpolation:
    """Fit the filters by least squares over the places between two pixels.

    Args:
        edge: edge of the field's band, cycles per pixel.
        step_px: pitch of the grid, pixels.
    """
    frequencies = np.linspace(0, 2 * edge, _FREQUENCIES)
    power = np.maximum(0, 1 - frequencies / (2 * edge))
    weights = np.sqrt(_FIELD_SHARE * (frequencies <= edge) + (1 - _FIELD_SHARE) * power)
    places = (np.arange(_PLACES) + 0.5) / _PLACES
    linear = [interpolation_gain(frequencies, place) for place in places]
    before = _cosines(_PREFILTER_TAPS, frequencies)
    stopped = _cosines(_PREFILTER_TAPS, np.linspace(max(0.5 - edge, _STOP), 0.5, _FREQUENCIES))
    after = _cosines(_CORRECTION_TAPS, step_px * frequencies)
    stop_weight = np.sqrt(_STOP_WEIGHT * _PLACES * 30 / _FREQUENCIES)
    prefilter = np.zeros(before.shape[1])
    correction = np.zeros(after.shape[1])
    for _ in range(_ROUNDS):
        gains = [
            gain * (1 + place * (1 - place) * (after @ correction)) for place, gain in zip(places, linear, strict=True)
        ]
        rows = [(weights * gain)[:, None] * before for gain in gains]
        wanted = [weights + 0j] * _PLACES
        prefilter = _least_squares([*rows, stop_weight * stopped], [*wanted, np.zeros(len(stopped))])
        passed = [gain * (before @ prefilter) for gain in linear]
        rows = [
            (weights * place * (1 - place) * gain)[:, None] * after for place, gain in zip(places, passed, strict=True)
        ]
        correction = _least_squares(rows, [weights * (1 - gain) for gain in passed])
    taps = _symmetric(prefilter)
    return CorrectedInterpolation(taps / taps.sum(), _symmetric(correction))


def interpolation_gain(frequencies: Real, place: float) -> NDArray[np.complex128]:
    """Gain of linear interpolation at a share `place` of the way between two pixels; cycles per pixel."""
    phase = 2j * np.pi * frequencies
    return np.asarray((1 - place + place * np.exp(phase)) * np.exp(-phase * place))


def _cosines(taps: int, frequencies: Real) -> Real:
    """Gains of the taps of a symmetric filter from its middle one on, [F, taps // 2 + 1]."""
    number = np.arange(taps // 2 + 1)
    return np.asarray(np.cos(2 * np.pi * frequencies[:, None] * number) * np.where(number > 0, 2, 1))


def _symmetric(half: Real) -> Real:
    return np.concatenate([half[:0:-1], half])


def _least_squares(rows: list[NDArray[np.number]], wanted: list[NDArray[np.number]]) -> Real:
    """Real solution of complex equations."""
    matrix = np.concatenate(rows)
    values = np.concatenate(wanted)
    real_matrix = np.concatenate([matrix.real, matrix.imag])
    real_values = np.concatenate([values.real, values.imag])
    return np.asarray(np.linalg.lstsq(real_matrix, real_values, rcond=None)[0])
