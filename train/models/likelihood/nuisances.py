"""Nuisance parameters of a page: its complex gain, tilt and shift, and what they do to the light.

A vector of six: gain (real and imaginary part), tilt (x, y) of the signal against the reference, radians at the right
and lower edge of the page's image, and shift (x, y) of the image from where the registration has it, camera pixels.
A shift is a ramp of phase on the pipe's exit facet.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from lightpage.device.profile import Profile
from lightpage.train.models.parts import Parts, multiply, phasor
from lightpage.waves.geometry import WaveGeometry, couplings, on_facet
from lightpage.waves.grid import FieldGrid


class PageNuisances(nn.Module):
    """Gain, tilt and shift of a page's light, and the gradient by them.

    Args:
        profile: nominal device.
        geometry: the device. Nominal geometry is accurate enough for the facet.
        cells: sample intervals of the pipe along (y', x).
        grid: common grid.
    """

    def __init__(self, profile: Profile, geometry: WaveGeometry, cells: tuple[int, int], grid: FieldGrid) -> None:
        super().__init__()
        up, across = ((np.arange(1, count) / count - 0.5) * geometry.pipe_width_m for count in cells)
        radians = 2 * np.pi * profile.image_pixel_m / (geometry.wavelength_m * geometry.focal_length_m)
        to_facet = couplings(geometry)
        by_across = np.stack(np.broadcast_arrays(*on_facet(to_facet, across, np.zeros(1))))
        by_up = np.stack(np.broadcast_arrays(*on_facet(to_facet, np.zeros(1), up)))
        self.x: Tensor
        self.y: Tensor
        self.ramps_across: Tensor
        self.ramps_up: Tensor
        for name, value in {
            "x": grid.x_m / (profile.page_width_m / 2),
            "y": grid.y_m / (profile.page_height_m / 2),
            "ramps_across": -radians * by_across,
            "ramps_up": -radians * by_up,
        }.items():
            self.register_buffer(name, torch.from_numpy(np.array(value)).float(), persistent=False)

    def at_exit(self, nuisance: Tensor) -> Parts:
        """Factor of gain and shift on the light of the exit facet, [fy, fx]."""
        across = phasor(nuisance[4:] @ self.ramps_across)
        up = phasor(nuisance[4:] @ self.ramps_up)
        return _outer(multiply((nuisance[0], nuisance[1]), across), up)

    def tilt(self, nuisance: Tensor, every: int = 1) -> Parts:
        """Phasor of the tilt on every so many samples of the common grid, [Gy, Gx]."""
        return _outer(phasor(nuisance[2] * self.x[::every]), phasor(nuisance[3] * self.y[::every]))

    def gradient(self, leaving: Parts, back: Parts, field: Parts, score: Parts, every: int = 1) -> Tensor:
        """Return the derivative of the log-likelihood by the nuisance parameters, [6].

        Derivatives by the gain are those by a relative change of it, and by its phase.

        Args:
            leaving: light on the exit facet with gain and shift, [fy, fx].
            back: derivative of the log-likelihood by it; d log L = Re(conj(back) d leaving).
            field: predicted field on the common grid, [Gy, Gx].
            score: derivative of the log-likelihood by the field, [Gy, Gx].
            every: distance of the samples of the last two, in samples of the common grid.
        """
        x = self.x[::every]
        y = self.y[::every]
        by_log_gain = (leaving[0] * back[0] + leaving[1] * back[1]).sum()
        turned = _by_phase(leaving, back)
        along_up = turned.sum(1)
        along_across = turned.sum(0)
        shifts = self.ramps_across @ along_across + self.ramps_up @ along_up
        at_camera = _by_phase(field, score)
        tilts = [at_camera.sum(0) @ x, (at_camera @ torch.ones_like(x)) @ y]
        return torch.cat([torch.stack([by_log_gain, along_up.sum(), *tilts]), shifts])


def _outer(across: Parts, up: Parts) -> Parts:
    """Product of phasors along either axis, [n] and [m], over a plane, [m, n]."""
    return multiply((across[0][None, :], across[1][None, :]), (up[0][:, None], up[1][:, None]))


def _by_phase(light: Parts, score: Parts) -> Tensor:
    """Derivative by the phase of light: Re(conj(i light) score)."""
    return light[0] * score[1] - light[1] * score[0]
