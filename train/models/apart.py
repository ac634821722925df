"""Cameras that stand apart on the axis: what each sees of one field, and the field that both have seen.

Against the mean of both places the in-phase camera sees D e and the quadrature camera D* e, with D = exp(i phi) over
the facet and phi growing as the square of the frequency (`lightpage.waves.defocus`). Without |e|^2, and for a turn of
90 degrees, the two equations say cos(phi) E(f) - i sin(phi) E*(-f). The determinant, cos(2 phi), is zero on the ring
where phi is pi / 4: there |e|^2 alone tells one of two real numbers. Descent is slow all over: where a camera is dark,
at 1 + D e = 0, its brightness does not tell in which direction to go.

So what each camera sees is a field of its own, and two demands are met in turn: that both be defocused from one field
in the band, and that each have the measured brightness. Reflections at both, averaged (Douglas and Rachford 1956; for
lost phases Bauschke, Combettes and Luke 2002), do not get stuck where projections do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from torch import Tensor

from lightpage.train.models.filters import along_columns, along_rows, block_weights, in_blocks

ROUNDS = 14
_WEIGHT = 0.75
"""Of the likelihood against staying: a larger one takes fewer rounds and, in dim light, lets more noise in."""
_RELAXATION = 1.4
"""Of a round's step; below 2."""
_DARK = 1e-9
_LINEAR_STEP = 0.7
"""Linear equations have curvatures up to 2; the step times that must stay below 1.5 with this momentum."""
_LINEAR_MOMENTUM = 0.5

Filter = Callable[[Tensor], Tensor]


class CamerasApart(NamedTuple):
    """The defocus of the in-phase camera against the mean of both; the quadrature camera's is its conjugate.

    Attributes:
        real, imaginary: of the kernel along either axis, see `block_weights`.
    """

    real: Tensor
    imaginary: Tensor

    @classmethod
    def of(cls, taps: Tensor) -> Self:
        """The cameras of a kernel's real and imaginary part, [2, taps]."""
        return cls(block_weights(taps[0]), block_weights(taps[1]))

    def seen(self, field: Tensor) -> Tensor:
        """What the cameras see of a field [2, ny, nx]: in-phase, then quadrature, [4, ny, nx]."""
        whole = in_blocks(field)
        even, odd = along_rows(whole, self.real), _quarter_turn(along_rows(whole, self.imaginary))
        along = torch.cat([even + odd, even - odd])
        even, odd = along_columns(along, self.real), along_columns(along, self.imaginary)
        both = torch.cat([even[:2] + _quarter_turn(odd[:2]), even[2:] - _quarter_turn(odd[2:])])
        return both if whole is field else both[:, : field.shape[1], : field.shape[2]]

    def gathered(self, both: Tensor) -> Tensor:
        """The adjoint of `seen`: [4, ny, nx] to [2, ny, nx]."""
        whole = in_blocks(both)
        even, odd = along_rows(whole, self.real), along_rows(whole, self.imaginary)
        in_phase, quadrature = even[:2] - _quarter_turn(odd[:2]), even[2:] + _quarter_turn(odd[2:])
        even = along_columns(in_phase + quadrature, self.real)
        field = even + _quarter_turn(along_columns(quadrature - in_phase, self.imaginary))
        return field if whole is both else field[:, : both.shape[1], : both.shape[2]]

    def recovered(
        self,
        start: Tensor,
        brightness: Tensor,
        arms: Tensor,
        amplitude: Tensor,
        inverse_amplitude: Tensor,
        band: Filter,
    ) -> Tensor:
        """The field that both cameras have seen.

        Args:
            start: estimate of e, [2, ny, nx].
            brightness: measured |1 + D e|^2 and |arm + D* e|^2, [2, ny, nx].
            arms: of both cameras, [4, 1, 1].
            amplitude, inverse_amplitude: by which e becomes E, which defocus and band are about, and back, [ny, nx].
            band: filter of E to the pipe's band.

        Returns:
            e, [2, ny, nx].
        """
        brightness = torch.clamp(brightness, min=0)
        shown = self.seen(start * amplitude) * inverse_amplitude
        state, field = shown, start
        for number in range(ROUNDS):
            moved = _likely(2 * shown - state + arms, brightness) - arms
            state = state + _RELAXATION * (moved - shown)
            field = band(self.gathered(state * amplitude)) / 2
            if number < ROUNDS - 1:
                shown = self.seen(field) * inverse_amplitude
        return field * inverse_amplitude

    def recovered_linearly(self, left: Tensor, arms: Tensor, band: Filter) -> Tensor:
        """The field where |e|^2 is taken off both equations: descent from none.

        Args:
            left: sides of the equations, [2, ny, nx].
            arms: of both cameras, [4, 1, 1].
            band: filter of e to the pipe's band.

        Returns:
            e, [2, ny, nx]; on the ring of the determinant's zero, what one of two real numbers says of it.
        """
        before = estimate = torch.zeros_like(left)
        for _ in range(ROUNDS):
            ahead = estimate + _LINEAR_MOMENTUM * (estimate - before)
            along = self.seen(ahead) * arms
            beyond = left - torch.stack([along[0] + along[1], along[2] + along[3]])
            pull = torch.cat([beyond[:1], beyond[:1], beyond[1:], beyond[1:]]) * arms
            before, estimate = estimate, ahead + band(_LINEAR_STEP * self.gathered(pull))
        return estimate


def _likely(light: Tensor, brightness: Tensor) -> Tensor:
    """Light [4, ny, nx] of both cameras, moved towards a measured brightness [2, ny, nx].

    The length r, rho before, makes (r - rho)^2 / 2 + weight (r^2 - brightness log r^2) least; the second is the
    negative logarithm of photons' likelihood.
    """
    square = light * light
    length = torch.sqrt(torch.stack([square[0] + square[1], square[2] + square[3]]) + _DARK)
    stiff = 1 + 2 * _WEIGHT
    wanted = (length + torch.sqrt(length * length + 8 * _WEIGHT * stiff * brightness)) / (2 * stiff)
    in_phase, quadrature = wanted / length
    return torch.cat([light[:2] * in_phase, light[2:] * quadrature])


def _quarter_turn(light: Tensor) -> Tensor:
    """Light [2, ny, nx] times i."""
    return torch.stack([-light[1], light[0]])
