"""The differentiable ray twin: where each branch of a page point lands on the cameras, and with what phase.

A collimated beam leaves SLM point (x, y) with transverse wave vector k = -(k0/f)(x, y). Each wall n.r = c that it meets
maps k to k - 2(k.n)n and adds the phase 2(k.n)c + pi; the glass adds (kz - nk0)L; the beam lands at -f k'/k0.
A real lens adds a phase to each ray: a phase and a tilt, about the middle of the part of the facet that a branch fills.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from torch import Tensor, nn

from lightpage.calibration.interfaces import BRANCHES, Rays
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.phases import camera_phase, launch_phase
from lightpage.calibration.waves.wave_model import fitted_geometry
from lightpage.device.lens_path import SeidelTerms
from lightpage.device.profile import Profile

_LANDINGS = 3
"""Rounds in which a place and the second lens's tilt there are made to agree: each leaves a hundredth of the error."""
_NODES = leggauss(8)
"""Places along an axis of the facet that stand for a symbol's light there, -1 to 1, and their weights."""
_FIRST = [int(branch == "yx") for branch in BRANCHES]
"""Pair of walls by which each branch's light is reflected first: 0 along x, 1 along y."""
_SECOND = [1 - axis for axis in _FIRST]
_STATES = 4
"""States of the device that are traced at once: more only take more memory."""
_DARK = 1e-12
"""Light below which a part of the facet has no middle, over what the symbol sends at most."""

Real = NDArray[np.float64]


class RayTwin(nn.Module):
    """Ray tracer of one nominal device; all that can deviate comes in as `parameters`.

    Computes in float64: phases run to thousands of radians.

    Args:
        profile: the nominal device.
    """

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        self.profile = profile
        self.wave_number = 2 * math.pi / profile.light.wavelength_m
        self.index = profile.pipe.refractive_index
        self.half_width = profile.page_width_m / 2
        self.half_height = profile.page_height_m / 2
        self.corner = profile.corner_m
        self.ideal_lenses = profile.ideal_lenses
        self.symbol_pitch = profile.symbol_pitch_m
        self.camera_pitch = profile.image_pixel_m
        self.camera_centre = ((profile.camera.columns_px - 1) / 2, (profile.camera.rows_px - 1) / 2)

    def forward(
        self, parameters: Tensor, points: Tensor, anchors: Tensor, places: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Trace rays of page points, and return the pixels of camera-plane places.

        Args:
            parameters: [P] float64.
            points: [N, 2] page points (x, y), metres from the page's centre.
            anchors: [N, 2] points that decide the cells.
            places: [M, 2] camera-plane points, metres.

        Returns:
            places [B, N, 2], phases [B, N], positions [N, 2], pixels [2, M, 2].
        """
        return (*self.trace(parameters, points, anchors), self.pixels(parameters, places))

    def trace(self, parameters: Tensor, points: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rays of page points alone; see `forward`."""
        return self._trace(_named(parameters), points, anchors)

    def pixels(self, parameters: Tensor, places: Tensor) -> Tensor:
        """Pixels of camera-plane places alone; see `forward`."""
        return self._pixels(_named(parameters), places)

    def _trace(self, value: dict[str, Tensor], points: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        geometry: Any = fitted_geometry(self.profile, value)  # its numbers are tensors here
        focal, length, width = geometry.focal_length_m, geometry.pipe_length_m, geometry.pipe_width_m
        angle, roll = geometry.pipe_angle, geometry.pipe_roll
        centre = torch.stack([value["page_centre_x_m"], value["page_centre_y_m"]])
        wall_offset = torch.stack([value["pipe_centre_x_m"], value["pipe_centre_y_m"]])
        nk = self.index * self.wave_number
        zero, one = torch.zeros_like(angle), torch.ones_like(angle)
        normals = torch.stack([torch.stack([one, zero]), torch.stack([torch.sin(angle), torch.cos(angle)])])

        def in_pipe(at: Tensor) -> Tensor:
            return _turn(at + centre, -roll)

        def exit_centroid(k: Tensor) -> Tensor:
            kz = torch.sqrt(nk**2 - (k * k).sum(-1))
            reached: Tensor = k @ normals.T * (length / width / kz)[:, None]
            return reached

        def bent_by(path: SeidelTerms, field: Tensor, facet: Tensor, spread: Tensor) -> tuple[Tensor, Tensor]:
            """Return the change of k, [B, N, 2], and of the phase, [B, N], by a lens's path of light on the facet.

            Light there has its middle at `facet`, as (X, Y'), and the variance `spread` along either axis, [B, N, 2].
            """
            x, y = facet[..., 0], (facet[..., 1] - facet[..., 0] * torch.sin(angle)) / torch.cos(angle)
            at = field[..., 0], field[..., 1], x, y
            slopes, (bend_x, bend_y) = path.slope(*at), path.bend(*at)
            middle = path.of_field(field[..., 0], field[..., 1]) + path.of_both(*at)
            mean = middle + (bend_x * spread[..., 0] + bend_y * spread[..., 1]) / 2
            return torch.stack(slopes, dim=-1), mean - slopes[0] * x - slopes[1] * y

        per_metre = self.wave_number / focal
        starts = in_pipe(points)
        straight = -per_metre * starts
        positions = exit_centroid(straight)
        cells = exit_centroid(-per_metre * in_pipe(anchors)).detach()
        odd = torch.tensor([[axis in branch for axis in "xy"] for branch in BRANCHES], device=points.device)
        crossed = torch.where(odd[:, None], 2 * torch.floor(cells / 2) + 1, 2 * torch.round(cells / 2))

        entrance, leaves, spread = self._filled(crossed, positions, width, focal)
        tilt, more = bent_by(geometry.lens_path, starts, entrance, spread)
        k = straight + tilt
        phase = launch_phase(value, points[:, 0] / self.corner, points[:, 1] / self.corner) + more
        squared = (k * k).sum(-1)
        phase = phase - squared / (torch.sqrt(nk**2 - squared) + nk) * length
        for order in (_FIRST, _SECOND):
            cells_of = torch.stack([crossed[branch, :, axis] for branch, axis in enumerate(order)])
            k, phase = self._reflect(k, phase, normals[order][:, None], cells_of, width, wall_offset[order][:, None])
        landing = -k / per_metre
        for _ in range(1 if self.ideal_lenses else _LANDINGS):
            tilt, more = bent_by(geometry.camera_path, landing, leaves, spread)
            landing = (tilt - k) / per_metre
        landing = _turn(landing, roll)
        x, y = landing[..., 0] / self.corner, landing[..., 1] / self.corner
        edges = self.half_width / self.corner, self.half_height / self.corner
        return landing, phase - more + camera_phase(value, x, y, *edges), positions

    def _filled(self, met: Tensor, positions: Tensor, width: Tensor, focal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the places where light through the cells `met` enters and leaves the pipe, by exit centroids.

        Args:
            met: cells by branch, [B, N, 2].
            positions: exit centroids, [N, 2].
            width: of the pipe, metres.
            focal: focal length of the first lens, metres.

        Returns:
            Mean places at entrance and exit, and variance along either axis, [B, N, 2]; weighted by a symbol's light.
        """
        shifted = torch.clamp(met - positions, -1, 1)
        low, high = torch.clamp(shifted - 0.5, min=-0.5), torch.clamp(shifted + 0.5, max=0.5)
        u, weight = (torch.from_numpy(array).to(met.device) for array in _NODES)
        places = width * ((low + high)[..., None] / 2 + (high - low)[..., None] / 2 * u)
        light = weight * torch.sinc(places * self.symbol_pitch * self.wave_number / (2 * math.pi * focal)) ** 2
        total = light.sum(-1) + _DARK
        mean = (light * places).sum(-1) / total
        leaves = torch.where(torch.remainder(met, 2) == 0, 1, -1) * (mean - width * shifted)
        return mean, leaves, (light * places**2).sum(-1) / total - mean**2

    @staticmethod
    def _reflect(
        k: Tensor, phase: Tensor, normals: Tensor, cells: Tensor, width: Tensor, offsets: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Reflect |cells| times on the pair of walls with the normal, starting with the wall on the cells' side.

        Each reflection turns the sign of k.n, and the next wall is the other one. So what the walls' distance adds is
        the same each time, and what their offset adds is undone by every second one.

        Args:
            k, phase: [B, N, 2] and [B, N].
            normals, offsets: each branch's pair of walls, [B, 1, 2] and [B, 1].
            cells: [B, N].
            width: the walls' distance, metres.
        """
        met, along = torch.abs(cells), (k * normals).sum(-1)
        left_over = torch.remainder(met, 2)
        phase = phase + along * (width * cells + 2 * offsets * left_over) + math.pi * met
        return k - 2 * (along * left_over)[..., None] * normals, phase

    def _pixels(self, value: dict[str, Tensor], places: Tensor) -> Tensor:
        radius2 = (places * places).sum(-1, keepdim=True) / self.corner**2
        across, up = places[:, :1] / self.half_width, places[:, 1:] / self.half_height
        cameras = []
        for camera in ("in_phase", "quadrature"):
            keystone = value[f"{camera}_keystone_x_relative"] * across + value[f"{camera}_keystone_y_relative"] * up
            seen = places * (1 + value["distortion_relative"] * radius2 + keystone) / self.camera_pitch
            x, y = seen[:, 0], seen[:, 1]
            column = (1 + value[f"{camera}_scale_x_relative"]) * x + value[f"{camera}_turn_xy_slope"] * y
            row = value[f"{camera}_turn_yx_slope"] * x + (1 + value[f"{camera}_scale_y_relative"]) * y
            column = column + value[f"{camera}_shift_x_px"] + self.camera_centre[0]
            row = row + value[f"{camera}_shift_y_px"] + self.camera_centre[1]
            cameras.append(torch.stack([column, row], dim=-1))
        return torch.stack(cameras)


def _named(parameters: Tensor) -> dict[str, Tensor]:
    return dict(zip(NAMES, parameters.unbind(0), strict=True))


def _turn(points: Tensor, angle: Tensor) -> Tensor:
    """Rotate [..., 2] from x towards y."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = points[..., 0], points[..., 1]
    return torch.stack([x * cos - y * sin, x * sin + y * cos], dim=-1)


class TorchTwin:
    """`RayTwin` behind the numpy interface that registration takes (`lightpage.calibration.interfaces.Twin`)."""

    def __init__(self, twin: RayTwin) -> None:
        self.module, self.known = twin, len(NAMES)

    def trace(self, parameters: Real, points: Real, anchors: Real | None = None) -> Rays:
        """See `lightpage.calibration.interfaces.Twin`."""
        decided_by = points if anchors is None else anchors
        return Rays(*self._run(self.module.trace, parameters, points, decided_by))

    def pixels(self, parameters: Real, places: Real) -> Real:
        """See `lightpage.calibration.interfaces.Twin`."""
        (pixels,) = self._run(lambda vector, at: (self.module.pixels(vector, at),), parameters, places)
        return pixels

    @staticmethod
    def _run(asked: Callable[..., tuple[Tensor, ...]], parameters: Real, *inputs: Real) -> tuple[Real, ...]:
        vector = torch.tensor(parameters, dtype=torch.float64)
        tensors = [torch.tensor(array, dtype=torch.float64) for array in inputs]
        with torch.no_grad():
            if vector.ndim == 1:
                outputs = asked(vector, *tensors)
            else:
                of_each = torch.func.vmap(asked, in_dims=(0, *(None for _ in tensors)), chunk_size=_STATES)
                outputs = of_each(vector, *tensors)
        return tuple(output.numpy() for output in outputs)
