"""The factor on a decoder's concentrations under which held-out pages are most likely."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize
from torch.utils.data import DataLoader, Dataset

from lightpage.progress import warn
from lightpage.train.data.pages import Page
from lightpage.train.fitting.loss import von_mises_nll
from lightpage.train.fitting.modules import DecoderTraining
from lightpage.train.fitting.validation import without_piston

_SCALE_BOUNDS = (-3.0, 3.0)
"""Bounds of the logarithm of a factor that calibrates concentrations: hardly trained decoders were off by five."""

_AT_A_BOUND = 1e-3


def decode_pages(module: DecoderTraining[Any], pages: Dataset[Page]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Decode pages with a trained module, where it is: p [pages, 2, ny, nx] and the true phases [pages, ny, nx]."""
    outputs, truths = [], []
    with torch.no_grad():
        for *page, phases in DataLoader(pages, batch_size=None):
            outputs.append(module(*(part[None].to(module.device) for part in page))[0].float().cpu().numpy())
            truths.append(phases.cpu().numpy())
    return np.stack(outputs), np.stack(truths)


def best_kappa_scale(module: DecoderTraining[Any], pages: Dataset[Page], mask: NDArray[np.bool_]) -> float:
    """Factor on p under which held-out pages are most likely: the network's claim, calibrated.

    Piston is taken off by the pilots first, as the runtime does it.
    """
    outputs, truths = [], []
    for p, truth in zip(*decode_pages(module, pages), strict=True):
        outputs.append(without_piston(p, truth, mask, module.levels)[:, ~mask])
        truths.append(truth[~mask])
    return calibrating_factor(np.concatenate(outputs, axis=1), np.concatenate(truths))


def calibrating_factor(p: NDArray[np.float32], phases: NDArray[np.float32]) -> float:
    """Factor on p [2, N] under which the true phases [N] are most likely."""
    shown, asked = torch.from_numpy(p)[None], torch.from_numpy(phases)[None]
    return most_likely_factor(lambda factor: float(von_mises_nll(shown * factor, asked).mean()))


def most_likely_factor(nll: Callable[[float], float]) -> float:
    """Factor under which the truth is most likely; says so where the search ends at a bound.

    Args:
        nll: negative log-likelihood of the truth, by factor.
    """
    found = optimize.minimize_scalar(lambda log: nll(math.exp(log)), bounds=_SCALE_BOUNDS, method="bounded")
    log_factor = float(found.x)
    if min(log_factor - _SCALE_BOUNDS[0], _SCALE_BOUNDS[1] - log_factor) < _AT_A_BOUND:
        what = f"concentrations would be calibrated still better beyond the factor {math.exp(log_factor):.3g}"
        warn(f"{what}, where the search ends: is the decoder trained?")
    return math.exp(log_factor)
