"""The von Mises likelihood of phases, as a loss that is convex in p and needs no angle, and the rate behind it."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def von_mises_nll(p: Tensor, phases: Tensor) -> Tensor:
    """Negative log-likelihood in nats of each phase under concentration |p| about the angle of p.

    log 2 pi + log i0e(|p|) + |p| - p.(cos, sin), with i0e the exponentially scaled Bessel function.

    Args:
        p: (px, py), [N, 2, ...].
        phases: true phases [N, ...], radians.
    """
    p = p.float()
    concentration = torch.sqrt((p * p).sum(1) + 1e-8)
    along = p[:, 0] * torch.cos(phases) + p[:, 1] * torch.sin(phases)
    return math.log(2 * math.pi) + torch.log(torch.special.i0e(concentration)) + concentration - along


FEW_LEVELS = 64
"""Up to so many, a belief in phases may be narrower than a level; of more, the sum over levels is the integral."""


def training_rate(p: Tensor, phases: Tensor, levels: int) -> Tensor:
    """AIR in bits per symbol of levels that a piston may have turned, so that the true one lies at `phases`.

    log2 M less the mean of log2 sum_k exp(p.(e(phase + 2 pi k / M) - e(phase))), e the unit vector at an angle. Of more
    than `FEW_LEVELS` the sum is M I0(|p|), to exp(-M^2 / 2 |p|) of it.

    Args:
        p: (px, py), [2, N].
        phases: true phases [N], radians.
        levels: M.
    """
    p = p.detach().float()
    if levels > FEW_LEVELS:
        return math.log2(2 * math.pi) - von_mises_nll(p[None], phases[None]).mean() / math.log(2)
    cos, sin = torch.cos(phases), torch.sin(phases)
    along, across = p[0] * cos + p[1] * sin, p[1] * cos - p[0] * sin
    steps = torch.arange(levels, device=p.device)[:, None] * (2 * math.pi / levels)
    others = torch.logsumexp(along * torch.cos(steps) + across * torch.sin(steps), dim=0)
    return math.log2(levels) - (others - along).mean() / math.log(2)
