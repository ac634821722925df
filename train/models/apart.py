"""Fields of two cameras that see one field from two places on the axis or from one, and the field that fits both.

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
from torch.nn import functional

from lightpage.train.models.filters import BLOCK, block_weights

ROUNDS = 14
WEIGHT = 0.75
"""Weight of the likelihood against staying: a larger one takes fewer rounds and, in dim light, lets more noise in."""
STIFF = 1 + 2 * WEIGHT
RELAXATION = 1.4
"""Factor on a round's step; below 2."""
_DARK = 1e-9
_LINEAR_ROUNDS = 30
_LINEAR_STEP = 0.7
"""Linear equations have curvatures up to 2; the step times that must stay below 1.5 with this momentum."""
_LINEAR_MOMENTUM = 0.5

Filter = Callable[[Tensor], Tensor]


class CamerasApart(NamedTuple):
    """The defocus of the in-phase camera against the mean of both; the quadrature camera's is its conjugate.

    Attributes:
        there: filters of either axis, real and imaginary part of what in-phase and of what quadrature sees,
            [4 BLOCK, 2, taps], see `block_weights`.
        back: their adjoint, along the first axis, [4 BLOCK, 2, taps].
        added: the adjoint along the other one, where both cameras' light is added up, [2 BLOCK, 4, taps].
    """

    there: Tensor
    back: Tensor
    added: Tensor

    @classmethod
    def of(cls, taps: Tensor) -> Self:
        """The cameras of a kernel's real and imaginary part, [2, taps]."""
        real, imaginary = block_weights(taps[0]), block_weights(taps[1])
        forth = [torch.stack([real, -imaginary], 1), torch.stack([imaginary, real], 1)]
        adjoint = [torch.stack([real, imaginary], 1), torch.stack([-imaginary, real], 1)]
        added = [torch.cat(pair, 1) for pair in zip(adjoint, forth, strict=True)]
        return cls(torch.cat(forth + adjoint), torch.cat(adjoint + forth), torch.cat(added))

    def seen(self, field: Tensor) -> Tensor:
        """Return the fields that the cameras see of a field [2, ny, nx]: in-phase, then quadrature, [4, ny, nx]."""
        ny, nx = field.shape[1:]
        return _along_columns(_along_rows(_in_blocks(field), self.there), self.there)[:, :ny, :nx]

    def gathered(self, both: Tensor) -> Tensor:
        """The adjoint of `seen`: [4, ny, nx] to [2, ny, nx]."""
        ny, nx = both.shape[1:]
        return _along_rows(_along_columns(_in_blocks(both), self.back), self.added)[:, :ny, :nx]


class CamerasTilted(NamedTuple):
    """Cameras whose defocus also changes over the page, as that of tilted ones does.

    A quadratic through three kernels of constant defocus stands for it. At a tilt of 0.4 radian along one axis it is
    right to 0.004, root mean square, along both to 0.026. As nearly is it unitary, as `reflected` takes it to be.

    Attributes:
        nodes: cameras in the middle of the page, and where the in-phase one is least and most defocused.
        weights: shares of these at each place, [3, ny, nx] of the grid in whole blocks.
    """

    nodes: tuple[CamerasApart, CamerasApart, CamerasApart]
    weights: Tensor

    @classmethod
    def of(cls, taps: Tensor, beside: Tensor, along: Tensor) -> Self:
        """The cameras of kernels.

        Args:
            taps: real and imaginary part in the middle, [2, taps].
            beside: the same where the defocus is least and most, [2, 2, taps].
            along: places from the least to the most, -1 to 1, of the grid's samples, [ny, nx].
        """
        along = _in_blocks(along[None])[0]
        weights = torch.stack([1 - along * along, along * (along - 1) / 2, along * (along + 1) / 2])
        return cls((CamerasApart.of(taps), CamerasApart.of(beside[0]), CamerasApart.of(beside[1])), weights)

    def seen(self, field: Tensor) -> Tensor:
        """See `CamerasApart`."""
        ny, nx = field.shape[1:]
        shares = self.weights[:, :ny, :nx].unbind()
        parts = [node.seen(field) * share for node, share in zip(self.nodes, shares, strict=True)]
        return parts[0] + parts[1] + parts[2]

    def gathered(self, both: Tensor) -> Tensor:
        """See `CamerasApart`."""
        ny, nx = both.shape[1:]
        shares = self.weights[:, :ny, :nx].unbind()
        parts = [node.gathered(both * share) for node, share in zip(self.nodes, shares, strict=True)]
        return parts[0] + parts[1] + parts[2]


class CamerasTogether:
    """Cameras that see the same plane."""

    def seen(self, field: Tensor) -> Tensor:
        """See `CamerasApart`."""
        return torch.cat([field, field])

    def gathered(self, both: Tensor) -> Tensor:
        """See `CamerasApart`."""
        return both[:2] + both[2:]


Cameras = CamerasApart | CamerasTilted
"""Cameras that do not see the same plane."""


def recovered_linearly(
    cameras: Cameras, left: Tensor, arms: Tensor, amplitude: Tensor, inverse_amplitude: Tensor, band: Filter
) -> Tensor:
    """The field where |e|^2 is taken off both equations: descent from none.

    Args:
        left: sides of the equations, [2, ny, nx].
        cameras, arms, amplitude, inverse_amplitude, band: see `reflected`.

    Returns:
        e, [2, ny, nx]; on the ring of the determinant's zero, what one of two real numbers says of it.
    """
    before = estimate = torch.zeros_like(left)
    for _ in range(_LINEAR_ROUNDS):
        ahead = estimate + _LINEAR_MOMENTUM * (estimate - before)
        beyond = left - _by_camera(cameras.seen(ahead) * inverse_amplitude * arms)
        pull = cameras.gathered(_for_both_parts(beyond) * amplitude * arms)
        before, estimate = estimate, ahead + band(_LINEAR_STEP * pull)
    return estimate * inverse_amplitude


def reflected(
    cameras: Cameras | CamerasTogether,
    rounds: int,
    start: Tensor,
    brightness: Tensor,
    arms: Tensor,
    amplitude: Tensor,
    inverse_amplitude: Tensor,
    band: Filter,
) -> Tensor:
    """The field that both cameras have seen.

    Args:
        cameras: map of a field to what each camera sees.
        rounds: number of averaged reflections.
        start: estimate of e, [2, ny, nx].
        brightness: measured |1 + D e|^2 and |arm + D* e|^2, [2, ny, nx].
        arms: phasors of both cameras, [4, 1, 1].
        amplitude, inverse_amplitude: factors from e to E, which defocus and band are about, and back, [ny, nx].
        band: filter of E to the pipe's band.

    Returns:
        e, [2, ny, nx].
    """
    pulling = 8 * WEIGHT * STIFF * torch.clamp(brightness, min=0)
    half = amplitude / 2
    of_arms = cameras.gathered(arms * half)
    field = start * amplitude
    state = light = cameras.seen(field) * inverse_amplitude + arms
    for number in range(rounds):
        if number:
            light = cameras.seen(field) * inverse_amplitude + arms
        state = state + RELAXATION * (_likely(2 * light - state, pulling) - light)
        field = band(cameras.gathered(state * half) - of_arms)
    return field * inverse_amplitude


def _likely(light: Tensor, pulling: Tensor) -> Tensor:
    """Light [4, ny, nx] of both cameras, moved towards a measured brightness.

    The length r, rho before, makes (r - rho)^2 / 2 + weight (r^2 - brightness log r^2) least; the second is the
    negative logarithm of photons' likelihood. It is the larger root of stiff r^2 - rho r - 2 weight brightness.

    Args:
        light: real and imaginary parts.
        pulling: 8 weight stiff times the brightness, [2, ny, nx].
    """
    longer = 1 + torch.sqrt(1 + pulling / (_by_camera(light * light) + _DARK))
    return light * _for_both_parts(longer / (2 * STIFF))


def _by_camera(parts: Tensor) -> Tensor:
    """Sums over real and imaginary part, [4, ny, nx] to [2, ny, nx]."""
    return torch.stack([parts[0] + parts[1], parts[2] + parts[3]])


def _for_both_parts(values: Tensor) -> Tensor:
    """The values of either camera twice, [2, ny, nx] to [4, ny, nx]."""
    return torch.stack([values[0], values[0], values[1], values[1]])


def _in_blocks(images: Tensor) -> Tensor:
    """Images [C, ny, nx] of whole blocks, zeros at the right and below where there are none."""
    ny, nx = images.shape[1:]
    return functional.pad(images, (0, -nx % BLOCK, 0, -ny % BLOCK)) if ny % BLOCK or nx % BLOCK else images


def _along_rows(images: Tensor, weights: Tensor) -> Tensor:
    """Rows of images [C, ny, nx] of whole blocks, filtered, by the groups of channels that the weights are for."""
    reach, groups = (weights.shape[2] - BLOCK) // 2, len(images) // weights.shape[1]
    split = functional.conv2d(images, weights[:, :, None, :], stride=(1, BLOCK), padding=(0, reach), groups=groups)
    ny, nx = images.shape[1:]
    return split.reshape(-1, BLOCK, ny, nx // BLOCK).permute(0, 2, 3, 1).reshape(-1, ny, nx)


def _along_columns(images: Tensor, weights: Tensor) -> Tensor:
    """Filter blocks of columns, as `_along_rows` filters rows."""
    reach, groups = (weights.shape[2] - BLOCK) // 2, len(images) // weights.shape[1]
    split = functional.conv2d(images, weights[:, :, :, None], stride=(BLOCK, 1), padding=(reach, 0), groups=groups)
    ny, nx = images.shape[1:]
    return split.reshape(-1, BLOCK, ny // BLOCK, nx).permute(0, 2, 1, 3).reshape(-1, ny, nx)
