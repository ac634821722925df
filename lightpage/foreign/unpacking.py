"""Frames and symbols of a recording as files that other programs read, written page by page."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from PIL import Image

from lightpage.failures import os_errors
from lightpage.progress import track
from lightpage.recording.layout import FRAMES, REFERENCES
from lightpage.recording.reader import Recording

_MATLAB = b"MATLAB 7.3 MAT-file, written by lightpage"
_USER_BLOCK = 512
Add = Callable[[NDArray[Any]], object]
Opener = Callable[[Path, str, int, NDArray[Any]], AbstractContextManager[Add]]
"""Opens what takes so many arrays like the last argument, one after another, in a folder, under a name."""


class Form(StrEnum):
    """Kind of the files."""

    TIFF = "tiff"
    NPY = "npy"
    PNG = "png"
    MAT = "mat"
    HDF5 = "hdf5"


def unpack(recording: Recording, form: Form, out: Path) -> dict[str, str]:
    """Write the frames, the reference frames and, where they are known, the symbols of a recording, and its code.

    Frames are free of their black level, as they are read everywhere. The folder appears when it is complete.

    Args:
        recording: what is written.
        form: of its files.
        out: a folder that is not there.

    Returns:
        The options by which `lightpage import` takes the files back, and their values.

    Raises:
        InvalidInputError: the folder cannot be written.
        ModuleNotFoundError: what writes the files is not installed.
        RecordingError, StorageError, SurroundingsError: a page cannot be read, or there is no room.
    """
    with os_errors(f"--out {out}", "a folder that can be made"):
        made = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.absolute().parent))
        try:
            options = _write(recording, form, made)
            made.chmod(0o777 & ~_umask())
            os.rename(made, out)
        except BaseException:
            shutil.rmtree(made, ignore_errors=True)
            raise
    return {f"--{option.replace('_', '-')}": str(out / name) for option, name in options}


def _write(recording: Recording, form: Form, folder: Path) -> list[tuple[str, str]]:
    opener, ending = _OPENERS[form], _ENDINGS[form]
    array, array_ending = (_npy, ".npy") if form in (Form.TIFF, Form.PNG) else (opener, ending)
    first, references = recording.frames(0), recording.references()
    options = []
    with ExitStack() as opened:
        adders: list[Add] = []
        for name, like in zip(FRAMES, (first.in_phase, first.quadrature), strict=True):
            adders.append(opened.enter_context(opener(folder, name, recording.pages, like)))
            options.append((name, f"{name}{ending}"))
        if (symbols := recording.symbols(0)) is not None:
            adders.append(opened.enter_context(array(folder, "symbols", recording.pages, symbols)))
            options.append(("symbols", f"symbols{array_ending}"))
        for page in track(range(recording.pages), "unpack"):
            pair, symbols = recording.shown(page)
            parts = [pair.in_phase, pair.quadrature, *([] if symbols is None else [symbols])]
            for add, part in zip(adders, parts, strict=True):
                add(part)
    for name, frame in zip(REFERENCES, (references.in_phase, references.quadrature), strict=True):
        with opener(folder, name, 1, frame) as add:
            add(frame)
        options.append((name, f"{name}{ending}"))
    if (pilots := recording.pilots()) is not None:
        with array(folder, "pilots", 1, pilots.astype(np.uint8)) as add:
            add(pilots.astype(np.uint8))
        options.append(("pilots", f"pilots{array_ending}"))
    header = recording.header
    texts = {"profile": ("profile.toml", header.profile_text), "code": ("code.json", header.code_text)}
    for option, (name, text) in texts.items():
        if text is not None:
            (folder / name).write_text(text, "utf-8")
            options.append((option, name))
    return options


@contextmanager
def _tiff(folder: Path, name: str, count: int, like: NDArray[Any]) -> Iterator[Add]:
    import tifffile

    large = count * like.nbytes > 1 << 31
    with tifffile.TiffWriter(folder / f"{name}.tif", bigtiff=large) as file:
        yield partial(file.write, photometric="minisblack", metadata=None)


@contextmanager
def _npy(folder: Path, name: str, count: int, like: NDArray[Any]) -> Iterator[Add]:
    with (folder / f"{name}.npy").open("wb") as file:
        descr = npy.dtype_to_descr(like.dtype)
        header = {"descr": descr, "fortran_order": False, "shape": (count, *like.shape)}
        npy.write_array_header_2_0(file, header)
        yield lambda part: file.write(np.ascontiguousarray(part).tobytes())


@contextmanager
def _png(folder: Path, name: str, count: int, like: NDArray[Any]) -> Iterator[Add]:
    (folder / name).mkdir()
    digits, written = max(4, math.ceil(math.log10(count + 1))), 0

    def add(part: NDArray[Any]) -> None:
        nonlocal written
        Image.fromarray(part).save(folder / name / f"{written:0{digits}d}.png")
        written += 1

    yield add


@contextmanager
def _hdf5(folder: Path, name: str, count: int, like: NDArray[Any], *, matlab: bool = False) -> Iterator[Add]:
    """Open an HDF5 file of one array; MATLAB has its axes in the other order, and a header before the file."""
    shape = like.shape[::-1] if matlab else like.shape
    written = 0
    path = folder / f"{name}{'.mat' if matlab else '.h5'}"
    with h5py.File(str(path), "w", userblock_size=_USER_BLOCK if matlab else 0) as file:
        dataset = file.create_dataset(name, (count, *shape), like.dtype, chunks=(1, *shape))
        if matlab:
            dataset.attrs["MATLAB_class"] = np.bytes_(like.dtype.name)

        def add(part: NDArray[Any]) -> None:
            nonlocal written
            dataset[written] = part.T if matlab else part
            written += 1

        yield add
    if matlab:
        with path.open("r+b") as raw:
            raw.write(_MATLAB.ljust(124) + b"\x00\x02IM")  # version 2, little-endian


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_OPENERS: dict[Form, Opener] = {
    Form.TIFF: _tiff,
    Form.NPY: _npy,
    Form.PNG: _png,
    Form.MAT: partial(_hdf5, matlab=True),
    Form.HDF5: _hdf5,
}
_ENDINGS = {Form.TIFF: ".tif", Form.NPY: ".npy", Form.PNG: "", Form.MAT: ".mat", Form.HDF5: ".h5"}
