"""The coherent localizer: every branch sampled where it lands and freed from the phase of its path."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.calibration.interfaces import BRANCHES
from lightpage.device.profile import Profile
from lightpage.waves.grid import FieldGrid, field_grid, symbol_samples

BICUBIC, BILINEAR = "bicubic", "bilinear"


class CoherentLocalizer(nn.Module):
    """Field and sampling table to features at symbol pitch.

    Args:
        profile: the nominal device.
        samples: per symbol and axis; 0 takes as many as the field has, see `symbol_samples`.
        interpolation: interpolation of the field between the grid's samples, `bicubic` or `bilinear`: an error of -32
            or -23 dB on the usual grid.
        grid: the common grid, where it is not the usual one.
    """

    def __init__(
        self, profile: Profile, samples: int = 0, interpolation: str = BICUBIC, grid: FieldGrid | None = None
    ) -> None:
        super().__init__()
        self.interpolation = interpolation
        usual = field_grid(profile)
        own = grid or usual
        self.grid_shape = own.shape
        self._last = tuple(count - 1 for count in usual.shape)
        """Row and column of the usual grid's last sample, in whose units a table's places are."""
        self._span = tuple((count - 1) * own.pitch_m / usual.pitch_m for count in own.shape)
        """Distance from the first to the last sample of its own grid, in the same units; both have the same middle."""
        self.page_shape = profile.page_shape
        self.samples = samples or symbol_samples(profile)
        steps = (torch.arange(self.samples, dtype=torch.float32) + 0.5) / self.samples - 0.5
        self.offset_x: Tensor
        self.offset_y: Tensor
        self.register_buffer("offset_x", steps.repeat(self.samples).reshape(1, -1, 1, 1), persistent=False)
        self.register_buffer("offset_y", steps.repeat_interleave(self.samples).reshape(1, -1, 1, 1), persistent=False)

    @property
    def light_channels(self) -> int:
        """Features that carry light: real parts of all branches' samples, then imaginary parts."""
        return 2 * len(BRANCHES) * self.samples**2

    def forward(self, field: Tensor, places: Tensor, gradients: Tensor, phases: Tensor) -> Tensor:
        """Demodulated samples.

        Args:
            field: [2, Gy, Gx] on the common grid.
            places, gradients, phases: arrays that `lightpage.calibration.sampling_table.sampling_table` makes.

        Returns:
            [2, B, S, ny, nx]: real and imaginary part, S samples of each symbol row by row, over the field's root
            mean square.

        Raises:
            ValueError: a field on another grid.
        """
        if tuple(field.shape[-2:]) != self.grid_shape:
            raise ValueError(f"field: got {tuple(field.shape[-2:])}, wanted the localizer's grid {self.grid_shape}")
        (where, phase), (ny, nx) = self.looks(places, gradients, phases), self.page_shape
        sampled = functional.grid_sample(
            field[None], where, mode=self.interpolation, padding_mode="zeros", align_corners=True
        ).reshape(2, len(BRANCHES), self.samples**2, ny, nx)
        cos, sin = torch.cos(phase), torch.sin(phase)
        scale = torch.rsqrt((field * field).mean() * 2 + 1e-12)
        real = (sampled[0] * cos + sampled[1] * sin) * scale
        imaginary = (sampled[1] * cos - sampled[0] * sin) * scale
        return torch.stack([real, imaginary])

    def looks(self, places: Tensor, gradients: Tensor, phases: Tensor) -> tuple[Tensor, Tensor]:
        """Return the samples' places, [1, B S ny, nx, 2] for grid_sample, and their phases, [B, S, ny, nx] radians."""
        x, y = self.offset_x, self.offset_y
        column = places[:, 0:1] + gradients[:, 0:1] * x + gradients[:, 1:2] * y
        row = places[:, 1:2] + gradients[:, 2:3] * x + gradients[:, 3:4] * y
        value, along_x, along_y, xx, xy, yy = phases.unsqueeze(2).unbind(1)
        phase = value + along_x * x + along_y * y + xx * x * x / 2 + xy * x * y + yy * y * y / 2
        (last_row, last_column), (height, width) = self._last, self._span
        where = torch.stack([(2 * column - last_column) / width, (2 * row - last_row) / height], dim=-1)
        return where.reshape(1, -1, self.page_shape[1], 2), phase
