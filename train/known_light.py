"""What known pages show, against what the fitted waves say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from optics.grid import symbol_samples
from optics.profile import Profile
from optics.registration.calibrate import KnownPage
from optics.registration.fitted_waves import FittedWaves, illumination_terms, on_modulator
from train.features import FeatureExtractor
from train.field import Measured

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]


@dataclass(frozen=True)
class KnownLight:
    """A known page as it was measured, its image shift taken off.

    Attributes:
        phases: what was written, radians [ny, nx].
        measured: both equations of the field.
        field: that solves them, complex [Gy, Gx].
    """

    phases: Real
    measured: Measured
    field: Complex

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Where both cameras look at the common grid, bool [Gy, Gx]."""
        return self.measured.lit.numpy().astype(bool)


def known_light(extractor: FeatureExtractor, pages: Sequence[KnownPage]) -> list[KnownLight]:
    """Known pages as the calibrated device measured them."""
    found = []
    for page in pages:
        phases = np.angle(page.symbols)
        state = extractor.state(extractor.field(page.pair), phases, np.zeros(2))
        with torch.no_grad():
            measured, field = extractor.look(page.pair, state.shift_px)
        found.append(KnownLight(phases, measured, field[0].numpy() + 1j * field[1].numpy()))
    return found


@dataclass(frozen=True)
class Illuminated:
    """The light of a known page as the fitted waves explain it.

    Attributes:
        factors: of `illumination_terms`, over the first, complex [6].
        expected: complex [Gy, Gx], of the measured field's strength and piston.
    """

    factors: Complex
    expected: Complex


def illuminated(profile: Profile, parameters: Real, pages: Sequence[KnownLight]) -> list[Illuminated]:
    """The illumination under which the fitted waves show most of each known page's light, by least squares.

    Args:
        profile: the nominal device.
        parameters: [P] fitted.
        pages: as that device measured them.
    """
    samples = symbol_samples(profile)
    waves = FittedWaves(profile, parameters, samples, filled=True)
    return [_illuminated(waves, samples, light) for light in pages]


def _illuminated(waves: FittedWaves, samples: int, light: KnownLight) -> Illuminated:
    page = on_modulator(light.phases, samples)
    terms = illumination_terms(waves.x, waves.y)
    shown = np.stack([waves.to_camera(page * term) for term in terms], axis=-1)
    factors = np.linalg.lstsq(shown[light.seen], light.field[light.seen], rcond=None)[0]
    return Illuminated(factors / factors[0], shown @ factors)
