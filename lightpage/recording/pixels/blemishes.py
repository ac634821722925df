"""Blemishes of a camera, found on its reference-only frame: pixels without a signal, and places behind dust.

A reference is a smooth beam. A pixel far above it is hot, and one that counts next to nothing is dead. Dust on a sensor
darkens signal and reference alike, so its shadow is divided out of both. Structure of the beam itself, such as fringes,
is as often bright as dark, and is left as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair
from lightpage.words import counted

Counts = NDArray[np.integer[Any]]
Image = NDArray[np.float32]

UNIT_GAIN = 64
"""Stored gain of a pixel without a blemish. Gains are bytes; that of a pixel without a signal is 0."""
_BLOCK_PX = 8
"""Side of the blocks of pixels by which the beam is known."""
_BEAM_BLOCKS = 7
"""Side of the median filter of these blocks: wide enough for a shadow of 25 pixels to be a minority."""
_PROFILE_DEGREE = 4
"""Degree along either axis of the logarithm of the beam's profile."""
_LEAST_BEAM = 0.05
"""Light, over the brightest, below which a place is beside the beam, and has no blemishes."""
_TINY = 1e-6
_DEVIATIONS = 7.0
"""Standard deviations of the noise from which on a pixel or a place differs from the beam."""
_LEAST_SHADE = 0.05
"""Least share of the light that a shadow takes in its middle."""
_EDGE_SHADE = 0.02
"""Share of the light that a shadow takes at its edge."""
_SEARCHED_PX = 1.5
"""Standard deviation of the filter with which shadows are searched, pixels."""
_REACH_PX = 8
"""Distance from the middle of a shadow to which its edge is followed, pixels."""
_BESIDE_PX = 8.0
"""Standard deviation of the filter by which the light beside a shadow is known within it, pixels."""
_SMOOTHINGS_PX = (0.0, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Standard deviations of filters with which a shadow may be measured; the first whose noise is low enough is taken."""
_MOST_NOISE = 0.03
"""Largest noise of a measured shadow, over the light."""
_MOST_BRIGHT = 1 / 3
"""Largest number of places that are too bright, over that of places that are too dark, if these are shadows."""
_MOST_SHADE = 0.2
"""Largest share of all pixels that are in shadows; more belong to the beam."""
_JOINED_PX = 3
"""Half of the distance to which shaded pixels belong to one shadow."""
_NAMED = 3
"""Places that are named of each kind."""
_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


class Places(NamedTuple):
    """Places of a camera's blemishes, (column, row) of pixels.

    Attributes:
        lost: pixels without a signal.
        specks: middles of the shadows of dust.
    """

    lost: list[tuple[int, int]]
    specks: list[tuple[int, int]]

    @classmethod
    def of(cls, gains: NDArray[np.uint8]) -> Self:
        """Find the places of gains [H, W], see `Blemishes`."""
        lost = [(int(column), int(row)) for row, column in np.argwhere(gains == 0)]
        shaded = gains > UNIT_GAIN
        shadows, count = scipy.ndimage.label(scipy.ndimage.binary_dilation(shaded, iterations=_JOINED_PX))
        middles = scipy.ndimage.center_of_mass(shaded, shadows, range(1, count + 1))
        return cls(lost, [(round(column), round(row)) for row, column in middles])

    def __str__(self) -> str:
        """Numbers and first places in words, empty where there are none."""
        parts = []
        for places, what in ((self.lost, "hot or dead pixel"), (self.specks, "dust speck")):
            if places:
                first = ", ".join(f"({x}, {y})" for x, y in places[:_NAMED])
                more = ", ..." if len(places) > _NAMED else ""
                parts.append(f"{counted(len(places), what)} at {first}{more}")
        return "; ".join(parts)


@dataclass(frozen=True)
class Blemishes:
    """Blemishes of both cameras.

    Attributes:
        gains: factor of each pixel's count times `UNIT_GAIN`, 0 where it has no signal, uint8 [2, H, W].
        references: reference-only frames without the blemishes.
    """

    gains: NDArray[np.uint8]
    references: FramePair

    @classmethod
    def of(cls, references: FramePair) -> Self:
        """Find the blemishes of both cameras on their reference-only frames."""
        frames = references.in_phase, references.quadrature
        gains, corrected = zip(*map(_camera_blemishes, frames), strict=True)
        return cls(np.stack(gains), FramePair(*corrected))

    @classmethod
    def behind(cls, passed: Image, references: FramePair) -> Self:
        """Blemishes of cameras behind dust, of whose light a share passes, [2, H, W]; clean references."""
        return cls(np.minimum(np.rint(UNIT_GAIN / passed), np.iinfo(np.uint8).max).astype(np.uint8), references)

    def joined(self, other: Self) -> Self:
        """Return these blemishes with others beside them that the references do not show."""
        gains = self.gains.astype(np.float32) * other.gains / UNIT_GAIN
        return replace(self, gains=np.minimum(np.rint(gains), np.iinfo(np.uint8).max).astype(np.uint8))

    @property
    def unit_gains(self) -> NDArray[np.uint8]:
        """Gains of frames that are already `corrected`."""
        return np.full_like(self.gains, UNIT_GAIN)

    @property
    def none(self) -> bool:
        """Return whether no pixel has a blemish."""
        return bool((self.gains == UNIT_GAIN).all())

    @property
    def lost(self) -> tuple[int, int]:
        """Numbers of pixels without a signal, of both cameras."""
        in_phase, quadrature = np.count_nonzero(self.gains == 0, axis=(1, 2)).tolist()
        return in_phase, quadrature

    @property
    def shaded(self) -> tuple[int, int]:
        """Numbers of pixels in shadows, of both cameras."""
        in_phase, quadrature = np.count_nonzero(self.gains > UNIT_GAIN, axis=(1, 2)).tolist()
        return in_phase, quadrature

    def places(self) -> tuple[Places, Places]:
        """Return where each camera has its blemishes."""
        in_phase, quadrature = map(Places.of, self.gains)
        return in_phase, quadrature

    def corrected(self, pair: FramePair) -> FramePair:
        """Return the frames of a page without the blemishes; pixels without a signal count what their references do."""
        if self.none:
            return pair
        frames = pair.in_phase, pair.quadrature
        references = self.references.in_phase, self.references.quadrature
        return FramePair(*map(_corrected, frames, self.gains, references))


def _camera_blemishes(reference: Counts) -> tuple[NDArray[np.uint8], Counts]:
    """Gains of a camera's pixels, and its reference without the blemishes."""
    counts = reference.astype(np.float32)
    beam = _beam(counts)
    # a hot pixel stands out from the beam and from its neighbours
    usual = np.maximum(beam, scipy.ndimage.median_filter(counts, 3))
    noise = _DEVIATIONS * _spread((counts - beam) / np.sqrt(beam + 1)) * np.sqrt(beam + 1)
    hot = _inside(beam) & (counts > usual + noise)
    clean = np.where(hot, beam, counts)
    beam = _beam(clean)
    passed = _passed(clean, beam)
    lost = hot | (passed < UNIT_GAIN / np.iinfo(np.uint8).max)
    gains = np.where(lost, 0, np.rint(UNIT_GAIN / np.where(lost, 1, passed))).astype(np.uint8)
    return gains, _corrected(reference, gains, np.rint(beam).astype(reference.dtype))


def _passed(counts: Image, beam: Image) -> Image:
    """Share of the light that passes the dust before each pixel, 1 where there is none, [H, W].

    Args:
        counts: counts of the reference without hot pixels.
        beam: counts of the smooth beam.
    """
    searched = scipy.ndimage.gaussian_filter((counts - beam) / np.sqrt(beam + 1), _SEARCHED_PX)
    threshold = _DEVIATIONS * _spread(searched)
    shade = scipy.ndimage.gaussian_filter(counts, _SEARCHED_PX) < (1 - _LEAST_SHADE) * beam
    inside = _inside(beam)
    dark = inside & (searched < -threshold) & shade
    bright = np.count_nonzero(inside & (searched > threshold))
    if not dark.any() or bright > _MOST_BRIGHT * np.count_nonzero(dark):
        return np.ones_like(counts)
    near = scipy.ndimage.distance_transform_edt(~dark) <= _REACH_PX
    if np.count_nonzero(near) > _MOST_SHADE * near.size:
        return np.ones_like(counts)
    relative = counts / beam
    beside = scipy.ndimage.gaussian_filter((~near).astype(np.float32), _BESIDE_PX)
    # the beam within a shadow is as it is beside it
    relative /= scipy.ndimage.gaussian_filter(np.where(near, 0, relative), _BESIDE_PX) / np.maximum(beside, _TINY)
    unshaded = ~near & (beam > np.median(beam))
    filtered = relative
    for smoothing in _SMOOTHINGS_PX:
        filtered = scipy.ndimage.gaussian_filter(relative, smoothing) if smoothing else relative
        if _spread(filtered[unshaded]) <= _MOST_NOISE:
            break
    return np.where(near & (filtered < 1 - _EDGE_SHADE), filtered, 1).astype(np.float32)


def _inside(beam: Image) -> NDArray[np.bool_]:
    """Return where the beam is bright enough for blemishes to be found, [H, W]."""
    return np.asarray(beam > 2 * _LEAST_BEAM * beam.max())


def _beam(counts: Image) -> Image:
    """Counts of the smooth beam at each pixel, [H, W].

    A smooth profile is fitted to the logarithm of blocks of pixels, and corrected by the medians of blocks near by.
    """
    rows, columns = counts.shape
    padded = np.pad(counts, ((0, -rows % _BLOCK_PX), (0, -columns % _BLOCK_PX)), mode="edge")
    blocks = padded.reshape(padded.shape[0] // _BLOCK_PX, _BLOCK_PX, -1, _BLOCK_PX).mean(axis=(1, 3))
    blocks = np.maximum(blocks, _LEAST_BEAM * blocks.max() + _TINY)
    y, x = (np.linspace(-1, 1, size) for size in blocks.shape)
    terms = np.polynomial.polynomial.polyvander2d(*np.meshgrid(x, y), [_PROFILE_DEGREE] * 2).reshape(blocks.size, -1)
    logarithm = np.log(blocks).ravel()
    weight = np.sqrt(blocks).ravel()
    profile = terms @ np.linalg.lstsq(terms * weight[:, None], logarithm * weight, rcond=None)[0]
    profile = np.exp(profile).reshape(blocks.shape)
    smooth = profile * scipy.ndimage.median_filter(blocks / profile, _BEAM_BLOCKS)
    places = [(np.arange(size) - (_BLOCK_PX - 1) / 2) / _BLOCK_PX for size in counts.shape]
    at = np.meshgrid(*places, indexing="ij")
    return np.asarray(scipy.ndimage.map_coordinates(smooth, at, order=1, mode="nearest"), np.float32)


def _spread(values: NDArray[np.floating]) -> float:
    """Standard deviation of values whose outliers do not count."""
    return _MAD * float(np.median(np.abs(values - np.median(values))))


def _corrected(frame: Counts, gains: NDArray[np.uint8], reference: Counts) -> Counts:
    """Frame [H, W] with the gains of its pixels, and with the reference where they have no signal."""
    corrected = frame.copy()
    shaded = gains > UNIT_GAIN
    raised = np.rint(frame[shaded] * (gains[shaded] / UNIT_GAIN))
    corrected[shaded] = np.minimum(raised, np.iinfo(frame.dtype).max).astype(frame.dtype)
    corrected[gains == 0] = reference[gains == 0]
    return corrected
