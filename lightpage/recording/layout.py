"""The layout of a recording and the frame pair in it: what its reader and its writer share."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair

FORMAT = "lightpage-recording"
VERSION = 1
MIN_BIT_DEPTH = 8
MAX_BIT_DEPTH = 16

FRAMES = ("in_phase", "quadrature")
REFERENCES = ("reference_in_phase", "reference_quadrature")

CAMERAS = "cameras"
"""Group of what cameras say; optional, with every dataset in it."""
SHOT_DATA = {
    "cameras/frame_ids": np.dtype(np.uint64),
    "cameras/device_times_s": np.dtype(np.float64),
    "cameras/host_times_s": np.dtype(np.float64),
    "cameras/exposures_s": np.dtype(np.float64),
}
"""[page, 2], of the in-phase and the quadrature frame; an exposure that is not known is NaN."""
DARK = ("cameras/dark_in_phase", "cameras/dark_quadrature")
HOT = ("cameras/hot_in_phase", "cameras/hot_quadrature")
LOSSES = "cameras/losses"


@dataclass(frozen=True)
class FrameInfo:
    """Facts of a frame that a camera and its driver state.

    Attributes:
        serial: of the camera.
        frame_id: the camera's own count of frames; it wraps.
        device_time_s: of the exposure, by the camera's clock, seconds from any moment.
        host_time_s: when the frame was complete, seconds since 1970.
        pixel_format: as GenICam names it, e.g. ``Mono8``.
        exposure_s: None where it is not known.
    """

    serial: str
    frame_id: int
    device_time_s: float
    host_time_s: float
    pixel_format: str
    exposure_s: float | None = None


@dataclass(frozen=True)
class LostShot:
    """A shot that gave no page.

    Attributes:
        page: that was to be photographed.
        reason: a word, e.g. ``MISSING_FRAME``.
        detail: for people.
        time_s: seconds since 1970.
    """

    page: int
    reason: str
    detail: str
    time_s: float


def hash_frames(frames: FramePair) -> str:
    """SHA-256 of a frame pair with its types and shapes, in hex: the identity of a recorded page."""
    digest = hashlib.sha256()
    for frame in (frames.in_phase, frames.quadrature):
        little_endian = np.ascontiguousarray(frame, dtype=frame.dtype.newbyteorder("<"))
        digest.update(f"{frame.dtype.name}{frame.shape}".encode())
        digest.update(little_endian.tobytes())
    return digest.hexdigest()


def page_hashes(frames: FramePair) -> frozenset[str]:
    """`hash_frames` of a pair in each type that its counts may be stored in: one page may go by any of them."""
    forms = [_forms(frame) for frame in (frames.in_phase, frames.quadrature)]
    return frozenset(hash_frames(FramePair(*pair)) for pair in product(*forms))


def _forms(frame: NDArray[np.integer[Any]]) -> list[NDArray[np.integer[Any]]]:
    """The frame in each type of a recording that holds its counts."""
    highest = int(frame.max(initial=0))
    return [frame.astype(kind, copy=False) for kind in (np.uint8, np.uint16) if highest <= np.iinfo(kind).max]


def frame_type(bit_depth: int) -> np.dtype[np.unsignedinteger[Any]]:
    """The smallest type that holds a camera count of `bit_depth` bits."""
    return np.dtype(np.uint8 if bit_depth == MIN_BIT_DEPTH else np.uint16)


def narrow(pair: FramePair, bit_depth: int) -> FramePair:
    """The pair in the narrowest type for `bit_depth` bits, native byte order, where all counts fit into it.

    A recording may hold 8-bit counts in 16 bits; a camera and a bundle do not.
    """
    expected = frame_type(bit_depth)
    frames = [
        frame.astype(expected, copy=False) if int(frame.max(initial=0)) <= np.iinfo(expected).max else frame
        for frame in (pair.in_phase, pair.quadrature)
    ]
    return FramePair(frames[0], frames[1])
