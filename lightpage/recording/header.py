"""The header of a recording: what holds for all of its pages, read from its attributes and arrays, and checked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lightpage.device.profile import Profile, parse_profile
from lightpage.errors import ProfileError, RecordingError
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.progress import warn
from lightpage.recording.layout import FORMAT, FRAMES, MAX_BIT_DEPTH, MIN_BIT_DEPTH, REFERENCES, VERSION, frame_type
from lightpage.recording.stored import ArrayFile, StoredArray

_SYMBOL_PAGES_AT_ONCE = 64
"""Pages of symbols checked in one read, so that opening a long recording stays small in memory."""


@dataclass(frozen=True)
class Header:
    """Facts that hold for all pages of a recording.

    Attributes:
        subject: the recording, for error messages.
        pages: how many there are.
        bit_depth: bits of a camera count; full scale is 2**bit_depth - 1.
        levels: level count M of the symbols.
        declared_levels: the same as the file states it; None where it does not.
        black_level: counts of a camera in the dark; frames are read free of them.
        frame_shape: camera pixels as (rows, columns).
        page_shape: symbols as (rows, columns); None where the file holds neither symbols nor pilots.
        has_symbols: whether the written symbols are known.
        code_text: what the pages hold, JSON text; None where no encoder made them, or noted it.
        profile_text: the nominal profile as TOML text, or None.
    """

    subject: str
    pages: int
    bit_depth: int
    levels: int
    declared_levels: int | None
    black_level: int
    frame_shape: tuple[int, int]
    page_shape: tuple[int, int] | None
    has_symbols: bool
    code_text: str | None
    profile_text: str | None

    def check_against(self, profile: Profile) -> None:
        """Check that the recording belongs to devices of this profile.

        Raises:
            RecordingError: frames or page of another shape.
        """
        what = "symbols" if self.has_symbols else "pilots"
        for name, kind, unit, own, expected in (
            ("in_phase", "frames", "pixels", self.frame_shape, profile.frame_shape),
            (what, "pages", "symbols", self.page_shape or profile.page_shape, profile.page_shape),
        ):
            if own != expected:
                got, wanted = (f"{rows} x {columns}" for rows, columns in (own, expected))
                wanted = f"{wanted} (profile {profile.name})"
                raise RecordingError(f"{self.subject}: {name}", f"{kind} of {got} {unit}", wanted)

    def own_profile(self) -> Profile | None:
        """The nominal profile that the recording carries; None where it has none that can be read."""
        try:
            return None if self.profile_text is None else self._parsed(self.profile_text)
        except ProfileError:
            return None

    def device(self, given: Profile | None, tell: Callable[[str], None] = warn) -> Profile:
        """The nominal profile of the pages: the one that was given, or else the recording's own.

        An unreadable own profile is ignored. Another page layout is an error; other optics are only a warning.

        Args:
            given: profile that was named, if one was.
            tell: takes the warning of other optics.

        Raises:
            RecordingError: there is none, frames or page have another shape, or the page is laid out otherwise.
            ProfileError: the recording's own is needed, and cannot be read.
        """
        subject = f"{self.subject}: attribute 'profile'"
        if given is None:
            if self.profile_text is None:
                raise RecordingError(subject, "none", "one, or --profile P")
            given = self._parsed(self.profile_text)
        self.check_against(given)
        if (own := self.own_profile()) is not None and (others := _differences(own, given)):
            if own.page != given.page:
                expected = f"what profile {given.name} says: leave --profile out, or import the frames anew with it"
                raise RecordingError(subject, "; ".join(others), expected)
            tell(f"{subject}: {'; '.join(others)}: the named profile is taken, not the recording's")
        return given

    def _parsed(self, text: str) -> Profile:
        return parse_profile(text, f"{self.subject}: attribute 'profile'")


def _differences(own: Profile, given: Profile) -> list[str]:
    """Return what a recording's own profile says otherwise than the one that was given, a line each."""
    told, expected = own.model_dump(), given.model_dump()
    return [
        f"{table}.{key} = {value} (profile {given.name}: {expected[table][key]})"
        for table, values in told.items()
        if isinstance(values, dict)
        for key, value in values.items()
        if expected[table][key] != value
    ]


def read_header(file: ArrayFile) -> Header:
    """Read and check what holds for all pages; of the symbols every one is read, of the frames none.

    Raises:
        RecordingError: no recording, one that is newer than this program, or one that contradicts itself.
        StorageError, SurroundingsError: it cannot be read.
    """
    if not isinstance(found := file.attribute("format"), str) or found != FORMAT:
        got = "none" if found is None else repr(found)
        raise RecordingError(f"{file.subject}: attribute 'format'", got, repr(FORMAT))
    _whole(file, "version", VERSION, VERSION, f"version {VERSION}")
    bit_depth = _whole(file, "camera_bit_depth", MIN_BIT_DEPTH, MAX_BIT_DEPTH)
    levels = _whole(file, "levels", MIN_LEVELS, MAX_LEVELS, default=MAX_LEVELS)
    dark = 2**bit_depth - 2
    black_level = _whole(file, "black_level", 0, dark, f"a whole number from 0 to {dark} counts", default=0)
    text, code = file.attribute("profile"), file.attribute("code")
    if text is not None and not isinstance(text, str):
        raise RecordingError(f"{file.subject}: attribute 'profile'", type(text).__name__, "TOML text")
    pages, *frame_shape = _check_frames(file, bit_depth)
    symbols, pilots = file.array("symbols"), file.array("pilots")
    if pilots is not None:
        _check_pilots(file, pilots)
    if symbols is not None:
        _check_symbols(file, symbols, pilots, pages, levels)
    page = symbols if symbols is not None else pilots
    return Header(
        subject=file.subject,
        pages=pages,
        bit_depth=bit_depth,
        levels=levels,
        declared_levels=None if file.attribute("levels") is None else levels,
        black_level=black_level,
        frame_shape=(frame_shape[0], frame_shape[1]),
        page_shape=None if page is None else (page.shape[-2], page.shape[-1]),
        has_symbols=symbols is not None,
        code_text=code if isinstance(code, str) else None,
        profile_text=text,
    )


def _whole(
    file: ArrayFile, name: str, low: int, high: int, expected: str | None = None, default: int | None = None
) -> int:
    """A root attribute that is a whole number from `low` to `high`."""
    value = file.attribute(name, default)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        got = "none" if value is None else repr(value)
        expected = expected or f"a whole number from {low} to {high}"
        raise RecordingError(f"{file.subject}: attribute '{name}'", got, expected)
    return value


def _dataset(file: ArrayFile, name: str, dimensions: int) -> StoredArray:
    if (found := file.array(name)) is None:
        raise RecordingError(f"{file.subject}: dataset '{name}'", "none", "an array")
    if len(found.shape) != dimensions:
        raise RecordingError(found.subject, f"shape {found.shape}", f"{dimensions} dimensions")
    return found


def _check_frames(file: ArrayFile, bit_depth: int) -> tuple[int, ...]:
    """Check pages and reference frames; returns the shape of the pages' frames."""
    first, kind = _dataset(file, FRAMES[0], 3), frame_type(bit_depth)
    shapes = dict.fromkeys(FRAMES, first.shape) | dict.fromkeys(REFERENCES, first.shape[1:])
    for name, shape in shapes.items():
        found = _dataset(file, name, len(shape))
        # 8-bit counts may come in either type; more bits fit into uint16 only.
        if found.dtype.kind != "u" or not kind.itemsize <= found.dtype.itemsize <= 2:
            raise RecordingError(found.subject, f"type {found.dtype}", f"{kind} for {bit_depth} bits")
        if found.shape != shape:
            raise RecordingError(found.subject, f"shape {found.shape}", f"shape {shape}, as '{FRAMES[0]}' has")
        if 0 in found.shape:
            raise RecordingError(found.subject, f"shape {found.shape}", "at least one page and one pixel")
    return first.shape


def _check_pilots(file: ArrayFile, pilots: StoredArray) -> None:
    _dataset(file, "pilots", 2)
    if pilots.dtype.kind not in "bui":
        raise RecordingError(pilots.subject, f"type {pilots.dtype}", "booleans")
    known, size = np.count_nonzero(file.rows("pilots")), math.prod(pilots.shape)
    if not 0 < known < size:
        raise RecordingError(pilots.subject, f"{known} pilots of {size} symbols", "some of them, not all")


def _check_symbols(file: ArrayFile, symbols: StoredArray, pilots: StoredArray | None, pages: int, levels: int) -> None:
    _dataset(file, "symbols", 3)
    subject, shape = symbols.subject, symbols.shape
    if symbols.dtype != np.uint8:
        raise RecordingError(subject, f"type {symbols.dtype}", "uint8")
    if shape[0] != pages or 0 in shape[1:]:
        raise RecordingError(subject, f"shape {shape}", f"shape ({pages}, ny, nx), as '{FRAMES[0]}' has")
    if pilots is not None and pilots.shape != shape[1:]:
        raise RecordingError(pilots.subject, f"shape {pilots.shape}", f"shape {shape[1:]}, as 'symbols' has")
    for start in range(0, pages, _SYMBOL_PAGES_AT_ONCE):
        stop = min(start + _SYMBOL_PAGES_AT_ONCE, pages)
        highest = int(file.rows("symbols", start, stop).max())
        if highest >= levels:
            raise RecordingError(subject, f"a symbol of {highest}", f"0 to {levels - 1}, since levels = {levels}")
