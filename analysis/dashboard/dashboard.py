"""The dashboard of deploy/grafana, drawn from what a real Prometheus has scraped from a real service under load.

    python -m analysis.dashboard.dashboard --out docs/images/dashboard.png

The panels are those of the dashboard's JSON: their titles, expressions, units, stacking and colours. Only the drawing
is matplotlib's, in place of Grafana's. Pages of user bytes are sent and read; then the device has drifted; it is
recalibrated with known pages; at last more calls come than can be served.
"""

from __future__ import annotations

import json
import math
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path
from typing import Any

import click
import grpc
import matplotlib.dates
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import FuncFormatter, Locator, MaxNLocator, MultipleLocator

from analysis.dashboard.prometheus import DEPLOY, RunningPrometheus
from analysis.service.overload import capacity
from analysis.service.running import PagesToSend, RunningService, stub
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.demo.demo import SPOILT_PAGE, drifted, write_pages
from lightpage.device.state import Device
from lightpage.errors import LightpageError
from lightpage.pictures import write_figure_png
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pages import Pages
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.simulator import SimulatorSource
from lightpage.runtime.device.acquisition.source import SHOT_S, Shot
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder

DASHBOARD = DEPLOY / "grafana" / "lightpage.json"
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
_PAGES = tuple(page for page in range(6) if page != SPOILT_PAGE)
_DRIFT = 0.1
"""Of the change of temperature of `drifted`: margin is lost, and no page yet."""
_DEADLINE_S = 4.0
_CALLERS = 12
_USER_BYTES = pb.DecodeOptions(want_user_data=True, session="device")


@dataclass(frozen=True)
class Shots:
    """Pages of a simulated device, and its reference beam."""

    pages: tuple[Shot, ...]
    references: FramePair


def shots(decoder: Decoder, folder: Path) -> tuple[Shots, Shots]:
    """Pages of user bytes on the bench device, as it was calibrated and after a drift."""
    write_pages(decoder, folder / "pages.h5", 0)
    source = SimulatorSource(decoder.bundle.profile, Device(), written=Pages.open(folder / "pages.h5"))
    taken = []
    with source:
        for device in (Device(), drifted(Device(), _DRIFT)):
            source.set_device(device)
            pages = [source.shot(SHOT_S, n) for n in track(_PAGES, "simulate", total=len(_PAGES))]
            taken.append(Shots(tuple(pages), source.references()))
    return taken[0], taken[1]


class Load:
    """Callers that send pairs of the device, now and then two in one call.

    Args:
        service: that they call.
        rate: calls a second, of all callers together.
    """

    def __init__(self, service: RunningService, rate: float) -> None:
        self._service, self._rate, self.factor = service, rate, 1.0
        self.pairs: Sequence[FramePair] = ()
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._call, args=(number,)) for number in range(_CALLERS)]

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _call(self, number: int) -> None:
        chance, sent = np.random.default_rng(number), PagesToSend()
        with self._service.channel() as channel:
            while not self._stop.wait(chance.exponential(_CALLERS / (self.factor * self._rate))):
                pair = self.pairs[int(chance.integers(len(self.pairs)))]
                with suppress(grpc.RpcError):
                    requests = sent.requests(pair, options=_USER_BYTES)
                    if chance.random() < 0.1:
                        list(stub(channel).DecodePages(iter(2 * requests), timeout=2 * _DEADLINE_S))
                    else:
                        stub(channel).DecodeFrames(iter(requests), timeout=_DEADLINE_S)


def scenario(service: RunningService, decoder: Decoder, seconds: float, folder: Path) -> None:
    """Use the service as calibrated, drifted, recalibrated and overloaded, each for a while."""
    click.echo("simulate pages")
    fresh, moved = shots(decoder, folder)
    pairs = [[shot.pair for shot in taken.pages] for taken in (fresh, moved)]
    known = [(shot.pair, shot.symbols) for shot in moved.pages[1:4] if shot.symbols is not None]
    rate = capacity(service, PagesToSend(), 8.0)
    click.echo(f"the service decodes {rate:.2f} pages a second")
    load = Load(service, rate)

    def phase(what: str, of: Sequence[FramePair], factor: float) -> None:
        click.echo(what)
        load.pairs, load.factor = of, factor
        time.sleep(seconds)

    load.pairs = pairs[0]
    with load, LightpageClient(service.target, timeout_s=120) as client:
        phase("as calibrated", pairs[0], 0.5)
        phase("after a drift", pairs[1], 0.5)
        click.echo("recalibrate")
        started = client.recalibrate_frames(
            [pair for pair, _ in known],
            [symbols for _, symbols in known],
            moved.references,
            levels=decoder.page_codec.code.levels,
        )
        try:
            last = started
            for job in client.watch_job(started.id):
                last = job
            click.echo(f"recalibration: {last.state}")
        except LightpageError as error:
            click.echo(f"recalibration: {error}")
        phase("recalibrated", pairs[1], 0.5)
        phase("overload", pairs[1], 4.0)


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
        prometheus: that is asked.
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
    """Of the series that have one of their own."""
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
    """Some five marks; of bytes at powers of two."""
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


@click.command()
@click.option("--seconds", default=60.0, show_default=True, type=click.FloatRange(5.0), help="Of each of four phases.")
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1), help="Threads of an inference.")
@click.option("--out", required=True, type=OutputFile(), help="The picture, PNG.")
def main(seconds: float, threads: int, out: Path) -> None:
    """Draw the dashboard of a service under load."""
    decoder = Decoder.load(bundle_path(DEFAULT), threads)
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder = Path(name)
        service = RunningService("--store", f"{folder}/models", "--threads", str(threads))
        with service, RunningPrometheus(service.metrics.removeprefix("http://").partition("/")[0]) as prometheus:
            begun = time.time()
            scenario(service, decoder, seconds, folder)
            time.sleep(2.0)  # for the last scrape
            empty = Drawing(prometheus, begun, time.time()).draw(json.loads(DASHBOARD.read_text("utf-8")), out)
    click.echo(f"{out}: no data in {', '.join(empty) if empty else 'no panel'}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.dashboard.dashboard"))
