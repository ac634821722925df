"""Recordings: frame pairs, reference frames and, where they are known, symbols, in one HDF5 file.

The layout is the contract with other people's devices. Root attributes: `format` = "lightpage-recording",
`version` = 1, `camera_bit_depth`, `levels` (256 if absent), optionally `profile` (the nominal profile as TOML text) and
`black_level` (counts of a camera in the dark, 0 if absent; taken off when frames are read).
Datasets: `in_phase` and `quadrature` [page, row, column], `reference_in_phase` and `reference_quadrature`
[row, column], uint8 or uint16, counts right-aligned; optionally `symbols` uint8 [page, ny, nx] and `pilots`, boolean
[ny, nx]. A simulator adds the group `truth`, which no decoder reads. Cameras add the group `cameras`, see `layout`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import RecordingError
from lightpage.progress import warn
from lightpage.recording.exposure import describe, unused_low_bits
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.hdf5 import open_hdf5
from lightpage.recording.header import read_header
from lightpage.recording.layout import (
    CAMERAS,
    DARK,
    FRAMES,
    HOT,
    LOSSES,
    REFERENCES,
    SHOT_DATA,
    FrameInfo,
    LostShot,
    hash_frames,
)
from lightpage.recording.pixels.black_level import without_black
from lightpage.recording.stored import ArrayFile
from lightpage.words import brief, counted, sides


class Recording(AbstractContextManager["Recording"]):
    """A recording opened for reading and checked; use it in a `with` statement, or close it.

    `len` tells its pages, `recording[page]` is a frame pair, and a `for` loop yields all of them in order.

    Attributes:
        path: of the file.
        header: what holds for all of its pages.
        pages, levels, bit_depth, frame_shape, page_shape, has_symbols: see `Header`.
        cameras: what cameras have noted.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        """Check `file`, which must be open for reading, and is closed with this; `Recording.open` is the usual way in.

        Raises:
            RecordingError: the file is not a recording, or it is inconsistent.
        """
        self.path = path
        self._alignment_told = False
        self._file = ArrayFile(file, f"recording {path}")
        try:
            self.header = header = read_header(self._file)
            self.cameras = CameraNotes(self._file, header.pages)
            self.cameras.check()
        except BaseException:
            self.close()
            raise
        self.pages, self.levels, self.bit_depth = header.pages, header.levels, header.bit_depth
        self.frame_shape, self.page_shape, self.has_symbols = header.frame_shape, header.page_shape, header.has_symbols

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open and check a recording without reading its frames.

        Raises:
            RecordingError: missing, truncated, foreign, newer than this program, or inconsistent; the message names the
                file, the dataset or attribute, what came and what was wanted.
        """
        if not isinstance(path, str | os.PathLike):
            raise RecordingError(f"recording {path!r}", type(path).__name__, "a path")
        path = Path(path)
        return cls(open_hdf5(path, f"recording {path}"), path)

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self.pages

    def __getitem__(self, page: int) -> FramePair:
        """The frame pair of a page, -1 being the last; see `frames`."""
        from_end = isinstance(page, int | np.integer) and -self.pages <= page < 0
        return self.frames(page + self.pages if from_end else page)

    def __iter__(self) -> Iterator[FramePair]:
        return map(self.frames, range(self.pages))

    def __repr__(self) -> str:
        page = "" if self.page_shape is None else f" of {sides(self.page_shape)} symbols"
        return brief(
            self,
            str(self.path),
            f"{counted(self.pages, 'page')}{page} in {self.levels} levels, {'' if self.has_symbols else 'not '}known",
            f"frames of {sides(self.frame_shape)} pixels in {self.bit_depth} bits",
        )

    def close(self) -> None:
        """Close the file; nothing can be read afterwards."""
        self._file.close()

    @property
    def stored_page_bytes(self) -> float:
        """Bytes that the frame pair of a page takes in the file, compressed as it is; mean over the pages.

        Of recordings that are shown as one, it is what their own files take.
        """
        found = map(self._file.array, FRAMES)
        return sum(array.stored_bytes for array in found if array is not None) / self.pages

    def frames(self, page: int) -> FramePair:
        """The frame pair of one page, its black level taken off.

        Raises:
            RecordingError: no such page, or its data cannot be read.
        """
        return FramePair(*(self._counts(name, f" page {page}", self._file.page(name, page)) for name in FRAMES))

    def references(self) -> FramePair:
        """The two reference-only frames, their black level taken off.

        Raises:
            RecordingError: the data cannot be read.
        """
        return FramePair(*(self._counts(name, "", self._file.rows(name)) for name in REFERENCES))

    def shown(self, index: int) -> tuple[FramePair, NDArray[np.uint8] | None]:
        """Frames and symbols of a page; see `frames` and `symbols`."""
        return self.frames(index), self.symbols(index)

    def symbols(self, page: int) -> NDArray[np.uint8] | None:
        """The symbols [ny, nx] of one page, or None when the file holds none.

        Raises:
            RecordingError: no such page, or its data cannot be read.
        """
        return self._file.page("symbols", page) if self.has_symbols else None

    def pilots(self) -> NDArray[np.bool_] | None:
        """The recording's own pilot positions [ny, nx], or None: then the profile's default positions hold.

        Raises:
            RecordingError: the data cannot be read.
        """
        return None if self._file.array("pilots") is None else self._file.rows("pilots").astype(np.bool_)

    def page_hash(self, page: int) -> str:
        """SHA-256 of one frame pair in hex, by which pages that were trained on are recognised; see `page_hashes`.

        Raises:
            RecordingError: no such page, or its data cannot be read.
        """
        return hash_frames(self.frames(page))

    def _counts(self, name: str, where: str, frame: NDArray[Any]) -> NDArray[Any]:
        """A frame without its black level; counts that its bits do not hold are refused, and odd ones told once."""
        header, highest = self.header, int(frame.max())
        if highest > (full_scale := 2**header.bit_depth - 1):
            expected = f"at most {full_scale}, since camera_bit_depth = {header.bit_depth}"
            raise RecordingError(f"{header.subject}: dataset '{name}'{where}", f"a count of {highest}", expected)
        if not self._alignment_told and (unused := unused_low_bits(frame, header.bit_depth)):
            self._alignment_told = True
            told = f"{describe(header.bit_depth, unused)}; right-aligned counts are wanted"
            warn(f"{header.subject}: {name}: {told}")
        return without_black(frame, header.black_level, header.bit_depth)


@dataclass(frozen=True)
class CameraNotes:
    """A recording's notes of its cameras beside the frames; each is None, or empty, where it was not noted.

    Attributes:
        file: the recording.
        pages: that it has.
    """

    file: ArrayFile
    pages: int

    def check(self) -> None:
        """Check that what is noted can be read, without reading it.

        Raises:
            RecordingError: it is not whole.
        """
        for name in (*SHOT_DATA, *DARK, *HOT, LOSSES):
            self.file.array(name)

    def frame_infos(self, page: int) -> tuple[FrameInfo, FrameInfo] | None:
        """Return what the cameras said of a page's in-phase and quadrature frame.

        Raises:
            RecordingError: no such page, or the data cannot be read, or do not fit the frames.
        """
        known = [array for name in SHOT_DATA if (array := self.file.array(name)) is not None]
        if len(known) < len(SHOT_DATA):
            return None
        names = [self.file.attribute(name, group=CAMERAS) for name in ("serials", "pixel_formats")]
        shapes = {array.shape for array in known}
        if shapes != {(self.pages, 2)} or any(np.shape(name) != (2,) for name in names):
            subject = f"{self.file.subject}: group '{CAMERAS}'"
            expected = f"({self.pages}, 2), and two serials and pixel formats"
            raise RecordingError(subject, f"shapes {sorted(shapes)}, {names}", expected)
        ids, device, host, exposures = (self.file.page(name, page).tolist() for name in SHOT_DATA)
        first, second = (
            FrameInfo(serial, number, device_s, host_s, form, None if np.isnan(exposure_s) else exposure_s)
            for serial, number, device_s, host_s, form, exposure_s in zip(
                map(str, names[0]), ids, device, host, map(str, names[1]), exposures, strict=True
            )
        )
        return first, second

    def dark_frames(self) -> FramePair | None:
        """Return what the cameras saw without light, as it was."""
        found = self._both(DARK)
        return None if found is None else FramePair(*found)

    def hot_pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
        """Row and column [n, 2] of the pixels of each camera that were mended."""
        if (found := self._both(HOT)) is None:
            return None
        first, second = (pixels.astype(np.intp).reshape(-1, 2) for pixels in found)
        return first, second

    def losses(self) -> list[LostShot]:
        """Shots that gave no page.

        Raises:
            RecordingError: a note that cannot be read.
        """
        if (found := self.file.array(LOSSES)) is None:
            return []
        try:
            return [LostShot(**json.loads(text)) for text in self.file.rows(LOSSES)]
        except (TypeError, ValueError) as error:
            raise RecordingError(found.subject, error, "notes of lost shots") from None

    def _both(self, names: tuple[str, str]) -> list[NDArray[Any]] | None:
        """The arrays of both cameras, or None where one is missing."""
        return None if None in map(self.file.array, names) else [self.file.rows(name) for name in names]
