"""A training run's decoder as a graph, and the golden page that it is proven by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import sampling_table
from lightpage.export.estimator_graphs import WholeGraph
from lightpage.export.graph import DecoderGraph, Graph, PublishedGraph, published_tensors, table_tensors
from lightpage.export.parity import torch_answer
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import COARSE, residual_limit, shows_page
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.published.trainer import published_decoder
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import Run, load_decoder, load_weights

Tensors = dict[str, NDArray[np.generic]]


def graph_of(folder: Path, run: Run, references: FramePair, twin: RayTwin) -> tuple[Graph, Tensors]:
    """A run's decoder as a graph, and the defaults of its table.

    Raises:
        InvalidInputError: no weights.
    """
    profile, calibration, choices = run.profile, run.calibration, run.hyperparameters
    if isinstance(choices, PublishedChoices):
        decoder = published_decoder(run.localizer, choices, profile, references, calibration.turn_rad)
        published = PublishedGraph(load_weights(folder, decoder), run.kappa_scale).eval()
        return published, published_tensors(decoder)
    table = sampling_table(TorchTwin(twin), calibration.vector, calibration.turn_rad, profile)
    apart = calibration.device(profile, references).apart_inputs
    graph = DecoderGraph(profile, load_decoder(folder, run), run.kappa_scale, apart=apart).eval()
    return graph, table_tensors(graph, table, references)


def golden_of(
    graph: Graph | WholeGraph, pair: FramePair, defaults: Tensors, bit_depth: int, residual: str = "residual"
) -> tuple[float | None, FramePair, dict[str, NDArray[np.float32]]]:
    """The residual's limit by a page of a run, the frames of the golden page, and what torch says to them.

    Args:
        graph, defaults: decoder and its table.
        pair: frames of the page.
        bit_depth: bits of the counts.
        residual: output by which the bundle judges its pages.
    """
    answer = torch_answer(graph, pair, defaults)
    limit = _residual_limit(graph, pair, defaults, answer, residual)
    for rounded in COARSE:
        coarse = rounded(pair, bit_depth)
        to_coarse = torch_answer(graph, coarse, defaults)
        if limit is None or shows_page(float(to_coarse[residual]), limit):
            return limit, coarse, to_coarse
    return limit, pair, answer


def _residual_limit(
    graph: Graph | WholeGraph,
    pair: FramePair,
    defaults: Tensors,
    answer: dict[str, NDArray[np.float32]],
    residual: str,
) -> float | None:
    """See `residual_limit`."""
    if residual not in graph.outputs:
        return None
    swapped = float(torch_answer(graph, FramePair(pair.quadrature, pair.in_phase), defaults)[residual])
    return residual_limit(float(answer[residual]), swapped)
