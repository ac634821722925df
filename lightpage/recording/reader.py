"""Recordings: frame pairs, reference frames and, where they are known, symbols, in one HDF5 file.

The layout is the contract with other people's devices. Root attributes: `format` = "lightpage-recording",
`version` = 1, `camera_bit_depth`, `levels` (256 if absent), optionally `profile` (the nominal profile as TOML text) and
`black_level` (counts of a camera in the dark, 0 if absent; taken off when frames are read).
Datasets: `in_phase` and `quadrature` [page, row, column], `reference_in_phase` and `reference_quadrature`
[row, column], uint8 or uint16, counts right-aligned; optionally `symbols` uint8 [page, ny, nx] and `pilots`, boolean
[ny, nx]. A simulator adds the group `truth`, which no decoder reads. Cameras add the group `cameras`, see `layout`.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import RecordingError
from lightpage.progress import warn
from lightpage.recording.alignment import describe, unused_low_bits
from lightpage.recording.black_level import without_black
from lightpage.recording.camera_notes import CameraNotes
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.hdf5 import open_hdf5
from lightpage.recording.header import read_header
from lightpage.recording.layout import FRAMES, REFERENCES, hash_frames
from lightpage.recording.stored import ArrayFile


class Recording(AbstractContextManager["Recording"]):
    """A recording opened for reading and checked; use it in a `with` statement, or close it.

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
        path = Path(path)
        return cls(open_hdf5(path, f"recording {path}"), path)

    def __exit__(self, *_: object) -> None:
        self.close()

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
