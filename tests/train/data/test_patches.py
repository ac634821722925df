"""Patches of pages: the network sees in them what it sees in the page."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from lightpage.errors import InvalidInputError
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.features import PageFeatures, PageState
from lightpage.train.data.patches import Patches, patch_start, training_pages
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import SymbolUNet, reach, with_page_coordinates

SHAPE = (30, 41)
SIDE = 24


def store_of(folder: Path, shape: tuple[int, int]) -> FeatureStore:
    rng = np.random.default_rng(0)

    def make(start: int, shift: tuple[float, float]) -> Iterator[PageFeatures]:
        for page in range(start, 3):
            yield PageFeatures(
                light=rng.standard_normal((2, 1, 4, *shape)).astype(np.float16),
                positions=rng.uniform(-2, 2, (2, *shape)).astype(np.float32),
                phases=(10 * page + rng.random(shape)).astype(np.float32),
                state=PageState((0.0, 0.0), 0.0),
            )

    fill(folder, "key", 3, make, "pages")
    return FeatureStore(folder)


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    return store_of(tmp_path / "features", SHAPE)


@pytest.fixture
def mask() -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[::5, ::3] = True
    return mask


def test_small_pages_are_trained_on_whole(store: FeatureStore, mask: np.ndarray) -> None:
    pages = training_pages([store, store], mask, Hyperparameters(patch=41), 4)
    assert len(pages) == 6  # type: ignore[arg-type]
    light, positions, phases = store[1]
    positions = with_page_coordinates(positions, SHAPE, (slice(None), slice(None)))
    pilots = torch.from_numpy(mask)
    for shown, whole in zip(pages[4], (light, positions, phases.masked_fill(pilots, torch.nan)), strict=True):
        torch.testing.assert_close(shown, whole, rtol=0, atol=0, equal_nan=True)
    wide = training_pages([store], mask, Hyperparameters(patch=40), 4)
    assert wide[0][-1].shape == (30, 40)  # the shorter side is taken whole


def test_a_page_of_few_rows_is_cut_along_its_columns_alone(tmp_path: Path, mask: np.ndarray) -> None:
    rows = 9
    low = store_of(tmp_path / "low", (rows, SHAPE[1]))
    for index in range(6):
        phases = Patches([low], mask[:rows], SIDE, rim=5)[index][-1]
        assert phases.shape == (rows, SIDE)
        assert torch.isfinite(phases).any()


def test_patches_in_which_the_network_sees_no_symbol_whole_are_refused(store: FeatureStore, mask: np.ndarray) -> None:
    with pytest.raises(InvalidInputError, match="at least 11"):
        training_pages([store], mask, Hyperparameters(blocks=2, patch=10), 4)
    rim = reach(1, 1)
    with pytest.raises(InvalidInputError, match=f"at least {2 * rim + 2}"):  # cut to whole steps of two
        training_pages([store], mask, Hyperparameters(blocks=1, depth=1, patch=2 * rim + 1), 4)
    smallest = training_pages([store], mask, Hyperparameters(blocks=1, depth=1, patch=2 * rim + 2), 4)
    assert all(torch.isfinite(smallest[index][-1]).any() for index in range(len(smallest)))  # type: ignore[arg-type]


@pytest.mark.parametrize(("blocks", "depth"), [(1, 0), (2, 0), (1, 1)])
def test_a_network_says_of_a_patch_what_it_says_of_the_page(
    store: FeatureStore, mask: np.ndarray, blocks: int, depth: int
) -> None:
    torch.manual_seed(0)
    network = SymbolUNet(8, channels=8, blocks=blocks, depth=depth)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    patches = training_pages([store], mask, Hyperparameters(blocks=blocks, depth=depth, patch=SIDE), 4)
    assert len(patches) == 3 * 2 * 2  # type: ignore[arg-type]
    asked_at = set()
    for index in [*range(len(patches))] * 2:  # type: ignore[arg-type]
        light, where, phases = patches[index]
        assert SIDE - 1 <= min(phases.shape) <= max(phases.shape) <= SIDE
        whole_light, whole_where, whole_phases = store[index // 4]
        row, column = _found(phases, whole_phases)
        asked = torch.isfinite(phases)
        at = slice(row, row + phases.shape[0]), slice(column, column + phases.shape[1])
        assert not (asked & torch.from_numpy(mask)[at]).any()
        torch.testing.assert_close(phases[asked], whole_phases[at][asked])
        with torch.no_grad():
            part = network.outputs(light[None].float(), where[None])[0]
            page = network.outputs(whole_light[None].float(), whole_where[None])[0]
        torch.testing.assert_close(part[:, asked], page[:, *at][:, asked])
        asked_at |= {(row + int(r), column + int(c)) for r, c in asked.nonzero()}
    rows, columns = ({place[axis] for place in asked_at} for axis in (0, 1))
    assert {0, SHAPE[0] - 1} <= rows  # the page's own edges are learnt from
    assert {0, SHAPE[1] - 1} <= columns


def test_symbols_at_the_edge_are_asked_for_as_often_as_those_in_the_middle() -> None:
    torch.manual_seed(0)
    count, side, often = 225, 96, np.zeros(225)
    for _ in range(4000):
        start = patch_start(count, side, rim=3)
        often[start + 3 * (start > 0) : start + side - 3 * (start + side < count)] += 1
    assert often[[0, -1]] == pytest.approx(often[count // 2], rel=0.15)
    assert often.min() > 0.85 * often[count // 2]
    assert patch_start(96, 96, rim=3) == 0


def _found(phases: torch.Tensor, page: torch.Tensor) -> tuple[int, int]:
    """Return the row and column at which a patch was cut."""
    height, width = phases.shape
    for row in range(SHAPE[0] - height + 1):
        for column in range(SHAPE[1] - width + 1):
            part = page[row : row + height, column : column + width]
            if torch.equal(part[torch.isfinite(phases)], phases[torch.isfinite(phases)]):
                return row, column
    raise AssertionError("no part of the page")


def test_the_loss_counts_what_is_asked(store: FeatureStore, mask: np.ndarray) -> None:
    module = SymbolTraining(SymbolUNet(8, channels=4, blocks=1), Hyperparameters(), mask, 256)
    module.log = lambda *_, **__: None  # type: ignore[method-assign]
    phases = Patches([store], mask, SIDE, rim=3)[0][-1]
    p = torch.randn(1, 2, SIDE, SIDE, requires_grad=True)
    module.loss(p, phases[None]).backward()
    assert p.grad is not None
    assert torch.equal(p.grad.abs().sum((0, 1)) > 0, torch.isfinite(phases))
