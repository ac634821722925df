"""Study of folding: the pipe mirrors the pieces of a picture, and no view from outside can tell which."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.progress import Progress
from lightpage.simulator.true_optics import TrueOptics
from lightpage.study.studies.rays import half_page, traced_page
from lightpage.study.study import Case, Result, Row, Settings, Study

Real = NDArray[np.float64]

_BORDER = 10
"""Pixels around the page's image, where a sheared pipe sends light too."""
_LOOKS = 16
"""Pages of random phases whose light is averaged: one alone would show speckle."""


def lettered_picture(shape: tuple[int, int]) -> Real:
    """A picture without any symmetry, so that every mirrored piece shows: letters on a ramp, [rows, columns], 0..1."""
    rows, columns = shape
    figure = Figure(figsize=(columns / 100, rows / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    ramp = np.linspace(0.15, 0.5, columns)[None, :] + np.linspace(0, 0.15, rows)[:, None]
    axis.imshow(ramp, cmap="gray", vmin=0, vmax=1, aspect="auto", extent=(0, 6, 4, 0))
    for number, letter in enumerate("ABCDEFGHJKLMNPQRSTUVWXYZ"):
        x, y = number % 6 + 0.5, number // 6 + 0.5
        axis.text(x, y, letter, color="white", fontsize=rows / 7, ha="center", va="center", weight="bold")
    canvas.draw()  # type: ignore[no-untyped-call]
    shown: Real = np.asarray(canvas.buffer_rgba())[..., 0] / 255  # type: ignore[no-untyped-call]
    return shown


def folded_by_rays(profile: Profile, picture: Real, angle_deg: float) -> Real:
    """The picture as rays carry it to the cameras: brightness piles up where they land together.

    Returns:
        [rows + 2 _BORDER, columns + 2 _BORDER]: the page's own place in the middle.
    """
    rows, columns = picture.shape
    _, traced = traced_page(profile, (rows, columns), angle_deg)
    landed = (traced.places / half_page(profile)).numpy()
    edges = [(np.arange(count + 2 * _BORDER + 1) - _BORDER) * 2 / count - 1 for count in (rows, columns)]
    weight = np.where(traced.valid.numpy(), picture.ravel(), 0)
    image, _, _ = np.histogram2d(landed[:, 1], landed[:, 0], bins=edges, weights=weight)
    return np.asarray(image)


def folded_by_waves(profile: Profile, picture: Real, angle_deg: float, looks: int, seed: int, tell: Progress) -> Real:
    """The picture as light carries it, reference blocked: mean intensity over pages of random phases."""
    optics = TrueOptics(profile, Device().with_settings([f"geometry.pipe_angle_deg={angle_deg}"]))
    amplitude = np.sqrt(ndimage.zoom(picture, np.array(optics.slm_factor.shape) / picture.shape, order=1))
    rng = np.random.default_rng(seed)
    total = np.zeros([len(axis) for axis in reversed(optics.camera_axes_m)])
    for look in range(looks):
        tell("light", look / looks)
        phases = rng.uniform(0, 2 * np.pi, profile.page_shape)
        size = profile.page.symbol_size_px
        field = amplitude * np.exp(1j * np.kron(phases, np.ones((size, size))))
        total += np.abs(optics.camera_field(optics.channel.exit_field(optics.slm_factor * field))) ** 2
    return total / looks


def _cases(settings: Settings) -> list[Case]:
    angles = (-0.6,) if settings.quick else (0.0, -0.6)
    return [{"name": f"{angle:+.1f}-degree", "angle_deg": angle} for angle in angles]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile = settings.profile
    rows, columns = profile.page_shape
    scale = 2 if settings.quick else 4
    shape = scale * rows, scale * columns
    picture = lettered_picture(shape)
    looks = 2 if settings.quick else _LOOKS
    waves = folded_by_waves(profile, picture, case["angle_deg"], looks, settings.seed, progress)
    return {
        "picture": picture,
        "rays": folded_by_rays(profile, picture, case["angle_deg"]),
        "waves": waves,
        "kept": _kept(profile, shape, case["angle_deg"]),
    }


def _kept(profile: Profile, shape: tuple[int, int], angle_deg: float) -> float:
    """Share of the page whose light lands where it would without a pipe, to a symbol."""
    points, traced = traced_page(profile, shape, angle_deg)
    stays = torch.linalg.norm(traced.places - points, dim=1) < profile.symbol_pitch_m
    return float((stays & traced.valid).double().mean())


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [(f"{case['angle_deg']:g}", result["kept"]) for case, result in zip(cases, results, strict=True)]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(15, 3.9 * len(cases)), layout="constrained")
    axes = figure.subplots(len(cases), 3, squeeze=False)
    for row, case, result in zip(axes, cases, results, strict=True):
        titles = ("on the modulator", f"on the cameras, by rays, {case['angle_deg']:g} degree", "the same, by waves")
        for axis, name, title in zip(row, ("picture", "rays", "waves"), titles, strict=True):
            axis.imshow(result[name], cmap="gray", vmax=np.quantile(result[name], 0.995))
            axis.set_title(title)
            axis.set_axis_off()
    return figure


STUDY = Study(
    title="what the pipe does to a picture",
    source="figure 2A",
    cases=_cases,
    measure=_measure,
    header=("angle", "share of the page that stays in place"),
    rows=_rows,
    plot=_plot,
)
