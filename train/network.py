"""The decoder network: a U-Net whose highest level is the symbol, not the camera sample."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class Residual(nn.Module):
    """Two 3x3 convolutions around the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Same shape [N, C, ny, nx]."""
        inner = self.second(functional.gelu(self.first(functional.gelu(x))))
        return torch.as_tensor(x + inner)


class SymbolUNet(nn.Module):
    """Features at symbol pitch to the vector p of each symbol.

    All samples of a symbol are its channels (pixel-unshuffled), so a 3x3 kernel sees the neighbouring symbols whole.

    Args:
        features: input channels.
        channels: channels at symbol pitch, doubled with each level.
        blocks: residual blocks before and after each level's descent.
        levels: levels below symbol pitch; 0 is the flat network.
    """

    def __init__(self, features: int, channels: int = 96, blocks: int = 2, levels: int = 0) -> None:
        super().__init__()
        self.stem = nn.Conv2d(features, channels, 3, padding=1)
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        self.inward = nn.ModuleList()
        self.outward = nn.ModuleList()
        width = channels
        for _ in range(levels):
            self.inward.append(nn.Sequential(*(Residual(width) for _ in range(blocks))))
            self.down.append(nn.Conv2d(width, 2 * width, 2, stride=2))
            self.up.append(nn.Conv2d(2 * width, width, 1))
            self.outward.append(nn.Sequential(*(Residual(width) for _ in range(blocks))))
            width *= 2
        self.bottom = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.head = nn.Conv2d(channels, 2, 1)

    def forward(self, features: Tensor) -> Tensor:
        """[N, features, ny, nx] to p = (px, py), [N, 2, ny, nx]: its angle is the phase, its length kappa."""
        x = self.stem(features)
        kept = []
        for inward, down in zip(self.inward, self.down, strict=True):
            x = inward(x)
            kept.append(x)
            height, width = x.shape[-2:]
            x = down(functional.pad(x, (0, width % 2, 0, height % 2)))
        x = self.bottom(x)
        for up, outward, skip in zip(reversed(self.up), reversed(self.outward), reversed(kept), strict=True):
            raised = functional.interpolate(up(x), scale_factor=2.0, mode="nearest")
            x = outward(skip + raised[..., : skip.shape[-2], : skip.shape[-1]])
        return torch.as_tensor(self.head(functional.gelu(x)))
