"""Figures of a study's published decoder on held-out pages: rates, claimed rates and errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lightpage.codec.choose import FEWEST_PAGES, DrawnPage, choose
from lightpage.errors import InvalidInputError
from lightpage.metrics.information import achievable_rate, decide
from lightpage.metrics.measures import measure, symbol_maps
from lightpage.metrics.reliability import expected_calibration_error
from lightpage.page.levels import MAX_LEVELS, Levels
from lightpage.page.symbols import symbol_phases
from lightpage.train.data.features import PageState
from lightpage.train.fitting.concentration_scale import decode_pages, most_likely_factor
from lightpage.train.fitting.validation import without_piston
from lightpage.train.models.parts import turned
from lightpage.train.published.held_pages import HeldPages
from lightpage.train.published.training import PublishedTraining, nearest_class, rate_of_classes


def estimates(
    module: PublishedTraining, pages: HeldPages, mask: NDArray[np.bool_], knows_piston: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """p [2, pages, N] of the data symbols, the piston taken off, and their true phases [pages, N].

    What classes learn of a piston is the class that is nearest to it.
    """
    classes = module.choices.classes

    def still(p: NDArray[np.float32], phases: NDArray[np.float32], state: PageState) -> NDArray[np.float32]:
        if knows_piston:
            known = np.array(state.piston_rad)
            piston = float(decide(known, classes)) * 2 * np.pi / classes if classes else state.piston_rad
            return np.asarray(turned(torch.from_numpy(p), -piston).numpy())
        return without_piston(p, phases, mask, module.levels)

    decoded = decode_pages(module, pages)
    p = [still(*page)[:, ~mask] for page in zip(*decoded, pages.states, strict=True)]
    return np.stack(p, axis=1), decoded[1][:, ~mask]


def figures_of_p(
    p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_], levels: int
) -> dict[str, Any]:
    """Return AIR, claimed rate and error of von Mises estimates [2, pages, N], means over pages; their ECE."""
    mu, kappa = np.arctan2(p[1], p[0]), np.hypot(p[0], p[1])
    symbols = decide(phases, levels)
    maps = symbol_maps(mu, kappa, symbols, levels, ~mask)
    figures = measure(mu, kappa, symbols, levels)
    return {"air_map": maps.air, "own_mi_map": maps.own_mi, "error_map": maps.error_rad, "ece": figures.ece}


def user_bytes(p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """User bytes of a page by the code that carries most of what is read, `lightpage code`'s choice.

    Args:
        p: calibrated estimates of the data symbols, [2, pages, N].
        phases: true ones, [pages, N].
        mask: pilots, bool [ny, nx].

    Returns:
        0 where no code carries them; not a number where the pages are too few to say.
    """
    errors, kappa = np.arctan2(p[1], p[0]).astype(float) - phases, np.hypot(p[0], p[1]).astype(float)
    if len(errors) < FEWEST_PAGES:
        return float("nan")

    def draw(levels: int, rng: np.random.Generator) -> list[DrawnPage]:
        pages = []
        for error, concentration in zip(errors, kappa, strict=True):
            symbols = rng.integers(0, levels, error.shape).astype(np.uint8)
            phase = np.angle(np.exp(1j * (symbol_phases(symbols, levels) + error)))
            pages.append(DrawnPage(phase, concentration, symbols, Levels.of(levels)))
        return pages

    air = float(achievable_rate(errors, kappa, np.zeros(errors.shape, np.int64), MAX_LEVELS).mean())
    try:
        return float(choose(draw, air, mask)[0].user_bytes)
    except InvalidInputError:
        return 0.0


def figures_of_classes(
    module: PublishedTraining, validation: HeldPages, unseen: HeldPages, mask: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the figures of posteriors over classes, as `figures_of_p` names them, without phase errors.

    The validation pages choose their temperature.
    """
    classes, data = module.choices.classes, torch.from_numpy(~mask)
    known = list(_scored(module, validation, data))

    scale = most_likely_factor(
        lambda factor: float(sum(functional.cross_entropy(factor * scores.T, symbols) for scores, symbols in known))
    )
    rates, claims, confidences, right = [], [], [], []
    for page, truth in _scored(module, unseen, data):
        log = torch.log_softmax(page.double() * scale, dim=0)
        rates.append(rate_of_classes(-log.gather(0, truth[None])[0], classes).numpy())
        claims.append(rate_of_classes(-(log.exp() * log).sum(0), classes).numpy())
        confidence, decided = log.exp().max(0)
        confidences.append(confidence.numpy())
        right.append((decided == truth).numpy())
    return {
        "air_map": _over_pages(rates, mask),
        "own_mi_map": _over_pages(claims, mask),
        "ece": expected_calibration_error(np.concatenate(confidences), np.concatenate(right)),
    }


def _scored(module: PublishedTraining, pages: HeldPages, data: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Scores [classes, N] and true classes [N] of the data symbols of each page."""
    with torch.no_grad():
        for frames, state, phases in (pages[index] for index in range(len(pages))):
            scores = module.network.scores(frames[None], state[None, :2])[0].float().cpu()
            yield scores[:, data], nearest_class(phases + state[2], module.choices.classes).cpu()[data]


def _over_pages(values: Sequence[NDArray[np.floating]], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Means over pages of what data symbols have, [ny, nx], NaN at pilots."""
    over = np.full(mask.shape, np.nan, dtype=np.float32)
    over[~mask] = np.mean(values, axis=0)
    return over
