"""Looks at HDF5 files: recordings, pages to write, decoded pages, and those of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from lightpage.device.profile import Profile
from lightpage.errors import FrameError, InvalidInputError
from lightpage.foreign.array import MOST_BYTES, spread
from lightpage.inspection.exposure import contrast, histogram
from lightpage.inspection.finding import Fact, Finding, Picture, shape_fact, shape_text
from lightpage.inspection.foreign_files import look_at_hdf5
from lightpage.page.symbols import pilot_mask
from lightpage.recording import decoded_file, layout, pages
from lightpage.recording.exposure import check_different, check_pair_light
from lightpage.recording.hdf5 import find, open_hdf5, read_attribute
from lightpage.recording.pages import Pages
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.recording.reader import Recording
from lightpage.recording.stored import ArrayFile
from lightpage.recording.unfinished import pages_of
from lightpage.waves.grid import check_camera

_SAMPLE_BYTES = 1 << 26
"""Of frames that are read."""
_MOST_PAGES = 8
_MOST_PILOTS = 0.5
"""Share of pilots that a profile has to stay below."""
_DIFFERENT = "frames of two cameras"
_NEEDED = "data as docs/reference/formats.md describes them"


def look_at(path: Path, profile: Profile | None) -> Finding:
    """Return what an HDF5 file is.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: it cannot be opened.
    """
    subject = f"file {path}"
    with open_hdf5(path, subject) as file:
        told = str(read_attribute(file, "format", subject))
        _check_sizes(file, subject)
        unfinished = "pages_complete" in file.attrs
        if told == layout.FORMAT and unfinished:
            return _unfinished(path, file)
        if told == decoded_file.FORMAT:
            return _decoded(path, file)
    if told == layout.FORMAT:
        return _recording(path, profile)
    if told == pages.FORMAT:
        return _pages(path, profile)
    return look_at_hdf5(path, profile)


def _check_sizes(file: h5py.File, subject: str) -> None:
    """Check that a page of no array is so large that reading it would take all memory."""
    for name in (*layout.FRAMES, *layout.REFERENCES, "symbols", "pilots"):
        found = find(file, name, subject)
        if isinstance(found, h5py.Dataset) and found.shape:
            shape = found.shape[1:] if len(found.shape) > 2 else found.shape
            if (size := int(np.prod(shape, dtype=float)) * found.dtype.itemsize) > MOST_BYTES:
                got = f"a page of {size / 1e9:.3g} GB, shape {found.shape}"
                raise InvalidInputError(f"{subject}: dataset '{name}'", got, f"at most {MOST_BYTES / 1e9:.3g} GB")


def _unfinished(path: Path, file: h5py.File) -> Finding:
    found = Finding(path, "unfinished recording")
    with found.trying(_NEEDED):
        found.facts["pages so far"] = pages_of(file)
    found.problems.append("it is being written, or its writing was stopped: the same command goes on with it")
    return found


def _decoded(path: Path, file: h5py.File) -> Finding:
    found = Finding(path, "decoded pages")
    with found.trying(_NEEDED):
        arrays = ArrayFile(file, f"file {path}")
        symbols = arrays.array("symbols")
        if symbols is None or len(symbols.shape) != 3:
            raise InvalidInputError(f"file {path}: dataset 'symbols'", "no pages", "(pages, ny, nx)")
        found.facts |= {"pages": symbols.shape[0], "symbols": shape_fact(symbols.shape[1:])}
        found.facts["levels"] = arrays.attribute("levels")
    return found


def _pages(path: Path, profile: Profile | None) -> Finding:
    found = Finding(path, "pages to write")
    with found.trying(_NEEDED), Pages.open(path) as written:
        found.facts |= {"pages": len(written), "symbols": shape_fact(written.page_shape), "levels": written.levels}
        _tell_code(found, written.code)
        found.profile = written.device(profile)
        first = written[0]
        found.pictures = lambda: [("page 0", first, "symbol")]
        found.next += [
            f"lightpage record --source camera:CONFIG.toml --symbols {found.quoted} --out R.h5",
            f"lightpage simulate --symbols {found.quoted} --out R.h5",
        ]
    return found


def _tell_code(found: Finding, text: str | None) -> bool:
    """Tell of the file that pages hold; returns whether they hold one."""
    if text is None:
        return False
    with found.trying("a code, JSON"):
        told = json.loads(text)
        if not isinstance(told, dict):
            raise ValueError("no object")
        names = {"volume": "volume", "file_bytes": "file, bytes", "page_bytes": "user bytes a page"}
        found.facts |= {name: told[key] for key, name in names.items() if key in told}
        return True
    return False


def _recording(path: Path, profile: Profile | None) -> Finding:
    found = Finding(path, "recording")
    with found.trying(_NEEDED), Recording.open(path) as recording:
        header, page = recording.header, recording.page_shape
        found.facts |= {
            "pages": recording.pages,
            "frames": _frames(recording),
            "black level": header.black_level,
            "symbols": _symbols(recording),
            "page": Fact(None, "the profile's") if page is None else Fact(list(page), f"{shape_text(page)} symbols"),
        }
        coded = _tell_code(found, header.code_text)
        with found.trying("a profile that fits"):
            found.profile = header.device(profile, found.problems.append)
            check_camera(found.profile)
            found.facts["profile"] = f"{found.profile.name}{' (its own)' if profile is None else ''}"
        _pilots(found, recording)
        _exposure(found, recording)
        found.pictures = lambda: _pictures(path)
        _next(found, recording, coded)
    return found


def _frames(recording: Recording) -> Fact:
    rows, columns = recording.frame_shape
    value = {"rows": rows, "columns": columns, "bit_depth": recording.bit_depth}
    return Fact(value, f"{rows} x {columns} pixels, {recording.bit_depth} bits")


def _symbols(recording: Recording) -> Fact:
    levels = recording.levels if recording.has_symbols else None
    text = "unknown" if levels is None else f"known, {levels} levels"
    return Fact({"known": levels is not None, "levels": levels}, text)


def _pilots(found: Finding, recording: Recording) -> None:
    """Tell how many symbols of a page are pilots: the recording's own, or its profile's."""
    own = recording.pilots()
    if (places := own if own is not None or found.profile is None else pilot_mask(found.profile)) is None:
        return
    count, share = int(np.count_nonzero(places)), float(np.mean(places))
    found.facts["pilots"] = Fact({"count": count, "share": share}, f"{count} ({share:.1%} of the symbols)")
    if share >= _MOST_PILOTS:
        found.problems.append(f"{count} pilots of {places.size} symbols, wanted less than half")


def _exposure(found: Finding, recording: Recording) -> None:
    """Tell how some frames are exposed, and the references."""
    pair = recording.references()
    with found.trying("reference frames with light"):
        check_pair_light("reference: ", pair, recording.bit_depth)
    frame_bytes = 2 * pair.in_phase.nbytes
    looked_at = spread(recording.pages, max(1, min(_MOST_PAGES, _SAMPLE_BYTES // frame_bytes)))
    unlit, frames = [], []
    for page in looked_at:
        frames.append(recording.frames(page))
        try:
            check_pair_light("", frames[-1], recording.bit_depth)
        except FrameError as error:
            unlit.append(f"page {page}: {error.subject} {error.got}")
        with found.trying(_DIFFERENT):
            check_different(f"page {page}: quadrature", frames[-1].in_phase, frames[-1].quadrature, "in-phase")
    found.facts["pages looked at"] = Fact(looked_at, ", ".join(map(str, looked_at)))
    found.problems += unlit
    for name, reference in zip(layout.FRAMES, (pair.in_phase, pair.quadrature), strict=True):
        own = [getattr(each, name) for each in frames]
        found.histograms[name] = histogram(own, recording.bit_depth)
        saturated = found.histograms[name].saturated
        found.facts[f"{name}: saturated"] = Fact(saturated, f"{saturated:.2%} of the pixels")
        fringes = float(np.mean([contrast(each, reference) for each in own]))
        found.facts[f"{name}: contrast of fringes"] = Fact(fringes, f"{fringes:.2f}")
    with found.trying("references of a smooth beam"):
        for name, places in zip(layout.FRAMES, Blemishes.of(pair).places(), strict=True):
            found.facts[f"{name}: blemishes"] = Fact(places._asdict(), str(places) or "none")


def _next(found: Finding, recording: Recording, coded: bool) -> None:
    """Tell what can be done with a recording."""
    profile = "" if recording.header.own_profile() is not None else " --profile P"
    if recording.has_symbols:
        found.next += [
            f"lightpage calibrate{profile} --recording {found.quoted} --out C.toml",
            f"lightpage train{profile} --recording {found.quoted} --calibration C.toml --out RUN",
            f"lightpage evaluate --bundle B.zip --recording {found.quoted}",
        ]
    if coded:
        found.next.append(f"lightpage recover --bundle B.zip --recording {found.quoted} --out FILE")
    elif not recording.has_symbols:
        found.next.append(f"lightpage bulk decode RUN --bundle B.zip --recordings {found.quoted}")


def _pictures(path: Path) -> list[Picture]:
    """Return frames and references, fringes of the in-phase camera, and a page."""
    with Recording.open(path) as recording:
        pair, reference = recording.frames(0), recording.references()
        lit = np.maximum(reference.in_phase, 1)
        drawn: list[Picture] = [
            ("in-phase frame, page 0", pair.in_phase, "counts"),
            ("quadrature frame, page 0", pair.quadrature, "counts"),
            ("in-phase reference", reference.in_phase, "counts"),
            ("quadrature reference", reference.quadrature, "counts"),
            ("fringes: in-phase over reference, middle", _middle(pair.in_phase / lit), "ratio"),
        ]
        symbols = recording.symbols(0)
        return drawn if symbols is None else [*drawn, ("symbols of page 0", symbols, "symbol")]


def _middle(frame: np.ndarray, side: int = 96) -> np.ndarray:
    """Return the middle of a frame."""
    rows, columns = (slice(max(0, size // 2 - side), size // 2 + side) for size in frame.shape)
    return frame[rows, columns]
