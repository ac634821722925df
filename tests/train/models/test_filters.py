"""Claims about the separable filter: it is plain convolution, whatever the image's size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage, signal

from train.models.filters import SeparableFilter


def symmetric_taps(count: int) -> np.ndarray:
    half = np.random.default_rng(count).standard_normal(count // 2 + 1)
    return np.concatenate([half[:0:-1], half])


@pytest.mark.parametrize("taps", [1, 3, 11, 31])
@pytest.mark.parametrize("shape", [(1, 16, 32), (2, 37, 50), (3, 5, 7), (1, 33, 1)])
def test_it_equals_scipys_convolution_with_zeros_beyond_the_edges(shape: tuple[int, int, int], taps: int) -> None:
    images, kernel = np.random.default_rng(0).standard_normal(shape), symmetric_taps(taps)
    expected = ndimage.convolve1d(images, kernel, axis=1, mode="constant")
    expected = ndimage.convolve1d(expected, kernel, axis=2, mode="constant")
    got = SeparableFilter(kernel)(torch.tensor(images, dtype=torch.float32)).numpy()
    assert got.shape == shape
    np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())


def test_gradients_are_those_of_the_convolution() -> None:
    kernel = symmetric_taps(5)
    images = torch.randn(1, 19, 23, generator=torch.Generator().manual_seed(0), requires_grad=True)
    weights = np.random.default_rng(1).standard_normal((19, 23))
    (SeparableFilter(kernel)(images)[0] * torch.tensor(weights, dtype=torch.float32)).sum().backward()
    assert images.grad is not None
    expected = signal.convolve2d(weights, np.outer(kernel, kernel), mode="same")
    np.testing.assert_allclose(images.grad[0].numpy(), expected, atol=1e-4)
