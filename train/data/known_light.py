"""Light of known pages, compared with the fitted waves' prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.waves.wave_model import FittedWaves, illumination_terms, on_modulator
from lightpage.progress import track
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.models.field import Measured
from lightpage.waves.grid import symbol_samples

ACCURACY = 3 / 8
"""Share of a simulation's splitting steps."""
_EQUATIONS = 100_000
"""Approximate number of samples of the common grid that say by which factors the illumination varies: six unknowns."""

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]


@dataclass(frozen=True)
class Explained:
    """A known page as it was measured, its image shift taken off, and as the fitted waves explain it.

    Attributes:
        measured: both equations of the field.
        field: field that solves them, complex [Gy, Gx].
        illumination: factors of `illumination_terms` over the first, complex [6], with which the waves explain most.
        expected: field that the waves predict then, complex [Gy, Gx], with the measured field's strength and piston.
    """

    measured: Measured
    field: Complex
    illumination: Complex
    expected: Complex

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Mask of the common grid's samples that both cameras see, bool [Gy, Gx]."""
        return self.measured.lit.numpy().astype(bool)


def explained(extractor: FeatureExtractor, pages: Sequence[KnownPage]) -> list[Explained]:
    """Known pages as the calibrated device measured them and its fitted waves explain them, by least squares.

    The waves are as exact as those of a decoder that makes another pass.

    Args:
        extractor: extractor of the device.
        pages: known pages of the device.
    """
    profile, parameters = extractor.device.profile, extractor.device.parameters
    modulation, samples = extractor.device.modulation, symbol_samples(profile)
    grid = extractor.grid
    waves = FittedWaves(profile, parameters, samples, filled=True, accuracy=ACCURACY, grid=grid)
    terms = np.stack(illumination_terms(waves.x, waves.y))
    stride = max(1, int(np.sqrt(np.prod(grid.shape) / _EQUATIONS)))
    at_few = FittedWaves(profile, parameters, samples, filled=True, stride=stride, accuracy=ACCURACY, grid=grid)
    found = []
    for page in track(pages, "light of known pages"):
        nominal = np.angle(page.symbols)
        state = extractor.state(extractor.field(page.pair), modulation.phase(nominal), np.zeros(2))
        with torch.no_grad():
            measured, solved = extractor.measure(page.pair, state.shift_px)
        field, seen = solved[0].numpy() + 1j * solved[1].numpy(), measured.lit.numpy().astype(bool)
        written = on_modulator(modulation.page_light(nominal), samples)
        few = seen[::stride, ::stride]
        shown = np.stack([at_few.to_camera(written * term)[few] for term in terms], axis=-1)
        factors = np.linalg.lstsq(shown, field[::stride, ::stride][few], rcond=None)[0]
        expected = waves.to_camera(written * np.tensordot(factors, terms, 1))
        found.append(Explained(measured, field, factors / factors[0], expected))
    return found
