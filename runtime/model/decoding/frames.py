"""Checks a frame pair before it is decoded: size, type, bit depth, and whether it shows any light that can be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError
from lightpage.recording.exposure import check_light
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import frame_type


def check_pair(pair: FramePair, shape: tuple[int, int], dtype: str, bit_depth: int) -> None:
    """Check both frames of a pair.

    Args:
        pair: the frames.
        shape: (rows, columns) that the camera delivers.
        dtype: "uint8" or "uint16".
        bit_depth: bits of a camera count.

    Raises:
        FrameError: a frame of the wrong size or type, beyond the bit depth, black or saturated; it names the frame.
    """
    for name, frame in (("in-phase frame", pair.in_phase), ("quadrature frame", pair.quadrature)):
        _check_frame(name, frame, shape, dtype, bit_depth)


@contextmanager
def named(subject: str) -> Iterator[None]:
    """Put `subject` before what a `FrameError` names."""
    try:
        yield
    except FrameError as error:
        raise type(error)(subject + error.subject, error.got, error.expected) from error


def _check_frame(name: str, frame: NDArray[Any], shape: tuple[int, int], dtype: str, bit_depth: int) -> None:
    if not isinstance(frame, np.ndarray) or frame.shape != shape:
        raise FrameError(name, f"shape {getattr(frame, 'shape', type(frame).__name__)}", f"shape {shape}")
    if frame.dtype != np.dtype(dtype):
        raise FrameError(name, f"type {frame.dtype}", dtype)
    check_light(name, frame, bit_depth)


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
