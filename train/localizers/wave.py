"""The wave localizer: the adjoint of the sheared pipe's simulation, run backwards with fitted parameters."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from optics.profile import Profile
from train.localizers.coherent import SAMPLES
from train.waves import Real, Waves


class WaveLocalizer(nn.Module):
    """Runs a field back through camera lens, pipe and launch lens to the SLM.

    Args:
        profile, parameters: as for `Waves`.
    """

    def __init__(self, profile: Profile, parameters: Real) -> None:
        super().__init__()
        self.page_shape = profile.page_shape
        self.waves = Waves(profile, parameters)

    @property
    def light_channels(self) -> int:
        """Features that carry light: real parts of a symbol's samples, then imaginary parts."""
        return 2 * SAMPLES**2

    def forward(self, field: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Field to samples of one branch, as the coherent localizer gives those of many.

        Args:
            field: [2, Gy, Gx] on the common grid.
            parameters: [P], of a device that has drifted since.

        Returns:
            [2, 1, S, ny, nx].
        """
        return by_symbol(self.waves.to_page(self.waves.matrices(parameters), field), self.page_shape)


def by_symbol(page: Tensor, page_shape: tuple[int, int]) -> Tensor:
    """Samples on the modulator [2, ny SAMPLES, nx SAMPLES] to [2, 1, S, ny, nx], over their root mean square."""
    rows, columns = page_shape
    page = page * torch.rsqrt(page.square().mean() * 2 + 1e-12)
    split = page.reshape(2, rows, SAMPLES, columns, SAMPLES).permute(0, 2, 4, 1, 3)
    return split.reshape(2, 1, SAMPLES**2, rows, columns)
