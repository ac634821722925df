"""The modulator: amplitude of its light, what a change of phase does to it, and the samples that stand for a symbol."""

from __future__ import annotations

import torch
from torch import Tensor

from lightpage.calibration.likelihood.table import HARMONICS
from lightpage.train.models.parts import Parts, multiply


def amplitude_and_slope(direction: Parts, series: Tensor) -> tuple[Tensor, Tensor]:
    """Amplitude of the light of each symbol, and the derivative of its logarithm by the phase, [ny, nx] each.

    Args:
        direction: unit phasors of the symbols' phases, [ny, nx].
        series: Fourier series of the logarithm of the amplitude, constant, then cosine and sine by harmonic,
            [1 + 2 HARMONICS].
    """
    turn = direction
    logarithm, slope = series[0] + torch.zeros_like(direction[0]), torch.zeros_like(direction[0])
    for number in range(1, HARMONICS + 1):
        cosine, sine = series[2 * number - 1], series[2 * number]
        logarithm = logarithm + cosine * turn[0] + sine * turn[1]
        slope = slope + number * (sine * turn[0] - cosine * turn[1])
        turn = multiply(turn, direction)
    return torch.exp(logarithm), slope


def to_samples(symbols: Tensor, samples: int) -> Tensor:
    """Values of symbols [ny, nx] at so many samples along either axis of each, [ny samples, nx samples]."""
    ny, nx = symbols.shape
    return symbols[:, None, :, None].expand(ny, samples, nx, samples).reshape(ny * samples, nx * samples)


def summed(samples: Tensor, count: int) -> Tensor:
    """Sum over the `count` x `count` samples of each symbol, [ny, nx]."""
    ny, nx = samples.shape
    return samples.reshape(ny // count, count, nx // count, count).sum((1, 3))
