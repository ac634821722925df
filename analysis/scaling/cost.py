"""Pages a second against nodes: one node measured, and a cluster of them simulated as queues.

    python -m analysis.scaling.cost --out FOLDER --keep node.json      # measure this machine, then simulate
    python -m analysis.scaling.cost --from node.json                   # simulate from what was measured before

It prints its assumptions, compares itself with runs of this machine, and says which part is saturated first.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from analysis.scaling.archive import archive
from analysis.scaling.cluster_model import (
    Cluster,
    Driver,
    Rate,
    Work,
    nodes_that_saturate,
    simulated,
    whole_job_pages_per_s,
)
from analysis.scaling.node_figures import DriverFigures, NodeFigures, RunFigures, measure
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.errors import InvalidInputError
from lightpage.files import replace_text
from lightpage.metrics.provenance import write_figures
from lightpage.pictures import write_figure_png
from lightpage.progress import track
from lightpage.report.drawing import BLUE, ORANGE
from lightpage.runtime.archives.workers.ray_engine import AHEAD

NODES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
ETHERNET_BYTES_PER_S = 1.25e9
"""10 Gbit/s."""
FULL_SIZE_S, FULL_SIZE_BYTES, FULL_SIZE_SYMBOLS = 3.324, 2 * 5472 * 3648.0, 350 * 225
"""Seconds of a page of two passes on two cores (docs/results/full-size.md), bytes of its frames, its symbols."""
BENCH_SYMBOLS = 87 * 56
_DRAWS = 20
"""Jobs whose mean is compared with one that was run."""
PAGES, _LEAST_RANGES, _MOST_RANGES = 500_000, 24, 400
"""Pages of a simulation, about, and ranges that each of its workers does at least and at most."""


@dataclass(frozen=True)
class Kind:
    """Pages of one size, and the nodes that read them.

    Attributes:
        name: name of the kind.
        work: work of a worker.
        workers: workers of a node.
    """

    name: str
    work: Work
    workers: int


def kinds(figures: NodeFigures, full_size_s: float, full_size_bytes: float) -> list[Kind]:
    """The bench page as it was measured with all workers at work, and the full-size page with the same spread."""
    most = max(figures.measured, key=lambda run: run.workers)
    ranges = np.array(most.page_seconds)
    range_s = figures.record_s + round_trip_s(figures)
    bench = Work(tuple(ranges), figures.read_bytes, figures.written_bytes, range_s, figures.range_pages)
    scaled = tuple(full_size_s * ranges / ranges.mean())
    written = figures.written_bytes * FULL_SIZE_SYMBOLS / BENCH_SYMBOLS
    full = Work(scaled, full_size_bytes, written, range_s, figures.range_pages)
    return [Kind("bench", bench, most.workers), Kind("full-size", full, 1)]


def round_trip_s(figures: NodeFigures) -> float:
    """Return the seconds between two ranges of a worker that does nothing, with two ranges in flight."""
    least = min(figures.ray, key=lambda driver: driver.in_flight)
    return least.wall_s * least.in_flight


def fitted_driver(figures: Sequence[DriverFigures], ahead: int) -> Driver:
    """Fit the driver's cost of a range as a line over the number of ranges in flight."""
    in_flight, took = np.array([(each.in_flight, each.cpu_s) for each in figures]).T
    if len(figures) == 1:
        return Driver(float(took[0]), 0.0, ahead)
    slope, base = np.polyfit(in_flight, took, 1)
    return Driver(max(0.0, float(base)), max(0.0, float(slope)), ahead)


def checks(figures: NodeFigures) -> list[dict[str, float]]:
    """The model of one node against runs of it that it was not made from.

    By the run with as many workers, and by the run with one: the difference is what workers of a node take from each
    other, which the model does not know.
    """
    alone = min(figures.measured, key=lambda run: run.workers)
    driver = Driver(max(each.cpu_s for each in figures.local), 0.0, ahead=1)
    ranges = -(-figures.pages // figures.range_pages)

    def predicted(run: RunFigures, workers: int) -> float:
        moved = figures.read_bytes, figures.written_bytes
        work = Work(run.page_seconds, *moved, figures.record_s, figures.range_pages)
        cluster = Cluster(1, workers, storage_bytes_per_s=1e15, link_bytes_per_s=1e15)
        rates = [whole_job_pages_per_s(cluster, work, driver, ranges, seed) for seed in range(_DRAWS)]
        return float(np.mean(rates))

    return [
        {
            "workers": checked.workers,
            "measured_pages_per_s": checked.pages_per_s,
            "predicted_pages_per_s": predicted(own, checked.workers),
            "predicted_from_one_worker": predicted(alone, checked.workers),
        }
        for own, checked in zip(figures.measured, figures.checked, strict=True)
    ]


def curve(kind: Kind, cluster: Cluster, driver: Driver, nodes: Sequence[int], seed: int) -> list[Rate]:
    """Rates of clusters of so many nodes."""
    rates = []
    for count in track(nodes, f"simulate {kind.name}", unit="cluster"):
        own = replace(cluster, nodes=count, workers=kind.workers)
        ranges = PAGES // (count * kind.workers * kind.work.range_pages)
        ranges = max(_LEAST_RANGES, min(_MOST_RANGES, ranges))
        rates.append(simulated(own, kind.work, driver, ranges_per_worker=ranges, seed=seed))
    return rates


def assumptions(figures: NodeFigures, cluster: Cluster, driver: Driver) -> list[str]:
    """List the assumptions of the model."""
    failures = (
        "no node fails"
        if cluster.mtbf_s is None
        else f"a node fails every {cluster.mtbf_s / 3600:g} h and is back after {cluster.repair_s:g} s"
    )
    return [
        f"a node is this machine: {figures.cores} cores, that many bench workers of one thread, or one full-size "
        "worker of two threads",
        "all nodes are alike; the time of a range is drawn from those that were measured",
        f"storage: {cluster.storage_bytes_per_s / 1e9:g} GB/s for all, {cluster.link_bytes_per_s / 1e9:g} GB/s a node, "
        "page by page, first come first served; no cache, no latency, no cost of names",
        f"a worker reads one page ahead; the driver keeps {driver.ahead} ranges on their way for each worker",
        f"driver: {1e3 * driver.base_s:.2f} ms a range and {1e6 * driver.in_flight_s:.2f} us for each on its way, "
        "one at a time: the CPU time of Ray's process here, whose threads really run side by side",
        "Ray's own head and schedulers are not in it beyond what two workers of one machine show",
        f"the job is long: its start and its last ranges do not count; {failures}",
    ]


def picture(curves: dict[str, list[Rate]], limits: dict[str, dict[str, float]], out: Path) -> None:
    """Draw pages a second and efficiency against nodes."""
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for (name, rates), colour in zip(curves.items(), (BLUE, ORANGE), strict=False):
        nodes = [rate.nodes for rate in rates]
        ideal = [rate.nodes * rates[0].pages_per_s / rates[0].efficiency for rate in rates]
        left.plot(nodes, ideal, color=colour, linewidth=0.8, linestyle="dashed")
        left.plot(nodes, [rate.pages_per_s for rate in rates], "o-", color=colour, markersize=4, label=name)
        right.plot(nodes, [rate.efficiency for rate in rates], "o-", color=colour, markersize=4, label=name)
        side: Literal["left", "right"] = "left" if colour is ORANGE else "right"
        for (part, at), style in zip(sorted(limits[name].items()), (":", "-."), strict=False):
            if at <= 2 * nodes[-1]:
                right.axvline(at, color=colour, linestyle=style, linewidth=1)
                told = f"{part} full, {name}"
                right.annotate(told, (at, 0.03), rotation=90, va="bottom", ha=side, fontsize=7, color=colour)
    left.set(xlabel="nodes", ylabel="pages/s", xscale="log", yscale="log")
    right.set(
        xlabel="nodes",
        ylabel="efficiency, of workers that never wait",
        xscale="log",
        ylim=(0, 1.05),
    )
    left.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_figure_png(out, figure, dpi=110)


def _table(name: str, rates: Sequence[Rate]) -> str:
    rows = [f"{name}\n{'nodes':>6} {'pages/s':>9} {'efficiency':>10} {'driver':>7} {'storage':>8}  bound by"]
    rows += [
        f"{rate.nodes:>6} {rate.pages_per_s:>9.1f} {rate.efficiency:>10.2f} {rate.driver:>7.2f} {rate.storage:>8.2f}  "
        f"{rate.bound}"
        for rate in rates
    ]
    return "\n".join(rows)


def _first(limits: dict[str, float]) -> str:
    part, nodes = min(limits.items(), key=lambda each: each[1])
    other, later = max(limits.items(), key=lambda each: each[1])
    return f"first saturated: the {part}, at {nodes:,.0f} nodes; the {other} at {later:,.0f}"


@click.command()
@click.option("--from", "from_path", type=click.Path(path_type=Path), help="Take what was measured from this file.")
@click.option("--out", type=OutputFolder(), help="Measure this machine; archive and runs go here.")
@click.option("--keep", type=OutputFile(), help="Write what was measured to this file.")
@click.option(
    "--pages", default=320, show_default=True, type=click.IntRange(8), help="Pages of the archive to measure on."
)
@click.option("--fields", default=64, show_default=True, type=click.IntRange(1), help="Pages that are simulated.")
@click.option("--range-pages", default=32, show_default=True, type=click.IntRange(1))
@click.option("--nodes", multiple=True, type=click.IntRange(1), help="Nodes of a cluster; may be given several times.")
@click.option(
    "--storage",
    default=ETHERNET_BYTES_PER_S,
    show_default=True,
    type=float,
    help="Bytes a second of the storage of all nodes.",
)
@click.option(
    "--link", default=ETHERNET_BYTES_PER_S, show_default=True, type=float, help="Bytes a second of a node's link."
)
@click.option("--mtbf-hours", type=float, help="Mean time between failures of a node; without it none fails.")
@click.option(
    "--full-size-seconds",
    default=FULL_SIZE_S,
    show_default=True,
    type=float,
    help="Seconds of a full-size page, two cores.",
)
@click.option(
    "--full-size-bytes", default=FULL_SIZE_BYTES, show_default=True, type=float, help="Bytes of a full-size frame pair."
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--picture", "picture_path", type=OutputFile(), help="Draw the curves, PNG.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    from_path: Path | None,
    out: Path | None,
    keep: Path | None,
    pages: int,
    fields: int,
    range_pages: int,
    nodes: tuple[int, ...],
    storage: float,
    link: float,
    mtbf_hours: float | None,
    full_size_seconds: float,
    full_size_bytes: float,
    seed: int,
    picture_path: Path | None,
    json_path: Path | None,
) -> None:
    """Print pages a second and efficiency against nodes, what is saturated first, and how the model was checked."""
    figures = _figures(from_path, out, pages, fields, range_pages, seed)
    if keep is not None:
        replace_text(keep, figures.model_dump_json(indent=1) + "\n", "figures")
    driver = fitted_driver(figures.ray, AHEAD)
    mtbf_s = None if mtbf_hours is None else 3600 * mtbf_hours
    cluster = Cluster(1, 1, storage, link, mtbf_s)
    told = assumptions(figures, cluster, driver)
    click.echo("assumptions\n" + "\n".join(f"- {line}" for line in told))
    found: dict[str, Any] = {"node": figures.model_dump(), "assumptions": told, "checks": checks(figures), "kinds": {}}
    click.echo(f"\none node, job of {figures.pages} pages, local engine\nworkers  measured  predicted  from one worker")
    for row in found["checks"]:
        click.echo(
            f"{row['workers']:>7.0f} {row['measured_pages_per_s']:>9.2f} {row['predicted_pages_per_s']:>10.2f}"
            f" {row['predicted_from_one_worker']:>16.2f}"
        )
    curves, limits = dict[str, list[Rate]](), dict[str, dict[str, float]]()
    for kind in kinds(figures, full_size_seconds, full_size_bytes):
        curves[kind.name] = curve(kind, cluster, driver, nodes or NODES, seed)
        limits[kind.name] = nodes_that_saturate(replace(cluster, workers=kind.workers), kind.work, driver)
        name = (
            f"{kind.name}: {kind.work.mean_s:.3f} s a page and worker, {kind.workers} a node, "
            f"{kind.work.read_bytes / 1e6:.3g} MB read, {kind.work.written_bytes / 1e6:.2g} MB written"
        )
        click.echo(f"\n{_table(name, curves[kind.name])}\n{_first(limits[kind.name])}")
        rows = [{**vars(rate), "bound": rate.bound} for rate in curves[kind.name]]
        found["kinds"][kind.name] = {"rates": rows, "nodes_that_saturate": limits[kind.name]}
    if picture_path is not None:
        picture(curves, limits, picture_path)
    if json_path is not None:
        write_figures(json_path, found)


def _figures(
    from_path: Path | None, out: Path | None, pages: int, fields: int, range_pages: int, seed: int
) -> NodeFigures:
    if (from_path is None) == (out is None):
        raise InvalidInputError("options", "neither --from nor --out, or both", "one of them")
    if from_path is not None:
        return NodeFigures.read(from_path)
    assert out is not None
    folder = out / f"cost-{pages}"
    folder.mkdir(parents=True, exist_ok=True)
    return measure(archive(folder, pages, fields, seed), folder, range_pages)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.cost"))
