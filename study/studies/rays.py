"""Study of rays: their ways through lenses and pipe, and from the page's zones to the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from lightpage.device.lenses import lens_of
from lightpage.device.profile import Profile
from lightpage.progress import Progress
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.train.published.localizers import page_places
from lightpage.train.published.rays import RayTracer, Traced

ANGLES_DEG = (0.0, -0.6)
_GRID = (90, 140)
_QUICK_GRID = (18, 28)
_DRAWN = 9
"""Rays drawn along each axis."""


def tracer_for(profile: Profile) -> RayTracer:
    """A tracer through the prescription of the profile's lenses, or through ideal ones."""
    return RayTracer(profile, lens_of(profile))


def half_page(profile: Profile) -> Tensor:
    """Half width and half height of the page, metres, [2] float64."""
    return torch.tensor([profile.page_width_m, profile.page_height_m], dtype=torch.float64) / 2


def traced_page(profile: Profile, shape: tuple[int, int], angle_deg: float) -> tuple[Tensor, Traced]:
    """Places over the whole page, metres [rows columns, 2] in row order, and where rays from them land."""
    points = (page_places(shape) * half_page(profile)).reshape(-1, 2)
    return points, tracer_for(profile)(points, torch.deg2rad(torch.tensor(angle_deg, dtype=torch.float64)))


def _cases(settings: Settings) -> list[Case]:
    return [{"name": f"{angle:+.1f}-degree", "angle_deg": angle} for angle in ANGLES_DEG]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile = settings.profile
    shape = _QUICK_GRID if settings.quick else _GRID
    progress("trace the page", 0.0)
    _, traced = traced_page(profile, shape, case["angle_deg"])
    line = torch.linspace(-1, 1, _DRAWN, dtype=torch.float64)
    zero = torch.zeros_like(line)
    along = [torch.stack(pair, dim=-1) * half_page(profile) for pair in ((line, zero), (zero, line))]
    tracer, angle = tracer_for(profile), torch.deg2rad(torch.tensor(case["angle_deg"], dtype=torch.float64))
    return {
        "places": traced.places.reshape(*shape, 2).numpy(),
        "valid": traced.valid.reshape(shape).numpy(),
        "reflections": traced.reflections.reshape(*shape, 2).numpy(),
        "symbol_m": profile.symbol_pitch_m,
        "path_x": tracer.path(along[0], angle).numpy(),
        "path_y": tracer.path(along[1], angle).numpy(),
    }


def shared_with_others(places: NDArray[np.float64], zones: NDArray[np.int64], cell_m: float) -> NDArray[np.bool_]:
    """Return whether each ray shares its cell of the camera plane with a ray of another zone, [N].

    Args:
        places: places on the camera plane, metres, [N, 2].
        zones: reflections of each ray, [N, 2].
        cell_m: edge of a cell.
    """
    cells = np.floor(places / cell_m).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    _, zone = np.unique(zones, axis=0, return_inverse=True)
    pairs = np.unique(np.stack([cell.ravel(), zone.ravel()]), axis=1)
    return np.asarray(np.bincount(pairs[0])[cell.ravel()] > 1)


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    rows: list[Row] = []
    (straight,) = (result for case, result in zip(cases, results, strict=True) if not case["angle_deg"])
    for case, result in zip(cases, results, strict=True):
        there = result["valid"].ravel()
        apart = np.linalg.norm(result["places"] - straight["places"], axis=-1)
        # results that were kept before know no symbols
        moved = np.where(straight["valid"], apart, np.nan).ravel()[there] / result.get("symbol_m", np.nan)
        zones, places = (result[name].reshape(-1, 2)[there] for name in ("reflections", "places"))
        step = float(np.ptp(places[:, 0])) / result["places"].shape[1]
        shared = shared_with_others(places, zones, 2 * step)
        for x, y in np.unique(zones, axis=0):
            chosen = (zones == (x, y)).all(1)
            share = float(chosen.sum() / len(there))
            further = float(shared[chosen].mean()), float(np.nanmedian(moved[chosen]))
            rows.append((f"{case['angle_deg']:g}", int(x), int(y), share, *further))
        rows.append((f"{case['angle_deg']:g}", "lost", "", float(1 - there.mean()), float("nan"), float("nan")))
    return rows


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(15, 4.2 * len(cases)), layout="constrained")
    axes = figure.subplots(len(cases), 4, squeeze=False)
    shape = results[0]["places"].shape[:2]
    page = page_places(shape).numpy()
    for row, case, result in zip(axes, cases, results, strict=True):
        for axis, name, component in ((row[0], "path_x", 0), (row[1], "path_y", 1)):
            path = result[name]
            axis.plot(path[:, :, 2] * 1e3, path[:, :, component] * 1e3, linewidth=0.8)
            axis.set_xlabel("z, mm")
            axis.set_ylabel(f"{'xy'[component]}, mm")
            axis.set_title(f"{case['angle_deg']:g} degree: rays in {'xy'[component]}-z")
        for axis, component in ((row[2], 0), (row[3], 1)):
            places = np.where(result["valid"][..., None], result["places"] * 1e3, np.nan)
            axis.scatter(places[..., 0], places[..., 1], c=page[..., component], s=2, cmap="viridis")
            axis.set_aspect("equal")
            axis.invert_yaxis()
            axis.set_xlabel("x on the camera, mm")
            axis.set_ylabel("y on the camera, mm")
            axis.set_title(f"where they land, by {'xy'[component]} on the page")
    return figure


STUDY = Study(
    title="where rays go, and which zones lie on top of each other",
    source="figure 4A and 4D",
    cases=_cases,
    measure=_measure,
    header=("angle", "reflections x", "reflections y", "share of page", "on another zone", "moved, symbols"),
    rows=_rows,
    plot=_plot,
)
