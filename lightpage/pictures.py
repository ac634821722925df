"""Pictures for documents as small PNG files: in a palette where nobody sees the difference."""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = 256
_UNSEEN = 8
"""Largest change of a pixel's colours by a palette, of 255; beyond, gradients show bands."""


def write_png(path: Path | IO[bytes], png: bytes) -> None:
    """Write a picture that is PNG, its transparency left out; the same picture gives the same bytes.

    Raises:
        OSError: the path cannot be written.
    """
    with Image.open(io.BytesIO(png)) as drawn:
        every = drawn.convert("RGB")
    few = every.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    off = np.abs(np.asarray(every, np.int16) - np.asarray(few.convert("RGB"))).max()
    (few if off <= _UNSEEN else every).save(path, "PNG", optimize=True)


def write_figure_png(path: Path | IO[bytes], figure: Figure, **how: Any) -> None:
    """Write a figure as PNG; `how` is what its `savefig` takes.

    Raises:
        OSError: the path cannot be written.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", **how)
    write_png(path, drawn.getvalue())
