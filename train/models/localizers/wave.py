"""The wave localizer: the adjoint of the sheared pipe's simulation, run backwards with fitted parameters."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightpage.device.profile import Profile
from lightpage.train.models.waves import Real, Waves
from lightpage.waves.grid import FieldGrid, symbol_samples


class WaveLocalizer(nn.Module):
    """Runs a field back through camera lens, pipe and launch lens to the SLM.

    Args:
        profile, parameters, grid: see `Waves`.
    """

    def __init__(self, profile: Profile, parameters: Real, grid: FieldGrid | None = None) -> None:
        super().__init__()
        self.waves = Waves(profile, parameters, symbol_samples(profile), grid=grid)

    @property
    def light_channels(self) -> int:
        """Features that carry light: real parts of a symbol's samples, then imaginary parts."""
        return 2 * self.waves.samples**2

    def forward(self, field: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Field to samples of one branch, as the coherent localizer gives those of many.

        Args:
            field: [2, Gy, Gx] on the common grid.
            parameters: [P], of a device that has drifted since.

        Returns:
            [2, 1, S, ny, nx].
        """
        return by_symbol(self.waves.to_page(self.waves.matrices(parameters), field), self.waves.samples)


def by_symbol(page: Tensor, samples: int) -> Tensor:
    """Samples per symbol and axis, [2, ny samples, nx samples], to [2, 1, S, ny, nx], over their root mean square."""
    rows, columns = (count // samples for count in page.shape[-2:])
    page = page * torch.rsqrt(page.square().mean() * 2 + 1e-12)
    split = page.reshape(2, rows, samples, columns, samples).permute(0, 2, 4, 1, 3)
    return split.reshape(2, 1, samples**2, rows, columns)
