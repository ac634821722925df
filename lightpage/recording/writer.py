"""Writing a recording page by page, so that an interruption loses nothing and nothing half-written is ever loaded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import asdict, astuple
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lightpage.device.profile import Profile
from lightpage.errors import LightpageError, PageError, RecordingError
from lightpage.failures import os_failure
from lightpage.files import move_into_place, move_to_new_name
from lightpage.page.levels import check_levels
from lightpage.page.symbols import check_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.hdf_file import open_to_write
from lightpage.recording.layout import (
    CAMERAS,
    DARK,
    FRAMES,
    HOT,
    LOSSES,
    MAX_BIT_DEPTH,
    MIN_BIT_DEPTH,
    REFERENCES,
    SHOT_DATA,
    FrameInfo,
    LostShot,
    frame_type,
)
from lightpage.recording.unfinished import (
    CUT_OFF,
    Identity,
    Symbols,
    check_damage,
    discard_partial,
    growing,
    other_pages,
    pages_of,
    partial_path,
    taken,
)
from lightpage.words import counted

Infos = tuple[FrameInfo, FrameInfo]
HotPixels = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Of both cameras, [n, 2]: row and column."""


class RecordingWriter(AbstractContextManager["RecordingWriter"]):
    """Writes a recording page by page to `<path>.partial`, and moves it to `path` when the `with` statement ends well.

    After an exception, Ctrl-C included, the partial file stays behind, complete up to the last page appended; a writer
    that is to `resume` goes on from there. A half-written file is never found under the final name.

    Attributes:
        path, partial_path: final name, and the file that is being written.
        pages: written so far.
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
        black_level: int = 0,
    ) -> None:
        """Start a new recording; a partial file of the same name that nobody is writing is overwritten.

        Args:
            path: final name.
            profile: nominal profile; fixes the shapes and is kept as TOML text.
            levels: M, 2 to 256.
            bit_depth: bits of a camera count, 8 to 16.
            references: reference-only frames.
            pilots: boolean [ny, nx]; None leaves the profile's default positions in force.
            resume: whether a partial file is gone on with that was started with the same arguments.
            code: what the pages hold, JSON text, where they were made by an encoder.
            keep_references: whether a recording that is gone on with keeps its own reference frames, where `references`
                are others: no camera takes the same ones twice.
            symbols: of the pages to come; a recording whose pages have others is not gone on with.
            overwrite: whether a file that has the final name, then or at the end, and pages of a recording that is not
                gone on with, may be lost.
            black_level: counts of a camera in the dark, which all frames still have; readers take it off.

        Raises:
            RecordingError: wrong bit depth, black level, frames or pilots, or the file cannot be written or is being
                written; or there is something that may not be lost.
            PageError: a level count outside 2..256.
        """
        self.path, self.pages = Path(path), 0
        self.partial_path = partial_path(self.path)
        self._subject = f"recording {self.path}"
        check_levels(levels, f"{self._subject}: levels")
        if not MIN_BIT_DEPTH <= bit_depth <= MAX_BIT_DEPTH:
            raise RecordingError(f"{self._subject}: bit depth", bit_depth, f"{MIN_BIT_DEPTH} to {MAX_BIT_DEPTH}")
        if not 0 <= black_level < (most := 2**bit_depth - 1):
            raise RecordingError(f"{self._subject}: black level", black_level, f"0 to {most - 1}")
        self._identity = Identity(profile, levels, bit_depth, code, symbols, black_level)
        self._overwrite = overwrite
        if not overwrite and self.path.exists():
            raise self._exists()
        fixed = self._checked_fixed(references, pilots)
        if not (resume and self._continue(fixed, REFERENCES if keep_references else ())):
            self._create(fixed)

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
            subject, identity = f"{self._subject}: symbols", self._identity
            data["symbols"] = check_symbols(symbols, identity.profile.page_shape, identity.levels, subject)
            if data["symbols"].ndim != 2:
                raise PageError(subject, f"shape {data['symbols'].shape}", "one page [ny, nx]")
        data |= {f"truth/{name}": np.asarray(value) for name, value in (truth or {}).items()}
        if infos is not None:
            data |= _shot_data(infos)
        self._check_same_datasets(data)
        if infos is not None and "serials" not in (group := self._file.require_group(CAMERAS)).attrs:
            group.attrs["serials"] = [info.serial for info in infos]
            group.attrs["pixel_formats"] = [info.pixel_format for info in infos]
        try:
            for name, value in data.items():
                dataset = self._file[name] if name in self._file else self._grow(name, value.shape, value.dtype)
                dataset.resize(self.pages + 1, axis=0)
                dataset[self.pages] = value
            # The count comes last: pages beyond it were cut off in the middle, and resuming drops them.
            self._file.attrs["pages_complete"] = self.pages + 1
            self._file.flush()
            self._disk.check()
        except OSError as error:
            raise self._failure(f"{self._subject}: page {self.pages}", error, "room for it on the disk") from None
        self.pages += 1

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
        """Keep remarks on the whole recording as attributes of the group `name`, where no decoder looks.

        The group `truth` has the true state of a simulated device.
        """
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
            (move_into_place if self._overwrite else move_to_new_name)(self.partial_path, self.path)  # still locked
        except FileExistsError:
            raise self._exists() from None
        except OSError as error:
            raise self._failure(self._subject, error, "a file that can be completed") from None
        finally:
            self._disk.close()

    def abandon(self) -> None:
        """Close the partial file and leave it for a writer that is to `resume`."""
        self._file.close()
        self._disk.close()

    def _failure(self, subject: str, error: OSError, expected: str) -> LightpageError:
        """The error of a write, which says what stays of the pages before."""
        failure = os_failure(subject, error, expected, RecordingError)
        if not self.pages:
            return failure
        kept = f"{counted(self.pages, 'page')} stay in {self.partial_path.name}; the same command goes on with them"
        return type(failure)(subject, failure.got, f"{failure.expected}. {kept}")

    def _exists(self) -> RecordingError:
        there = f"; the pages are in {self.partial_path}" if self.pages else ""
        return RecordingError(self._subject, "a file that exists by now", f"a new name, or --force{there}")

    def _checked(self, name: str, frame: NDArray[Any]) -> NDArray[Any]:
        frame = np.asarray(frame)
        subject, identity = f"{self._subject}: {name}", self._identity
        if frame.dtype.kind not in "ui":
            raise RecordingError(subject, f"type {frame.dtype}", "whole counts")
        if frame.shape != identity.profile.frame_shape:
            raise RecordingError(subject, f"shape {frame.shape}", f"shape {identity.profile.frame_shape}")
        full_scale = 2**identity.bit_depth - 1
        if int(frame.min()) < 0 or int(frame.max()) > full_scale:
            raise RecordingError(subject, f"counts from {frame.min()} to {frame.max()}", f"0 to {full_scale}")
        return frame.astype(frame_type(identity.bit_depth), copy=False)

    def _checked_fixed(self, references: FramePair, pilots: ArrayLike | None) -> dict[str, NDArray[Any]]:
        """The datasets that do not grow."""
        fixed = {name: self._checked(name, getattr(references, name.removeprefix("reference_"))) for name in REFERENCES}
        if pilots is not None:
            mask, shape = np.asarray(pilots), self._identity.profile.page_shape
            if mask.dtype != np.bool_ or mask.shape != shape:
                got = f"{mask.dtype} of shape {mask.shape}"
                raise RecordingError(f"{self._subject}: pilots", got, f"bool of shape {shape}")
            fixed["pilots"] = mask
        return fixed

    def _create(self, fixed: Mapping[str, NDArray[Any]]) -> None:
        discard_partial(self.path)
        self._disk = open_to_write(self.partial_path, f"recording {self.partial_path}")
        self._file = h5py.File(self._disk, "w")  # type: ignore[arg-type]  # the stubs know only names
        self._file.attrs.update(self._identity.attributes())
        for name, value in fixed.items():
            self._file.create_dataset(name, data=value)
        for name in FRAMES:
            self._grow(name, self._identity.profile.frame_shape, frame_type(self._identity.bit_depth))
        self._file.attrs["pages_complete"] = 0
        self._file.flush()
        try:
            self._disk.check()
        except OSError as error:
            self.abandon()
            raise self._failure(f"recording {self.partial_path}", error, "room for it on the disk") from None

    def _continue(self, fixed: Mapping[str, NDArray[Any]], kept: tuple[str, ...]) -> bool:
        """Open the partial file if it is sound and was started with the same arguments.

        Args:
            fixed: the datasets that do not grow.
            kept: names of those that may hold something else.

        Raises:
            RecordingError: another process is writing it, the system does not let it be read, or it has other pages
                that may not be lost.
        """
        partial, pages, other = self.partial_path, 0, ""
        if not taken(partial, remove=False):
            return False
        disk = open_to_write(partial, f"recording {partial}", "a file that can be read and written", keep=True)
        with ExitStack() as opened:
            opened.enter_context(closing(disk))
            try:
                file = opened.enter_context(h5py.File(disk, "r+"))  # type: ignore[arg-type]
                pages = pages_of(file)
                other = self._identity.difference(file, pages)
                if not other and not (
                    all(_is_same(file[name], value, name not in kept) for name, value in fixed.items())
                    and ("pilots" in file) == ("pilots" in fixed)
                ):
                    other = "other settings"
                if not other and all(file[name].shape[0] >= pages for name in growing(file)):
                    for name in growing(file):
                        file[name].resize(pages, axis=0)
                    disk.check()
                    self._file, self._disk, self.pages = file, disk, pages
                    opened.pop_all()
                    return True
            except CUT_OFF as error:
                try:
                    check_damage(partial, error)
                except LightpageError:
                    disk.give_up()
                    raise
        if pages and other and not self._overwrite:
            raise other_pages(partial, pages, other)
        return False

    def _check_same_datasets(self, data: Mapping[str, NDArray[Any]]) -> None:
        if self.pages and set(there := growing(self._file)) != set(data):
            expected = f"{', '.join(sorted(there))}, as on the pages before"
            raise RecordingError(f"{self._subject}: page {self.pages}", f"datasets {', '.join(sorted(data))}", expected)
        for name, value in data.items():
            if name in self._file and (expected := self._file[name].shape[1:]) != value.shape:
                raise RecordingError(f"{self._subject}: {name}", f"shape {value.shape}", f"shape {expected}")

    def _grow(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> h5py.Dataset:
        return self._file.create_dataset(name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(1, *shape))


def _is_same(dataset: h5py.Dataset, value: NDArray[Any], exactly: bool) -> bool:
    """Return whether a dataset holds a value, or at least one of its kind."""
    if exactly:
        return np.array_equal(dataset[()], value)
    return dataset.shape == value.shape and dataset.dtype == value.dtype


def _shot_data(infos: Infos) -> dict[str, NDArray[Any]]:
    _, ids, device, host, _, exposures = zip(*map(astuple, infos), strict=True)
    known = [np.nan if exposure is None else exposure for exposure in exposures]
    columns = zip(SHOT_DATA.items(), (ids, device, host, known), strict=True)
    return {name: np.array(values, kind) for (name, kind), values in columns}
