"""The von Mises likelihood of phases, as a loss that is convex in p and needs no angle, and the rate behind it."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lightpage.metrics.information import achievable_rate


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


def training_rate(p: Tensor, phases: Tensor, levels: int) -> float:
    """AIR in bits per symbol of levels that a piston may have turned, so that the true one lies at `phases`.

    Args:
        p: (px, py), [2, N].
        phases: true phases [N], radians.
        levels: M.
    """
    px, py = p.detach().float().cpu().numpy()
    error = np.arctan2(py, px) - phases.cpu().numpy()
    return float(achievable_rate(error, np.hypot(px, py), np.zeros(error.shape, np.uint8), levels).mean())
