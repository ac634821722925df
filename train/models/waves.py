"""The wave model of a device as real matrix products, both ways: it trains, and is exported.

It does what `FittedWaves` does. The matrices are made from the parameters in the graph itself, so that a device that
has drifted is decoded by feeding other parameters.

`Waves` is the form for one page: a CPU computes its tiles and blocks in less time than the large products of the form
for batches on a GPU, `lightpage.train.models.batched.waves.BatchedWaves` (docs/guides/speed.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lightpage.calibration.parameters import NAMES, as_dict
from lightpage.calibration.waves.wave_model import (
    fitted_camera_phase,
    fitted_geometry,
    fitted_launch_phase,
    modulator_axes,
)
from lightpage.device.profile import Profile
from lightpage.train.models import functions
from lightpage.train.models.parts import Parts, conjugate, multiply, multiply_conjugate, parts, phasor
from lightpage.train.models.wave_lens import OVERSAMPLING, ROLL_MARGIN, LensMatrices, PlacedLens, TiledLens
from lightpage.train.models.wave_pipe import BlockMatrices, TiledPipe
from lightpage.waves.geometry import cells_for, highest_frequencies
from lightpage.waves.grid import FieldGrid, field_grid, symbol_samples
from lightpage.waves.lens import entrance_window
from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

Real = NDArray[np.float64]


class Fidelity(NamedTuple):
    """Fidelity of the simulated light: error bounds; larger ones take less time.

    Attributes:
        pipe: error of the splitting of a sheared pipe.
        lenses: error of each lens's expansion.
    """

    pipe: float
    lenses: float


EXACT = Fidelity(0.01, 0.015)
"""Fidelity for light that is taken off what was seen: twice the error of the pipe costs a full-size page 0.02 bit."""
ROUGH = Fidelity(0.06, 0.05)
"""Fidelity for light that is but a small rest: half the errors bring 0.006 bit."""


THINNED = 2
"""Distance of the samples of a thinned grid, in samples of the usual one: still above the Nyquist rate of the field."""


class WaveMatrices(NamedTuple):
    """Everything that depends on the device's parameters."""

    launch: LensMatrices
    delaunch: LensMatrices
    at_launch: Parts
    against_reference: Parts
    pipe: list[BlockMatrices]


class Waves(nn.Module):
    """Modulator to common grid and back.

    Args:
        profile: the nominal device.
        parameters: [P] of the ray twin, fitted (or, for an oracle, true): they say how finely the pipe is sampled
            and which of its modes couple.
        samples: number of samples on the modulator, per symbol and axis.
        fidelity: how exactly light is followed.
        filled, grid: see `FittedWaves`. One filled sample per symbol stands for all of it.
        thinned: whether light can be computed on every `THINNED`-th sample of the grid along either axis too.
    """

    def __init__(
        self,
        profile: Profile,
        parameters: Real,
        samples: int,
        fidelity: Fidelity = EXACT,
        *,
        filled: bool = False,
        grid: FieldGrid | None = None,
        thinned: bool = False,
    ) -> None:
        super().__init__()
        grid = grid or field_grid(profile)
        self.samples = samples
        value = as_dict(parameters)
        geometry = fitted_geometry(profile, value)
        x, y = modulator_axes(profile, samples)
        centre = np.array([value[f"page_centre_{axis}_m"] for axis in "xy"])
        finest_x, finest_y = modulator_axes(profile, symbol_samples(profile))
        seen = float(grid.x_m[-1]), float(grid.y_m[-1])
        cells = cells_for(geometry, finest_x + centre[0], finest_y + centre[1], *seen)
        highest = highest_frequencies(geometry, geometry.camera_path, grid.x_m, grid.y_m)
        sparse = [
            sparse_axis(axis, frequency, OVERSAMPLING)
            for axis, frequency in zip((grid.x_m, grid.y_m), highest, strict=True)
        ]
        common = cells, ROLL_MARGIN, fidelity.lenses
        self.geometry, self.cells, self.fidelity = geometry, cells, fidelity
        self.launch = TiledLens(geometry, geometry.lens_path, (x + centre[0], y + centre[1]), *common)
        self.delaunch = TiledLens(geometry, geometry.camera_path, (sparse[0], sparse[1]), *common)
        self._pipe = TiledPipe(geometry, cells, fidelity.pipe)
        self.profile, self.envelope_m = profile, profile.symbol_pitch_m / samples if filled else 0.0
        self.x_m: Tensor
        self.y_m: Tensor
        self.grid_x_m: Tensor
        self.grid_y_m: Tensor
        self.sparse_x_m: Tensor
        self.sparse_y_m: Tensor
        for name, buffer in {
            "x_m": x,
            "y_m": y,
            "grid_x_m": grid.x_m,
            "grid_y_m": grid.y_m,
            "sparse_x_m": sparse[0],
            "sparse_y_m": sparse[1],
        }.items():
            self.register_buffer(name, torch.from_numpy(buffer).to(torch.float32), persistent=False)
        across, down = (
            interpolation(axis, few, OVERSAMPLING) for axis, few in zip((grid.x_m, grid.y_m), sparse, strict=True)
        )
        self.interpolations = down, across
        self._down, self._across = Banded(down), Banded(across)
        self._up, self._back = Banded(down.T), Banded(across.T)
        if thinned:
            self._thin_down = Banded(down[::THINNED])
            self._thin_across = Banded(across[::THINNED])
            self._thin_up = Banded(down[::THINNED].T)
            self._thin_back = Banded(across[::THINNED].T)
        self.default: Tensor
        self.register_buffer("default", torch.from_numpy(parameters).to(torch.float32), persistent=False)

    def lenses(
        self, parameters: Tensor, blur: Tensor | float, camera: tuple[Tensor, Tensor]
    ) -> tuple[PlacedLens, PlacedLens]:
        """Return both lenses with the device's smooth phases, in the type of the parameters.

        Args:
            parameters: [P].
            blur: see `matrices`.
            camera: places (x, y) on the camera plane at which the second lens has its phase, metres.
        """
        value = dict(zip(NAMES, parameters.unbind(), strict=True))
        geometry = fitted_geometry(self.profile, value)
        x, y, grid_x, grid_y = (axis.to(parameters.dtype) for axis in (self.x_m, self.y_m, *camera))
        page_x, page_y = x + value["page_centre_x_m"], y + value["page_centre_y_m"]
        at_launch = fitted_launch_phase(self.profile, value, geometry, x[None, :], y[:, None])
        at_launch = at_launch + geometry.lens_path.of_field(page_x[None, :], page_y[:, None])
        at_camera = fitted_camera_phase(self.profile, value, geometry, grid_x[None, :], grid_y[:, None])
        at_camera = at_camera - geometry.camera_path.of_field(grid_x[None, :], grid_y[:, None])
        sparse = self.sparse_x_m[0].to(parameters.dtype), self.sparse_y_m[0].to(parameters.dtype)

        def window(across: Tensor, up: Tensor) -> Tensor:
            blur_m2 = blur * self.profile.slm.pitch_m**2
            return torch.as_tensor(entrance_window(geometry, across, up, self.envelope_m, blur_m2, functions))

        return (
            PlacedLens(geometry, geometry.lens_path, (page_x[0], page_y[0]), at_launch, window),
            PlacedLens(geometry, geometry.camera_path, sparse, -at_camera, None),
        )

    def matrices(self, parameters: Tensor | None = None, blur: Tensor | float = 0.0) -> WaveMatrices:
        """Return the matrices of both ways.

        Args:
            parameters: [P]; those that the model was made with if left out.
            blur: variance of the modulator's blur, over the square of its pixels' pitch.
        """
        grid = self.grid_x_m, self.grid_y_m
        launch, camera = self.lenses(self.default if parameters is None else parameters, blur, grid)
        return WaveMatrices(
            self.launch.matrices(launch),
            self.delaunch.matrices(camera),
            phasor(launch.on_plane),
            conjugate(phasor(camera.on_plane)),
            self._pipe.matrices(launch.geometry),
        )

    def to_camera(self, at: WaveMatrices, page: Tensor) -> Tensor:
        """Field on the modulator [2, ny samples, nx samples] to the common grid [2, Gy, Gx], against the reference."""
        return torch.stack(self.exit_to_camera(at, self.to_exit(at, parts(page))))

    def to_page(self, at: WaveMatrices, field: Tensor) -> Tensor:
        """Field on the common grid [2, Gy, Gx] back to the modulator, by the adjoint."""
        return torch.stack(self.exit_to_page(at, self.back_to_exit(at, parts(field))))

    def to_exit(self, at: WaveMatrices, page: Parts) -> Parts:
        """Field on the modulator [ny samples, nx samples] to the pipe's exit facet, [fy, fx]."""
        entrance = self.launch.to_facet(at.launch, multiply(page, at.at_launch))
        real, imaginary = self._pipe(entrance, at.pipe, backwards=False)
        return real, imaginary

    def exit_to_camera(self, at: WaveMatrices, leaving: Parts, *, thinned: bool = False) -> Parts:
        """Field on the exit facet to the common grid [Gy, Gx], or to the thinned one, against the reference."""
        sparse = torch.stack(self.delaunch.to_plane(at.delaunch, leaving))
        down, across = (self._thin_down, self._thin_across) if thinned else (self._down, self._across)
        light = across(down(sparse).transpose(-1, -2)).transpose(-1, -2)
        return multiply(parts(light), _against_reference(at, thinned=thinned))

    def back_to_exit(self, at: WaveMatrices, field: Parts, *, thinned: bool = False) -> Parts:
        """Field on the common grid, or on the thinned one, back to the exit facet, by the adjoint."""
        light = torch.stack(multiply_conjugate(field, _against_reference(at, thinned=thinned)))
        up, back = (self._thin_up, self._thin_back) if thinned else (self._up, self._back)
        sparse = back(up(light).transpose(-1, -2)).transpose(-1, -2)
        return self.delaunch.to_facet(at.delaunch, parts(sparse))

    def exit_to_page(self, at: WaveMatrices, leaving: Parts) -> Parts:
        """Field on the exit facet back to the modulator, by the adjoint."""
        page = self.launch.to_plane(at.launch, self._pipe(leaving, at.pipe, backwards=True))
        return multiply_conjugate(page, at.at_launch)


def thinned_plane(plane: Tensor) -> Tensor:
    """Every `THINNED`-th sample of a plane of the grid along either axis, [..., Gy, Gx]."""
    return plane[..., ::THINNED, ::THINNED]


def _against_reference(at: WaveMatrices, *, thinned: bool) -> Parts:
    real, imaginary = at.against_reference
    return (thinned_plane(real), thinned_plane(imaginary)) if thinned else (real, imaginary)


_BLOCK = 64
"""Rows of a matrix that go through a product together."""


class Banded(nn.Module):
    """A matrix whose rows are zero but for a few neighbours, as products of small blocks.

    Args:
        matrix: [m, n].
    """

    def __init__(self, matrix: NDArray[np.floating]) -> None:
        super().__init__()
        rows, columns = matrix.shape
        starts, width = range(0, rows, _BLOCK), 1
        spans = []
        for start in starts:
            used = np.flatnonzero(np.any(matrix[start : start + _BLOCK] != 0, axis=0))
            first, last = (int(used[0]), int(used[-1]) + 1) if used.size else (0, 1)
            spans.append(first)
            width = max(width, last - first)
        width = min(width, columns)
        blocks, places = np.zeros((len(spans), _BLOCK, width)), np.zeros((len(spans), width), np.int64)
        for number, (start, first) in enumerate(zip(starts, spans, strict=True)):
            first = min(first, columns - width)
            part = matrix[start : start + _BLOCK, first : first + width]
            blocks[number, : len(part)], places[number] = part, first + np.arange(width)
        self._rows = rows
        self.blocks: Tensor
        self.places: Tensor
        self.register_buffer("blocks", torch.from_numpy(blocks).float(), persistent=False)
        self.register_buffer("places", torch.from_numpy(places), persistent=False)

    def forward(self, light: Tensor) -> Tensor:
        """The matrix times each of [..., n, k], [..., m, k]."""
        count, width = self.places.shape
        near = light.index_select(-2, self.places.flatten())
        near = near.reshape(*light.shape[:-2], count, width, light.shape[-1])
        return (self.blocks @ near).flatten(-3, -2)[..., : self._rows, :]
