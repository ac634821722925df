"""Tensors of a device that maximum likelihood needs in addition to its sampling table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.likelihood.counts import CountStatistics
from lightpage.calibration.parameters import as_dict
from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions, fitted_geometry
from lightpage.device.profile import Profile
from lightpage.page.modulation import Modulation
from lightpage.page.pilots import Pilots
from lightpage.waves.grid import symbol_samples
from lightpage.waves.lens import entrance_window

Real = NDArray[np.float64]

HARMONICS = 6
"""Order of the Fourier series of the amplitude over the phase of light."""
_PHASES = 512
"""Phases at which the modulator's light is sampled."""
POINT_SPREAD_REACH = 6
"""Largest distance, in samples of the modulator, of the point spread of forward and adjoint waves."""
_FACET_SAMPLES = 257
"""Samples along an axis of the entrance facet."""
KNOWN_CONCENTRATION = 1e6
"""Concentration of a known phase."""
PIXEL_GAINS = "pixel_gains"
"""Name of the gains of a camera with blemishes, see `lightpage.recording.pixels.blemishes.Blemishes`."""
FLAT_FIELD = "flat_field"
"""Name of the mean phase error of each symbol, radians [ny, nx]. It is a part of the launched light."""
MEASUREMENT_INPUTS = ("reference_in_phase", "reference_quadrature", "registration", "homodyne", *APART, PIXEL_GAINS)
"""Names of the tensors that the measurements of a page on the common grid depend on."""
PILOT_PHASORS = "pilot_phasors"
PILOT_MASK = "pilot_mask"
"""Names of the tensors that may be fed with each page, since pilots depend on the number of levels."""


def launch_tensors(
    profile: Profile, parameters: Real, conditions: LaunchConditions, modulation: Modulation
) -> SamplingTable:
    """Compute the tensors of the launched light.

    Args:
        profile: nominal device.
        parameters: fitted parameters, [P].
        conditions: illumination and blur of a known page.
        modulation: light of the modulator at its levels.

    Returns:
        blur []; illumination [2, 6], without its phase; amplitude_series [13] and slope_power [], see
        `lightpage.train.models.likelihood.modulator`; point_spread [7].
    """
    coefficients = conditions.illumination * np.exp(-1j * np.angle(conditions.illumination[0]))
    return {
        "blur": np.array(conditions.blur, np.float32),
        "illumination": np.stack([coefficients.real, coefficients.imag]).astype(np.float32),
        **amplitude_tensors(modulation),
        "point_spread": point_spread(profile, parameters, conditions.blur),
    }


def amplitude_tensors(modulation: Modulation) -> SamplingTable:
    """Tensors `amplitude_series` and `slope_power` of a modulation, see `launch_tensors`."""
    series = amplitude_series(modulation)
    return {"amplitude_series": series, "slope_power": slope_power(series, modulation)}


def point_spread(profile: Profile, parameters: Real, blur: float) -> NDArray[np.float32]:
    """Compute the point spread of forward and adjoint waves together, along one axis of the modulator.

    The pipe loses no light. So this is the point spread of the entrance facet's window alone.

    Args:
        profile, parameters, blur: see `launch_tensors`.

    Returns:
        Light at distances of 0 to 6 samples over that at 0, [1 + POINT_SPREAD_REACH].
    """
    geometry = fitted_geometry(profile, as_dict(parameters))
    pitch = profile.symbol_pitch_m / symbol_samples(profile)
    facet = np.linspace(-0.5, 0.5, _FACET_SAMPLES) * geometry.pipe_width_m
    transmission = entrance_window(geometry, facet, np.zeros(1), pitch, blur * profile.slm.pitch_m**2)[0] ** 2
    cycles = facet * pitch / (geometry.wavelength_m * geometry.focal_length_m)
    spread = np.cos(2 * np.pi * np.arange(1 + POINT_SPREAD_REACH)[:, None] * cycles) @ transmission
    return np.asarray(spread / spread[0], np.float32)


def slope_power(series: NDArray[np.float32], modulation: Modulation) -> NDArray[np.float32]:
    """Mean square of the derivative of the light by its phase, over all levels, []."""
    phase = np.angle(modulation.light(2 * np.pi * (np.arange(_PHASES) + 0.5) / _PHASES))
    numbers = np.arange(1, HARMONICS + 1)
    cosine = np.cos(numbers * phase[:, None])
    sine = np.sin(numbers * phase[:, None])
    amplitude = np.exp(series[0] + cosine @ series[1::2] + sine @ series[2::2])
    slope = (numbers * cosine) @ series[2::2] - (numbers * sine) @ series[1::2]
    return np.array(np.mean(amplitude**2 * (1 + slope**2)), np.float32)


def amplitude_series(modulation: Modulation) -> NDArray[np.float32]:
    """Fourier series of the logarithm of the amplitude over the phase of the light, [1 + 2 HARMONICS]."""
    light = modulation.light(2 * np.pi * (np.arange(_PHASES) + 0.5) / _PHASES)
    phase = np.angle(light)
    harmonics = [function(number * phase) for number in range(1, HARMONICS + 1) for function in (np.cos, np.sin)]
    terms = np.stack([np.ones(_PHASES), *harmonics], axis=1)
    return np.asarray(np.linalg.lstsq(terms, np.log(np.abs(light)), rcond=None)[0], np.float32)


def count_tensors(statistics: tuple[CountStatistics, CountStatistics], correlation: float) -> SamplingTable:
    """Look-up tables of both cameras' counts: `count_scale` [2] and `count_weights` [2, 4, KNOTS].

    Args:
        statistics: statistics of the in-phase and of the quadrature camera.
        correlation: see `CountStatistics.weights`.
    """
    return {
        "count_scale": np.array([camera.scale for camera in statistics], np.float32),
        "count_weights": np.stack([camera.weights(correlation) for camera in statistics]),
    }


def pilot_tensors(pilots: Pilots) -> SamplingTable:
    """Phasors of the pilots [2, ny, nx], and their mask, 1 at a pilot and 0 elsewhere, [ny, nx]."""
    phases = np.zeros(pilots.mask.shape)
    phases[pilots.mask] = pilots.phases
    return {
        PILOT_PHASORS: np.stack([np.cos(phases), np.sin(phases)]).astype(np.float32),
        PILOT_MASK: pilots.mask.astype(np.float32),
    }


def known_p(phases: Real) -> NDArray[np.float32]:
    """Phases [ny, nx] that are known as the `p` of an estimate, [2, ny, nx]."""
    return (KNOWN_CONCENTRATION * np.stack([np.cos(phases), np.sin(phases)])).astype(np.float32)
