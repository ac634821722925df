"""Patches of pages: the network sees in them what it sees in the page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import ConcatDataset

from train.feature_store import FeatureStore, fill
from train.features import PageFeatures, PageState
from train.fitting import Hyperparameters, SymbolTraining
from train.network import SymbolUNet
from train.patches import Patches, training_pages

SHAPE = (30, 41)
SIDE = 20


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    rng = np.random.default_rng(0)

    def make(start: int, shift: tuple[float, float]) -> Iterator[PageFeatures]:
        for page in range(start, 3):
            yield PageFeatures(
                light=rng.standard_normal((2, 1, 4, *SHAPE)).astype(np.float16),
                positions=rng.uniform(-2, 2, (2, *SHAPE)).astype(np.float32),
                phases=(10 * page + rng.random(SHAPE)).astype(np.float32),
                state=PageState((0.0, 0.0), 0.0),
            )

    fill(tmp_path / "features", "key", 3, make, "pages")
    return FeatureStore(tmp_path / "features")


@pytest.fixture
def mask() -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[::5, ::3] = True
    return mask


def test_small_pages_are_trained_on_whole(store: FeatureStore, mask: np.ndarray) -> None:
    assert isinstance(training_pages([store], mask, 41), ConcatDataset)
    assert isinstance(training_pages([store], mask, 40), Patches)


def test_a_network_says_of_a_patch_what_it_says_of_the_page(store: FeatureStore, mask: np.ndarray) -> None:
    torch.manual_seed(0)
    network = SymbolUNet(8, channels=8, blocks=1)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    patches = training_pages([store], mask, SIDE)
    assert len(patches) == 3 * 2 * 3  # type: ignore[arg-type]
    asked_at = set()
    for index in range(len(patches)):  # type: ignore[arg-type]
        light, where, phases = patches[index]
        assert phases.shape == (SIDE, SIDE)
        whole_light, whole_where, whole_phases = store[index // 6]
        row, column = _found(phases, whole_phases)
        asked = torch.isfinite(phases)
        at = slice(row, row + SIDE), slice(column, column + SIDE)
        assert not (asked & torch.from_numpy(mask)[at]).any()
        torch.testing.assert_close(phases[asked], whole_phases[at][asked])
        with torch.no_grad():
            part = network(light[None].float(), where[None])[0]
            page = network(whole_light[None].float(), whole_where[None])[0]
        # three convolutions of 3x3: three rings of neighbours
        torch.testing.assert_close(part[:, asked], page[:, *at][:, asked])
        asked_at |= {(row + int(r), column + int(c)) for r, c in asked.nonzero()}
    assert len(asked_at) > 0.7 * (~mask).sum()
    assert {0, SHAPE[0] - 1} & {row for row, _ in asked_at}  # the page's own edge is learnt from


def _found(phases: torch.Tensor, page: torch.Tensor) -> tuple[int, int]:
    """Where a patch was cut."""
    for row in range(SHAPE[0] - SIDE + 1):
        for column in range(SHAPE[1] - SIDE + 1):
            part = page[row : row + SIDE, column : column + SIDE]
            if torch.equal(part[torch.isfinite(phases)], phases[torch.isfinite(phases)]):
                return row, column
    raise AssertionError("no part of the page")


def test_the_loss_counts_what_is_asked(store: FeatureStore, mask: np.ndarray) -> None:
    module = SymbolTraining(SymbolUNet(8, channels=4, blocks=1), Hyperparameters(), mask, 256)
    module.log = lambda *_, **__: None  # type: ignore[method-assign]
    phases = Patches([store], mask, SIDE)[0][-1]
    p = torch.randn(1, 2, SIDE, SIDE, requires_grad=True)
    module.loss(p, phases[None]).backward()
    assert p.grad is not None
    assert torch.equal(p.grad.abs().sum((0, 1)) > 0, torch.isfinite(phases))
