"""Features of recorded pages: field, page by page piston and shift from the known symbols, localized light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn

from lightpage.calibration.calibrate import LEAST_KEPT, KnownPage, least_coherence
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.coherence import COHERENT_BRANCHES, branch_shares, page_coherence
from lightpage.calibration.interfaces import BRANCHES
from lightpage.calibration.samplers import FieldSampler
from lightpage.calibration.sampling_table import SamplingTable, sampling_table, shifted
from lightpage.errors import CalibrationError
from lightpage.page.symbols import symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.train.models.field import FieldRecovery, Measured, TorchFieldSolver
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.localizers.coherent import CoherentLocalizer
from lightpage.train.models.localizers.wave import WaveLocalizer
from lightpage.train.models.parts import stacked
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import GRID_STEP_PX, FieldGrid

Real = NDArray[np.float64]
M = TypeVar("M", bound=nn.Module)

CPU = torch.device("cpu")
_PROBE_PX = 0.3
_LARGEST_STEP_PX = 0.5


@dataclass(frozen=True)
class PageState:
    """State of one page that no symbol explains: image shift and piston.

    Attributes:
        shift_px: how far the image has moved (x, y) since calibration, camera pixels.
        piston_rad: phase common to all symbols.
    """

    shift_px: tuple[float, float]
    piston_rad: float


@dataclass(frozen=True)
class PageFeatures:
    """Features of one page as a network takes them.

    Attributes:
        light: demodulated samples [2, B, S, ny, nx], float16, piston taken off.
        positions: exit centroids [2, ny, nx], float32, over the pipe's width.
        phases: true phases [ny, nx], float32, radians.
        state: image shift and piston of the page that were taken off.
        estimate: p [2, ny, nx], float32, of an earlier pass, from which this one starts; None for the first pass.
    """

    light: NDArray[np.float16]
    positions: NDArray[np.float32]
    phases: NDArray[np.float32]
    state: PageState
    estimate: NDArray[np.float32] | None = None


class FeatureExtractor:
    """Turns frame pairs of one calibrated device into features.

    Args:
        device: device as it was calibrated.
        localizer: `coherent` or `wave`.
        choices: hyperparameters of the decoder that the features are for.
        with_signal_power: see `FieldRecovery`.
        compute: where fields and light are computed.

    Attributes:
        device, compute: see above.
        recovery, recovery_there: field recovery on the CPU, and where fields are computed.
    """

    def __init__(
        self,
        device: CalibratedDevice,
        localizer: str = "coherent",
        choices: Hyperparameters | None = None,
        *,
        with_signal_power: bool = True,
        compute: torch.device = CPU,
    ) -> None:
        choices = choices or Hyperparameters()
        profile, parameters = device.profile, device.parameters
        self.device, self.compute = device, compute
        self._twin = TorchTwin(RayTwin(profile))
        self.table: SamplingTable = sampling_table(self._twin, parameters, device.quadrature_phase_rad, profile)
        self._apart = {name: self.table[name] for name in device.apart_inputs}
        self.recovery = choices.field_recovery(profile, with_signal_power=with_signal_power)
        self.recovery_there = on_device(self.recovery, compute)
        self._solve = TorchFieldSolver(self.recovery_there)
        self._coherent = choices.coherent_localizer(profile).to(compute)
        self._wave = WaveLocalizer(profile, parameters, self.grid).to(compute) if localizer == "wave" else None
        shares = branch_shares(self.table["positions"].reshape(2, -1).T.astype(float))
        self._shares = shares.reshape(len(COHERENT_BRANCHES), *profile.page_shape)
        self._chosen = [BRANCHES.index(name) for name in COHERENT_BRANCHES]

    @property
    def grid(self) -> FieldGrid:
        """The common grid."""
        return self.recovery.grid

    def field(self, pair: FramePair) -> NDArray[np.complex64]:
        """Recovered field on the common grid."""
        at = self.table["registration"], self.table["homodyne"], self._apart
        return self._solve(pair, self.device.references, *at)[0]

    def measure(
        self, pair: FramePair, shift_px: tuple[float, float], recovery: FieldRecovery | None = None
    ) -> tuple[Measured, Tensor]:
        """Return the equations and the field of a page whose image has moved by (x, y), on the calibrated grid.

        They are computed on the CPU, or where another of the extractor's recoveries is.
        """
        recovery = recovery or self.recovery
        device = next(recovery.buffers()).device
        registration = shifted(self.table["registration"], np.array(shift_px))
        seen = (pair.in_phase, pair.quadrature, self.device.references.in_phase, self.device.references.quadrature)
        tensors = [*(frame.astype(np.float32) for frame in seen), registration, self.table["homodyne"]]
        tensors += self._apart.values()
        measured = recovery.measure(*(torch.from_numpy(values).to(device) for values in tensors))
        return measured, recovery.solve(measured)[0]

    def check(self, page: KnownPage, calibrated: float) -> None:
        """Check that a known page shows its symbols where this calibration says.

        Args:
            page: number of the page in the recording.
            calibrated: coherence of the pages that were calibrated on.

        Raises:
            CalibrationError: it shows hardly more of them than chance does, or clearly less than those pages.
        """
        light = page.light(self.device.modulation)
        sampler = FieldSampler(self.known_field(page.pair, np.angle(light)), self.grid)
        found = page_coherence(sampler, self._twin, self.device.parameters, self.device.profile, light)
        least = max(least_coherence(page.symbols.size), LEAST_KEPT * calibrated)
        if not found >= least:
            raise CalibrationError(
                "calibration against the recording",
                f"a coherence of {found:.3f}",
                f"at least {least:.3f}: the calibration of the device that was recorded, and the symbols of its pages",
            )

    def known_field(self, pair: FramePair, phases: Real) -> NDArray[np.complex64]:
        """Recovered field of a known page, its image shift taken off."""
        field = self.field(pair)
        return self._moved(field, np.array(self.page(field, phases, np.zeros(2))[0].state.shift_px))

    def pages(
        self, recording: Recording, indices: Sequence[int], shift_px: tuple[float, float] = (0.0, 0.0)
    ) -> Iterator[PageFeatures]:
        """Features of the given pages, in order; the shift is followed from page to page, from `shift_px` on."""
        shift = np.array(shift_px)
        for index in indices:
            symbols = recording.symbols(index)
            assert symbols is not None
            phases = self.device.modulation.phase(symbol_phases(symbols, recording.levels))
            page, shift = self.page(self.field(recording.frames(index)), phases, shift)
            yield page

    def page(self, field: NDArray[np.complex64], phases: Real, shift: Real) -> tuple[PageFeatures, Real]:
        """Features of one page, and its shift, found from the known phases [ny, nx] starting from `shift` (x, y)."""
        state = self.state(field, phases, shift)
        shift, piston = np.array(state.shift_px), state.piston_rad
        light = self._light(field, shift) if self._wave is None else localized(self._wave, self._moved(field, shift))
        if self._wave is not None:
            centre = light[:, 0].mean(1)
            piston = float(np.angle(np.sum((centre[0] + 1j * centre[1]) * np.exp(-1j * phases))))
        cos, sin = np.cos(piston), np.sin(piston)
        turned = np.stack([light[0] * cos + light[1] * sin, light[1] * cos - light[0] * sin])
        features = PageFeatures(
            turned.astype(np.float16),
            self.table["positions"],
            phases.astype(np.float32),
            PageState(state.shift_px, piston),
        )
        return features, shift

    def state(self, field: NDArray[np.complex64], phases: Real, shift: Real) -> PageState:
        """Shift and piston of a page with known phases [ny, nx]; the shift is looked for from `shift` (x, y) on."""
        known = np.exp(-1j * phases)
        for _ in range(2):
            shift = shift + self._shift_step(field, known, shift)
        piston = float(np.angle(self._agreement(self._light(field, shift), known)))
        return PageState((float(shift[0]), float(shift[1])), piston)

    def _moved(self, field: NDArray[np.complex64], shift: Real) -> NDArray[np.complex64]:
        return moved(field, shift * self.device.profile.image_pixel_m / self.grid.pitch_m)

    def _light(self, field: NDArray[np.complex64], shift: Real) -> NDArray[np.float32]:
        return demodulate(self._coherent, field, self.table, shift)

    def _agreement(self, light: NDArray[np.float32], known: NDArray[np.complex128]) -> complex:
        """Coherent sum of the branches' light with the known symbols over the page."""
        centre = light[:, self._chosen].mean(2)
        return complex(np.sum(self._shares * (centre[0] + 1j * centre[1]) * known))

    def _shift_step(self, field: NDArray[np.complex64], known: NDArray[np.complex128], shift: Real) -> Real:
        """Vertex of the parabola of coherent power along x and along y."""
        here = abs(self._agreement(self._light(field, shift), known)) ** 2
        step = np.zeros(2)
        for axis in (0, 1):
            probe = _PROBE_PX * np.eye(2)[axis]
            plus = abs(self._agreement(self._light(field, shift + probe), known)) ** 2
            minus = abs(self._agreement(self._light(field, shift - probe), known)) ** 2
            bend = plus - 2 * here + minus
            if bend < 0:
                step[axis] = -_PROBE_PX * (plus - minus) / (2 * bend)
        return np.clip(step, -_LARGEST_STEP_PX, _LARGEST_STEP_PX)


def on_device(module: M, device: torch.device) -> M:
    """Return the module itself for the CPU, on which it must be, or a copy on another device."""
    return module if device == CPU else deepcopy(module).to(device)


def demodulate(
    localizer: CoherentLocalizer, field: NDArray[np.complexfloating], table: SamplingTable, shift: Real | None = None
) -> NDArray[np.float32]:
    """The coherent localizer's light [2, B, S, ny, nx] of a field [Gy, Gx], seen `shift` (x, y) camera pixels on."""
    places = table["places"]
    if shift is not None:
        places = places + (shift / GRID_STEP_PX).astype(np.float32)[None, :, None, None]
    device = next(localizer.buffers()).device
    known = (torch.from_numpy(values).to(device) for values in (places, table["place_gradients"], table["phases"]))
    with torch.no_grad():
        light: NDArray[np.float32] = localizer(stacked(field).to(device), *known).cpu().numpy()
    return light


def localized(waves: WaveLocalizer, field: NDArray[np.complexfloating]) -> NDArray[np.float32]:
    """The wave localizer's light [2, 1, S, ny, nx] of a field [Gy, Gx]."""
    with torch.no_grad():
        light: NDArray[np.float32] = waves(stacked(field).to(next(waves.buffers()).device)).cpu().numpy()
    return light


def moved(field: NDArray[np.complex64], shift: Real) -> NDArray[np.complex64]:
    """The field as seen `shift` (x, y) samples further on."""
    real, imaginary = (ndimage.shift(part, -shift[::-1], order=3) for part in (field.real, field.imag))
    return np.asarray(real + 1j * imaginary, dtype=np.complex64)
