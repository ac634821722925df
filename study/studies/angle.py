"""Study of the pipe's angle: whether rays find it in training, from zero on, and what a decoder without rays reaches.

Rays say where light lands, not its phase, which runs hundreds of radians over the page and is left to the network.
Against a reference beam of the same curvature most of it does not show: what it costs to learn, the third case says.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lightpage.progress import Progress
from lightpage.study.lights import DataSet
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.study.trained import trained

_LOCKED = 0.3
"""Training AIR, bits a symbol, from which a decoder counts as locked; `none` comes to it too, if later, by heart."""


def _cases(settings: Settings) -> list[Case]:
    cases = (("ray", "ray", False), ("none", "none", False), ("ray-matched", "ray", True))
    true = settings.device.geometry.pipe_angle_deg
    return [
        {"name": name, "localizer": localizer, "matched": matched, "true_deg": true}
        for name, localizer, matched in cases
    ]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    data_set = DataSet(settings.profile, settings.device)
    if case["matched"]:
        curvature = settings.profile.light_curvature_rad
        data_set = DataSet(settings.profile, settings.device.with_settings([f"reference.curvature_rad={curvature}"]))
    return trained(settings, data_set, case["localizer"], work, progress)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    rows: list[Row] = []
    for case, result in zip(cases, results, strict=True):
        reference = "matched" if case["matched"] else "nearly flat"
        locked = first_step(result["training_curve"])
        reached = (result[name] for name in ("air", "own_mi", "steps"))
        rows.append((case["localizer"], reference, result["angle_deg"], case["true_deg"], locked, *reached))
    return rows


def first_step(curve: NDArray[np.float64], least: float = _LOCKED) -> float:
    """Step at which a curve [points, 2] first reaches so many bits; not a number where it never does."""
    reached = curve[curve[:, 1] >= least, 0]
    return float(reached[0]) if len(reached) else float("nan")


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(16, 8), layout="constrained")
    grid = figure.add_gridspec(2, 2 * len(cases))
    angles, rates = figure.add_subplot(grid[0, : len(cases)]), figure.add_subplot(grid[0, len(cases) :])
    maps = [figure.add_subplot(grid[1, 2 * number : 2 * number + 2]) for number in range(len(cases))]
    top = max(float(np.nanmax(result["own_mi_map"])) for result in results)
    for number, (axis, case, result) in enumerate(zip(maps, cases, results, strict=True)):
        name = f"{case['localizer']}, matched reference" if case["matched"] else case["localizer"]
        if len(result["angles"]):
            angles.plot(*result["angles"].T, ".-", markersize=3, color=f"C{number}", label=name)
        rates.plot(*result["training_curve"].T, color=f"C{number}", linewidth=0.8, alpha=0.6)
        rates.plot(*result["validation_curve"].T, "o-", color=f"C{number}", markersize=3, label=name)
        axis.imshow(result["own_mi_map"], vmin=0, vmax=top, cmap="viridis")
        axis.set_title(f"{name}: own-MI {result['own_mi']:.2f}, AIR {result['air']:.2f} bit/symbol", fontsize="medium")
        axis.set_axis_off()
    angles.axhline(settings.device.geometry.pipe_angle_deg, color="k", linestyle="--", label="true")
    angles.set_ylabel("fitted pipe angle, degrees")
    rates.set_ylabel("AIR, bit/symbol; thin: pages trained on")
    rates.set_ylim(-1, max(1.0, rates.get_ylim()[1]))
    for axis in (angles, rates):
        axis.set_xlabel("step")
        axis.legend()
    figure.colorbar(maps[0].images[0], ax=maps, label="own-MI, bit/symbol", shrink=0.8)
    return figure


STUDY = Study(
    title="whether rays find the pipe's angle in training, and what a decoder without them sees",
    source="figures 4C and 2C",
    cases=_cases,
    measure=_measure,
    header=("localizer", "reference", "fitted angle", "true", "locked at", "AIR", "own-MI", "steps"),
    rows=_rows,
    plot=_plot,
    trains=True,
    changeable=True,
)
