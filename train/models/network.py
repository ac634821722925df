"""The decoder network: a U-Net whose finest pitch is that of symbols, not of camera samples."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

_HARMONICS = (0.5, 1.0, 2.0)
"""Turns a pipe width of the exit centroid: zones of even and odd reflections alternate, each has two edges."""
_CONDITIONS = 6 + 4 * len(_HARMONICS)
_CONDITION_WIDTH = 64
_TYPICAL_LOG_KAPPA = 5.0
_KAPPA_UNIT = 100.0
"""Change of p by an output of one: with concentrations in the hundreds, the net need not learn large numbers."""
_LOG_KAPPA_UNIT = 10.0
"""Change of the logarithm of p's length by an output of one: few steps are to make large factors."""
_MOST_LOG_FACTOR = 15.0
"""Largest logarithm of that factor: light unlike any that was trained on shall not make p infinite."""


def with_page_coordinates(positions: Tensor, shape: tuple[int, ...], part: tuple[slice, slice]) -> Tensor:
    """Exit centroids [..., 2, ny, nx] of a part of a page, and its columns and rows from -1 to 1 behind them.

    Args:
        positions: exit centroids.
        shape: shape of the page, rows and columns of symbols.
        part: slices of the page's rows and columns.
    """
    rows, columns = (
        torch.linspace(-1, 1, count, device=positions.device)[some] for count, some in zip(shape, part, strict=True)
    )
    page = torch.stack([columns.expand(len(rows), -1), rows[:, None].expand(-1, len(columns))])
    return torch.cat([positions, page.expand(*positions.shape[:-3], 2, -1, -1)], dim=-3)


class PositionModulation(nn.Module):
    """Scales and shifts each channel by where a symbol lies: feature-wise linear modulation (FiLM).

    The filter that brings a symbol's light together depends on how the walls cut its beam. Behind one convolution, this
    makes a filter for each place; without it, a single one has to serve all.

    Args:
        channels: number of channels of the features.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Conv2d(_CONDITIONS, _CONDITION_WIDTH, 1)
        self.outer = nn.Conv2d(_CONDITION_WIDTH, 2 * channels, 1)
        for value in self.outer.parameters():
            nn.init.zeros_(value)

    def forward(self, x: Tensor, positions: Tensor) -> Tensor:
        """Features [N, C, ny, nx] and exit centroids q, [N, 2, ny, nx] over the pipe's width, to features.

        Of a part of a page, the centroids come `with_page_coordinates`.
        """
        scale, shift = self.of_places(positions)
        return x * scale + shift

    def of_places(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Factor and summand of each channel, [N, C, ny, nx] both."""
        if positions.shape[1] == 2:
            whole = tuple(positions.shape[-2:])
            positions = with_page_coordinates(positions, whole, (slice(None), slice(None)))
        scale, shift = self.outer(functional.gelu(self.inner(self._conditions(positions)))).chunk(2, dim=1)
        return 1 + scale, shift

    @staticmethod
    def _conditions(positions: Tensor) -> Tensor:
        """Column and row on the page from -1 to 1, q, q - round(q) and harmonics of q."""
        centroids, page = positions.chunk(2, dim=1)
        angles = [2 * math.pi * harmonic * centroids for harmonic in _HARMONICS]
        waves = [wave(angle) for angle in angles for wave in (torch.cos, torch.sin)]
        return torch.cat([page, centroids, centroids - torch.round(centroids), *waves], dim=1)


class Residual(nn.Module):
    """Two 3x3 convolutions around the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Map features to features of the same shape [N, C, ny, nx]."""
        inner = self.second(functional.gelu(self.first(functional.gelu(x))))
        return torch.as_tensor(x + inner)


def reach(blocks: int, depth: int) -> int:
    """Rings of neighbours that a `SymbolUNet` of that size sees of a symbol, at most."""
    convolutions = 2 * blocks
    inner = sum((2 * convolutions + 1) << step for step in range(depth))
    return 1 + inner + (convolutions << depth)


def estimate(outputs: Tensor, before: Tensor | float = 0.0) -> Tensor:
    """p of a network's outputs [N, 3, ny, nx]: the first two add to it, the third multiplies it.

    From a page's dark edge to its middle concentration grows a hundredfold: a factor says so more easily than a sum.

    Args:
        outputs: outputs of the network; zeros leave p as it was before.
        before: p of an earlier pass, [N, 2, ny, nx].
    """
    log_factor = torch.clamp(_LOG_KAPPA_UNIT * outputs[:, 2:], max=_MOST_LOG_FACTOR)
    return torch.as_tensor(torch.exp(log_factor) * (before + _KAPPA_UNIT * outputs[:, :2]))


class SymbolUNet(nn.Module):
    """Light at symbol pitch to the vector p of each symbol.

    All samples of a symbol are its channels (pixel-unshuffled), so a 3x3 kernel sees the neighbouring symbols whole.
    Untrained, it claims nothing: p is zero everywhere.

    Args:
        light_channels: real and imaginary parts of a symbol's samples.
        channels: channels at symbol pitch, doubled with each halving of the resolution.
        blocks: residual blocks at each resolution, on the way down and on the way up.
        depth: how often the resolution is halved below symbol pitch; 0 is the flat network.
    """

    def __init__(self, light_channels: int, channels: int = 96, blocks: int = 2, depth: int = 0) -> None:
        super().__init__()
        self.stem = nn.Conv2d(light_channels, channels, 3, padding=1)
        self.where = PositionModulation(channels)
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        self.inward = nn.ModuleList()
        self.outward = nn.ModuleList()
        width = channels
        for _ in range(depth):
            self.inward.append(nn.Sequential(*(Residual(width) for _ in range(blocks))))
            self.down.append(nn.Conv2d(width, 2 * width, 2, stride=2))
            self.up.append(nn.Conv2d(2 * width, width, 1))
            self.outward.append(nn.Sequential(*(Residual(width) for _ in range(blocks))))
            width *= 2
        self.bottom = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.head = nn.Conv2d(channels, 3, 1)
        for value in self.head.parameters():
            nn.init.zeros_(value)

    def forward(self, light: Tensor, positions: Tensor) -> Tensor:
        """Light and exit centroids to p: its angle is the phase, its length kappa.

        Args:
            light: [N, light_channels, ny, nx].
            positions: exit centroids over the pipe's width, [N, 2, ny, nx]; of a part of a page, with coordinates.

        Returns:
            p = (px, py), [N, 2, ny, nx].
        """
        return estimate(self.outputs(light, positions))

    def outputs(self, light: Tensor, positions: Tensor) -> Tensor:
        """Return the outputs that `estimate` turns into p, [N, 3, ny, nx]; light and exit centroids are those for p."""
        return self.behind_places(self.where(self.stem(light), positions))

    def behind_places(self, x: Tensor) -> Tensor:
        """Return the outputs for features that are scaled and shifted by where they lie, [N, C, ny, nx]."""
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


class Refiner(nn.Module):
    """The estimate of an earlier pass, and the light that it leaves unexplained, to a better estimate.

    Unexplained light adds to the natural parameter p of a von Mises density, as any further measurement of the phase
    does. Who to trust is learnt.

    Args:
        light_channels, channels, blocks, depth: see `SymbolUNet`.
    """

    def __init__(self, light_channels: int, channels: int = 96, blocks: int = 2, depth: int = 0) -> None:
        super().__init__()
        self.unet = SymbolUNet(light_channels + 3, channels, blocks, depth)
        self.trust = nn.Parameter(torch.ones(()))

    def forward(self, light: Tensor, positions: Tensor, earlier: Tensor) -> Tensor:
        """Unexplained light, exit centroids and the earlier p, [N, 2, ny, nx], to p: see `SymbolUNet`."""
        known = torch.cat([light, *self.known(earlier)], dim=1)
        return estimate(self.unet.outputs(known, positions), self.trust * earlier)

    @staticmethod
    def known(earlier: Tensor) -> tuple[Tensor, Tensor]:
        """Return the network's input of an earlier p [N, 2, ny, nx]: its direction, and the logarithm of its length."""
        x, y = earlier.chunk(2, 1)
        kappa = torch.sqrt(x * x + y * y + 1e-12)
        return earlier / kappa, torch.log(kappa) - _TYPICAL_LOG_KAPPA
