"""Time of the serving runtime for a page with an exported decoder."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from lightpage.device.profile import Profile
from lightpage.export.graph import FRAME_INPUTS
from lightpage.runtime.model.execution.page_graph import PAGE_INPUTS
from lightpage.runtime.model.execution.table_graph import GraphFile, TableGraph

SETTLE_S = 0.2
"""Pause before a decode: the threads of the one before spin for a while, and would be in its way."""


def opened(model: bytes, threads: int, profile: Path | None = None) -> TableGraph:
    """An exported decoder in the runtime that serves; `profile` as for `open_session`."""
    return TableGraph(GraphFile(model, "speed"), "speed", PAGE_INPUTS, threads, profile=profile)


def frames_of(profile: Profile) -> dict[str, np.ndarray]:
    """A frame pair of noise: times do not depend on what is seen."""
    rng = np.random.default_rng(0)
    return {name: rng.integers(60, 140, profile.frame_shape, dtype=np.uint8) for name in FRAME_INPUTS}


def seconds_of(graph: TableGraph, feeds: dict[str, np.ndarray]) -> float:
    """Time one decode, seconds, after the threads of the previous one have come to rest."""
    time.sleep(SETTLE_S)
    start = time.perf_counter()
    graph.run(["p"], feeds)
    return time.perf_counter() - start
