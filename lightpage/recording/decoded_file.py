"""Decoded pages in one HDF5 file, written page by page and given its name when it is complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.failures import os_failure
from lightpage.files import move_into_place, new_file
from lightpage.recording.hdf_file import open_to_write

FORMAT = "lightpage-decoded"
VERSION = 1


class DecodedWriter:
    """Writes `symbols` uint8 and `confidence` float32, both [page, ny, nx], with `levels` and the model versions.

    `pages` int64 [page] holds the pages' numbers: those that were refused are missing. Until it is complete, the file
    lies beside `path` under a name of its own: a recording's writer keeps its pages at `<path>.partial`.

    Args:
        path: final name; replaced only when the `with` statement ends well.
        levels: M.

    Raises:
        InvalidInputError: the path cannot be written.
    """

    def __init__(self, path: str | Path, levels: int) -> None:
        self.path = Path(path)
        subject, expected = f"output {self.path}", "a path that can be written"
        try:
            descriptor, self._partial = new_file(self.path.parent, self.path.name)
        except OSError as error:
            raise os_failure(subject, error, expected) from None
        os.close(descriptor)
        self._disk = open_to_write(self._partial, subject, expected)
        self._file = h5py.File(self._disk, "w")  # type: ignore[arg-type]  # the stubs know only names
        self._file.attrs.update({"format": FORMAT, "version": VERSION, "levels": levels})
        self._versions: list[str] = []
        self._pages: list[int] = []

    def append(
        self, symbols: NDArray[np.uint8], confidence: NDArray[np.float32], model_version: str, page: int | None
    ) -> None:
        """Add one page.

        Args:
            symbols, confidence: [ny, nx].
            model_version: which model decoded it.
            page: its number; the one after the last if None.

        Raises:
            InvalidInputError: it cannot be written.
        """
        with self._writing():
            for name, values in (("symbols", symbols), ("confidence", confidence)):
                dataset = self._dataset(name, values.shape, values.dtype)
                dataset.resize(len(self._versions) + 1, axis=0)
                dataset[-1] = values
            self._disk.check()
        self._pages.append(len(self._pages) if page is None else page)
        self._versions.append(model_version)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                with self._writing():
                    self._file["model_versions"] = np.array(self._versions, dtype=h5py.string_dtype())
                    self._file["pages"] = np.array(self._pages, np.int64)
                    self._file.close()
                    self._disk.check()
                    move_into_place(self._partial, self.path)
        finally:
            self._file.close()
            self._disk.close()
            self._partial.unlink(missing_ok=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise os_failure(f"output {self.path}", error, "a path with room for it") from None

    def _dataset(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> h5py.Dataset:
        if name not in self._file:
            self._file.create_dataset(name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(1, *shape))
        dataset: h5py.Dataset = self._file[name]
        return dataset
