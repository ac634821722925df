"""Weights of kept decoders: what rounding changes, and what is read again."""

from pathlib import Path

import numpy as np
import pytest
import torch

from analysis.comparison.kept_weights import LARGE, MOST_MOVED_BITS, moved_bits, read_weights, steps, write_weights
from lightpage.train.data.pages import Page
from lightpage.train.fitting.concentration_scale import decode_pages
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import SymbolUNet

SHAPE, CHANNELS = (12, 16), 16


def decoder() -> SymbolTraining:
    """A decoder that claims something of every symbol, a concentration of some tens."""
    torch.manual_seed(5)
    module = SymbolTraining(SymbolUNet(4, CHANNELS), Hyperparameters(), np.zeros(SHAPE, bool), 256)
    for value in module.network.parameters():
        torch.nn.init.normal_(value, std=0.1)
    return module.eval()


class Pages(torch.utils.data.Dataset[Page]):
    """Random light."""

    def __init__(self, count: int, seed: int) -> None:
        self._count, self._random = count, torch.Generator().manual_seed(seed)
        self._pages = [self._page() for _ in range(count)]

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Page:
        if index >= self._count:
            raise IndexError(index)
        return self._pages[index]

    def _page(self) -> Page:
        light, positions = (torch.randn(count, *SHAPE, generator=self._random) for count in (4, 2))
        return light.half(), positions, torch.zeros(SHAPE)


def test_kept_weights_say_the_same_to_the_fourth_digit_in_less_than_half_precision(tmp_path: Path) -> None:
    module = decoder()
    weights = {name: value.clone() for name, value in module.network.state_dict().items()}
    write_weights(tmp_path / "kept", weights, steps(module, Pages(2, seed=1)))
    assert all(torch.equal(value, weights[name]) for name, value in module.network.state_dict().items())
    kept = read_weights(tmp_path / "kept")
    assert {name: value.shape for name, value in kept.items()} == {name: v.shape for name, v in weights.items()}
    large = {name for name, value in weights.items() if value.numel() >= LARGE}
    assert {name for name in weights if not torch.equal(kept[name], weights[name])} == large
    unseen = Pages(4, seed=2)
    before = decode_pages(module, unseen)[0]
    module.network.load_state_dict(kept)
    # other pages of the same kind: their mean differs by some of its standard errors
    assert 0.2 * MOST_MOVED_BITS < moved_bits(before, decode_pages(module, unseen)[0]) < 2 * MOST_MOVED_BITS
    assert (tmp_path / "kept").stat().st_size < sum(2 * value.numel() for value in weights.values())


def test_what_is_said_moves_by_the_relative_entropy() -> None:
    said = np.array([4.0, -3.0]).reshape(1, 2, 1, 1)
    theta = np.linspace(-np.pi, np.pi, 4000, endpoint=False)

    def log_density(p: np.ndarray) -> np.ndarray:
        log = p[0, 0] * np.cos(theta) + p[0, 1] * np.sin(theta)
        return np.asarray((log - np.log(np.exp(log).sum()))[0])

    now = np.array([1.0, 2.0]).reshape(1, 2, 1, 1)
    before, after = log_density(said), log_density(now)
    assert moved_bits(said, now) == pytest.approx(np.sum(np.exp(before) * (before - after)) / np.log(2), rel=1e-6)
    assert moved_bits(said, said) == 0
