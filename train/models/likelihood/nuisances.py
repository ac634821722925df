"""Nuisance parameters of a page: its complex gain, tilt and shift, and what they do to the predicted field.

A vector of six: gain (real and imaginary part), tilt (x, y) of the signal against the reference, radians at the right
and lower edge of the page's image, and shift (x, y) of the image from where the registration has it, camera pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.device.profile import Profile
from lightpage.train.models.parts import Parts, multiply, phasor
from lightpage.waves.grid import FieldGrid

_REACH = 2


class PageNuisances(nn.Module):
    """Gain, tilt and shift of a predicted field, and the gradient by them.

    Args:
        profile: nominal device.
        grid: common grid.
    """

    def __init__(self, profile: Profile, grid: FieldGrid) -> None:
        super().__init__()
        self.samples_per_px = 1 / grid.step_px
        self.x: Tensor
        self.y: Tensor
        for name, axis, half in (("x", grid.x_m, profile.page_width_m), ("y", grid.y_m, profile.page_height_m)):
            self.register_buffer(name, torch.from_numpy(axis / (half / 2)).float(), persistent=False)

    def forward(self, field: Parts, nuisance: Tensor) -> tuple[Parts, Parts]:
        """Apply nuisance parameters [6] to a field [Gy, Gx].

        Returns:
            The field that the cameras should see, and the phasor of its tilt.
        """
        along, down = self._gradient(field)
        shift_x, shift_y = -nuisance[4] * self.samples_per_px, -nuisance[5] * self.samples_per_px
        moved = tuple(part + shift_x * x + shift_y * y for part, x, y in zip(field, along, down, strict=True))
        real, imaginary = multiply((nuisance[0], nuisance[1]), (moved[0], moved[1]))
        tilt = phasor(nuisance[2] * self.x[None, :] + nuisance[3] * self.y[:, None])
        return multiply((real, imaginary), tilt), tilt

    def gradient(self, field: Parts, score: Parts) -> Tensor:
        """Return the derivative of the log-likelihood by the nuisance parameters, [6].

        Derivatives by the gain are those by a relative change of it, and by its phase.

        Args:
            field: predicted field, [Gy, Gx].
            score: derivative of the log-likelihood by the field, [Gy, Gx]; d log L = Re(conj(score) d field).
        """
        same = (field[0] * score[0] + field[1] * score[1]).sum()
        turned = field[0] * score[1] - field[1] * score[0]  # Re(conj(i field) score)
        by_row = turned @ torch.ones_like(self.x)
        tilt_x = (turned.sum(0) * self.x).sum()
        tilt_y = (by_row * self.y).sum()
        along, down = self._gradient(field)
        shifts = [-self.samples_per_px * (part[0] * score[0] + part[1] * score[1]).sum() for part in (along, down)]
        return torch.stack([same, by_row.sum(), tilt_x, tilt_y, *shifts])

    @staticmethod
    def _gradient(field: Parts) -> tuple[Parts, Parts]:
        """Differences of a field along x and y, per grid sample: of fourth order, zero beyond the edges."""
        stacked = functional.pad(torch.stack(field), (_REACH, _REACH, _REACH, _REACH))
        ny, nx = field[0].shape

        def at(down: int, across: int) -> Tensor:
            return stacked[:, _REACH + down : _REACH + down + ny, _REACH + across : _REACH + across + nx]

        along = (8 * (at(0, 1) - at(0, -1)) - (at(0, 2) - at(0, -2))) / 12
        down = (8 * (at(1, 0) - at(-1, 0)) - (at(2, 0) - at(-2, 0))) / 12
        return (along[0], along[1]), (down[0], down[1])
