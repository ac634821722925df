"""Study of the pipe's angle: whether rays find it in training, from zero on, and what a decoder without rays reaches.

Rays say where light lands, not its phase, which runs hundreds of radians over the page and is left to the network.
Against a reference beam of the same curvature most of it does not show: what it costs to learn, the third case says.

Courses ask what makes rays find the angle: how long the geometry is held, where it begins, how fast it moves, whether
the page's place is trained too, how large symbols are; each from several seeds. On a device smaller than the authors'
the same angle moves the picture by fewer pixels, and by less than a symbol a network need not care. So for courses
angle, cameras' poses and rates are as many times larger.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.progress import Progress
from lightpage.study.lights import DataSet
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.study.trained import trained
from lightpage.train.published.training import PROFILE, PublishedChoices

_LOCKED = 0.3
"""Training AIR, bits a symbol, from which a decoder counts as locked; `none` comes to it too, if later, by heart."""


@dataclass(frozen=True)
class _Course:
    """A course of the geometry in training.

    Attributes:
        changes: changes of the authors' choices.
        begins: angle at the beginning, over the true one.
        symbol_px: side of a symbol, modulator pixels; the profile's if left out.
    """

    changes: Mapping[str, Any] = field(default_factory=dict)
    begins: float = 0.0
    symbol_px: int = 0


_COURSES = {
    "authors": _Course(),
    "held": _Course({"held_share": 0.3}),
    "from-profile": _Course({"start": PROFILE}),
    "held-from-profile": _Course({"held_share": 0.3, "start": PROFILE}),
    "slow-angle": _Course({"angle_rate": PublishedChoices.angle_rate / 4}),
    "fast-angle": _Course({"angle_rate": 4 * PublishedChoices.angle_rate}),
    "slow-affine": _Course({"affine_rate": PublishedChoices.affine_rate / 4}),
    "zero": _Course({"start": PROFILE, "angle_rate": 0.0}),
    "true": _Course({"start": PROFILE, "angle_rate": 0.0}, begins=1.0),
    "near": _Course({"start": PROFILE}, begins=0.8),
    "page": _Course({"start": PROFILE, "page_moves": True}),
    "page-near": _Course({"start": PROFILE, "page_moves": True}, begins=0.8),
    "symbols-16": _Course({"start": PROFILE}, symbol_px=16),
}
"""Courses of the geometry in training, by name."""
_SEEDS = 3


def _cases(settings: Settings) -> list[Case]:
    true = settings.device.geometry.pipe_angle_deg
    cases: list[Case] = [
        {"name": "ray", "localizer": "ray", "matched": False, "true_deg": true},
        {"name": "none", "localizer": "none", "matched": False, "true_deg": true},
        {"name": "ray-matched", "localizer": "ray", "matched": True, "true_deg": true},
    ]
    usual = {"localizer": "ray", "true_deg": _times_smaller(settings) * true, "by_name": True}
    cases += [
        {**usual, "name": f"{course}-{reference}-{seed}", "course": course, "matched": matched, "seed": seed}
        for reference, matched in (("flat", False), ("matched", True))  # those on one data set follow each other
        for course in _COURSES
        for seed in range(1 if settings.quick else _SEEDS)
    ]
    return cases


def _times_smaller(settings: Settings) -> float:
    """Return how many times more pixels along x the authors' camera has than that of the study."""
    return load_profile("paper").camera.columns_px / settings.profile.camera.columns_px


def _enlarged(settings: Settings, device: Device) -> Device:
    """Return a small device on which angle and registration move the picture by as many pixels as at full size."""
    cameras, keys = ("in_phase_camera", "quadrature_camera"), ("scale_relative_error", "rotation_deg")
    numbers = [("geometry", "pipe_angle_deg"), *((camera, key) for camera in cameras for key in keys)]
    times = _times_smaller(settings)
    return device.with_settings(
        [f"{table}.{key}={times * getattr(getattr(device, table), key)!r}" for table, key in numbers]
    )


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile, device, changes = settings.profile, settings.device, dict[str, Any]()
    if case["matched"]:
        device = device.with_settings([f"reference.curvature_rad={profile.light_curvature_rad}"])
    if "course" in case:
        course, times = _COURSES[case["course"]], _times_smaller(settings)
        device = _enlarged(settings, device)
        rates = {"affine_rate": PublishedChoices.affine_rate, "angle_rate": PublishedChoices.angle_rate}
        changes = {"seed": case["seed"], **rates, **course.changes}
        changes |= {name: times * changes[name] for name in rates}
        changes["begins_rad"] = math.radians(course.begins * case["true_deg"])
        profile = profile.with_symbols_of(course.symbol_px or profile.page.symbol_size_px)
    return trained(settings, DataSet(profile, device), case["localizer"], work, progress, **changes)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    rows: list[Row] = []
    for case, result in zip(cases, results, strict=True):
        reference = "matched" if case["matched"] else "nearly flat"
        locked = first_step(result["training_curve"])
        reached = (result[name] for name in ("air", "own_mi", "steps"))
        rows.append((case["name"], reference, result["angle_deg"], case["true_deg"], locked, *reached))
    return rows


def first_step(curve: NDArray[np.float64], least: float = _LOCKED) -> float:
    """Step at which a curve [points, 2] first reaches so many bits; not a number where it never does."""
    reached = curve[curve[:, 1] >= least, 0]
    return float(reached[0]) if len(reached) else float("nan")


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    if any("course" in case for case in cases):
        return _plot_courses([both for both in zip(cases, results, strict=True) if "course" in both[0]])
    figure = Figure(figsize=(16, 8), layout="constrained")
    grid = figure.add_gridspec(2, 2 * len(cases))
    angles, rates = figure.add_subplot(grid[0, : len(cases)]), figure.add_subplot(grid[0, len(cases) :])
    maps = [figure.add_subplot(grid[1, 2 * number : 2 * number + 2]) for number in range(len(cases))]
    top = max(float(np.nanmax(result["own_mi_map"])) for result in results)
    for number, (axis, case, result) in enumerate(zip(maps, cases, results, strict=True)):
        name, step_angles = str(case["name"]), result["angles"]
        if len(step_angles):
            shares = step_angles[:, 1] / case["true_deg"]
            angles.plot(step_angles[:, 0], shares, ".-", markersize=3, color=f"C{number}", label=name)
        rates.plot(*result["training_curve"].T, color=f"C{number}", linewidth=0.8, alpha=0.6)
        rates.plot(*result["validation_curve"].T, "o-", color=f"C{number}", markersize=3, label=name)
        axis.imshow(result["own_mi_map"], vmin=0, vmax=top, cmap="viridis")
        axis.set_title(f"{name}: own-MI {result['own_mi']:.2f}, AIR {result['air']:.2f} bit/symbol", fontsize="medium")
        axis.set_axis_off()
    angles.axhline(1, color="k", linestyle="--", label="true")
    angles.set_ylabel("fitted pipe angle, over the true one")
    rates.set_ylabel("AIR, bit/symbol; thin: pages trained on")
    rates.set_ylim(-1, max(1.0, rates.get_ylim()[1]))
    for axis in (angles, rates):
        axis.set_xlabel("step")
        axis.legend()
    figure.colorbar(maps[0].images[0], ax=maps, label="own-MI, bit/symbol", shrink=0.8)
    return figure


def _plot_courses(measured: Sequence[tuple[Case, Result]]) -> Figure:
    """Draw the angle and the AIR along each course, one line a seed; cases without a course are in the table alone."""
    courses = [name for name in _COURSES if any(case["course"] == name for case, _ in measured)]
    figure = Figure(figsize=(2.6 * len(courses) + 1, 5.5), layout="constrained")
    axes = figure.subplots(2, len(courses), sharex=True, sharey="row", squeeze=False)
    for (angle, rate), name in zip(axes.T, courses, strict=True):
        for case, result in measured:
            if case["course"] != name:
                continue
            style = {"color": "C1" if case["matched"] else "C0", "linewidth": 1, "alpha": 0.8}
            angle.plot(result["angles"][:, 0], result["angles"][:, 1] / case["true_deg"], **style)
            rate.plot(*result["validation_curve"].T, **style)
        angle.axhline(1, color="k", linestyle="--", linewidth=1)
        angle.axhline(0, color="k", linestyle=":", linewidth=1)
        angle.set_title(name, fontsize="medium")
        rate.set_xlabel("step")
    axes[0, 0].set_ylabel("fitted angle, over the true one")
    axes[1, 0].set_ylabel("AIR of validation, bit/symbol")
    axes[1, 0].set_ylim(bottom=-0.5)
    for color, reference in (("C0", "nearly flat reference"), ("C1", "matched reference")):
        if any(case["matched"] == (color == "C1") for case, _ in measured):
            axes[1, -1].plot([], [], color=color, label=reference)
    axes[1, -1].legend(fontsize="small")
    return figure


STUDY = Study(
    title="whether rays find the pipe's angle in training, and what a decoder without them sees",
    source="figures 4C and 2C",
    cases=_cases,
    measure=_measure,
    header=("case", "reference", "fitted angle", "true", "locked at", "AIR", "own-MI", "steps"),
    rows=_rows,
    plot=_plot,
    trains=True,
    parts=True,
    changeable=True,
)
