"""The symbol U-Net, and the separable filter that is plain convolution."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from lightpage.train.models.filters import SeparableFilter
from lightpage.train.models.network import PositionModulation, Refiner, SymbolUNet, estimate


@pytest.mark.parametrize("depth", [0, 1, 2])
def test_it_keeps_the_page_whatever_its_size(depth: int) -> None:
    network = SymbolUNet(7, channels=8, blocks=1, depth=depth)
    assert network(torch.zeros(2, 7, 11, 13), torch.zeros(2, 2, 11, 13)).shape == (2, 2, 11, 13)


def test_a_flat_network_sees_the_neighbours_and_no_further() -> None:
    torch.manual_seed(0)
    network = SymbolUNet(3, channels=8, blocks=2).eval()
    for block in network.bottom:
        torch.nn.init.normal_(block.second.weight, std=0.1)
    torch.nn.init.normal_(network.head.weight)
    x = torch.randn(1, 3, 31, 31, requires_grad=True)
    network(x, torch.zeros(1, 2, 31, 31))[0, 0, 15, 15].backward()
    assert x.grad is not None
    seen = x.grad.abs().sum((0, 1)) > 0
    rows = torch.nonzero(seen.any(1)).ravel()
    # stem 3x3 and two blocks of two 3x3: five rings of neighbours
    assert (int(rows.min()), int(rows.max())) == (10, 20)


def test_the_filter_depends_on_where_a_beam_leaves_the_pipe() -> None:
    torch.manual_seed(0)
    modulation, x = PositionModulation(4), torch.randn(1, 4, 1, 3)
    positions = torch.tensor([0.2, 0.4, 1.2]).expand(1, 2, 1, 3)
    assert torch.equal(modulation(x, positions), x)  # at the start, everywhere the same
    torch.nn.init.normal_(modulation.outer.weight)
    assert not torch.allclose(modulation(x, positions), x)


def test_untrained_it_claims_nothing_and_a_further_pass_leaves_the_estimate() -> None:
    light, positions, earlier = torch.randn(2, 3, 5, 6), torch.rand(2, 2, 5, 6), torch.randn(2, 2, 5, 6)
    assert not SymbolUNet(3, channels=8, blocks=1)(light, positions).any()
    torch.testing.assert_close(Refiner(3, channels=8, blocks=1)(light, positions, earlier), earlier)


def test_outputs_add_to_an_estimate_and_scale_it() -> None:
    before = torch.tensor([3.0, 4.0]).reshape(1, 2, 1, 1)
    more = estimate(torch.tensor([0.03, 0.04, 0.0]).reshape(1, 3, 1, 1), before)
    torch.testing.assert_close(more / before, torch.full_like(before, 2.0))
    scaled = estimate(torch.tensor([0.0, 0.0, 0.2]).reshape(1, 3, 1, 1), before)
    torch.testing.assert_close(scaled / before, torch.full_like(before, math.exp(2)))


@pytest.mark.parametrize(("shape", "taps"), [((1, 16, 32), 1), ((2, 37, 50), 11), ((3, 5, 7), 31)])
def test_it_equals_scipys_convolution_with_zeros_beyond_the_edges(shape: tuple[int, int, int], taps: int) -> None:
    images, half = np.random.default_rng(0).standard_normal(shape), np.random.default_rng(taps).random(taps // 2 + 1)
    kernel = np.concatenate([half[:0:-1], half])
    expected = ndimage.convolve1d(images, kernel, axis=1, mode="constant")
    expected = ndimage.convolve1d(expected, kernel, axis=2, mode="constant")
    got = SeparableFilter(kernel)(torch.tensor(images, dtype=torch.float32)).numpy()
    assert got.shape == shape
    np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())
