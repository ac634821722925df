"""Synthetic pages of a calibrated device: its fitted wave model, where it stands and where it may drift to.

A network that has seen a single geometry carries part of its skill to no other. The fitted wave model shows it the same
device as it may drift, with the illumination and the noise that recorded pages have over the model.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.sampling_table import sampling_table
from lightpage.calibration.waves.wave_model import FittedWaves, illumination_terms, on_modulator
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.train.data.features import PageFeatures, PageState, demodulate, localized
from lightpage.train.data.known_light import Explained
from lightpage.train.models.localizers.coherent import CoherentLocalizer
from lightpage.train.models.localizers.wave import WaveLocalizer
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import FieldGrid, field_grid, symbol_samples

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

PAGES_PER_STATE = 4
"""Pages of each drifted state: the waves and the sampling table are set up once a state."""
_LARGE = 20_000
"""Symbols of a page from which each page has a state of its own."""
MOST_NOISE = 0.3
"""Unexplained power over the light's above which synthetic light teaches nothing of the device."""
_DRIFT = {
    "pipe_angle_rad": np.deg2rad(0.06),
    "focal_length_relative": 6e-4,
    "pipe_length_relative": 3e-4,
    "pipe_width_relative": 1e-5,
    "page_centre_x_m": 5e-6,
    "page_centre_y_m": 5e-6,
    "pipe_roll_rad": np.deg2rad(0.02),
    "pipe_centre_x_m": 0.5e-6,
    "pipe_centre_y_m": 0.5e-6,
    "launch_defocus_rad": 0.3,
    "launch_astigmatism_0_rad": 0.1,
    "launch_astigmatism_45_rad": 0.1,
    "launch_coma_x_rad": 0.1,
    "launch_coma_y_rad": 0.1,
    "camera_tilt_x_rad": 0.5,
    "camera_tilt_y_rad": 0.5,
    "camera_curvature_rad": 0.3,
}
"""Most that a device is expected to drift between two trainings, either way: of pipe angle and focal length twice what
the demonstration lets it drift. The cameras' poses are left out: registration takes them off before the network sees
anything."""


@dataclass(frozen=True)
class ModelMatch:
    """Discrepancy between recorded pages and the fitted geometry.

    Attributes:
        illumination: complex factor on the modulator as a quadratic in the page's coordinates (-1 to 1), [6].
        noise: power of what is left unexplained over the field's power.
        seen: mask of the common grid's samples that both cameras see, bool [Gy, Gx].
    """

    illumination: Complex
    noise: float
    seen: NDArray[np.bool_]


def model_match(known: Sequence[Explained]) -> ModelMatch:
    """Return the discrepancy between known pages and the fitted wave model, as means over the pages."""
    left = [
        np.mean(np.abs(light.field - light.expected)[light.seen] ** 2) / np.mean(np.abs(light.field[light.seen]) ** 2)
        for light in known
    ]
    seen = np.all([light.seen for light in known], axis=0)
    return ModelMatch(np.mean([light.illumination for light in known], axis=0), float(np.mean(left)), seen)


class SyntheticPages:
    """Features of pages that the fitted device would show after drifts of its own.

    Args:
        device: device as it was calibrated.
        like: discrepancy between recorded pages and that geometry.
        localizer: the coherent one; None for that by waves.
        seed: seed of drifts, symbols and noise.
        grid: the common grid, where it is not the usual one.
    """

    def __init__(
        self,
        device: CalibratedDevice,
        like: ModelMatch,
        localizer: CoherentLocalizer | None,
        seed: int,
        grid: FieldGrid | None = None,
    ) -> None:
        profile = device.profile
        self._device, self._like, self._seed = device, like, seed
        self._twin, self._grid = TorchTwin(RayTwin(profile)), grid or field_grid(profile)
        self._per_state = PAGES_PER_STATE if np.prod(profile.page_shape) < _LARGE else 1
        self._coherent = localizer

    def pages(self, first: int = 0) -> Iterator[PageFeatures]:
        """Features of page `first` and all after it, without end; the same pages from wherever it starts."""
        state = first // self._per_state
        skipped = first % self._per_state
        while True:
            yield from itertools.islice(self._state(state), skipped, None)
            state, skipped = state + 1, 0

    def _state(self, number: int) -> Iterator[PageFeatures]:
        """All pages of one drifted state."""
        profile = self._device.profile
        rng = np.random.default_rng([self._seed, number])
        drift = np.array([_DRIFT.get(name, 0.0) for name in NAMES]) * rng.uniform(-1, 1, len(NAMES))
        parameters = self._device.parameters + drift
        waves = FittedWaves(profile, parameters, symbol_samples(profile), filled=True, grid=self._grid)
        waves_back = WaveLocalizer(profile, parameters, self._grid) if self._coherent is None else None
        table = sampling_table(self._twin, parameters, np.pi / 2, profile)
        light_on = np.tensordot(self._like.illumination, np.stack(illumination_terms(waves.x, waves.y)), 1)
        for symbols in random_symbols(profile, MAX_LEVELS, self._per_state, rng):
            nominal, modulation = symbol_phases(symbols, MAX_LEVELS), self._device.modulation
            field = waves.to_camera(on_modulator(modulation.page_light(nominal), symbol_samples(profile)) * light_on)
            field = (self._like.seen * (field + self._noise(field, rng))).astype(np.complex64)
            if waves_back is not None:
                light = localized(waves_back, field)
            else:
                assert self._coherent is not None
                light = demodulate(self._coherent, field, table)
            written, still = modulation.phase(nominal).astype(np.float32), PageState((0.0, 0.0), 0.0)
            yield PageFeatures(light.astype(np.float16), table["positions"], written, still)

    def _noise(self, field: Complex, rng: np.random.Generator) -> Complex:
        """White noise in the pipe's band with the power that the model leaves unexplained."""
        band = self._grid.band
        white = rng.standard_normal((2, *field.shape))
        noise = signal.oaconvolve(white, band[None, :, None], mode="same", axes=1)
        noise = signal.oaconvolve(noise, band[None, None, :], mode="same", axes=2)
        level = np.sqrt(
            self._like.noise * np.mean(np.abs(field[self._like.seen]) ** 2) / np.sum(np.mean(noise**2, axis=(1, 2)))
        )
        return np.asarray(level * (noise[0] + 1j * noise[1]))
