"""The comparison of decoders as a picture: what each carries, claims, and where on the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

MAP = "air_map.npy"
"""File of an arm's run: AIR of each symbol, mean over the held-out pages, [ny, nx]."""
_DOTS = 110


def draw(lights: list[dict[str, Any]], out: Path) -> None:
    """Write `figure.png` into the folder of a comparison.

    Args:
        lights: as `figures.json` holds them; each outcome's `run` is a folder below `out`, with its `MAP`.
        out: the comparison's folder.
    """
    widest = max(len(light["outcomes"]) for light in lights)
    figure = Figure(figsize=(8.0 + 2.1 * widest, 0.4 + 2.5 * len(lights)), layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(len(lights), 2 + widest, squeeze=False, width_ratios=[2.2, 1.6, *[1] * widest])
    for row, light in zip(rows, lights, strict=True):
        for axis in row[2:]:
            axis.set_axis_off()
        outcomes = light["outcomes"]
        top = max(outcome["own_mi"] for outcome in outcomes)
        _bars(row[0], light, outcomes)
        _curves(row[1], outcomes, top)
        for axis, outcome in zip(row[2:], outcomes, strict=False):
            shown = axis.imshow(np.load(out / outcome["run"] / MAP), vmin=0, vmax=top, cmap="viridis")
            axis.set_title(f"{outcome['arm']}: {outcome['air']:.2f}", fontsize=9)
        figure.colorbar(shown, ax=row[2:], shrink=0.8, label="AIR, bit/symbol")
    figure.savefig(out / "figure.png", dpi=_DOTS, metadata={"Software": None})


def _bars(axis: Any, light: dict[str, Any], outcomes: list[dict[str, Any]]) -> None:
    """AIR of each arm, and, beyond it, what it claims."""
    places = np.arange(len(outcomes))[::-1]
    air = [outcome["air"] for outcome in outcomes]
    axis.barh(places, air, color="tab:blue", label="AIR")
    axis.plot([outcome["own_mi"] for outcome in outcomes], places, "k|", markersize=14, label="claimed (own-MI)")
    top = max(0.1, *(outcome["own_mi"] for outcome in outcomes))
    for place, outcome in zip(places, outcomes, strict=True):
        says = f"{outcome['air']:.2f} bit, {outcome['page_kB']:.2f} kB"
        axis.text(max(outcome["air"], outcome["own_mi"], 0) + 0.03 * top, place, says, va="center", fontsize=8)
    axis.set_yticks(places, [outcome["arm"] for outcome in outcomes])
    axis.set_xlim(0, 1.5 * top)
    axis.set_xlabel("bit/symbol, held-out pages", fontsize=8)
    axis.legend(fontsize=7, loc="lower right")
    axis.set_title(
        f"{light['angle_deg']:g} degree, {light['full_well_e']:g} e-, "
        f"symbols of {light['symbol_size_px']}x{light['symbol_size_px']} pixels",
        fontsize=9,
    )


def _curves(axis: Any, outcomes: list[dict[str, Any]], top: float) -> None:
    """How each arm learnt: AIR of the pages trained on, thin, and of those held out, thick, by share of its steps."""
    for number, outcome in enumerate(outcomes):
        colour = f"C{number % 10}"
        for name, width in (("training_curve", 0.7), ("validation_curve", 1.8)):
            steps, rates = np.reshape(outcome[name], (-1, 2)).T
            label = outcome["arm"] if name == "validation_curve" else None
            axis.plot(steps / outcome["steps"], rates, color=colour, linewidth=width, label=label)
    axis.set_ylim(-0.2 * top, 1.15 * top)
    axis.set_xlabel("share of its steps", fontsize=8)
    axis.set_ylabel("AIR; thin: on training pages", fontsize=8)
    axis.legend(fontsize=6)
    axis.grid(alpha=0.3)
