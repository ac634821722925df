"""Picture of how the image is found, followed and confirmed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lightpage.page.pilots import LEAST_CONFIRMED_SHARE, SOUND_SHARE
from lightpage.pictures import write_figure_png

POINTS = ("15,000 e-", "32 e-")
_COLOURS = ("tab:blue", "tab:orange")


def draw(figures: dict[str, Any], path: Path) -> None:
    """Offsets, walks, and what pilots confirm of right and of wrong pages.

    Args:
        figures: figures as `analysis.tracking.image_search` keeps them.
        path: path of the PNG.
    """
    figure = Figure(figsize=(13, 4), layout="constrained")
    first, second, third = figure.subplots(1, 3)
    rng = np.random.default_rng(0)
    for name, colour in zip(POINTS, _COLOURS, strict=True):
        rows = figures[f"{name}: offsets"]["rows"]
        spread = 2 ** rng.uniform(-0.15, 0.15, len(rows))
        places = [row["offset_px"] for row in rows] * spread
        first.plot(places, [row["share_of_tracked"] for row in rows], ".", color=colour, label=name, alpha=0.6)
        walk = figures[f"{name}: straight walk, reference stays"]["rows"]
        airs = np.array([row["air"] for row in walk])
        label = f"{name}, mean {airs.mean():.2f} bits"
        second.plot([abs(row["place_px"][1]) for row in walk], airs / airs.mean(), color=colour, label=label)
        bins = np.linspace(0, 1.2, 49)
        right, wrong = (figures[f"{name}: {kind} pages"]["shares"] for kind in ("sound", "wrong"))
        third.hist(right, bins, color=colour, alpha=0.6, label=f"{name}, this device")
        third.hist(wrong, bins, color=colour, alpha=0.6, hatch="///", label=f"{name}, wrong pages")
    for axes in (first, second):
        axes.axhline(0.98, color="black", lw=0.8, linestyle="dashed", label="2% less")
    first.set(xscale="log", xlabel="image off at the first page, camera px", ylabel="AIR over that of a tracked page")
    first.set_xticks([0.5, 1, 2, 4, 8, 12], ["0.5", "1", "2", "4", "8", "12"])
    first.set_ylim(min(0.9, *first.get_ylim()), 1.02)
    second.set(xlabel="walked, camera px (0.12 a page)", ylabel="AIR over its mean")
    second.set_ylim(min(0.9, *second.get_ylim()), 1.05)
    for share, label in ((LEAST_CONFIRMED_SHARE, "less: page lost"), (SOUND_SHARE, "less: device changed")):
        third.axvline(share, color="black", lw=0.8)
        third.annotate(label, (share, 0.97), xycoords=("data", "axes fraction"), rotation=90, ha="right", va="top")
    third.set(xlabel="claimed information that the pilots confirm", ylabel="pages", yscale="log")
    for axes in (first, second, third):
        axes.legend(fontsize=8, loc="lower left" if axes is first else "best")
    write_figure_png(path, figure, dpi=130)
