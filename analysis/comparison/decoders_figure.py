"""The comparison of decoders as a picture: what each carries, claims, and where on the page."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lightpage.pictures import write_figure_png

LABELS = {
    "ray": "published, ray localizer",
    "mode": "published, mode localizer",
    "fast": "`--preset fast`",
    "coherent": "one pass, coherent",
    "wave": "`--preset standard`: one pass, wave",
    "refined": "`--preset accurate`: two passes, coherent",
    "wave-refined": "two passes, wave",
    "oracle": "oracle, one pass",
    "oracle-refined": "oracle, two passes",
}
"""Methods by the names that pages use, in the order of their table."""
MAP = "air_map.npy"
"""File of a method's run: AIR of each symbol, mean over the held-out pages, [ny, nx]."""
_BRIGHT = 99.0
"""Percentile of the symbols' rates at which the colours of the maps end."""
_DOTS = 110
_WIDTH_IN, _DATA_SET_IN = 14.0, 5.2
_TITLE_LETTERS = 26
"""Letters of a line above a map."""


def draw(data_sets: list[dict[str, Any]], out: Path) -> None:
    """Write `figure.png` into the folder of a comparison.

    Args:
        data_sets: data sets of `figures.json`; each outcome's `run` is a folder below `out`, with its `MAP`.
        out: the comparison's folder.
    """
    figure = Figure(figsize=(_WIDTH_IN, _DATA_SET_IN * len(data_sets)), layout="constrained")
    FigureCanvasAgg(figure)
    for part, data_set in zip(figure.subfigures(len(data_sets), 1, squeeze=False)[:, 0], data_sets, strict=True):
        outcomes = data_set["outcomes"]
        top = max(0.1, *(outcome["own_mi"] for outcome in outcomes))
        part.suptitle(title(data_set))
        charts, maps = part.subfigures(1, 2, width_ratios=[2, 3])
        bars, curves = charts.subplots(2, 1)
        _bars(bars, outcomes, top)
        _curves(curves, outcomes, top)
        _maps(maps, outcomes, out)
    write_figure_png(out / "figure.png", figure, dpi=_DOTS)


def title(data_set: dict[str, Any]) -> str:
    """Return the title of a comparison's data set."""
    size = data_set["symbol_size_px"]
    noise = f"full well {data_set['full_well_e']:g} e-, exposure {data_set['exposure']:g}"
    device = ", ideal device" if data_set["ideal"] else ""
    return f"{data_set['angle_deg']:g} degree, {noise}, symbols of {size}x{size} pixels{device}"


def _bars(axis: Any, outcomes: list[dict[str, Any]], top: float) -> None:
    """AIR of each method, and a mark where it claims to be."""
    places = np.arange(len(outcomes))[::-1]
    axis.barh(places, [outcome["air"] for outcome in outcomes], color=[f"C{n % 10}" for n in range(len(outcomes))])
    axis.plot([outcome["own_mi"] for outcome in outcomes], places, "k|", markersize=14)
    for place, outcome in zip(places, outcomes, strict=True):
        says = f"{outcome['air']:.2f} bit, {outcome['page_kB']:.2f} kB"
        axis.text(max(outcome["air"], outcome["own_mi"], 0) + 0.03 * top, place, says, va="center", fontsize=8)
    axis.set_yticks(places, [method_label(outcome) for outcome in outcomes], fontsize=8)
    axis.set_xlim(0, 1.45 * top)
    axis.set_xlabel("AIR of held-out pages, bit/symbol; black: what is claimed (own-MI)", fontsize=8)


def _curves(axis: Any, outcomes: list[dict[str, Any]], top: float) -> None:
    """Draw learning curves: AIR by share of steps, thin for training pages and thick for validation pages."""
    for number, outcome in enumerate(outcomes):
        for name, width in (("training_curve", 0.7), ("validation_curve", 1.8)):
            steps, rates = np.reshape(outcome[name], (-1, 2)).T
            axis.plot(steps / outcome["steps"], rates, color=f"C{number % 10}", linewidth=width)
    axis.set_ylim(-0.2 * top, 1.15 * top)
    axis.set_xlabel("share of its training steps", fontsize=8)
    axis.set_ylabel("AIR; thin: on training pages", fontsize=8)
    axis.grid(alpha=0.3)


def _maps(part: Any, outcomes: list[dict[str, Any]], out: Path) -> None:
    """Draw maps of the AIR of each symbol of the page, one for each method."""
    maps = [np.load(out / outcome["run"] / MAP) for outcome in outcomes]
    top = max(0.1, *(float(np.nanpercentile(rates, _BRIGHT)) for rates in maps))
    rows = 1 if len(outcomes) < 3 else 2
    axes = part.subplots(rows, -(-len(outcomes) // rows), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, outcome, rates in zip(axes.flat, outcomes, maps, strict=False):
        axis.imshow(rates, vmin=0, vmax=top, cmap="viridis")
        axis.set_title(textwrap.fill(f"{method_label(outcome)}: {outcome['air']:.2f}", _TITLE_LETTERS), fontsize=8)
    part.colorbar(
        axes.flat[0].images[0],
        ax=axes,
        location="bottom",
        shrink=0.6,
        aspect=40,
        extend="both",
        label="AIR of each symbol, bit",
    )


def method_name(outcome: dict[str, Any]) -> str:
    """Return the name of a method without the number of its refinements, which is one."""
    return str(outcome["method"]).removesuffix(" 1")


def method_label(outcome: dict[str, Any]) -> str:
    """Return the name of a method as pages have it, without marks of code."""
    name = method_name(outcome)
    return LABELS.get(name, name).replace("`", "")
