"""The figures of the report of a run or of an evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from numpy.typing import NDArray

from lightpage.calibration.goodness.figure import goodness_figure
from lightpage.metrics.measures import smoothed
from lightpage.report.contents.data import Golden, Real, ReportData
from lightpage.report.drawing import BLUE, GREEN, GREY, ORANGE, Picture, as_picture, new_figure, one_axis
from lightpage.report.words import number, signed

if TYPE_CHECKING:
    from lightpage.train.fitting.curves import Curve

_TRIMMED = 1.0
"""Per cent at either end that do not stretch a colour scale."""
_BRIGHTEST = 99.8
"""Per cent of a frame's pixels that are not drawn white."""
_LEAST_KAPPA = 1e-2


def maps(data: ReportData, centroids: Real | None) -> list[Picture]:
    """AIR, own-MI, over-claim and phase error over the page, with the borders of the zones where `centroids` tell."""
    air, own, error = (smoothed(each) for each in (data.maps.air, data.maps.own_mi, np.rad2deg(data.maps.error_rad)))
    low, high = np.percentile([air, own], [_TRIMMED, 100 - _TRIMMED])
    claim = own - air
    most = float(np.percentile(np.abs(claim), 100 - _TRIMMED)) or 1.0
    error_low, error_high = np.percentile(error, [_TRIMMED, 100 - _TRIMMED]).tolist()
    mean, mean_error = data.measures, np.rad2deg(np.nanmean(data.maps.error_rad))
    claimed = number(mean.over_claim_bits_per_symbol, 3)
    rows = (
        ("AIR, bit/symbol", air, "viridis", (low, high), f"AIR, mean {mean.air_bits_per_symbol:.3f} bit/symbol."),
        (
            "own-MI, bit/symbol",
            own,
            "viridis",
            (low, high),
            f"Own-MI, what the decoder claims, mean {mean.own_mi_bits_per_symbol:.3f} bit/symbol; colours as for AIR.",
        ),
        (
            "over-claim, bit/symbol",
            claim,
            "PuOr",
            (-most, most),
            f"Over-claim, own-MI less AIR, mean {claimed} bit/symbol: above zero claims too much.",
        ),
        (
            "mean |phase error|, degree",
            error,
            "cividis",
            (error_low, error_high),
            f"Mean magnitude of the phase error, {mean_error:.2f} degrees over the page.",
        ),
    )
    return [
        _map(label, values, colormaps[colours], limits, centroids, caption)
        for label, values, colours, limits, caption in rows
    ]


def goodness(data: ReportData) -> list[Picture]:
    """Draw maps of the light that the calibration does not explain; none where that was not measured."""
    found = data.calibration.goodness
    if found is None:
        return []
    alt = (
        f"Maps of the light that the calibration does not explain, over page and exit facet: the fit is {found.verdict}"
    )
    caption = "Light of a known page that the fitted device does not explain, over noise: 1 is noise alone."
    return [as_picture(goodness_figure(found), alt, caption, image=True)]


def _map(
    label: str, values: Real, colours: Colormap, limits: tuple[float, float], centroids: Real | None, caption: str
) -> Picture:
    figure, axis = one_axis(image=True)
    shown = axis.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1])
    figure.colorbar(shown, ax=axis, label=label, extend="both", orientation="horizontal", aspect=35)
    for centroid, style in zip(() if centroids is None else centroids, ("solid", "dashed"), strict=False):
        borders = np.arange(np.floor(centroid.min()) + 0.5, centroid.max())
        if len(borders):
            lines = axis.contour(centroid, levels=borders, colors="white", linestyles=style, linewidths=1.3)
            lines.set_path_effects([patheffects.withStroke(linewidth=2.4, foreground="black")])
    if centroids is not None:
        _name_zones(axis, np.rint(centroids).astype(int))
    axis.set(xlabel="column, symbols", ylabel="row, symbols")
    return as_picture(figure, f"Map over the page. {caption}", caption, image=True)


def _name_zones(axis: Axes, cells: NDArray[np.int_]) -> None:
    for x, y in np.unique(cells.reshape(2, -1), axis=1).T.tolist():
        rows, columns = np.nonzero((cells[0] == x) & (cells[1] == y))
        axis.text(
            float(columns.mean()),
            float(rows.mean()),
            f"{signed(x)}, {signed(y)}",
            ha="center",
            va="center",
            fontsize=8,
            color="white",
            path_effects=[patheffects.withStroke(linewidth=2, foreground="black")],
        )


def reliability(data: ReportData) -> Picture:
    """Confidence against accuracy, with how many symbols claim it."""
    bins = data.confidence_bins
    figure = new_figure()
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    most = max(max(b.high for b in bins), max(b.accuracy for b in bins))
    above.plot([0, most], [0, most], color=GREY, linewidth=1, linestyle="dashed", label="calibrated")
    above.plot(
        [b.confidence for b in bins], [b.accuracy for b in bins], "o-", color=BLUE, markersize=4, label="measured"
    )
    above.set(ylabel="accuracy", ylim=(0, 1.05 * most), title=f"ECE {data.measures.ece:.4f}")
    above.legend(frameon=False, loc="upper left")
    widths = [b.high - b.low for b in bins]
    below.bar([b.low for b in bins], [b.count for b in bins], widths, align="edge", color=BLUE, edgecolor="white")
    below.set(
        xlabel="confidence (posterior of the decided level)", ylabel="symbols", xlim=(0, 1.02 * most), yscale="log"
    )
    caption = (
        f"Confidence against accuracy, {data.measures.count:,} symbols of {data.measures.levels} levels. "
        "Below the dashed line, decisions are less sure than they claim."
    )
    return as_picture(figure, f"Reliability diagram, ECE {data.measures.ece:.4f}.", caption)


_DRIFTS = (
    ("piston", "rad", ("piston_rad",)),
    ("image", "px", ("image_x_px", "image_y_px")),
    ("tilt", "rad", ("tilt_x_rad", "tilt_y_rad")),
    ("stroke, brightness", "relative", ("stroke_relative", "brightness_relative")),
)
"""Panels of the drift: title, unit, and the quantities that they show, each since its first page."""


def drift(data: ReportData) -> list[Picture]:
    """Draw what drifts from page to page; none where it is not known."""
    panels = [panel for panel in _DRIFTS if any(name in data.drift for name in panel[2])]
    if not panels:
        return []
    figure = new_figure()
    axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    for axis, (title, unit, names) in zip(axes, panels, strict=True):
        for name, colour in zip(names, (BLUE, ORANGE), strict=False):
            if name in data.drift:
                values = np.array(data.drift[name].values, np.float64)
                shown = np.flatnonzero(np.isfinite(values))
                if not shown.size:
                    continue
                what = name.rpartition("_")[0].replace("_", " ")
                axis.plot(shown + 1, (values - values[shown[0]])[shown], color=colour, linewidth=1, label=what)
        axis.set_ylabel(unit)
        axis.set_title(title, loc="left")
        if len(names) > 1:
            axis.legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0, ncols=2)
    axes[-1].set_xlabel("measured page")
    steps = ", ".join(f"{name.replace('_', ' ')} {walk.step:.2g}" for name, walk in data.drift.items())
    caption = f"Drift since the first page. Root mean square of the change from page to page: {steps}."
    return [as_picture(figure, "Lines of the device's state over the pages.", caption)]


def concentration(data: ReportData) -> Picture:
    """Draw promised concentrations against observed ones, as distances from a perfect cosine."""
    bins = data.concentration_bins
    figure, axis = one_axis()
    ends = np.maximum(np.array([(b.low, b.high) for b in bins]), _LEAST_KAPPA)
    middle = np.sqrt(ends[:, 0] * ends[:, 1])
    promised, observed = (np.array([1 - getattr(b, name) for b in bins]) for name in ("promised", "observed"))
    axis.plot(middle, promised, color=GREY, linestyle="dashed", linewidth=1, label="promised, 1 − I₁(κ)/I₀(κ)")
    reach = np.abs(ends.T - middle)
    told = "observed, 1 − mean cos(error)"
    axis.errorbar(middle, observed, xerr=reach, fmt="o", color=BLUE, markersize=4, linewidth=1, label=told)
    axis.set(xlabel="concentration κ", ylabel="1 − mean cos(error)", xscale="log", yscale="log")
    axis.legend(frameon=False)
    caption = (
        "Concentration against measured error, in bins of equal count; bars span a bin. "
        "Points above the dashed line err more than κ promises."
    )
    worst = max(abs(b.promised - b.observed) for b in bins)
    alt = f"Concentration against measured error; mean cosine and I1/I0 differ by at most {worst:.2g}."
    return as_picture(figure, alt, caption)


def training(passes: Sequence[Mapping[str, Curve]]) -> list[Picture]:
    """Loss and AIR while the run was trained, and the pipe's angle where rays were; one pass behind the other."""
    pictures = []
    if losses := _in_a_row(passes, "train_nll"):
        figure, axis = one_axis()
        for index, curve in enumerate(losses):
            axis.plot(*_xy(curve), color=BLUE, linewidth=0.8, label="training" if not index else None)
        _mark_passes(axis, losses)
        axis.set(xlabel="step", ylabel="loss, nat/symbol")
        axis.legend(frameon=False)
        last = losses[-1][-1]
        caption = "Loss, the von Mises negative log-likelihood, of training batches. Validation is logged as AIR only."
        pictures.append(
            as_picture(figure, f"Loss over the steps, {number(last[1], 2)} nat/symbol at step {last[0]}.", caption)
        )
    rates = {"train_air": ("training batches", BLUE, "-"), "val_air": ("validation pages", ORANGE, "o-")}
    if any(tag in curves for tag in rates for curves in passes):
        figure, axis = one_axis()
        for tag, (name, colour, style) in rates.items():
            for index, curve in enumerate(_in_a_row(passes, tag)):
                label = None if index else name
                axis.plot(*_xy(curve), style, color=colour, linewidth=0.9, markersize=2.5, label=label)
        _mark_passes(axis, _in_a_row(passes, "train_air"))
        axis.set(xlabel="step", ylabel="AIR, bit/symbol")
        axis.legend(frameon=False, loc="lower right")
        best = [max(value for _, value in curve) for curve in _in_a_row(passes, "val_air")]
        caption = "AIR of training batches and of the validation pages"
        if best:
            caption += f", at its best {', with one more pass '.join(f'{air:.3f}' for air in best)} bit/symbol"
        caption += "."
        pictures.append(as_picture(figure, f"AIR over the steps. {caption}", caption))
    if angles := _in_a_row(passes, "angle_deg"):
        figure, axis = one_axis()
        axis.plot(*_xy(angles[0]), color=GREEN, linewidth=1.2)
        axis.set(xlabel="step", ylabel="pipe angle, degree")
        last = angles[0][-1]
        caption = f"Pipe angle that the rays were trained to, {number(last[1], 3)} degrees at step {last[0]}."
        pictures.append(as_picture(figure, caption, caption))
    return pictures


def _in_a_row(passes: Sequence[Mapping[str, Curve]], tag: str) -> list[Curve]:
    """The curves of a tag, each pass's steps counted on from those of the passes before it."""
    found: list[Curve] = []
    before = 0
    for curves in passes:
        if curve := curves.get(tag):
            found.append([(before + step, value) for step, value in curve])
        before += max((step + 1 for other in curves.values() for step, _ in other), default=0)
    return found


def _mark_passes(axis: Axes, curves: Sequence[Curve]) -> None:
    """A line where each further pass begins."""
    for curve in curves[1:]:
        axis.axvline(curve[0][0], color="gray", linewidth=0.8, linestyle=":")
        axis.annotate(" further pass", (curve[0][0], 1), xycoords=("data", "axes fraction"), va="top", fontsize=7)


def page(golden: Golden) -> list[Picture]:
    """Draw both frames, and the phase that is decoded from them."""
    pictures = []
    for name, frame in (("In-phase", golden.pair.in_phase), ("Quadrature", golden.pair.quadrature)):
        figure, axis = one_axis(image=True)
        shown = axis.imshow(frame, cmap="gray", vmin=0, vmax=float(np.percentile(frame, _BRIGHTEST)))
        figure.colorbar(shown, ax=axis, label="counts", extend="max", orientation="horizontal", aspect=35)
        axis.set(xlabel="column, px", ylabel="row, px")
        pictures.append(as_picture(figure, f"{name} camera frame of one page.", f"{name} frame.", image=True))
    figure, axis = one_axis(image=True)
    shown = axis.imshow(golden.phase, cmap="twilight", vmin=-math.pi, vmax=math.pi)
    bar = figure.colorbar(shown, ax=axis, label="phase, rad", orientation="horizontal", aspect=35)
    bar.set_ticks([-math.pi, 0, math.pi], labels=["−π", "0", "π"])
    axis.set(xlabel="column, symbols", ylabel="row, symbols")
    caption = "Phase that is decoded from the two, piston removed."
    return [*pictures, as_picture(figure, "Decoded phase of every symbol of the page.", caption, image=True)]


def rays(data: ReportData, traced: Sequence[tuple[Real, NDArray[np.int64]]]) -> list[Picture]:
    """Rays of a row and of a column of the page, from the side: all of the way, and inside of the pipe."""
    pictures = []
    for axis, ((path, met), (name, wall)) in enumerate(zip(traced, (("x", "x"), ("y", "y'")), strict=True)):
        pictures += [_side(data, path, met, axis, name, wall, inside=inside) for inside in (False, True)]
    return pictures


def _side(
    data: ReportData, path: Real, met: NDArray[np.int64], axis: int, name: str, wall: str, *, inside: bool
) -> Picture:
    """Draw a side view; `path` [K, N, 3] in millimetres, `met` reflections [N] at the walls of this view."""
    lens, pipe = data.rays.lens, data.profile.pipe
    surfaces = 1 if lens is None else len(lens.surfaces)
    middle = path[:, path.shape[1] // 2, 2]  # along the axis, where no ray is lost
    entrance = float(middle[surfaces + 1])
    exit_ = entrance + 1e3 * pipe.length_m
    half = 1e3 * pipe.width_m / 2 / (1.0 if axis == 0 else math.cos(math.radians(data.rays.angle_deg)))
    figure, view = one_axis()
    kinds = sorted(set(met.tolist()))
    colours = dict(zip(kinds, colormaps["viridis"](np.linspace(0, 0.85, len(kinds))), strict=True))
    for ray in range(path.shape[1]):
        view.plot(path[:, ray, 2], path[:, ray, axis], color=colours[int(met[ray])], linewidth=0.8)
    for kind in kinds:
        view.plot([], [], color=colours[kind], label=f"{kind} at {wall}")
    for edge in (-half, half):
        view.plot([entrance, exit_], [edge, edge], color="black", linewidth=1.5)
    if inside:
        margin = 0.03 * (exit_ - entrance)
        view.set(xlim=(entrance - margin, exit_ + margin), ylim=(-1.15 * half, 1.15 * half))
    else:
        for surface in (*range(1, surfaces + 1), *range(-1 - surfaces, -1)):
            view.plot(path[surface, :, 2], path[surface, :, axis], color=GREY, linewidth=1.5)
        for plane in (middle[0], middle[-1]):
            view.axvline(float(plane), color=GREY, linestyle="dotted", linewidth=1)
    view.set(xlabel="z, mm", ylabel=f"{name}, mm")
    figure.legend(frameon=False, loc="outside upper center", ncols=4, fontsize=8, title="reflections", title_fontsize=8)
    where = "inside of the pipe" if inside else "from modulator (left) to camera (right)"
    caption = f"{name}–z, {where}; black: walls." if inside else f"{name}–z, {where}; grey: lenses, black: walls."
    return as_picture(figure, f"Side view {name} against z of {path.shape[1]} rays {where}.", caption)


def _xy(curve: Curve) -> tuple[list[int], list[float]]:
    return [step for step, _ in curve], [value for _, value in curve]
