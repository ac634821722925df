"""The panels of a dashboard of Grafana's, drawn with matplotlib."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib.dates
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import FuncFormatter, Locator, MaxNLocator, MultipleLocator

from analysis.dashboard.prometheus import RunningPrometheus
from lightpage.pictures import write_figure_png

_COLUMNS = 24
_CELL_IN = (0.72, 0.3)
_DOTS = 75
_COLOURS = {
    "green": "#73bf69",
    "yellow": "#f2cc0c",
    "blue": "#5794f2",
    "orange": "#ff9830",
    "red": "#f2495c",
    "purple": "#b877d9",
}
_PALETTE = [*_COLOURS.values(), "#8ab8ff", "#fade2a", "#96d98d", "#ffb357", "#ca95e5", "#ff7383"]
_BACK, _PANEL, _TEXT, _FAINT = "#111217", "#181b1f", "#ccccdc", "#3a3d44"


def formatted(unit: str) -> Callable[[float, Any], str]:
    """Texts of values in a unit of Grafana's."""

    def scaled(value: float, step: int, ends: Sequence[str]) -> str:
        magnitude = abs(value)
        for end in ends[:-1]:
            if magnitude < step:
                return f"{value:.3g}{end}"
            value, magnitude = value / step, magnitude / step
        return f"{value:.3g}{ends[-1]}"

    def text(value: float, _: Any = None) -> str:
        if not math.isfinite(value):
            return "-"
        if unit == "s":
            if abs(value) >= 60:
                return f"{value / 60:.3g} min" if abs(value) < 3600 else f"{value / 3600:.3g} h"
            return f"{value:.3g} s" if abs(value) >= 1 or not value else f"{1e3 * value:.3g} ms"
        if unit in ("bytes", "Bps"):
            return scaled(value, 1024, [" B", " KiB", " MiB", " GiB"]) + ("/s" if unit == "Bps" else "")
        if unit == "percentunit":
            return f"{100 * value:.4g}%"
        return f"{value:.3g}" + ("/s" if unit == "ops" else "")

    return text


class Drawing:
    """The panels of a dashboard, as a Prometheus knows them.

    Args:
        prometheus: Prometheus that is asked.
        start, end: seconds since 1970.
    """

    def __init__(self, prometheus: RunningPrometheus, start: float, end: float) -> None:
        self._prometheus, self._start, self._end = prometheus, start, end
        self._step_s = max(1.0, (end - start) / 300)

    def draw(self, dashboard: dict[str, Any], out: Path) -> list[str]:
        """Draw it to `out`; returns the titles of panels that have nothing to show."""
        panels, empty = dashboard["panels"], []
        rows = max(panel["gridPos"]["y"] + panel["gridPos"]["h"] for panel in panels)
        figure = plt.figure(figsize=(_COLUMNS * _CELL_IN[0], rows * _CELL_IN[1]), facecolor=_BACK)
        grid = GridSpec(rows, _COLUMNS, figure, left=0.005, right=0.995, top=0.998, bottom=0.002, wspace=0, hspace=0)
        for panel in panels:
            at = panel["gridPos"]
            room = grid[at["y"] : at["y"] + at["h"], at["x"] : at["x"] + at["w"]].get_position(figure)
            if panel["type"] == "row":
                sign = ">" if panel["collapsed"] else "v"
                figure.text(
                    room.x0 + 0.004, room.y0 + room.height / 2, f"{sign}  {panel['title']}", color=_TEXT, va="center"
                )
                continue
            gap_x, gap_y = 0.0015, 0.0012
            box = (room.x0 + gap_x, room.y0 + gap_y, room.width - 2 * gap_x, room.height - 2 * gap_y)
            frame = figure.add_axes(box, facecolor=_PANEL, xticks=[], yticks=[])
            frame.spines[:].set_color(_FAINT)
            frame.annotate(
                panel["title"], (0, 1), (8, -8), "axes fraction", "offset points", color=_TEXT, va="top", size=10
            )
            found = self._asked(panel)
            if not found:
                empty.append(panel["title"])
                frame.text(0.5, 0.45, "No data", color=_TEXT, ha="center", va="center")
            elif panel["type"] == "stat":
                _stat(frame, panel, found)
            else:
                width, height = box[2] * figure.get_figwidth(), box[3] * figure.get_figheight()
                below = 0.62 if len(found) > 4 else 0.45
                inner = (0.62 / width, below / height, 1 - 0.75 / width, 1 - (below + 0.36) / height)
                axes = frame.inset_axes(inner, facecolor=_PANEL)
                _series(axes, frame, panel, found)
                axes.set_xlim(_moment(self._start), _moment(self._end))  # type: ignore[arg-type]
        write_figure_png(out, figure, dpi=_DOTS, facecolor=_BACK)
        plt.close(figure)
        return empty

    def _asked(self, panel: dict[str, Any]) -> list[tuple[str, list[datetime], list[float]]]:
        """Legend, times and values of each series of a panel."""
        found = []
        for target in panel["targets"]:
            expression = target["expr"].replace("$__rate_interval", "15s").replace("$instance", ".*")
            expression = expression.replace("$method", ".*")
            for series in self._prometheus.over(expression, self._start, self._end, self._step_s):
                legend = target["legendFormat"]
                for label in re.findall(r"{{(\w+)}}", legend):
                    legend = legend.replace(f"{{{{{label}}}}}", series["metric"].get(label, ""))
                values = [float(value) for _, value in series["values"]]
                if any(map(math.isfinite, values)):
                    found.append((legend, [_moment(float(at)) for at, _ in series["values"]], values))
        return found


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _colours(panel: dict[str, Any]) -> dict[str, str]:
    """Return the colours of a panel's series that have one of their own, by name."""
    found = {}
    for override in panel["fieldConfig"]["overrides"]:
        for one in override["properties"]:
            if one["id"] == "color":
                found[override["matcher"]["options"]] = _COLOURS[one["value"]["fixedColor"]]
    return found


def _series(
    axes: Axes, frame: Axes, panel: dict[str, Any], found: list[tuple[str, list[datetime], list[float]]]
) -> None:
    defaults, own = panel["fieldConfig"]["defaults"], _colours(panel)
    palette = cycle([colour for colour in _PALETTE if colour not in own.values()] or _PALETTE)
    colours = [own.get(legend) or next(palette) for legend, _, _ in found]
    if defaults["custom"]["stacking"]["mode"] == "normal":
        times = sorted({at for _, moments, _ in found for at in moments})
        layers = [dict(zip(moments, values, strict=True)) for _, moments, values in found]
        heights = [
            [max(0.0, layer.get(at, 0.0)) if math.isfinite(layer.get(at, 0.0)) else 0.0 for at in times]
            for layer in layers
        ]
        axes.stackplot(times, heights, colors=colours, labels=[legend for legend, _, _ in found], alpha=0.8)  # type: ignore[arg-type]
    else:
        for (legend, moments, values), colour in zip(found, colours, strict=True):
            axes.plot(moments, values, color=colour, label=legend, linewidth=1.4)  # type: ignore[arg-type]
    low, high = axes.get_ylim()
    axes.set_ylim(defaults.get("min", low), max(defaults.get("max", high), defaults.get("min", low) + 1e-9))
    axes.yaxis.set_major_formatter(FuncFormatter(formatted(defaults["unit"])))
    axes.yaxis.set_major_locator(_locator(defaults["unit"], axes.get_ylim()))
    axes.xaxis.set_major_formatter(matplotlib.dates.DateFormatter("%H:%M"))  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(matplotlib.dates.MinuteLocator())  # type: ignore[no-untyped-call]
    axes.tick_params(colors=_TEXT, labelsize=8, length=0)
    axes.grid(color=_FAINT, linewidth=0.6)
    axes.spines[:].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    frame.legend(
        handles,
        labels,
        loc="lower left",
        ncols=4,
        fontsize=8,
        frameon=False,
        labelcolor=_TEXT,
        handlelength=1.2,
        columnspacing=1.0,
        borderaxespad=0.3,
    )


def _locator(unit: str, limits: tuple[float, float]) -> Locator:
    """Place about five marks on an axis, at powers of two for bytes."""
    if unit not in ("bytes", "Bps"):
        return MaxNLocator(5)
    return MultipleLocator(2.0 ** math.ceil(math.log2(max(1.0, (limits[1] - limits[0]) / 5))))


def _stat(frame: Axes, panel: dict[str, Any], found: list[tuple[str, list[datetime], list[float]]]) -> None:
    defaults, (legend, _, values) = panel["fieldConfig"]["defaults"], found[-1]
    value = next(one for one in reversed(values) if math.isfinite(one))
    colour = "green"
    for step in defaults["thresholds"]["steps"]:
        if step["value"] is None or value >= step["value"]:
            colour = step["color"]
    named = {key: told["text"] for mapping in defaults["mappings"] for key, told in mapping["options"].items()}
    text = legend
    if panel["options"]["textMode"] != "name":
        text = named.get(f"{value:g}", formatted(defaults["unit"])(value, None))
    frame.text(0.5, 0.4, text, color=_COLOURS[colour], ha="center", va="center", size=20, weight="bold")
