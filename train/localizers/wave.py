"""The wave localizer: the adjoint of the sheared pipe's simulation, run backwards with fitted parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from optics.grid import field_grid
from optics.profile import Profile
from optics.registration.parameters import as_dict
from optics.registration.phases import camera_phase, launch_phase
from optics.waves import WaveChannel, WaveGeometry, modes_for
from train.localizers.coherent import SAMPLES

Real = NDArray[np.float64]

_STEPS = 24
"""Splitting steps; more change the result by less than the fit's own error."""
_REACH = 1.08
"""Modes beyond the nominal page's edge: page shift, roll and shear."""


class WaveLocalizer:
    """Runs the recovered field back through camera lens, pipe and launch lens to the SLM.

    Args:
        profile: the nominal device.
        parameters: [P] fitted (or, for an oracle, true) parameters of the ray twin; the wave model is made from them.
    """

    def __init__(self, profile: Profile, parameters: Real) -> None:
        value = as_dict(parameters)
        geometry = WaveGeometry(
            wavelength_m=profile.light.wavelength_m,
            focal_length_m=profile.lens.focal_length_m * (1 + value["focal_length_relative"]),
            pipe_length_m=profile.pipe.length_m * (1 + value["pipe_length_relative"]),
            pipe_width_m=profile.pipe.width_m * (1 + value["pipe_width_relative"]),
            refractive_index=profile.pipe.refractive_index,
            pipe_angle=np.deg2rad(profile.pipe.angle_deg) + value["pipe_angle_rad"],
            pipe_roll=value["pipe_roll_rad"],
        )
        grid = field_grid(profile)
        rows, columns = profile.page_shape
        pitch = profile.symbol_pitch_m / SAMPLES
        x = (np.arange(columns * SAMPLES) - (columns * SAMPLES - 1) / 2) * pitch
        y = (np.arange(rows * SAMPLES) - (rows * SAMPLES - 1) / 2) * pitch
        half_x, half_y = profile.page_width_m / 2 * _REACH, profile.page_height_m / 2 * _REACH
        self._channel = WaveChannel(
            geometry,
            x + value["page_centre_x_m"],
            y + value["page_centre_y_m"],
            grid.x_m,
            grid.y_m,
            cells=(modes_for(half_y, geometry), modes_for(half_x, geometry)),
            steps=_STEPS,
        )
        self._shape = (rows, columns)
        half_width, half_height = profile.page_width_m / 2, profile.page_height_m / 2
        corner = np.hypot(half_width, half_height)
        self._camera_phase = camera_phase(
            value, grid.x_m[None, :] / corner, grid.y_m[:, None] / corner, half_width / corner, half_height / corner
        )
        self._launch_phase = launch_phase(value, x[None, :] / corner, y[:, None] / corner)
        offset = geometry.wave_number / geometry.focal_length_m
        facet_ramp = offset * (value["pipe_centre_x_m"] * x[None, :] + value["pipe_centre_y_m"] * y[:, None])
        camera_ramp = offset * (
            value["pipe_centre_x_m"] * grid.x_m[None, :] + value["pipe_centre_y_m"] * grid.y_m[:, None]
        )
        self._launch_phase = self._launch_phase - facet_ramp
        self._camera_phase = self._camera_phase + camera_ramp

    def __call__(self, field: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Field [Gy, Gx] to samples [2, 1, S, ny, nx], as the coherent localizer gives them with a single branch."""
        at_slm = self._channel.adjoint(field * np.exp(-1j * self._camera_phase)) * np.exp(-1j * self._launch_phase)
        at_slm = at_slm / np.sqrt(np.mean(np.abs(at_slm) ** 2) + 1e-12)
        rows, columns = self._shape
        split = at_slm.reshape(rows, SAMPLES, columns, SAMPLES).transpose(1, 3, 0, 2).reshape(1, -1, rows, columns)
        return np.stack([split.real, split.imag]).astype(np.float32)
