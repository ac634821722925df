"""The branches of many pages, each sampled where it lands: `CoherentLocalizer` with pages for channels."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.train.models.batched.products import PAD, Tables, sizes
from lightpage.train.models.localizers.coherent import CoherentLocalizer
from lightpage.train.models.parts import Parts


class BatchedBranches(nn.Module):
    """Fields to features at symbol pitch.

    Args:
        localizer: which does that for one page.
    """

    def __init__(self, localizer: CoherentLocalizer) -> None:
        super().__init__()
        self.localizer = localizer

    def tables(self, places: Tensor, gradients: Tensor, phases: Tensor) -> Tables:
        """Constants of a sampling table: `where` float32 [1, ..., nx, 2], and phasors [1, B S, ny, nx]."""
        where, phase = self.localizer.looks(places, gradients, phases)
        rows, columns = self.localizer.grid_shape
        # samples beyond the grid make its rows and columns whole multiples, and the span from -1 to 1 longer
        longer = [(count - 1) / (count + -count % PAD - 1) for count in (columns, rows)]
        where = (where + 1) * torch.tensor(longer) - 1
        return {
            "where": where,
            "cos": torch.cos(phase).flatten(0, 1)[None],
            "sin": torch.sin(phase).flatten(0, 1)[None],
        }

    def forward(self, field: Parts, power: Tensor, tables: Tables) -> Tensor:
        """Demodulated samples.

        Args:
            field: E, [B, ny, nx] each of whole multiples.
            power: of it, see `BatchedField.power`.
            tables: constants.

        Returns:
            [B, 2 B S, ny, nx]: real parts, then imaginary parts, over the field's root mean square.
        """
        ny, nx = self.localizer.page_shape
        real, imaginary = (
            functional.grid_sample(
                part[None].to(torch.float32),
                tables["where"],
                mode=self.localizer.interpolation,
                padding_mode="zeros",
                align_corners=True,
            )
            .to(part.dtype)
            .reshape(-1, sizes(tables["cos"])[1], ny, nx)
            for part in field
        )
        scale = torch.rsqrt(2 * power + 1e-12).to(real.dtype)[:, None, None, None]
        cos, sin = tables["cos"], tables["sin"]
        light = torch.cat([real * cos + imaginary * sin, imaginary * cos - real * sin], 1)
        return light * scale
