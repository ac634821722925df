"""The symbol U-Net."""

from __future__ import annotations

import pytest
import torch

from train.network import SymbolUNet


@pytest.mark.parametrize("levels", [0, 1, 2])
def test_it_keeps_the_page_whatever_its_size(levels: int) -> None:
    network = SymbolUNet(7, channels=8, blocks=1, levels=levels)
    assert network(torch.zeros(2, 7, 11, 13)).shape == (2, 2, 11, 13)


def test_a_flat_network_sees_the_neighbours_and_no_further() -> None:
    torch.manual_seed(0)
    network = SymbolUNet(3, channels=8, blocks=2).eval()
    for block in network.bottom:
        torch.nn.init.normal_(block.second.weight, std=0.1)
    x = torch.randn(1, 3, 31, 31, requires_grad=True)
    network(x)[0, 0, 15, 15].backward()
    assert x.grad is not None
    seen = x.grad.abs().sum((0, 1)) > 0
    rows = torch.nonzero(seen.any(1)).ravel()
    # stem 3x3 and two blocks of two 3x3: five rings of neighbours
    assert (int(rows.min()), int(rows.max())) == (10, 20)
