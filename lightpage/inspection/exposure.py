"""Measures exposure by samples: a histogram of counts, saturation, the contrast of fringes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.inspection.finding import Histogram
from lightpage.recording.exposure import greatest_count, unused_low_bits
from lightpage.recording.layout import MIN_BIT_DEPTH

_BINS = 16
_PIXELS = 1 << 18
"""Pixels of a frame that are counted."""
_BAR = 40
_TOLD = 0.0005
"""Share of the pixels below which a bin is told to be under 0.1%."""


def sampled(frame: NDArray[Any]) -> NDArray[Any]:
    """Return pixels spread over a frame, at most about a quarter of a million."""
    flat = frame.reshape(-1)
    return flat[:: max(1, flat.size // _PIXELS)]


def histogram(frames: list[NDArray[Any]], bit_depth: int) -> Histogram:
    """Return how often counts come in some frames.

    Args:
        frames: whole counts [row, column], at least one frame.
        bit_depth: of a count.
    """
    counted = np.concatenate([sampled(frame) for frame in frames])
    unused = 0
    if counted.max() >= greatest_count(bit_depth, bit_depth - MIN_BIT_DEPTH):
        unused = unused_low_bits(counted, bit_depth) or 0
    full_scale = greatest_count(bit_depth, unused)
    width = (1 << bit_depth) // _BINS
    edges = np.arange(_BINS + 1) * width
    shares = np.bincount(np.minimum(counted // width, _BINS - 1), minlength=_BINS) / counted.size
    saturated = float(np.mean(counted >= full_scale))
    return Histogram(tuple(edges.tolist()), tuple(shares.tolist()), full_scale, saturated)


def contrast(frame: NDArray[Any], reference: NDArray[Any]) -> float:
    """Return the fringes' visibility: (high - low) / (high + low) of the frame over its reference.

    High and low are percentiles (95 and 5), so that single pixels do not count.
    """
    lit = sampled(reference).astype(float)
    ratio = sampled(frame)[lit > 0] / lit[lit > 0]
    if not ratio.size:
        return 0.0
    low, high = np.percentile(ratio, (5, 95))
    return float((high - low) / (high + low)) if high + low > 0 else 0.0


def bars(found: Histogram) -> list[str]:
    """Return a histogram as lines of text."""
    most = max(found.shares) or 1.0
    width = len(str(found.edges[-1] - 1))
    lines = []
    last = max(place for place, share in enumerate(found.shares) if share or not place)
    for low, high, share in list(zip(found.edges, found.edges[1:], found.shares, strict=False))[: last + 1]:
        bar = "#" * round(_BAR * share / most)
        told = "<0.1%" if 0 < share < _TOLD else f"{share:.1%}"
        lines.append(f"  {low:>{width}} to {high - 1:>{width}} {bar:<{_BAR}} {told:>6}")
    return lines
