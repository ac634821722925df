"""A recording made of the files of other programs, page by page, so that an interruption loses nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import (
    BlackFrameError,
    FrameError,
    InvalidInputError,
    NoSuchPageError,
    PageError,
    SaturatedFrameError,
)
from lightpage.foreign.array import spread
from lightpage.foreign.frames import Counts, Frames, Pages
from lightpage.page.symbols import check_symbols
from lightpage.progress import note, track, warn
from lightpage.recording.exposure import check_different, check_light, unused_low_bits
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import FRAMES, MAX_BIT_DEPTH
from lightpage.recording.pixels.black_level import without_black
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.words import counted

_SAMPLED = 16
"""Frames of either camera that are looked at before the work begins."""
DEPTHS = (8, 10, 12, 14, 16)
"""Bit depths of cameras."""
_PEDESTAL = 0.02
"""Share of full scale that no count of the sampled frames lies below, where a camera's black level is in them."""
_DARK_PERCENT = 5
"""Most pixels of a frame that noise leaves below the right black level."""
_CHANCE = 1e-6
"""Chance that random symbols of all levels are as small as those looked at, below which the levels are doubted."""
_MOST_REFERENCES = 1000


@dataclass(frozen=True)
class Exposure:
    """Kind of the counts of both cameras.

    Attributes:
        bit_depth: of a count, right-aligned.
        unused_bits: of the files' counts, below the first one that is used.
        told: whether the depth was told, not found.
        darkest, brightest: right-aligned counts of the frames that were looked at.
        dark: right-aligned count that a twentieth of their pixels lie below.
    """

    bit_depth: int
    unused_bits: int
    told: bool
    darkest: int
    brightest: int
    dark: int


@dataclass(frozen=True)
class Unlit:
    """A frame that was taken although no decoder will read it.

    Attributes:
        page: its number.
        what: the error that it would have been.
    """

    page: int
    what: str


@dataclass(frozen=True)
class Material:
    """Files that a recording is made of, opened.

    Attributes:
        profile: the nominal device.
        frames, references: of the in-phase and the quadrature camera.
        symbols: of the pages; None where they are unknown.
        levels: M.
        pilots: places of the known symbols, boolean [ny, nx]; None for those of the profile.
        code: what the pages hold, JSON text, where an encoder made them.
        black_level: counts of a camera in the dark.
        levels_told: whether the levels were told, not assumed.
    """

    profile: Profile
    frames: tuple[Frames, Frames]
    references: tuple[Frames, Frames]
    symbols: Pages | None
    levels: int
    pilots: NDArray[np.bool_] | None
    code: str | None
    black_level: int
    levels_told: bool

    @property
    def pages(self) -> int:
        """Number of pages."""
        return len(self.frames[0])

    def check(self) -> None:
        """Check that there is one frame of each camera, and a page of symbols, for every page.

        Raises:
            InvalidInputError: there are more of one than of another.
            FrameError: both cameras have the same frame, or a frame has no counts.
        """
        first, second = self.frames
        if len(first) != len(second):
            got = f"{len(second)} quadrature frames"
            raise InvalidInputError(second.subject, got, f"{len(first)}, as in-phase frames in {first.subject}")
        if self.symbols is not None and self.symbols.count != self.pages:
            got = f"{self.symbols.count} pages of symbols"
            raise InvalidInputError(self.symbols.subject, got, f"{self.pages}, as frames in {first.subject}")
        # references without noise may well be equal
        check_different(f"{second.subject}: frame 0", first.frame(0), second.frame(0), f"{first.subject}: frame 0")
        for references in self.references:
            if len(references) > _MOST_REFERENCES:
                expected = f"one, or up to {_MOST_REFERENCES} exposures whose mean is taken"
                raise InvalidInputError(references.subject, f"{len(references)} reference frames", expected)

    def page_symbols(self, page: int) -> NDArray[np.uint8]:
        """Return the symbols of a page.

        Raises:
            NoSuchPageError: there is no such page.
            PageError: they are no symbols of the levels.
        """
        assert self.symbols is not None  # or nobody asks
        if page >= self.symbols.count:
            raise NoSuchPageError(self.symbols.subject, f"page {page}", f"0 to {self.symbols.count - 1}")
        found, subject = self.symbols.page(page), f"{self.symbols.subject}: page {page}"
        if found.dtype.kind == "f":
            if not np.array_equal(found, np.rint(found)):
                raise PageError(subject, "values that are not whole, or no numbers", "symbols")
            found = found.astype(np.int64)
        return check_symbols(found, self.profile.page_shape, self.levels, subject)


def exposure_of(material: Material, bit_depth: int | None) -> Exposure:
    """Find what the counts are, from some frames of either camera and the references; frames are shifted by it.

    Counts are shifted where they do not fit the depth, or lie at the upper end of 16 bits. Lowest bits that no count of
    a smaller depth uses say nothing: 8 bits scaled to 12 are multiples of 16 too.

    Args:
        material: whose frames are looked at.
        bit_depth: of a count, where it is known.

    Raises:
        FrameError: values that are no counts.
        InvalidInputError, StorageError, SurroundingsError: a frame cannot be read, or the black level is no count.
    """
    peak, unused, darkest = 0, MAX_BIT_DEPTH, (1 << MAX_BIT_DEPTH) - 1
    dark: list[float] = []
    for frames in (*material.frames, *material.references):
        most = _SAMPLED if frames in material.frames else 1
        for frame in frames.sample(most):
            peak = max(peak, int(frame.max()))
            if most > 1:
                darkest = min(darkest, int(frame.min()))
                dark.append(float(np.percentile(frame[::4, ::4], _DARK_PERCENT)))
            # too few different counts, as of a dark frame, tell nothing
            if (found := unused_low_bits(frame, 8 * frame.dtype.itemsize)) is not None:
                unused = min(unused, found)
    if peak < 1 << (bit_depth or MAX_BIT_DEPTH - 1) or unused == MAX_BIT_DEPTH:
        unused = 0
    elif bit_depth is not None:
        unused = wanted if (wanted := MAX_BIT_DEPTH - bit_depth) <= unused else 0
    for frames in (*material.frames, *material.references):
        frames.shift = unused
    brightest = peak >> unused
    depth = bit_depth or (MAX_BIT_DEPTH - unused if unused else next(bits for bits in DEPTHS if peak < 1 << bits))
    if material.black_level >= (most := 2**depth - 1):
        raise InvalidInputError(f"--black-level {material.black_level}", f"counts of {depth} bits", f"0 to {most - 1}")
    return Exposure(depth, unused, bit_depth is not None, darkest >> unused, brightest, int(np.median(dark)) >> unused)


def tell(exposure: Exposure, material: Material) -> None:
    """Tell whoever watches what was found of counts and symbols, and what may be wrong with them.

    Raises:
        PageError: a page that was looked at has no symbols of the levels.
        InvalidInputError, StorageError, SurroundingsError: it cannot be read.
    """
    black_level = material.black_level
    if not exposure.told:
        shifted = (
            f", without the lowest {exposure.unused_bits} bits, which are not used" if exposure.unused_bits else ""
        )
        note(f"counts of {exposure.bit_depth} bits, up to {exposure.brightest}{shifted} (override with --bit-depth)")
    if not black_level and exposure.darkest > _PEDESTAL * 2**exposure.bit_depth:
        warn(
            f"no count of the frames looked at is below {exposure.darkest}: if the cameras count so in the dark, say "
            f"--black-level {exposure.darkest}, or decoding loses information"
        )
    if black_level > exposure.dark:
        warn(
            f"more than {_DARK_PERCENT}% of the counts looked at are below --black-level {black_level} and become 0: "
            f"they reach down to {exposure.darkest}"
        )
    if material.symbols is not None and not material.levels_told:
        _doubt_levels(material, spread(material.pages, _SAMPLED))


def _doubt_levels(material: Material, pages: Sequence[int]) -> None:
    """Warn where the symbols of some pages are so small that the assumed levels are doubtful."""
    found = [material.page_symbols(page) for page in pages]
    levels, count = 1 + max(int(page.max()) for page in found), sum(page.size for page in found)
    if count * math.log(levels / material.levels) < math.log(_CHANCE):
        warn(f"no symbol looked at is above {levels - 1}, and {material.levels} levels are assumed: --levels {levels}?")


def references_of(material: Material, exposure: Exposure) -> FramePair:
    """Return the reference frames, each the rounded mean of its exposures.

    Raises:
        FrameError: black or saturated ones.
    """
    pair = []
    for name, frames in zip(("in-phase", "quadrature"), material.references, strict=True):
        total = np.zeros(material.profile.frame_shape)
        for number in range(len(frames)):
            total += frames.frame(number)
        mean = np.rint(total / len(frames)).astype(np.uint16)
        counts = without_black(mean, material.black_level, exposure.bit_depth)
        check_light(f"{frames.subject}: {name} reference frame", counts, exposure.bit_depth)
        pair.append(mean)
    return FramePair(*pair)


def blemishes_of(path: Path) -> dict[str, dict[str, list[tuple[int, int]]]]:
    """Return the places of blemishes on a recording's references by camera, and tell whoever watches of them."""
    with Recording.open(path) as recording:
        by_camera = dict(zip(FRAMES, Blemishes.of(recording.references()).places(), strict=True))
    for camera, places in by_camera.items():
        if str(places):
            note(f"{camera.replace('_', '-')} camera: {places}; calibration corrects them")
    return {camera: places._asdict() for camera, places in by_camera.items()}


def write(material: Material, exposure: Exposure, writer: RecordingWriter, *, keep_unlit: bool) -> list[Unlit]:
    """Write the pages that a recording lacks, with a progress bar; the light of those that it has is checked too.

    Args:
        material: what it is made of.
        exposure: what the counts are.
        writer: of the recording; pages that it has are left out.
        keep_unlit: whether black and saturated frames are taken.

    Returns:
        Those that were taken.

    Raises:
        FrameError: a frame that holds no counts of the depth, or that is black or saturated and not to be taken.
        PageError: symbols that are none of the levels.
        RecordingError: no room for a page.
    """
    unlit: list[Unlit] = []
    begun = writer.pages
    for page in track(range(material.pages), "import", total=material.pages):
        first, second = (_lit(frames, page, material, exposure, keep_unlit, unlit) for frames in material.frames)
        if page < begun:
            continue
        symbols = None if material.symbols is None else material.page_symbols(page)
        writer.append(symbols, FramePair(first, second))
    return unlit


def _lit(
    frames: Frames, page: int, material: Material, exposure: Exposure, keep_unlit: bool, unlit: list[Unlit]
) -> Counts:
    """Return the frame of a page, whose light is checked."""
    frame = frames.frame(page)
    try:
        counts = without_black(frame, material.black_level, exposure.bit_depth)
        check_light(f"{frames.subject}: page {page}", counts, exposure.bit_depth)
    except (BlackFrameError, SaturatedFrameError) as error:
        if not keep_unlit:
            expected = f"{error.expected}, or --keep-unlit to take it as it is"
            raise type(error)(error.subject, error.got, expected) from None
        unlit.append(Unlit(page, f"{error.subject}: {error.got}"))
    except FrameError as error:
        raise FrameError(error.subject, error.got, f"{error.expected}, or another --bit-depth") from None
    return frame


def describe(unlit: Sequence[Unlit]) -> str:
    """Return number and list of the pages that were taken although no decoder will read them, for people."""
    numbers = sorted({each.page for each in unlit})
    told = ", ".join(map(str, numbers[:10])) + (", ..." if len(numbers) > 10 else "")
    return f"{counted(len(numbers), 'page')} with a black or saturated frame: {told}"
