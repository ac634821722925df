"""Whether rays find the pipe's angle in training, from zero on; and what a decoder without rays sees."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from optics.device import Device
from optics.progress import Progress
from train.studies.study import Case, Result, Row, Settings, Study
from train.studies.trained import Light, trained


def _cases(settings: Settings) -> list[Case]:
    return [{"name": localizer, "localizer": localizer} for localizer in ("ray", "none")]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    light = Light("light", settings.profile, Device())
    return trained(settings, light, case["localizer"], work, progress)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    true = Device().geometry.pipe_angle_deg
    rows: list[Row] = []
    for case, result in zip(cases, results, strict=True):
        fitted = float(result["angles"][-1, 1]) if len(result["angles"]) else float("nan")
        rows.append((case["localizer"], fitted, true, result["air"], result["own_mi"], result["steps"]))
    return rows


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(15, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    angles = results[0]["angles"]
    axes[0, 0].plot(angles[:, 0], angles[:, 1], marker=".")
    axes[0, 0].axhline(Device().geometry.pipe_angle_deg, color="k", linestyle="--", label="true")
    axes[0, 0].set_xlabel("step")
    axes[0, 0].set_ylabel("fitted pipe angle, degrees")
    axes[0, 0].legend()
    for case, result, colour in zip(cases, results, ("tab:blue", "tab:red"), strict=True):
        for name, style in (("training_curve", ":"), ("validation_curve", "-")):
            curve = result[name]
            axes[0, 1].plot(
                curve[:, 0],
                curve[:, 1],
                style,
                marker=".",
                color=colour,
                label=f"{case['localizer']}, {name.split('_')[0]}",
            )
    axes[0, 1].set_xlabel("step")
    axes[0, 1].set_ylabel("AIR, bit/symbol")
    axes[0, 1].set_ylim(bottom=-1)
    axes[0, 1].legend()
    top = max(float(np.nanmax(result["own_mi_map"])) for result in results)
    for axis, case, result in zip(axes[1], cases, results, strict=True):
        shown = axis.imshow(result["own_mi_map"], vmin=0, vmax=top, cmap="viridis")
        axis.set_title(f"{case['localizer']}: own-MI {result['own_mi']:.2f}, AIR {result['air']:.2f} bit/symbol")
        axis.set_axis_off()
    figure.colorbar(shown, ax=axes[1], label="own-MI, bit/symbol")
    return figure


STUDY = Study(
    title="whether rays find the pipe's angle in training, and what a decoder without them sees",
    source="figures 4C and 2C",
    cases=_cases,
    measure=_measure,
    header=("localizer", "fitted angle", "true", "AIR", "own-MI", "steps"),
    rows=_rows,
    plot=_plot,
    trains=True,
)
