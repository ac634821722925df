"""The published decoder's U-Net: it works at sample pitch and comes down to symbol pitch in its head.

Widths, kernels and strides as in Lim, Gladrow et al., supplement S3 and table 1, with strides of 2 where they print 3:
only so do four samples a symbol and axis come down to one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightpage.errors import InvalidInputError

KERNEL = 5
DEPTH = 3
"""Number of times that the U halves its resolution."""
HEAD_STRIDES = {4: (1, 1, 2, 1, 2), 8: (1, 1, 2, 2, 2), 16: (1, 2, 2, 2, 2)}
"""Strides of the convolutions behind the U, by samples per symbol and axis."""
INPUTS = 4
"""Two images and the two grids of positions."""


def samples_for(symbol_size_px: int) -> int:
    """Samples per symbol and axis for symbols of so many modulator pixels: table 1, and the next larger between."""
    return next((count for count in HEAD_STRIDES if symbol_size_px <= count), max(HEAD_STRIDES))


class PublishedUNet(nn.Module):
    """Images at sample pitch to a few numbers for each symbol.

    Args:
        samples: samples per symbol and axis: 4, 8 or 16.
        channels: channels at sample pitch and below it.
        outputs: numbers for each symbol.

    Raises:
        InvalidInputError: another number of samples.
    """

    def __init__(self, samples: int = 4, channels: tuple[int, int] = (32, 64), outputs: int = 2) -> None:
        super().__init__()
        if samples not in HEAD_STRIDES:
            raise InvalidInputError("samples per symbol", samples, f"one of {', '.join(map(str, HEAD_STRIDES))}")
        high, low = channels
        self.first = _convolution(INPUTS, high)
        self.down = nn.ModuleList(_convolution(high if level == 0 else low, low, 2) for level in range(DEPTH))
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(
                low if level == DEPTH - 1 else 2 * low,
                high if level == 0 else low,
                KERNEL,
                stride=2,
                padding=KERNEL // 2,
                output_padding=1,
            )
            for level in reversed(range(DEPTH))
        )
        width, reduced, head = 2 * high, False, []
        for stride in HEAD_STRIDES[samples]:
            reduced = reduced or stride > 1
            head.append(_convolution(width, low if reduced else high, stride))
            width = head[-1].out_channels
        self.head = nn.ModuleList(head)
        self.last = nn.Conv2d(width, outputs, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Images and grids [N, 4, S ny, S nx] to [N, outputs, ny, nx]."""
        x = torch.relu(self.first(images))
        kept = [x]
        for down in self.down:
            x = torch.relu(down(x))
            kept.append(x)
        kept.pop()
        for up in self.up:
            skip = kept.pop()
            raised = torch.relu(up(x))[..., : skip.shape[-2], : skip.shape[-1]]
            x = torch.cat([skip, raised], dim=1)
        for convolution in self.head:
            x = torch.relu(convolution(x))
        return torch.as_tensor(self.last(x))


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, KERNEL, stride=stride, padding=KERNEL // 2)
