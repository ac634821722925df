"""Arrays of HDF5 files as they are stored: none is believed that HDF5 would fill in, or could not decode.

HDF5 reads zeros, and says nothing, where a chunk was never written, an external file is cut short, or the source of a
virtual dataset is missing or cannot be opened for a moment. So what is stored is looked at before anything is read, and
virtual datasets are read from their sources here. A page that lies in the file in one piece, as it is, is read without
HDF5, which has one lock for all that a process reads by it.
"""

from __future__ import annotations

import importlib
import math
import os
import re
import threading
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count as numbers
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import RecordingError, StorageError
from lightpage.progress import warn
from lightpage.recording.hdf5 import (
    DATA,
    READABLE,
    find,
    hdf,
    open_named,
    open_once,
    patiently,
    read_attribute,
    resolved,
)
from lightpage.words import counted

CACHE_BYTES = 1 << 30
"""Most memory for the chunks of one array that hold a page; a chunk beyond it is decompressed anew for every page."""

OPEN_SOURCES = 16
"""Files of virtual datasets that stay open; there may be more of them than the system lets a process open."""

_UNLIMITED = hdf.h5s.UNLIMITED
_EXTFILE_PREFIX = os.environ.get("HDF5_EXTFILE_PREFIX", "")
"""HDF5 looks at it once, when it is loaded."""

_HDF5_ERRORS = OSError, KeyError, RuntimeError, ValueError
"""What h5py raises, the last of a file that is closed."""

_FILTERS = {
    4: "szip",
    307: "bzip2",
    32000: "lzf",
    32001: "blosc",
    32004: "lz4",
    32008: "bitshuffle",
    32013: "zfp",
    32015: "zstd",
    32017: "sz",
    32024: "sz3",
    32026: "blosc2",
}
"""Names of registered filters, where a file does not give one."""

Indices = range | NDArray[np.intp]
"""Ascending."""
Slab = tuple[int, int, int, int]
"""Start, stride, count and block of a selection along an axis."""


class Sources:
    """Files that virtual datasets show; the last few stay open."""

    def __init__(self) -> None:
        self._open: OrderedDict[Path, tuple[h5py.File, dict[str, StoredArray]]] = OrderedDict()

    def array(self, path: Path, name: str, subject: str, chain: tuple[tuple[Path, str], ...]) -> StoredArray:
        """An array of a file; `chain` holds the virtual datasets that led to it.

        Raises:
            RecordingError: the file or the array is not there, or is not whole.
            StorageError, SurroundingsError: it cannot be read.
        """
        name = name.strip("/")
        if (path, name) in chain:
            raise RecordingError(subject, "sources that lead back to themselves", "a source that holds data")
        if path not in self._open:
            self._open[path] = open_named(path, f"{subject}: source {path}", "HDF5_VDS_PREFIX"), {}
        self._open.move_to_end(path)
        file, arrays = self._open[path]
        if name not in arrays:
            subject = f"{subject}: source {path}: dataset '{name}'"
            found = find(file, name, subject)
            if not isinstance(found, h5py.Dataset):
                raise RecordingError(subject, "none", "the array that the virtual dataset shows")
            arrays[name] = StoredArray(found, subject, self, (*chain, (path, name)))
            while len(self._open) > 1 and (len(self._open) > OPEN_SOURCES or self._kept_bytes() > CACHE_BYTES):
                _, (file, _) = self._open.popitem(last=False)
                file.close()
        return arrays[name]

    def _kept_bytes(self) -> int:
        return sum(array.kept_bytes for _, arrays in self._open.values() for array in arrays.values())

    def close(self) -> None:
        """Close all files."""
        for file, _ in self._open.values():
            with suppress(OSError, RuntimeError):
                file.close()
        self._open.clear()


class ArrayFile:
    """An HDF5 file opened for reading, and opened again where its storage has failed; several threads may use it.

    Args:
        file: the file.
        subject: what it is, for error messages.
    """

    def __init__(self, file: h5py.File, subject: str) -> None:
        self._file, self.subject = file, subject
        self._path = Path(file.filename).absolute()
        self._stamp, self._gone = patiently(self._found_stamp, subject, READABLE, RecordingError), False
        self._sources = Sources()
        self._arrays: dict[str, StoredArray | None] = {}
        self._lock = threading.RLock()

    def array(self, name: str) -> StoredArray | None:
        """An array of the file, or None where it has none of this name, or HDF5's null.

        Raises:
            RecordingError: a group or a link that leads to nothing; and see `StoredArray`.
            StorageError, SurroundingsError: it cannot be read.
        """
        with self._lock:
            self._check_not_closed()
            if name not in self._arrays:
                self._be_open()
                subject = f"{self.subject}: dataset '{name}'"
                found = find(self._file, name, subject)
                if not isinstance(found, (h5py.Dataset, type(None))):
                    got = "a group" if isinstance(found, h5py.Group) else "a named type"
                    raise RecordingError(subject, got, "an array")
                self._arrays[name] = None if found is None else StoredArray(found, subject, self._sources)
            return self._arrays[name]

    def rows(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """An array, or its rows from `start` to `stop`, in this machine's byte order.

        Raises:
            RecordingError: there is no such array, or another file has the file's name by now; and see `array`.
            StorageError, SurroundingsError: it cannot be read.
        """
        subject = f"{self.subject}: dataset '{name}'" + (f" page {start}" if stop == start + 1 else "")

        def read() -> NDArray[Any]:
            if self._gone:
                self._open_again()
            if (array := self.array(name)) is None:
                raise RecordingError(subject, "none", "an array")
            return array.rows(start, len(array) if stop is None else stop)

        with self._lock:
            data = patiently(read, subject, renew=self._let_go)
        return data.astype(data.dtype.newbyteorder("="), copy=False)  # torch takes no other byte order

    def page(self, name: str, page: int) -> NDArray[Any]:
        """A row of an array that has one for each page.

        Raises:
            RecordingError: no such page; and see `rows`.
            StorageError, SurroundingsError: it cannot be read.
        """
        pages = 0 if (array := self.array(name)) is None else len(array)
        if not isinstance(page, int | np.integer) or not 0 <= page < pages:
            raise RecordingError(f"{self.subject}: page", repr(page), f"a whole number from 0 to {pages - 1}")
        row = self._without_hdf5(name, page)
        return self.rows(name, page, page + 1)[0] if row is None else row

    def _without_hdf5(self, name: str, page: int) -> NDArray[Any] | None:
        """The same, if the row lies in the file as it is and can be read; what is wrong otherwise, HDF5 says.

        Raises:
            StorageError: the file ends before the row does, which HDF5 fills with zeros.
        """
        array, piece = None, None
        with self._lock, suppress(*_HDF5_ERRORS):
            array = None if self._gone else self.array(name)
            piece = None if array is None else array.piece(page)
        if array is None or piece is None:
            return None
        row = np.empty(array.shape[1:], array.dtype)
        with closing(piece), suppress(OSError):
            if not piece.read_into(row):
                subject = f"{self.subject}: dataset '{name}' page {page}"
                raise StorageError(subject, "the end of the file", DATA)
            return row.astype(row.dtype.newbyteorder("="), copy=False)
        return None

    def attribute(self, name: str, default: object = None, group: str = "") -> Any:
        """An attribute of the file or of a group in it; see `read_attribute`."""
        subject = f"{self.subject}: group '{group}'" if group else self.subject
        with self._lock:
            self._be_open()
            place = find(self._file, group, subject) if group else self._file
            return default if place is None else read_attribute(place, name, subject, default)

    def close(self) -> None:
        """Close the file; nothing can be read afterwards."""
        with self._lock:
            self._gone = False
            self._sources.close()
            for array in self._arrays.values():
                if array is not None:  # one behind a link keeps another file open
                    array.dataset.id.close()
            self._file.close()

    def _found_stamp(self) -> tuple[int, int]:
        status = self._path.stat()
        return status.st_size, status.st_mtime_ns

    def _let_go(self) -> None:
        """Close the file: what a share has lost cannot be read by the same handle again."""
        with suppress(OSError, RuntimeError):
            self.close()
        self._gone = True

    def _open_again(self) -> None:
        if self._found_stamp() != self._stamp:
            raise RecordingError(self.subject, "another file since it was opened", "the same file")
        self._file, self._gone = open_once(self._path, self.subject), False
        self._arrays.clear()

    def _check_not_closed(self) -> None:
        if not (self._gone or self._file):
            raise RecordingError(self.subject, "a file that is closed", "an open one: read inside its `with` statement")

    def _be_open(self) -> None:
        self._check_not_closed()
        if self._gone:
            patiently(self._open_again, self.subject, READABLE)


@dataclass(frozen=True)
class _Piece:
    """A piece of an open file.

    Attributes:
        file: a descriptor of its own, so that the file may be closed meanwhile.
        place: of the first byte.
    """

    file: int
    place: int

    def read_into(self, array: NDArray[Any]) -> bool:
        """Fill an array, and return whether the file had so many bytes.

        Raises:
            OSError: the system cannot read it.
        """
        left, place = array.reshape(-1).data.cast("B"), self.place
        while left and (count := os.preadv(self.file, [left], place)):
            left, place = left[count:], place + count
        return not left

    def close(self) -> None:
        """Let the file go."""
        os.close(self.file)


@dataclass(frozen=True)
class _Part:
    """The part of a virtual dataset that comes from one source: element by element, along each axis, in order.

    Attributes:
        path, name: of the source.
        shown: indices of the virtual dataset, along each axis.
        taken: indices of the source; all of it if empty.
    """

    path: Path
    name: str
    shown: tuple[Indices, ...]
    taken: tuple[Indices, ...]


class StoredArray:
    """An array of an HDF5 file, opened for reading.

    Args:
        found: the array.
        subject: what it is, for error messages.
        sources: opens the files that it shows, if it is a virtual dataset.
        chain: the virtual datasets that show this one.

    Attributes:
        subject, shape, dtype: of the array.
        stored_bytes: that it takes on the disk.
        kept_bytes: memory for chunks that pages share.

    Raises:
        RecordingError: data were never written, are in files that are not there, or are stored in a way that cannot be
            read.
        StorageError, SurroundingsError: it cannot be read.
    """

    def __init__(self, found: Any, subject: str, sources: Sources, chain: tuple[tuple[Path, str], ...] = ()) -> None:
        self.subject, self._sources, self.kept_bytes = subject, sources, 0
        try:
            self.shape: tuple[int, ...] = found.shape
            self.dtype: np.dtype[Any] = found.dtype
        except (TypeError, ValueError):
            raise RecordingError(subject, "a type that cannot be read", "whole numbers") from None
        self._path, self._name = Path(found.file.filename), found.name.strip("/")
        self._chain = chain or ((self._path, self._name),)
        self.dataset: Any = found
        self._is_plain: bool | None = None
        self._parts: list[_Part] = []
        properties = found.id.get_create_plist()
        layout = properties.get_layout()
        if layout == hdf.h5d.VIRTUAL:
            self.stored_bytes = self._check_parts(properties)
            return
        self.stored_bytes = float(patiently(found.id.get_storage_size, subject))
        if layout == hdf.h5d.CHUNKED:
            self._check_chunks(properties)
        elif properties.get_external_count():
            self._check_external(properties)
        elif layout == hdf.h5d.CONTIGUOUS and self.stored_bytes < found.nbytes:
            raise self._unwritten(range(len(self)))

    def __len__(self) -> int:
        return self.shape[0] if self.shape else 1

    def piece(self, row: int) -> _Piece | None:
        """The piece of the file that is a row, byte for byte, to be closed; None where HDF5 must read the row.

        Raises:
            OSError, KeyError, RuntimeError, ValueError: what HDF5 says.
        """
        if self._is_plain is None:
            self._is_plain = _is_plain(self.dataset)
        if not self._is_plain:
            return None
        size = math.prod(self.shape[1:]) * self.dtype.itemsize
        if self.dataset.chunks is None:
            place = self.dataset.id.get_offset() + row * size
        else:
            chunk = self.dataset.id.get_chunk_info_by_coord((row, *(0 for _ in self.shape[1:])))
            place = chunk.byte_offset if chunk.size == size else None
        return None if place is None else _Piece(os.dup(self.dataset.file.id.get_vfd_handle()), place)

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """The array from `start` to `stop` along its first axis.

        Raises:
            StorageError, SurroundingsError: the data cannot be read, or a source has gone since it was opened.
            OSError, KeyError, RuntimeError: what HDF5 says; see `lightpage.recording.hdf5.patiently`.
        """
        if not self._parts:
            return np.asarray(self.dataset[start:stop])
        rows = np.empty((stop - start, *self.shape[1:]), self.dtype)
        for part in self._parts:
            first, last = (bisect_left(part.shown[0], row) for row in (start, stop))
            if first == last:
                continue
            shown = (_moved(part.shown[0][first:last], -start), *part.shown[1:])
            taken = part.taken
            if len(part.shown[0]) > 1:
                axis = next(axis for axis, indices in enumerate(taken) if len(indices) > 1)
                taken = (*taken[:axis], taken[axis][first:last], *taken[axis + 1 :])
            low, high = int(taken[0][0]), int(taken[0][-1]) + 1
            data = patiently(
                partial(self._rows_of, part, low, high),
                f"{self.subject}: source {part.path}: dataset '{part.name}'",
                renew=self._sources.close,
            )
            data = data[_at((_moved(taken[0], -low), *taken[1:]))]
            rows[_at(shown)] = data.reshape([len(indices) for indices in shown])
        return rows

    def _rows_of(self, part: _Part, start: int, stop: int) -> NDArray[Any]:
        try:
            source = self._source(part)
        except RecordingError as error:  # it was there and whole when the recording was opened
            raise StorageError(error.subject, error.got, error.expected) from None
        return source.rows(start, stop)

    def _source(self, part: _Part) -> StoredArray:
        return self._sources.array(part.path, part.name, self.subject, self._chain)

    def _check_chunks(self, properties: Any) -> None:
        """Check that all chunks are there and can be decoded; keep them in memory where pages share them."""
        chunk = self.dataset.chunks
        counts = [-(-size // step) for size, step in zip(self.shape, chunk, strict=True)]
        across, end = math.prod(counts[1:]), _size_of(self._path, self.subject)
        missing_filters = self._missing_filters(properties)
        there = patiently(self.dataset.id.get_num_chunks, self.subject)
        if there < math.prod(counts) or self.stored_bytes > end or missing_filters:
            self._look_at_chunks(across, end, missing_filters)
        if properties.get_nfilters() and chunk[0] > 1:
            self._keep_chunks(across)

    def _look_at_chunks(self, across: int, end: int, missing_filters: list[tuple[int, str]]) -> None:
        """Check each chunk: there are `across` of them side by side, and the file ends at `end`."""
        seen: dict[int, int] = {}
        skipped = ~0

        def look(info: Any) -> None:
            nonlocal skipped
            first = info.chunk_offset[0]
            if info.byte_offset + info.size <= end:
                seen[first] = seen.get(first, 0) + 1
            skipped &= info.filter_mask

        def look_at_all() -> None:
            seen.clear()
            self.dataset.id.chunk_iter(look)

        patiently(look_at_all, self.subject)
        step = self.dataset.chunks[0]
        if ends := _ends(range(0, len(self) if across else 0, step), lambda row: seen.get(row, 0) < across):
            raise self._unwritten(range(ends[0], min(ends[1] + step, len(self))))
        for index, told in missing_filters:
            if seen and not skipped >> index & 1:
                got = f"data compressed by the filter {told}, which HDF5 does not have here"
                expected = "it (pip install hdf5plugin), or data repacked with gzip (h5repack -f GZIP=4 IN OUT)"
                raise RecordingError(self.subject, got, expected)

    def _keep_chunks(self, across: int) -> None:
        chunk = self.dataset.chunks
        needed = across * math.prod(chunk) * self.dtype.itemsize
        if needed > CACHE_BYTES:
            one = "x".join(map(str, (1, *self.shape[1:])))
            warn(
                f"{self.subject}: {counted(chunk[0], 'page')} share {needed >> 20} MiB, decompressed for each page; "
                f"'h5repack -l {self._name}:CHUNK={one} IN OUT' makes reading fast"
            )
            return
        self.kept_bytes = needed
        access = hdf.h5p.create(hdf.h5p.DATASET_ACCESS)
        _, before, _ = access.get_chunk_cache()
        access.set_chunk_cache(100 * across + 1, max(before, needed), 1.0)
        file, name = self.dataset.file, self.dataset.name
        self.dataset.id.close()  # the memory is that of its first opening
        self.dataset = patiently(lambda: hdf.Dataset(hdf.h5d.open(file.id, name.encode(), access)), self.subject)

    def _missing_filters(self, properties: Any) -> list[tuple[int, str]]:
        """Position and name of each filter that HDF5 cannot decode here."""
        filters = [properties.get_filter(index) for index in range(properties.get_nfilters())]
        if not all(decodes(code) for code, *_ in filters):
            with suppress(ImportError):
                importlib.import_module("hdf5plugin")  # tells HDF5 of its filters
        return [
            (index, f"{_FILTERS.get(code) or name.decode('utf-8', 'replace').strip() or 'unknown'} ({code})")
            for index, (code, _, _, name) in enumerate(filters)
            if not decodes(code)
        ]

    def _check_external(self, properties: Any) -> None:
        """Check that the files beside the HDF5 file that hold the data are there, and long enough."""
        folder = str(self._path.absolute().parent)
        prefix = _EXTFILE_PREFIX.replace("${ORIGIN}", folder)
        left = self.dataset.nbytes
        for index in range(properties.get_external_count()):
            name, offset, size = properties.get_external(index)
            path = Path(prefix, os.fsdecode(name)).absolute()
            subject = f"{self.subject}: external file {path}"
            needed = min(left, size)
            where = "this file: HDF5 looks for it in the current folder, or where HDF5_EXTFILE_PREFIX says"
            if (there := _size_of(path, subject, where)) < offset + needed:
                raise RecordingError(subject, f"{there} bytes", f"{offset + needed} bytes: copy the whole file along")
            left -= needed
        if left:
            raise RecordingError(self.subject, f"external files that lack {left} bytes", "files that hold all data")

    def _check_parts(self, properties: Any) -> float:
        """Check that sources hold all that a virtual dataset shows; returns the bytes that they take for it."""
        left = self.dataset.id.get_space()
        left.select_all()
        stored = 0.0
        for part in list(self._mapped(properties)):  # opening many sources may close the file of this one
            source = self._source(part)
            if not part.taken:
                part = replace(part, taken=tuple(map(range, source.shape)))
            self._check_part(part, source)
            stored += source.stored_bytes * math.prod(map(len, part.taken)) / max(1, math.prod(source.shape))
            self._parts.append(part)
            _take_off(left, part.shown)
        if left.get_select_npoints():
            (first, *_), (last, *_) = left.get_select_bounds()
            raise self._unwritten(range(int(first), int(last) + 1), "no source")
        return stored

    def _check_part(self, part: _Part, source: StoredArray) -> None:
        shape = tuple(int(indices[-1]) + 1 for indices in part.taken)
        if len(shape) != len(source.shape) or any(map(int.__gt__, shape, source.shape)):
            expected = f"at least {shape}, of which '{self._name}' shows {_told(part.shown[0])}"
            raise RecordingError(source.subject, f"shape {source.shape}", f"{expected}: copy the whole source along")
        shown, taken = ([len(axis) for axis in axes if len(axis) > 1] for axes in (part.shown, part.taken))
        if shown != taken:
            raise RecordingError(source.subject, f"{taken} of it, shown as {shown}", "a source shown in its own shape")
        if not np.can_cast(source.dtype, self.dtype, "safe"):
            raise RecordingError(source.subject, f"type {source.dtype}", f"one that fits into {self.dtype}")

    def _mapped(self, properties: Any) -> Iterator[_Part]:
        """The parts of a virtual dataset; those of numbered sources, as far as it shows them, one by one."""
        for index in range(properties.get_virtual_count()):
            space, source = properties.get_virtual_vspace(index), properties.get_virtual_srcspace(index)
            file_name, name = properties.get_virtual_filename(index), properties.get_virtual_dsetname(index)
            shown = self._selected(space) or [(0, 1, 1, size) for size in self.shape]
            taken = self._selected(source)
            grows = next((axis for axis, slab in enumerate(shown) if _grows(slab)), None)
            grown = next((axis for axis, slab in enumerate(taken) if _grows(slab)), None)
            if grows is None or grown is not None:
                axes = [_indices(slab, stop=size) for slab, size in zip(shown, self.shape, strict=True)]
                most = None if grows is None else len(axes[grows])
                yield self._part(file_name, name, 0, axes, [_indices(slab, most=most) for slab in taken])
                continue
            first, step, _, block = shown[grows]
            for number in numbers():
                if (start := first + number * step) >= self.shape[grows]:
                    self._check_end(file_name, name, number)
                    break
                shown[grows] = start, 1, 1, block
                axes = [_indices(slab, stop=size) for slab, size in zip(shown, self.shape, strict=True)]
                yield self._part(file_name, name, number, axes, [_indices(slab) for slab in taken])

    def _part(
        self, file_name: str, name: str, number: int, shown: Sequence[Indices], taken: Sequence[Indices]
    ) -> _Part:
        """The part of a source; names of numbered ones hold `%b`."""
        file_name, name = (
            text.replace("%%", "\0").replace("%b", str(number)).replace("\0", "%") for text in (file_name, name)
        )
        prefixes = os.environ.get("HDF5_VDS_PREFIX", "")
        path = self._path if file_name == "." else resolved(file_name, self._path, prefixes)
        return _Part(path, name, tuple(shown), tuple(taken))

    def _check_end(self, file_name: str, name: str, number: int) -> None:
        """Check that no source is there from `number` on: HDF5 ends at the first that it cannot open.

        Raises:
            RecordingError: this one is missing, and a later one is there.
            StorageError: this one is there by now.
        """
        end = self._part(file_name, name, number, (), ())
        if "%b" not in file_name:
            return
        before, _, after = (re.escape(text.replace("%%", "%")) for text in os.path.basename(file_name).partition("%b"))
        pattern = re.compile(f"{before}([0-9]+){after.replace('%b', '[0-9]+')}")
        with suppress(OSError):
            found = [int(match[1]) for entry in os.listdir(end.path.parent) if (match := pattern.fullmatch(entry))]
            if max(found, default=-1) >= number:
                self._source(end)
                raise StorageError(self.subject, f"no data of {end.path}", "storage that answers")

    def _selected(self, space: Any) -> list[Slab | NDArray[np.intp]]:
        """Return what a mapping selects along each axis; nothing where it is the whole array."""
        kind = space.get_select_type()
        if kind == hdf.h5s.SEL_ALL:
            return []
        if kind == hdf.h5s.SEL_HYPERSLABS:
            if space.is_regular_hyperslab():
                return list(zip(*space.get_regular_hyperslab(), strict=True))
            blocks = np.asarray(space.get_select_hyper_blocklist(), np.intp)
            axes = [
                np.unique(np.concatenate([np.arange(first, last + 1) for first, last in blocks[:, :, axis]]))
                for axis in range(blocks.shape[2])
            ]
            if math.prod(map(len, axes)) == space.get_select_npoints():
                return list(axes)
        raise RecordingError(self.subject, "sources shown point by point", "sources shown by whole rows and columns")

    def _unwritten(self, rows: Sequence[int], what: str = "no data") -> RecordingError:
        unit = "page" if len(self.shape) == 3 else "row"
        return RecordingError(
            self.subject,
            f"{what} for {unit} {_told(rows)} of {len(self)}",
            f"data for every {unit}: record the rest, or shorten all arrays to what was written",
        )


def _grows(slab: Slab | NDArray[np.intp]) -> bool:
    return isinstance(slab, tuple) and _UNLIMITED in slab[2:]


def _indices(slab: Slab | NDArray[np.intp], stop: int | None = None, most: int | None = None) -> Indices:
    """The indices of a selection along an axis; one that grows ends at `stop`, or has `most` of them."""
    if not isinstance(slab, tuple):
        return slab
    start, step, count, block = slab
    if not _grows(slab):
        size = block if count == 1 else count * block
    elif most is not None:
        size = most
    else:
        assert stop is not None
        whole, rest = divmod(max(0, stop - start), step)
        size = max(0, stop - start) if block == _UNLIMITED else whole * block + min(rest, block)
    if size <= block or block == step:
        return range(start, start + size)
    if block == 1:
        return range(start, start + size * step, step)
    index = np.arange(size)
    return start + index // block * step + index % block


def _moved(indices: Indices, by: int) -> Indices:
    if isinstance(indices, range):
        return range(indices.start + by, indices.stop + by, indices.step)
    return np.asarray(indices) + by


def _is_plain(found: Any) -> bool:
    """Return whether each row of a dataset lies in its file in one piece, as numpy has it in memory."""
    properties, shape = found.id.get_create_plist(), found.shape
    if found.dtype.kind not in "ui" or len(shape) < 2 or not all(shape):
        return False
    if found.chunks is None:
        in_one = not properties.get_external_count() and found.id.get_offset() is not None
    else:
        in_one = found.chunks == (1, *shape[1:]) and not properties.get_nfilters()
    in_file = hasattr(os, "preadv") and found.file.driver == "sec2" and not found.file.userblock_size
    return in_one and in_file and found.id.get_type() == hdf.h5t.py_create(found.dtype)


def _at(axes: Sequence[Indices]) -> Any:
    """Return what selects these indices of an array."""
    if all(isinstance(axis, range) for axis in axes):
        return tuple(slice(axis.start, axis.stop, axis.step) for axis in axes if isinstance(axis, range))
    return np.ix_(*axes)


def _take_off(space: Any, axes: Sequence[Indices]) -> None:
    """Remove a block from what is selected."""
    pieces = [[axis] if isinstance(axis, range) else [range(one, one + 1) for one in axis] for axis in axes]
    for block in product(*pieces):
        start, size, step = zip(*((axis.start, len(axis), axis.step) for axis in block), strict=True)
        space.select_hyperslab(start, size, step, op=hdf.h5s.SELECT_NOTB)


def decodes(code: int) -> bool:
    """Return whether HDF5 can decode a filter of this number here."""
    return hdf.h5z.filter_avail(code) and bool(hdf.h5z.get_filter_info(code) & hdf.h5z.FILTER_CONFIG_DECODE_ENABLED)


def _size_of(path: Path, subject: str, expected: str = "a file that can be read") -> int:
    return patiently(lambda: path.stat().st_size, subject, expected, RecordingError)


def _ends(rows: range, lacks: Callable[[int], bool]) -> tuple[int, int] | None:
    """Return the first and the last row that lacks data, if any: an array can claim too many rows to ask each."""
    first = next(filter(lacks, rows), None)
    return None if first is None else (first, next(filter(lacks, reversed(rows))))


def _told(rows: Indices | Sequence[int]) -> str:
    return f"{rows[0]}" if len(rows) == 1 else f"{rows[0]} to {rows[-1]}"
