"""Draws docs/images/decoders.png from kept figures: AIR of each decoder, against what any could read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from analysis.comparison.decoders_figure import LABELS, method_label, method_name, title
from lightpage.files import replace_file
from lightpage.pictures import write_figure_png
from lightpage.report.drawing import BLUE, GREEN, GREY, ORANGE

_KINDS = (("published decoders", ORANGE), ("Lightpage", BLUE), ("told the device's true state", GREY))


def draw(data_set: dict[str, Any], bound: float | None, path: Path) -> None:
    """Draw the decoders of a comparison's data set.

    Args:
        data_set: data set of a kept comparison.
        bound: bits that any decoder could read of a symbol at most; None where that is not known.
        path: PNG.
    """
    order = {name: place for place, name in enumerate(LABELS)}
    outcomes = sorted(data_set["outcomes"], key=lambda outcome: order.get(method_name(outcome), len(order)))
    figure = Figure(figsize=(11, 1.6 + 0.36 * len(outcomes)), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    places = np.arange(len(outcomes))[::-1]
    kinds = np.array([_kind(outcome) for outcome in outcomes])
    rates = np.array([outcome["air"] for outcome in outcomes])
    for kind, (label, colour) in enumerate(_KINDS):
        axis.barh(places[kinds == kind], rates[kinds == kind], color=colour, height=0.7, label=label)
    zones = None
    for place, outcome in zip(places, outcomes, strict=True):
        text = f"{outcome['air']:.2f} bit, {outcome['page_kB']:.2f} kB a page"
        axis.text(0.08, place, text, va="center", color="white", fontsize=9)
        if by_walls := outcome.get("by_walls"):
            ends = sorted(by_walls.values())
            (zones,) = axis.plot([ends[0], ends[-1]], [place, place], "|-", color="black", markersize=9)
    if zones is not None:
        zones.set_label("where the light met both pairs of walls, to none")
    if bound is not None:
        axis.axvline(bound, color=GREEN, linestyle="dashed", label=f"bound of any decoder, {bound:.2f} bit")
    axis.set_yticks(places, [method_label(outcome) for outcome in outcomes])
    axis.set(xlabel="AIR of held-out pages, bit/symbol", title=title(data_set))
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, loc="outside lower center", ncols=3, fontsize=9)
    path.parent.mkdir(exist_ok=True)
    replace_file(path, lambda file: write_figure_png(file, figure, dpi=110), "picture")


def _kind(outcome: dict[str, Any]) -> int:
    label = method_label(outcome)
    return 0 if label.startswith("published") else 2 if label.startswith("oracle") else 1
