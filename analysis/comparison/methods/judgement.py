"""The figures of a trained method on the held-out pages of a bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from analysis.comparison.decoders_figure import MAP
from analysis.comparison.methods.bench import Bench
from analysis.comparison.outcome import Outcome, gained_at_the_end, symbols_by_walls
from lightpage.metrics.information import achievable_rate, own_information, page_kilobytes
from lightpage.metrics.measures import measure
from lightpage.train.data.pages import Page
from lightpage.train.fitting.concentration_scale import best_kappa_scale, decode_pages
from lightpage.train.fitting.fitted import Fitted
from lightpage.train.fitting.modules import DecoderTraining
from lightpage.train.fitting.validation import without_piston


def decoded(bench: Bench, module: DecoderTraining[Any], pages: Dataset[Page], scale: float) -> NDArray[np.float32]:
    """p of all data symbols of pages, piston and crosstalk off, and calibrated, [2, symbols]."""
    found = zip(*decode_pages(module, pages), strict=True)
    still = [without_piston(p * scale, truth, bench.mask, module.levels) for p, truth in found]
    return np.concatenate([p[:, ~bench.mask] for p in still], axis=1)


def judged(
    bench: Bench,
    name: str,
    size: str,
    steps: int,
    folder: Path,
    trained: Fitted[Any],
    validation: Dataset[Page],
    unseen: Dataset[Page],
    preparing: float,
    drawn: float,
) -> Outcome:
    """Figures of the held-out pages, kappa calibrated on the validation pages."""
    module: DecoderTraining[Any] = trained.module
    levels = module.levels
    scale = best_kappa_scale(module, validation, bench.mask)
    px, py = decoded(bench, module, unseen, scale)
    truth = [bench.recording.symbols(page) for page in bench.unseen]
    symbols = np.concatenate([page[~bench.mask] for page in truth if page is not None])
    figures = measure(np.arctan2(py, px), np.hypot(px, py), symbols, levels)
    by_symbol = np.full(bench.profile.page_shape, np.nan)
    rates = achievable_rate(np.arctan2(py, px), np.hypot(px, py), symbols, levels)
    by_symbol[~bench.mask] = rates.reshape(len(truth), -1).mean(axis=0)
    np.save(folder / MAP, by_symbol)
    zones = symbols_by_walls(bench.profile, bench.fitted)
    groups = {name: by_symbol[~bench.mask & there] for name, there in zones.items()}
    validated = trained.curves.get("val_air", [])
    data = int((~bench.mask).sum())
    return Outcome(
        kappa_scale=scale,
        validation_curve=validated,
        training_curve=trained.curves.get("train_air", []),
        run=str(folder.relative_to(bench.out.parent)),
        method=name,
        size=size,
        steps=steps,
        air=figures.air_bits_per_symbol,
        own_mi=figures.own_mi_bits_per_symbol,
        symbol_error_rate=figures.symbol_error_rate,
        own_mi_unscaled=float(own_information(np.arctan2(py, px), np.hypot(px, py) / scale, levels).mean()),
        page_kB=page_kilobytes(figures.air_bits_per_symbol, data),
        own_mi_kB=page_kilobytes(figures.own_mi_bits_per_symbol, data),
        by_walls={name: float(air.mean()) if air.size else float("nan") for name, air in groups.items()},
        validation_air=trained.validation_air,
        gained_in_last_fifth=gained_at_the_end(validated, steps),
        preparing_seconds=preparing,
        training_seconds=trained.seconds,
        pages_per_second=drawn / trained.seconds,
    )
