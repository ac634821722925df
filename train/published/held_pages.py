"""Pages of a simulated device in the memory of what has computed them, for training there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from lightpage.page.levels import Levels
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.recording_job import SYMBOLS
from lightpage.simulator.simulator import Simulator
from lightpage.train.data.features import PageState
from lightpage.train.data.pages import Page


@dataclass(frozen=True)
class MadePages:
    """Pages of random symbols, as a recording of the same device and seed holds them but for the noise.

    Attributes:
        frames: counts of both cameras, [pages, 2, H, W], on the device that has computed them.
        symbols: [pages, ny, nx].
        states: true image shift and piston of each page.
        references: reference-only frames.
        levels: M.
    """

    frames: Tensor
    symbols: NDArray[np.uint8]
    states: list[PageState]
    references: FramePair
    levels: int

    @classmethod
    def of(cls, simulator: Simulator, count: int, progress: Progress) -> MadePages:
        """Simulate pages with a simulator that computes in torch.

        Args:
            simulator: new.
            count: number of pages.
            progress: told of the pages.
        """
        profile, levels, seed = simulator.profile, simulator.levels, simulator.seed
        symbols = np.concatenate(
            [random_symbols(profile, levels, 1, np.random.default_rng([seed, SYMBOLS, n])) for n in range(count)]
        )
        frames: Tensor | None = None
        states = []
        for number, page in enumerate(symbols):
            progress("simulate", number / count)
            seen = simulator.see(page)
            if frames is None:
                frames = seen.frames[0].new_empty((count, 2, *seen.frames[0].shape))
            for camera, frame in enumerate(seen.frames):
                frames[number, camera] = frame
            states.append(PageState(seen.shift_px, seen.piston))
        assert frames is not None
        return cls(frames, symbols, states, simulator.references(), levels)

    def pair(self, page: int) -> FramePair:
        """Return a page's frames in numpy's arrays."""
        return FramePair(*self.frames[page].cpu().numpy())


class HeldPages(Dataset[Page]):
    """Some of the made pages as a published decoder takes them; see `FramePages`.

    Args:
        made: all pages.
        pages: numbers of those to show.
    """

    def __init__(self, made: MadePages, pages: Sequence[int]) -> None:
        self._made, self._pages = made, pages
        self.references, self.levels = made.references, Levels.of(made.levels)
        self.states = [made.states[page] for page in pages]

    def __len__(self) -> int:
        """Pages."""
        return len(self._pages)

    def __getitem__(self, index: int) -> Page:
        """Return a page: frames, state and true phases, where the frames are."""
        frames, state = self._made.frames[self._pages[index]], self.states[index]
        phases = symbol_phases(self._made.symbols[self._pages[index]], self.levels).astype(np.float32)
        known = torch.tensor([*state.shift_px, state.piston_rad], dtype=torch.float32)
        return frames, known.to(frames.device), torch.from_numpy(phases).to(frames.device)
