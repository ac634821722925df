"""Proof that an exported decoder says what torch says, on real frames."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lightpage.errors import BundleError
from lightpage.export.estimator_graphs import WholeGraph
from lightpage.export.graph import Graph
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.manifest import FLOAT32
from lightpage.runtime.model.decoding.golden import GOLDEN_TOLERANCE


def torch_answer(
    graph: Graph | WholeGraph, pair: FramePair, defaults: dict[str, NDArray[np.generic]]
) -> dict[str, NDArray[np.float32]]:
    """Every output of the decoder for a frame pair, by torch; `defaults` in the order of its inputs."""
    with torch.no_grad():
        answers = graph(
            torch.from_numpy(pair.in_phase),
            torch.from_numpy(pair.quadrature),
            *(torch.from_numpy(np.ascontiguousarray(value)) for value in defaults.values()),
        )
    return {name: answer.numpy() for name, answer in zip(graph.outputs, answers, strict=True)}


def check_parity(
    expected: NDArray[np.float32], got: NDArray[np.float32], subject: str, tolerance: float = GOLDEN_TOLERANCE[FLOAT32]
) -> float:
    """Relative error of p.

    Raises:
        BundleError: it is larger than the tolerance, or not a number.
    """
    error = float(np.linalg.norm(got - expected) / max(float(np.linalg.norm(expected)), 1e-30))
    if not error <= tolerance:
        raise BundleError(f"parity of {subject} with torch", f"p off by {error:.3g} of its norm", f"<= {tolerance:g}")
    return error
