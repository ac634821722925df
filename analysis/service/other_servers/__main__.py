"""Overhead of a call beyond the run of the graph, for the service, MLServer, KServe and Ray Serve with the same graph.

    python -m analysis.service.other_servers --out runs/bench-service/other-servers --json FILE

Each of the others is installed into an environment of its own below --out, at the first run: 1.5 GB in all. All servers
then run in a private network, since some of them listen on every address. They stay up together, and are called in
turns, one at a time, in an order that changes. How busy the idle ones keep the cores is told.

**Graphs.** Two answer a constant whatever the frames are, for pairs of 2.5 and 40 MB. The third is the decoder of the
shipped bundle. The others run the bundle's ONNX file as it is, by the same ONNX Runtime with the same threads, and
answer its output p. They do nothing else. The service checks frames and pilots, decides symbols, and answers them with
their posterior probabilities: that counts as overhead. It has the graph cut in two: what follows from the table alone
is computed on loading, and not for every page (`runtime/model/execution/table_graph.py`). Image tracking is off.

**Overhead** is a call's time, from frames as arrays to an answer as arrays, less the median run of the same ONNX file
in a process that serves nobody, in the same rounds. With the decoder, the cut takes time off the service's alone. What
the cut graph takes is told too. So is the overhead without the service's checks and decision, whose time it tells
itself. **Throughput** is of four callers at once.

**Ways.** The service is called by its own contract (chunks), by the Open Inference Protocol, and over a Unix socket
with shared memory that frames are copied into. The others are called by the Open Inference Protocol over gRPC, and with
bare bytes over HTTP. Each way of the one is compared with each of the others. A way is better than another if their
medians differ by more than the larger spread of both, from the 10th to the 90th percentile. What was tried too is timed
with a few calls: MLServer with tensors of numbers, Ray Serve behind its proxy.
"""

from __future__ import annotations

import platform
import re
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

from analysis.service.other_servers import rivals
from analysis.service.other_servers.bare_run import BareRuns
from analysis.service.other_servers.environments import NAMES, environment, requirements
from analysis.service.other_servers.graphs import Graph, write_graphs
from analysis.service.other_servers.measuring import Way, check_answers, measured, other_ways, own_ways
from analysis.service.other_servers.onnx_run import AT_ONCE
from analysis.service.other_servers.servers import OtherServer
from analysis.service.other_servers.timing import CALLERS, in_turns, timed
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.virtual_device.namespace import go_on_inside, require

_NAME = "analysis.service.other_servers"
_IDLE_S = 5.0
_TRIED = 5
"""Calls of a configuration that does not count."""
_TOLD = ("grpcio", "numpy", "onnxruntime", "protobuf")
"""Packages whose versions are told, beside the server's own."""
_COMPARED = (
    ("overhead", "overhead_compared", "ms less"),
    ("overhead without the service's checks and decision", "overhead_without_work_compared", "ms less"),
    ("throughput", "pages_per_s_compared", "pages/s more"),
)


def idle_cores(ways: Iterable[Way]) -> dict[str, float]:
    """Return how many cores each idle server keeps busy; the service's port and socket count as one server."""
    servers = {way.marked: way.server for way in ways}
    before = {marked: marked.cpu_s() for marked in servers}
    time.sleep(_IDLE_S)
    busy = dict.fromkeys(servers.values(), 0.0)
    for marked, name in servers.items():
        busy[name] += (marked.cpu_s() - before[marked]) / _IDLE_S
    return busy


def versions() -> dict[str, Any]:
    """Return the versions of what runs here and in each environment."""
    found: dict[str, Any] = {"python": platform.python_version()}
    found["lightpage"] = {name: version(name) for name in ("lightpage", *_TOLD)}
    for name in NAMES:
        pinned = dict(re.findall(r"^([\w.-]+)==(\S+)$", requirements(name), re.M))
        found[name] = {package: pinned[package] for package in (name, *_TOLD)}
    return found


def tried(name: str, connect: rivals.Caller, graphs: list[Graph]) -> dict[str, float]:
    """Milliseconds of a few calls with each graph."""
    found, rng = {}, np.random.default_rng(0)
    for graph in graphs:
        with connect(graph) as call:
            taken = in_turns({name: partial(timed, call)}, _TRIED, f"{name}, {graph.name}", rng)[name]
        found[graph.name] = 1e3 * median(each.seconds for each in taken)
    return found


def show(name: str, found: dict[str, Any]) -> None:
    """Print what was found with one graph."""
    whole, cut = found["bare_run_ms"], found["bare_cut_run_ms"]
    click.echo(
        f"\n{name}, pairs of {found['pair_bytes'] / 1e6:.1f} MB; a bare run takes {whole['p50']:.2f} ms "
        f"({whole['p10']:.2f} to {whole['p90']:.2f}), cut in two {cut['p50']:.2f}"
    )
    click.echo(f"{'':<36}{'overhead, ms':>24}{f'{CALLERS} callers, pages/s':>28}{'server CPU, ms':>16}")
    click.echo(f"{'':<36}{'p10':>8}{'p50':>8}{'p90':>8}{'p10':>12}{'p50':>8}{'p90':>8}{'a call':>16}")
    for way, overhead in found["overhead_ms"].items():
        rates, cpu = found["pages_per_s"][way], found["server_cpu_ms"][way]
        click.echo(
            f"{way:<36}{overhead['p10']:>8.2f}{overhead['p50']:>8.2f}{overhead['p90']:>8.2f}"
            f"{rates['p10']:>12.2f}{rates['p50']:>8.2f}{rates['p90']:>8.2f}{cpu:>16.1f}"
        )
    for what, key, unit in _COMPARED:
        click.echo(f"{what}: {unit} in the service than in others, * in their better way, (spread)")
        owns = next(iter(found[key].values()))
        click.echo(f"{'':<36}" + "".join(f"{name:<38}" for name in owns))
        for other, beside in found[key].items():
            mark = "*" if next(iter(beside.values()))["best"] else ""
            click.echo(f"{other + mark:<36}" + "".join(f"{verdict(one):<38}" for one in beside.values()).rstrip())


def verdict(one: dict[str, Any]) -> str:
    """A comparison in words."""
    beyond = "better" if one["missed_by"] < 0 else f"missed by {one['missed_by']:.2f}"
    return f"{one['difference']:+.2f} ({one['spread']:.2f}) {beyond}"


@click.command()
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("runs/bench-service/other-servers"),
    show_default=True,
    help="Folder of the environments.",
)
@click.option("--calls", default=40, show_default=True, type=click.IntRange(3), help="Calls of each way, one by one.")
@click.option("--rounds", default=3, show_default=True, type=click.IntRange(1), help="Rounds of callers at once.")
@click.option("--threads", type=click.IntRange(1), help="Threads of one run; by default all cores.")
@click.option("--seed", default=0, show_default=True, help="Seed of the order in which they are called.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(out: Path, calls: int, rounds: int, threads: int | None, seed: int, json_path: Path | None) -> None:
    """Print what calls cost beside the graph, and pages a second, of all servers."""
    require()
    pythons = {name: environment(out.absolute(), name) for name in NAMES}
    go_on_inside(_NAME)
    threads, rng = threads or available_cpus(), np.random.default_rng(seed)
    figures: dict[str, Any] = {
        "versions": versions(),
        "cores": available_cpus(),
        "threads": threads,
        "runs_at_once": AT_ONCE,
        "callers": CALLERS,
        "calls": calls,
        "rounds": rounds,
        "seed": seed,
    }
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder, models = Path(name), Path(name) / "models"
        models.mkdir()
        graphs = write_graphs(models, threads)
        with ExitStack() as stack:
            servers: dict[str, OtherServer] = {}
            for each in (
                rivals.mlserver(pythons["mlserver"], models, folder),
                rivals.kserve(pythons["kserve"], models, folder, threads),
                rivals.ray_serve(pythons["ray"], models, folder, threads),
            ):
                server = stack.enter_context(each)
                servers[server.name] = server
            for server in servers.values():
                server.wait(graphs[0])
            bare = stack.enter_context(BareRuns(models, graphs, threads))
            figures["graphs"] = {}
            for graph in graphs:
                with own_ways(graph, threads, folder) as own:
                    ways = own | other_ways(servers, graph)
                    check_answers(graph, ways, models, threads)
                    if "idle_cores" not in figures:
                        figures["idle_cores"] = idle_cores(ways.values())
                        busy = ", ".join(f"{name} {share:.3f}" for name, share in figures["idle_cores"].items())
                        click.echo(f"cores that idle servers keep busy: {busy}")
                    found = measured(graph, ways, bare, calls, rounds, rng)
                figures["graphs"][graph.name] = found
                show(graph.name, found)
            others = {"MLServer, gRPC, numbers": tried("MLServer, numbers", rivals.MLSERVER_NUMBERS, graphs)}
            figures["memory_mb"] = {name: each.marked.resident_bytes() / 1e6 for name, each in servers.items()}
        with rivals.ray_serve(pythons["ray"], models, folder, threads, direct=False) as server:
            server.wait(graphs[0])
            for kind, caller in (("gRPC", rivals.RAY_PROXY_GRPC), ("HTTP", rivals.RAY_PROXY_HTTP)):
                others[f"Ray Serve, {kind}, behind its proxy"] = tried(f"Ray's proxy, {kind}", caller, graphs)
    figures["tried_ms"] = others
    click.echo("\ntried too, milliseconds of a call, the run included:")
    for way, taken in others.items():
        click.echo(f"{way:<36}" + ", ".join(f"{name} {value:.1f}" for name, value in taken.items()))
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name=f"python -m {_NAME}"))
