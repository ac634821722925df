"""Bound that no decoder exceeds: information of a page's light on one symbol, all else of page and device being known.

It is Fisher's, against shot noise, read noise, quantisation and the noise of the modulator's pixels. Hot pixels, dust
and what a camera bends are left out: each takes information away.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import CameraPose, Device
from lightpage.metrics.information import own_information
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.simulator.engine import NUMPY, Engine
from lightpage.simulator.true_optics import TrueOptics

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]


@dataclass(frozen=True)
class _View:
    """Light of a page on one camera, on the plane and at the pitch of the computed optics.

    Attributes:
        pose: pose of the camera.
        amplitude: signal and reference, the latter times the contrast of the fringes, complex [y, x].
        electrons_per_unit: electrons for a unit of intensity.
        weight: 1 over the variance of a pixel's electrons, [y, x]; 0 beside the frame and where the pixel is full.
        engine: what has computed them.
    """

    pose: CameraPose
    amplitude: Complex
    electrons_per_unit: float
    weight: Real
    engine: Engine

    def information(self, change: Complex) -> float:
        """Fisher information of a number that changes the field at this rate, [y, x]."""
        xp = self.engine.xp
        rate = 2 * self.electrons_per_unit * xp.real(xp.conj(self.amplitude) * change)
        return float(xp.sum(rate**2 * self.weight))


class LightBound:
    """The least error of the symbols of one page.

    Args:
        profile, device: nominal and true.
        symbols: symbols of the page, [ny, nx].
        levels: M.
        engine: what computes.
    """

    def __init__(
        self, profile: Profile, device: Device, symbols: NDArray[np.integer], levels: int, engine: Engine = NUMPY
    ) -> None:
        self._optics = TrueOptics(profile, device, engine=engine)
        self._size, self._shape = profile.page.symbol_size_px, symbols.shape
        self._phase = self._enlarged(symbol_phases(symbols, levels))

    def concentration(self, row: int, column: int) -> float:
        """1 over the least variance of a symbol's phase, 1/rad^2: the Cramer-Rao bound and the modulator's noise."""
        here = np.zeros(self._shape)
        here[row, column] = 1.0
        change, optics = self._optics.exit_field_change(self._phase, self._enlarged(here)), self._optics
        told = sum(view.information(optics.camera_field(change, view.pose)) for view in self._views)
        noise = optics.device.slm.phase_noise_rad / self._size
        return 1.0 / (1.0 / told + noise**2)

    def _enlarged(self, values: Real) -> Real:
        """Values of symbols on the modulator's pixels, in double precision: their change is a small difference."""
        on_pixels: Real = self._optics.engine.exact(np.kron(values, np.ones((self._size, self._size))))
        return on_pixels

    @cached_property
    def _views(self) -> tuple[_View, _View]:
        """The in-phase and the quadrature camera's."""
        device, reference = self._optics.device, self._optics.reference_in_place
        leaving = self._optics.exit_field(self._phase)

        def view(pose: CameraPose, turned: Complex, gain: float) -> _View:
            scale, contrast = gain * self._optics.electrons_per_unit, device.drift.contrast
            amplitude = self._optics.camera_field(leaving, pose) + contrast * turned
            electrons = scale * (abs(amplitude) ** 2 + (1 - contrast**2) * abs(turned) ** 2)
            return _View(pose, amplitude, scale, self._weight(electrons), self._optics.engine)

        homodyne = device.homodyne
        turned = reference * np.exp(1j * homodyne.turn_rad)
        return view(device.in_phase_camera, reference, 1.0), view(
            device.quadrature_camera, turned, homodyne.quadrature_gain
        )

    def _weight(self, electrons: Real) -> Real:
        """See `_View`."""
        sensor, camera, pixel = (
            self._optics.device.sensor,
            self._optics.profile.camera,
            self._optics.profile.image_pixel_m,
        )
        step = sensor.full_well_e / (2**sensor.bit_depth - 1)
        x, y = self._optics.camera_axes_m
        seen = (abs(y) <= camera.rows_px * pixel / 2)[:, None] & (abs(x) <= camera.columns_px * pixel / 2)
        counted = (electrons < sensor.full_well_e) & self._optics.engine.exact(seen)
        weight: Real = counted / (electrons + sensor.read_noise_e**2 + step**2 / 12)
        return weight


def sampled_concentrations(
    profile: Profile, device: Device, levels: int, symbols: int, seed: tuple[int, int], engine: Engine = NUMPY
) -> Iterator[float]:
    """Yield `LightBound.concentration` of symbols of one random page; `seed` is a seed and the page's number."""
    rng = np.random.default_rng(seed)
    bound = LightBound(profile, device, random_symbols(profile, levels, 1, rng)[0], levels, engine)
    for row, column in rng.integers(profile.page_shape, size=(symbols, 2)).tolist():
        yield bound.concentration(row, column)


def mean_information(concentrations: Sequence[float], levels: int, seed: int) -> tuple[float, float]:
    """Mean information of posteriors of these concentrations on one of M levels, each at an error that a seed draws.

    Returns:
        Bits, and the standard error of the mean.
    """
    rng, kappa = np.random.default_rng(seed), np.array(concentrations)
    each = own_information(rng.vonmises(0.0, np.minimum(kappa, 1e12)), kappa, levels)
    return float(each.mean()), float(each.std(ddof=1) / np.sqrt(each.size))
