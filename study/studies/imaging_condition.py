"""Study of the imaging condition: pipe width against a symbol's first diffraction order, aperture against the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lightpage.device.profile import Profile
from lightpage.progress import Progress
from lightpage.study.study import Case, Result, Row, Settings, Study

SIZES_PX = (1, 2, 4, 8, 16)


def needed_width_m(profile: Profile, symbol_size_px: int) -> float:
    """Width that holds the first order of symbols of that size: wavelength x focal length / pitch."""
    pitch = symbol_size_px * profile.slm.pitch_m
    return profile.light.wavelength_m * profile.lens.focal_length_m / pitch


def apertures(profile: Profile) -> tuple[float, float]:
    """Numerical aperture of the page's corner (sine condition), and the largest that the pipe reflects totally."""
    return profile.corner_m / profile.lens.focal_length_m, math.sqrt(max(0.0, profile.pipe.refractive_index**2 - 1))


def _cases(settings: Settings) -> list[Case]:
    return [{"name": f"{size}x{size}", "size": size} for size in SIZES_PX]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile, size = settings.profile, case["size"]
    page, pipe = apertures(profile)
    cut = profile.with_symbols_of(size).page
    needed = needed_width_m(profile, size)
    return {
        "symbols": cut.columns * cut.rows,
        "needed_mm": needed * 1e3,
        "width_mm": profile.pipe.width_m * 1e3,
        "page_aperture": page,
        "pipe_aperture": min(1.0, pipe),
        "carried": needed <= profile.pipe.width_m and page <= pipe,
    }


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [
        (
            case["name"],
            result["symbols"],
            result["needed_mm"],
            result["width_mm"],
            result["page_aperture"],
            result["pipe_aperture"],
            "yes" if result["carried"] else "no",
        )
        for case, result in zip(cases, results, strict=True)
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(6, 4), layout="constrained")
    axis = figure.subplots()
    sizes = np.geomspace(SIZES_PX[0], SIZES_PX[-1], 200)
    axis.loglog(sizes, needed_width_m(settings.profile, 1) * 1e3 / sizes, color="tab:blue")
    for case, result in zip(cases, results, strict=True):
        colour = "tab:green" if result["carried"] else "tab:red"
        axis.plot(case["size"], result["needed_mm"], "o", color=colour)
    axis.axhline(settings.profile.pipe.width_m * 1e3, color="k", linestyle="--", label="the pipe's width")
    axis.set_xticks(SIZES_PX, [str(size) for size in SIZES_PX])
    axis.minorticks_off()
    axis.set_xlabel("symbol size, modulator pixels")
    axis.set_ylabel("width of its first order at the pipe, mm")
    axis.legend()
    return figure


STUDY = Study(
    title="which symbols the pipe can carry",
    source="supplement S2",
    cases=_cases,
    measure=_measure,
    header=("symbols", "on a page", "needs mm", "has mm", "NA of page", "NA of pipe", "carried"),
    rows=_rows,
    plot=_plot,
)
