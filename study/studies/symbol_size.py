"""Study of symbol sizes: information of a page with symbols of 16, 8, 4 and 2 modulator pixels, by modes and rays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lightpage.progress import Progress
from lightpage.study.lights import DataSet
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.study.trained import trained

SIZES_PX = (16, 8, 4, 2)
LOCALIZERS = ("mode", "ray")


def _cases(settings: Settings) -> list[Case]:
    sizes = SIZES_PX[1:3] if settings.quick else SIZES_PX
    return [
        {"name": f"{localizer}-{size}x{size}", "size": size, "localizer": localizer}
        for size in sizes
        for localizer in LOCALIZERS
    ]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    data_set = DataSet(settings.profile.with_symbols_of(case["size"]), settings.device)
    return trained(settings, data_set, case["localizer"], work, progress)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [
        (
            f"{case['size']}x{case['size']}",
            case["localizer"],
            result["air"],
            result["own_mi"],
            result["air_kB"],
            result["own_mi_kB"],
            result["steps"],
        )
        for case, result in zip(cases, results, strict=True)
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    sizes = list(dict.fromkeys(case["size"] for case in cases))
    figure = Figure(figsize=(3.4 * len(sizes) + 4, 7.5), layout="constrained")
    axes = figure.subplots(3, len(sizes) + 1, squeeze=False)
    top = max(float(np.nanmax(result["own_mi_map"])) for result in results)
    by_case = {(case["localizer"], case["size"]): result for case, result in zip(cases, results, strict=True)}
    for row, localizer in zip(axes, LOCALIZERS, strict=False):
        for axis, size in zip(row, sizes, strict=False):
            result = by_case[localizer, size]
            axis.imshow(result["own_mi_map"], vmin=0, vmax=top, cmap="viridis")
            axis.set_title(f"{localizer}, {size}x{size}: {result['own_mi']:.2f} bit")
            axis.set_axis_off()
    figure.colorbar(axes[0, 0].images[0], ax=axes[:2, : len(sizes)], label="own-MI, bit/symbol", shrink=0.8)
    for axis, key, title in ((axes[0, -1], "own_mi_kB", "claimed"), (axes[1, -1], "air_kB", "carried (AIR)")):
        for localizer in LOCALIZERS:
            axis.plot(range(len(sizes)), [by_case[localizer, size][key] for size in sizes], "o-", label=localizer)
        axis.set_xticks(range(len(sizes)), [f"{size}x{size}" for size in sizes])
        axis.set_ylabel("kB a page")
        axis.set_title(title)
        axis.legend()
    shown_ray = by_case["ray", 4 if 4 in sizes else sizes[-1]]
    entropy = np.log2(2 * np.pi) - shown_ray["own_mi_map"]
    for axis, image, title in (
        (axes[2, 0], entropy, "ray: entropy that it claims, bit"),
        (axes[2, 1], shown_ray["error_map"], "ray: error that it makes, rad"),
    ):
        shown = axis.imshow(image, cmap="magma")
        axis.set_title(title)
        axis.set_axis_off()
        figure.colorbar(shown, ax=axis, shrink=0.7)
    for axis in axes[2, 2:]:
        axis.set_visible(False)
    return figure


STUDY = Study(
    title="how much a page carries with symbols of four sizes",
    source="figure 3",
    cases=_cases,
    measure=_measure,
    header=("symbols", "localizer", "AIR", "own-MI", "kB by AIR", "kB by own-MI", "steps"),
    rows=_rows,
    plot=_plot,
    trains=True,
    changeable=True,
)
