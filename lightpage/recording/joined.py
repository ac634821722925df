"""Pages of other recordings as one recording: a small file that shows their frames, and copies none.

It shows the pages of several recordings one after the other, or some pages of one with symbols of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import RecordingError
from lightpage.failures import os_failure
from lightpage.files import move_into_place
from lightpage.recording.hdf5 import open_hdf5
from lightpage.recording.layout import FORMAT, FRAMES, REFERENCES, VERSION
from lightpage.recording.reader import Recording

_SYMBOLS, _PILOTS = "symbols", "pilots"


def join(paths: Sequence[Path], out: Path) -> None:
    """Write a recording whose pages are those of others, in their order; the reference frames are the first one's.

    It holds no frames of pages, so the others must stay where they are.

    Args:
        paths: of the recordings, at least one.
        out: the new file; one that is there is replaced.

    Raises:
        RecordingError: one cannot be read, or differs from the first in more than its pages.
    """
    kinds = [_kind(path) for path in paths]
    for path, kind in zip(paths, kinds, strict=True):
        for name, value in kind.items():
            if value != kinds[0][name]:
                raise RecordingError(f"recording {path}: {name}", value, f"{kinds[0][name]}, as {paths[0]} has")
    with _begun(paths[0], out) as (first, file):
        for name in (*FRAMES, _SYMBOLS):
            if name in first:
                file.create_virtual_dataset(name, _layout(name, paths))


def show_known(path: Path, symbols: Mapping[int, NDArray[np.uint8]], levels: int, out: Path) -> None:
    """Write a recording of those pages of another whose symbols were found.

    It holds no frames of pages, so the other must stay where it is.

    Args:
        path: of the other recording.
        symbols: of its pages, [ny, nx] each, by their numbers; of one page at least.
        levels: M of the symbols.
        out: the new file; one that is there is replaced.

    Raises:
        RecordingError: the other cannot be read, or the file cannot be written.
    """
    partial = out.with_name(f"{out.name}.partial")
    try:
        with _begun(path, partial) as (first, file):
            file.attrs["levels"] = levels
            file.create_dataset(_SYMBOLS, data=np.stack([symbols[page] for page in sorted(symbols)]))
            for name in FRAMES:
                file.create_virtual_dataset(name, _some(path, first[name], sorted(symbols)))
        move_into_place(partial, out)
    except OSError as error:
        raise os_failure(f"recording {out}", error, "a file that can be written", RecordingError) from None
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def _begun(path: Path, out: Path) -> Iterator[tuple[h5py.File, Any]]:
    """Yield a recording, and a new file that has all of it but its pages; the stubs know of no virtual datasets there.

    Raises:
        RecordingError: see `show_known`.
    """
    try:
        with open_hdf5(path, f"recording {path}") as first, h5py.File(str(out), "w") as file:
            attributes = ("camera_bit_depth", "levels", "black_level", "profile")
            file.attrs.update({"format": FORMAT, "version": VERSION})
            file.attrs.update({name: first.attrs[name] for name in attributes if name in first.attrs})
            for name in (*REFERENCES, _PILOTS):
                if name in first:
                    file.create_dataset(name, data=first[name][()])
            yield first, file
    except OSError as error:
        raise os_failure(f"recording {out}", error, "a file that can be written", RecordingError) from None


def _kind(path: Path) -> dict[str, Any]:
    """Return what recordings must have in common, in words."""
    with Recording.open(path) as recording:
        pilots = recording.pilots()
        return {
            "frames": recording.frame_shape,
            "page": recording.page_shape,
            "bit depth": recording.bit_depth,
            "levels": recording.levels,
            "black level": recording.header.black_level,
            "symbols": "known" if recording.has_symbols else "unknown",
            "pilots": "those of the profile" if pilots is None else np.flatnonzero(pilots).tolist(),
        }


def _layout(name: str, paths: Sequence[Path]) -> Any:
    """The pages of all recordings behind one another."""
    parts = []
    for path in paths:
        with open_hdf5(path, f"recording {path}") as file:
            parts.append((path, file[name].shape, file[name].dtype))
    shape = (sum(shape[0] for _, shape, _ in parts), *parts[0][1][1:])
    kind = np.result_type(*(kind for _, _, kind in parts))
    layout = h5py.VirtualLayout(shape, kind)  # type: ignore[attr-defined]
    start = 0
    for path, own, kind in parts:
        layout[start : start + own[0]] = _source(path, name, own, kind)
        start += own[0]
    return layout


def _some(path: Path, dataset: Any, pages: Sequence[int]) -> Any:
    """Some pages of a recording, in ascending order."""
    layout = h5py.VirtualLayout((len(pages), *dataset.shape[1:]), dataset.dtype)  # type: ignore[attr-defined]
    source = _source(path, dataset.name.lstrip("/"), dataset.shape, dataset.dtype)
    for _, run in groupby(enumerate(pages), lambda one: one[1] - one[0]):
        (start, first), *rest = run
        count = 1 + len(rest)
        layout[start : start + count] = source[first : first + count]
    return layout


def _source(path: Path, name: str, shape: tuple[int, ...], kind: np.dtype[Any]) -> Any:
    """A dataset of a recording, to be shown."""
    told = str(path.absolute()).replace("%", "%%")  # or HDF5 looks for a number
    return h5py.VirtualSource(told, name, shape, kind)  # type: ignore[attr-defined]
