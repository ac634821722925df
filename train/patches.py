"""Parts of large pages to train on: a step then sees as many symbols as on a small page, from more places and pages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import ConcatDataset, Dataset

from train.feature_store import FeatureStore
from train.fitting import Page
from train.network import with_page_coordinates

_RIM = 4
"""Symbols along a patch's edge that are shown and not asked for: the network would miss their neighbours."""


def training_pages(stores: Sequence[FeatureStore], mask: NDArray[np.bool_], side: int) -> Dataset[Page]:
    """What a network at symbol pitch trains on: whole pages, or patches where they are larger than those.

    Args:
        stores: pages of one shape.
        mask: pilots, bool [ny, nx].
        side: symbols along a patch's edge.
    """
    if max(mask.shape) <= side:
        return ConcatDataset(stores)
    return Patches(stores, mask, side)


class Patches(Dataset[Page]):
    """Patches of pages, at a place drawn anew each time.

    An item is a page's as of `FeatureStore`, cut; its positions also hold column and row on the page (see
    `with_page_coordinates`), and phases that are not to be learnt from are NaN: pilots, and a rim.
    """

    def __init__(self, stores: Sequence[FeatureStore], mask: NDArray[np.bool_], side: int) -> None:
        self._places = [(store, index) for store in stores for index in range(len(store))]
        self._shape = mask.shape
        self._sides = tuple(min(side, count) for count in mask.shape)
        self._mask = torch.from_numpy(mask)
        self._each = int(np.prod([np.ceil(count / side) for count in mask.shape]))

    def __len__(self) -> int:
        """As many as cover all pages."""
        return len(self._places) * self._each

    def __getitem__(self, index: int) -> Page:
        """A patch of page `index // patches of a page`."""
        store, page = self._places[index // self._each]
        # about a symbol that may be any, as far as the page reaches: its edge is seen as often as its middle
        starts = [
            min(max(int(torch.randint(count, ())) - side // 2, 0), count - side)
            for count, side in zip(self._shape, self._sides, strict=True)
        ]
        rows, columns = (slice(start, start + side) for start, side in zip(starts, self._sides, strict=True))
        light, positions, *belief, phases = store.part(page, rows, columns)
        where = with_page_coordinates(positions, self._shape, (rows, columns))
        return light, where, *belief, torch.where(self._asked(rows, columns), phases, torch.nan)

    def _asked(self, rows: slice, columns: slice) -> Tensor:
        """Symbols of a patch that are data and have their neighbours, or the page's edge, around them."""
        asked = ~self._mask[rows, columns]
        for axis, (part, count) in enumerate(zip((rows, columns), self._shape, strict=True)):
            along = asked if axis == 0 else asked.T
            if part.start > 0:
                along[:_RIM] = False
            if part.stop < count:
                along[-_RIM:] = False
        return asked
