"""The Hessian of a page's log-likelihood by the phases of the modulator's samples, as what neighbours share alone.

Forward and adjoint waves bring the light of one sample back to it and to its neighbours, by the point spread of the
pipe's entrance; the cameras' weights vary like speckle, and on average they are one factor. So the product of the
Hessian and a change of phases is a convolution, and needs no waves. `docs/reference/physics.md` has its accuracy.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightpage.train.models.filters import block_weights, filtered
from lightpage.train.models.likelihood.modulator import summed, to_samples
from lightpage.train.models.parts import Parts, scaled

ROUNDS = 4
"""Rounds of conjugate gradients; more bring nothing, since the Hessian is known no better."""
LARGEST_DEVIATION_RAD = 0.5
_LEAST = 1e-20


class LocalHessian:
    """Local Hessian of a page at an estimate.

    Args:
        direction: unit phasors of the derivatives of the samples' light by their phases, [ny S, nx S].
        information: Fisher information of the symbols, [ny, nx].
        point_spread: see `lightpage.calibration.likelihood.table.point_spread`.
        precision: inverse variance of what a sample's phase differs from its symbol's, [].
    """

    def __init__(self, direction: Parts, information: Tensor, point_spread: Tensor, precision: Tensor) -> None:
        self._samples = direction[0].shape[0] // information.shape[0]
        taps = torch.cat([point_spread[1:].flip(0), point_spread])
        self._weights = block_weights(taps)[:, None]
        apart = torch.arange(self._samples)
        of_symbol = point_spread[(apart[:, None] - apart).abs()].sum() ** 2
        self._light = scaled(direction, torch.sqrt(to_samples(information / of_symbol, self._samples)))
        self._information, self._precision = information, precision
        self._own = to_samples(information, self._samples) / self._samples**2 + precision

    def solve(self, gradient: Tensor, deviations: Tensor) -> tuple[Tensor, Tensor]:
        """Return the changes of the symbols' phases [ny, nx] and of their samples' deviations, [ny S, nx S].

        Conjugate gradients of both together, preconditioned by the diagonal.

        Args:
            gradient: derivative of the log-likelihood by the samples' phases, [ny S, nx S].
            deviations: what the samples' phases differ from their symbols', radians; their mean is zero.
        """
        symbols, samples = self._split(gradient)
        samples = samples - self._precision * deviations
        phases, changes = torch.zeros_like(symbols), torch.zeros_like(samples)
        by_symbol, by_sample = symbols / self._information, samples / self._own
        ahead, beside = by_symbol, by_sample
        power = (symbols * by_symbol).sum() + (samples * by_sample).sum()
        for number in range(ROUNDS):
            curved, bent = self._times(ahead, beside)
            length = power / ((ahead * curved).sum() + (beside * bent).sum() + _LEAST)
            phases, changes = phases + length * ahead, changes + length * beside
            if number == ROUNDS - 1:
                break
            symbols, samples = symbols - length * curved, samples - length * bent
            by_symbol, by_sample = symbols / self._information, samples / self._own
            before = power
            power = (symbols * by_symbol).sum() + (samples * by_sample).sum()
            share = power / (before + _LEAST)
            ahead, beside = by_symbol + share * ahead, by_sample + share * beside
        return phases, torch.clamp(changes, -LARGEST_DEVIATION_RAD, LARGEST_DEVIATION_RAD)

    def _times(self, phases: Tensor, deviations: Tensor) -> tuple[Tensor, Tensor]:
        """Product of the Hessian, with the deviations' precision, and changes of phases and deviations."""
        change = to_samples(phases, self._samples) + deviations
        spread = filtered(torch.stack(scaled(self._light, change)), self._weights)
        symbols, samples = self._split(self._light[0] * spread[0] + self._light[1] * spread[1])
        return symbols, samples + self._precision * deviations

    def _split(self, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient by phases [ny, nx], and by deviations of zero mean, [ny S, nx S]."""
        symbols = summed(gradient, self._samples)
        return symbols, gradient - to_samples(symbols / self._samples**2, self._samples)
