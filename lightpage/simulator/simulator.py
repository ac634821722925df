"""The simulated device: pages in, frame pairs out, with every imperfection of its state and drift from page to page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import CameraPose, Device
from lightpage.page.levels import check_levels
from lightpage.page.symbols import check_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.cameras import (
    expose,
    in_phase_intensity,
    quadrature_intensity,
    resample,
    to_counts,
)
from lightpage.simulator.engine import NUMPY, Engine
from lightpage.simulator.true_optics import Place, TrueOptics
from lightpage.waves.grid import check_camera

Complex = NDArray[np.complexfloating]

LIGHT = 1
"""Raised when the same device and pages give other frames: what an earlier version began is then not gone on with."""
_WALK, _NOISE, _FLICKER = 0, 2, 4
"""Independent random streams drawn from one seed; the last two have one for each page."""


@dataclass(frozen=True)
class SimulatedPage:
    """Recorded page, with quantities that only the simulator knows.

    Attributes:
        pair: the frames.
        exit_field: signal on the exit facet's grid, complex64 [cells_y - 1, cells_x - 1], before piston.
        piston: phase of the signal against the reference, radians.
        shift_px: drift of the image (x, y), camera pixels.
    """

    pair: FramePair
    exit_field: Complex
    piston: float
    shift_px: tuple[float, float]


@dataclass(frozen=True)
class SeenPage:
    """A simulated page in the arrays of the engine that has computed it.

    Attributes:
        frames: counts of the in-phase and of the quadrature camera.
        exit_field, piston, shift_px: see `SimulatedPage`.
    """

    frames: tuple[Any, Any]
    exit_field: Any
    piston: float
    shift_px: tuple[float, float]


class Simulator:
    """A device with a memory: its piston and image shift walk from page to page, and it may be knocked.

    Args:
        profile: nominal device.
        device: true state.
        levels: levels M of the symbols it will be given.
        seed: seed of noise and drift from page to page; the same seed and calls give the same frames. The ripple of the
            reference belongs to the device (`reference.ripple_seed`).
        steps: splitting steps of a sheared pipe; `splitting_steps` if left out.
        reference_stays: whether the image moves over the reference, as when page or pipe move, and not with it, as when
            the cameras do.
        engine: what computes. Another one gives the same light and draws other noise.

    Raises:
        PageError: a level count outside 2..256.
        ProfileError: the profile's camera is too coarse or too small for its page.
    """

    def __init__(
        self,
        profile: Profile,
        device: Device,
        levels: int = 256,
        seed: int = 0,
        steps: int | None = None,
        *,
        reference_stays: bool = False,
        engine: Engine = NUMPY,
    ) -> None:
        check_levels(levels)
        check_camera(profile)
        self.optics = TrueOptics(profile, device, steps, engine)
        self.levels = levels
        self.seed = seed
        self.reference_stays = reference_stays
        self._walk = np.random.default_rng([seed, _WALK])
        self._piston = float(self._walk.uniform(-np.pi, np.pi))
        self._shift = np.zeros(2)
        self._page = 0

    @property
    def profile(self) -> Profile:
        """The nominal device."""
        return self.optics.profile

    @property
    def device(self) -> Device:
        """The true state."""
        return self.optics.device

    def set_device(self, device: Device) -> None:
        """Move the device to another true state (slow drift); piston and shift go on from where they are."""
        self.optics = TrueOptics(self.profile, device, self.optics.channel.steps, self.optics.engine)

    def knock(self, shift_px: tuple[float, float]) -> None:
        """Move the image at once by (x, y) camera pixels, on both cameras; it walks on from there."""
        self._shift = self._shift + np.asarray(shift_px)

    def skip(self, pages: int) -> None:
        """Let `pages` pages pass unseen: what follows is what would have followed had they been simulated."""
        for _ in range(pages):
            self._drift()

    def page(self, symbols: NDArray[np.uint8]) -> FramePair:
        """Write a page of symbols [ny, nx] and record its frame pair."""
        return self.simulate(symbols).pair

    def simulate(self, symbols: NDArray[np.uint8]) -> SimulatedPage:
        """Write a page of symbols [ny, nx]; the frames together with the truth.

        Raises:
            PageError: symbols of the wrong shape, type or range.
        """
        seen, to_numpy = self.see(symbols), self.optics.engine.to_numpy
        return SimulatedPage(
            FramePair(*map(to_numpy, seen.frames)), to_numpy(seen.exit_field), seen.piston, seen.shift_px
        )

    def see(self, symbols: NDArray[np.uint8]) -> SeenPage:
        """`simulate`, with what it computes left where the engine has it."""
        check_symbols(symbols, self.profile.page_shape, self.levels, "symbols to simulate")
        device, engine = self.device, self.optics.engine
        rng = engine.generator([self.seed, _NOISE, self._page])
        flicker = device.slm.flicker_rad * np.random.default_rng([self.seed, _FLICKER, self._page]).standard_normal()
        self._drift()
        shift = (float(self._shift[0]), float(self._shift[1]))
        size = self.profile.page.symbol_size_px
        phases, pixels = map(engine.array, (symbol_phases(symbols, self.levels), np.ones((size, size))))
        phase = engine.xp.kron(phases, pixels)
        noise = device.slm.phase_noise_rad * rng.standard_normal(phase.shape)
        exit_field = self.optics.exit_field(phase, noise, flicker)
        frames = self._frames(exit_field, shift, rng)
        return SeenPage(frames, exit_field, self._piston, shift)

    def references(self) -> FramePair:
        """Reference-only frames, the mean of so many exposures that only quantisation is left."""
        return FramePair(*map(self.optics.engine.to_numpy, self._frames(None, (0.0, 0.0), None)))

    def dark(self) -> FramePair:
        """Frames without any light, in which hot pixels alone show."""
        engine = self.optics.engine
        dark = engine.array(np.zeros(self.profile.frame_shape))
        frames = (blemishes.counted(dark, self.device.sensor) for blemishes in self.optics.blemishes)
        return FramePair(*map(engine.to_numpy, frames))

    def _drift(self) -> None:
        """Walk on by one page; its noise has a stream of its own, so that pages can pass without being computed."""
        drift = self.device.drift
        self._piston += drift.piston_rad * self._walk.standard_normal()
        self._shift = self._shift + drift.shift_px * self._walk.standard_normal(2)
        self._page += 1

    def _frames(self, exit_field: Complex | None, shift: tuple[float, float], noise: Any | None) -> tuple[Any, Any]:
        device, engine = self.device, self.optics.engine
        homodyne = device.homodyne
        error, sign = np.deg2rad(homodyne.quadrature_error_deg), homodyne.quadrature_sign
        piston, frames = complex(np.exp(1j * self._piston)), []
        together = Place.of(device.in_phase_camera) == Place.of(device.quadrature_camera)
        field: Complex = engine.array(np.zeros(1, np.complex64))
        if exit_field is not None and together:
            field = self.optics.camera_field(exit_field) * piston
        for which, pose in enumerate((device.in_phase_camera, device.quadrature_camera)):
            reference = self._reference_behind(pose, shift)
            if exit_field is not None and not together:
                field = self.optics.camera_field(exit_field, pose) * piston
            if which:
                gain = homodyne.quadrature_gain
                intensity = gain * quadrature_intensity(field, reference, error, sign, device.drift.contrast)
            else:
                intensity = in_phase_intensity(field, reference, device.drift.contrast)
            blemishes = self.optics.blemishes[which]
            seen = resample(intensity, *self.optics.camera_axes_m, *self.optics.view(pose, shift), engine)
            seen = seen * blemishes.transmission
            if exit_field is None:
                seen = seen * device.reference.recorded_exposure_relative
            else:
                seen = seen * blemishes.late_transmission
            if noise is None:
                counts = to_counts(seen * self.optics.electrons_per_unit, device.sensor, engine)
            else:
                counts = expose(seen, self.optics.electrons_per_unit, device.sensor, noise, engine)
            frames.append(blemishes.counted(counts, device.sensor))
        return frames[0], frames[1]

    def _reference_behind(self, pose: CameraPose, shift: tuple[float, float]) -> Complex:
        """The reference where a camera sees it behind an image that has moved by `shift`, on the image's plane."""
        if not self.reference_stays or shift == (0.0, 0.0):
            return self.optics.reference_in_place
        middle = tuple(count // 2 for count in self.profile.frame_shape)
        still, moved = ([float(axis[middle]) for axis in self.optics.view(pose, by)] for by in ((0.0, 0.0), shift))
        return self.optics.reference((still[0] - moved[0], still[1] - moved[1]))
