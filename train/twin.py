"""The differentiable ray twin: where each branch of a page point lands on the cameras, and with what phase.

A collimated beam leaves SLM point (x, y) with transverse wave vector k = -(k0/f)(x, y). Each wall n.r = c that it meets
maps k to k - 2(k.n)n and adds the phase 2(k.n)c + pi; the glass adds (kz - nk0)L; the beam lands at -f k'/k0.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from optics.profile import Profile
from optics.registration.parameters import NAMES
from optics.registration.phases import camera_phase, launch_phase
from optics.registration.twin import BRANCHES, Rays

_WIDEST_SPREAD = 1.05
"""Headroom on the nominal exit centroid when counting how many walls a beam can meet."""


Real = NDArray[np.float64]


class RayTwin(nn.Module):
    """Ray tracer of one nominal device; all that can deviate comes in as `parameters`.

    Computes in float64: phases run to thousands of radians.

    Args:
        profile: the nominal device.
    """

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        self.wave_number = 2 * math.pi / profile.light.wavelength_m
        self.index = profile.pipe.refractive_index
        self.focal_length = profile.lens.focal_length_m
        self.pipe_length = profile.pipe.length_m
        self.pipe_width = profile.pipe.width_m
        self.pipe_angle = math.radians(profile.pipe.angle_deg)
        self.half_width = profile.page_width_m / 2
        self.half_height = profile.page_height_m / 2
        self.corner = profile.corner_m
        self.camera_pitch = profile.camera.pitch_m
        self.camera_centre = ((profile.camera.columns_px - 1) / 2, (profile.camera.rows_px - 1) / 2)
        spread = self.pipe_length / self.focal_length / self.index / self.pipe_width * _WIDEST_SPREAD
        self.walls_met = math.ceil(max(self.half_width, self.half_height) * spread) + 1

    def forward(
        self, parameters: Tensor, points: Tensor, anchors: Tensor, places: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Both questions at once: rays of page points, and pixels of camera-plane places.

        Args:
            parameters: [P] float64.
            points: [N, 2] page points (x, y), metres from the page's centre.
            anchors: [N, 2] points that decide the cells.
            places: [M, 2] camera-plane points, metres.

        Returns:
            places [B, N, 2], phases [B, N], positions [N, 2], pixels [2, M, 2].
        """
        value = dict(zip(NAMES, parameters.unbind(0), strict=True))
        return (*self._trace(value, points, anchors), self._pixels(value, places))

    def _trace(self, value: dict[str, Tensor], points: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        focal = self.focal_length * (1 + value["focal_length_relative"])
        length = self.pipe_length * (1 + value["pipe_length_relative"])
        width = self.pipe_width * (1 + value["pipe_width_relative"])
        angle = self.pipe_angle + value["pipe_angle_rad"]
        roll = value["pipe_roll_rad"]
        centre = torch.stack([value["page_centre_x_m"], value["page_centre_y_m"]])
        wall_offset = torch.stack([value["pipe_centre_x_m"], value["pipe_centre_y_m"]])
        nk = self.index * self.wave_number
        zero, one = torch.zeros_like(angle), torch.ones_like(angle)
        normals = {"x": torch.stack([one, zero]), "y": torch.stack([torch.sin(angle), torch.cos(angle)])}

        def wave_vector(at: Tensor) -> Tensor:
            return -(self.wave_number / focal) * _turn(at + centre, -roll)

        def exit_centroid(k: Tensor) -> Tensor:
            kz = torch.sqrt(nk**2 - (k * k).sum(-1))
            reach = length / width / kz
            return torch.stack([k @ normals["x"] * reach, k @ normals["y"] * reach], dim=-1)

        k = wave_vector(points)
        squared = (k * k).sum(-1)
        glass = -squared / (torch.sqrt(nk**2 - squared) + nk) * length
        launch = glass + launch_phase(value, points[:, 0] / self.corner, points[:, 1] / self.corner)
        cells = exit_centroid(wave_vector(anchors)).detach()
        even = 2 * torch.round(cells / 2)
        odd = 2 * torch.floor(cells / 2) + 1

        landings, phases = [], []
        for branch in BRANCHES:
            crossed = {"x": (odd if "x" in branch else even)[:, 0], "y": (odd if "y" in branch else even)[:, 1]}
            bent, phase = k, launch
            for name in "yx" if branch == "yx" else "xy":
                bent, phase = self._reflect(
                    bent, phase, normals[name], crossed[name], width, wall_offset["xy".index(name)]
                )
            landing = _turn(-(focal / self.wave_number) * bent, roll)
            landings.append(landing)
            x, y = landing[:, 0] / self.corner, landing[:, 1] / self.corner
            edges = self.half_width / self.corner, self.half_height / self.corner
            phases.append(phase + camera_phase(value, x, y, *edges))
        return torch.stack(landings), torch.stack(phases), exit_centroid(k)

    def _reflect(
        self, k: Tensor, phase: Tensor, normal: Tensor, cells: Tensor, width: Tensor, offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Reflect |cells| times on the pair of walls with `normal`, starting with the wall on the cells' side."""
        for met in range(self.walls_met):
            hit = (torch.abs(cells) > met).to(k.dtype)
            wall = torch.sign(cells) * (width / 2) * (-1) ** met + offset
            along = (k @ normal) * hit
            phase = phase + 2 * along * wall + math.pi * hit
            k = k - 2 * along[:, None] * normal
        return k, phase

    def _pixels(self, value: dict[str, Tensor], places: Tensor) -> Tensor:
        radius2 = (places * places).sum(-1, keepdim=True) / self.corner**2
        seen = places * (1 + value["distortion_relative"] * radius2) / self.camera_pitch
        x, y = seen[:, 0], seen[:, 1]
        cameras = []
        for camera in ("in_phase", "quadrature"):
            column = (1 + value[f"{camera}_scale_x_relative"]) * x + value[f"{camera}_turn_xy_slope"] * y
            row = value[f"{camera}_turn_yx_slope"] * x + (1 + value[f"{camera}_scale_y_relative"]) * y
            column = column + value[f"{camera}_shift_x_px"] + self.camera_centre[0]
            row = row + value[f"{camera}_shift_y_px"] + self.camera_centre[1]
            cameras.append(torch.stack([column, row], dim=-1))
        return torch.stack(cameras)


def _turn(points: Tensor, angle: Tensor) -> Tensor:
    """Rotate [N, 2] from x towards y."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = points[:, 0], points[:, 1]
    return torch.stack([x * cos - y * sin, x * sin + y * cos], dim=-1)


class TorchTwin:
    """`RayTwin` behind the numpy interface that registration takes (`optics.registration.twin.Twin`)."""

    def __init__(self, twin: RayTwin) -> None:
        self.module = twin

    def trace(self, parameters: Real, points: Real, anchors: Real | None = None) -> Rays:
        """See `optics.registration.twin.Twin`."""
        decided_by = points if anchors is None else anchors
        places, phases, positions, _ = self._run(parameters, points, decided_by, points[:1])
        return Rays(places, phases, positions)

    def pixels(self, parameters: Real, places: Real) -> Real:
        """See `optics.registration.twin.Twin`."""
        return self._run(parameters, places[:1], places[:1], places)[3]

    def _run(self, parameters: Real, *inputs: Real) -> tuple[Real, ...]:
        vector = torch.tensor(parameters, dtype=torch.float64)
        tensors = [torch.tensor(array, dtype=torch.float64) for array in inputs]
        with torch.no_grad():
            if vector.ndim == 1:
                outputs = self.module(vector, *tensors)
            else:
                outputs = torch.func.vmap(self.module, in_dims=(0, *(None for _ in tensors)))(vector, *tensors)
        return tuple(output.numpy() for output in outputs)
