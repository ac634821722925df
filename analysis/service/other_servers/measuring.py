"""Measurements of one graph in all servers: the ways to call them, what calls take, and how they compare."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from analysis.service.other_servers import rivals
from analysis.service.other_servers.bare_run import CUT, WHOLE, BareRuns
from analysis.service.other_servers.calls import Call, chunk_caller, inference_caller, memory_caller
from analysis.service.other_servers.figures import Comparison, Figure
from analysis.service.other_servers.graphs import DECODER_NAME, Graph
from analysis.service.other_servers.onnx_run import GRAPH, OUTPUT, OnnxRun
from analysis.service.other_servers.servers import MARK, Marked, OtherServer
from analysis.service.other_servers.timing import CALLERS, in_turns, rate, timed
from analysis.service.running import RunningService
from lightpage.errors import LightpageError
from lightpage.runtime.service.frames.inference_calls import MODEL

OWN = "Lightpage"
CALLS_EACH = {"constant-small": 12, "constant-large": 3, DECODER_NAME: 4}
"""Calls of each caller at once, in one round."""


@dataclass(frozen=True)
class Way:
    """Way to call a server.

    Attributes:
        server: name of the server.
        marked: processes of the server.
        connect: a caller.
    """

    server: str
    marked: Marked
    connect: Callable[[], AbstractContextManager[Call]]


@contextmanager
def own_ways(graph: Graph, threads: int, folder: Path) -> Iterator[dict[str, Way]]:
    """The service with a graph, at a port and at a socket."""
    own = ("--bundle", str(graph.bundle), "--no-tracking", "--threads", str(threads))
    near, far = Marked(), Marked()
    at_socket = ("--address", f"unix:{folder}/{graph.name}.socket", "--shared-memory")
    with (
        RunningService(*own, environment={MARK: far.mark}) as service,
        RunningService(*own, *at_socket, environment={MARK: near.mark}) as local,
    ):
        wanted = ("symbols", "confidence")
        yield {
            f"{OWN}, chunks": Way(OWN, far, partial(chunk_caller, service.target, graph)),
            f"{OWN}, Open Inference Protocol": Way(
                OWN, far, partial(inference_caller, service.target, MODEL, graph.pair, wanted)
            ),
            f"{OWN}, shared memory": Way(OWN, near, partial(memory_caller, local.target, graph)),
        }


def other_ways(servers: Mapping[str, OtherServer], graph: Graph) -> dict[str, Way]:
    """The others with a graph."""
    return {
        f"{name}, {kind}": Way(name, server.marked, partial(callers[name], graph))
        for name, server in servers.items()
        for kind, callers in (("gRPC", rivals.GRPC), ("HTTP", rivals.HTTP))
    }


def check_answers(graph: Graph, ways: Mapping[str, Way], folder: Path, threads: int) -> None:
    """Check that the others carry this graph, and that the service answers the same in every way.

    Raises:
        LightpageError: they do not.
    """
    expected, symbols = OnnxRun(folder / graph.name / GRAPH, threads)(*graph.frames), None
    for name, way in ways.items():
        with way.connect() as call:
            answer = call()
        if OUTPUT in answer:
            same = np.array_equal(answer[OUTPUT].reshape(expected.shape), expected)
        else:
            symbols = answer["symbols"] if symbols is None else symbols
            same = np.array_equal(answer["symbols"], symbols)
        if not same:
            raise LightpageError(f"{name} with graph {graph.name}", "another answer", "that of the same ONNX file")


def measured(
    graph: Graph, ways: Mapping[str, Way], bare: BareRuns, calls: int, rounds: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Overheads, rates and CPU time of each way with a graph."""
    with ExitStack() as stack:
        called = {name: partial(timed, stack.enter_context(way.connect())) for name, way in ways.items()}
        runs = {kind: partial(bare.run, kind, graph.name) for kind in (WHOLE, CUT)}
        told = in_turns({**runs, **called}, calls, graph.name, rng)
    whole, cut = ([each.seconds for each in told.pop(kind)] for kind in (WHOLE, CUT))
    alone = median(whole)
    overheads = {name: figure_ms([each.seconds - alone for each in taken]) for name, taken in told.items()}
    without = {name: figure_ms([each.seconds - alone - each.work_s for each in taken]) for name, taken in told.items()}
    each = CALLS_EACH[graph.name]

    def at_once(way: Way) -> tuple[float, float]:
        before = way.marked.cpu_s()
        answers_per_s = rate(way.connect, each)
        return answers_per_s, 1e3 * (way.marked.cpu_s() - before) / (CALLERS * (each + 1))

    blocks = {name: partial(at_once, way) for name, way in ways.items()}
    loaded = in_turns(blocks, rounds, f"{graph.name}, {CALLERS} callers", rng, warm=0)
    throughput = {name: Figure.of([answers_per_s for answers_per_s, _ in found]) for name, found in loaded.items()}
    return {
        "pair_bytes": graph.pair_bytes,
        "bare_run_ms": asdict(figure_ms(whole)),
        "bare_cut_run_ms": asdict(figure_ms(cut)),
        "overhead_ms": {name: asdict(figure) for name, figure in overheads.items()},
        "overhead_without_work_ms": {name: asdict(figure) for name, figure in without.items()},
        "pages_per_s": {name: asdict(figure) for name, figure in throughput.items()},
        "server_cpu_ms": {name: median(cpu_ms for _, cpu_ms in found) for name, found in loaded.items()},
        "bare_runs_ms": {WHOLE: [1e3 * each for each in whole], CUT: [1e3 * each for each in cut]},
        "calls_ms": {name: [1e3 * each.seconds for each in taken] for name, taken in told.items()},
        "overhead_compared": compared(overheads, ways),
        "overhead_without_work_compared": compared(without, ways),
        "pages_per_s_compared": compared(throughput, ways, more_is_better=True),
    }


def figure_ms(seconds: Sequence[float]) -> Figure:
    """Milliseconds of seconds."""
    return Figure.of([1e3 * each for each in seconds])


def compared(
    figures: Mapping[str, Figure], ways: Mapping[str, Way], more_is_better: bool = False
) -> dict[str, dict[str, dict[str, Any]]]:
    """Each way of the others beside each one of the service, by both names; `best` says it is its server's best."""
    own = [name for name, way in ways.items() if way.server == OWN]
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for other, way in ways.items():
        if way.server == OWN:
            continue
        names = [name for name in ways if ways[name].server == way.server]
        best = (max if more_is_better else min)(names, key=lambda name: figures[name].p50)
        found[other] = {}
        for name in own:
            comparison = Comparison.of(figures[name], figures[other], more_is_better)
            found[other][name] = {**asdict(comparison), "missed_by": comparison.missed_by, "best": other == best}
    return found
