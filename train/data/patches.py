"""Pages to train on, and parts of large ones: a step then sees symbols from more places and pages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from lightpage.errors import InvalidInputError
from lightpage.page.crosstalk import of_neighbours
from lightpage.page.levels import Levels
from lightpage.train.data.feature_store import FeatureStore
from lightpage.train.data.pages import Page
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import reach, with_page_coordinates


def training_pages(
    stores: Sequence[FeatureStore], mask: NDArray[np.bool_], choices: Hyperparameters, levels: int | Levels
) -> Dataset[Page]:
    """Return the data set of a network at symbol pitch: whole pages, or patches where pages are larger than those.

    Args:
        stores: pages of one shape.
        mask: pilots, bool [ny, nx].
        choices: say how large patches are, and the network.
        levels: levels of the pages.

    Raises:
        InvalidInputError: patches in which the network would not see the neighbours of a single symbol.
    """
    rim, crosstalk = reach(choices.blocks, choices.depth), Levels.of(levels).crosstalk
    return Patches(stores, mask, choices.patch, rim, 2**choices.depth, crosstalk)


class Patches(Dataset[Page]):
    """Patches of pages, at a place drawn anew each time; whole pages where they are no larger.

    An item is a page's as of `FeatureStore`, cut; its positions also hold column and row on the page (see
    `with_page_coordinates`). Phases are those of the light, crosstalk included; those that are not to be learnt from
    are NaN: pilots, and a rim.

    Args:
        stores, mask: see `training_pages`.
        side: symbols along an edge.
        rim: symbols along a patch's edge that are shown and not asked for: the network misses their neighbours.
        step: places lie on multiples of it, as the network's coarser grids do.
        crosstalk: of the modulator, see `lightpage.page.levels.Levels`.

    Raises:
        InvalidInputError: patches that are all rim.
    """

    def __init__(
        self,
        stores: Sequence[FeatureStore],
        mask: NDArray[np.bool_],
        side: int,
        rim: int,
        step: int = 1,
        crosstalk: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._rim, self._step, self._crosstalk = rim, step, crosstalk
        self._places = [(store, index) for store in stores for index in range(len(store))]
        self._shape = mask.shape
        # the last place lies on the step too
        self._sides = tuple(min(count, side - (side - count) % step) for count in mask.shape)
        if any(own < count and own <= 2 * rim for own, count in zip(self._sides, mask.shape, strict=True)):
            expected = f"at least {2 * rim + step}: more than twice what the network sees"
            raise InvalidInputError("patch", f"{side} symbols", expected)
        self._mask = torch.from_numpy(mask)
        self._each = int(np.prod([np.ceil(count / side) for count in mask.shape]))

    def __len__(self) -> int:
        """Number of patches that cover all pages."""
        return len(self._places) * self._each

    def __getitem__(self, index: int) -> Page:
        """A patch of page `index // patches of a page`."""
        store, page = self._places[index // self._each]
        sizes = zip(self._shape, self._sides, strict=True)
        starts = [patch_start(count, side, self._rim, self._step) for count, side in sizes]
        rows, columns = (slice(start, start + side) for start, side in zip(starts, self._sides, strict=True))
        light, positions, *estimate, phases = store.part(page, rows, columns)
        phases = phases + torch.from_numpy(of_neighbours(phases.numpy(), self._crosstalk)).float()
        where = with_page_coordinates(positions, self._shape, (rows, columns))
        return light, where, *estimate, torch.where(self._asked(rows, columns), phases, torch.nan)

    def _asked(self, rows: slice, columns: slice) -> Tensor:
        """Symbols of a patch that are data and have their neighbours, or the page's edge, around them."""
        asked = ~self._mask[rows, columns]
        for axis, (part, count) in enumerate(zip((rows, columns), self._shape, strict=True)):
            along = asked if axis == 0 else asked.T
            if part.start > 0:
                along[: self._rim] = False
            if part.stop < count:
                along[-self._rim :] = False
        return asked


def patch_start(count: int, side: int, rim: int, step: int = 1) -> int:
    """Draw where a patch begins on an axis, from beyond the page too: its edge is asked for as often as its middle.

    Args:
        count, side: symbols of the page and of the patch.
        rim: symbols at an edge of the patch that are not asked for, unless it is the page's.
        step: a patch begins at multiples of it.
    """
    if side == count:
        return 0
    beyond = max(0, side - 2 * rim - 1)  # an axis shorter than that has one place
    drawn = int(torch.randint(-beyond, count - side + beyond + 1, ()))
    return min(max(drawn, 0), count - side) // step * step
