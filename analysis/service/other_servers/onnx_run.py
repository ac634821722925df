"""Run of an ONNX graph in ONNX Runtime, the same for each of the other servers in its own environment.

The module needs numpy and onnxruntime, and nothing of Lightpage.
"""

from __future__ import annotations

import os
from pathlib import Path
from threading import BoundedSemaphore
from typing import Any

import numpy as np
from numpy.typing import NDArray

os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # read once, on import

import onnxruntime  # type: ignore[import-untyped]

GRAPH = "graph.onnx"
"""Name of the graph in the folder of a model, which is named as the model is."""
FRAMES = "frames.npy"
"""Beside it: a pair that the model takes, [2, rows, columns]."""
OUTPUT = "p"
"""The one output that is asked for: the others follow from it."""
AT_ONCE = 2
"""Runs at once, as the service has it: a second page fills the gaps around the first."""
_ERRORS_ONLY = 3


class OnnxRun:
    """A graph that is open; calls may come from many threads at once.

    Args:
        path: path of the graph.
        threads: threads of one run.
    """

    def __init__(self, path: Path, threads: int) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = _ERRORS_ONLY
        # As in the service: behind a run its threads leave the cores to those who send and receive.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self._room = BoundedSemaphore(AT_ONCE)

    def __call__(self, in_phase: NDArray[Any], quadrature: NDArray[Any]) -> NDArray[np.float32]:
        """p of a frame pair, float32 [2, ny, nx]."""
        with self._room:
            p: NDArray[np.float32] = self._session.run([OUTPUT], {"in_phase": in_phase, "quadrature": quadrature})[0]
        return p


def open_all(folder: Path, threads: int) -> dict[str, OnnxRun]:
    """The graphs of all models in a folder, by name."""
    return {path.parent.name: OnnxRun(path, threads) for path in sorted(folder.glob(f"*/{GRAPH}"))}
