"""Draws what was found of a file: frames, references, fringes, a page, and how often counts come."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lightpage.errors import InvalidInputError
from lightpage.files import replace_file
from lightpage.inspection.exposure import sampled
from lightpage.inspection.finding import Finding, Picture, printable
from lightpage.pictures import write_figure_png

_COLUMNS = 2
"""Frames of both cameras stand side by side."""
_SIDE_PX = 1800
"""Pixels of a frame's longer side that are drawn."""
_SHADES = (0.2, 99.5)
"""Percentiles of the counts that are black and white: single bright pixels would leave the rest in the dark."""
_DOTS = 110


def _exposure(found: Finding, name: str) -> str:
    """Describe how a camera is exposed."""
    told = f"{name.replace('_', '-')}, saturated: {found.histograms[name].saturated:.2%}"
    contrast = found.facts.get(f"{name}: contrast of fringes")
    return told if contrast is None else f"{told}, contrast of fringes: {contrast}"


def draw(found: Finding, pictures: list[Picture], out: Path) -> None:
    """Draw what was found to a PNG file.

    Raises:
        InvalidInputError: there is nothing to draw, the name is no PNG's, or the file cannot be written.
    """
    if out.suffix.lower() not in ("", ".png"):
        raise InvalidInputError(f"--picture {out}", f"a name that ends with '{out.suffix}'", "one that ends with .png")
    if not pictures:
        raise InvalidInputError(f"--picture {out}", found.kind, "a file with frames or symbols")
    panels = len(pictures) + bool(found.histograms)
    columns = min(panels, _COLUMNS)
    rows = math.ceil(panels / columns)
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    figure.suptitle(f"{printable(found.path.name)}: {found.kind}")
    for place, (title, pixels, unit) in enumerate(pictures, 1):
        axis = figure.add_subplot(rows, columns, place)
        step = max(1, max(pixels.shape) // _SIDE_PX)
        shown = np.nan_to_num(pixels[::step, ::step], posinf=0.0, neginf=0.0)
        low, high = np.percentile(sampled(shown), _SHADES)
        image = axis.imshow(shown, cmap="gray", vmin=low, vmax=max(high, low + 1e-9))
        axis.set_title(title, fontsize=9)
        axis.set_xticks([])
        axis.set_yticks([])
        figure.colorbar(image, ax=axis, shrink=0.8, label=unit)
    if found.histograms:
        axis = figure.add_subplot(rows, columns, (panels, rows * columns))
        for name, each in found.histograms.items():
            axis.stairs([max(share, 1e-6) for share in each.shares], each.edges, label=_exposure(found, name))
        axis.set(xlabel="count", ylabel="share of the pixels", yscale="log")
        full_scale = max(each.full_scale for each in found.histograms.values())
        axis.axvline(full_scale, color="black", linestyle="dashed", linewidth=1, label=f"full scale, {full_scale}")
        axis.set_title("exposure", fontsize=9)
        axis.legend(fontsize=8)
    replace_file(out, lambda file: write_figure_png(file, figure, dpi=_DOTS), "picture")
