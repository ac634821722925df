"""Validation of a network on held-out pages while it is trained."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lightpage.metrics.information import achievable_rate, decide
from lightpage.page.crosstalk import of_decoded_neighbours
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots, estimate_piston
from lightpage.train.models.parts import turned


def held_out_air(p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_], levels: Levels) -> float:
    """AIR in bits per data symbol of decoded pages.

    Args:
        p: [pages, 2, ny, nx].
        phases: true phases [pages, ny, nx].
        mask: pilots, bool [ny, nx].
        levels: levels of the pages.
    """
    rates = []
    for page, truth in zip(p, phases, strict=True):
        px, py = without_piston(page, truth, mask, levels)[:, ~mask]
        air = achievable_rate(np.arctan2(py, px), np.hypot(px, py), decide(truth[~mask], levels), levels)
        rates.append(float(np.mean(air)))
    return float(np.mean(rates))


def without_piston(
    p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_], levels: int | Levels
) -> NDArray[np.float32]:
    """p [2, ny, nx] of a page, turned by what its pilots show of the piston and by crosstalk, as the runtime does it.

    Args:
        p: decoded.
        phases: true phases [ny, nx].
        mask: pilots, bool [ny, nx].
        levels: levels of the page.
    """
    piston = estimate_piston(p, Pilots(mask, phases[mask].astype(np.float64))).angle_rad
    still = np.asarray(turned(torch.tensor(p), -piston).numpy(), dtype=np.float32)
    beside = of_decoded_neighbours(still, Levels.of(levels).crosstalk)
    return np.asarray(turned(torch.tensor(still), torch.tensor(-beside)).numpy(), dtype=np.float32)
