"""The published U-Net: what it sees, what it costs, what comes out."""

from __future__ import annotations

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lightpage.errors import InvalidInputError
from train.published.unet import HEAD_STRIDES, PublishedUNet, samples_for


@pytest.mark.parametrize("samples", HEAD_STRIDES)
@pytest.mark.parametrize("page", [(7, 11), (8, 12)])
def test_each_symbol_gets_its_numbers_whatever_the_page(samples: int, page: tuple[int, int]) -> None:
    network = PublishedUNet(samples, (4, 8), outputs=3)
    assert network(torch.zeros(2, 4, samples * page[0], samples * page[1])).shape == (2, 3, *page)


def test_table_1_of_samples_and_no_others() -> None:
    assert [samples_for(size) for size in (2, 4, 8, 16)] == [4, 4, 8, 16]
    with pytest.raises(InvalidInputError, match="4, 8, 16"):
        PublishedUNet(5)


@pytest.mark.parametrize(("channels", "megaflops"), [((16, 32), 1.5), ((32, 64), 5.9), ((64, 128), 23.6)])
def test_what_a_symbol_costs(channels: tuple[int, int], megaflops: float) -> None:
    rows, columns = 16, 24
    with FlopCounterMode(display=False) as counter:
        PublishedUNet(4, channels)(torch.zeros(1, 4, 4 * rows, 4 * columns))
    assert counter.get_total_flops() / rows / columns / 1e6 == pytest.approx(megaflops, rel=0.02)
