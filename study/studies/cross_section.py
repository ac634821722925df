"""Study of cross-sections: where a point's light lands behind a square and a round pipe, in few spots or a smear."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.progress import Progress
from lightpage.study.study import Case, Result, Row, Settings, Study

Real = NDArray[np.float64]

_SYMBOL_PX = 2
"""Symbols whose first order the rays fill: of 2x2 pixels, at full scale an aperture of 0.0145."""
_POINTS = {
    "centre": (0, 0),
    "edge of a zone": (0, 0.5),
    "next zone": (0, 1),
    "corner of zones": (0.5, 0.5),
    "diagonal": (1, 1),
}
"""Exit centroids over the pipe's width (x, y): how often a beam meets walls."""
_RAYS = 41
_SAME_SPOT = 0.02
"""Places within this share of the pipe's width are one spot."""


def bundle(profile: Profile, centroid: tuple[float, float], rays: int) -> tuple[Real, Real]:
    """Rays of one modulator point at the pipe's entrance: places [N, 2], metres, and direction sines [2] in glass.

    A point leaves the lens as parallel rays; how wide they are spread over the entrance is its aperture. The point is
    the one whose beam leaves the pipe `centroid` pipe widths from the axis, were there no walls.
    """
    pipe = profile.pipe
    sines = np.array(centroid) * pipe.width_m
    sines = sines / np.hypot(pipe.length_m, np.linalg.norm(sines))
    spread = profile.light.wavelength_m * profile.lens.focal_length_m / (_SYMBOL_PX * profile.slm.pitch_m) / 2
    axis = np.linspace(-1, 1, rays)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside = places[np.linalg.norm(places, axis=1) <= 1]
    return inside * min(spread, 0.98 * pipe.width_m / 2), sines


def square_exit(profile: Profile, places: Real, sines: Real) -> Real:
    """Direction sines [N, 2] behind a square pipe, by unfolding it."""
    width, length = profile.pipe.width_m, profile.pipe.length_m
    reach = places + sines / np.sqrt(1 - np.sum(sines**2)) * length
    cells = np.rint(reach / width)
    return np.asarray(np.where(cells % 2 == 0, sines, -sines) * np.ones_like(places))


def round_exit(profile: Profile, places: Real, sines: Real) -> Real:
    """Direction sines [N, 2] behind a round pipe of the same width, wall after wall."""
    radius, length = profile.pipe.width_m / 2, profile.pipe.length_m
    at, going = places.copy(), np.tile(sines, (len(places), 1))
    cosine = np.sqrt(1 - np.sum(sines**2))
    left = np.full(len(places), length / cosine)
    bound = int(np.ceil(length * np.linalg.norm(sines) / cosine / radius * 50)) + 2
    for _ in range(min(bound, 10_000)):
        # |at + s going| = radius
        a, b, c = np.sum(going**2, 1), np.sum(at * going, 1), np.sum(at**2, 1) - radius**2
        reach = np.where(a > 0, (-b + np.sqrt(np.maximum(b * b - a * c, 0))) / np.maximum(a, 1e-300), np.inf)
        hit = reach < left
        if not hit.any():
            break
        at[hit] += reach[hit, None] * going[hit]
        left[hit] -= reach[hit]
        normal = at[hit] / np.linalg.norm(at[hit], axis=1, keepdims=True)
        going[hit] -= 2 * np.sum(going[hit] * normal, axis=1, keepdims=True) * normal
        at[hit] *= 1 - 1e-12
    return going


def spots(places: Real, same_m: float) -> int:
    """Number of separate spots: squares of that size that light falls into, those that touch counted once."""
    cells = {tuple(cell) for cell in np.rint(places / same_m).astype(int)}
    count = 0
    while cells:
        count += 1
        front = [cells.pop()]
        while front:
            x, y = front.pop()
            near = {(x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1)} & cells
            cells -= near
            front += near
    return count


def _cases(settings: Settings) -> list[Case]:
    return [
        {"name": f"{shape} {name}".replace(" ", "-"), "shape": shape, "point": name, "centroid": centroid}
        for shape in ("square", "round")
        for name, centroid in _POINTS.items()
    ]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile = settings.profile
    progress("trace", 0.0)
    places, sines = bundle(profile, case["centroid"], 11 if settings.quick else _RAYS)
    trace = square_exit if case["shape"] == "square" else round_exit
    landed = trace(profile, places, sines) * profile.pipe.refractive_index * profile.lens.focal_length_m
    spread = float(np.sqrt(np.mean(np.sum((landed - landed.mean(0)) ** 2, axis=1))))
    return {
        "landed": landed,
        "spots": spots(landed, _SAME_SPOT * profile.pipe.width_m),
        "spread_mm": round(spread * 1e3, 9),
        "aperture": float(np.abs(places).max() / profile.lens.focal_length_m),
    }


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [
        (case["shape"], case["point"], result["spots"], result["spread_mm"], result["aperture"])
        for case, result in zip(cases, results, strict=True)
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(14, 6.7), layout="constrained")
    axes = figure.subplots(2, len(_POINTS), sharex=True, sharey=True)
    reach = 1.1e3 * max(float(np.abs(result["landed"]).max()) for result in results)
    for axis, case, result in zip(axes.ravel(), cases, results, strict=True):
        axis.plot(*(result["landed"].T * 1e3), ".", markersize=3)
        axis.set_title(f"{case['shape']}, {case['point']}")
        axis.set(aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("x on the camera, mm")
    for axis in axes[:, 0]:
        axis.set_ylabel("y, mm")
    return figure


STUDY = Study(
    title="where the light of a point lands behind a square and a round pipe",
    source="supplement S1",
    cases=_cases,
    measure=_measure,
    header=("pipe", "point", "spots", "spread mm", "aperture"),
    rows=_rows,
    plot=_plot,
)
