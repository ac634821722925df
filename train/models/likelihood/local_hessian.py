"""Local approximation of the Hessian of a page's log-likelihood by the phases of the modulator's samples.

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
"""Rounds of conjugate gradients. More gain nothing, since the Hessian is approximate."""
LARGEST_DEVIATION_RAD = 0.5
DAMPING = 0.3
"""Curvature that deviations get beside their own, over a sample's information (Levenberg): the point spread alone has
none outside the pipe's band, where the true Hessian has a little."""
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
        of_sample = to_samples(information / self._samples**2, self._samples)
        self._information = information
        self._precision = precision
        self._damped = precision + DAMPING * of_sample
        self._diagonal = precision + of_sample

    def solve(self, gradient: Tensor, deviations: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the changes of the symbols' phases [ny, nx], and the samples' next deviations, [ny S, nx S].

        Conjugate gradients of both together, preconditioned by the diagonal.

        Args:
            gradient: derivative of the log-likelihood by the samples' phases, [ny S, nx S].
            deviations: deviations of the samples' phases from those of their symbols, radians, with a mean of zero;
                None where they are to stay zero.
        """
        symbols = summed(gradient, self._samples)
        if deviations is None:
            (phases,) = self._conjugate_gradients([symbols])
            return phases, torch.zeros_like(gradient)
        samples = self._without_mean(gradient, symbols) - self._precision * deviations
        phases, changes = self._conjugate_gradients([symbols, samples])
        limited = torch.clamp(changes, -LARGEST_DEVIATION_RAD, LARGEST_DEVIATION_RAD)
        return phases, deviations + self._without_mean(limited, summed(limited, self._samples))

    def _conjugate_gradients(self, residual: list[Tensor]) -> list[Tensor]:
        """Solve for changes of phases, and of deviations where the residual has both."""
        diagonal = [self._information, self._diagonal][: len(residual)]
        solution = [torch.zeros_like(part) for part in residual]
        scaled_residual = [part / own for part, own in zip(residual, diagonal, strict=True)]
        direction = scaled_residual
        power = _product(residual, scaled_residual)
        for number in range(ROUNDS):
            product = self._times(direction)
            length = power / (_product(direction, product) + _LEAST)
            solution = [part + length * change for part, change in zip(solution, direction, strict=True)]
            if number == ROUNDS - 1:
                break
            residual = [part - length * change for part, change in zip(residual, product, strict=True)]
            scaled_residual = [part / own for part, own in zip(residual, diagonal, strict=True)]
            previous = power
            power = _product(residual, scaled_residual)
            share = power / (previous + _LEAST)
            direction = [part + share * change for part, change in zip(scaled_residual, direction, strict=True)]
        return solution

    def _times(self, change: list[Tensor]) -> list[Tensor]:
        """Product of the damped Hessian and changes of phases, and of deviations where they are given."""
        samples = sum(change[1:], to_samples(change[0], self._samples))
        spread = filtered(torch.stack(scaled(self._light, samples)), self._weights)
        gradient = self._light[0] * spread[0] + self._light[1] * spread[1]
        symbols = summed(gradient, self._samples)
        return [symbols, *(self._without_mean(gradient, symbols) + self._damped * part for part in change[1:])]

    def _without_mean(self, samples: Tensor, sums: Tensor) -> Tensor:
        """Samples less their mean over each symbol."""
        return samples - to_samples(sums / self._samples**2, self._samples)


def _product(one: list[Tensor], other: list[Tensor]) -> Tensor:
    """Scalar product of two lists of tensors of the same shapes."""
    return torch.stack([(first * second).sum() for first, second in zip(one, other, strict=True)]).sum()
