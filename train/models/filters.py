"""Separable convolution of images with one kernel, in a form that both torch and ONNX Runtime run fast."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

_BLOCK = 16
"""Outputs computed together. A strided convolution with that many filters is a matrix product: in ONNX Runtime twice
as fast as a depthwise convolution with 31 taps, and in torch several times."""


class SeparableFilter(nn.Module):
    """Convolve [C, H, W] with the same odd, symmetric taps along both axes, zeros beyond the edges.

    Args:
        taps: [K].
    """

    def __init__(self, taps: NDArray[np.float64]) -> None:
        super().__init__()
        self.reach = len(taps) // 2
        weights = np.zeros((_BLOCK, _BLOCK + len(taps) - 1))
        for output in range(_BLOCK):
            weights[output, output : output + len(taps)] = taps
        self.weights: Tensor
        self.register_buffer("weights", torch.tensor(weights, dtype=torch.float32)[:, None])

    def forward(self, images: Tensor) -> Tensor:
        """Filtered images [C, H, W]."""
        return self._along_rows(self._along_columns(images))

    def _along_columns(self, images: Tensor) -> Tensor:
        channels, height, width = images.shape
        blocks = -(-width // _BLOCK)
        padded = functional.pad(images, (self.reach, blocks * _BLOCK - width + self.reach))[:, None]
        split = functional.conv2d(padded, self.weights[:, :, None, :], stride=(1, _BLOCK))
        return split.permute(0, 2, 3, 1).reshape(channels, height, blocks * _BLOCK)[:, :, :width]

    def _along_rows(self, images: Tensor) -> Tensor:
        channels, height, width = images.shape
        blocks = -(-height // _BLOCK)
        padded = functional.pad(images, (0, 0, self.reach, blocks * _BLOCK - height + self.reach))[:, None]
        split = functional.conv2d(padded, self.weights[:, :, :, None], stride=(_BLOCK, 1))
        return split.permute(0, 2, 1, 3).reshape(channels, blocks * _BLOCK, width)[:, :height]
