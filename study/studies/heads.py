"""Phases by a von Mises density against symbols by classes: the same decoder with either head, on the same data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lightpage.device.state import ideal_device
from lightpage.progress import Progress
from lightpage.study.lights import DataSet
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.study.trained import trained

LEVELS = (16, 256)
HEADS = ("von Mises", "classes")


def _cases(settings: Settings) -> list[Case]:
    levels = LEVELS[:1] if settings.quick else LEVELS
    return [
        {"name": f"{head}-{count}".replace(" ", "-"), "head": head, "levels": count}
        for count in levels
        for head in HEADS
    ]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    # classes ask for a piston that is known, and a square pipe lets the mode localizer do all that it can
    data_set = DataSet(settings.profile.with_ideal_lenses(), ideal_device(), case["levels"])
    classes = case["levels"] if case["head"] == "classes" else 0
    return trained(settings, data_set, "mode", work, progress, knows_piston=True, classes=classes)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [
        (
            case["levels"],
            case["head"],
            result["air"],
            result["own_mi"],
            result["own_mi"] - result["air"],
            result["ece"],
            result.get("air_of_p", result["air"]),
        )
        for case, result in zip(cases, results, strict=True)
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(4 * len(cases) + 4, 4), layout="constrained")
    axes = figure.subplots(1, len(cases) + 1)
    top = max(float(np.nanmax(result["air_map"])) for result in results)
    for axis, case, result in zip(axes, cases, results, strict=False):
        axis.imshow(result["air_map"], vmin=0, vmax=top, cmap="viridis")
        axis.set_title(f"{case['head']}, {case['levels']} levels: {result['air']:.2f} bit")
        axis.set_axis_off()
        curve = result["training_curve"]
        axes[-1].plot(curve[:, 0], curve[:, 1], marker=".", label=f"{case['head']}, {case['levels']}")
    figure.colorbar(axes[0].images[0], ax=list(axes[:-1]), label="AIR, bit/symbol", shrink=0.8)
    axes[-1].set_xlabel("step")
    axes[-1].set_ylabel("AIR on the pages trained on, bit/symbol")
    axes[-1].set_ylim(-1, max(1.0, axes[-1].get_ylim()[1]))
    axes[-1].legend()
    return figure


STUDY = Study(
    title="a von Mises density of the phase against classes of symbols",
    source="what its discussion proposes",
    cases=_cases,
    measure=_measure,
    header=("levels", "head", "AIR", "own-MI", "over-claim", "ECE", "AIR of p"),
    rows=_rows,
    plot=_plot,
    trains=True,
)
