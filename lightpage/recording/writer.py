"""Writing a recording page by page, so that an interruption loses nothing and nothing half-written is ever loaded."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lightpage.device.profile import Profile
from lightpage.errors import LightpageError, NoSuchPageError, PageError, RecordingError
from lightpage.failures import error_number, hdf5_failure, os_failure, short_resource
from lightpage.files import lock, move_into_place, move_to_new_name
from lightpage.page.levels import check_levels
from lightpage.page.symbols import check_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.hdf5 import retried
from lightpage.recording.hdf_file import open_to_write
from lightpage.recording.layout import (
    CAMERAS,
    DARK,
    FORMAT,
    FRAMES,
    HOT,
    LOSSES,
    MAX_BIT_DEPTH,
    MIN_BIT_DEPTH,
    REFERENCES,
    SHOT_DATA,
    VERSION,
    FrameInfo,
    LostShot,
    frame_type,
)
from lightpage.words import counted

Infos = tuple[FrameInfo, FrameInfo]
HotPixels = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Of both cameras, [n, 2]: row and column."""
Symbols = Callable[[int], NDArray[np.uint8]]
"""Of a page by its number; `NoSuchPageError` where there is none."""


def partial_path(path: Path) -> Path:
    """Where a recording lies until it is complete and gets its name `path`."""
    return path.with_name(path.name + ".partial")


def pages_there(
    path: Path,
    profile: Profile,
    levels: int,
    bit_depth: int,
    *,
    code: str | None = None,
    symbols: Symbols | None = None,
    overwrite: bool = False,
) -> int:
    """Pages of the unfinished recording `path` that `RecordingWriter.resume` would go on from; arguments as there.

    Raises:
        RecordingError: another process is writing them; or they are others, and `overwrite` is not asked for.
    """
    partial = partial_path(path)
    if not _take(partial, remove=False):
        return 0
    try:
        with retried(lambda: h5py.File(str(partial), "r", locking=False)) as file:
            pages = _pages_of(file)
            other = _difference(file, pages, _header(profile, levels, bit_depth, code), symbols)
    except _CUT_OFF as error:
        _check_damage(partial, error)
        return 0
    if not (pages and other):
        return pages
    if overwrite:
        return 0
    raise _others(partial, pages, other)


_CUT_OFF = (OSError, KeyError, RuntimeError, TypeError, ValueError)
"""What HDF5 raises of a file that was cut off while it was written; it is begun anew."""


def _check_damage(partial: Path, error: Exception) -> None:
    """Check that an error says something of an unfinished file, and not that it cannot be read now.

    Raises:
        StorageError, SurroundingsError, RecordingError: it cannot be read.
    """
    if error_number(error) is not None or short_resource("", error):
        expected = "a file that can be read: its pages are not begun anew"
        raise hdf5_failure(f"recording {partial}", error, expected, RecordingError) from None


def _pages_of(file: h5py.File) -> int:
    """Without its count a file was interrupted while it was completed: all of its pages are there."""
    return int(file.attrs.get("pages_complete", file[FRAMES[0]].shape[0]))


def _header(profile: Profile, levels: int, bit_depth: int, code: str | None) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "camera_bit_depth": bit_depth,
        "levels": levels,
        "profile": profile.to_toml(),
        **({} if code is None else {"code": code}),
    }


def _difference(file: h5py.File, pages: int, header: Mapping[str, Any], symbols: Symbols | None) -> str:
    """Of what else than `header` and `symbols` the pages of a file are; empty if they are the same."""
    for name, what in (("profile", "another profile"), ("camera_bit_depth", "another bit depth")):
        if file.attrs.get(name) != header[name]:
            return what
    if any(file.attrs.get(name) != header.get(name) for name in ("levels", "code")):
        return "other symbols"
    if any(file.attrs.get(name) != header[name] for name in ("format", "version")):
        return "another format"
    if symbols is None or not pages:
        return ""
    if "symbols" not in file:
        return "unknown symbols"
    try:
        same = all(np.array_equal(file["symbols"][page], symbols(page)) for page in range(pages))
    except NoSuchPageError:
        same = False
    return "" if same else "other symbols"


def _others(partial: Path, pages: int, other: str) -> RecordingError:
    same = "symbols" if other.endswith("symbols") else other.removeprefix("another ").removeprefix("other ")
    return RecordingError(
        f"recording {partial}",
        f"{counted(pages, 'page')} of {other}",
        f"the same {'--symbols' if same == 'symbols' else same}, another name, or --force",
    )


def discard_partial(path: Path) -> None:
    """Remove the unfinished pages of the recording `path`, if there are any.

    Raises:
        RecordingError: another process is writing them, or they cannot be removed.
    """
    _take(partial_path(path), remove=True)


def _take(partial: Path, *, remove: bool) -> bool:
    """Whether `partial` is there, writable and written by nobody else; `remove` unlinks it while that is certain.

    HDF5 holds this same lock on a file as long as it is open for writing.
    """
    subject = f"recording {partial}"
    try:
        with partial.open("rb+") as file:
            lock(file.fileno(), subject)
            if remove:
                partial.unlink()
    except FileNotFoundError:
        return False
    except BlockingIOError:
        raise RecordingError(
            subject, "pages that another process is writing now", "another name, or to wait for its end"
        ) from None
    except OSError as error:
        raise os_failure(subject, error, "a file that can be read and written", RecordingError) from None
    return True


class RecordingWriter:
    """Writes a recording page by page to `<path>.partial`, and moves it to `path` when the `with` statement ends well.

    After an exception, Ctrl-C included, the partial file stays behind, complete up to the last page appended;
    `RecordingWriter.resume` goes on from there. A half-written file is never found under the final name.
    """

    def __init__(
        self,
        path: str | Path,
        profile: Profile,
        levels: int,
        bit_depth: int,
        references: FramePair,
        pilots: ArrayLike | None = None,
        *,
        resume: bool = False,
        code: str | None = None,
        keep_references: bool = False,
        symbols: Symbols | None = None,
        overwrite: bool = True,
    ) -> None:
        """Start a new recording; a partial file of the same name that nobody is writing is overwritten.

        Args:
            path: final name.
            profile: nominal profile; fixes the shapes and is kept as TOML text.
            levels: M, 2 to 256.
            bit_depth: bits of a camera count, 8 to 16.
            references: reference-only frames.
            pilots: boolean [ny, nx]; None leaves the profile's default positions in force.
            resume: as `RecordingWriter.resume` does.
            code: what the pages hold, JSON text, where they were made by an encoder.
            keep_references: whether a recording that is gone on with keeps its own reference frames, where `references`
                are others: no camera takes the same ones twice.
            symbols: of the pages to come; a recording whose pages have others is not gone on with.
            overwrite: whether a file that has the final name, then or at the end, and pages of a recording that is not
                gone on with, may be lost.

        Raises:
            RecordingError: wrong bit depth, frames or pilots, or the file cannot be written or is being written; or
                there is something that may not be lost.
            PageError: a level count outside 2..256.
        """
        self._prepare(path, profile, levels, bit_depth)
        self._code, self._keep_references = code, keep_references
        self._symbols, self._overwrite = symbols, overwrite
        if not overwrite and self.path.exists():
            raise self._exists()
        if not (resume and self._continue(references, pilots)):
            self._create(references, pilots)

    @classmethod
    def resume(
        cls,
        path: str | Path,
        profile: Profile,
        levels: int,
        bit_depth: int,
        references: FramePair,
        pilots: ArrayLike | None = None,
        code: str | None = None,
        *,
        keep_references: bool = False,
        symbols: Symbols | None = None,
        overwrite: bool = True,
    ) -> Self:
        """Go on with `<path>.partial` if it was started with the same arguments, else start anew.

        `pages` tells how many pages are there already. Arguments and errors as for the constructor.
        """
        return cls(
            path,
            profile,
            levels,
            bit_depth,
            references,
            pilots,
            resume=True,
            code=code,
            keep_references=keep_references,
            symbols=symbols,
            overwrite=overwrite,
        )

    @property
    def pages(self) -> int:
        """Pages written so far."""
        return self._pages

    @property
    def partial_path(self) -> Path:
        """The file that is being written."""
        return self._partial

    def append(
        self,
        symbols: ArrayLike | None,
        frames: FramePair,
        truth: Mapping[str, NDArray[Any]] | None = None,
        infos: Infos | None = None,
    ) -> None:
        """Append one page and flush it to the disk.

        Args:
            symbols: [ny, nx], or None when they are unknown; either for all pages or for none.
            frames: counts [row, column] within the bit depth.
            truth: what only a simulator knows, one array a name, of the same shape and type on every page.
            infos: what the cameras say of both frames; either for all pages or for none.

        Raises:
            RecordingError: wrong frames, symbols or truth on some pages only, or a page that cannot be written.
            PageError: symbols of the wrong shape or range.
        """
        data = {name: self._checked(name, getattr(frames, name)) for name in FRAMES}
        if symbols is not None:
            subject = f"{self._subject}: symbols"
            data["symbols"] = check_symbols(symbols, self._profile.page_shape, self._levels, subject)
            if data["symbols"].ndim != 2:
                raise PageError(f"{self._subject}: symbols", f"shape {data['symbols'].shape}", "one page [ny, nx]")
        data |= {f"truth/{name}": np.asarray(value) for name, value in (truth or {}).items()}
        if infos is not None:
            data |= _shot_data(infos)
        self._check_same_datasets(data)
        if infos is not None and "serials" not in (group := self._file.require_group(CAMERAS)).attrs:
            group.attrs["serials"] = [info.serial for info in infos]
            group.attrs["pixel_formats"] = [info.pixel_format for info in infos]
        try:
            for name, value in data.items():
                self._write_page(name, value)
            # The count comes last: pages beyond it were cut off in the middle, and resuming drops them.
            self._file.attrs["pages_complete"] = self._pages + 1
            self._file.flush()
            self._disk.check()
        except OSError as error:
            raise self._failure(f"{self._subject}: page {self._pages}", error, "room for it on the disk") from None
        self._pages += 1

    def set_truth(self, device_toml: str) -> None:
        """Keep the true state of a simulated device as TOML text, where no decoder looks."""
        self._file.require_group("truth").attrs["device"] = device_toml
        self._file.flush()

    def set_dark_frames(self, dark: FramePair, hot: HotPixels) -> None:
        """Keep what the cameras see without light, and the pixels that were mended because they always see some.

        Raises:
            RecordingError: frames that do not fit.
        """
        for name, hot_name, which, pixels in zip(DARK, HOT, FRAMES, hot, strict=True):
            value = self._checked(name, getattr(dark, which))
            for key, data in ((name, value), (hot_name, np.asarray(pixels, np.uint32).reshape(-1, 2))):
                if key in self._file:
                    del self._file[key]
                self._file.create_dataset(key, data=data)
        self._file.flush()

    def add_note(self, name: str, values: Mapping[str, str | float]) -> None:
        """Keep remarks on the whole recording as attributes of the group `name`, where no decoder looks."""
        self._file.require_group(name).attrs.update(values)
        self._file.flush()

    def add_loss(self, loss: LostShot) -> None:
        """Note a shot that gave no page."""
        if LOSSES not in self._file:
            self._file.create_dataset(LOSSES, shape=(0,), maxshape=(None,), dtype=h5py.string_dtype())
        losses = self._file[LOSSES]
        losses.resize(losses.shape[0] + 1, axis=0)
        losses[-1] = json.dumps(asdict(loss))
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.commit()
        else:
            self.abandon()

    def commit(self) -> None:
        """Close the file and give it its final name.

        Raises:
            RecordingError: the file cannot be completed or renamed.
        """
        try:
            if "pages_complete" in self._file.attrs:
                del self._file.attrs["pages_complete"]
            self._file.close()
            self._disk.check()
            (move_into_place if self._overwrite else move_to_new_name)(self._partial, self.path)  # still locked
        except FileExistsError:
            raise self._exists() from None
        except OSError as error:
            raise self._failure(self._subject, error, "a file that can be completed") from None
        finally:
            self._disk.close()

    def abandon(self) -> None:
        """Close the partial file and leave it for `resume`."""
        self._file.close()
        self._disk.close()

    def _prepare(self, path: str | Path, profile: Profile, levels: int, bit_depth: int) -> None:
        self.path = Path(path)
        self._subject = f"recording {self.path}"
        self._partial = partial_path(self.path)
        check_levels(levels, f"{self._subject}: levels")
        if not MIN_BIT_DEPTH <= bit_depth <= MAX_BIT_DEPTH:
            raise RecordingError(f"{self._subject}: bit depth", bit_depth, f"{MIN_BIT_DEPTH} to {MAX_BIT_DEPTH}")
        self._profile, self._levels, self._bit_depth = profile, levels, bit_depth
        self._pages = 0

    def _failure(self, subject: str, error: OSError, expected: str) -> LightpageError:
        """The error of a write, which says what stays of the pages before."""
        failure = os_failure(subject, error, expected, RecordingError)
        if not self._pages:
            return failure
        kept = f"{counted(self._pages, 'page')} stay in {self._partial.name}; the same command goes on with them"
        return type(failure)(subject, failure.got, f"{failure.expected}. {kept}")

    def _exists(self) -> RecordingError:
        there = f"; the pages are in {self._partial}" if self._pages else ""
        return RecordingError(self._subject, "a file that exists by now", f"a new name, or --force{there}")

    def _header(self) -> dict[str, Any]:
        return _header(self._profile, self._levels, self._bit_depth, self._code)

    def _checked(self, name: str, frame: NDArray[Any]) -> NDArray[Any]:
        frame = np.asarray(frame)
        subject = f"{self._subject}: {name}"
        if frame.dtype.kind not in "ui":
            raise RecordingError(subject, f"type {frame.dtype}", "whole counts")
        if frame.shape != self._profile.frame_shape:
            raise RecordingError(subject, f"shape {frame.shape}", f"shape {self._profile.frame_shape}")
        full_scale = 2**self._bit_depth - 1
        if int(frame.min()) < 0 or int(frame.max()) > full_scale:
            raise RecordingError(subject, f"counts from {frame.min()} to {frame.max()}", f"0 to {full_scale}")
        return frame.astype(frame_type(self._bit_depth), copy=False)

    def _checked_fixed(self, references: FramePair, pilots: ArrayLike | None) -> dict[str, NDArray[Any]]:
        """The datasets that do not grow."""
        fixed = {f"reference_{name}": self._checked(f"reference_{name}", getattr(references, name)) for name in FRAMES}
        if pilots is not None:
            mask = np.asarray(pilots)
            if mask.dtype != np.bool_ or mask.shape != self._profile.page_shape:
                raise RecordingError(
                    f"{self._subject}: pilots",
                    f"{mask.dtype} of shape {mask.shape}",
                    f"bool of shape {self._profile.page_shape}",
                )
            fixed["pilots"] = mask
        return fixed

    def _create(self, references: FramePair, pilots: ArrayLike | None) -> None:
        fixed = self._checked_fixed(references, pilots)
        discard_partial(self.path)
        self._disk = open_to_write(self._partial, f"recording {self._partial}")
        self._file = h5py.File(self._disk, "w")  # type: ignore[arg-type]  # the stubs know only names
        for name, value in self._header().items():
            self._file.attrs[name] = value
        for name, value in fixed.items():
            self._file.create_dataset(name, data=value)
        for name in FRAMES:
            self._grow(name, self._profile.frame_shape, frame_type(self._bit_depth))
        self._file.attrs["pages_complete"] = 0
        self._file.flush()
        try:
            self._disk.check()
        except OSError as error:
            self.abandon()
            raise self._failure(f"recording {self._partial}", error, "room for it on the disk") from None

    def _continue(self, references: FramePair, pilots: ArrayLike | None) -> bool:
        """Open the partial file if it is sound and was started with the same arguments.

        Raises:
            RecordingError: another process is writing it, the system does not let it be read, or it has other pages
                that may not be lost.
        """
        fixed = self._checked_fixed(references, pilots)
        if not _take(self._partial, remove=False):
            return False
        subject, expected = f"recording {self._partial}", "a file that can be read and written"
        disk = open_to_write(self._partial, subject, expected, keep=True)
        try:
            file = h5py.File(disk, "r+")  # type: ignore[arg-type]
        except _CUT_OFF as error:
            disk.close()
            _check_damage(self._partial, error)
            return False
        pages, other = 0, ""
        try:
            pages = _pages_of(file)
            other = _difference(file, pages, self._header(), self._symbols)
            if not other and not (
                all(self._is_same(file[name], name, value) for name, value in fixed.items())
                and ("pilots" in file) == ("pilots" in fixed)
            ):
                other = "other settings"
            if same := not other:
                self._file, self._disk = file, disk
                for name in self._growing():
                    if file[name].shape[0] < pages:
                        same = False
                    file[name].resize(pages, axis=0)
                disk.check()
        except _CUT_OFF as error:
            try:
                _check_damage(self._partial, error)
            except LightpageError:
                disk.give_up()
                file.close()
                disk.close()
                raise
            same = False
        except BaseException:
            file.close()
            disk.close()
            raise
        if same:
            self._pages = pages
            return True
        file.close()
        disk.close()
        if pages and other and not self._overwrite:
            raise _others(self._partial, pages, other)
        return False

    def _is_same(self, dataset: h5py.Dataset, name: str, value: NDArray[Any]) -> bool:
        if self._keep_references and name in REFERENCES:
            return dataset.shape == value.shape and dataset.dtype == value.dtype
        return np.array_equal(dataset[()], value)

    def _growing(self) -> list[str]:
        """The datasets that grow by one with each page."""
        names = [name for name in (*FRAMES, "symbols", *SHOT_DATA) if name in self._file]
        truth = self._file.get("truth")
        return names + ([f"truth/{name}" for name in truth] if isinstance(truth, h5py.Group) else [])

    def _check_same_datasets(self, data: Mapping[str, NDArray[Any]]) -> None:
        if self._pages and set(self._growing()) != set(data):
            raise RecordingError(
                f"{self._subject}: page {self._pages}",
                f"datasets {', '.join(sorted(data))}",
                f"{', '.join(sorted(self._growing()))}, as on the pages before",
            )
        for name, value in data.items():
            if name in self._file and self._file[name].shape[1:] != value.shape:
                raise RecordingError(
                    f"{self._subject}: {name}", f"shape {value.shape}", f"shape {self._file[name].shape[1:]}"
                )

    def _grow(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> h5py.Dataset:
        return self._file.create_dataset(
            name, shape=(0, *shape), maxshape=(None, *shape), chunks=(1, *shape), dtype=dtype
        )

    def _write_page(self, name: str, value: NDArray[Any]) -> None:
        dataset = self._file[name] if name in self._file else self._grow(name, value.shape, value.dtype)
        dataset.resize(self._pages + 1, axis=0)
        dataset[self._pages] = value


def _shot_data(infos: Infos) -> dict[str, NDArray[Any]]:
    exposures = [np.nan if info.exposure_s is None else info.exposure_s for info in infos]
    columns = (
        [info.frame_id for info in infos],
        [info.device_time_s for info in infos],
        [info.host_time_s for info in infos],
        exposures,
    )
    return {name: np.array(values, kind) for (name, kind), values in zip(SHOT_DATA.items(), columns, strict=True)}
