"""Page features on disk, kept page by page: interrupted work goes on where it was, and training reads what it needs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from torch.utils.data import Dataset

from lightpage.failures import os_failure
from lightpage.files import replace_text, reserve
from lightpage.progress import track
from lightpage.train.data.features import PageFeatures, PageState
from lightpage.train.data.pages import Page
from lightpage.train.processes import is_first_process, wait_for_first

_STATE = "state.json"
_FILES = {"light": "light", "positions": "positions", "estimate": "belief", "phases": "phases"}
"""Files of the arrays of `PageFeatures`, in the order in which a page's item has them.

The file of estimates keeps its earlier name, so that what an earlier version has made is gone on with."""
_PAGE_STATE = "page_states"

Maker = Callable[[int, tuple[float, float]], Iterator[PageFeatures]]
"""Makes the features from a page number on; told of the shift of the page before it."""


class FeatureStore(Dataset[Page]):
    """Pages of features in a folder, as arrays that are mapped and not loaded.

    An item is a page's light [2 C, ny, nx] float16, positions [2, ny, nx], the estimate p of an earlier pass
    [2, ny, nx] if there was one, and true phases [ny, nx].

    Args:
        folder: folder of arrays that `fill` has completed.
        pages: numbers of the pages to show, all if left out.
    """

    def __init__(self, folder: Path, pages: range | None = None) -> None:
        names = [name for name in _FILES.values() if (folder / f"{name}.npy").exists()]
        self._arrays = [np.load(folder / f"{name}.npy", mmap_mode="r") for name in names]
        self._states = np.load(folder / f"{_PAGE_STATE}.npy", mmap_mode="r")
        self._pages = range(len(self._states)) if pages is None else pages

    def __len__(self) -> int:
        """Pages."""
        return len(self._pages)

    def __getitem__(self, index: int) -> Page:
        """Return a whole page."""
        return self.part(index, slice(None), slice(None))

    def part(self, index: int, rows: slice, columns: slice) -> Page:
        """Read some rows and columns of a page, and nothing more."""
        number = self._pages[index]
        light, *others = (torch.from_numpy(np.array(array[number][..., rows, columns])) for array in self._arrays)
        return light.flatten(0, -3), *others

    def state(self, index: int) -> PageState:
        """Image shift and piston that were taken off a page."""
        x, y, piston = map(float, self._states[self._pages[index]])
        return PageState((x, y), piston)


def fill(folder: Path, key: str, count: int, make: Maker, what: str) -> float:
    """Make the features of `count` pages and keep them in `folder`, or go on with those that are there.

    Of several processes the first makes them, and the others wait.

    Returns:
        Seconds that it took, all stretches together.

    Args:
        folder: made if missing; what it holds under another key is made anew.
        key: everything that the features depend on.
        count: pages.
        make: makes them, from a page on.
        what: name of the work, for the progress bar.

    Raises:
        LightpageError: the folder cannot be written or has no room, or the first process has made no page for half an
            hour.
    """
    key = f"{count} pages {key}"
    with _told(folder):
        folder.mkdir(parents=True, exist_ok=True)
    if not is_first_process():
        wait_for_first(lambda: _kept(folder, key)[0], count, f"features in {folder}")
    done, shift, before = _kept(folder, key)
    if done >= count:
        return before
    start, seconds = time.monotonic() - before, before
    if done == 0:
        (folder / _STATE).unlink(missing_ok=True)  # before its arrays are
        for old in folder.glob("*.npy"):
            old.unlink()
    arrays: dict[str, np.memmap[Any, Any]] = {}
    with torch.inference_mode():
        pages = track(make(done, shift), what, total=count, done=done)
        for number, page in zip(range(done, count), pages, strict=False):
            values = {file: getattr(page, name) for name, file in _FILES.items()}
            values[_PAGE_STATE] = np.array([*page.state.shift_px, page.state.piston_rad])
            for name, value in values.items():
                if value is None:
                    continue
                if name not in arrays:
                    with _told(folder):
                        arrays[name] = _opened(folder / f"{name}.npy", None if number else (count, *value.shape), value)
                arrays[name][number] = value
                arrays[name].flush()
            seconds = time.monotonic() - start
            state = {"key": key, "done": number + 1, "shift_px": page.state.shift_px, "seconds": seconds}
            replace_text(folder / _STATE, json.dumps(state), "state of the features")
    return seconds


def _opened(path: Path, new: tuple[int, ...] | None, like: NDArray[Any]) -> np.memmap[Any, Any]:
    """An array in a file that is mapped: the one that is there, or a `new` one of this shape and the type of `like`."""
    if new is None:
        return open_memmap(path, "r+")
    array = open_memmap(path, "w+", dtype=like.dtype, shape=new)
    reserve(path)
    return array


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        expected = "a folder that can be written, on a file system that maps files into memory"
        raise os_failure(f"features in {folder}", error, expected) from None


def _kept(folder: Path, key: str) -> tuple[int, tuple[float, float], float]:
    """Pages that an earlier call completed under the same key, the last one's shift, and the seconds that they took."""
    try:
        state = json.loads((folder / _STATE).read_text("utf-8"))
        if state["key"] == key:
            shift = float(state["shift_px"][0]), float(state["shift_px"][1])
            return int(state["done"]), shift, float(state["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return 0, (0.0, 0.0), 0.0
