"""The layout of a recording and the frame pair in it: what its reader and its writer share."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT = "lightpage-recording"
VERSION = 1
MIN_BIT_DEPTH = 8
MAX_BIT_DEPTH = 16

FRAMES = ("in_phase", "quadrature")
REFERENCES = ("reference_in_phase", "reference_quadrature")


@dataclass(frozen=True)
class FramePair:
    """The two frames of one page, camera counts [row, column]."""

    in_phase: NDArray[np.integer[Any]]
    quadrature: NDArray[np.integer[Any]]


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
