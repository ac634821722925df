"""Study of the pipe's length: information of a page through longer and longer square pipes, by modes and by rays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import ideal_device
from lightpage.progress import Progress
from lightpage.study.lights import DataSet
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.study.trained import trained

LENGTHS_MM = tuple(10 + 32.5 * step for step in range(13))
"""Lengths of the full-size pipe, 10 to 400; those of a smaller device are as much shorter as its focal length."""
LOCALIZERS = ("mode", "ray")
_SHOWN = 6


def scaled_length_m(profile: Profile, length_mm: float) -> float:
    """Pipe length of this device that meets as many walls as `length_mm` at full size."""
    full = load_profile("paper")
    return (
        length_mm
        * 1e-3
        * profile.pipe.width_m
        / full.pipe.width_m
        * profile.lens.focal_length_m
        / (full.lens.focal_length_m * profile.page_width_m / full.page_width_m)
    )


def _cases(settings: Settings) -> list[Case]:
    lengths = LENGTHS_MM[2:4] if settings.quick else LENGTHS_MM
    return [
        {"name": f"{localizer}-{length:g}mm", "length_mm": length, "localizer": localizer}
        for length in lengths
        for localizer in LOCALIZERS
    ]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    length = scaled_length_m(settings.profile, case["length_mm"])
    pipe = settings.profile.pipe.model_copy(update={"length_m": length, "angle_deg": 0.0})
    profile = settings.profile.with_ideal_lenses().model_copy(update={"pipe": pipe})
    data_set = DataSet(profile, ideal_device())
    # as with the authors, who trained the angle of their device alone: a simulated pipe is known to be square
    return trained(settings, data_set, case["localizer"], work, progress, angle_rate=0.0)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [
        (case["length_mm"], case["localizer"], result["air"], result["own_mi"], result["air_kB"], result["own_mi_kB"])
        for case, result in zip(cases, results, strict=True)
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    lengths = list(dict.fromkeys(case["length_mm"] for case in cases))
    shown_lengths = [lengths[i] for i in np.unique(np.linspace(0, len(lengths) - 1, _SHOWN).round().astype(int))]
    figure = Figure(figsize=(15, 8), layout="constrained")
    grid = figure.add_gridspec(len(LOCALIZERS) + 1, len(shown_lengths), height_ratios=[1] * len(LOCALIZERS) + [1.3])
    axes = [[figure.add_subplot(grid[i, j]) for j in range(len(shown_lengths))] for i in range(len(LOCALIZERS))]
    by_case = {(case["localizer"], case["length_mm"]): result for case, result in zip(cases, results, strict=True)}
    top = max(float(np.nanmax(result["own_mi_map"])) for result in results)
    for row, localizer in zip(axes, LOCALIZERS, strict=True):
        for axis, length in zip(row, shown_lengths, strict=True):
            axis.imshow(by_case[localizer, length]["own_mi_map"], vmin=0, vmax=top, cmap="viridis")
            axis.set_title(f"{localizer}, {length:g} mm")
            axis.set_axis_off()
    figure.colorbar(
        axes[0][0].images[0], ax=[axis for row in axes for axis in row], label="own-MI, bit/symbol", shrink=0.8
    )
    axis = figure.add_subplot(grid[-1, :])
    for localizer, colour in zip(LOCALIZERS, ("tab:red", "tab:blue"), strict=True):
        for key, what, style in (("own_mi_kB", "own-MI", "o-"), ("air_kB", "AIR", "s:")):
            values = [by_case[localizer, length][key] for length in lengths]
            axis.plot(lengths, values, style, color=colour, label=f"{localizer}, {what}")
    axis.set_xlabel("length of the full-size pipe, mm")
    axis.set_ylabel("kB a page")
    axis.legend()
    return figure


STUDY = Study(
    title="how much a page carries through longer pipes",
    source="figure 5",
    cases=_cases,
    measure=_measure,
    header=("length mm", "localizer", "AIR", "own-MI", "kB by AIR", "kB by own-MI"),
    rows=_rows,
    plot=_plot,
    trains=True,
)
