"""Several recordings of one device as one: a small file that shows their pages one after the other, and copies none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lightpage.errors import RecordingError
from lightpage.failures import os_failure
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
    try:
        with open_hdf5(paths[0], f"recording {paths[0]}") as first, h5py.File(str(out), "w") as file:
            attributes = ("camera_bit_depth", "levels", "black_level", "profile")
            file.attrs.update({"format": FORMAT, "version": VERSION})
            file.attrs.update({name: first.attrs[name] for name in attributes if name in first.attrs})
            for name in (*REFERENCES, _PILOTS):
                if name in first:
                    file.create_dataset(name, data=first[name][()])
            for name in (*FRAMES, _SYMBOLS):
                if name in first:
                    file.create_virtual_dataset(name, _layout(name, paths))  # type: ignore[attr-defined]
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
    """The pages of all recordings behind one another. The stubs of h5py know of no virtual datasets."""
    parts = []
    for path in paths:
        with open_hdf5(path, f"recording {path}") as file:
            parts.append((path, file[name].shape, file[name].dtype))
    shape = (sum(shape[0] for _, shape, _ in parts), *parts[0][1][1:])
    kind = np.result_type(*(kind for _, _, kind in parts))
    layout = h5py.VirtualLayout(shape, kind)  # type: ignore[attr-defined]
    start = 0
    for path, own, kind in parts:
        source = str(path.absolute()).replace("%", "%%")  # or HDF5 looks for a number
        pages = h5py.VirtualSource(source, name, own, kind)  # type: ignore[attr-defined]
        layout[start : start + own[0]] = pages
        start += own[0]
    return layout
