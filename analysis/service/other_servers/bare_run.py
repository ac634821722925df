"""Graphs in a process that serves nobody: what a run takes at least.

It runs the graph as the other servers have it (`WHOLE`), or cut in two as the service has it (`CUT`,
`runtime/model/execution/table_graph.py`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from analysis.service.other_servers.graphs import Graph
from analysis.service.other_servers.onnx_run import FRAMES, open_all
from analysis.service.other_servers.timing import Timed
from lightpage.helper_process import Helper, HelperProcess
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.page_graph import open_graph

WHOLE, CUT = "whole", "cut"
_START_S = 120.0
_RUN_S = 60.0


class BareRuns:
    """Process that runs graphs and serves nobody; use it in a `with` statement.

    Args:
        folder: folder of the models.
        graphs: graphs in it.
        threads: threads of one run.

    Raises:
        WorkerError: it has ended, or does not answer.
    """

    def __init__(self, folder: Path, graphs: Iterable[Graph], threads: int) -> None:
        self._process = HelperProcess(f"{__name__}:Runs", subject="bare runs")
        try:
            bundles = {graph.name: graph.bundle for graph in graphs}
            self._process.ask("load", folder, threads, bundles, timeout_s=_START_S)
        except BaseException:
            self._process.end()
            raise

    def run(self, kind: str, name: str) -> Timed:
        """Run a graph once, `WHOLE` or `CUT`."""
        return Timed(self._process.ask("run", kind, name, timeout_s=_RUN_S))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.end()


class Runs(Helper):
    """Runs graphs."""

    def load(self, folder: Path, threads: int, bundles: dict[str, Path]) -> None:
        """Load the models of a folder, and the bundles by the names of their graphs."""
        self._runs: dict[tuple[str, str], Callable[[], object]] = {}
        for name, whole in open_all(folder, threads).items():
            self._runs[WHOLE, name] = partial(whole, *np.load(folder / name / FRAMES))
        for name, path in bundles.items():
            bundle = Bundle.open(path)
            cut = Decoder(bundle, threads, open_graph(bundle, threads))
            self._runs[CUT, name] = partial(cut.infer, FramePair(*np.load(folder / name / FRAMES)))

    def run(self, kind: str, name: str) -> float:
        """Run one once; returns the seconds that it took."""
        begun = time.perf_counter()
        self._runs[kind, name]()
        return time.perf_counter() - begun
