"""Graphs in a process that serves nobody: what a run takes at least.

It is a helper process (`BareRuns`). It answers each line, ``whole NAME`` or ``cut NAME``, with the seconds of one run:
of the graph as the other servers have it, or cut in two as the service has it
(`runtime/model/execution/table_graph.py`).
"""

from __future__ import annotations

import sys
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
from lightpage.helper_process import HelperProcess, parent_link
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder, open_graph

WHOLE, CUT = "whole", "cut"
_MODULE = "analysis.service.other_servers.bare_run"
_START_S = 120.0
_RUN_S = 60.0


class BareRuns:
    """Such a process; use it in a `with` statement.

    Args:
        folder: of the models.
        graphs: in it.
        threads: of one run.

    Raises:
        ConnectionError: it has ended.
        TimeoutError: it does not answer.
    """

    def __init__(self, folder: Path, graphs: Iterable[Graph], threads: int) -> None:
        bundles = [f"{graph.name}={graph.bundle}" for graph in graphs]
        self._process = HelperProcess(_MODULE, str(folder), str(threads), *bundles, subject="the process of bare runs")
        try:
            self._process.line(time.monotonic() + _START_S)
        except BaseException:
            self._process.end()
            raise

    def run(self, kind: str, name: str) -> Timed:
        """Run a graph once, `WHOLE` or `CUT`."""
        end = time.monotonic() + _RUN_S
        self._process.send(f"{kind} {name}\n".encode(), end)
        return Timed(float(self._process.line(end)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.end()


def main(folder: Path, threads: int, *bundles: str) -> None:
    """Run what is asked for, until nobody asks any more."""
    runs: dict[str, Callable[[], object]] = {}
    for name, whole in open_all(folder, threads).items():
        runs[f"{WHOLE} {name}"] = partial(whole, *np.load(folder / name / FRAMES))
    for name, _, path in (each.partition("=") for each in bundles):
        bundle = Bundle.open(path)
        cut = Decoder(bundle, threads, open_graph(bundle, threads))
        runs[f"{CUT} {name}"] = partial(cut.infer, FramePair(*np.load(folder / name / FRAMES)))
    with parent_link() as link, link.makefile("r") as asked:
        link.sendall(b"ready\n")
        for line in asked:
            begun = time.perf_counter()
            runs[line.strip()]()
            link.sendall(f"{time.perf_counter() - begun}\n".encode())


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
