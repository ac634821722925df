"""Statistics of the cameras' counts as look-up tables over the square root of the expected count."""

from __future__ import annotations

import torch
from torch import Tensor

from lightpage.calibration.likelihood.counts import KNOTS


def looked_up(table: Tensor, root: Tensor) -> Tensor:
    """Values of a table [KNOTS] at the nearest of its places, 0 to KNOTS - 1, [ny, nx]; the last one beyond."""
    place = torch.clamp(root + 0.5, max=KNOTS - 0.5).to(torch.int64)
    return table.index_select(0, place.flatten()).reshape(root.shape)


def score_of_counts(expected: Tensor, counts: Tensor, scale: Tensor, weights: Tensor) -> Tensor:
    """Derivative of the log-likelihood by the expected counts of one camera, [ny, nx].

    Args:
        expected: counts that the light would give a perfect camera, [ny, nx].
        counts: counts that were measured.
        scale: places of the tables for a root of one, [].
        weights: see `lightpage.calibration.likelihood.counts.CountStatistics.weights`, [4, KNOTS].
    """
    root = scale * torch.sqrt(expected)
    return counts * looked_up(weights[0], root) - looked_up(weights[1], root)
